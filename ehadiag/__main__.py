"""Run the command line as `python -m ehadiag`."""

import os
import sys

if __name__ == "__main__":
    # `python -m` looks into the working folder first, where others may have put Python files.
    if not sys.flags.safe_path and sys.path[0] != os.path.dirname(os.path.dirname(__file__)):
        del sys.path[0]
    from ehadiag.cli.main import process

    process()
