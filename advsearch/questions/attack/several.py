"""Several attacks as one answer: robust accuracy of objects against epsilon, and answers tried on other models."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.api.studies import SETTLED, StudyRun, carry_out_study
from advsearch.attacks import clopper_pearson
from advsearch.attacks.verification import WORST_CASE
from advsearch.cluster import Call, Executor
from advsearch.config import AttackConfig
from advsearch.engine.attack_parts import LOADING, check_from_config, executor_for, problem_from_config
from advsearch.engine.journal import answering
from advsearch.engine.naming import different
from advsearch.engine.problem import Problem
from advsearch.engine.record import control_group, verified_rate
from advsearch.engine.transport import CleanMatrix
from advsearch.engine.verifier import RetrialCondition, Retrials
from advsearch.files import JsonObject
from advsearch.interrupts import interruptible
from advsearch.progress import NullProgress, Progress
from advsearch.questions.attack.answer import (
    CurvePoint,
    CurveResult,
    MatrixCell,
    MatrixModel,
    MatrixResult,
    MatrixRow,
    ObjectRow,
)
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.base import StudyResult
from advsearch.runs.summary import read_answer


def curve_from_config(
    config: AttackConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> CurveResult:
    """Robust accuracy against epsilon, over objects.

    The epsilons are tried from the smallest. An object that flips at one of them flips at every larger one, whose ball
    has the same configuration in it, so it is not attacked again. An object that is wrong as it is counts as not robust
    at any epsilon, and is told apart from those that were found.
    """
    epsilons: Sequence[float | None] = sorted(config.epsilons) or [None]

    def result(rows: list[ObjectRow], common: StudyResult) -> CurveResult:
        curve = [_accuracy(rows, epsilon) for epsilon in epsilons]
        return CurveResult(**vars(common), epsilons=list(epsilons), table=rows, curve=curve)

    return carry_out_study(config, _curve, result, progress, resumed)


def _curve(study: StudyRun) -> list[ObjectRow]:
    rows = []
    for chain in study.chains:
        row, clean = ObjectRow(object=chain[0].of, clean=None, flips_at=None), CleanMatrix()
        renders: Counter[str] = Counter()
        for one in chain:
            summary = study.attack(one, clean)
            if summary is None:
                break
            renders.update(summary.renders)
            row = _seen(one.of, summary, one.epsilon).model_copy(update={"renders": dict(renders)})
            if row.ending in SETTLED:
                break
        rows.append(row)
    return rows


def _seen(name: str, summary: AttackSummary, tried: float | None) -> ObjectRow:
    epsilon = summary.epsilon if tried is None else tried
    return ObjectRow(
        object=name,
        clean=summary.clean.control,
        ending=summary.ending,
        epsilon=epsilon,
        flips_at=epsilon if summary.ending == "found" else None,
        verified=summary.verified,
        margin=summary.verified.margin if summary.verified else None,
        run=summary.run,
        tried=tried,
    )


def _known(row: ObjectRow, epsilon: float | None) -> bool:
    """Whether a row says anything about an epsilon: it was tried there, or had flipped before.

    What ended without a number says nothing, and neither does an object that its own noise makes wrong too often for
    any answer to be verified.
    """
    if row.ending in (None, "non-finite objective"):
        return False
    if row.ending in SETTLED:
        return True
    steady = row.clean is not None and row.clean.correct >= WORST_CASE.needed(row.clean.trials)
    return steady and (epsilon is None or (row.tried is not None and row.tried >= epsilon))


def _accuracy(rows: Sequence[ObjectRow], epsilon: float | None) -> CurvePoint:
    """How many objects are still recognised at an epsilon."""
    known = [row for row in rows if _known(row, epsilon)]
    wrong = sum(row.ending == "already wrong" for row in known)
    found = sum(row.ending == "found" and _flips_within(row, epsilon) for row in known)
    robust = len(known) - wrong - found
    return CurvePoint(
        epsilon=epsilon,
        objects=len(known),
        robust=robust,
        found=found,
        already_wrong=wrong,
        accuracy=robust / len(known) if known else None,
        interval=clopper_pearson(robust, len(known)) if known else (0.0, 1.0),
    )


def _flips_within(row: ObjectRow, epsilon: float | None) -> bool:
    return epsilon is None or (isinstance(row.flips_at, float) and row.flips_at <= epsilon)


LEAST_SPP = 64
"""Samples a pixel of the trials, where none of the attacks needed more and nothing was asked for."""


def matrix_from_config(
    config: AttackConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> MatrixResult:
    """Attack several models, and try every answer on each of them in pictures that are the same for all.

    Trial k has the same seed for every answer and every model, and none that a search or its verification has used.
    Models of one input size are shown the same picture; for another size the same configuration is rendered anew. A
    success needs the model to be right on the clean scene with the same seed, as everywhere.
    """
    names, progress = different(config.models, "model"), progress or NullProgress()
    progress.stage(LOADING)
    for name in names:
        check_from_config(_alone(config, name))

    def result(rows: tuple[list[MatrixModel], list[MatrixRow]], common: StudyResult) -> MatrixResult:
        return MatrixResult(**vars(common), models=list(names), ensemble=config.ensemble, tested=rows[0], table=rows[1])

    return carry_out_study(config, lambda study: _matrix(config, names, study), result, progress, resumed)


def _matrix(config: AttackConfig, names: Sequence[str], study: StudyRun) -> tuple[list[MatrixModel], list[MatrixRow]]:
    """Attack, then try every answer on every model."""
    attacked: list[tuple[str, AttackSummary]] = []
    for (one,) in study.chains:
        summary = study.attack(one)
        if summary is not None:
            attacked.append((one.of, summary))
    models: list[MatrixModel] = []
    cells: dict[str, list[MatrixCell]] = {}
    answers = {name: u for name, summary in attacked if (u := _answer(summary)) is not None}
    if answers and not study.interrupted:
        spp = config.verify_spp or max([LEAST_SPP, *(s.sample_count.spp for _, s in attacked if s.sample_count)])
        try:
            with interruptible():
                study.progress.stage("loading the models to try the answers on")
                problems = {name: problem_from_config(_alone(config, name))[0] for name in names}
                seed, trials = seeds.stream(config.seed, "matrix"), config.trial_count
                with executor_for(
                    config, "advsearch.questions.attack.several:models_answering", study.progress
                ) as executor:
                    kept = (problems, study.run, study.progress, executor)
                    tried = Transfer(*kept, trials=trials, spp=spp, seed=seed)
                    models = tried.clean()
                    for name, u in answers.items():
                        cells[name] = tried.on_each(name, u)
        except KeyboardInterrupt:
            study.interrupted = True
    rows = [
        MatrixRow(attacked=name, ending=one.ending, run=one.run, renders=one.renders, tested=cells.get(name, []))
        for name, one in attacked
    ]
    return models, rows


def models_answering(settings: JsonObject) -> Call:
    """Return what answers queries of the models of a configuration: what a worker does."""
    config = AttackConfig(**settings)
    return answering(cache(lambda name: problem_from_config(_alone(config, name))[0]))


def _alone(config: AttackConfig, name: str) -> AttackConfig:
    """What an answer is tried on one model with; nothing is searched."""
    return AttackConfig.of(config, model=name, ensemble=None)


def _answer(summary: AttackSummary) -> Tensor | None:
    """The configuration that an attack answers with; None where nothing was searched."""
    if summary.adversarial is None or summary.run is None:
        return None
    return torch.from_numpy(read_answer(Path(summary.run)))


class Transfer:
    """Tries answers on models.

    Args:
        problems: of each model, by its name; they have one space.
        run: keeps the rows.
        progress: told how far it is.
        executor: of workers that make the pictures; None makes them here.
        trials: of each answer on each model.
        spp: samples a pixel.
        seed: root of the trials.
    """

    def __init__(
        self,
        problems: Mapping[str, Problem],
        run: RunDirectory,
        progress: Progress,
        executor: Executor | None,
        *,
        trials: int,
        spp: int,
        seed: int,
    ) -> None:
        self._conditions = [RetrialCondition(name, one, spp, _size(one)) for name, one in problems.items()]
        self._retrials = Retrials(self._conditions, run, progress, trials=trials, seed=seed, executor=executor)
        self._progress, self._each = progress, trials * len(problems)

    def clean(self) -> list[MatrixModel]:
        """Try the clean scene on every model."""
        self._begin("trying the clean scene on every model")
        return [self._control(one) for one in self._conditions]

    def on_each(self, attacked: str, u: Tensor) -> list[MatrixCell]:
        """Try the answer (d,) to one model on every model."""
        self._begin(f"trying the answer to {attacked} on every model")
        checked = {one.name: self._retrials.answer(attacked, u, one) for one in self._conditions}
        return [
            MatrixCell(model=name, ending=one.ending.value, verified=verified_rate(one))
            for name, one in checked.items()
        ]

    def _begin(self, title: str) -> None:
        self._progress.stage(title, self._each, hint=f"{self._each} answers; `trials` or `verify_spp` shorten it")

    def _control(self, one: RetrialCondition) -> MatrixModel:
        problem = one.problem
        return MatrixModel(
            model=one.name,
            labels=list(problem.task.truth_names(problem.truth())),
            input_size=_size(problem),
            spp=one.spp,
            clean=control_group(self._retrials.clean(one), one.spp),
        )


def _size(problem: Problem) -> tuple[int, int]:
    return problem.renderer.formation.resolution
