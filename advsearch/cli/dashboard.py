"""`advsearch dashboard`: look at runs in a browser."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from advsearch.cli import output
from advsearch.errors import InputError

HELP = "serve the pages of runs to a browser on this machine"

PORT = 8265

_EXAMPLES = """examples:
  advsearch dashboard
  advsearch dashboard mug-sweep-001 mug-sweep-002
  advsearch dashboard --host 0.0.0.0
"""


def add_parser(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "dashboard",
        help=HELP,
        description=f"{HELP[0].upper()}{HELP[1:]}. It writes nothing, and ends with Ctrl-C.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("runs", nargs="*", metavar="RUN", help="names or folders of runs (default: all in runs/)")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen at (default: %(default)s); others need the printed token"
    )
    parser.add_argument("--port", type=int, default=PORT, help="port; 0 takes a free one (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print the address as JSON")


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    from advsearch.runs.directory import find_run
    from advsearch.viewer.server import Dashboard

    if not 0 <= args.port <= 65535:
        raise InputError(f"--port: expected a number from 0 to 65535, got {args.port}")
    server = Dashboard([find_run(name) for name in args.runs], args.host, args.port)
    if args.json:
        output.print_json({"schema": 1, "command": "dashboard", "address": server.address, "token": server.token})
        sys.stdout.flush()
    else:
        print(server.address, flush=True)
    if server.token:
        print(
            "Whoever has this address sees the runs, over plain HTTP; use it on networks that you trust.",
            file=sys.stderr,
        )
    print("Ctrl-C ends it.", file=sys.stderr)
    try:
        server.serve_forever()
    finally:
        server.server_close()
    return 0
