"""Find a libLLVM that Dr.Jit can compile its kernels with, before Mitsuba is imported.

Dr.Jit takes whatever ``libLLVM`` the machine offers first. A version that is too old
leaves the backend inactive (Dr.Jit 1.5 refuses versions below 15) or, worse, aborts the
whole process at the first render: on x86 the kernels use the ``fminimum`` operation,
which LLVM selects from version 17 on. Measured with Dr.Jit 1.5.0 on an AMD EPYC: 13 and
14 are refused, 15 and 16 abort, 19 and 22 render. So this module looks for the newest
file of version 17 or later and names it in the variable that Dr.Jit reads,
``DRJIT_LIBLLVM_PATH``.

Only the standard library is imported here: the set-up script runs this file before
anything else works (``python -m advsearch.scene.mitsuba_backend.llvm`` prints the
chosen file).
"""

from __future__ import annotations

import contextlib
import ctypes
import ctypes.util
import functools
import os
import platform
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from advsearch.errors import AdvsearchError, EnvironmentSetupError
from advsearch.trust.code import OWN_FOLDER

VARIABLE = "DRJIT_LIBLLVM_PATH"
MINIMUM = 17  # the first major version that renders: see the head of this file
_PATTERNS = (
    "usr/lib/*/libLLVM*.so*", "usr/lib/libLLVM*.so*", "usr/lib/llvm*/lib/libLLVM*.so*", "usr/lib64/libLLVM*.so*",
    "usr/lib64/llvm*/lib*/libLLVM*.so*", "usr/local/lib/libLLVM*.so*", "opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    "usr/local/opt/llvm*/lib/libLLVM*.dylib", "home/linuxbrew/.linuxbrew/opt/llvm*/lib/libLLVM*.so*",
    "Program Files/LLVM/bin/LLVM-C.dll",
)  # fmt: skip
"""Where the packages of Debian, Ubuntu, Fedora, Arch, Homebrew and LLVM's own Windows
installer put the file.
"""
_NAME = re.compile(r"libLLVM([-.]\d+(\.\d+)*)?\.(so[^/]*|dylib)|LLVM-C\.dll")
_NAME_VERSION = re.compile(r"libLLVM(?:\.so\.|[-.])(\d\d(?:\.\d+)*)")
_FOLDER_VERSION = re.compile(r"llvm[-@]?/?(\d\d(?:\.\d+)*)")
_PROBE = (
    "import ctypes, sys\n"
    "v = [ctypes.c_uint() for _ in range(3)]\n"
    "ctypes.CDLL(sys.argv[1]).LLVMGetVersion(*map(ctypes.byref, v))\n"
    "print(*(n.value for n in v))\n"
)
Version = tuple[int, ...]


@dataclass(frozen=True)
class LibraryFile:
    """A libLLVM file, its version, major first, or (), and why Dr.Jit cannot use it
    (empty if it can).
    """

    path: Path
    version: Version
    refused: str = ""

    def __str__(self) -> str:
        version = ".".join(map(str, self.version)) or "version unknown"
        return f"{self.path} ({version}{': ' + self.refused if self.refused else ''})"


def find(
    root: Path = Path("/"), environ: Mapping[str, str] = os.environ
) -> list[LibraryFile]:
    """Every libLLVM of this machine, usable ones first, each group newest first;
    `DRJIT_LIBLLVM_PATH` is not looked at. Tests give another root of the file system;
    ``CONDA_PREFIX`` is read from `environ`.
    """
    patterns = list(_PATTERNS)
    if prefix := environ.get("CONDA_PREFIX", ""):  # an active conda environment
        inside = Path(prefix).relative_to(Path(prefix).anchor).as_posix()
        for folder in (f"{inside}/lib", f"{inside}/Library/bin"):
            patterns += [
                f"{folder}/{name}"
                for name in ("libLLVM*.so*", "libLLVM*.dylib", "LLVM-C.dll")
            ]
    paths = [
        path
        for pattern in patterns
        for path in root.glob(pattern)
        if _NAME.fullmatch(path.name)
    ]
    library = ctypes.util.find_library("LLVM") if root == Path("/") else None
    if library and os.sep in library:
        paths.append(Path(library))
    links = {path.resolve(): path for path in paths if path.is_file()}
    candidates = [examine(path, name_hint=link) for path, link in links.items()]
    return sorted(
        candidates,
        key=lambda candidate: (not candidate.refused, candidate.version),
        reverse=True,
    )


def examine(path: Path, *, name_hint: Path) -> LibraryFile:
    """Say which version a libLLVM file is, symbolic links resolved, from its name, else
    from that of the link through which it was found, or else by asking it; and whether
    Dr.Jit can use it.
    """
    own = own_elf_header()
    head = b""
    try:
        with path.open("rb") as file:
            head = file.read(20)
    except OSError as error:
        return LibraryFile(path, (), f"it cannot be read: {error.strerror}")
    if own and (head[:4] != b"\x7fELF" or len(head) < 20):
        return LibraryFile(path, (), "it is not a shared library")
    if own and (head[4:6], head[18:20]) != (own[4:6], own[18:20]):
        return LibraryFile(path, (), "it is for another processor")
    version = version_in(path) or version_in(name_hint) or asked_version(str(path))
    return LibraryFile(path, version, refusal(version))


def refusal(version: Version) -> str:
    """Why Dr.Jit cannot use this version of LLVM; empty when it can."""
    if not version:
        return "it does not tell its version, so it is older than 16 or not LLVM"
    if version[0] < 15:
        return "Dr.Jit refuses versions below 15"
    return "it aborts the process at the first render" if version[0] < MINIMUM else ""


def version_in(path: Path) -> Version:
    """The version in a path like ``libLLVM-19.so.1``, ``libLLVM.so.19.1``,
    ``llvm/19.1.7/lib/libLLVM.dylib``; or ().
    """
    match = _NAME_VERSION.match(path.name) or _FOLDER_VERSION.search(
        path.parent.as_posix()
    )
    return tuple(int(part) for part in match[1].split(".")) if match else ()


@functools.cache
def ensure_llvm() -> LibraryFile:
    """Choose a libLLVM and name it in ``DRJIT_LIBLLVM_PATH``, which Dr.Jit reads when
    it is imported.

    A file that the variable names already wins, whatever else there is. Call it before
    the first import of Mitsuba.

    Raises:
        EnvironmentSetupError: there is no usable file, or the one that the variable
            names is not usable; the message lists what was found and the command that
            installs a good one.
    """
    named = os.environ.get(VARIABLE, "")
    if not named:
        chosen = newest(find())
        os.environ[VARIABLE] = str(chosen.path)
        return chosen
    path = Path(named)
    correct = "Correct it, or unset it to let advsearch look for one."
    # the dynamic loader looks it up; only the library itself knows its version
    if os.sep not in named:
        version = asked_version(named)
        chosen = LibraryFile(path, version, refusal(version))
    elif path.is_file():
        chosen = examine(path.resolve(), name_hint=path)
    else:
        raise EnvironmentSetupError(
            f"{VARIABLE}: expected a libLLVM file, got {named!r}, which does not "
            f"exist. {correct}"
        )
    if chosen.refused:
        raise EnvironmentSetupError(
            f"{VARIABLE}: expected a libLLVM of version {MINIMUM} or later, got "
            f"{chosen}. {correct}"
        )
    return replace(chosen, path=path)


def install_command(
    release: Mapping[str, str] | None = None, system: str = sys.platform
) -> str:
    """The command that installs a good libLLVM here, or a line for each platform; None
    reads ``/etc/os-release``.
    """
    sudo = "" if hasattr(os, "geteuid") and os.geteuid() == 0 else "sudo "
    commands = {
        "Debian, Ubuntu": f"{sudo}apt-get install libllvm19", "Fedora": f"{sudo}dnf install llvm-libs",
        "Homebrew": "brew install llvm", "conda": "conda install -c conda-forge "
                                                  "libllvm19",
    }  # fmt: skip
    if os.environ.get("CONDA_PREFIX"):
        return commands["conda"]
    if system == "darwin":
        return commands["Homebrew"]
    if release is None:
        with contextlib.suppress(OSError):
            release = platform.freedesktop_os_release()
    release = release or {}
    ids = {release.get("ID", ""), *release.get("ID_LIKE", "").split()}
    if "ubuntu" in ids and re.match(r"(1\d|2[0-3])\.", release.get("VERSION_ID", "")):
        return commands["conda"]  # its own packages end with LLVM 15
    for name, known in (
        ("Debian, Ubuntu", {"debian", "ubuntu"}),
        ("Fedora", {"fedora", "rhel"}),
    ):
        if known & ids:
            return commands[name]
    return "\n".join(f"  {name}: {command}" for name, command in commands.items())


def newest(candidates: list[LibraryFile]) -> LibraryFile:
    """The first usable candidate that can be loaded."""
    refused = [str(candidate) for candidate in candidates if candidate.refused]
    for candidate in candidates:
        if candidate.refused:
            continue
        try:
            # Dr.Jit loads the same file next, so this costs nothing
            ctypes.CDLL(str(candidate.path))
        except OSError as error:
            refused.append(f"{candidate.path} (cannot be loaded: {error})")
        else:
            return candidate
    there = "Found: " + "; ".join(refused) + "." if refused else "Found none."
    command = install_command()
    separator = "\n" if "\n" in command else " "
    raise EnvironmentSetupError(
        f"expected a libLLVM of version {MINIMUM} or later, with which Dr.Jit compiles "
        f"its kernels. {there} "
        f"Install one with:{separator}{command}{separator}or name a file in {VARIABLE}."
    )


@functools.cache
def own_elf_header() -> bytes:
    """The first bytes of this interpreter's own file: word size, byte order, processor;
    empty if it is not ELF.
    """
    try:
        with open(sys.executable, "rb") as file:
            head = file.read(20)
    except OSError:
        return b""
    return head if head[:4] == b"\x7fELF" else b""


def asked_version(library: str) -> Version:
    """Load a library in another process, which a bad one may take down, and ask for its
    version; () if it has none.
    """
    command = [
        sys.executable,
        "-c",
        _PROBE,
        os.path.abspath(library) if os.sep in library else library,
    ]
    try:
        printed = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=30,
            check=True,
            cwd=OWN_FOLDER,
        ).stdout
        return tuple(int(part) for part in printed.split())
    except (OSError, subprocess.SubprocessError, ValueError):
        return ()


def main() -> int:
    """Print the libLLVM that advsearch will use, or why there is none (status 3)."""
    try:
        chosen = ensure_llvm()
    except AdvsearchError as error:
        print(f"advsearch: {error}", file=sys.stderr)
        return 3
    print(f"{'.'.join(map(str, chosen.version))} ({chosen.path})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
