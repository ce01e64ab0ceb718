"""`python -m pop_fast.cli ...` is `pop ...`, for launchers that start a module."""

import sys

from pop_fast.cli import main

if __name__ == "__main__":
    sys.exit(main())
