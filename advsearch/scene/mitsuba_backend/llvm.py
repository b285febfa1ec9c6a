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
from advsearch.trust.code import SUBPROCESS_DIRECTORY

ENVIRONMENT_VARIABLE = "DRJIT_LIBLLVM_PATH"
_VARIABLE_ADVICE = "Correct it, or unset it to let advsearch look for one."
ELF_HEADER_SIZE = 20  # bytes of the beginning of an ELF file that are compared
MIN_VERSION = 17  # the first major version that renders: see the head of this file
_PATTERNS = (
    "usr/lib/*/libLLVM*.so*",
    "usr/lib/libLLVM*.so*",
    "usr/lib/llvm*/lib/libLLVM*.so*",
    "usr/lib64/libLLVM*.so*",
    "usr/lib64/llvm*/lib*/libLLVM*.so*",
    "usr/local/lib/libLLVM*.so*",
    "opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    "usr/local/opt/llvm*/lib/libLLVM*.dylib",
    "home/linuxbrew/.linuxbrew/opt/llvm*/lib/libLLVM*.so*",
    "Program Files/LLVM/bin/LLVM-C.dll",
)
"""Where packages put the file.

They are those of Debian, Ubuntu, Fedora, Arch, Homebrew and LLVM's own Windows
installer.
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
    """A libLLVM file.

    As text it is its path, and in parentheses its version and why it is refused.
    """

    path: Path
    version: Version  # major first, or ()
    refusal: str = ""  # why Dr.Jit cannot use it; empty if it can

    def __str__(self) -> str:
        version = ".".join(map(str, self.version)) or "version unknown"
        reason = f": {self.refusal}" if self.refusal else ""
        return f"{self.path} ({version}{reason})"


def find_libraries(
    root: Path = Path("/"), environ: Mapping[str, str] = os.environ
) -> list[LibraryFile]:
    """Find every libLLVM of this machine.

    `DRJIT_LIBLLVM_PATH` is not read. Tests give another root of the file system.

    Args:
        root: root of the file system.
        environ: environment variables, of which ``CONDA_PREFIX`` is read.

    Returns:
        Usable files first, each group newest first.
    """
    paths = _find_library_files(root, environ)
    # one of the links that lead to each file, by the file
    link_of_file = {path.resolve(): path for path in paths if path.is_file()}
    libraries = [
        examine_library(path, name_hint=link) for path, link in link_of_file.items()
    ]
    # usable libraries first, and among them the newest first
    return sorted(
        libraries,
        key=lambda library: (not library.refusal, library.version),
        reverse=True,
    )


def _find_library_files(root: Path, environ: Mapping[str, str]) -> list[Path]:
    """Return paths below a root that may be libLLVM files, some of them repeatedly.

    The arguments are those of `find_libraries`.
    """
    patterns = [*_PATTERNS, *_list_conda_patterns(environ.get("CONDA_PREFIX", ""))]
    paths: list[Path] = []
    for pattern in patterns:
        matches = root.glob(pattern)
        paths += [path for path in matches if _NAME.fullmatch(path.name)]
    # The dynamic loader knows only the real root. It may answer with a bare name, such
    # as "libLLVM.so.19", which is no path.
    library = ctypes.util.find_library("LLVM") if root == Path("/") else None
    if library and os.sep in library:
        paths.append(Path(library))
    return paths


def _list_conda_patterns(prefix: str) -> list[str]:
    """Return patterns of libLLVM files in a conda environment, relative to the root.

    `prefix` is the environment's folder; there are no patterns if it is empty.
    """
    if not prefix:
        return []
    relative = Path(prefix).relative_to(Path(prefix).anchor).as_posix()
    names = ("libLLVM*.so*", "libLLVM*.dylib", "LLVM-C.dll")
    directories = (f"{relative}/lib", f"{relative}/Library/bin")
    return [f"{directory}/{name}" for directory in directories for name in names]


def examine_library(path: Path, *, name_hint: Path) -> LibraryFile:
    """Find out the version of a libLLVM file, and whether Dr.Jit can use it.

    The version is in its name, or in that of the link through which it was found;
    otherwise the library is loaded.

    Args:
        path: path of the file, symbolic links resolved.
        name_hint: the link through which it was found.
    """
    reason = _explain_unusable_file(path)
    if reason:
        return LibraryFile(path, version=(), refusal=reason)
    version = (
        parse_version(path) or parse_version(name_hint) or query_version(str(path))
    )
    return LibraryFile(path, version, refusal=explain_refusal(version))


def _explain_unusable_file(path: Path) -> str:
    """Return why a file cannot be loaded, by its first bytes; empty if it can."""
    # The first bytes of Python's own program. They are empty on systems whose programs
    # are no ELF files: there the library is not checked by its header.
    interpreter_header = read_interpreter_header()
    try:
        with path.open("rb") as file:
            header = file.read(ELF_HEADER_SIZE)
    except OSError as error:
        return f"it cannot be read: {error.strerror}"
    return _explain_wrong_header(header, interpreter_header)


def _explain_wrong_header(header: bytes, interpreter_header: bytes) -> str:
    """Return why a file with this beginning cannot be loaded; empty if it can.

    `interpreter_header` is the beginning of Python's own program. If that is empty,
    nothing is checked.
    """
    if not interpreter_header:
        return ""
    if header[:4] != b"\x7fELF" or len(header) < ELF_HEADER_SIZE:
        return "it is not a shared library"
    if _get_architecture(header) != _get_architecture(interpreter_header):
        return "it is for another processor"
    return ""


def explain_refusal(version: Version) -> str:
    """Return why Dr.Jit cannot use this version of LLVM; empty if it can."""
    if not version:
        return "it does not report its version, so it is older than 16 or not LLVM"
    if version[0] < 15:
        return "Dr.Jit refuses versions below 15"
    if version[0] < MIN_VERSION:
        return "it aborts the process at the first render"
    return ""


def _get_architecture(elf_header: bytes) -> bytes:
    """Return the word size, byte order and processor in a header of an ELF file."""
    return elf_header[4:6] + elf_header[18:20]


def parse_version(path: Path) -> Version:
    """Return the version that a path has, or ().

    Such paths are ``libLLVM-19.so.1``, ``libLLVM.so.19.1`` and
    ``llvm/19.1.7/lib/libLLVM.dylib``.
    """
    directory = path.parent.as_posix()
    match = _NAME_VERSION.match(path.name) or _FOLDER_VERSION.search(directory)
    if match is None:
        return ()
    return tuple(int(number) for number in match[1].split("."))


@functools.cache
def ensure_llvm() -> LibraryFile:
    """Choose a libLLVM and set ``DRJIT_LIBLLVM_PATH`` to it for Dr.Jit.

    Dr.Jit reads the variable when it is imported, so call this before the first import
    of Mitsuba. If the variable already names a file, that file is used.

    Raises:
        EnvironmentSetupError: there is no usable file, or the one that the variable
            names is not usable; the message lists what was found and the command that
            installs a good one.
    """
    variable = os.environ.get(ENVIRONMENT_VARIABLE, "")
    if not variable:
        library = select_newest(find_libraries())
        os.environ[ENVIRONMENT_VARIABLE] = str(library.path)
        return library
    return _examine_named_library(variable)


def _examine_named_library(variable: str) -> LibraryFile:
    """Return the libLLVM that ``DRJIT_LIBLLVM_PATH`` names, if it is usable."""
    library = _find_named_library(variable)
    if library.refusal:
        raise EnvironmentSetupError(
            f"{ENVIRONMENT_VARIABLE}: expected a libLLVM of version {MIN_VERSION} or "
            f"later, got {library}. {_VARIABLE_ADVICE}"
        )
    # the path as the variable has it, not resolved
    return replace(library, path=Path(variable))


def _find_named_library(variable: str) -> LibraryFile:
    """Return the libLLVM with a path or a plain name, usable or not.

    Raises:
        EnvironmentSetupError: there is no file with the path.
    """
    path = Path(variable)
    # A plain name: the dynamic loader finds the file, and only the library itself knows
    # its version.
    if os.sep not in variable:
        version = query_version(variable)
        return LibraryFile(path, version, explain_refusal(version))
    if path.is_file():
        return examine_library(path.resolve(), name_hint=path)
    raise EnvironmentSetupError(
        f"{ENVIRONMENT_VARIABLE}: expected a libLLVM file, got {variable!r}, which "
        f"does not exist. {_VARIABLE_ADVICE}"
    )


def get_install_command(
    release: Mapping[str, str] | None = None, system: str = sys.platform
) -> str:
    """Return the command that installs a good libLLVM here.

    On an unknown platform, it is one line for each known platform.

    Args:
        release: what identifies the Linux distribution; None reads ``/etc/os-release``.
        system: as `sys.platform`.
    """
    commands = _list_install_commands()
    if os.environ.get("CONDA_PREFIX"):
        return commands["conda"]
    if system == "darwin":
        return commands["Homebrew"]
    release = _read_release() if release is None else release
    source = _find_package_source(release)
    if source is not None:
        return commands[source]
    return "\n".join(f"  {name}: {command}" for name, command in commands.items())


def _find_package_source(release: Mapping[str, str]) -> str | None:
    """Return from where a Linux distribution gets a good libLLVM; None if unknown.

    It is a key of `_list_install_commands`.
    """
    ids = {release.get("ID", ""), *release.get("ID_LIKE", "").split()}
    version = release.get("VERSION_ID", "")
    # Ubuntu before 24 has no package of a good version: there it is conda's.
    is_old_ubuntu = "ubuntu" in ids and re.match(r"(1\d|2[0-3])\.", version)
    if is_old_ubuntu:
        return "conda"
    if ids & {"debian", "ubuntu"}:
        return "Debian, Ubuntu"
    if ids & {"fedora", "rhel"}:
        return "Fedora"
    return None


def _list_install_commands() -> dict[str, str]:
    """Return commands that install a good libLLVM, by the platform."""
    sudo = "" if hasattr(os, "geteuid") and os.geteuid() == 0 else "sudo "
    return {
        "Debian, Ubuntu": f"{sudo}apt-get install libllvm19",
        "Fedora": f"{sudo}dnf install llvm-libs",
        "Homebrew": "brew install llvm",
        "conda": "conda install -c conda-forge libllvm19",
    }


def _read_release() -> Mapping[str, str]:
    """Return what identifies this Linux distribution; empty if it cannot be read."""
    with contextlib.suppress(OSError):
        return platform.freedesktop_os_release()
    return {}


def select_newest(candidates: list[LibraryFile]) -> LibraryFile:
    """Return the newest usable library that can be loaded.

    Args:
        candidates: libraries in the order of `find_libraries`, the newest first.

    Raises:
        EnvironmentSetupError: there is none.
    """
    rejected = [str(candidate) for candidate in candidates if candidate.refusal]
    for candidate in candidates:
        if candidate.refusal:
            continue
        try:
            # Dr.Jit loads the same file next, so this costs nothing
            ctypes.CDLL(str(candidate.path))
        except OSError as error:
            rejected.append(f"{candidate.path} (cannot be loaded: {error})")
        else:
            return candidate
    raise EnvironmentSetupError(_describe_lack(rejected))


def _describe_lack(rejected: list[str]) -> str:
    """Return the message that no libLLVM is usable: the rejected ones, and how to get
    one.
    """
    rejected_text = "Found: " + "; ".join(rejected) + "." if rejected else "Found none."
    command = get_install_command()
    separator = "\n" if "\n" in command else " "
    return (
        f"expected a libLLVM of version {MIN_VERSION} or later, with which Dr.Jit "
        f"compiles its kernels. {rejected_text} Install one "
        f"with:{separator}{command}{separator}or name a file in {ENVIRONMENT_VARIABLE}."
    )


@functools.cache
def read_interpreter_header() -> bytes:
    """Return the first bytes of this interpreter's file; empty if it is not ELF.

    They have word size, byte order and processor.
    """
    try:
        with open(sys.executable, "rb") as file:
            header = file.read(ELF_HEADER_SIZE)
    except OSError:
        return b""
    return header if header[:4] == b"\x7fELF" else b""


def query_version(library: str) -> Version:
    """Return the version that a library reports, or () if it reports none.

    It is loaded in another process, which a bad one may take down.
    """
    path = os.path.abspath(library) if os.sep in library else library
    try:
        output = _run_probe(path)
        return tuple(int(number) for number in output.split())
    except (OSError, subprocess.SubprocessError, ValueError):
        return ()


def _run_probe(path: str) -> str:
    """Return what `_PROBE` prints for a library: its version numbers."""
    return subprocess.run(
        [sys.executable, "-c", _PROBE, path],
        capture_output=True,
        text=True,
        timeout=30,
        check=True,
        cwd=SUBPROCESS_DIRECTORY,
    ).stdout


def main() -> int:
    """Print the libLLVM that advsearch will use, or why there is none (status 3)."""
    try:
        library = ensure_llvm()
    except AdvsearchError as error:
        print(f"advsearch: {error}", file=sys.stderr)
        return 3
    print(f"{'.'.join(map(str, library.version))} ({library.path})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
