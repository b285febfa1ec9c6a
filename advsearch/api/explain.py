"""`explain`: failures in words, from the rows of sweeps, confirmed by fresh renders."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice, zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch import seeds
from advsearch.api.keywords import ExplainKeywords, asks, configured
from advsearch.api.subruns import carry_out_part
from advsearch.api.sweep import job_of
from advsearch.attacks import clopper_pearson
from advsearch.config import ExplainConfig, SweepConfig
from advsearch.config.explain import FEWEST_ROWS
from advsearch.engine.sweeps.job import check_all
from advsearch.engine.sweeps.swept_scene import Scenes
from advsearch.errors import FileFormatError, InputError, ModelError
from advsearch.explanations.clusters import find_clusters
from advsearch.explanations.envelope import Envelope, find_envelope
from advsearch.explanations.importance import FactorWeight, find_importance
from advsearch.explanations.observations import Factor, Observations, observed
from advsearch.explanations.renders import along, lies_inside, sweep_inside
from advsearch.explanations.rules import CHANCE, CountedRule, RuleCondition, RuleConditions, covered, find_rules
from advsearch.interrupts import interruptible
from advsearch.models.features import Features, features_of
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.recipes.table import Answered, rows_of
from advsearch.runs.directory import CONFIG, PARTS, RunDirectory, find_run
from advsearch.runs.results.base import INTERRUPTED
from advsearch.runs.results.explain import (
    ConditionRow,
    EnvelopeRow,
    ExplainResult,
    FailureCluster,
    FailureClusters,
    NearestRight,
    ParameterWeight,
    RightOf,
    RuleNotTold,
    RuleRow,
)
from advsearch.runs.results.recipe import RecipeResult
from advsearch.runs.results.sweep import SweepSummary
from advsearch.runs.summary import read_result
from advsearch.settings import split_names
from advsearch.viewer.pages import write_page
from advsearch.viewer.thumbnails import path_of

if TYPE_CHECKING:
    from typing_extensions import Unpack


@asks(ExplainConfig, ExplainKeywords)
def explain(
    sweeps: str | Path | Sequence[str | Path],
    *,
    progress: Watched = None,
    **settings: Unpack[ExplainKeywords],
) -> ExplainResult:
    """Say in words where a model is wrong, from the rows of sweeps, and confirm it by renders (docs/explain.md).

    All other arguments are the settings of `advsearch explain`. The run is kept, in `run` or under runs/.

    Args:
        sweeps: name or folder of a run of `sweep` that has ended, or several, whose rows are read together; of a
            recipe, its sweeps.
        progress: True shows a bar, False none, None one on a terminal; or told how far it is.

    Raises:
        InputError: anything that the caller can put right; nothing is written then.
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
    asked = [_Asked.of(folder) for name in split_names(config.sweeps) for folder in _sweeps_of(find_run(name))]
    rows = [row for one in asked for row in one.rows]
    if len(rows) < FEWEST_ROWS:
        raise InputError(f"explain: expected at least {FEWEST_ROWS} rows, got {len(rows)}; sweep more configurations")
    found = observed([(_shown(row), row.correct) for row in rows])
    choosing, counting = found.halves(config.seed)
    progress.stage("seeking rules on one half of the rows")
    sought = find_rules(choosing, counting, config.seed)
    rules = sought.told
    progress.stage("measuring which parameters matter")
    importance = find_importance(found)
    envelope = find_envelope(choosing, counting, config.accuracy)
    with RunDirectory.of(config, resumed) as run:
        renders = _Renders(run.path, progress, config, found)
        table = [_rule_row(rule, found.factors, renders.confirmed(rule, n, asked)) for n, rule in enumerate(rules)]
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
            interval=clopper_pearson(right, len(found)),
            rules=table,
            not_told=None if sought.next is None else _not_told(sought.next, found),
            importance=_weights(importance, found.factors),
            envelope=None if envelope is None else _envelope_row(envelope, found.factors, config.accuracy),
            pairs=pairs,
            pairs_sought=min(config.pairs, len(found) - right),
            clusters=clusters,
            renders=renders.count,
            ending=INTERRUPTED if renders.interrupted else "done",
            warnings=[*renders.warnings, *_cautions(rows, importance)],
            seconds={"total": time.perf_counter() - begun},
            seed=config.seed,
            command_line=config.command_line(),
        )
        run.write_summary(result)
        write_page(run.path, result)
        return result


def _sweeps_of(folder: Path) -> list[Path]:
    """Return the folder of a sweep, or those of the sweeps that a recipe consists of."""
    made = read_result(folder)
    if not isinstance(made, RecipeResult):
        return [folder]
    parts = [folder / PARTS / part.name for part in made.parts if part.command == SweepConfig.command]
    if not parts:
        raise InputError(f"explain: expected sweeps, got {folder}, a recipe without one")
    return parts


@dataclass(frozen=True)
class _Asked:
    """One of the sweeps whose rows are read."""

    folder: Path
    config: SweepConfig
    summary: SweepSummary
    rows: list[Answered]

    @classmethod
    def of(cls, folder: Path) -> _Asked:
        summary = read_result(folder)
        if not isinstance(summary, SweepSummary):
            raise FileFormatError(f"{folder}: expected the run of a sweep that has ended, got one of another command")
        return cls(folder, SweepConfig.from_yaml(folder / CONFIG), summary, rows_of("", folder, summary))


def _shown(row: Answered) -> dict[str, tuple[float | str, str]]:
    return {name: (value, row.units.get(name, "")) for name, value in row.values.items()}


def _together(names: Iterator[str] | Sequence[str]) -> str:
    return ",".join(dict.fromkeys(one for name in names for one in split_names(name)))


def _cautions(rows: Sequence[Answered], importance: Sequence[FactorWeight]) -> list[str]:
    right = sum(row.correct for row in rows)
    if right in (0, len(rows)):
        return [f"The model is {'right' if right else 'wrong'} in every row: there is nothing to tell apart."]
    if all(one.interval[0] <= 0.0 for one in importance):
        return ["No parameter is shown to decide anything: the intervals of all their shares begin at 0."]
    return []


# ---- renders --------------------------------------------------------------------------------------------------------


@dataclass
class _Renders:
    """Sweeps in the folder of the run; none any more after an interrupt."""

    folder: Path
    progress: Progress
    config: ExplainConfig
    found: Observations
    count: int = 0
    interrupted: bool = False
    warnings: list[str] = field(default_factory=list)

    def _rows(self, name: str, config: SweepConfig) -> list[Answered] | None:
        """The rows of a sweep; None if it was interrupted, or the scene is not to be had any more."""
        if self.interrupted:
            return None
        path = self.folder / PARTS / name
        own = config.model_copy(update={"threads": self.config.threads}) if self.config.threads else config
        try:
            done = carry_out_part(path, own, self.progress)
        except InputError as error:
            text = f"Nothing was rendered for {name}: {error}"
            self.warnings += [text] if text not in self.warnings else []
            return None
        assert isinstance(done, SweepSummary)
        self.interrupted = done.goes_on
        self.count += sum(done.renders.values())
        return None if self.interrupted else rows_of("", path, done)

    def confirmed(self, rule: CountedRule, number: int, asked: Sequence[_Asked]) -> RightOf | None:
        """Render fresh configurations inside a rule, in the scene of each sweep."""
        if not self.config.confirm:
            return None
        rows: list[Answered] = []
        for place, one in enumerate(asked):
            seed = seeds.stream(self.config.seed, "confirm", number * len(asked) + place)
            samples = -(-self.config.confirm // len(asked))
            self.progress.message(f"rule {number + 1}: rendering about {samples} configurations inside it")
            own = sweep_inside(one.config, self.found, rule.conditions, samples, seed)
            rows += self._rows(f"rule-{number + 1}-{place}", own) or []
        kept = [row.correct for row in rows if lies_inside(rule.conditions, self.found.factors, row.values)]
        return right_of(sum(kept), len(kept)) if kept else None

    def pairs(
        self, rules: Sequence[CountedRule], rows: Sequence[Answered], asked: Sequence[_Asked]
    ) -> Iterator[NearestRight]:
        """The nearest right configurations to typical failures, along the parameters of their rule or else the others.

        A failure that no parameter alone puts right has none.
        """
        for number, (index, conditions) in enumerate(typical_failures(self.found, rules, self.config.pairs)):
            one, row = _sweep_of(index, asked), rows[index]
            first = [condition.place for condition in conditions]
            others = [place for place in range(len(self.found.factors)) if place not in first]
            for places in (first, *([place] for place in others)):
                near = [
                    found
                    for place in places
                    if (found := self._nearest(f"pair-{number + 1}", one, row, self.found.factors[place]))
                ]
                if near:
                    yield min(near, key=self._moved)
                    break

    def clusters(self, asked: Sequence[_Asked], run: RunDirectory) -> FailureClusters | None:
        """Render failures of one model's sweeps again, and group them by what it decides by."""
        alone = [one for one in asked if len(one.config.models) == 1]
        alike = [one for one in alone if one.config.models == alone[0].config.models]
        failing = [(one, number) for one in alike for number, row in enumerate(one.rows) if not row.correct]
        if self.interrupted or not self.config.clusters or not failing:
            return None
        if len(alike) < len(asked):
            name = alike[0].config.model
            self.warnings.append(f"Kinds are of the failures of model {name} alone, where it was swept by itself.")
        generator = np.random.default_rng(seeds.stream(self.config.seed, "clusters"))
        picked = [failing[n] for n in sorted(generator.permutation(len(failing))[: self.config.clusters])]
        self.progress.stage("rendering failures again", len(picked), hint="`clusters` says how many")
        try:
            with interruptible():
                shown = [
                    pictures_again(one.config, numbers, self.progress)
                    for one in alike
                    if (numbers := [number for owner, number in picked if owner is one])
                ]
        except KeyboardInterrupt:
            self.interrupted = True
            return None
        except (InputError, ModelError) as error:
            self.warnings.append(f"No failures were grouped: {error}")
            return None
        self.count += len(picked)
        pictures, features = torch.cat([some for some, _ in shown]), shown[0][1]
        found = find_clusters(features(pictures).double().numpy(), self.config.seed)
        listed = []
        for place, members in enumerate(found.members):
            own = [picked[k][0].rows[picked[k][1]] for k in members]
            path = run.save_image(f"cluster-{place + 1}", pictures[members[0]])
            answers = dict(Counter(row.answer for row in own).most_common())
            picture = str(path.relative_to(self.folder))
            listed.append(
                FailureCluster(failures=len(own), answers=answers, values=dict(own[0].values), picture=picture)
            )
        return FailureClusters(
            features=features.source,
            failures=len(picked),
            silhouette=found.silhouette,
            apart=found.apart,
            listed=listed,
        )

    def _moved(self, pair: NearestRight) -> float:
        """How far the value moved, as a share of what the rows have; another name is as far as it goes."""
        place = next(k for k, one in enumerate(self.found.factors) if one.name == pair.parameter)
        column = self.found.values[:, place]
        if self.found.factors[place].options:
            return 1.0
        return abs(float(pair.right_at) - float(pair.wrong_at)) / float(np.ptp(column))

    def _nearest(self, name: str, one: _Asked, row: Answered, factor: Factor) -> NearestRight | None:
        """Go along one factor until the answer is right, twice with other noise; the failure fails in both."""
        self.progress.message(f"{name}: the nearest right answer along {factor.name}")
        label = f"{name}-{factor.name.replace('.', '_')}"
        passes: list[list[Answered]] = []
        for number in range(2):
            seed = seeds.stream(self.config.seed, f"{label} {number}")
            found = self._rows(f"{label}-{number}", along(one.config, row.values, factor, self.found, seed))
            if found is None:
                return None
            passes.append(found)
        own = row.values[factor.name]
        right = {
            first.values[factor.name]: place
            for place, (first, second) in enumerate(zip(*passes, strict=True))
            if first.correct and second.correct
        }
        start = next(place for place, each in enumerate(passes[0]) if each.values[factor.name] == own)
        if not right or passes[0][start].correct or passes[1][start].correct:
            return None
        at = min(right, key=lambda value: abs(float(value) - float(own)) if not factor.options else 0.0)
        pictures = [
            str(path.relative_to(self.folder))
            for place in (start, right[at])
            if (path := path_of(self.folder / PARTS / f"{label}-0", place)).is_file()
        ]
        return NearestRight(
            values=dict(row.values),
            parameter=factor.name,
            unit=factor.unit,
            wrong_at=own,
            right_at=at,
            answered=passes[0][start].answer,
            answered_there=passes[0][right[at]].answer,
            pictures=pictures,
        )


def typical_failures(found: Observations, rules: Sequence[CountedRule], most: int) -> list[tuple[int, RuleConditions]]:
    """Return failures with the conditions of the rule that they are under, the most typical first.

    Rules take turns, and what fails under none of them is the last to take one. Of each the failure nearest to the
    middle of its failures, by ranks, comes first.

    Args:
        found: the rows.
        rules: which rows they cover is said by their conditions; a row belongs to the first.
        most: failures at most.
    """
    left = ~found.right
    queues: list[list[tuple[int, RuleConditions]]] = []
    for conditions in (*(rule.conditions for rule in rules), ()):
        own = left & covered(conditions, found)
        left = left & ~own
        queues.append([(index, conditions) for index in _by_typicality(found, np.flatnonzero(own))])
    turns = (one for turn in zip_longest(*queues) for one in turn if one is not None)
    return list(islice(turns, most))


def _by_typicality(found: Observations, failures: npt.NDArray[np.intp]) -> list[int]:
    ranks = found.values.argsort(axis=0).argsort(axis=0)[failures] / len(found)
    away = np.abs(ranks - ranks.mean(axis=0)).sum(axis=1) if len(failures) else np.zeros(0)
    return [int(one) for one in failures[np.argsort(away, kind="stable")]]


def _sweep_of(index: int, asked: Sequence[_Asked]) -> _Asked:
    for one in asked:
        if index < len(one.rows):
            return one
        index -= len(one.rows)
    raise IndexError(index)


def pictures_again(config: SweepConfig, numbers: Sequence[int], progress: Progress) -> tuple[Tensor, Features]:
    """Return pictures (n, H, W, 3) of a sweep of one model, as the model saw them, and what reads its features.

    Raises:
        InputError: the scene is not to be had any more, or the task is another than classification.
    """
    job = job_of(config)
    if job.tasks[0].varies:
        raise InputError(f"task {config.task_name}: features are read of classifiers")
    check_all(job)
    scenes, pictures = Scenes(job), []
    for number in numbers:
        pictures.append(scenes.picture(number))
        progress.advance(1)
    return torch.stack(pictures), features_of(job.models[0])


# ---- rows of the answer ---------------------------------------------------------------------------------------------


def right_of(right: int, of: int) -> RightOf:
    """Return a count with the interval of its share."""
    return RightOf(right=right, total=of, interval=clopper_pearson(right, of))


def _rule_row(rule: CountedRule, factors: Sequence[Factor], confirmed: RightOf | None) -> RuleRow:
    return RuleRow(
        conditions=condition_rows(rule.conditions, factors),
        **vars(right_of(rule.right, rule.of)),
        elsewhere=right_of(rule.right_elsewhere, rule.of_elsewhere),
        confirmed=confirmed,
    )


def _envelope_row(one: Envelope, factors: Sequence[Factor], accuracy: float) -> EnvelopeRow:
    rows = condition_rows(one.conditions, factors)
    return EnvelopeRow(conditions=rows, **vars(right_of(one.right, one.of)), accuracy=accuracy, held=one.held)


def condition_rows(conditions: RuleConditions, factors: Sequence[Factor]) -> list[ConditionRow]:
    """Return conditions with the names of their factors."""
    return [_condition_row(one, factors[one.place]) for one in conditions]


def _condition_row(one: RuleCondition, factor: Factor) -> ConditionRow:
    return ConditionRow(
        parameter=factor.name,
        unit=factor.unit,
        over=one.low if np.isfinite(one.low) else None,
        at_most=one.high if np.isfinite(one.high) else None,
        options=[factor.options[number] for number in sorted(one.options or ())],
        text=one.text(factor),
    )


def _weights(importance: Sequence[FactorWeight], factors: Sequence[Factor]) -> list[ParameterWeight]:
    return [
        ParameterWeight(
            parameters=[factors[place].name for place in one.places],
            share=one.share,
            interval=one.interval,
            parts=one.parts,
        )
        for one in importance
    ]


def _not_told(rule: CountedRule, found: Observations) -> RuleNotTold:
    times = rule.times_needed()
    return RuleNotTold(
        conditions=condition_rows(rule.conditions, found.factors),
        **vars(right_of(rule.right, rule.of)),
        elsewhere=right_of(rule.right_elsewhere, rule.of_elsewhere),
        chance=rule.chance,
        asked=CHANCE,
        rows=None if times is None else round_up(times * len(found)),
    )


def round_up(rows: float) -> int:
    """Return a number of rows with two digits that mean something: 173.2 becomes 180."""
    step: int = 10 ** max(0, math.floor(math.log10(rows)) - 1)
    return math.ceil(rows / step) * step
