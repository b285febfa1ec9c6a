"""Several attacks as one answer: robust accuracy of objects against epsilon, and answers tried on other models."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.api.studies import SETTLED, StudyRun
from advsearch.attacks import clopper_pearson
from advsearch.attacks.verification import WORST_CASE
from advsearch.cluster import Call
from advsearch.config import AttackConfig
from advsearch.engine.attack_parts import LOADING, check_from_config, executor_for, problem_from_config
from advsearch.engine.journal import answering
from advsearch.engine.naming import different
from advsearch.engine.problem import Problem
from advsearch.engine.record import control_group, verified_rate
from advsearch.engine.transport import CleanMatrix
from advsearch.engine.verifier import RetrialCondition, Retrials
from advsearch.files import JsonObject
from advsearch.question import Asked
from advsearch.questions.attack.answer import (
    CurvePoint,
    CurveResult,
    MatrixCell,
    MatrixModel,
    MatrixResult,
    MatrixRow,
    ObjectRow,
)
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.summary import read_answer


def curve(asked: Asked[AttackConfig]) -> CurveResult:
    """Robust accuracy against epsilon, over objects.

    The epsilons are tried from the smallest. An object that flips at one of them flips at every larger one, whose ball
    has the same configuration in it, so it is not attacked again. An object that is wrong as it is counts as not robust
    at any epsilon, and is told apart from those that were found.
    """
    study = StudyRun(asked)
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
    epsilons: Sequence[float | None] = sorted(asked.config.epsilons) or [None]
    return asked.result(
        CurveResult,
        epsilons=list(epsilons),
        table=rows,
        curve=[_accuracy(rows, epsilon) for epsilon in epsilons],
        parts=study.names,
        warnings=study.warnings,
    )


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
    flipped = [row.flips_at for row in known if row.ending == "found"]
    found = sum(epsilon is None or (isinstance(one, float) and one <= epsilon) for one in flipped)
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


LEAST_SPP = 64
"""Samples a pixel of the trials, where none of the attacks needed more and nothing was asked for."""


def matrix(asked: Asked[AttackConfig]) -> MatrixResult:
    """Attack several models, and try every answer on each of them in pictures that are the same for all.

    Trial k has the same seed for every answer and every model, and none that a search or its verification has used.
    Models of one input size are shown the same picture; for another size the same configuration is rendered anew. A
    success needs the model to be right on the clean scene with the same seed, as everywhere.
    """
    config, names = asked.config, different(asked.config.models, "model")
    asked.progress.stage(LOADING)
    for name in names:
        check_from_config(_alone(config, name))

    study = StudyRun(asked)
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
        with asked.until_interrupted():
            study.progress.stage("loading the models to try the answers on")
            problems = {name: problem_from_config(_alone(config, name))[0] for name in names}
            seed, trials = seeds.stream(config.seed, "matrix"), config.trial_count
            with executor_for(
                config, "advsearch.questions.attack.several:models_answering", study.progress
            ) as executor:
                conditions = [RetrialCondition(name, one, spp, _size(one)) for name, one in problems.items()]
                retrials = Retrials(conditions, study.run, study.progress, trials=trials, seed=seed, executor=executor)
                each = trials * len(names)
                hint = f"{each} answers; `trials` or `verify_spp` shorten it"
                study.progress.stage("trying the clean scene on every model", each, hint=hint)
                models = [_model(one, retrials) for one in conditions]
                for name, u in answers.items():
                    study.progress.stage(f"trying the answer to {name} on every model", each, hint=hint)
                    checked = [(one.name, retrials.answer(name, u, one)) for one in conditions]
                    cells[name] = [
                        MatrixCell(model=model, ending=one.ending.value, verified=verified_rate(one))
                        for model, one in checked
                    ]
    rows = [
        MatrixRow(attacked=name, ending=one.ending, run=one.run, renders=one.renders, tested=cells.get(name, []))
        for name, one in attacked
    ]
    return asked.result(
        MatrixResult,
        models=list(names),
        ensemble=config.ensemble,
        tested=models,
        table=rows,
        parts=study.names,
        warnings=study.warnings,
    )


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


def _model(one: RetrialCondition, retrials: Retrials) -> MatrixModel:
    return MatrixModel(
        model=one.name,
        labels=list(one.problem.task.truth_names(one.problem.truth())),
        input_size=_size(one.problem),
        spp=one.spp,
        clean=control_group(retrials.clean(one), one.spp),
    )


def _size(problem: Problem) -> tuple[int, int]:
    return problem.renderer.formation.resolution
