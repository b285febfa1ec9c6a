"""`advsearch dashboard`: look at runs in a browser."""

from __future__ import annotations

import argparse
import sys
from functools import cached_property
from typing import TYPE_CHECKING

from advsearch.cli import output
from advsearch.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

    from advsearch.questions.photographs.answer import PhotoAgreement
    from advsearch.questions.photographs.carry_out import Photographs

HELP = "show the pages of runs in a browser on this machine"
MORE = ". It keeps the photographs that are taken on a run's page, writes nothing else, and ends with Ctrl-C"

PORT = 8265
EXAMPLES = ("dashboard", "dashboard mug-sweep-001 mug-sweep-002", "dashboard --host 0.0.0.0")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("runs", nargs="*", metavar="RUN", help="names or folders of runs (default: all in runs/)")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen at (default: %(default)s); others need the printed token"
    )
    parser.add_argument("--port", type=int, default=PORT, help="port; 0 takes a free one (default: %(default)s)")
    parser.add_argument(
        "--https", action="store_true", help="speak HTTPS on this machine too; at other addresses that is always so"
    )
    parser.add_argument("--json", action="store_true", help="print the address as JSON")


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    # late, so that --help answers at once
    from advsearch.questions.photographs.answer import NO_QR, qr_text
    from advsearch.runs.directory import find_run
    from advsearch.viewer.server import Dashboard

    if not 0 <= args.port <= 65535:
        raise InputError(f"--port: expected a number from 0 to 65535, got {args.port}")
    runs = [find_run(name) for name in args.runs]
    server = Dashboard(runs, args.host, args.port, https=args.https, photographs=_LoadedLater())
    if args.json:
        told = {"address": server.address, "token": server.token, "fingerprint": server.fingerprint}
        output.print_json({"schema": 1, "command": "dashboard", **told})
        sys.stdout.flush()
    else:
        print(server.address, flush=True)
    if server.fingerprint:
        print(
            "The browser will warn of the certificate, which was made for this server alone. Its SHA-256 is "
            f"{server.fingerprint}.",
            file=sys.stderr,
        )
    if server.token:
        print("Whoever has this address sees the runs and can add photographs to them.", file=sys.stderr)
        print(qr_text(server.address) or f"For a code to point a phone at: {NO_QR}", file=sys.stderr)
    print("Ctrl-C ends it.", file=sys.stderr)
    try:
        server.serve_forever()
    finally:
        server.server_close()
    return 0


class _LoadedLater:
    """`Photographs`, which needs PyTorch: loaded when a page of photographs is first opened."""

    @cached_property
    def _loaded(self) -> Photographs:
        # late, so that --help answers at once
        from advsearch.questions.photographs.carry_out import Photographs

        return Photographs()

    def add(self, run: Path, rendering: str, data: bytes) -> PhotoAgreement:
        return self._loaded.add(run, rendering, data)

    def agreement(self, run: Path) -> PhotoAgreement:
        return self._loaded.agreement(run)
