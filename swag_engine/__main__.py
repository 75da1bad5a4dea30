"""`python -m swag_engine COMMAND ...`: the command line."""

import sys

from .app.cli import main

if __name__ == "__main__":
    sys.exit(main())
