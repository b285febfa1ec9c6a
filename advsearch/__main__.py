"""`python -m advsearch`."""

from __future__ import annotations

import sys

from advsearch.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
