"""`explain`: failures in words, from the rows of sweeps, confirmed by fresh renders."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from typing_extensions import Unpack

from advsearch.api.keywords import RunKeywords, asks, configured
from advsearch.config import SweepConfig
from advsearch.errors import InputError
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.explain.answer import EnvelopeRow, ExplainResult, ParameterWeight, RuleNotTold, RuleRow
from advsearch.questions.explain.findings import Envelope, FactorWeight, find_envelope, find_importance
from advsearch.questions.explain.renders import AskedSweep, Renders, read_answers, right_of
from advsearch.questions.explain.settings import ExplainConfig
from advsearch.rules import CHANCE, FEWEST_ROWS, CountedRule, find_rules, halves, is_independent, observed
from advsearch.runs.directory import PARTS, RunDirectory, find_run
from advsearch.runs.results.base import INTERRUPTED
from advsearch.runs.summary import read_result
from advsearch.settings import split_names
from advsearch.viewer.pages import keep_answer


class ExplainKeywords(RunKeywords, total=False):
    confirm: int
    pairs: int
    clusters: int
    accuracy: float
    seed: int
    threads: int | None


@asks(ExplainConfig, ExplainKeywords)
def explain(
    sweeps: str | Path | Sequence[str | Path], *, progress: Watched = None, **settings: Unpack[ExplainKeywords]
) -> ExplainResult:
    """Say in words where a model is wrong, from the rows of sweeps, and confirm it by renders (docs/explain.md).

    Args:
        sweeps: name or folder of a run of `sweep` that has ended, or several, whose rows are read together; of a
            recipe, its sweeps.
    """
    return explain_from_config(configured(ExplainConfig, sweeps=sweeps, **settings), progress=watcher(progress))


def explain_from_config(
    config: ExplainConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> ExplainResult:
    """Explain what a configuration describes; renders are sweeps in `parts/`, and those that are done stay done.

    Raises:
        InputError: too few rows, nothing that varies, or a missing library.
        FileFormatError: a run is not a finished sweep.
    """
    begun, progress = time.perf_counter(), progress or NullProgress()
    progress.stage("reading rows")
    asked = [AskedSweep.of(folder) for name in split_names(config.sweeps) for folder in _sweeps_of(find_run(name))]
    rows = read_answers(asked)
    if len(rows) < FEWEST_ROWS:
        raise InputError(f"explain: expected at least {FEWEST_ROWS} rows, got {len(rows)}; sweep more configurations")
    table = observed(rows, rows.attrs["units"])
    if not table.attrs["units"]:
        raise InputError("explain: expected rows in which something varies that all of them have, got none")
    choosing, counting = halves(table, config.seed)
    progress.stage("seeking rules on one half of the rows")
    found = find_rules(choosing, counting, config.seed)
    progress.stage("measuring which parameters matter")
    importance = find_importance(table)
    envelope = find_envelope(choosing, counting, config.accuracy)
    with RunDirectory.of(config, resumed) as run:
        renders = Renders(run.path, progress, config, asked, rows, table)
        rules = [RuleRow(**_counts(one), confirmed=renders.confirmed(one, n)) for n, one in enumerate(found.told)]
        pairs = list(renders.pairs(found.told))
        clusters = renders.clusters(run)
        answers = right_of(table)
        result = ExplainResult(
            run=str(run.path),
            sweeps=[str(one.folder) for one in asked],
            object=_together(one.summary.object for one in asked),
            model=_together(one.summary.model for one in asked),
            environment=_together(one.summary.environment for one in asked),
            controls=asked[0].summary.controls,
            parameters=list(table.attrs["units"]),
            **vars(answers),
            units=None if is_independent(table) else table["unit"].nunique(),
            rules=rules,
            not_told=_not_told(found.next, len(table)),
            importance=[
                ParameterWeight(parameters=[*one.factors], share=one.share, interval=one.interval, parts=one.parts)
                for one in importance
            ],
            envelope=None if envelope is None else _envelope_row(envelope, config.accuracy),
            pairs=pairs,
            pairs_sought=min(config.pairs, answers.total - answers.right),
            clusters=clusters,
            renders=renders.count,
            ending=INTERRUPTED if renders.interrupted else "done",
            warnings=[*renders.warnings, *_cautions(table, importance)],
            seconds={"total": time.perf_counter() - begun},
            seed=config.seed,
            command_line=config.command_line(),
        )
        return keep_answer(run, result)


def _sweeps_of(folder: Path) -> list[Path]:
    """Return the folder of a sweep, or those of the sweeps that a recipe consists of."""
    made = read_result(folder)
    if made.command != "recipe":
        return [folder]
    listed = getattr(made, "parts", ())
    parts = [folder / PARTS / part.name for part in listed if part.command == SweepConfig.command]
    if not parts:
        raise InputError(f"explain: expected sweeps, got {folder}, a recipe without one")
    return parts


def _together(names: Iterator[str] | Sequence[str]) -> str:
    return ",".join(dict.fromkeys(one for name in names for one in split_names(name)))


def _cautions(table: pd.DataFrame, importance: Sequence[FactorWeight]) -> list[str]:
    cautions, draws = list[str](), table["unit"].nunique()
    if draws < FEWEST_ROWS:
        cautions = [f"The rows are of {draws} draws, each with several, which are not independent: few show little."]
    if table["correct"].nunique() < 2:
        always = "right" if table["correct"].all() else "wrong"
        return [*cautions, f"The model is {always} in every row: there is nothing to tell apart."]
    if all(one.interval[0] <= 0.0 for one in importance):
        return [*cautions, "No parameter is shown to decide anything: the intervals of all their shares begin at 0."]
    return cautions


def _counts(rule: CountedRule) -> dict[str, Any]:
    """What a rule is, and how often the model is right under it and elsewhere."""
    conditions = [one.row for one in rule.conditions]
    return {"conditions": conditions, **vars(right_of(rule.inside)), "elsewhere": right_of(rule.elsewhere)}


def _not_told(rule: CountedRule | None, rows: int) -> RuleNotTold | None:
    if rule is None:
        return None
    times = rule.times_needed()
    needed = None if times is None else round_up(times * rows)
    return RuleNotTold(**_counts(rule), chance=rule.chance, asked=CHANCE, rows=needed)


def _envelope_row(box: Envelope, accuracy: float) -> EnvelopeRow:
    conditions = [one.row for one in box.conditions]
    return EnvelopeRow(conditions=conditions, **vars(right_of(box.inside)), accuracy=accuracy, held=box.held)


def round_up(rows: float) -> int:
    """Return a number of rows with two digits that mean something: 173.2 becomes 180."""
    step: int = 10 ** max(0, math.floor(math.log10(rows)) - 1)
    return math.ceil(rows / step) * step
