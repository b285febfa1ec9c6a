"""What every command prints with: JSON alone on standard output, messages on standard error."""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from advsearch.runs.results.base import Result


def add_flags(parser: argparse.ArgumentParser, *, quiet: bool = False) -> None:
    """Add ``--json`` and, for commands that take their time, ``--quiet``."""
    parser.add_argument("--json", action="store_true", help="print one JSON value on standard output")
    if quiet:
        parser.add_argument("--quiet", action="store_true", help="no progress and no messages on standard error")


def add_code_flag(parser: argparse.ArgumentParser) -> None:
    """Add ``--code``, for commands that carry out the settings of a file."""
    parser.add_argument(
        "--code",
        action="append",
        default=[],
        metavar="MODULE:NAME",
        help="Python code that the file names and that may be imported, as it stands there; may be repeated",
    )


def print_json(value: Any) -> None:
    """Print `value` as JSON on standard output; NaN and infinity become null."""
    from advsearch.runs.results.base import plain

    text = json.dumps(plain(value), indent=2, allow_nan=False, ensure_ascii=False)
    print("".join(sign if sign.isprintable() or sign == "\n" else _json_escape(sign) for sign in text))


def _json_escape(sign: str) -> str:
    """What a terminal would not show, as JSON escapes it."""
    return "\\u007f" if sign == "\x7f" else json.dumps(sign)[1:-1]


def finish(summary: Result | Mapping[str, Any], answer: Callable[[Any], str], *, as_json: bool) -> int:
    """Print the last word of a command, and return its exit status.

    Args:
        summary: what came out; its `ending` says whether it was interrupted.
        answer: makes a text for a person of it.
        as_json: print the summary itself instead.
    """
    from advsearch.cli.main import INTERRUPTED, OK

    if as_json:
        print_json(summary)
    else:
        print(answer(summary) + go_on_text(summary))
    ending = summary.get("ending") if isinstance(summary, Mapping) else getattr(summary, "ending", None)
    return INTERRUPTED if ending == "interrupted" else OK


def go_on_text(summary: Result | Mapping[str, Any]) -> str:
    """Return how to go on with a run that was stopped; nothing of one that was not, or that is kept nowhere."""
    from advsearch.runs.directory import shown
    from advsearch.runs.summary import goes_on

    if not isinstance(summary, Mapping):
        run = getattr(summary, "run", None)
        return f"\n\nGo on with: advsearch resume {shown(run)}" if summary.goes_on and run else ""
    return (
        f"\n\nGo on with: advsearch resume {shown(summary['run'])}" if goes_on(summary) and summary.get("run") else ""
    )


@contextmanager
def output_kept_clean() -> Iterator[None]:
    """Send whatever is printed inside the block to standard error, be it by Python or by a native library.

    So one JSON value, printed afterwards, is all that standard output holds.
    """
    sys.stdout.flush()
    with redirect_stdout(sys.stderr), _descriptor_redirected(1, 2):
        yield


def columns(rows: Sequence[Sequence[str]], indent: str = "  ", gap: str = "   ") -> str:
    """Return lines with the cells of `rows` in aligned columns."""
    wide = [max(len(row[i]) for row in rows if i < len(row)) for i in range(max(map(len, rows), default=0))]
    return "\n".join(
        (indent + gap.join(cell.ljust(width) for cell, width in zip(row, wide, strict=False))).rstrip() for row in rows
    )


@contextmanager
def _descriptor_redirected(source: int, target: int) -> Iterator[None]:
    """Let file descriptor `source` stand for `target` inside the block; do nothing where one of them is closed."""
    try:
        kept = os.dup(source)
        os.dup2(target, source)
    except OSError:
        yield
        return
    try:
        yield
    finally:
        _flush_c()
        os.dup2(kept, source)
        os.close(kept)


def _flush_c() -> None:
    """Write out what the C library holds back, before its descriptor changes."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).fflush(None)
