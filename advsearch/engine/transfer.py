"""Answers tried on several models, in pictures that are the same for all."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from advsearch.cluster.executor import Executor
from advsearch.engine.problem import Problem
from advsearch.engine.retrial import RetrialCondition, Retrials
from advsearch.engine.rows import control_group, verified_rate
from advsearch.progress import Progress
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results.matrix import MatrixCell, MatrixModel


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
