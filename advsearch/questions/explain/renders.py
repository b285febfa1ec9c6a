"""Sweeps that render anew what rows said: inside a rule, and along one factor from a failure."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice, zip_longest
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch import seeds
from advsearch.api.studies import carry_out_part
from advsearch.config import SweepConfig
from advsearch.controls import CONTROLS
from advsearch.errors import FileFormatError, InputError, ModelError
from advsearch.explanations import (
    Answered,
    CountedRule,
    Factor,
    Mask,
    Observations,
    RuleCondition,
    RuleConditions,
    covered,
    figure_value,
    rows_of,
)
from advsearch.interrupts import interruptible
from advsearch.models.features import Features, features_of
from advsearch.options import BY_KEY
from advsearch.progress import Progress
from advsearch.questions.explain.answer import FailureCluster, FailureClusters, NearestRight, RightOf
from advsearch.questions.explain.findings import find_clusters
from advsearch.questions.explain.settings import ExplainConfig
from advsearch.questions.sweep.carry_out import scenes_of
from advsearch.runs.directory import CONFIG, PARTS, RunDirectory
from advsearch.runs.results.sweep import SweepSummary
from advsearch.runs.summary import read_result
from advsearch.settings import split_names
from advsearch.viewer.thumbnails import path_of

ALONG = 9
"""Values of a factor that are tried on the way to a right answer."""
OUTER = ("object", "environment", "model")


def sweep_inside(
    config: SweepConfig, found: Observations, conditions: RuleConditions, samples: int, seed: int
) -> SweepConfig:
    """Return a sweep like another, of about so many configurations, most of which lie under the conditions.

    Ranges of what is drawn are cut to the conditions, as far as the rows went; axes of a grid to the values that the
    rows have there; names to those that are left. What cannot be cut has to be left out by whoever counts.
    """
    mask = covered(conditions, found)
    grid = {name: _values(found, mask, name, given) for name, given in config.grid.items()}
    outer = {name: _names(config, found, mask, name) for name in OUTER}
    others = math.prod(len(split_names(names)) if names else 1 for names in outer.values())
    while grid and math.prod(map(_size, grid.values())) * others > 2 * samples:
        longest = max(grid, key=lambda name: _size(grid[name]))
        if _size(grid[longest]) < 2:
            break
        values = grid[longest]
        assert isinstance(values, list)
        grid[longest] = values[::2]
    points = math.prod(map(_size, grid.values())) * others
    cut = {one.place: one for one in conditions}
    controls = {name: {**given, **_ranges(config, name, found, mask, cut)} for name, given in config.controls.items()}
    draws = math.ceil(samples / points) if controls else None
    return _quiet(config, grid=grid, controls=controls, samples=draws, seed=seed, **outer)


def along(
    config: SweepConfig, row: Mapping[str, float | str], factor: Factor, found: Observations, seed: int
) -> SweepConfig:
    """Return a sweep along one factor with everything else as a row has it; the row's own value comes first."""
    place = found.factors.index(factor)
    own = row[factor.name]
    if factor.options:
        values: list[float | str] = [own, *(name for name in factor.options if name != own)]
    else:
        column = found.values[:, place]
        spread = [float(f"{one:.4g}") for one in np.linspace(column.min(), column.max(), ALONG)]
        values = [own, *(one for one in dict.fromkeys(spread) if one != own)]
    grid: dict[str, object] = {name: [row[name]] for name in row if "." in name and can_be_given(config, name)}
    outer = {name: next(iter(_like(config, name, str(row[name]))), None) for name in OUTER}
    if factor.name in OUTER:
        several = [one for value in values for one in _like(config, factor.name, str(value))]
        outer[factor.name] = ",".join(several)
    else:
        grid[factor.name] = values
    fixed = {name: value for name, value in config.set_.items() if name not in grid}
    alone = {"workers": None, "cluster": None}  # ten pictures take less than a worker takes to load
    kept: dict[str, object] = {"keep_pictures": "all", "set": fixed, **alone}
    return _quiet(config, grid=grid, controls={}, samples=None, seed=seed, **kept, **outer)


def can_be_given(config: SweepConfig, name: str) -> bool:
    """Whether a sweep can be told a value of its rows; others follow from those, as `path.distance` from the time."""
    instance, dot, parameter = name.partition(".")
    given = config.controls.get(instance, {})
    kind = str(given.get("kind", instance.partition(":")[0]))
    if not dot or kind == BY_KEY or kind not in CONTROLS:
        return True
    return parameter in {one.name for one in CONTROLS[kind].declared(given)}


def lies_inside(conditions: RuleConditions, factors: tuple[Factor, ...], row: Mapping[str, float | str]) -> bool:
    """Whether a row lies under all conditions."""
    return all(_holds(one, factors[one.place], row[factors[one.place].name]) for one in conditions)


def _holds(condition: RuleCondition, factor: Factor, value: float | str) -> bool:
    if condition.options is not None:
        return str(value) in {factor.options[one] for one in condition.options}
    return condition.low < float(value) <= condition.high


def _quiet(config: SweepConfig, **changes: object) -> SweepConfig:
    """A sweep with nothing beside its rows."""
    more: dict[str, object] = {"trials": 0, "verify_spp": None, "keep_pictures": "none", "aov": None, "surface": False}
    known = {*SweepConfig.model_fields, "set"}
    given = {name: value for name, value in {**more, **changes}.items() if name in known}
    if not given.get("controls"):
        given["sampler"] = "sobol"
    return SweepConfig(**{**config.plain(), **given})


def _values(found: Observations, mask: Mask, name: str, given: object) -> object:
    """The values of an axis that the rows under the mask have; what was given where it does not vary."""
    place = next((k for k, one in enumerate(found.factors) if one.name == name), None)
    if place is None:
        return given
    options, values = found.factors[place].options, np.unique(found.values[mask, place])
    return [options[int(one)] for one in values] if options else [float(one) for one in values]


def _size(values: object) -> int:
    return len(values) if isinstance(values, list) else 1


def _names(config: SweepConfig, found: Observations, mask: Mask, name: str) -> str | None:
    """The objects, environments or models that the rows under the mask have."""
    left = _values(found, mask, name, None)
    given = getattr(config, name)
    if not isinstance(left, list) or given is None:
        return given if given is None else str(given)
    return ",".join(one for value in left for one in _like(config, name, str(value))) or str(given)


def _like(config: SweepConfig, name: str, value: str) -> list[str]:
    """Of the names that a sweep was given, those that its rows write so."""
    given = split_names(getattr(config, name)) if getattr(config, name) else ()
    return [one for one in given if value in (one, figure_value(one))] or list(given[:1])


def _ranges(
    config: SweepConfig, control: str, found: Observations, mask: Mask, cut: Mapping[int, RuleCondition]
) -> dict[str, object]:
    """The ranges of what a control draws, where a condition cuts them; not of an axis of the grid, frames among them,
    nor of what follows from other numbers."""
    ranges: dict[str, object] = {}
    axes = {*config.grid, *([f"{control}.time"] if config.path else [])}
    for place, condition in cut.items():
        name = found.factors[place].name
        instance, dot, parameter = name.partition(".")
        if name in axes or not can_be_given(config, name):
            continue
        if instance == control and dot and condition.options is None:
            column = found.values[:, place]
            low, high = max(condition.low, float(column.min())), min(condition.high, float(column.max()))
            ranges[parameter] = [low, high]
    return ranges


@dataclass(frozen=True)
class AskedSweep:
    """One of the sweeps whose rows are read."""

    folder: Path
    config: SweepConfig
    summary: SweepSummary
    rows: list[Answered]

    @classmethod
    def of(cls, folder: Path) -> AskedSweep:
        summary = read_result(folder)
        if not isinstance(summary, SweepSummary):
            raise FileFormatError(f"{folder}: expected the run of a sweep that has ended, got one of another command")
        return cls(folder, SweepConfig.from_yaml(folder / CONFIG), summary, rows_of("", folder, summary))

    @property
    def units(self) -> list[str]:
        """The unit of each row; sweeps of the same draws share theirs, so that two models' are not told twice."""
        deciding = self.config.deciding()
        drawn = {name: deciding[name] for name in ("grid", "controls", "samples", "sampler", "seed")}
        return [f"{row.unit} {drawn}" for row in self.rows]


@dataclass
class Renders:
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
            said = any(one.endswith(f": {error}") for one in self.warnings)  # once for all pairs of a kind
            self.warnings += [] if said else [f"Nothing was rendered for {name}: {error}"]
            return None
        assert isinstance(done, SweepSummary)
        self.interrupted = done.goes_on
        self.count += sum(done.renders.values())
        return None if self.interrupted else rows_of("", path, done)

    def confirmed(self, rule: CountedRule, number: int, asked: Sequence[AskedSweep]) -> RightOf | None:
        """Render fresh configurations inside a rule, in the scene of each sweep."""
        if not self.config.confirm:
            return None
        rows: list[tuple[int, Answered]] = []
        for place, one in enumerate(asked):
            seed = seeds.stream(self.config.seed, "confirm", number * len(asked) + place)
            samples = -(-self.config.confirm // len(asked))
            self.progress.message(f"rule {number + 1}: rendering about {samples} configurations inside it")
            own = sweep_inside(one.config, self.found, rule.conditions, samples, seed)
            rows += [(place, row) for row in self._rows(f"rule-{number + 1}-{place}", own) or []]
        kept = [each for each in rows if lies_inside(rule.conditions, self.found.factors, each[1].values)]
        right = np.array([row.correct for _, row in kept], dtype=bool)
        units = np.array([f"{place} {row.unit}" for place, row in kept])
        return right_of(Observations((), np.zeros((len(kept), 0)), right, _numbers(units))) if kept else None

    def pairs(
        self, rules: Sequence[CountedRule], rows: Sequence[Answered], asked: Sequence[AskedSweep]
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

    def clusters(self, asked: Sequence[AskedSweep], run: RunDirectory) -> FailureClusters | None:
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

    def _nearest(self, name: str, one: AskedSweep, row: Answered, factor: Factor) -> NearestRight | None:
        """Go along one factor until the answer is right, twice with other noise; the failure fails in both."""
        if not can_be_given(one.config, factor.name):
            return None
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
    """Return at most so many failures with the conditions of the rule that they are under, the most typical first.

    Rules take turns, a row belongs to the first that covers it, and what fails under none of them is the last to take
    one. Of each the failure nearest to the middle of its failures, by ranks, comes first.
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


def _sweep_of(index: int, asked: Sequence[AskedSweep]) -> AskedSweep:
    for one in asked:
        if index < len(one.rows):
            return one
        index -= len(one.rows)
    raise IndexError(index)


def pictures_again(config: SweepConfig, numbers: Sequence[int], progress: Progress) -> tuple[Tensor, Features]:
    """Return pictures (n, H, W, 3) of a sweep of one model, as the model saw them, and what reads its features; an
    InputError where the scene is not to be had any more, or the task is another than classification."""
    scenes, pictures = scenes_of(config), []
    if scenes.job.tasks[0].varies:
        raise InputError(f"task {config.task_name}: features are read of classifiers")
    for number in numbers:
        pictures.append(scenes.picture(number))
        progress.advance(1)
    return torch.stack(pictures), features_of(scenes.job.models[0])


def right_of(found: Observations) -> RightOf:
    """Return a count with the interval of its share."""
    return RightOf(right=int(found.right.sum()), total=len(found), interval=found.interval)


def _numbers(names: npt.NDArray[np.str_]) -> npt.NDArray[np.int64]:
    return np.unique(names, return_inverse=True)[1].reshape(-1).astype(np.int64)
