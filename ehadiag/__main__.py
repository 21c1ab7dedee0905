"""Run the command line as `python -m ehadiag`."""

from ehadiag.cli.main import process

if __name__ == "__main__":
    process()
