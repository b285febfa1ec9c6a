"""The independent re-check of the worst configuration of a sweep: fresh seeds, enough samples, 8 bits.

Its place in the answer: docs/sweeps.md, "What it says". A sweep has no clean configuration, so there is no control
group: a trial counts where the model is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from advsearch.attacks import Trials, choose_spp, run_trials
from advsearch.attacks.sample_count import most_samples
from advsearch.attacks.verification import RenderTrial
from advsearch.engine.record import Stages
from advsearch.engine.rows import judgement_of, rate_of, trial_row
from advsearch.engine.sweeps.job import Job
from advsearch.engine.sweeps.swept_scene import SweptScene
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results.sweep import WorstVerified
from advsearch.seeds import stream
from advsearch.tasks import Judgement

KIND, PROBES = "verification", "sample count worst"
"""Rows of the trials, and of the renders that chose their sample count."""


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
    if job.trials == 0:
        return None
    seed, ladder = job.pictures.seed, job.ladder
    stages.begin(
        "verification",
        "finding how many samples the check needs",
        most_samples(1, ladder),
        hint="the worst configuration, counted in samples a pixel; `verify_spp=NUMBER` leaves it out",
        at_most=True,
    )
    probe = _after(_stored(run, PROBES), lambda at, seed, spp: view.trial(model, at, seed, spp))
    known, number = 0 if run is None else run.store.count(PROBES), 0

    def margin_of(spp: int, seed: int) -> float:
        nonlocal number
        trial = probe(u, seed, spp)
        if run is not None and number >= known:
            run.record(trial_row(PROBES, number, seed, spp, trial, sought=False))
        number += 1
        stages.progress.advance(spp)
        return trial.score

    count = choose_spp({"worst": margin_of}, seed=seed, ladder=ladder)
    hint = f"{job.trials} pictures of {count.spp} samples a pixel; `trials` or `verify_spp` shorten it"
    stages.begin("verification", "checking the worst configuration with fresh renders", job.trials, hint=hint)
    stored = _stored(run, KIND)

    def keep(group: str, number: int, trial: Judgement) -> None:
        stages.progress.advance(1)
        if run is not None and number >= len(stored):
            own = stream(seed, KIND, number)
            run.record(trial_row(KIND, number, own, count.spp, trial, sought=False))

    render = _after(stored, lambda at, seed, spp: view.trial(model, at, seed, spp))
    trials = run_trials(render, u, spp=count.spp, seed=seed, trials=job.trials, on_trial=keep)
    settled = count.converged or len(ladder) == 1
    renders = count.renders + len(trials)
    wrong = [trial for trial in trials if trial.success]
    rate = rate_of(Trials(len(wrong), len(trials), count.spp), trials, wrong)
    return WorstVerified(**vars(rate), converged=settled, renders=renders)


def _stored(run: RunDirectory | None, kind: str) -> list[Judgement]:
    return [] if run is None else [judgement_of(row) for row in run.store.rows(kind)]


def _after(stored: Sequence[Judgement], render: RenderTrial) -> RenderTrial:
    """Return the trials that are stored, one after the other, then rendered ones."""
    left = list(reversed(stored))
    return lambda u, seed, spp: left.pop() if left else render(u, seed, spp)
