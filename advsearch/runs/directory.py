"""Create, lock and fill run directories, which contain all files of a run
(docs/runs.md).
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, final

from advsearch.errors import (
    AdvsearchError,
    FileFormatError,
    InputError,
    RunExistsError,
    StorageError,
    UnknownNameError,
)
from advsearch.runs import files, store
from advsearch.runs import summary as summary
from advsearch.runs.trackers import Tracker, check_tracker
from advsearch.settings import CONFIG as CONFIG
from advsearch.settings import HEADER, PythonOnly, format_value, settings
from advsearch.trust.stored_files import open_regular
from advsearch.trust.writing import (
    LOCK,
    PART,
    RunLock,
    check_no_links,
    check_not_moved,
    storage_errors,
    write_bytes,
    write_text,
)
from advsearch.trust.yaml_text import MAX_YAML_BYTES

if TYPE_CHECKING:
    from advsearch.runs.results import Result
    from advsearch.settings import Config

# The folder, in the current directory, of runs that are referred to by name.
HOME = Path("runs")

# Files and folders in the directory of a run.
REPORT = "report.html"
# The rows of a finished sweep as columns of numbers (advsearch/viewer/columns.py).
COLUMNS = "columns.bin"
IMAGES = "images"
SMALL_PICTURES = f"{IMAGES}/rows"  # images of a sweep, in folders of a thousand
PHOTOGRAPHS = f"{IMAGES}/photos"  # photographs of the real object, aligned
ARTIFACTS = "artifacts"
# The attacked object, clean and adversarial, to rotate in a browser.
OBJECT_FILE = f"{ARTIFACTS}/object.glb"
AOV_FOLDER = "aov"  # ground truth of each image of a sweep, by its number
PARTS = "parts"  # the runs of which a study consists

# The note with the objects of a Python session that no file and no command can name, as
# pairs of role and name.
PYTHON_ONLY_NOTE = "only in Python"
# The note with the settings on which the numbers of the run depend.
SETTINGS_NOTE = "settings"

MAX_VALUE_LENGTH = 40  # maximum length of a value in an error

CONTENTS = (
    CONFIG,
    *(f"{store.NAME}{ending}" for ending in ("", "-wal", "-shm", "-journal")),
    summary.NAME,
    REPORT,
    COLUMNS,
    IMAGES,
    ARTIFACTS,
    AOV_FOLDER,
    PARTS,
)
"""Everything that a run writes. `overwrite` removes these, and nothing else."""


@final
class RunDirectory:
    """The directory of a run, which is locked against other processes until `close`.

    Use `create`, `resume` or `open` to make one, and a `with` block to close it. If the
    block of a new run raises an error before there is any result, the directory is
    removed again, so that wrong input leaves nothing behind. If the directory is
    removed or renamed in the meantime, the next write or the end of the block raises a
    StorageError.
    """

    def __init__(self, path: Path, lock: RunLock) -> None:
        self.path = path
        self._lock = lock
        self._is_new = True
        self._tracker: Tracker | None = None
        self.store = store.Store(path / store.NAME)

    @classmethod
    def create(
        cls,
        run: str | Path | None = None,
        *,
        config: Config | None = None,
        overwrite: bool = False,
        default: str = "attack",
    ) -> RunDirectory:
        """Make the directory of a new run, lock it, and write `run.yaml`.

        `advsearch run` repeats a run from that file. With `overwrite`, only a directory
        that advsearch wrote is changed, and only files that advsearch writes are
        removed from it.

        Args:
            run: a name (for a folder in ``runs/``) or a path; None for
                ``runs/<default>-NNN`` with the next free number.
            config: its settings; a run without them cannot be repeated or resumed.
            overwrite: whether the new run may replace another one.
            default: name of a run without a name.

        Raises:
            RunExistsError: there is something already.
        """
        path = _make_numbered_directory(default) if run is None else locate_run(run)
        # Checked before the directory is made. If the folder of a study was moved away
        # while it runs, `mkdir` would make it again.
        check_not_moved(path)
        check_free(path, overwrite=overwrite)
        with storage_errors(path):
            path.mkdir(parents=True, exist_ok=True)
        try:
            return cls._create_in(path, config, overwrite=overwrite)
        except InputError:
            # the directory belongs to another run, and stays
            raise
        except BaseException:
            _remove_if_bare(path)
            raise

    @classmethod
    def _create_in(
        cls, path: Path, config: Config | None, *, overwrite: bool
    ) -> RunDirectory:
        """Begin a run in a directory that exists; after an error nothing of it is left.

        Args:
            path: path of the directory.
            config: configuration of the run, which is written as `run.yaml`; None for
                a run that cannot be repeated.
            overwrite: whether an older run in the directory is removed.

        Raises:
            RunExistsError: another process has begun a run there.
        """
        # releases the lock and closes the store if anything below fails
        with ExitStack() as undo:
            lock = RunLock(path)
            undo.callback(lock.release)
            # once more: a run may have begun there before the lock was held
            check_free(path, overwrite=overwrite)
            with storage_errors(path):
                _clear(path)
            try:
                run_directory = cls._write_start(path, config, lock, undo)
            except BaseException:
                with suppress(OSError):  # the first error is raised in any case
                    _clear(path)
                raise
            undo.pop_all()  # nothing failed: the caller closes it
            return run_directory

    @classmethod
    def _write_start(
        cls, path: Path, config: Config | None, lock: RunLock, undo: ExitStack
    ) -> RunDirectory:
        """Write the first files of a run into its directory, which is locked.

        Args:
            path: path of the directory.
            config: configuration of the run, which is written as `run.yaml`, or None.
            lock: lock of the directory.
            undo: gets what closes the store after an error.
        """
        if config is not None:
            write_text(path / CONFIG, config.make_repeatable().to_yaml())
        run_directory = cls(path, lock)
        undo.callback(run_directory.store.close)
        if config is not None:
            run_directory._note_start(config)
        return run_directory

    @classmethod
    def open(cls, config: Config, resumed: str | Path | None = None) -> RunDirectory:
        """Open the directory of a run, and its tracker if the run has one.

        Args:
            config: configuration of the run.
            resumed: name or path of a run to go on with; None for a new run.
        """
        log: str | None = getattr(config, "log", None)
        check_tracker(log)
        run = cls.create_for(config) if resumed is None else cls.resume(resumed, config)
        if log is not None:
            run._tracker = Tracker(log, run.path, config.get_deciding_settings())
        return run

    @classmethod
    def create_for(cls, config: Config) -> RunDirectory:
        """Make the directory of a new run as its configuration states.

        Without a name in the configuration, the name consists of the object and the
        controls, such as "mug-texture-001".

        Raises:
            RunExistsError: there is something already.
        """
        location, overwrite = config.run_location
        first, *others = config.run_name_words
        return cls.create(
            location,
            config=config,
            overwrite=overwrite,
            default=make_default_name(first, others),
        )

    @classmethod
    def resume(cls, run: str | Path, config: Config | None = None) -> RunDirectory:
        """Open and lock the directory of a run, to go on with it.

        Args:
            run: its name or path.
            config: the configuration, which must be the one that the run began with;
                None if nothing is to be evaluated.

        Raises:
            InputError: another process works on it, or `config` would give other
                numbers than the run began with.
        """
        # A run whose directory this process had open may have been removed or renamed;
        # this error is more helpful than that of `find_run`.
        check_not_moved(locate_run(run))
        path = find_run(run)
        check_links(path)
        # releases the lock and closes the directory if the settings do not fit
        with ExitStack() as undo:
            lock = RunLock(path)
            undo.callback(lock.release)
            run_directory = cls(path, lock)
            undo.callback(run_directory.close)
            run_directory._is_new = False
            if config is not None:
                run_directory._check_settings_unchanged(config)
            undo.pop_all()  # nothing failed: the caller closes it
        return run_directory

    @property
    def restart_advice(self) -> str:
        """What a person can do instead of going on with it."""
        if self.store.read_note(PYTHON_ONLY_NOTE) is not None:
            return "start again where it was asked, in Python"
        return f"start again with advsearch run {self.path / CONFIG}"

    def _note_start(self, config: Config) -> None:
        """Store everything on which the numbers of a new run depend.

        These are its settings, the versions of packages, digests of files, and which
        objects of a Python session it uses. In a new run `check_unchanged` stores its
        values, since there are no earlier ones with which to compare them.
        """
        if config.python_only_parts:
            self.store.write_note(
                PYTHON_ONLY_NOTE, json.dumps(config.python_only_parts)
            )
        versions = summary.collect_versions(_known_settings(config))
        self.check_unchanged(summary.VERSIONS_NOTE, versions)
        # This note is the last one: if it exists, the others were stored, too.
        self.check_unchanged(SETTINGS_NOTE, config.get_deciding_settings())

    def _check_settings_unchanged(self, config: Config) -> None:
        """Check that settings, versions and files are those that the run began with.

        Raises:
            InputError: some are not, so that it would give other numbers.
        """
        has_settings = self.store.read_note(SETTINGS_NOTE) is not None
        if not has_settings:
            self._begin_killed_run(config)
            return
        self.check_unchanged(SETTINGS_NOTE, config.get_deciding_settings())
        # versions of packages, and digests of files that a resumed run reads again
        versions = summary.collect_versions(_select_read_settings(config))
        self.check_unchanged(summary.VERSIONS_NOTE, versions)

    def _begin_killed_run(self, config: Config) -> None:
        """Begin a run that was killed before `_note_start` ended.

        It has no stored settings and no rows.

        Raises:
            FileFormatError: it has rows.
        """
        if self.store.count_rows():
            raise FileFormatError(
                f"{self.store.path}: expected the settings the run began with, got none"
            )
        self._note_start(config)

    def check_unchanged(self, note: str, facts: Mapping[str, Any]) -> None:
        """Check that facts on which the numbers of a run depend have not changed.

        Facts are settings, versions of packages, or digests of files. The first call
        stores them. Later calls compare with the stored ones, and store those that are
        new.

        Args:
            note: name of the note under which they are stored.
            facts: values by name, such as {"torch": "2.13.0"}.

        Raises:
            InputError: a fact differs from the stored one; the run
                can't go on.
        """
        before = self._read_facts(note)
        changed = summary.find_changed_facts(before, facts)
        if changed:
            changes = [_format_change(name, before.get(name)) for name in changed]
            raise InputError(
                f"{self.path}: cannot resume with something else than the run began "
                f"with: {', '.join(changes)}; restore it, or {self.restart_advice}"
            )
        has_new_facts = not facts.keys() <= before.keys()
        if has_new_facts:  # the stored values of known facts stay
            self.store.write_note(note, json.dumps({**facts, **before}))

    def _read_facts(self, note: str) -> dict[str, Any]:
        """Return the facts in a note; empty if there is no such note.

        Raises:
            FileFormatError: the note has something else.
        """
        stored = self.store.read_json_note(note)
        before = {} if stored is None else stored  # None at the first call
        if not isinstance(before, dict):
            type_name = type(before).__name__
            raise FileFormatError(
                f"{self.store.path}: expected what the run began with in the note "
                f"{note!r}, got {type_name}"
            )
        return before

    def check_files_unchanged(self, used_settings: Iterable[Mapping[str, Any]]) -> None:
        """Check that the files that settings name are those with which the run began.

        Versions of packages are checked, too. In a new run all of these are stored, for
        later comparison.

        Args:
            used_settings: settings by name, of each part of the run.

        Raises:
            InputError: a version or a file has changed since the run began.
        """
        facts = dict[str, str]()
        for values in used_settings:
            facts |= summary.collect_versions(values)
        self.check_unchanged(summary.VERSIONS_NOTE, facts)

    def append_rows(
        self, *rows: store.Row, cached: store.CachedEvaluation | None = None
    ) -> None:
        """Add rows to the results, and send them to the tracker if there is one.

        When this returns, the rows survive a kill of the process.

        Args:
            *rows: one row for each evaluated configuration.
            cached: data that a search needs to be resumed and the last row lacks, such
                as the gradient; None if there is nothing.
        """
        self.store.append(rows, cached)
        if self._tracker is not None:
            self._tracker.send_rows(rows)

    @staticmethod
    def find_file_changed_since(run: Path, config: Config) -> str | None:
        """Return the name of a file that has changed since a run was made.

        Args:
            run: directory of the run.
            config: configuration whose settings name the files.

        Returns:
            One such name; None if no file has changed.
        """
        return summary.find_changed_file(
            RunDirectory.read_versions(run), config.to_json()
        )

    @staticmethod
    def read_versions(run: Path) -> dict[str, object]:
        """Return the versions of packages and digests of files that a run has noted.

        They are those with which the run was made.
        """
        with store.Store.open_to_read(run) as results:
            noted = results.read_json_note(summary.VERSIONS_NOTE)
        return noted if isinstance(noted, dict) else {}

    def append_row(self, kind: str, step: int, **columns: Any) -> None:
        """Add one evaluated configuration to the results; `columns` are those of
        `store.Row`.
        """
        self.append_rows(store.Row(kind, step, **columns))

    @staticmethod
    def locate_part(run: Path, name: str) -> Path:
        """Return the folder of a part of a run, whether it exists or not."""
        return run / PARTS / name

    def save_image(self, name: str, image: Any, folder: str = IMAGES) -> Path:
        """Write an image as ``<folder>/<name>.png``, and return its path.

        Args:
            name: name of the file, without its suffix.
            image: (H, W, 3) or (H, W), display-referred sRGB in [0, 1], of numpy or
                torch.
            folder: folder in the run directory.
        """
        return files.write_png(self.path / folder / f"{name}.png", image)

    def save_exr(self, name: str, image: Any, folder: str = IMAGES) -> Path:
        """Write ``<folder>/<name>.exr`` with the values as float32, which are linear by
        convention, and return its path.
        """
        return files.write_exr(self.path / folder / f"{name}.exr", image)

    def save_animation(self, name: str, frames: Sequence[Any]) -> Path:
        """Write ``images/<name>.gif`` of display-referred pictures, at most 3 MB, and
        return its path.
        """
        return write_bytes(
            self.path / IMAGES / f"{name}.gif", files.encode_animation(frames)
        )

    def write_file(self, name: str, data: bytes) -> Path:
        """Write a file of the run, whose name is relative to the run directory, and
        return its path.
        """
        return write_bytes(self.path / name, data)

    def write_summary(self, result: Result) -> Path:
        return summary.write_summary(self.path, result)

    def close(self) -> None:
        """Close the results and give up the lock; a second call does nothing."""
        self._close_tracker()
        self.store.close()
        self._lock.release()

    def _close_tracker(self) -> None:
        if self._tracker is not None:
            self._tracker.close()
            self._tracker = None

    @property
    def is_empty(self) -> bool:
        """Whether nothing would be lost if the directory were removed.

        It then has no result, no part, no row, and no answer of a remote model, which
        may have cost money.
        """
        has_files = any((self.path / name).exists() for name in (summary.NAME, PARTS))
        return (
            not has_files
            and self.store.count_rows() == 0
            and not self.store.has_model_answers
        )

    def discard(self) -> None:
        """Remove what this run wrote, and the directory if that leaves it empty."""
        self._close_tracker()
        with suppress(OSError, StorageError):
            # If the directory was moved, another run may be at its path now.
            check_not_moved(self.path)
            self.store.close()
            _clear(self.path)
            _remove_if_bare(self.path)
        self.close()

    def __enter__(self) -> RunDirectory:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the directory; after an error, remove it if it is new and empty.

        Without an error it is checked first that it was not moved in the meantime.
        """
        if error is None:
            try:
                check_not_moved(self.path)
            finally:
                self.close()
        elif self._is_new and self.is_empty:
            # the block raised before it stored anything
            self.discard()
        else:
            self.close()


def _select_read_settings(config: Config) -> dict[str, Any]:
    """Return the settings of a run, without those of files that it does not read again.

    A run has copied such a file, a recipe say, into its store. Then the file may have
    changed or be missing.
    """
    return {
        name: value
        for name, value in _known_settings(config).items()
        if name not in summary.NOT_READ_AGAIN
    }


@contextmanager
def create_before_work(config: Config) -> Iterator[Path | None]:
    """Make the directory of a new run before its work begins.

    So the run can be resumed however the block ends. If the block raises before
    anything was evaluated, the directory is removed again, with the folders that were
    made for it.

    Args:
        config: configuration of the run.

    Yields:
        The path of the directory, which is not locked: the block resumes the run. None
        if the run overwrites another one. Then nothing is made here, and the old run
        stays until the new one has something to store.
    """
    location, overwrite = config.run_location
    replaces_run = overwrite and location is not None and is_run(locate_run(location))
    if replaces_run:
        yield None
        return
    home = HOME if location is None else locate_run(location).parent
    new_folders = _list_missing_folders(home)
    with RunDirectory.create_for(config) as run:
        path = run.path
    try:
        yield path
    except BaseException:
        _discard_if_empty(path, new_folders)
        raise


def _list_missing_folders(folder: Path) -> list[Path]:
    """Return those of a folder and its parents that do not exist, the innermost first."""
    return [
        parent for parent in (folder, *folder.parents) if not os.path.exists(parent)
    ]


def _discard_if_empty(path: Path, new_folders: Sequence[Path]) -> None:
    """Remove the directory of a run without results, and empty folders around it.

    Args:
        path: path of the directory.
        new_folders: parent folders that were made for it, the innermost first.
    """
    # The directory cannot be opened if it was removed meanwhile, for instance.
    with suppress(AdvsearchError), closing(RunDirectory.resume(path)) as run:
        if run.is_empty:
            run.discard()
    # `rmdir` raises for a folder that is not empty, and so ends the loop
    with suppress(OSError):
        for folder in new_folders:
            folder.rmdir()


def make_default_name(object_name: str, controls: Iterable[str]) -> str:
    """Return the default name of a run, such as ``mug-texture``.

    It has only small letters, digits and hyphens, at most 80 of them.

    Args:
        object_name: name or file of the object, such as ``data/mug.obj``.
        controls: names of the controls, such as ``texture``.
    """
    words = "-".join([Path(object_name).stem, *controls])
    name = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")
    return name[:80] or "attack"  # if no sign is left


def check_links(run: Path) -> None:
    """Check that nothing in a run's folder is a link to a file elsewhere.

    Small pictures, of which there may be a million, are checked when each is read
    (`viewer.thumbnails`).

    Raises:
        FileFormatError: something is a link.
    """
    check_no_links(run, CONTENTS, unchecked_suffix=SMALL_PICTURES)


def locate_run(run: str | Path) -> Path:
    """Return the folder of a run: a name becomes ``runs/NAME``, a path is unchanged."""
    path = Path(run)
    is_name = isinstance(run, str) and os.sep not in run and run not in (".", "..")
    return HOME / path if is_name else path.expanduser()


def format_run_name(path: str | Path) -> str:
    """Return the text by which a user refers to the run in a folder.

    It is the name of the folder if that is in ``runs/``, else its path.
    """
    path = Path(path)
    return path.name if path.parent == HOME else str(path)


def find_run(run: str | Path, *, checked: bool = True) -> Path:
    """Return the directory of an existing run.

    Args:
        run: its name, or the path of its directory or of a file in it such as run.yaml.
        checked: refuse links in it, as is needed before anything in it is read.

    Raises:
        UnknownNameError: there is no such run.
        FileFormatError: it has links in it (`check_links`).
    """
    # If there are a path and a run in runs/ of this name, the path is used.
    for path in (Path(run).expanduser(), locate_run(run)):
        is_file_of_run = path.name in CONTENTS and os.path.isfile(path)
        folder = path.parent if is_file_of_run else path
        if is_run(folder):
            if checked:
                check_links(folder)
            return folder
    known = (path.name for path in HOME.glob("*") if is_run(path))
    raise UnknownNameError(
        "run", str(run), known, "Give a name in runs/ or the path of a run's folder."
    )


def read_python_only(path: Path) -> list[PythonOnly]:
    """Return the parts of a run that were passed as Python objects.

    No file and no command can name them, so that the run cannot be repeated from its
    `run.yaml`. They are noted as pairs of role and name. A pair of another form is left
    out, since another person may have written the file.
    """
    if not (path / store.NAME).is_file():
        return []
    with store.Store(path / store.NAME, read_only=True) as results:
        noted = results.read_json_note(PYTHON_ONLY_NOTE)
    pairs = noted if isinstance(noted, list) else []
    return [
        PythonOnly(str(pair[0]), str(pair[1]))
        for pair in pairs
        if isinstance(pair, list) and len(pair) == 2
    ]


def is_run(path: Path) -> bool:
    """Return whether advsearch wrote a directory.

    It is known by the header of its `results.sqlite`, or of its `run.yaml`.
    """
    if files.is_results_database(path / store.NAME):
        return True
    if os.path.islink(path / CONFIG):
        return False
    try:
        with open_regular(path / CONFIG, "a run.yaml", MAX_YAML_BYTES) as file:
            return file.read(len(HEADER)) == HEADER.encode()
    except (OSError, FileFormatError):
        return False


def check_free(run: str | Path, *, overwrite: bool = False) -> None:
    """Check that a new run may be put somewhere; call it before any long work.

    Args:
        run: name or path of the new run.
        overwrite: whether it may replace another run.

    Raises:
        InputError: it is no possible path.
        RunExistsError: a file is there, a folder that is no run, or, without
            `overwrite`, a run.
    """
    path = locate_run(run)
    _check_possible_folder(path)
    with storage_errors(path):
        is_free = not path.exists() or _has_only_leftovers(path)
    if is_free:
        return
    if not is_run(path):
        raise RunExistsError(
            f"{path}: the folder is not empty and not a run; choose "
            "another name with `run`"
        )
    if not overwrite:
        raise RunExistsError(
            f"{path}: the run exists already; add `overwrite=True` or "
            "choose another name with `run`"
        )


def _has_only_leftovers(folder: Path) -> bool:
    """Return whether a folder has nothing but what a run killed at its start leaves."""
    return all(_is_leftover(entry) for entry in folder.iterdir())


def _check_possible_folder(path: Path) -> None:
    """Check that a path may be that of a folder.

    Raises:
        InputError: it is no possible path.
        RunExistsError: it is a file.
    """
    if "\0" in str(path):
        raise InputError(
            f"expected a name or a folder for the run, got {str(path)!r} "
            "with a zero byte in it"
        )
    if os.path.exists(path) and not path.is_dir():
        raise RunExistsError(
            f"{path}: expected a folder for the run, got a file; "
            "choose another name with `run`"
        )


def _make_numbered_directory(default: str) -> Path:
    """Make and return the first free directory of ``default-001``, ``default-002`` and
    so on.

    Numbers below the largest one are not used again, even if their runs were removed.
    """
    pattern = re.compile(re.escape(default) + r"-(\d{3,})")
    with storage_errors(HOME):
        HOME.mkdir(parents=True, exist_ok=True)
        used_numbers = [
            int(match[1])
            for path in HOME.iterdir()
            if (match := pattern.fullmatch(path.name))
        ]
        return _make_first_free(default, max(used_numbers, default=0) + 1)


def _make_first_free(default: str, first: int) -> Path:
    """Make and return the first free directory of a name with a number, from `first` on.

    Another process may take a number between listing and mkdir: then the next one is
    tried.
    """
    for number in itertools.count(first):
        path = HOME / f"{default}-{number:03d}"
        try:
            path.mkdir()
        except FileExistsError:
            continue
        return path
    raise AssertionError("unreachable: `count` does not end")


def _clear(path: Path) -> None:
    """Remove all that a run writes from a directory, and nothing else."""
    for entry in list(path.iterdir()):
        if entry.name in CONTENTS or entry.name.startswith(PART):
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink()


def _known_settings(config: Config) -> dict[str, Any]:
    """Return the settings that the command has, by name, as JSON values."""
    known = {setting.name for setting in settings(type(config))}
    return {name: value for name, value in config.to_json().items() if name in known}


def _format_change(name: str, value: object) -> str:
    """Return the name of a changed fact, such as "seed (was 0)".

    Args:
        name: name of the fact.
        value: the value that it had. It is left out if it is None or long, as digests
            are.
    """
    text = format_value(value)
    if value is None or len(text) > MAX_VALUE_LENGTH:
        return name
    return f"{name} (was {text})"


def _is_leftover(path: Path) -> bool:
    """Return whether a file is a leftover of a run that was killed as it began.

    It is the lock, or a file that was not written completely.
    """
    return path.name == LOCK or path.name.startswith(PART)


def _remove_if_bare(path: Path) -> None:
    """Remove a directory if it has nothing but leftovers of a killed run."""
    with suppress(OSError):
        if all(_is_leftover(entry) for entry in path.iterdir()):
            for entry in list(path.iterdir()):
                entry.unlink()
            path.rmdir()
