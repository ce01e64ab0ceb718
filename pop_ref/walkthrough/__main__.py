"""Write the walk-through: `python -m pop_ref.walkthrough out/walkthrough`, and its other forms."""

import sys

from pop_ref.walkthrough.builder.command import main

if __name__ == "__main__":
    sys.exit(main())
