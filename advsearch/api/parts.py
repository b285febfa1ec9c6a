"""The attacks of a study on workers: each in a folder on the worker's own disk, which comes back as files.

An attack that this process has begun itself stays its own. What is shared are whole attacks, in a curve all those of an
object, so that one whose worker died begins again.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from advsearch.api.attack import attack_once
from advsearch.cluster.executor import Call, Work
from advsearch.cluster.opening import executor_of
from advsearch.config import CONFIGS, AttackConfig, GapConfig
from advsearch.engine import run_settings
from advsearch.engine.naming import different
from advsearch.engine.transport import CleanMatrix
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


SETTLED = ("found", "already wrong")
"""Endings after which an object is not attacked with a larger epsilon."""

ALL = "all"
"""What an ensemble is called among the models that were attacked."""


@dataclass(frozen=True)
class StudyAttack:
    """One attack of a study.

    Attributes:
        config: what the attack is carried out with.
        name: of its folder.
        of: what tells it from the others: an object, a control of it, or a model.
        epsilon: that of a curve; None where there is one for all.
    """

    config: AttackConfig
    name: str
    of: str
    epsilon: float | None = None

    @property
    def title(self) -> str:
        """What it is, in words."""
        return self.config.object + ("" if self.of == self.config.object else f" with {self.of}")


Chain = list[StudyAttack]
"""Attacks that follow one another, until one finds something."""


def chains_of(config: AttackConfig) -> list[Chain]:
    """Return the attacks of a study: of a gap, a matrix or a curve.

    Raises:
        InputError: a setting that none of the controls takes, or a name comes twice.
    """
    if isinstance(config, GapConfig):
        return [[one] for one in _controls_of(config)]
    return [[one] for one in _models_of(config)] if config.is_matrix else _objects_of(config)


def _controls_of(config: GapConfig) -> Chain:
    """Every object with every control."""
    run_settings.check(config)
    attacks = []
    for place, name in enumerate(different(config.objects, "object")):
        for number, (control, settings) in enumerate(config.controls.items()):
            own = run_settings.alone(config, control, settings)
            one = AttackConfig.of(config, object=name, controls={control: settings}, **own)
            attacks.append(StudyAttack(one, f"{place:02d}-{number:02d}-" + default_name(name, [control]), control))
    return attacks


def _models_of(config: AttackConfig) -> Chain:
    """Every model, or all of them together."""
    names = different(config.models, "model")
    own = [(ALL, {})] if config.ensemble else [(name, {"model": name}) for name in names]
    return [
        StudyAttack(AttackConfig.of(config, **more), f"{place:02d}-" + default_name(name, []), name)
        for place, (name, more) in enumerate(own)
    ]


def _objects_of(config: AttackConfig) -> list[Chain]:
    """Every object with every epsilon, from the smallest."""
    chains: list[Chain] = []
    for place, name in enumerate(different(config.objects, "object")):
        chains.append([])
        epsilons: list[float | None] = [*sorted(config.epsilons)] or [None]
        for epsilon in epsilons:
            words = [] if epsilon is None else [f"epsilon {epsilon:g}".replace(".", "_")]
            one = AttackConfig.of(config, object=name, epsilon=config.epsilon if epsilon is None else epsilon)
            chains[-1].append(StudyAttack(one, f"{place:02d}-" + default_name(name, words), name, epsilon))
    return chains


def attacks_of(settings: JsonObject) -> Call:
    """Return what carries out the attacks of the study that the settings describe: what a worker does."""
    config = CONFIGS[str(settings["command"])](**{k: v for k, v in settings.items() if k != "command"})
    assert isinstance(config, AttackConfig)
    chains = chains_of(config)

    def call(numbers: Sequence[int]) -> list[tuple[str, str, dict[str, bytes]]]:
        found, clean = [], CleanMatrix()
        with tempfile.TemporaryDirectory(prefix="advsearch-part-") as folder:
            for part in chains[numbers[0]]:
                path = Path(folder) / part.name
                own = part.config.model_copy(update={"run": str(path), "overwrite": True})
                ending = attack_once(own, clean=clean).summary.ending
                files = (one for one in path.rglob("*") if one.is_file() and one.name != lock.NAME)
                read = {one.relative_to(path).as_posix(): one.read_bytes() for one in files}
                found.append((part.name, str(path), read))
                if ending in SETTLED:
                    break
        return found

    return call


def share(config: AttackConfig, chains: Sequence[Chain], run: Path, progress: Progress) -> None:
    """Have the attacks that are not begun carried out by workers, where some were asked for.

    Args:
        config: of the study.
        chains: its attacks.
        run: its folder, which gets theirs.
        progress: told how far it is.

    Raises:
        ClusterError: every worker died of an attack, or there are none.
    """
    left = [number for number, chain in enumerate(chains) if not any(is_run(run / PARTS / one.name) for one in chain)]
    plain = config.to_repeat().model_copy(update={"workers": None, "cluster": None}).plain()
    settings, threads = {"command": config.command, **plain}, config.used_threads or 1
    work = Work("advsearch.api.parts:attacks_of", settings, FILES, threads, seconds=LONGEST, ahead=False)
    workers, cluster = (config.workers, config.cluster) if left else (None, None)
    with executor_of(work, workers=workers, cluster=cluster, tell=progress.message) as executor:
        if executor is None:
            return
        progress.stage("attacks on workers", len(left))
        for done in executor.results([number] for number in left):
            if done.lost:
                title = chains[done.items[0]][0].title
                raise ClusterError(f"{title}: {done.lost}; leave it out, or go on without it")
            for name, place, files in done.value:
                _place(run / PARTS, name, place, files)
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
