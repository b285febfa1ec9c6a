"""The commands `advsearch dashboard`, which serves the pages of runs to a browser, and
`advsearch view`, which makes the page of a run again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from advsearch.catalog import is_module_installed
from advsearch.cli import output
from advsearch.cli.main import argument, command
from advsearch.errors import InputError
from advsearch.questions.sweep.page import write_bundle
from advsearch.registry import load_attribute
from advsearch.runs.directory import find_run
from advsearch.viewer.clients import NO_QR, format_qr_code
from advsearch.viewer.pages import write_page
from advsearch.viewer.server import Dashboard

PORT = 8265
PHOTOGRAPH_PAGES = "advsearch.questions.photographs.pages:PhotographPages"

PRIVACY_NOTE = (
    "Anyone with this address can see the runs and send photographs. Each photograph is "
    "evaluated on this machine, by the model in the settings of the run, and stored in "
    "the folder of the run, as a picture and as rows. Nothing else is written."
)


@command(
    argument(
        "runs",
        nargs="*",
        metavar="RUN",
        help="names or folders of runs (default: all in runs/)",
    ),
    argument(
        "--host",
        default="127.0.0.1",
        help="address to listen at (default: %(default)s); at other addresses, anyone "
        "with the printed token can see the runs and add photographs, which the model "
        "of the run evaluates on this machine",
    ),
    argument(
        "--port",
        type=int,
        default=PORT,
        help="port; 0 for any free one (default: %(default)s)",
    ),
    argument(
        "--https",
        action="store_true",
        help="use HTTPS on this machine, too; at other addresses it is always used",
    ),
    argument("--json", action="store_true", help="print the address as JSON"),
    output.add_code_flag,
    more=". It stores the photographs that are taken on the page of a run, writes "
    "nothing else, and ends with Ctrl-C",
    examples=(
        "dashboard",
        "dashboard mug-sweep-001 mug-sweep-002",
        "dashboard --host 0.0.0.0",
    ),
)
def dashboard(args: argparse.Namespace) -> int:
    """Serve the pages of runs until Ctrl-C, and return the exit status.

    The address is printed on standard output, and all other messages on standard error.
    If others in the network can reach the server, its address has a token, and a note
    on privacy and a QR code are printed.

    Raises:
        InputError: the port is out of range, or a run does not exist.
    """
    if not 0 <= args.port <= 65535:
        raise InputError(f"--port: expected a number from 0 to 65535, got {args.port}")
    server = _open_server(args)
    facts = {
        "address": server.address,
        "token": server.token,
        "fingerprint": server.fingerprint,
    }
    output.print_answer(args.json, {"command": "dashboard", **facts}, server.address)
    # Output may be buffered: a program that waits for the address has to get it now.
    sys.stdout.flush()
    _print_advice(server)
    try:
        server.serve_forever()
    finally:
        server.server_close()
    return 0


def _open_server(args: argparse.Namespace) -> Dashboard:
    """Return the server of the runs that a command line names, at its address."""
    # Corrupt runs are allowed: the list of runs states the fault of each.
    runs = [find_run(name, checked=False) for name in args.runs]
    # PHOTOGRAPH_PAGES is "module:function"; an installation may lack the module
    has_photographs = is_module_installed(PHOTOGRAPH_PAGES.partition(":")[0])
    photographs = load_attribute(PHOTOGRAPH_PAGES)() if has_photographs else None
    return Dashboard(
        runs, args.host, args.port, https=args.https, photographs=photographs
    )


def _print_advice(server: Dashboard) -> None:
    """Print on standard error what a user of a server has to know."""
    if server.fingerprint:  # it speaks HTTPS
        print(
            "The browser will warn of the certificate, which was made for this server "
            "alone. Its SHA-256 is "
            f"{server.fingerprint}.",
            file=sys.stderr,
        )
    if server.token:  # others in the network can reach it
        print(PRIVACY_NOTE, file=sys.stderr)
        qr_code = format_qr_code(server.address)
        advice = f"For a code to point a phone at: {NO_QR}"
        print(qr_code or advice, file=sys.stderr)
    print("Ctrl-C ends it.", file=sys.stderr)


@command(
    argument(
        "runs",
        nargs="+",
        metavar="RUN",
        help="a run's name or folder; several sweeps with --bundle",
    ),
    argument(
        "--bundle",
        metavar="DIR",
        help="write a folder with a page, the rows and the small pictures",
    ),
    output.add_json_flag,
    examples=("view mug-sweep-001", "view mug-sweep-001 mug-sweep-002 --bundle site"),
)
def view(args: argparse.Namespace) -> int:
    """Write the page of a run again, or a folder with pages for any web server.

    Returns:
        The exit status.

    Raises:
        InputError: several runs were given without a folder.
    """
    folders = [find_run(name) for name in args.runs]
    out = _write_pages(folders, args.bundle)
    return output.print_answer(
        args.json,
        {"command": "view", "runs": list(map(str, folders)), "out": str(out)},
        str(out),
    )


def _write_pages(folders: Sequence[Path], bundle: str | None) -> Path:
    """Write the page of one run into its folder, or those of several into another one.

    Args:
        folders: the runs.
        bundle: the folder for the pages; None for the folder of the only run.

    Returns:
        The file or folder that was written.

    Raises:
        InputError: there are several runs and no folder.
    """
    if bundle is not None:
        return write_bundle(folders, Path(bundle))
    if len(folders) > 1:
        raise InputError(
            "--bundle: pages of several runs go into a folder; name one, "
            "or give one run"
        )
    return write_page(folders[0])
