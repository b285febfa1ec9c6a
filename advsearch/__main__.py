"""The `advsearch` command, and `python -m advsearch`."""

from __future__ import annotations

import os
import signal
import sys


def start() -> int:
    """Run the command line and return its exit status."""
    # Ctrl-C ends the process, without a traceback, until `main` begins
    signal.signal(signal.SIGINT, signal.SIG_DFL)

    # imported only now, with signals handled as above
    from advsearch.cli.main import main
    from advsearch.cli.output import INTERRUPTED

    status = main()
    # An interrupt inside Dr.Jit leaves it in a state in which the interpreter would
    # abort at its end. So the process ends without the interpreter's cleanup.
    if status == INTERRUPTED:
        sys.stderr.flush()
        os._exit(status)  # standard output is written out, and every file is closed
    return status


if __name__ == "__main__":
    sys.exit(start())
