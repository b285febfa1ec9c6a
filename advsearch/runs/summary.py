"""Read and write the result of a run, and find out what it depends on.

The result is in `summary.json` (docs/results.md). `artifacts/adversarial.npy` has the
adversarial configuration, with which it can be rendered again. A run depends on the
versions of packages, and on the files that its settings name, of which digests are
computed.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import platform
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from heapq import nsmallest
from importlib import metadata
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from advsearch.config import DEFAULT_ENVIRONMENT
from advsearch.errors import FileFormatError
from advsearch.files import JsonObject, split_paths
from advsearch.runs.results import RUNNING, SCHEMA, Result, find_result_type
from advsearch.settings.configuration import FILES
from advsearch.trust.stored_files import (
    list_opened_files,
    parse_json,
    read_bytes,
    read_text,
)
from advsearch.trust.writing import is_held, write_bytes, write_text

NAME = "summary.json"
MAX_SUMMARY_BYTES = 64 << 20


def to_json(result: Result) -> str:
    return json.dumps(result.to_dict(), indent=2, allow_nan=False, ensure_ascii=False)


def write_summary(folder: Path, result: Result) -> Path:
    """Write ``summary.json`` into the run directory, whole or not at all, and return
    its path.
    """
    return write_text(folder / NAME, to_json(result) + "\n")


def read_result(folder: Path) -> Result:
    """Return the result of the run in `folder`.

    Its ending is `RUNNING` if it is not finished and a process works on the run.

    Raises:
        FileFormatError: there is none, or its contents are not those of this version.
    """
    result = read_stored_result(folder)
    is_running = result.is_unfinished and is_held(folder)
    return result.model_copy(update={"ending": RUNNING}) if is_running else result


def read_stored_result(folder: Path) -> Result:
    """Return the result of the run in a folder as its `summary.json` states it.

    The status in it (`ending`) is that of the file. It is not replaced by `RUNNING` if
    a process works on the run; `read_result` does that.

    Raises:
        FileFormatError: there is no such file, or its contents are not those that this
            version writes.
    """
    path = folder / NAME
    values = _read_summary_values(path)
    result_type = find_result_type(values)  # the class of the experiment's result
    if result_type is None:
        command = str(values.get("command"))[:MAX_TEXT_IN_ERROR]
        raise make_summary_error(path, f"one of the command {command!r}")
    try:
        return result_type.from_values(values)
    except ValidationError as error:
        reason = _describe_first_error(error)
        got = (
            f"one with a part that is missing or of another type ({reason}); run it "
            "again"
        )
        raise make_summary_error(path, got) from None


def _read_summary_values(path: Path) -> JsonObject:
    """Return the JSON object in a `summary.json` of this version.

    Raises:
        FileFormatError: there is no such file, or it has something else.
    """
    try:
        text = read_text(path, "the summary of a run", MAX_SUMMARY_BYTES)
        values = parse_json(text, finite=True)
    except FileNotFoundError:
        # the summary is the last file of a run
        raise make_summary_error(path, "no such file; did the run end?") from None
    except (OSError, ValueError) as error:
        raise make_summary_error(path, str(error)) from None
    if not isinstance(values, dict):
        raise make_summary_error(path, type(values).__name__)
    _check_schema(path, values)
    return values


MAX_TEXT_IN_ERROR = 40  # characters of a text of a summary in an error


def _check_schema(path: Path, values: JsonObject) -> None:
    """Raise an error if a summary, the file `path`, has the schema of another version."""
    if values.get("schema", SCHEMA) != SCHEMA:
        schema = str(values["schema"])[:MAX_TEXT_IN_ERROR]
        raise make_summary_error(
            path,
            f"schema {schema} of another version (this one writes "
            f"{SCHEMA}); run it again",
        )


def _describe_first_error(error: ValidationError) -> str:
    """Return the first error of a validation, without values, which may be long."""
    first = error.errors(include_url=False, include_input=False)[0]
    field_name = ".".join(map(str, first["loc"]))
    return f"{field_name}: {first['msg']}"[:120]


def make_summary_error(path: Path, got: str) -> FileFormatError:
    return FileFormatError(f"{path}: expected the summary of a run, got {got}")


CONFIGURATION = "adversarial.npy"
FOLDER = "artifacts"
MAX_CONFIGURATION_BYTES = 1 << 30
MAGIC = b"\x93NUMPY\x01\x00"  # first bytes of a file of numpy, version 1.0
MAX_HEADER_BYTES = 1 << 10  # maximum size of the header after these bytes
HEADER = re.compile(
    re.escape(MAGIC)
    + rb"..\{'descr': '<f4', 'fortran_order': False, 'shape': \((\d{1,12}),\), \} *\n",
    re.DOTALL,
)
"""The header before the numbers. The reader of numpy is not used: it allocates memory
for any shape that the header states, and parses the header as Python code, which may
raise errors of any kind.
"""


def write_configuration(run: Path, u: NDArray[np.float32]) -> Path:
    """Write the adversarial configuration of a run atomically, and return its path.

    Args:
        run: directory of the run.
        u: (d,) the configuration, in [0, 1].
    """
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(u, dtype=np.float32), allow_pickle=False)
    return write_bytes(run / FOLDER / CONFIGURATION, buffer.getvalue())


def read_configuration(run: Path) -> NDArray[np.float32]:
    """Return the adversarial configuration (d,) that a run found, float32 in [0, 1].

    Raises:
        FileFormatError: there is none, or the file holds something else.
    """
    path = run / FOLDER / CONFIGURATION
    u = _parse_array(_read_array_file(path))
    if u is None or not bool(((u >= 0.0) & (u <= 1.0)).all()):
        raise FileFormatError(
            f"{path}: expected numbers (d,) float32 in [0, 1], got something else"
        )
    return u


def _read_array_file(path: Path) -> bytes:
    """Return the content of the file of an adversarial configuration.

    Raises:
        FileFormatError: there is none, or it does not begin as a .npy file does.
    """
    expected = f"{path}: expected the adversarial configuration of a run, got"
    try:
        data = read_bytes(
            path, "the adversarial configuration of a run", MAX_CONFIGURATION_BYTES
        )
    except FileNotFoundError:
        raise FileFormatError(f"{expected} no such file; did the run end?") from None
    except OSError as error:
        raise FileFormatError(f"{expected} {str(error)[:120]}") from None
    # The header ends with a newline. Without one the file is truncated.
    has_header_end = b"\n" in data[: len(MAGIC) + MAX_HEADER_BYTES]
    if not data.startswith(MAGIC) or not has_header_end:
        raise FileFormatError(f"{expected} something else, or the beginning of one")
    return data


def _parse_array(data: bytes) -> NDArray[np.float32] | None:
    """Return the numbers (d,) in the content of a .npy file.

    None unless the content is a `HEADER` with the count d, followed by four bytes for
    each number.
    """
    header = HEADER.match(data)
    if header is None:
        return None
    count = int(header[1])
    if len(data) != header.end() + 4 * count:
        return None
    numbers: NDArray[np.float32] = np.frombuffer(
        data, np.float32, count=count, offset=header.end()
    ).copy()  # frombuffer is read-only
    return numbers


VERSIONS_NOTE = "made with"  # the note with versions and digests of files
MAX_FILES = 20_000  # maximum number of files of a folder that are in its digest
FOLDERS = {"task": "*/*", "model": "*"}
"""Settings that may name a folder, with a pattern of the files in it on which the run
depends: the reference pictures of a task, or the files of a model `hf:FOLDER`.
"""

PACKAGES = ("advsearch", "mitsuba", "drjit", "torch", "numpy")

NOT_READ_AGAIN = ("recipe", "suite")
"""Settings whose file is copied into the store of the run. A resumed run reads the
copy, even if the file has changed.
"""


def collect_versions(settings: Mapping[str, object]) -> dict[str, str]:
    """Return facts on which the numbers of a run depend, apart from its settings.

    These are the versions of Python and of packages by name, and the SHA-256 of each
    file and each bundled object, environment or model that the settings name.
    """
    facts = {"python": platform.python_version()}
    for name in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            facts[name] = metadata.version(name)
    return {
        **facts,
        **compute_bundled_digests(settings),
        **compute_file_digests(settings),
    }


BUNDLED = {"objects": "object", "environments": "environment"}
"""Folders of `advsearch.bundled`, with the kind of their entries."""
NAMES_BUNDLED = (
    "object",
    "environment",
    "things",
    "held_out",
    "held_out_environment",
    "grid",
    "controls",
    "over",
    "set",
)
"""Settings that may name bundled objects and environments."""


def compute_bundled_digests(settings: Mapping[str, object]) -> dict[str, str]:
    """Return the SHA-256 of each bundled thing that settings name.

    Bundled things are objects, environments and the reference model. They may change
    with a new version of advsearch. The digest of a folder is that of a list of its
    files with their digests.

    Args:
        settings: settings by name.

    Returns:
        Digests by name, such as "bundled object mug".
    """
    package = Path(__file__).parent.parent
    names = _list_object_and_environment_names(settings)
    digests = dict[str, str]()
    for folder, kind in BUNDLED.items():
        for entry in sorted((package / "bundled" / "data" / folder).iterdir()):
            if entry.stem in names:
                files = sorted(entry.iterdir()) if entry.is_dir() else [entry]
                digests[f"bundled {kind} {entry.stem}"] = _digest_listing(files)
    weights = package / "models" / "data" / "reference.safetensors"
    if "reference" in _find_bundled_names(settings.get("model")) and weights.is_file():
        digests["bundled model reference"] = _digest_file(weights)
    return digests


def _list_object_and_environment_names(settings: Mapping[str, object]) -> set[str]:
    """Return the words in settings that may name bundled objects and environments.

    There may be other words among them, since they are not compared with known names.
    """
    names = {
        name
        for setting in NAMES_BUNDLED
        for name in _find_bundled_names(settings.get(setting))
    }
    # The setting exists and is None: then the scene has the default environment.
    uses_default_environment = "environment" in settings and not settings["environment"]
    if settings.get("object") and uses_default_environment:
        names.add(DEFAULT_ENVIRONMENT)
    return names


def _digest_listing(paths: Iterable[Path]) -> str:
    """Return the SHA-256 of a list of the files among paths, with their digests."""
    listing = "".join(
        f"{path.name} {_digest_file(path)}\n" for path in paths if path.is_file()
    )
    return hashlib.sha256(listing.encode()).hexdigest()


def _find_bundled_names(value: object) -> set[str]:
    """Return the words of a setting that may be names of something bundled.

    In ``mug,car@12,3.5; person@6,-2`` these are mug, car and person; numbers and paths
    are among the words, but nothing bundled is called so. Lists and mappings are
    searched for texts.
    """
    if isinstance(value, Mapping):
        return {name for inner in value.values() for name in _find_bundled_names(inner)}
    if isinstance(value, (list, tuple)):
        return {name for inner in value for name in _find_bundled_names(inner)}
    words = re.split(r"[,;+]", value) if isinstance(value, str) else []
    return {word.partition("@")[0].strip() for word in words}


def find_changed_facts(
    before: Mapping[str, object], now: Mapping[str, object]
) -> list[str]:
    """Return the names of facts that have another value now than before.

    A fact that is only known now counts as unchanged. Files are compared by the last
    part of their path, since they may have been moved. If several files had the same
    name, it is enough that one of them has the same digest.

    Args:
        before: values by name when the run began. A name may be the path of a file.
        now: values by name now.
    """
    values_before: dict[str, list[object]] = {}
    for path, value in before.items():
        values_before.setdefault(Path(path).name, []).append(value)
    changed = []
    for path, value in now.items():
        name = Path(path).name
        if name in values_before and value not in values_before[name]:
            changed.append(name)
    return changed


def find_changed_file(
    before: Mapping[str, object], settings: Mapping[str, object]
) -> str | None:
    """Return the name of a file that has changed since a run began; None if none has.

    Args:
        before: digests by path when the run began.
        settings: settings by name, which name the files.
    """
    settings_read_again = {
        name: value for name, value in settings.items() if name not in NOT_READ_AGAIN
    }
    digests_now = compute_file_digests(settings_read_again)
    changed_names = find_changed_facts(before, digests_now)
    return changed_names[0] if changed_names else None


def compute_file_digests(settings: Mapping[str, object]) -> dict[str, str]:
    """Return the SHA-256 of each file that settings name, in hexadecimal, by its path.

    Files that were read for such a file have digests of their own, as the materials and
    pictures that a mesh names. A folder has one digest for all its files. Bundled
    things and missing files have none.

    Args:
        settings: settings by name.
    """
    digests: dict[str, str] = {}
    for name, value in settings.items():
        for path in _find_paths(value):
            with suppress(OSError, ValueError):
                # The path may lead to several files. Their digests are added one by
                # one, so that those before a file that cannot be read remain.
                for file_name, digest in _iterate_digests(name, path):
                    digests[file_name] = digest
    return digests


def _iterate_digests(setting: str, path: str) -> Iterator[tuple[str, str]]:
    """Yield path and digest of each file on which a run depends by a path in a setting.

    The path may be a folder, which has a single digest, or a file. In addition, files
    are yielded that this process has read for that file, such as the materials of a
    mesh.

    Args:
        setting: name of the setting. Only some may name a folder (`FOLDERS`) or a file
            (`FILES`).
        path: the path, a part of the setting's value.

    Raises:
        OSError: a file cannot be read.
        ValueError: it is no possible path.
    """
    absolute_path = os.path.abspath(path)
    # The file itself and those read for it; empty if this process has not read it.
    opened_files = list_opened_files(absolute_path)

    folder = _find_folder(path)
    if folder and setting in FOLDERS and Path(folder).is_dir():
        file_pattern = FOLDERS[setting]
        yield folder, _digest_folder(Path(folder), file_pattern)

    # If this process has read the path, it is a file, whatever the setting.
    may_be_file = bool(opened_files) or setting in FILES
    if may_be_file and Path(path).is_file():
        yield path, _digest_file(Path(path))

    for opened_file in opened_files:
        if opened_file != absolute_path and Path(opened_file).is_file():
            file_name = _name_as_path(opened_file, path)
            yield file_name, _digest_file(Path(opened_file))


def _name_as_path(file: str, path: str) -> str:
    """Return the path of a file, relative to the current directory if another path is.

    Args:
        file: absolute path of the file.
        path: the other path, relative or absolute.
    """
    folder = os.path.dirname(os.path.abspath(path))
    return os.path.join(os.path.dirname(path), os.path.relpath(file, folder))


def _find_folder(path: str) -> str:
    """Return the folder that a path may be; empty if it cannot be one.

    Only an absolute path counts as a folder, and the folder of a model hf:FOLDER.
    """
    if os.path.isabs(path):
        return path
    return path.removeprefix("hf:") if path.startswith("hf:") else ""


def _digest_folder(folder: Path, pattern: str) -> str:
    """Return one SHA-256 of the names and contents of files in a folder.

    Args:
        folder: the folder.
        pattern: pattern of the paths of its files that count, such as "*/*". Only the
            first `MAX_FILES` by name count.
    """
    paths = nsmallest(MAX_FILES, folder.glob(pattern))
    # Joined without separator: all digests have the same length.
    lines = [
        f"{path.relative_to(folder).as_posix()}\n{_digest_file(path)}"
        for path in paths
        if path.is_file()
    ]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _find_paths(value: object) -> Iterator[str]:
    """Yield the texts in a setting that may be paths of files.

    Names are separated by commas. Some name a file in a part of the text:
    ``reference@weights.safetensors``, ``scene.glb#NODE`` and
    ``camera.csv+object.csv``. Then the parts are yielded, and the full text too, since
    a path may have these signs in it. Lists and mappings are searched for texts.
    """
    if isinstance(value, Mapping):
        for inner in value.values():
            yield from _find_paths(inner)
    elif isinstance(value, (list, tuple)):
        for inner in value:
            yield from _find_paths(inner)
    elif isinstance(value, str):
        for name in value.split(","):
            yield from _split_paths_in_name(name)


def _split_paths_in_name(name: str) -> list[str]:
    """Return a name and its parts that may be paths, each of them once."""
    parts = (
        name,
        name.rpartition("@")[2],
        name.partition("#")[0],
        *split_paths(name),
    )
    return list(dict.fromkeys(part.strip() for part in parts if part.strip()))


def _digest_file(path: Path) -> str:
    """Return the SHA-256 of a file, which is read in pieces of 1 MiB."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            digest.update(part)
    return digest.hexdigest()
