"""Only ordinary files are read, and never more of them than a limit."""

import io
import os
import socket
from pathlib import Path

import pytest

from advsearch.errors import FileFormatError, InputError
from advsearch.files import split_paths
from advsearch.trust import stored_files


def _pipe(folder: Path) -> Path:
    os.mkfifo(folder / "pipe")
    return folder / "pipe"


def _socket(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(folder)  # a socket's address has to be short
    with socket.socket(socket.AF_UNIX) as made:
        made.bind("socket")
    return folder / "socket"


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/null", "/dev/random"])
def test_a_device_is_refused_before_it_is_read(device: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="expected a label file, got a device"):
        stored_files.read_bytes(Path(device), "a label file", 100)
    (tmp_path / "link").symlink_to(device)
    with pytest.raises(FileFormatError, match="got a device"):
        stored_files.read_bytes(tmp_path / "link", "a label file", 100)


def test_pipes_sockets_and_folders_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = {_pipe(tmp_path): "pipe", _socket(tmp_path, monkeypatch): "socket", tmp_path: "directory"}
    for path, kind in kinds.items():
        with pytest.raises(FileFormatError, match=f"expected a mesh, got a {kind}; "):
            stored_files.open_regular(path, "a mesh", 100)


def test_a_pipe_that_takes_the_place_of_a_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ordinary = tmp_path / "ordinary"
    ordinary.write_bytes(b"x")
    status, pipe = os.stat(ordinary), _pipe(tmp_path)
    monkeypatch.setattr(os, "stat", lambda path: status)
    with pytest.raises(FileFormatError, match="got a pipe"):
        stored_files.open_regular(pipe, "a mesh", 100)


def test_no_more_is_read_than_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"0123456789")
    assert stored_files.read_bytes(path, "a mesh", 10) == b"0123456789"
    with pytest.raises(FileFormatError, match=r"expected a mesh of at most 9 bytes, got 10; .*ADVSEARCH_LIMITS"):
        stored_files.read_bytes(path, "a mesh", 9)
    monkeypatch.setenv("ADVSEARCH_LIMITS", "2")
    assert stored_files.read_bytes(path, "a mesh", 5) == b"0123456789"


def test_a_file_that_gives_no_size_is_limited_too() -> None:
    with pytest.raises(FileFormatError, match="at most 20 bytes, got more"):
        stored_files.read_bytes(Path("/proc/self/status"), "a mesh", 20)


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "many"])
def test_the_factor_of_limits_is_checked(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ADVSEARCH_LIMITS", value)
    with pytest.raises(InputError, match="ADVSEARCH_LIMITS"):
        stored_files.scale_limit(1)


@pytest.mark.parametrize("text", ["[" * 101 + "]" * 101, '{"a":' * 3000 + "1" + "}" * 3000, "[" * 100_000, "1" * 6000])
def test_json_is_neither_deep_nor_of_endless_numbers(text: str) -> None:
    with pytest.raises(ValueError) as error:
        stored_files.parse_json(text)
    assert len(str(error.value)) < 200


def test_a_file_that_waits_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").write_bytes(b"x")

    class Waiting(io.BytesIO):
        def read(self, size: int | None = -1) -> bytes:
            return None  # type: ignore[return-value]

    monkeypatch.setattr(stored_files, "open_regular", lambda *_: Waiting())
    with pytest.raises(FileFormatError, match="a label file"):
        stored_files.read_bytes(tmp_path / "a", "a label file", 100)


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("/x/camera.csv+/y/object.csv", ["/x/camera.csv", "/y/object.csv"]),
        ("approach+/x/object.csv", ["approach", "/x/object.csv"]), ("approach+orbit", ["approach+orbit"]),
        ("/v+1/camera.csv", ["/v+1/camera.csv"]),
    ],
)  # fmt: skip
def test_two_paths_are_told_from_a_name_with_a_plus(name: str, parts: list[str]) -> None:
    assert split_paths(name) == parts
