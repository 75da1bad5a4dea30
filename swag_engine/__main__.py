"""`python -m swag_engine COMMAND ...`: the command line."""

import sys

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
