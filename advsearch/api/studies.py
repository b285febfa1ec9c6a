"""Studies: questions that take several attacks, each in a folder of its own in the run, on workers if asked to.

A part is carried out in its folder, gone on with, or read where it is done. A worker carries an attack out in a folder
on its own disk, which comes back as files. An attack that this process has begun itself stays its own. What is shared
are whole attacks, in a curve all those of an object, so that one whose worker died begins again.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from advsearch import rooms
from advsearch.api import carry_out
from advsearch.cluster import Call, Work
from advsearch.cluster.dask_pool import executor_of
from advsearch.config import CONFIGS, AttackConfig
from advsearch.engine.attack_result import AttackResult
from advsearch.engine.judging import one_label_for_several
from advsearch.engine.naming import check_run_settings, different, load_models, settings_alone
from advsearch.engine.transport import CleanMatrix
from advsearch.errors import ClusterError
from advsearch.files import JsonObject
from advsearch.progress import Progress
from advsearch.question import Asked
from advsearch.runs import files
from advsearch.runs.directory import CONFIG, PARTS, default_name, is_run
from advsearch.runs.files import PART, storage_errors, write_bytes
from advsearch.runs.listing import finished
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.base import INTERRUPTED, Result
from advsearch.runs.summary import attack_of, read_result
from advsearch.scene.library import list_objects, load_object
from advsearch.settings import FILES, Config
from advsearch.tasks import make_task


def carry_out_part(path: Path, config: Config, progress: Progress) -> Result:
    """Return the result of the part in the folder `path`; what is done of it is not done again. The configuration is
    what it does, where it has not begun."""
    if not is_run(path) or not (path / CONFIG).is_file():
        return carry_out(config.model_copy(update={"run": str(path), "overwrite": True}), progress=progress)
    if finished(path):
        return read_result(path)
    return carry_out(type(config).from_yaml(path / CONFIG, config.asked), progress=progress, resumed=path)


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
    """One attack of a study: what it is carried out with, the name of its folder, and what tells it from the others: an
    object, a control of it, or a model. The epsilon is that of a curve, or None."""

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
    if config.command == "gap":
        return _controls_of(config)
    if not config.is_matrix:
        return _objects_of(config)
    names = different(config.models, "model")
    own = [(ALL, {})] if config.ensemble else [(name, {"model": name}) for name in names]
    return [
        [StudyAttack(AttackConfig.of(config, **more), f"{place:02d}-" + default_name(name, []), name)]
        for place, (name, more) in enumerate(own)
    ]


def _controls_of(config: AttackConfig) -> list[Chain]:
    check_run_settings(config)
    attacks = []
    for place, name in enumerate(different(config.objects, "object")):
        for number, (control, settings) in enumerate(config.controls.items()):
            own = settings_alone(config, control, settings)
            one = AttackConfig.of(config, object=name, controls={control: settings}, **own)
            attacks.append([StudyAttack(one, f"{place:02d}-{number:02d}-" + default_name(name, [control]), control)])
    return attacks


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


def attack_once() -> Callable[..., AttackResult]:
    """Return what carries out one attack, of the room that attacks."""
    found: Callable[..., AttackResult] = rooms.in_room("attack", "carry_out", "attack_once")
    return found


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
                ending = attack_once()(own, clean=clean).summary.ending
                kept = (one for one in path.rglob("*") if one.is_file() and one.name != files.NAME)
                read = {one.relative_to(path).as_posix(): one.read_bytes() for one in kept}
                found.append((part.name, str(path), read))
                if ending in SETTLED:
                    break
        return found

    return call


def share(config: AttackConfig, chains: Sequence[Chain], run: Path, progress: Progress) -> None:
    """Have the attacks of a study that are not begun carried out by workers into its folder, where some were asked for.
    Raises ClusterError: every worker died of an attack, or there are none."""
    left = [number for number, chain in enumerate(chains) if not any(is_run(run / PARTS / one.name) for one in chain)]
    plain = config.to_repeat().model_copy(update={"workers": None, "cluster": None}).plain()
    settings, threads = {"command": config.command, **plain}, config.used_threads or 1
    work = Work("advsearch.api.studies:attacks_of", settings, FILES, threads, seconds=LONGEST)
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


# ---- one study ------------------------------------------------------------------------------------------------------


def _label_for_all(config: AttackConfig) -> list[str]:
    """What there is to say where several bundled objects have one label."""
    if config.label is None or len(config.objects) < 2:
        return []
    bundled = list_objects()
    own = {name: load_object(name).label if name in bundled else None for name in config.objects}
    models, _ = load_models([config.model], make_task(config.task), config)
    return one_label_for_several(models, config.label, own)


class StudyRun:
    """Carries out attacks, each in a folder of its own, unless they are done already; first on workers, if asked to.

    `chains` are all that there are, `names` are of those so far, and `warnings` what they said, each sentence once.
    After an interrupt nothing more is carried out.
    """

    def __init__(self, asked: Asked[AttackConfig]) -> None:
        self.asked, self.run, self.progress = asked, asked.run, asked.progress
        self.warnings = _label_for_all(asked.config)
        for text in self.warnings:
            self.progress.message(text)
        self.chains = chains_of(asked.config)
        self.names: list[str] = []
        with asked.until_interrupted():
            share(asked.config, self.chains, self.run.path, self.progress)

    @property
    def interrupted(self) -> bool:
        """Whether there was an interrupt."""
        return self.asked.ending == INTERRUPTED

    def attack(self, one: StudyAttack, clean: CleanMatrix | None = None) -> AttackSummary | None:
        """Return the summary of one attack, or None if there was an interrupt; `clean` as for `attack_once`."""
        if self.interrupted:
            return None
        config, path = one.config, self.run.path / PARTS / one.name
        self.names.append(one.name)
        budget = f", epsilon {config.epsilon:.3g}" if isinstance(config.epsilon, float) else ""
        what = f"{config.object} against {config.model}, {' and '.join(config.controls)}{budget}"
        self.progress.message(f"attack {len(self.names)} of at most {sum(map(len, self.chains))}: {what}")
        if is_run(path) and (path / CONFIG).is_file():
            began = None if finished(path) else AttackConfig.from_yaml(path / CONFIG, config.asked)
            summary = (
                attack_once()(began, progress=self.progress, resumed=path, clean=clean).summary
                if began
                else attack_of(path)
            )
        else:
            own = config.model_copy(update={"run": str(path), "overwrite": True})
            summary = attack_once()(own, progress=self.progress, clean=clean).summary
        self.warnings += [text for text in summary.warnings if text not in self.warnings]
        if summary.ending == INTERRUPTED:
            self.asked.ending = INTERRUPTED
        return None if self.interrupted else summary
