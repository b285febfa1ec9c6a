"""Finding a libLLVM: every platform's places, names and versions, in made-up folders; and the one of this machine."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from advsearch.errors import EnvironmentSetupError
from advsearch.scene.mitsuba_backend import llvm

linux_only = pytest.mark.skipif(not llvm.read_interpreter_header(), reason="libraries are not ELF files here")


@pytest.fixture(autouse=True)
def _fresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Each test starts without the variable and a remembered choice, and leaves none to the tests after it."""
    monkeypatch.delenv(llvm.ENVIRONMENT_VARIABLE, raising=False)
    monkeypatch.delenv("CONDA_PREFIX", raising=False)
    llvm.ensure_llvm.cache_clear()
    yield
    llvm.ensure_llvm.cache_clear()


def library(root: Path, path: str, content: bytes | None = None) -> Path:
    """Make a file that looks like a library for this interpreter."""
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(llvm.read_interpreter_header() if content is None else content)
    return file


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", (19, 1)),  # Debian, Ubuntu since 19
        ("usr/lib/llvm-18/lib/libLLVM.so.1", (18,)),
        ("usr/lib64/llvm19/lib/libLLVM.so", (19,)),
        ("opt/homebrew/opt/llvm@19/lib/libLLVM.dylib", (19,)),
        ("usr/local/opt/llvm/lib/libLLVM.22.1.dylib", (22, 1)),
    ],
)
def test_finds_each_platforms_file_and_its_version(tmp_path: Path, path: str, version: tuple[int, ...]) -> None:
    library(tmp_path, path)
    (found,) = llvm.find_libraries(tmp_path, {})
    assert (found.version, found.refusal) == (version, "")


def test_newest_usable_comes_first_and_old_ones_are_refused(tmp_path: Path) -> None:
    for name in ("libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM-16.so.1", "libLLVM.so.19.1", "libLLVM.so.20.1"):
        library(tmp_path, f"usr/lib/x86_64-linux-gnu/{name}")
    found = llvm.find_libraries(tmp_path, {})
    assert [c.version[0] for c in found] == [20, 19, 16, 15, 14]
    assert [bool(c.refusal) for c in found] == [False, False, True, True, True]


@linux_only
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "not a shared library"), (b"INPUT(libLLVM-19.so)\n", "not a shared library"),
        (llvm.read_interpreter_header()[:18] + b"\x28\x00", "another processor"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_library_for_this_machine_is_refused(tmp_path: Path, content: bytes, reason: str) -> None:
    library(tmp_path, "usr/lib/libLLVM.so.19.1", content)
    (found,) = llvm.find_libraries(tmp_path, {})
    assert reason in found.refusal


def test_variable_wins_over_what_would_be_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = library(tmp_path, "mine/libLLVM.so.18.1")
    monkeypatch.setenv(llvm.ENVIRONMENT_VARIABLE, str(given))
    assert llvm.ensure_llvm() == llvm.LibraryFile(given, (18, 1))
    assert os.environ[llvm.ENVIRONMENT_VARIABLE] == str(given)


@pytest.mark.parametrize("name", ["libLLVM.so.15.0", "libLLVM-14.so.1", "missing/libLLVM.so.19.1"])
def test_variable_that_names_an_old_or_missing_file_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    path = tmp_path / name if name.startswith("missing") else library(tmp_path, name)
    monkeypatch.setenv(llvm.ENVIRONMENT_VARIABLE, str(path))
    with pytest.raises(EnvironmentSetupError, match=llvm.ENVIRONMENT_VARIABLE):
        llvm.ensure_llvm()


def test_this_machine_has_a_usable_one_and_it_tells_the_version_of_its_name() -> None:
    chosen = llvm.ensure_llvm()
    assert chosen.version[0] >= llvm.MIN_VERSION
    assert llvm.query_version(str(chosen.path))[: len(chosen.version)] == chosen.version
