"""The independent re-check of the worst configuration of a sweep: fresh seeds, enough samples, 8 bits.

Its place in the answer: docs/sweeps.md, "What it says". A sweep has no clean configuration, so there is no control
group: a trial counts where the model is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from torch import Tensor

from advsearch.attacks import Evaluation, Query, Trials, choose_spp, run_trials
from advsearch.attacks.sample_count import margins_of, most_samples
from advsearch.engine.journal import Journal
from advsearch.engine.record import Stages
from advsearch.engine.rows import rate_of
from advsearch.engine.sharing import Shared
from advsearch.engine.sweeps.job import Job
from advsearch.engine.sweeps.swept_scene import SweptScene
from advsearch.engine.verifier import ladder_of
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results.sweep import WorstVerified

PROBES = "sample count worst"
"""Rows of the renders that chose the sample count."""


@dataclass(frozen=True)
class OneModel:
    """A swept scene as one of the models sees it: what a `Problem` is to an attack."""

    view: SweptScene
    model: int

    def evaluate(self, query: Query) -> Evaluation:
        """Answer one query: a trial."""
        picture = self.view.picture(self.model, query.u, query.seed, query.spp)
        return Evaluation.of(self.view.judge(self.model, query.u, picture))


def check_worst(
    view: SweptScene, job: Job, model: int, u: Tensor, run: RunDirectory | None, stages: Stages
) -> WorstVerified | None:
    """Render a configuration again, and say how often the model is wrong.

    Trials that the run has stored already are not made again.

    Args:
        view: its scene.
        job: says how many trials.
        model: number of the model.
        u: (d,).
        run: gets a row for every trial, and has those of a run that was stopped.
        stages: told how far it is.

    Returns:
        As `verified` in the summary; None without trials.
    """
    config = job.config
    if config.trials == 0:
        return None
    seed, ladder = config.seed, ladder_of(config)
    stages.begin(
        "verification",
        "finding how many samples the check needs",
        most_samples(1, ladder),
        hint="the worst configuration, counted in samples a pixel; `verify_spp=NUMBER` leaves it out",
        at_most=True,
    )
    problem: Any = OneModel(view, model)
    journal = Journal(run, Shared(problem))

    def answers(queries: Sequence[Query], *, in_samples: bool = False) -> Iterator[Evaluation]:
        asked = [replace(one, drawn=False, sought=False) for one in queries]
        for query, answer in zip(asked, journal.answers(asked), strict=True):
            stages.progress.advance(query.spp if in_samples else 1)
            yield answer

    margins = margins_of(partial(answers, in_samples=True), PROBES, u, sought=False)
    count = choose_spp({"worst": margins}, seed=seed, ladder=ladder)
    hint = f"{config.trials} pictures of {count.spp} samples a pixel; `trials` or `verify_spp` shorten it"
    stages.begin("verification", "checking the worst configuration with fresh renders", config.trials, hint=hint)
    tried = run_trials(answers, u, spp=count.spp, seed=seed, trials=config.trials)
    settled = count.converged or len(ladder) == 1
    renders = count.renders + len(tried)
    wrong = [trial for trial in tried if trial.success]
    rate = rate_of(Trials(len(wrong), len(tried), count.spp), tried, wrong)
    return WorstVerified(**vars(rate), converged=settled, renders=renders)
