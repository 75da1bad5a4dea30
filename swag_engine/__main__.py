"""`swag COMMAND ...` or `python -m swag_engine COMMAND ...`: the command line."""

import os
import sys
from pathlib import Path

if sys.path[0] == os.getcwd() != str(Path(__file__).resolve().parents[1]):
    del sys.path[0]  # python -m would import packages from the current folder

from .app.answers import refuse_missing


def main() -> int:
    """Run the command line and return its exit code; a Python without the packages it needs is told which."""
    try:
        from .app import cli
    except ModuleNotFoundError as error:
        return refuse_missing(error, sys.argv[1:])
    return cli.main()


if __name__ == "__main__":
    sys.exit(main())
