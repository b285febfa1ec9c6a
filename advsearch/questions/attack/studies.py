"""Studies: several attacks, each in a directory of its own.

An attack is made in its directory, continued if it was interrupted, or read if it is
done. A worker makes an attack in a directory on its own disk, and returns the files. A
worker gets full attacks; in a curve, it gets all attacks on an object. If the worker
dies, they begin again. An attack that this process has begun is not given to a worker.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks.verification import WORST_CASE
from advsearch.cluster import BatchFunction, BatchResult, Workers, WorkerTask
from advsearch.cluster.workers import open_workers
from advsearch.engine.journal import make_worker_call
from advsearch.engine.judging import find_label_warnings
from advsearch.engine.naming import check_distinct, load_models
from advsearch.engine.prediction import CleanMatrix
from advsearch.engine.problem import Problem
from advsearch.engine.record import make_control_group, make_verified_rate
from advsearch.engine.verifier import RetrialCondition, Retrials
from advsearch.errors import ClusterError, FileFormatError
from advsearch.experiment import ResultType, RunContext, run_part
from advsearch.files import JsonObject
from advsearch.progress import Progress
from advsearch.questions.attack.carry_out import (
    LOADING,
    check_from_config,
    open_executor,
    problem_from_config,
)
from advsearch.questions.attack.run import attack_once
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.summary import (
    AttackSummary,
    CurvePoint,
    CurveResult,
    MatrixCell,
    MatrixModel,
    MatrixResult,
    MatrixRow,
    ObjectRow,
)
from advsearch.runs.directory import PARTS, is_run, make_default_name
from advsearch.runs.results import INTERRUPTED
from advsearch.runs.summary import read_configuration
from advsearch.scene.library import list_objects, load_object
from advsearch.settings import FILES
from advsearch.statistics.intervals import clopper_pearson
from advsearch.tasks import make_task
from advsearch.trust.writing import LOCK, PART, storage_errors, write_bytes

MAX_ATTACK_SECONDS = 6 * 3600.0
"""Seconds after which a worker counts as hanging."""
TEXT_SUFFIXES = (
    ".json",
    ".html",
    ".yaml",
)  # files that may contain the path of the run
# endings after which an object is not attacked with a larger epsilon
SETTLED = ("found", "already wrong")
ALL = "all"  # name of the ensemble among the models that were attacked


@dataclass(frozen=True)
class StudyAttack:
    """One attack of a study.

    Attributes:
        config: settings of the attack.
        name: name of its directory.
        object_or_model: the object, in a curve; the attacked model, in a matrix.
        epsilon: epsilon of a curve; None in a matrix, or if each control has its own.
    """

    config: AttackConfig
    name: str
    object_or_model: str
    epsilon: float | None = None


# Attacks that are made in order until an ending in `SETTLED`: in a curve those on an
# object, with growing epsilon. A chain of a matrix has a single attack.
Chain = list[StudyAttack]


def make_chains(config: AttackConfig) -> list[Chain]:
    """Return the attacks of a study, a matrix or a curve, in chains.

    Raises:
        InputError: a model or an object comes twice.
    """
    return _matrix_chains(config) if config.is_matrix else _curve_chains(config)


def _matrix_chains(config: AttackConfig) -> list[Chain]:
    """Return the attacks of a matrix: one for each model, or one on the ensemble.

    Each is a chain of a single attack.

    Args:
        config: settings of the study.

    Raises:
        InputError: a model comes twice.
    """
    names: Sequence[str] = check_distinct(config.models, "model")
    if config.ensemble:
        names = [ALL]
    chains: list[Chain] = []
    for index, name in enumerate(names):
        changes = {} if config.ensemble else {"model": name}
        attack_config = AttackConfig.from_config(config, **changes)
        directory = f"{index:02d}-" + make_default_name(name, [])
        chains.append([StudyAttack(attack_config, directory, object_or_model=name)])
    return chains


def _curve_chains(config: AttackConfig) -> list[Chain]:
    """Return the attacks of each object, with the smallest epsilon first."""
    # None if there is no list of epsilons: then `config.epsilon` stays as it is.
    epsilons: list[float | None] = [*sorted(config.epsilons)] or [None]
    names = check_distinct(config.objects, "object")
    return [
        [_make_curve_attack(config, index, name, epsilon) for epsilon in epsilons]
        for index, name in enumerate(names)
    ]


def _make_curve_attack(
    config: AttackConfig, index: int, name: str, epsilon: float | None
) -> StudyAttack:
    """Return the attack on an object with an epsilon.

    Args:
        config: settings of the study.
        index: index of the object among all objects.
        name: name of the object.
        epsilon: the epsilon; None for that of the settings.
    """
    name_parts = []
    if epsilon is not None:
        name_parts = [f"epsilon {epsilon:g}".replace(".", "_")]
    attack_config = AttackConfig.from_config(
        config,
        object=name,
        epsilon=config.epsilon if epsilon is None else epsilon,
    )
    directory = f"{index:02d}-" + make_default_name(name, name_parts)
    return StudyAttack(attack_config, directory, object_or_model=name, epsilon=epsilon)


def make_chain_worker(settings: JsonObject) -> BatchFunction:
    """Return the function by which a worker makes the attacks of a chain.

    The function takes a batch with a single item, the index of the chain. It returns,
    for each attack, the name of its directory, the path of the directory on the worker,
    and its files by relative path.

    Args:
        settings: settings of the study.
    """
    return partial(_run_chain, make_chains(AttackConfig(**settings)))


def _run_chain(
    chains: Sequence[Chain], batch: Sequence[int]
) -> list[tuple[str, str, dict[str, bytes]]]:
    """Make the attacks of the chain whose index is the only item of a batch.

    See `make_chain_worker` for what is returned.
    """
    finished = []
    clean = CleanMatrix()  # shared by the attacks, which have the same clean scene
    (chain_index,) = batch
    with tempfile.TemporaryDirectory(prefix="advsearch-part-") as directory:
        for study_attack in chains[chain_index]:
            path = Path(directory) / study_attack.name
            changes = {"run": str(path), "overwrite": True}
            config = study_attack.config.model_copy(update=changes)
            ending = attack_once(config, clean=clean).summary.ending
            finished.append((study_attack.name, str(path), _read_files(path)))
            if ending in SETTLED:
                break  # the attacks with larger epsilons are not needed
    return finished


def _read_files(directory: Path) -> dict[str, bytes]:
    """Return the files of a run directory by their relative paths, without its lock."""
    return {
        file.relative_to(directory).as_posix(): file.read_bytes()
        for file in directory.rglob("*")
        if file.is_file() and file.name != LOCK
    }


def distribute_attacks(
    config: AttackConfig, chains: Sequence[Chain], run: Path, progress: Progress
) -> None:
    """Have workers make the attacks of a study that have not begun.

    A worker gets all attacks of a chain at once. If any attack of a chain has begun in
    this process, the chain is left to it. Without workers, nothing is done here.

    Args:
        config: settings of the study.
        chains: all of its attacks, in chains of growing epsilon.
        run: its run directory, which gets the files.
        progress: reports the progress.

    Raises:
        ClusterError: every worker that tried an attack died, or no worker is left.
    """
    missing_chains = _find_missing_chains(chains, run)
    with open_workers(
        _make_study_task(config),
        # without work no workers are started
        workers=config.workers if missing_chains else None,
        cluster=config.cluster if missing_chains else None,
        report_message=progress.message,
    ) as executor:
        if executor is None:  # none are requested: this process makes the attacks
            return
        progress.stage("attacks on workers", len(missing_chains))
        # Each batch is a single chain, so that no chain waits for another one in its
        # batch.
        for result in executor.compute([index] for index in missing_chains):
            _check_not_lost(chains, result)
            for name, worker_path, files in result.value:
                _write_part(run, name, worker_path, files)
            _report_chain(executor, progress)


def _find_missing_chains(chains: Sequence[Chain], run: Path) -> list[int]:
    """Return the indices of the chains of which no attack has begun in a run directory."""
    return [
        index
        for index, chain in enumerate(chains)
        if not any(is_run(run / PARTS / attack.name) for attack in chain)
    ]


def _report_chain(executor: Workers, progress: Progress) -> None:
    """Report that the attacks of a chain are done, and how many workers there are."""
    stats = executor.stats
    worker_counts = {} if stats is None else {"workers": stats.workers}
    progress.advance(1, **worker_counts)


def _make_study_task(config: AttackConfig) -> WorkerTask:
    """Return how workers make the attacks of a study from its settings."""
    in_process = {"workers": None, "cluster": None}  # workers start no workers
    worker_settings = config.make_repeatable().model_copy(update=in_process).to_json()
    return WorkerTask(
        "advsearch.questions.attack.studies:make_chain_worker",
        worker_settings,
        path_setting_names=FILES,
        threads=config.n_used_threads or 1,
        min_timeout_seconds=MAX_ATTACK_SECONDS,
    )


def _check_not_lost(chains: Sequence[Chain], result: BatchResult) -> None:
    """Raise an error if the worker of a chain of attacks died.

    The chain is named by its object, and in a matrix also by the attacked model.
    """
    if result.failure_reason:
        (chain_index,) = result.items  # a batch is a single chain
        first_attack = chains[chain_index][0]  # all have the same object and model
        title = first_attack.config.object
        if first_attack.object_or_model != title:
            title += f" with {first_attack.object_or_model}"
        raise ClusterError(
            f"{title}: {result.failure_reason}; leave it out, or go on without it"
        )


def _write_part(
    run: Path, name: str, worker_path: str, files: dict[str, bytes]
) -> None:
    """Write the files of an attack that a worker made: all of them or none.

    They are written into an unfinished directory, whose name has the prefix `PART`, and
    which is renamed at the end.

    Args:
        run: the run directory of the study.
        name: name of the attack's directory in it.
        worker_path: the directory on the worker; texts that contain it get the new one.
        files: files by their relative paths.
    """
    path = run / PARTS / name
    unfinished_path = run / PARTS / f"{PART}{name}"
    with storage_errors(path):
        for relative_path, data in files.items():
            if relative_path.endswith(TEXT_SUFFIXES):
                data = data.replace(worker_path.encode(), str(path).encode())
            file = unfinished_path / relative_path
            file.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(file, data)
        unfinished_path.rename(path)


class StudyRun:
    """Makes the attacks of a study, each in a directory of its own.

    If workers are requested, they make all attacks first. Attacks that are done are only
    read. After an interrupt no further attack is made.

    Attributes:
        chains: all attacks.
        names: names of the directories of the attacks so far.
        warnings: warnings of these attacks, each sentence once.
    """

    def __init__(self, context: RunContext[AttackConfig]) -> None:
        """Report warnings, and have workers make attacks, if any are requested.

        Args:
            context: settings, run directory and progress of the study.
        """
        self.context = context
        self.run = context.run
        self.progress = context.progress
        config = context.config
        self.warnings = _find_label_warnings(config)
        for text in self.warnings:
            self.progress.message(text)
        self.chains = make_chains(config)
        self.names: list[str] = []
        with context.until_interrupted():
            distribute_attacks(config, self.chains, self.run.path, self.progress)

    @property
    def interrupted(self) -> bool:
        """Whether the study was interrupted."""
        return self.context.ending == INTERRUPTED

    def run_attack(
        self, attack: StudyAttack, clean: CleanMatrix | None = None
    ) -> AttackSummary | None:
        """Make an attack, or read its result.

        Args:
            attack: the attack.
            clean: the matrix of light transport of the clean scene, shared with other
                attacks; None to share none.

        Returns:
            The result; None after an interrupt.

        Raises:
            FileFormatError: its directory has the run of another experiment.
        """
        if self.interrupted:
            return None
        self.names.append(attack.name)
        self._report_attack(attack.config)
        summary = self._make_or_read(attack, clean)
        self.warnings += [
            text for text in summary.warnings if text not in self.warnings
        ]
        if summary.ending == INTERRUPTED:
            self.context.ending = INTERRUPTED  # the study is interrupted, too
            return None
        return summary

    def _report_attack(self, config: AttackConfig) -> None:
        """Report which attack is made now."""
        # None and a mapping by control are not reported.
        budget = ""
        if isinstance(config.epsilon, float):
            budget = f", epsilon {config.epsilon:.3g}"
        n_attacks = sum(map(len, self.chains))
        self.progress.message(
            f"attack {len(self.names)} of at most {n_attacks}: {config.object} against "
            f"{config.model}, {' and '.join(config.controls)}{budget}"
        )

    def _make_or_read(
        self, attack: StudyAttack, clean: CleanMatrix | None
    ) -> AttackSummary:
        """Make an attack, or read its result if it is done; see `run_attack`."""
        path = self.run.path / PARTS / attack.name
        make_attack = partial(_attack_with_matrix, clean)
        summary = run_part(path, attack.config, self.progress, make_attack)
        if not isinstance(summary, AttackSummary):
            raise FileFormatError(
                f"{path}: expected the run of an attack, got one of {summary.command}"
            )
        return summary

    def make_result(self, kind: type[ResultType], **fields: Any) -> ResultType:
        """Return the result of the study.

        Args:
            kind: class of the result.
            **fields: fields of the result, besides those that all results have.
        """
        return self.context.result(
            kind, parts=self.names, warnings=self.warnings, **fields
        )


def _attack_with_matrix(
    clean: CleanMatrix | None, config: AttackConfig, **options: Any
) -> AttackSummary:
    """Make an attack, and return its result.

    Args:
        clean: the matrix of light transport of the clean scene, shared with other
            attacks; None to share none.
        config: settings of the attack.
        **options: keywords of `attack_once`.
    """
    return attack_once(config, clean=clean, **options).summary


def _find_label_warnings(config: AttackConfig) -> list[str]:
    """Return the warnings about a label that several objects share."""
    if config.label is None or len(config.objects) <= 1:
        return []
    bundled = list_objects()  # objects of files have no label of their own
    labels = {
        name: load_object(name).label if name in bundled else None
        for name in config.objects
    }
    models, _ = load_models([config.model], make_task(config.task), config)
    return find_label_warnings(models, config.label, labels)


def curve(context: RunContext[AttackConfig]) -> CurveResult:
    """Measure robust accuracy against epsilon, over objects.

    The epsilons are tried from the smallest. If the prediction of an object flips at
    one of them, it flips at every larger one, too, since a larger ball contains the
    same configuration: so the object is not attacked again. An object whose clean scene
    is wrong already is not robust at any epsilon, and is counted separately.
    """
    study = StudyRun(context)
    rows = [_attack_object(study, chain) for chain in study.chains]
    # None: each control has its own epsilon
    epsilons: list[float | None] = [*sorted(context.config.epsilons)] or [None]
    points = [_compute_accuracy(rows, epsilon) for epsilon in epsilons]
    return study.make_result(CurveResult, epsilons=epsilons, table=rows, curve=points)


def _attack_object(study: StudyRun, chain: Chain) -> ObjectRow:
    """Attack an object with growing epsilons, until an attack settles it.

    An attack settles an object if it finds a wrong prediction, or if the clean scene is
    wrong already.

    Args:
        study: makes the attacks.
        chain: attacks on the object, the smallest epsilon first.

    Returns:
        The row of the last attack, with the renders of all. After an interrupt before
        the first attack, it has the object's name alone.
    """
    row = ObjectRow(object=chain[0].object_or_model, clean=None, flips_at=None)
    clean = CleanMatrix()
    renders: Counter[str] = Counter()
    for attack in chain:
        summary = study.run_attack(attack, clean)
        if summary is None:  # interrupted
            break
        renders.update(summary.renders)
        row = _make_object_row(attack, summary, renders)
        if row.ending in SETTLED:
            break
    return row


def _make_object_row(
    attack: StudyAttack, summary: AttackSummary, renders: Mapping[str, int]
) -> ObjectRow:
    """Return the row of an object after an attack.

    Args:
        attack: the attack.
        summary: its result.
        renders: renders of all attacks on the object so far, by what they are for.
    """
    # Without an epsilon of the curve, each control has its own, which may be a mapping
    # by control.
    epsilon = summary.epsilon if attack.epsilon is None else attack.epsilon
    margin = None
    if summary.verified is not None:
        margin = summary.verified.margin
    return ObjectRow(
        object=attack.object_or_model,
        clean=summary.clean.control,
        ending=summary.ending,
        epsilon=epsilon,
        flips_at=epsilon if summary.ending == "found" else None,
        verified=summary.verified,
        margin=margin,
        run=summary.run,
        tried=attack.epsilon,  # the epsilon of the curve only
        average=summary.average,
        renders=dict(renders),
    )


def _is_known(row: ObjectRow, epsilon: float | None) -> bool:
    """Return whether it is known if an object is robust at an epsilon.

    It is known if the object was attacked with this epsilon or a larger one, if a wrong
    prediction was found, or if the clean scene is wrong already. It is not known if the
    objective was not a number. It is not known either if the model is wrong about the
    clean scene in so many trials that no adversarial scene can be verified.

    Args:
        row: row of the last attack on the object.
        epsilon: the epsilon; None for the own epsilon of each control.
    """
    if row.ending in (None, "non-finite objective"):  # None: no attack was made
        return False
    if row.ending in SETTLED:
        return True
    if row.clean is None:
        return False
    min_correct = WORST_CASE.count_needed_successes(row.clean.trials)
    can_be_verified = row.clean.correct >= min_correct
    if not can_be_verified:
        return False
    return epsilon is None or (row.tried is not None and row.tried >= epsilon)


def _compute_accuracy(rows: Sequence[ObjectRow], epsilon: float | None) -> CurvePoint:
    """Compute the robust accuracy at an epsilon, with its Clopper-Pearson interval.

    Only objects whose robustness at this epsilon is known are counted. If there are
    none, the accuracy is None and the interval is [0, 1].

    Args:
        rows: row of the last attack on each object.
        epsilon: the epsilon; None for the own epsilon of each control.
    """
    known = [row for row in rows if _is_known(row, epsilon)]
    n_objects = len(known)
    n_wrong = sum(row.ending == "already wrong" for row in known)
    n_found = sum(_has_flipped(row, epsilon) for row in known)
    n_robust = n_objects - n_wrong - n_found
    return CurvePoint(
        epsilon=epsilon,
        objects=n_objects,
        robust=n_robust,
        found=n_found,
        already_wrong=n_wrong,
        accuracy=n_robust / n_objects if known else None,
        interval=clopper_pearson(n_robust, n_objects) if known else (0.0, 1.0),
    )


def _has_flipped(row: ObjectRow, epsilon: float | None) -> bool:
    """Return whether a wrong prediction was found within an epsilon.

    Args:
        row: row of the last attack on the object.
        epsilon: the epsilon; None for the own epsilon of each control.
    """
    if row.ending != "found":
        return False
    if epsilon is None:  # the object was attacked with the controls' own epsilons
        return True
    # `flips_at` is a mapping if each control has an epsilon.
    return isinstance(row.flips_at, float) and row.flips_at <= epsilon


# minimum number of samples per pixel of the trials, unless `verify_spp` sets it
MIN_TRIAL_SPP = 64


def matrix(context: RunContext[AttackConfig]) -> MatrixResult:
    """Attack several models, and try every adversarial scene on each of them.

    Trial k has the same seed for every scene and every model; no search or verification
    has used these seeds. Models with the same input size get the same image; for
    another size the same configuration is rendered anew. As in an attack, a trial is a
    success only if the model is right on the clean scene with the same seed. The
    samples per pixel are the setting `verify_spp`. Without it, they are the maximum
    that an attack needed, at least `MIN_TRIAL_SPP`.

    Args:
        context: settings, run directory and progress.
    """
    config = context.config
    names = check_distinct(config.models, "model")
    context.progress.stage(LOADING)
    for name in names:
        check_from_config(_with_model(config, name))  # raises before any attack
    study = StudyRun(context)
    attacked = _attack_models(study)
    # `_try_on_models` fills these: an interrupt leaves what was done before it
    models: list[MatrixModel] = []
    cells: dict[str, list[MatrixCell]] = {}
    configurations = _read_configurations(attacked)
    if configurations and not study.interrupted:
        spp = config.verify_spp or _choose_trial_spp(attacked.values())
        with context.until_interrupted():
            _try_on_models(study, names, spp, configurations, models, cells)
    return study.make_result(
        MatrixResult,
        models=list(names),
        ensemble=config.ensemble,
        tested=models,
        table=_list_matrix_rows(attacked, cells),
    )


def _attack_models(study: StudyRun) -> dict[str, AttackSummary]:
    """Make the attacks of a matrix, and return their results by the attacked model."""
    attacked = dict[str, AttackSummary]()
    for (attack,) in study.chains:  # a chain of a matrix is a single attack
        summary = study.run_attack(attack)
        if summary is not None:  # None: not made, after an interrupt
            attacked[attack.object_or_model] = summary
    return attacked


def _list_matrix_rows(
    attacked: Mapping[str, AttackSummary], cells: Mapping[str, list[MatrixCell]]
) -> list[MatrixRow]:
    """Return the row of each attack, with its cells; both are by the attacked model."""
    return [
        MatrixRow(
            attacked=name,
            ending=summary.ending,
            run=summary.run,
            renders=summary.renders,
            tested=cells.get(name, []),
        )
        for name, summary in attacked.items()
    ]


def _read_configurations(attacked: Mapping[str, AttackSummary]) -> dict[str, Tensor]:
    """Read the adversarial configurations (d,) of attacks that searched, by model."""
    return {
        name: torch.from_numpy(read_configuration(Path(summary.run)))
        for name, summary in attacked.items()
        if summary.adversarial is not None and summary.run is not None
    }


def _choose_trial_spp(summaries: Iterable[AttackSummary]) -> int:
    """Return the samples per pixel that suffice for the trials of several attacks.

    This is the maximum that any of them needed, at least `MIN_TRIAL_SPP`.
    """
    sample_counts = [
        summary.sample_count.spp for summary in summaries if summary.sample_count
    ]
    return max([MIN_TRIAL_SPP, *sample_counts])


def _try_on_models(
    study: StudyRun,
    names: Sequence[str],
    spp: int,
    configurations: Mapping[str, Tensor],
    models: list[MatrixModel],
    cells: dict[str, list[MatrixCell]],
) -> None:
    """Try the clean scene and all adversarial ones on every model.

    Args:
        study: study of the attacks.
        names: names of the models.
        spp: samples per pixel of the trials.
        configurations: (d,) the adversarial ones, by the model that was attacked.
        models: list to fill with what each model predicts of the clean scene.
        cells: mapping to fill with what each model predicts of an adversarial scene, by
            the model that was attacked. What is done before an interrupt stays.
    """
    config = study.context.config
    study.progress.stage("loading the models to try the scenes on")
    conditions = _make_conditions(names, spp, config)
    worker = "advsearch.questions.attack.studies:models_worker"
    with open_executor(config, worker, study.progress) as executor:
        retrials = _make_retrials(study, conditions, executor)
        _begin_trials(study, "trying the clean scene on every model", len(names))
        for condition in conditions:
            models.append(_try_clean(retrials, condition))
        for name, u in configurations.items():
            title = f"trying the scene against {name} on every model"
            _begin_trials(study, title, len(names))
            cells[name] = [
                _try_adversarial(retrials, name, u, condition)
                for condition in conditions
            ]


def _make_retrials(
    study: StudyRun, conditions: Sequence[RetrialCondition], executor: Workers | None
) -> Retrials:
    """Return what makes the trials of a matrix.

    Args:
        study: study of the attacks.
        conditions: what trials need of each model.
        executor: makes the trials; None makes them in this process.
    """
    config = study.context.config
    return Retrials(
        conditions,
        study.run,
        study.progress,
        trials=config.trial_count,
        seed=seeds.derive_seed(config.seed, "matrix"),
        executor=executor,
    )


def _begin_trials(study: StudyRun, title: str, n_models: int) -> None:
    """Report that a scene is tried on all models."""
    n_predictions = study.context.config.trial_count * n_models
    hint = f"{n_predictions} predictions; `trials` or `verify_spp` shorten it"
    study.progress.stage(title, n_predictions, hint=hint)


def _make_conditions(
    names: Sequence[str], spp: int, config: AttackConfig
) -> list[RetrialCondition]:
    """Return what trials need of each model: its problem, the samples and the image size."""
    conditions = []
    for name in names:
        problem, _ = problem_from_config(_with_model(config, name))
        resolution = problem.renderer.formation.resolution
        conditions.append(RetrialCondition(name, problem, spp, resolution))
    return conditions


def _try_clean(retrials: Retrials, condition: RetrialCondition) -> MatrixModel:
    """Try the clean scene on a model, and return how often it is right."""
    problem = condition.problem
    return MatrixModel(
        model=condition.name,
        labels=list(problem.task.truth_names(problem.find_truth())),
        input_size=problem.renderer.formation.resolution,
        spp=condition.spp,
        clean=make_control_group(retrials.run_clean_trials(condition), condition.spp),
    )


def _try_adversarial(
    retrials: Retrials, name: str, u: Tensor, condition: RetrialCondition
) -> MatrixCell:
    """Try an adversarial scene on a model, and return how often the model is wrong.

    Args:
        retrials: makes the trials.
        name: the model that was attacked.
        u: (d,) the configuration of the scene.
        condition: has the model that is tried.
    """
    verification = retrials.try_adversarial(name, u, condition)
    return MatrixCell(
        model=condition.name,
        ending=verification.ending.value,
        verified=make_verified_rate(verification),
    )


def models_worker(settings: JsonObject) -> BatchFunction:
    """Return the function by which a worker evaluates queries of several models.

    Each query names its problem by the name of the model.

    Args:
        settings: settings of the study.
    """
    config = AttackConfig(**settings)

    def load_problem(name: str) -> Problem:
        """Load a model, and return the problem with it."""
        problem, _ = problem_from_config(_with_model(config, name))
        return problem

    return make_worker_call(cache(load_problem))


def _with_model(config: AttackConfig, name: str) -> AttackConfig:
    """Return the settings of an attack on one of the models."""
    return AttackConfig.from_config(config, model=name, ensemble=None)
