"""From what a user says (`workers`, `cluster`) to an executor."""

from __future__ import annotations

import ast
import hashlib
import importlib
import json
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from advsearch import threads
from advsearch.cluster.coordinator import Coordinator
from advsearch.cluster.dask_pool import DaskPool, Site, local
from advsearch.cluster.executor import Executor, Work
from advsearch.cluster.worker import Files, read_files, this_machine, version
from advsearch.errors import FileFormatError, InputError
from advsearch.settings import read_yaml

LOCAL = "local"
"""The cluster of this machine's own processes."""

SCHEMES = ("tcp://", "tls://", "ws://", "wss://")

CLASSES = {
    **dict.fromkeys(
        ("SLURMCluster", "PBSCluster", "LSFCluster", "SGECluster", "MoabCluster", "OARCluster", "HTCondorCluster"),
        "dask_jobqueue",
    ),
    "KubeCluster": "dask_kubernetes.operator",
}
"""Classes of clusters that a file may name, and where each is; anything else would be code that the file runs."""


@contextmanager
def executor_of(
    work: Work, *, workers: int | None, cluster: str | None, tell: Callable[[str], None]
) -> Iterator[Executor | None]:
    """Open an executor of a work for the block; None where everything is done in this process.

    Args:
        work: what is to be done.
        workers: how many processes.
        cluster: a scheduler's address, "local", or a YAML file.
        tell: told what a person should read.

    Raises:
        InputError: they make no sense, or Dask is not installed.
        ClusterError: there is no scheduler.
    """
    if workers is None and cluster is None:
        yield None
        return
    check_installed()
    files = read_files(work)
    place = place_of(workers, cluster)
    pool = DaskPool(place)
    try:
        if pool.link:
            tell(f"Dask shows its workers at {pool.link}")
        yield Coordinator(pool, work, work_key(work, files), files, version(), this_machine(), tell)
    finally:
        pool.close()


def check_installed() -> None:
    """Check that Dask is there.

    Raises:
        InputError: it is not; the message says what to type.
    """
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise InputError("workers: needs Dask; pip install 'advsearch[dask]', or leave `workers` out") from None


def check_main() -> None:
    """Check that workers on this machine can import the script that runs: each does, as `multiprocessing` has it.

    Raises:
        InputError: a script asks outside of `if __name__ == "__main__":`, so that each worker would ask again.
    """
    main, name = sys.modules["__main__"], '`if __name__ == "__main__":`'
    spec, file = getattr(main, "__spec__", None), getattr(main, "__file__", None)
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    while frame is not None and not (frame.f_code.co_name == "<module>" and frame.f_globals is vars(main)):
        frame = frame.f_back
    if file is None or frame is None or (spec is not None and spec.name.endswith("__main__")):
        return
    try:
        tree = ast.parse(Path(file).read_text(encoding="utf-8"))
    except OSError:
        raise InputError(f"workers: expected a script that they can import, got {file}; put it into a file") from None
    except (ValueError, SyntaxError):
        return
    line, guards = frame.f_lineno, ("__name__", "parent_process", "current_process")
    for one in (node for node in ast.walk(tree) if isinstance(node, ast.If) and node.lineno <= line):
        leaves = any(isinstance(part, ast.NotEq) for part in ast.walk(one.test))  # where it is imported
        if (leaves or line <= (one.end_lineno or 0)) and any(guard in ast.unparse(one.test) for guard in guards):
            return
    raise InputError(
        f"workers: expected {file} to ask under {name}, got a call outside of it, in line {line}; put it there: "
        "every worker imports the script and would ask again"
    )


def work_key(work: Work, files: Files) -> str:
    """Return a name of a work by its content."""
    said = [work.function, work.settings, work.threads, sorted(files.named.items())]
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:32]


def place_of(workers: int | None, cluster: str | None) -> Site:
    """Return where the workers are.

    Args:
        workers: how many processes; None for one a core, or as many as there are.
        cluster: a scheduler's address, "local", or a YAML file; None for this machine.

    Raises:
        InputError: no such form, or a number of workers beside a scheduler that runs.
        FileFormatError: the file is missing or says something else.
    """
    if cluster is None or cluster == LOCAL:
        check_main()
        return local(workers or threads.cores())
    if cluster.startswith(SCHEMES):
        if workers is not None:
            raise InputError("workers: the scheduler of `cluster` says how many there are; leave one of the two out")
        return Site(cluster, address=cluster)
    path = Path(cluster)
    if path.suffix not in (".yaml", ".yml"):
        raise InputError(
            f"cluster: expected the address of a scheduler such as tcp://10.0.0.1:8786, local, or a .yaml file, got "
            f"{cluster!r}"
        )
    return _from_file(path, workers)


def _from_file(path: Path, workers: int | None) -> Site:
    said = read_yaml(path)
    unknown = sorted(set(said) - {"address", "class", "arguments", "workers", "security"})
    if unknown or ("address" in said) == ("class" in said):
        got = f"got {', '.join(map(str, unknown))}" if unknown else "got both or neither"
        raise FileFormatError(
            f"{path}: expected either address, or class with arguments and workers; beside it security; {got}"
        )
    security, arguments = (_mapping(path, said, name) for name in ("security", "arguments"))
    for name in ("tls_ca_file", "tls_client_cert", "tls_client_key", "tls_scheduler_cert", "tls_scheduler_key"):
        if isinstance(security.get(name), str):
            security[name] = str(path.parent / security[name])
    count = workers if workers is not None else said.get("workers")
    if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
        raise FileFormatError(f"{path}: workers: expected a whole number of at least 1, got {count!r}")
    if "address" in said:
        if not str(said["address"]).startswith(SCHEMES):
            raise FileFormatError(f"{path}: address: expected tcp://HOST:PORT or tls://HOST:PORT")
        if count is not None:
            raise InputError("workers: the scheduler of `cluster` says how many there are; leave one of the two out")
        return Site(str(said["address"]), address=str(said["address"]), security=security or None)
    name = str(said["class"])
    if name not in CLASSES:
        raise FileFormatError(f"{path}: class: expected one of {', '.join(CLASSES)}, got {name!r}")
    module = CLASSES[name]
    try:
        found = getattr(importlib.import_module(module), name)
    except ImportError:
        package = module.partition(".")[0].replace("_", "-")
        raise InputError(f"cluster: {name} needs {package}; pip install {package}") from None
    return Site(name, start=lambda **more: found(**{**arguments, **more}), security=security or None, count=count or 1)


def _mapping(path: Path, said: Mapping[str, Any], name: str) -> dict[str, Any]:
    given = said.get(name) or {}
    if not isinstance(given, dict) or not all(isinstance(key, str) for key in given):
        raise FileFormatError(f"{path}: {name}: expected names and values, got {given!r}")
    return dict(given)
