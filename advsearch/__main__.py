"""The `advsearch` command, and `python -m advsearch`."""

from __future__ import annotations

import signal
import sys


def start() -> int:
    """Run the command line and return its exit status."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends the process, without a traceback, until `main` begins

    from advsearch.cli.main import main

    return main()


if __name__ == "__main__":
    sys.exit(start())
