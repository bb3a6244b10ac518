"""``python -m misstep``: the command line."""

import sys

from misstep.cli import main

if __name__ == "__main__":
    sys.exit(main())
