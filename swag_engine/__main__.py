"""`swag COMMAND ...` or `python -m swag_engine COMMAND ...`: the command line."""

import os
import sys
from pathlib import Path

try:
    here = os.getcwd()
except OSError:
    print("The current folder does not exist any more: change to another one.", file=sys.stderr)
    sys.exit(2)
if sys.path[0] == here != str(Path(__file__).resolve().parents[1]):
    del sys.path[0]  # python -m would import packages from the current folder

from .app.answers import refuse_missing


def main() -> int:
    """Run the command line and return its exit code; a Python without the packages it needs is told which."""
    for number in range(3):  # a stream that a service has closed: the next file that is opened would take its place
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    sys.stdout = sys.stdout or open(1, "w", encoding="utf-8")  # noqa: SIM115 (until the process ends)
    sys.stderr = sys.stderr or open(2, "w", encoding="utf-8")  # noqa: SIM115
    try:
        from .app import cli
    except ModuleNotFoundError as error:
        return refuse_missing(error, sys.argv[1:])
    return cli.main()


if __name__ == "__main__":
    sys.exit(main())
