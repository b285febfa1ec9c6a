"""`explain`: failures in words, from the rows of sweeps, confirmed by fresh renders."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from typing_extensions import Unpack

from advsearch.api.keywords import RunKeywords, asks, configured
from advsearch.config import SweepConfig
from advsearch.errors import InputError
from advsearch.explanations import (
    CHANCE,
    FEWEST_ROWS,
    CountedRule,
    Factor,
    Observations,
    condition_rows,
    find_rules,
    observed,
)
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.explain.answer import EnvelopeRow, ExplainResult, ParameterWeight, RuleNotTold, RuleRow
from advsearch.questions.explain.findings import Envelope, FactorWeight, find_envelope, find_importance
from advsearch.questions.explain.renders import AskedSweep, Renders, right_of
from advsearch.questions.explain.settings import ExplainConfig
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
    rows = [row for one in asked for row in one.rows]
    if len(rows) < FEWEST_ROWS:
        raise InputError(f"explain: expected at least {FEWEST_ROWS} rows, got {len(rows)}; sweep more configurations")
    values = ({name: (value, row.units.get(name, "")) for name, value in row.values.items()} for row in rows)
    shown = [(one, row.correct) for one, row in zip(values, rows, strict=True)]
    found = observed(shown, [unit for one in asked for unit in one.units])
    choosing, counting = found.halves(config.seed)
    progress.stage("seeking rules on one half of the rows")
    sought = find_rules(choosing, counting, config.seed)
    rules = sought.told
    progress.stage("measuring which parameters matter")
    importance = find_importance(found)
    envelope = find_envelope(choosing, counting, config.accuracy)
    with RunDirectory.of(config, resumed) as run:
        renders = Renders(run.path, progress, config, found)
        table = [
            RuleRow(**_told(rule, found.factors), confirmed=renders.confirmed(rule, n, asked))
            for n, rule in enumerate(rules)
        ]
        pairs = list(renders.pairs(rules, rows, asked))
        clusters = renders.clusters(asked, run)
        first = asked[0].summary
        right = int(found.right.sum())
        result = ExplainResult(
            run=str(run.path),
            sweeps=[str(one.folder) for one in asked],
            object=_together(one.summary.object for one in asked),
            model=_together(one.summary.model for one in asked),
            environment=_together(one.summary.environment for one in asked),
            controls=first.controls,
            parameters=[one.name for one in found.factors],
            right=right,
            total=len(found),
            interval=found.interval,
            units=None if found.independent else found.count,
            rules=table,
            not_told=_not_told(sought.next, found),
            importance=[
                ParameterWeight(**{**vars(one), "parameters": [found.factors[place].name for place in one.places]})
                for one in importance
            ],
            envelope=_envelope_row(envelope, found.factors, config.accuracy),
            pairs=pairs,
            pairs_sought=min(config.pairs, len(found) - right),
            clusters=clusters,
            renders=renders.count,
            ending=INTERRUPTED if renders.interrupted else "done",
            warnings=[*renders.warnings, *_cautions(found, importance)],
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


def _cautions(found: Observations, importance: Sequence[FactorWeight]) -> list[str]:
    right, told = int(found.right.sum()), list[str]()
    if found.count < FEWEST_ROWS:
        told = [f"The rows are of {found.count} draws, each with several, which are not independent: few show little."]
    if right in (0, len(found)):
        return [*told, f"The model is {'right' if right else 'wrong'} in every row: there is nothing to tell apart."]
    if all(one.interval[0] <= 0.0 for one in importance):
        return [*told, "No parameter is shown to decide anything: the intervals of all their shares begin at 0."]
    return told


def _told(rule: CountedRule, factors: Sequence[Factor]) -> dict[str, Any]:
    """What a rule is, and how often it holds."""
    conditions = condition_rows(rule.conditions, factors)
    return {"conditions": conditions, **vars(right_of(rule.inside)), "elsewhere": right_of(rule.elsewhere)}


def _not_told(rule: CountedRule | None, found: Observations) -> RuleNotTold | None:
    if rule is None:
        return None
    times = rule.times_needed()
    rows = None if times is None else round_up(times * len(found))
    return RuleNotTold(**_told(rule, found.factors), chance=rule.chance, asked=CHANCE, rows=rows)


def _envelope_row(one: Envelope | None, factors: Sequence[Factor], accuracy: float) -> EnvelopeRow | None:
    if one is None:
        return None
    rows = condition_rows(one.conditions, factors)
    return EnvelopeRow(conditions=rows, **vars(right_of(one.inside)), accuracy=accuracy, held=one.held)


def round_up(rows: float) -> int:
    """Return a number of rows with two digits that mean something: 173.2 becomes 180."""
    step: int = 10 ** max(0, math.floor(math.log10(rows)) - 1)
    return math.ceil(rows / step) * step
