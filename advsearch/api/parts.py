"""The attacks of a `gap` on workers: each in a folder on the worker's own disk, which comes back as files.

An attack that this process has begun itself stays its own. What is shared are whole attacks, so that one whose worker
died begins again.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from advsearch.api.attack import attack_once
from advsearch.cluster.executor import Call, Work
from advsearch.cluster.opening import executor_of
from advsearch.config import AttackConfig, GapConfig
from advsearch.engine.naming import different
from advsearch.engine.run_settings import RunSettings
from advsearch.errors import ClusterError
from advsearch.files import JsonObject
from advsearch.progress import Progress
from advsearch.runs import lock
from advsearch.runs.directory import PARTS, default_name, is_run
from advsearch.runs.files import PART, storage_errors, write_bytes
from advsearch.settings import FILES

LONGEST = 6 * 3600.0
"""Seconds that one attack may take on a worker before it counts as hanging."""

TEXTS = (".json", ".html", ".yaml")
"""Files that may say where the run is."""


@dataclass(frozen=True)
class GapAttack:
    """One attack of a gap.

    Attributes:
        object: its name.
        control: the only one that is searched.
        config: what the attack is carried out with.
        name: of its folder.
    """

    object: str
    control: str
    config: AttackConfig
    name: str


def parts_of(config: GapConfig) -> list[GapAttack]:
    """Return the attacks of a gap: every object with every control.

    Raises:
        InputError: a setting that none of the controls takes.
    """
    shared = RunSettings(config.epsilon, config.norm, config.texture_resolution)
    shared.check(config.controls, config.over)
    parts = []
    for place, name in enumerate(different(config.objects, "object")):
        for number, (control, settings) in enumerate(config.controls.items()):
            own = vars(shared.alone(control, settings))
            one = AttackConfig.of(config, object=name, controls={control: settings}, **own)
            parts.append(GapAttack(name, control, one, f"{place:02d}-{number:02d}-" + default_name(name, [control])))
    return parts


def attacks_of(settings: JsonObject) -> Call:
    """Return what carries out the attacks of the gap that the settings describe: what a worker does."""
    parts = parts_of(GapConfig(**settings))

    def call(numbers: range) -> tuple[str, dict[str, bytes]]:
        part = parts[numbers.start]
        with tempfile.TemporaryDirectory(prefix="advsearch-part-") as folder:
            path = Path(folder) / part.name
            attack_once(part.config.model_copy(update={"run": str(path), "overwrite": True}))
            files = (one for one in path.rglob("*") if one.is_file() and one.name != lock.NAME)
            return str(path), {one.relative_to(path).as_posix(): one.read_bytes() for one in files}

    return call


def share(config: GapConfig, parts: Sequence[GapAttack], run: Path, progress: Progress) -> None:
    """Have the attacks that are not begun carried out by workers, where some were asked for.

    Args:
        config: of the gap.
        parts: its attacks.
        run: its folder, which gets theirs.
        progress: told how far it is.

    Raises:
        ClusterError: every worker died of an attack, or there are none.
    """
    left = [number for number, part in enumerate(parts) if not is_run(run / PARTS / part.name)]
    settings = config.to_repeat().model_copy(update={"workers": None, "cluster": None}).plain()
    threads = config.used_threads or 1
    work = Work("advsearch.api.parts:attacks_of", settings, FILES, threads, seconds=LONGEST, ahead=False)
    workers, cluster = (config.workers, config.cluster) if left else (None, None)
    with executor_of(work, workers=workers, cluster=cluster, tell=progress.message) as executor:
        if executor is None:
            return
        progress.stage("attacks on workers", len(left))
        for done in executor.results(range(number, number + 1) for number in left):
            part = parts[done.numbers.start]
            if done.lost:
                raise ClusterError(f"{part.object} with {part.control}: {done.lost}; leave it out, or go on without it")
            place, files = done.value
            _place(run / PARTS, part.name, place, files)
            facts = executor.facts
            progress.advance(1, **({} if facts is None else {"workers": facts.workers}))


def _place(folder: Path, name: str, before: str, files: Mapping[str, bytes]) -> None:
    """Write the files of an attack that was carried out in another folder, whole or not at all."""
    path, part = folder / name, folder / f"{PART}{name}"
    with storage_errors(path):
        for relative, data in files.items():
            if relative.endswith(TEXTS):
                data = data.replace(before.encode(), str(path).encode())
            (part / relative).parent.mkdir(parents=True, exist_ok=True)
            write_bytes(part / relative, data)
        part.rename(path)
