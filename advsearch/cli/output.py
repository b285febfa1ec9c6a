"""Print results, messages and progress.

Results go to standard output; with ``--json`` it contains nothing but JSON. Messages
and progress go to standard error: progress bars on a terminal, otherwise a line from
time to time.

Names of files, labels, objects and runs may come from other people. Control characters
in them could control the terminal or imitate a line of output, so this module prints
them as readable escapes. It also turns a full disk behind standard output into a
message.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import (
    AbstractContextManager,
    contextmanager,
    nullcontext,
    redirect_stdout,
    suppress,
)
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TextIO, cast

from advsearch.errors import AdvsearchError, StorageError
from advsearch.interrupts import INTERRUPTS
from advsearch.progress import Progress, escape_text, open_progress

if TYPE_CHECKING:
    from advsearch.report.views import ResultPart, ShownResult
    from advsearch.runs.results import Result


OK = 0
BAD_INPUT = 2
INTERRUPTED = 130
"""Exit statuses: the command did its work, got wrong input, or was interrupted."""

# Maximum length of a name in a message. Of a longer one only both ends are printed.
MAX_WORD_LENGTH = 300


def shorten_words(text: str) -> str:
    """Return a message with the middle of its overlong words left out."""
    return " ".join(
        word
        if len(word) <= MAX_WORD_LENGTH
        else f"{word[:100]}...{word[-40:]} ({len(word):,} characters)"
        for word in text.split(" ")
    )


class Screen:
    """A text stream that writes to another stream, with escapes for control characters.

    Text goes through `escape_text`. Other attributes are those of the other stream. If
    writing fails, an error is raised if `raises_errors` is set; otherwise the text is
    dropped.
    """

    def __init__(self, stream: TextIO, *, raises_errors: bool) -> None:
        self.stream = stream
        self._raises_errors = raises_errors

    def write(self, text: str) -> int:
        with output_errors() if self._raises_errors else suppress(OSError):
            self.stream.write(escape_text(text, self.stream.encoding or "utf-8"))
        return len(text)

    def flush(self) -> None:
        with output_errors() if self._raises_errors else suppress(OSError):
            self.stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextmanager
def output_errors() -> Iterator[None]:
    """Turn errors of standard output inside the block into errors with a message.

    Raises:
        BrokenPipeError: the reader has closed the output, which is no failure.
        StorageError: it cannot be written for another reason.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise StorageError(
            f"cannot write to standard output: {error.strerror or error}"
        ) from None


@contextmanager
def escape_output() -> Iterator[None]:
    """Escape control characters in all output that is printed inside of the block."""
    stdout = sys.stdout
    stderr = sys.stderr
    sys.stdout = _screen(stdout, raises_errors=True)
    # a command does its work even where its messages cannot be written
    sys.stderr = _screen(stderr, raises_errors=False)
    try:
        yield
    finally:
        sys.stdout = stdout
        sys.stderr = stderr


def get_raw_stream(stream: IO[str]) -> IO[str]:
    """Return the stream behind a `Screen`, for code that draws on a terminal, and that
    escapes names itself.
    """
    return stream.stream if isinstance(stream, Screen) else stream


def open_descriptors() -> None:
    """Open standard streams that are closed, so that they lead to nothing.

    Otherwise the next file that is opened would get the descriptor of one of them, and
    `print` would write to it.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free


def end_output() -> None:
    """Write out what standard output has buffered; drop it if that fails.

    The interpreter writes the buffer when it ends, and would print an error if that
    failed. So the output is redirected to nothing after a failure here.
    """
    try:
        sys.stdout.flush()
    except (OSError, ValueError, StorageError):
        with suppress(OSError, ValueError, AttributeError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _screen(stream: Any, *, raises_errors: bool) -> TextIO:
    """Return a `Screen` that writes to a stream; the stream itself if it is one.

    Without a stream, everything is dropped. Python has none if its descriptor was
    closed.
    """
    if isinstance(stream, Screen):
        return cast(TextIO, stream)
    if stream is None:
        stream = open(os.devnull, "w", encoding="utf-8")
    return cast(TextIO, Screen(stream, raises_errors=raises_errors))


def add_json_flag(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    parser.add_argument(
        "--json", action="store_true", help="print one JSON value on standard output"
    )


def add_code_flag(parser: argparse.ArgumentParser) -> None:
    """Add ``--code``, for commands that follow the settings of a file."""
    text = (
        "Python code that a file or a run names and that may be imported, as it "
        "stands there; may be repeated"
    )
    parser.add_argument(
        "--code", action="append", default=[], metavar="MODULE:NAME", help=text
    )


def add_quiet_flags(parser: argparse.ArgumentParser) -> None:
    """Add ``--json`` and ``--quiet``, for commands that take long."""
    add_json_flag(parser)  # --json
    parser.add_argument(
        "--quiet",
        action="store_true",
        help="no progress and no messages on standard error",
    )


def print_answer(
    as_json: bool,
    json_fields: Mapping[str, object],
    text: str,
    stream: IO[str] | None = None,
) -> int:
    """Print the answer of a command, and return the exit status of success.

    Args:
        as_json: print `json_fields` as JSON on standard output; otherwise the text.
        json_fields: the answer for programs.
        text: the answer for people.
        stream: stream for the text; None is standard output.
    """
    if as_json:
        print_json({"schema": 1, **json_fields})
    else:
        print(text, file=stream)
    return OK


def print_json(value: Any) -> None:
    """Print `value` as JSON on standard output; NaN and infinity become null."""
    # late, so that --help answers at once
    from advsearch.runs.results import to_json_value

    text = json.dumps(
        to_json_value(value), indent=2, allow_nan=False, ensure_ascii=False
    )
    # `ensure_ascii=False` above leaves letters of other languages readable, but also
    # characters that are not printable. These become escapes such as \u200b: without
    # the option, `json.dumps` escapes them; [1:-1] removes its quotes.
    text = "".join(
        sign if sign.isprintable() or sign == "\n" else json.dumps(sign)[1:-1]
        for sign in text
    )
    # DEL is the only such character that `json.dumps` does not escape.
    print(text.replace("\x7f", "\\u007f"))


def print_result(result: Result, *, as_json: bool) -> int:
    """Print a result, as JSON or as text for a person, and return the exit status."""
    if as_json:
        print_json(result)
    else:
        print(format_result(result) + explain_resume(result))
    was_interrupted = getattr(result, "ending", None) == "interrupted"
    return INTERRUPTED if was_interrupted else OK


def explain_resume(result: Result) -> str:
    """Return how to go on with a run that was stopped, as the last paragraph of a text.

    Empty for a run that ended, that another process still works on, or that has no
    folder.
    """
    run: Any = getattr(result, "run", None)
    if not run or not result.is_unfinished:
        return ""
    if getattr(result, "ending", None) == "running":
        return ""
    return f"\n\nGo on with: {make_resume_command(run)}"


def make_resume_command(run: str | Path) -> str:
    """Return the shell command that continues the run in a folder.

    If the settings of the run name Python code, the command allows it with `--code`.

    Args:
        run: the run directory.
    """
    # late, so that --help answers at once
    from advsearch.runs.directory import CONFIG, format_run_name

    words = ["advsearch", "resume", format_run_name(run)]
    # If the file cannot be read, the printed command reports it when it is run.
    with suppress(AdvsearchError):
        for name in _list_code_in_file(Path(run) / CONFIG):
            words += ["--code", name]
    return shlex.join(words)


def _list_code_in_file(file: Path) -> Sequence[str]:
    """Return the Python code that a file of settings names, as "module:name"."""
    # late, so that --help answers at once
    from advsearch.cli.flags import read_command, read_file_config
    from advsearch.config import SceneConfig
    from advsearch.settings import split_names

    config = read_file_config(read_command(file), file, {})
    if not isinstance(config, SceneConfig):
        return ()
    metrics = getattr(config, "metrics", {}).values()
    all_names = "".join([config.model, *config.control_kinds, *metrics])
    # Listing the code exactly takes seconds, so that is done only if there is a colon
    # in any name.
    if ":" not in all_names:
        return ()
    from advsearch.engine.naming import list_imported_code  # takes seconds

    return list_imported_code(split_names(config.model), config.control_kinds, metrics)


@contextmanager
def redirect_output() -> Iterator[None]:
    """Inside the block, send everything that is printed to standard error.

    This includes what native libraries print. A JSON value that is printed after the
    block is then the only text on standard output.
    """
    sys.stdout.flush()
    stdout_descriptor: int | None = None
    with suppress(OSError):  # a descriptor may be closed
        stdout_descriptor = os.dup(1)
        # native libraries write to descriptor 1
        os.dup2(2, 1)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        if stdout_descriptor is not None:
            _restore_stdout(stdout_descriptor)


def _restore_stdout(stdout_descriptor: int) -> None:
    """Make descriptor 1 standard output again, of which there is a copy to close."""
    # The C library buffers what native code prints: write that out before descriptor 1
    # is standard output again.
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).fflush(None)
    os.dup2(stdout_descriptor, 1)
    os.close(stdout_descriptor)


def format_result(result: Result) -> str:
    """Return a result as text for a person.

    Its paragraphs are its statement, its parts, how it was made, and notes.
    """
    # late, so that --help answers at once
    from advsearch.cli.flags import format_as_flags
    from advsearch.report.views import get_view, list_remarks

    view = get_view(result)
    paragraphs = [view.statement]
    for part in view.sections:
        if part.is_visible_in("text"):
            paragraphs.append(_format_part(part))
    paragraphs.append(_format_facts(result, view))
    notes = [f"Note: {format_as_flags(text)}" for text in list_remarks(result, view)]
    return _join_nonempty("\n\n", [*paragraphs, *notes])


def _format_facts(result: Result, view: ShownResult) -> str:
    """Return the facts of a result, and the path of its page, as a table."""
    # late, so that --help answers at once
    from advsearch.report.views import collect_facts
    from advsearch.runs.directory import REPORT

    facts = [[name.lower(), text] for name, text in collect_facts(result, view).items()]
    run = getattr(result, "run", None)
    if run:
        facts.append(["page", f"{run}/{REPORT}"])
    return align_columns(facts)


def _format_part(part: ResultPart) -> str:
    """Return a part of a result as text: its title, paragraphs, table and pictures."""
    # late, so that --help answers at once
    from advsearch.cli.flags import format_as_flags

    rows = list(part.rows)
    if part.column_heads:
        rows.insert(0, part.column_heads)
    table = align_columns(rows)
    picture_rows = [
        [picture.file, picture.caption] for group in part.pictures for picture in group
    ]
    tables = _join_nonempty("\n", [table, align_columns(picture_rows)])
    body = _join_nonempty("\n\n", [*map(format_as_flags, part.text), tables])
    return _join_nonempty("\n", [part.title, body])


def _join_nonempty(separator: str, texts: Iterable[str]) -> str:
    """Join texts, without those that are empty."""
    return separator.join(filter(None, texts))


def align_columns(rows: Sequence[Sequence[str]]) -> str:
    """Return lines with the cells of `rows` in aligned columns.

    Rows may have fewer cells than others.
    """
    n_columns = max(map(len, rows), default=0)
    widths = [
        max(len(row[column]) for row in rows if column < len(row))
        for column in range(n_columns)
    ]
    lines = []
    for row in rows:
        # not strict: a row may have fewer cells than there are columns
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=False)]
        lines.append(f"  {'   '.join(cells)}".rstrip())
    return "\n".join(lines)


@contextmanager
def open_command_progress(*, as_json: bool, quiet: bool) -> Iterator[Progress]:
    """Show the progress of a command inside the block, and let an interrupt end it.

    Args:
        as_json: JSON is printed afterwards, so everything else is kept off standard
            output.
        quiet: show nothing.
    """
    # late, so that --help answers at once
    from advsearch.cli.flags import format_as_flags

    with (
        redirect_output() if as_json else nullcontext(),
        open_progress(not quiet, format_as_flags) as watcher,
    ):
        progress = InterruptCheckingProgress(watcher)
        progress.stage("starting: loading PyTorch and Mitsuba")
        yield progress
        # raises KeyboardInterrupt if some code has swallowed one
        INTERRUPTS.raise_pending()


def open_answer_progress() -> AbstractContextManager[Progress]:
    """Show progress inside the block, for a command that prints its answer after it.

    Nothing else reaches standard output, whether the answer is text or JSON.
    """
    return open_command_progress(as_json=True, quiet=False)


class InterruptCheckingProgress:
    """A display of progress that also raises interrupts again that were lost.

    All calls are passed on to another display. Modules that are being imported,
    destructors and native code may swallow an interrupt, or turn it into another error.
    It is raised again at the next stage or step.
    """

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def stage(
        self,
        name: str,
        total: int | None = None,
        *,
        hint: str = "",
        at_most: bool = False,
    ) -> None:
        """See `Progress.stage`.

        Raises:
            KeyboardInterrupt: there was an interrupt that was not handled.
        """
        INTERRUPTS.raise_pending()
        self._progress.stage(name, total, hint=hint, at_most=at_most)

    def advance(self, n: int = 1, **info: float | str) -> None:
        """See `Progress.advance`; raises as `stage` does."""
        self._progress.advance(n, **info)
        INTERRUPTS.raise_pending()

    def message(self, text: str) -> None:
        self._progress.message(text)
