"""What every command prints with: JSON alone on standard output, messages on standard error."""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from advsearch.errors import AdvsearchError

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


def finish(result: Result, answer: Callable[[Any], str], *, as_json: bool) -> int:
    """Print the last word of a command, and return its exit status.

    Args:
        result: what came out.
        answer: makes a text for a person of it.
        as_json: print the result itself instead.
    """
    from advsearch.cli.main import INTERRUPTED, OK

    if as_json:
        print_json(result)
    else:
        print(answer(result) + go_on_text(result))
    stopped = getattr(result, "ending", None) == "interrupted"
    return INTERRUPTED if stopped else OK


def go_on_text(result: Result) -> str:
    """Return how to go on with a run that was stopped; nothing of one that was not, or that is kept nowhere."""
    run = getattr(result, "run", None)
    return f"\n\nGo on with: {go_on_command(run)}" if run and result.goes_on else ""


def go_on_command(run: str | Path) -> str:
    """Return the shell command that goes on with a run, with the Python code that its settings name.

    Args:
        run: its folder.
    """
    from advsearch.runs.directory import CONFIG, typed_name

    words = ["advsearch", "resume", typed_name(run)]
    with suppress(AdvsearchError):
        words += [word for name in _code_in(Path(run) / CONFIG) for word in ("--code", name)]
    return shlex.join(words)


def _code_in(file: Path) -> Sequence[str]:
    """The Python code that a run.yaml names."""
    from advsearch.cli.run import command_in, config_of_file
    from advsearch.config import SceneConfig
    from advsearch.settings import split_names

    config = config_of_file(command_in(file), file, {})
    if not isinstance(config, SceneConfig):
        return ()
    metrics = getattr(config, "metrics", {}).values()
    if ":" not in "".join([config.model, *config.kinds_of_controls, *metrics]):
        return ()
    from advsearch.engine.naming import code_of  # takes seconds

    return code_of(split_names(config.model), config.kinds_of_controls, metrics)


@contextmanager
def output_kept_clean() -> Iterator[None]:
    """Send whatever is printed inside the block to standard error, be it by Python or by a native library.

    So one JSON value, printed afterwards, is all that standard output holds.
    """
    sys.stdout.flush()
    with redirect_stdout(sys.stderr), _descriptor_redirected(1, 2):
        yield


def shown_text(result: Result) -> str:
    """Return what is shown of an answer as text: what it says, its parts, by what it came about, and notes."""
    from advsearch.report.shown import facts_of, remarks_of, shown
    from advsearch.runs.directory import REPORT

    given, run = shown(result), getattr(result, "run", None)
    parts = [given.said]
    for one in given.sections:
        if one.only not in ("", "text") or one.empty:
            continue
        table = aligned([one.heads, *one.rows] if one.heads else one.rows)
        pictures = [[picture.file, picture.caption] for group in one.pictures for picture in group]
        inside = [*one.text, "\n".join(filter(None, [table, aligned(pictures)]))]
        parts.append("\n".join(filter(None, [one.title, "\n\n".join(filter(None, inside))])))
    facts = [[name.lower(), text] for name, text in facts_of(result, given).items()]
    parts.append(aligned([*facts, *([["page", f"{run}/{REPORT}"]] if run else [])]))
    return "\n\n".join(filter(None, parts)) + as_notes(remarks_of(result, given))


def aligned(rows: Sequence[Sequence[str]], indent: str = "  ", gap: str = "   ") -> str:
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
        # write out what the C library holds back, before its descriptor changes
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).fflush(None)
        os.dup2(kept, source)
        os.close(kept)


def as_notes(texts: Sequence[str]) -> str:
    """Return notes below an answer, each a paragraph, with the flags of the settings that they name."""
    from advsearch.cli.flags import with_flags  # settings, which `--help` does without

    return "".join(f"\n\nNote: {with_flags(text)}" for text in texts)
