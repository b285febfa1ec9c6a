"""Studies: questions that take several attacks, each in a folder of its own in the run,
on workers if asked to.

A part is carried out in its folder, gone on with, or read where it is done. A worker
carries an attack out in a folder on its own disk, which comes back as files. An attack
that this process has begun itself stays its own. What is shared are whole attacks, in a
curve all those of an object, so that one whose worker died begins again.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch

from advsearch import seeds
from advsearch.attacks.verification import WORST_CASE
from advsearch.cluster import Call, WorkerTask
from advsearch.cluster.workers import open_workers
from advsearch.engine.journal import worker_call
from advsearch.engine.judging import one_label_for_several
from advsearch.engine.naming import different, load_models
from advsearch.engine.record import control_group, verified_rate
from advsearch.engine.transport import CleanMatrix
from advsearch.engine.verifier import RetrialCondition, Retrials
from advsearch.errors import ClusterError, FileFormatError
from advsearch.experiment import Made, RunContext, run_part
from advsearch.files import JsonObject
from advsearch.progress import Progress
from advsearch.questions.attack import carry_out as attacking
from advsearch.questions.attack import summary as results
from advsearch.questions.attack.run import attack_once
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.summary import AttackSummary, CurveResult, MatrixResult
from advsearch.runs.directory import PARTS, default_name, is_run
from advsearch.runs.results import INTERRUPTED
from advsearch.runs.summary import read_configuration
from advsearch.scene.library import list_objects, load_object
from advsearch.settings import FILES
from advsearch.statistics.intervals import clopper_pearson
from advsearch.tasks import make_task
from advsearch.trust.writing import LOCK, PART, storage_errors, write_bytes

# Seconds that one attack may take on a worker before it counts as hanging
LONGEST = 6 * 3600.0
TEXTS = (".json", ".html", ".yaml")  # Files that may say where the run is
# Endings after which an object is not attacked with a larger epsilon
SETTLED = ("found", "already wrong")
ALL = "all"  # What an ensemble is called among the models that were attacked


@dataclass(frozen=True)
class StudyAttack:
    """One attack of a study: what it is carried out with, the name of its folder, and
    what tells it from the others: an object or a model. The epsilon is that of a curve,
    or None.
    """

    config: AttackConfig
    name: str
    of: str
    epsilon: float | None = None


Chain = list[StudyAttack]  # Attacks that follow one another, until one finds something


def chains_of(config: AttackConfig) -> list[Chain]:
    """Return the attacks of a study: of a matrix or a curve. Raises InputError where a
    name comes twice.
    """
    chains: list[Chain] = []
    if config.is_matrix:
        names = different(config.models, "model")
        for place, name in enumerate([ALL] if config.ensemble else names):
            alone = AttackConfig.of(
                config, **({} if config.ensemble else {"model": name})
            )
            chains.append(
                [StudyAttack(alone, f"{place:02d}-" + default_name(name, []), name)]
            )
    else:
        # None is the own of each control
        epsilons: list[float | None] = [*sorted(config.epsilons)] or [None]
        for place, name in enumerate(different(config.objects, "object")):
            chains.append([])
            for epsilon in epsilons:
                words = (
                    []
                    if epsilon is None
                    else [f"epsilon {epsilon:g}".replace(".", "_")]
                )
                changed = AttackConfig.of(
                    config,
                    object=name,
                    epsilon=config.epsilon if epsilon is None else epsilon,
                )
                chains[-1].append(
                    StudyAttack(
                        changed,
                        f"{place:02d}-" + default_name(name, words),
                        name,
                        epsilon,
                    )
                )
    return chains


def attacks_of(settings: JsonObject) -> Call:
    """Return what carries out the attacks of the study that the settings describe: what
    a worker does.
    """
    chains = chains_of(AttackConfig(**settings))

    def call(numbers: Sequence[int]) -> list[tuple[str, str, dict[str, bytes]]]:
        carried_out = []
        clean = CleanMatrix()
        with tempfile.TemporaryDirectory(prefix="advsearch-part-") as folder:
            for part in chains[numbers[0]]:
                path = Path(folder) / part.name
                config_there = part.config.model_copy(
                    update={"run": str(path), "overwrite": True}
                )
                ending = attack_once(config_there, clean=clean).summary.ending
                kept = (
                    file
                    for file in path.rglob("*")
                    if file.is_file() and file.name != LOCK
                )
                read = {
                    file.relative_to(path).as_posix(): file.read_bytes()
                    for file in kept
                }
                carried_out.append((part.name, str(path), read))
                if ending in SETTLED:
                    break
        return carried_out

    return call


def share(
    config: AttackConfig, chains: Sequence[Chain], run: Path, progress: Progress
) -> None:
    """Have the attacks of a study that are not begun carried out by workers into its
    folder, where some were asked for. Raises ClusterError: every worker died of an
    attack, or there are none.
    """
    left = [
        number
        for number, chain in enumerate(chains)
        if not any(is_run(run / PARTS / part.name) for part in chain)
    ]
    settings = (
        config.to_repeat().model_copy(update={"workers": None, "cluster": None}).plain()
    )
    threads = config.used_threads or 1
    work = WorkerTask(
        "advsearch.questions.attack.studies:attacks_of",
        settings,
        FILES,
        threads,
        seconds=LONGEST,
    )
    workers, cluster = (config.workers, config.cluster) if left else (None, None)
    with open_workers(
        work, workers=workers, cluster=cluster, tell=progress.message
    ) as executor:
        if executor is None:
            return
        progress.stage("attacks on workers", len(left))
        for done in executor.results([number] for number in left):
            if done.lost:
                (lost, *_) = chains[done.items[0]]
                title = lost.config.object + (
                    "" if lost.of == lost.config.object else f" with {lost.of}"
                )
                raise ClusterError(
                    f"{title}: {done.lost}; leave it out, or go on without it"
                )
            for name, before, files_there in done.value:
                path = run / PARTS / name
                part = run / PARTS / f"{PART}{name}"
                with storage_errors(path):  # whole or not at all
                    for relative, data in files_there.items():
                        if relative.endswith(TEXTS):
                            data = data.replace(before.encode(), str(path).encode())
                        (part / relative).parent.mkdir(parents=True, exist_ok=True)
                        write_bytes(part / relative, data)
                    part.rename(path)
            facts = executor.facts
            progress.advance(1, **({} if facts is None else {"workers": facts.workers}))


class StudyRun:
    """Carries out attacks, each in a folder of its own, unless they are done already;
    first on workers, if asked to.

    `chains` are all that there are, `names` are of those so far, and `warnings` what
    they said, each sentence once. After an interrupt nothing more is carried out.
    """

    def __init__(self, asked: RunContext[AttackConfig]) -> None:
        self.asked = asked
        self.run = asked.run
        self.progress = asked.progress
        config = asked.config
        self.warnings: list[str] = []
        if config.label is not None and len(config.objects) > 1:
            bundled = list_objects()
            labels = {
                name: load_object(name).label if name in bundled else None
                for name in config.objects
            }
            models, _ = load_models([config.model], make_task(config.task), config)
            self.warnings = one_label_for_several(models, config.label, labels)
        for text in self.warnings:
            self.progress.message(text)
        self.chains = chains_of(config)
        self.names: list[str] = []
        with asked.until_interrupted():
            share(config, self.chains, self.run.path, self.progress)

    @property
    def interrupted(self) -> bool:
        return self.asked.ending == INTERRUPTED

    def attack(
        self, study: StudyAttack, clean: CleanMatrix | None = None
    ) -> AttackSummary | None:
        if self.interrupted:
            return None
        config = study.config
        path = self.run.path / PARTS / study.name
        self.names.append(study.name)
        budget = (
            f", epsilon {config.epsilon:.3g}"
            if isinstance(config.epsilon, float)
            else ""
        )
        what = (
            f"{config.object} against {config.model}, "
            f"{' and '.join(config.controls)}{budget}"
        )
        self.progress.message(
            f"attack {len(self.names)} of at most {sum(map(len, self.chains))}: {what}"
        )

        def ask(there: AttackConfig, **more: Any) -> AttackSummary:
            return attack_once(there, clean=clean, **more).summary

        summary = run_part(path, config, self.progress, ask)
        if not isinstance(summary, AttackSummary):
            raise FileFormatError(
                f"{path}: expected the run of an attack, got one of {summary.command}"
            )
        self.warnings += [
            text for text in summary.warnings if text not in self.warnings
        ]
        if summary.ending == INTERRUPTED:
            self.asked.ending = INTERRUPTED
        return None if self.interrupted else summary

    def result(self, kind: type[Made], **fields: Any) -> Made:
        return self.asked.result(
            kind, parts=self.names, warnings=self.warnings, **fields
        )


def curve(asked: RunContext[AttackConfig]) -> CurveResult:
    """Robust accuracy against epsilon, over objects.

    The epsilons are tried from the smallest. An object that flips at one of them flips
    at every larger one, whose ball has the same configuration in it, so it is not
    attacked again. An object that is wrong as it is counts as not robust at any
    epsilon, and is told apart from those that were found.
    """
    study = StudyRun(asked)
    rows = []
    for chain in study.chains:
        row = results.ObjectRow(object=chain[0].of, clean=None, flips_at=None)
        clean = CleanMatrix()
        renders: Counter[str] = Counter()
        for part in chain:
            summary = study.attack(part, clean)
            if summary is None:
                break
            renders.update(summary.renders)
            epsilon = summary.epsilon if part.epsilon is None else part.epsilon
            row = results.ObjectRow(
                object=part.of,
                clean=summary.clean.control,
                ending=summary.ending,
                epsilon=epsilon,
                flips_at=epsilon if summary.ending == "found" else None,
                verified=summary.verified,
                margin=summary.verified and summary.verified.margin,
                run=summary.run,
                tried=part.epsilon,
                average=summary.average,
                renders=dict(renders),
            )
            if row.ending in SETTLED:
                break
        rows.append(row)
    epsilons: list[float | None] = [*sorted(asked.config.epsilons)] or [None]
    points = [_accuracy(rows, epsilon) for epsilon in epsilons]
    return study.result(CurveResult, epsilons=epsilons, table=rows, curve=points)


def _known(row: results.ObjectRow, epsilon: float | None) -> bool:
    """Whether a row says anything about an epsilon: it was tried there, or had flipped
    before. What ended without a number does not, nor an object whose own noise makes it
    wrong too often for any scene to be verified.
    """
    if row.ending in (None, "non-finite objective"):
        return False
    if row.ending in SETTLED:
        return True
    steady = row.clean is not None and row.clean.correct >= WORST_CASE.needed(
        row.clean.trials
    )
    return steady and (
        epsilon is None or (row.tried is not None and row.tried >= epsilon)
    )


def _accuracy(
    rows: Sequence[results.ObjectRow], epsilon: float | None
) -> results.CurvePoint:
    known = [row for row in rows if _known(row, epsilon)]
    wrong = sum(row.ending == "already wrong" for row in known)
    flips = [row.flips_at for row in known if row.ending == "found"]
    found = sum(
        epsilon is None or (isinstance(flips_at, float) and flips_at <= epsilon)
        for flips_at in flips
    )
    robust = len(known) - wrong - found
    return results.CurvePoint(
        epsilon=epsilon, objects=len(known), robust=robust, found=found, already_wrong=wrong,
        accuracy=robust / len(known) if known else None,
        interval=clopper_pearson(robust, len(known)) if known else (0.0, 1.0),
    )  # fmt: skip


# Samples a pixel of the trials, where none of the attacks needed more and nothing was
# asked for
LEAST_SPP = 64


def matrix(asked: RunContext[AttackConfig]) -> MatrixResult:
    """Attack several models, and try every adversarial scene on each of them in
    pictures that are the same for all.

    Trial k has the same seed for every scene and every model, and none that a search or
    its verification has used. Models of one input size are shown the same picture; for
    another size the same configuration is rendered anew. A success needs the model to
    be right on the clean scene with the same seed, as everywhere.
    """
    config = asked.config
    names = different(asked.config.models, "model")
    asked.progress.stage(attacking.LOADING)
    for name in names:
        attacking.check_from_config(_alone(config, name))

    study = StudyRun(asked)
    summaries = {part.of: study.attack(part) for (part,) in study.chains}
    attacked = {
        name: summary for name, summary in summaries.items() if summary is not None
    }
    models: list[results.MatrixModel] = []
    cells: dict[str, list[results.MatrixCell]] = {}
    configurations = {  # of those in which something was searched
        name: torch.from_numpy(read_configuration(Path(summary.run)))
        for name, summary in attacked.items()
        if summary.adversarial is not None and summary.run is not None
    }
    if configurations and not study.interrupted:
        counts = [
            summary.sample_count.spp
            for summary in attacked.values()
            if summary.sample_count
        ]
        spp = config.verify_spp or max([LEAST_SPP, *counts])
        worker = "advsearch.questions.attack.studies:models_worker"
        with asked.until_interrupted():
            study.progress.stage("loading the models to try the scenes on")
            conditions = []
            for name in names:
                problem, _ = attacking.problem_from_config(_alone(config, name))
                conditions.append(
                    RetrialCondition(
                        name, problem, spp, problem.renderer.formation.resolution
                    )
                )
            seed = seeds.stream(config.seed, "matrix")
            trials = config.trial_count
            with attacking.executor_for(config, worker, study.progress) as executor:
                retrials = Retrials(
                    conditions,
                    study.run,
                    study.progress,
                    trials=trials,
                    seed=seed,
                    executor=executor,
                )
                each = trials * len(names)
                hint = f"{each} predictions; `trials` or `verify_spp` shorten it"
                study.progress.stage(
                    "trying the clean scene on every model", each, hint=hint
                )
                models = [
                    results.MatrixModel(
                        model=condition.name,
                        labels=list(
                            condition.problem.task.truth_names(
                                condition.problem.truth()
                            )
                        ),
                        input_size=condition.problem.renderer.formation.resolution,
                        spp=condition.spp,
                        clean=control_group(retrials.clean(condition), condition.spp),
                    )
                    for condition in conditions
                ]
                for name, u in configurations.items():
                    study.progress.stage(
                        f"trying the scene against {name} on every model",
                        each,
                        hint=hint,
                    )
                    tried = {
                        condition.name: retrials.adversarial(name, u, condition)
                        for condition in conditions
                    }
                    cells[name] = [
                        results.MatrixCell(
                            model=model,
                            ending=checked.ending.value,
                            verified=verified_rate(checked),
                        )
                        for model, checked in tried.items()
                    ]
    rows = [
        results.MatrixRow(
            attacked=name,
            ending=by.ending,
            run=by.run,
            renders=by.renders,
            tested=cells.get(name, []),
        )
        for name, by in attacked.items()
    ]
    return study.result(
        MatrixResult,
        models=list(names),
        ensemble=config.ensemble,
        tested=models,
        table=rows,
    )


def models_worker(settings: JsonObject) -> Call:
    """Return what evaluates queries of the models of a configuration: what a worker
    does.
    """
    config = AttackConfig(**settings)
    return worker_call(
        cache(lambda name: attacking.problem_from_config(_alone(config, name))[0])
    )


def _alone(config: AttackConfig, name: str) -> AttackConfig:
    return AttackConfig.of(config, model=name, ensemble=None)
