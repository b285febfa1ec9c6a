"""The independent re-check of the worst configuration of a sweep (DESIGN 4.1): fresh seeds, enough samples, 8 bits.

A sweep has no clean configuration, so there is no control group: a trial counts where the model is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

from advsearch.api.record import Stages, trial_row
from advsearch.api.samples import verification_ladder
from advsearch.api.sweeps.job import Job
from advsearch.api.sweeps.summary import verified
from advsearch.api.sweeps.view import View
from advsearch.attacks import Trial, choose_spp, run_trials
from advsearch.runs import store
from advsearch.runs.directory import RunDirectory
from advsearch.seeds import stream

KIND = "verification"
"""Rows of the trials."""


def check_worst(
    view: View, job: Job, model: int, u: Tensor, run: RunDirectory | None, stages: Stages
) -> dict[str, Any] | None:
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
    config, network = job.config, job.models[model]
    if config.trials == 0:
        return None
    ladder = verification_ladder(config)

    def margin_of(spp: int, seed: int) -> float:
        stages.progress.advance(1, samples=spp)
        return view.trial(model, u, seed, spp).margin

    count = choose_spp({"worst": margin_of}, seed=config.seed, ladder=ladder)
    stored = [] if run is None else [trial_of(row) for row in run.store.rows(KIND)]

    def keep(group: str, number: int, trial: Trial) -> None:
        stages.progress.advance(1)
        if run is not None and number >= len(stored):
            seed = stream(config.seed, KIND, number)
            run.record(trial_row(KIND, number, seed, count.spp, trial, network.labels))

    render = _after(stored, lambda at, seed, spp: view.trial(model, at, seed, spp))
    trials = run_trials(render, u, spp=count.spp, seed=config.seed, trials=config.trials, on_trial=keep)
    settled = count.converged or len(ladder) == 1
    renders = count.renders + len(trials)
    return verified(trials, network.labels, count.spp, converged=settled, renders=renders)


def trial_of(row: store.Row) -> Trial:
    """Return what was seen of a configuration from its row."""
    seen = math.nan if row.objective is None else row.objective
    return Trial(seen, row.label_index or 0, math.nan if row.probability is None else row.probability)


def _after(stored: Sequence[Trial], render: Callable[[Tensor, int, int], Trial]) -> Callable[[Tensor, int, int], Trial]:
    """Return the trials that are stored, one after the other, then rendered ones."""
    left = list(reversed(stored))
    return lambda u, seed, spp: left.pop() if left else render(u, seed, spp)
