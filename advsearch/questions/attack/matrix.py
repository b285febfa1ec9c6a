"""Attacks on several models, each answer tried on all of them, in pictures that are the same for all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.api.studies import StudyRun, carry_out_study
from advsearch.cluster.executor import Call, Executor
from advsearch.config import AttackConfig
from advsearch.engine.attack_parts import LOADING, check_from_config, executor_for, problem_from_config
from advsearch.engine.naming import different
from advsearch.engine.problem import Problem
from advsearch.engine.retrial import RetrialCondition, Retrials
from advsearch.engine.rows import control_group, verified_rate
from advsearch.engine.sharing import answering
from advsearch.files import JsonObject
from advsearch.interrupts import interruptible
from advsearch.progress import NullProgress, Progress
from advsearch.questions.attack.answer import MatrixCell, MatrixModel, MatrixResult, MatrixRow
from advsearch.runs.answer import read_answer
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.study import StudyResult

LEAST_SPP = 64
"""Samples a pixel of the trials, where none of the attacks needed more and nothing was asked for."""


def matrix_from_config(
    config: AttackConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> MatrixResult:
    """Attack several models, and try every answer on each of them in pictures that are the same for all.

    Trial k has the same seed for every answer and every model, and none that a search or its verification has used.
    Models of one input size are shown the same picture; for another size the same configuration is rendered anew. A
    success needs the model to be right on the clean scene with the same seed, as everywhere.

    Args:
        config: with several models.
        progress: told how far it is.
        resumed: folder of the run to go on with.

    Raises:
        InputError: anything that the caller can put right, such as a model that has no class for the label.
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
                    config, "advsearch.questions.attack.matrix:models_answering", study.progress
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
        """Try one answer on every model.

        Args:
            attacked: the model that it was searched on.
            u: (d,) the answer.
        """
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
