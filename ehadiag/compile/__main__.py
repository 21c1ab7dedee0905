"""Compiles the libraries that come with the package: `python -m ehadiag.compile FOLDER`.

For all levels of instructions; with `--here` only for this processor's own.
"""

import sys
from pathlib import Path

from ehadiag.compile import libraries

if __name__ == "__main__":
    here = [libraries.processor_level()] if sys.argv[2:] == ["--here"] else libraries.LEVELS
    libraries.build(Path(sys.argv[1]), here)
