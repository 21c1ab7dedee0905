"""Compiles the libraries that come with the package: `python -m ehadiag.compile FOLDER`.

For all levels of instructions; with `--here` only for this processor's own. What an earlier call
has compiled is taken only from a folder that `EHADIAG_CACHE_DIR` names.
"""

import os
import sys
import tempfile
from pathlib import Path

from ehadiag.compile import libraries

if __name__ == "__main__":
    here = [libraries.processor_level()] if sys.argv[2:] == ["--here"] else libraries.LEVELS
    with tempfile.TemporaryDirectory() as empty:
        os.environ["EHADIAG_CACHE_DIR"] = os.environ.get("EHADIAG_CACHE_DIR") or empty
        libraries.build(Path(sys.argv[1]), here)
