"""`advsearch doctor`: check every component that a run needs.

It reports the version of each component, whether it works, and how to repair it.
Components with native code are tried in a process of their own
(`advsearch.cli.doctor_probe`): an old libLLVM crashes the process, and the rest of the
report should still be printed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING

from advsearch import threads
from advsearch.cli import output
from advsearch.cli.main import command
from advsearch.errors import FELL_SHORT, AdvsearchError
from advsearch.scene.mitsuba_backend import llvm
from advsearch.trust.code import SUBPROCESS_DIRECTORY
from advsearch.version import __version__

if TYPE_CHECKING:
    from rich.table import Table

OK = "ok"
WARNING = "warning"
MISSING = "missing"
BROKEN = "broken"
"""The statuses of a component. With a warning, everything still runs."""
COLOURS = {OK: "green", WARNING: "yellow", MISSING: "red", BROKEN: "red"}

GIB = 2**30
# With less, there is a warning. The disk holds the images of runs and the kernel cache.
# A search needs up to 2.5 GiB of memory, and other programs run as well.
MIN_FREE_DISK = 1 * GIB
MIN_MEMORY = 3 * GIB

SECONDS_ALLOWED = 300  # maximum run time of the probe
OPTIONAL = {"pyarrow": "advsearch export does not write Parquet"}
"""Optional packages, with what does not work without them."""

PROBE_PROCESS = ""
"""The name under which `run_probe` returns how the probe's process itself ended."""
PROBE = (sys.executable, "-m", "advsearch.cli.doctor_probe")

_SMALL_PACKAGES = ("OpenEXR", "imageio", "matplotlib", "cma", "xatlas", "pyarrow")


@dataclass(frozen=True)
class Component:
    """The state of one component of the installation.

    Attributes:
        name: name of the component.
        version: its version; empty if it is unknown or does not apply.
        status: "ok", "warning", "missing" or "broken".
        detail: what was tried, or what is wrong.
        fix: how to repair it; empty if there is nothing to do.
    """

    name: str
    version: str
    status: str
    detail: str = ""
    fix: str = ""


@command(output.add_json_flag)
def doctor(args: argparse.Namespace) -> int:
    """Check every component of the installation, and print the results.

    Returns:
        The exit status: 0 if everything that is necessary works, else `FELL_SHORT`.
    """
    print(
        "advsearch: trying every part, a first render among them; that takes some "
        "seconds",
        file=sys.stderr,
    )
    parts = diagnose()
    is_good = all(part.status in (OK, WARNING) for part in parts)
    if args.json:
        _print_parts_as_json(parts, is_good=is_good)
    else:
        _print_parts(parts, is_good=is_good)
    return 0 if is_good else FELL_SHORT


def _print_parts_as_json(parts: Sequence[Component], *, is_good: bool) -> None:
    """Print the components, and whether all that is necessary works, as JSON."""
    output.print_json(
        {
            "schema": 1,
            "command": "doctor",
            "ok": is_good,
            "parts": [asdict(part) for part in parts],
        }
    )


def _print_parts(parts: Sequence[Component], *, is_good: bool) -> None:
    """Print a table of the components with their fixes, and whether all are in order.

    Args:
        parts: the parts with their states.
        is_good: whether everything that is necessary works.
    """
    # late: without rich, --json still works and reports it
    from rich.console import Console
    from rich.markup import escape

    console = Console(highlight=False)
    console.print(_make_parts_table(parts))
    console.print()
    for part in parts:
        if part.fix:
            console.print(f"{escape(part.name)}: {escape(part.fix)}", soft_wrap=True)
    if is_good:
        console.print("Everything that is necessary works.")
    else:
        console.print("[red]Something necessary does not work.[/]")


def _make_parts_table(parts: Sequence[Component]) -> Table:
    """Return a table with a row for each component."""
    # late: rich may be missing
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for heading in ("part", "version", "", "detail"):
        table.add_column(heading, overflow="fold")
    for part in parts:
        state = f"[{COLOURS[part.status]}]{part.status}[/]"
        table.add_row(
            escape(part.name), escape(part.version), state, escape(part.detail)
        )
    return table


def diagnose() -> list[Component]:
    """Check every part, in the order in which they depend on each other."""
    return [
        Component("Python", platform.python_version(), OK, sys.executable),
        Component("advsearch", __version__, OK, str(resources.files("advsearch"))),
        *check_packages(run_probe()),
        check_other_packages(),
        check_llvm(),
        check_bundled_scenes(),
        check_reference_weights(),
        check_kernel_cache(Path.home() / ".drjit"),
        check_disk(Path.cwd()),
        check_hardware(),
    ]


def run_probe(command: Sequence[str] = PROBE) -> dict[str, tuple[bool, str]]:
    """Try the parts that load native code in another process, which they may crash.

    Args:
        command: command of that process, which prints a line of JSON for each part that
            it has tried.

    Returns:
        For each part, by its name, whether it worked, and a detail or the error. If a
        part ended the process, it and those after it are missing. The entry
        `PROBE_PROCESS` is about the process: whether it ended well, and how it ended.
    """
    output_text, ended_well, ending = _run_probe_process(command)
    tried = {}
    for line in output_text.splitlines():
        try:
            outcome = json.loads(line)
            tried[outcome["name"]] = (bool(outcome["ok"]), str(outcome["detail"]))
        # a line that a library printed
        except (ValueError, KeyError, TypeError):
            continue
    return {**tried, PROBE_PROCESS: (ended_well, ending)}


def _run_probe_process(command: Sequence[str]) -> tuple[str, bool, str]:
    """Run a process for at most `SECONDS_ALLOWED`.

    Args:
        command: program and arguments.

    Returns:
        What it wrote to standard output, whether it ended well, and how it ended, which
        is empty if it ended well.
    """
    try:
        process = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=SECONDS_ALLOWED,
            check=False,
            cwd=SUBPROCESS_DIRECTORY,
        )
    except subprocess.TimeoutExpired as expired:
        ending = f"the trial took longer than {SECONDS_ALLOWED} s"
        return _decode_partial_output(expired), False, ending
    ending = _describe_ending(process.returncode, process.stderr)
    return process.stdout, process.returncode == 0, ending


def _decode_partial_output(expired: subprocess.TimeoutExpired) -> str:
    """Return what a process wrote to standard output before its time was over."""
    # After a timeout the output is bytes even with `text=True`, or None.
    partial_output: str | bytes = expired.stdout or ""
    if isinstance(partial_output, bytes):
        return partial_output.decode("utf-8", "replace")
    return partial_output


def _describe_ending(status: int, error_text: str) -> str:
    """Return how a process ended, as a clause; "" if it ended well.

    Args:
        status: its exit status; if negative, minus the number of the signal that ended
            it.
        error_text: its output to standard error.
    """
    if status == 0:
        return ""
    error_lines = [
        line.strip()
        for line in error_text.splitlines()
        if "ERROR" in line or "Error" in line
    ]
    status_text = f"status {status}"
    if status < 0:
        status_text = f"signal {signal.Signals(-status).name}"
    ending = f"the trial ended with {status_text}"
    # 120 characters of the first error line, so that the table stays readable
    return ending + (f" ({error_lines[0][:120]})" if error_lines else "")


def check_packages(tried: dict[str, tuple[bool, str]]) -> Iterator[Component]:
    """Yield a component for each package, with its version and whether it works.

    Mitsuba and Dr.Jit are not tried separately. The component "render", which is no
    package, tries both.

    Args:
        tried: for each component, whether it works and a detail, as `run_probe` returns
            them.
    """
    # in the order of the trials in `doctor_probe.TRIALS`
    for name in (
        "numpy",
        "torch",
        "mitsuba",
        "drjit",
        "render",
        "mitsuba-oidn",
        *_SMALL_PACKAGES,
    ):
        yield _check_probed_package(name, tried)


def _check_probed_package(name: str, tried: dict[str, tuple[bool, str]]) -> Component:
    """Return the entry of one package, or of "render"; `tried` as `check_packages`."""
    # "render" is no package and has no version; None is a missing package
    version = "" if name == "render" else find_installed_version(name)
    if version is None:
        return _make_missing_package(name)
    if name in ("mitsuba", "drjit"):
        return Component(name, version, OK, "tried by the render below")
    if name not in tried:
        # The process of the trials crashed before or at this one, usually because
        # libLLVM is too old.
        _ended_well, process_ending = tried[PROBE_PROCESS]
        detail = f"not reached: {process_ending}"
        return Component(name, version, BROKEN, detail, "see libLLVM below")
    is_working, detail = tried[name]
    if is_working:
        return Component(name, version, OK, detail)
    return _make_broken_package(name, version, detail)


def _make_missing_package(name: str) -> Component:
    """Return the entry of a package that is not installed."""
    if name in OPTIONAL:
        detail = f"not installed: {OPTIONAL[name]}"
        return Component(name, "", WARNING, detail, _reinstall(name))
    return Component(name, "", MISSING, "not installed", _reinstall(name))


def _make_broken_package(name: str, version: str, detail: str) -> Component:
    """Return the entry of a package that did not work; `detail` is its error."""
    status = WARNING if name in OPTIONAL else BROKEN
    fix = _reinstall(name)
    if name == "render":
        fix = "see libLLVM below, then mend mitsuba and drjit: make setup"
    return Component(name, version, status, detail, fix)


def check_other_packages(requirements: Sequence[str] | None = None) -> Component:
    """Check that the dependencies which need no trial are installed.

    Args:
        requirements: as in a package's metadata, for example "rich>=13"; None takes
            those of advsearch.
    """
    if requirements is None:
        requirements = metadata.requires("advsearch") or []
    untried_names = _list_untried_packages(requirements)
    versions = {name: find_installed_version(name) for name in untried_names}
    absent = [name for name, version in versions.items() if version is None]
    if absent:
        detail = f"not installed: {', '.join(absent)}"
        fix = _reinstall(" ".join(absent))
        return Component("other packages", "", MISSING, detail, fix)
    detail = ", ".join(f"{name} {version}" for name, version in versions.items())
    return Component("other packages", "", OK, detail)


def _list_untried_packages(requirements: Sequence[str]) -> list[str]:
    """Return the sorted names of required packages that no trial imports.

    Args:
        requirements: as in a package's metadata, for example "rich>=13"; those of
            optional extras are left out.
    """
    names = {
        # "rich>=13" and 'tomli; python_version < "3.11"' begin with the name
        re.split(r"[^\w.-]", requirement, maxsplit=1)[0]
        for requirement in requirements
        if "extra ==" not in requirement  # the package belongs to no optional extra
    }
    tried_names = {"numpy", "torch", "mitsuba", "mitsuba-oidn", *_SMALL_PACKAGES}
    return sorted(names - tried_names, key=str.lower)


def find_installed_version(name: str) -> str | None:
    """Return the version of an installed package; None if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _reinstall(name: str) -> str:
    """Return the command that installs a package again."""
    return (
        f"pip install --force-reinstall --no-deps {name}, or make clean setup in a "
        "checkout"
    )


def check_llvm() -> Component:
    """Check which libLLVM will be used.

    The detail names the other libraries that were found, too: those that could be used
    instead, and those that are refused, with the reason.
    """
    library_setting = os.environ.get(llvm.ENVIRONMENT_VARIABLE, "")
    libraries = llvm.find_libraries()
    try:
        chosen = llvm.ensure_llvm()
    except AdvsearchError as error:
        status = BROKEN if libraries or library_setting else MISSING
        fix = _make_llvm_fix(library_setting)
        return Component("libLLVM", "", status, str(error), fix)
    detail = f"chosen: {chosen.path}"
    if library_setting:
        detail += f", named by {llvm.ENVIRONMENT_VARIABLE}"
    detail += _describe_other_libraries(libraries, chosen.path)
    return Component("libLLVM", ".".join(map(str, chosen.version)), OK, detail)


def _make_llvm_fix(library_setting: str) -> str:
    """Return how to repair a libLLVM that is missing or does not work.

    Args:
        library_setting: the library that the environment variable names, or "".
    """
    if library_setting:
        return f"unset {llvm.ENVIRONMENT_VARIABLE}"
    return (
        f"{llvm.get_install_command()} (or name a file in {llvm.ENVIRONMENT_VARIABLE})"
    )


def _describe_other_libraries(
    libraries: Sequence[llvm.LibraryFile], chosen: Path
) -> str:
    """Return the usable and the refused libraries but the chosen one, as clauses."""
    # the text of a library has the reason for which it is refused
    refused = [str(library) for library in libraries if library.refusal]
    other_usable = [
        str(library)
        for library in libraries
        if not library.refusal and library.path != chosen.resolve()
    ]
    text = ""
    if other_usable:
        text += f"; also usable: {', '.join(other_usable)}"
    if refused:
        text += f"; refused: {', '.join(refused)}"
    return text


def check_bundled_scenes() -> Component:
    """Check the objects and environments that travel inside the package."""
    name = "bundled scenes"
    fix = "reinstall advsearch; in a checkout: git restore advsearch/bundled/data"
    try:
        # inside the block: the import itself is tried, too
        from advsearch.scene.library import list_environments, list_objects

        objects = list_objects()
        environments = list_environments()
    except (ImportError, OSError, ValueError, KeyError, AdvsearchError) as error:
        return Component(name, "", MISSING, f"{type(error).__name__}: {error}", fix)
    detail = f"{len(objects)} objects, {len(environments)} environments"
    if objects and environments:
        return Component(name, "", OK, detail)
    return Component(name, "", MISSING, detail, fix)


def check_reference_weights() -> Component:
    """Check the weights and labels of the bundled classifier."""
    name = "reference model"
    folder = resources.files("advsearch.models") / "data"
    absent = [
        file_name
        for file_name in ("reference.safetensors", "reference.json")
        if not folder.joinpath(file_name).is_file()
    ]
    if absent:
        fix = "reinstall advsearch; in a checkout: git restore advsearch/models/data"
        detail = f"{' and '.join(absent)} not in {folder}"
        return Component(name, "", MISSING, detail, fix)
    size = os.path.getsize(str(folder.joinpath("reference.safetensors")))
    return Component(name, "", OK, f"{size / 1e6:.1f} MB of weights")


def check_kernel_cache(folder: Path) -> Component:
    """Check the folder in which Dr.Jit stores compiled kernels."""
    name = "kernel cache"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        detail = (
            f"{folder} cannot be written ({error.strerror}): every run compiles "
            "its kernels again"
        )
        return Component(name, "", WARNING, detail, f"make {folder} writable")
    sizes = [entry.stat().st_size for entry in os.scandir(folder) if entry.is_file()]
    detail = f"{folder}: {len(sizes)} files, {sum(sizes) / 1e6:.0f} MB"
    return Component(name, "", OK, detail)


def check_disk(folder: Path) -> Component:
    """Check the space that is left where runs are written by default."""
    free = shutil.disk_usage(folder).free
    if free < MIN_FREE_DISK:
        fix = "free some space, or --run elsewhere"
        return Component(
            "disk", "", WARNING, f"{free / GIB:.1f} GiB free in {folder}", fix
        )
    return Component("disk", "", OK, f"{free / GIB:.0f} GiB free in {folder}")


def check_hardware() -> Component:
    """Check cores and memory; little memory is a warning."""
    cores = threads.count_cores()
    memory = _read_memory_size()
    cores_text = f"{cores} cores" if cores > 1 else f"{cores} core"
    detail = f"{platform.system()} {platform.machine()}, {cores_text}"
    if memory:
        detail += f", {memory / GIB:.1f} GiB of memory"
    if memory and memory < MIN_MEMORY:
        fix = "a search peaks at 2.5 GiB: close other programs"
        return Component("machine", "", WARNING, detail, fix)
    return Component("machine", "", OK, detail)


def _read_memory_size() -> int:
    """Return the bytes of memory; 0 on systems that do not report them."""
    with suppress(AttributeError, ValueError, OSError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return 0
