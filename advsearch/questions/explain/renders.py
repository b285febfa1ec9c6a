"""Sweeps that render anew what rows said: inside a rule, and along one factor from a failure."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from advsearch import seeds
from advsearch.controls import CONTROLS, Parameter
from advsearch.errors import FileFormatError, InputError, ModelError
from advsearch.experiment import RunContext
from advsearch.experiment import run_part as carry_out_part
from advsearch.interrupts import interruptible
from advsearch.models.features import Features, features_of
from advsearch.options import BY_KEY
from advsearch.progress import Progress
from advsearch.questions.explain.findings import find_clusters, right_of
from advsearch.questions.explain.result import Confirmation, FailureCluster, FailureClusters, NearestRight
from advsearch.questions.sweep.carry_out import scenes_of
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.report.wording import figure_value
from advsearch.rules import CountedRule, Mask, RuleConditions, covered, is_shown
from advsearch.runs.directory import CONFIG, PARTS
from advsearch.runs.summary import read_result
from advsearch.runs.tables import read_sweep
from advsearch.settings import split_names
from advsearch.viewer.thumbnails import path_of

ALONG = 9  # Values of a factor that are tried on the way to a right prediction
SIDES, LEAST_LEFT = 2, 0.2
"""Arcs of a circle that a condition has, at most. Share of a rule that no rule before it covers, from which on more is
rendered so that enough of it is left."""
OUTER = ("object", "environment", "model")
EXTENT = ("samples", "keep_pictures", "surface", "trials", "verify_spp")
"""Settings of a sweep that do not change what a picture with a number is, nor what is said of it."""


@dataclass(frozen=True, eq=False)
class AskedSweep:
    """One of the sweeps whose rows are read."""

    folder: Path
    config: SweepConfig
    summary: SweepSummary

    @classmethod
    def of(cls, folder: Path) -> AskedSweep:
        summary = read_result(folder)
        if not isinstance(summary, SweepSummary):
            raise FileFormatError(f"{folder}: expected the run of a sweep that has ended, got one of another command")
        return cls(folder, SweepConfig.from_yaml(folder / CONFIG), summary)


def read_predictions(sweeps: Sequence[AskedSweep]) -> pd.DataFrame:
    """Return the rows of some sweeps as one frame (`runs.tables`), with the number of their `sweep`; what is the same
    draw is one unit (`draw_names`), and the same picture, come again in a longer sweep of the same seed, is left out
    (`picture_names`). Object, environment and model are called as figures call them, and what a sweep has no parameter
    for is missing."""
    frames = []
    for number, sweep in enumerate(sweeps):
        is_drawn = sweep.summary.sampler is not None
        rows = read_sweep(sweep.folder, is_drawn=is_drawn).sort_values("step", ignore_index=True)
        for name in OUTER:
            called = rows[name].astype(object) if name in rows else pd.Series(getattr(sweep.summary, name), rows.index)
            rows[name] = called.map(figure_value)
        rows["draw"], rows["picture"] = draw_names(sweep, rows), picture_names(sweep, rows)
        frames.append(rows.assign(sweep=number))
    units = {name: unit for frame in frames for name, unit in frame.attrs["units"].items()}
    units = {**units, **dict.fromkeys(OUTER, "")}
    table = pd.concat(frames, ignore_index=True)
    table = table[~table.duplicated("picture")].reset_index(drop=True)
    for name in units:
        if not pd.api.types.is_float_dtype(table[name]):
            table[name] = table[name].astype("category")
    table["unit"] = np.unique(table["draw"], return_inverse=True)[1]
    table = table.drop(columns=["draw", "picture"])
    table["correct"] = (table["correct"] == 1) & is_shown(table)
    table.attrs["units"] = units
    return table


def draw_names(sweep: AskedSweep, rows: pd.DataFrame) -> list[str]:
    """Return the name of the draw that each row (n,) of a sweep is of, the same in another sweep of the same draw.

    What is drawn follows from the seed and the number of the draw, however many there are and whatever they are placed
    in: sweeps of one seed share their draws. Where nothing is drawn, pictures of the same values, or drives that begin
    with the same, differ in noise alone.
    """
    if sweep.summary.sampler is not None:
        return [f"draw {sweep.config.seed} {unit}" for unit in rows["unit"]]
    names = [name for name in (*OUTER[:2], *rows.attrs["units"]) if name not in ("model", "answer")]
    begins = rows.drop_duplicates("unit").set_index("unit")[list(dict.fromkeys(names))].astype(str)
    values = begins.agg(" ".join, axis=1)
    return [f"values {values[unit]}" for unit in rows["unit"]]


def picture_names(sweep: AskedSweep, rows: pd.DataFrame) -> list[str]:
    """Return a name of what each row (n,) of a sweep is: settings, number, values and model, so that equal ones are the
    same prediction of the same picture."""
    deciding = {name: value for name, value in sweep.config.deciding().items() if name not in EXTENT}
    values = rows[[*OUTER, *(name for name in rows.attrs["units"] if name not in OUTER)]].astype(str)
    texts = values.agg(" ".join, axis=1)
    named = zip(rows["step"], texts, rows["correct"], strict=True)
    return [f"{deciding} {step} {text} {correct}" for step, text, correct in named]


def values_of(rows: pd.DataFrame, place: int) -> dict[str, float | str]:
    known = rows.loc[place, list(rows.attrs["units"])].dropna().items()
    return {name: value if isinstance(value, str) else float(value) for name, value in known}


def sweep_inside(
    config: SweepConfig, table: pd.DataFrame, conditions: RuleConditions, samples: int, seed: int, arc: int = 0
) -> SweepConfig:
    """Return a sweep like another, of about so many configurations, most of which lie under the conditions. Ranges of
    what is drawn are cut to the conditions, as far as the rows went; axes of a grid to the values that the rows have
    there; names to those that are left. Of an angle that may lie on either side it is the side with the number `arc`.
    What cannot be cut has to be left out by whoever counts."""
    inside = table[covered(conditions, table)]
    left = {name: sorted(inside[name].unique().tolist()) for name in table.attrs["units"]}
    grid: dict[str, Any] = {name: left.get(name, values) for name, values in config.grid.items()}
    outer = {name: getattr(config, name) for name in OUTER}
    for name in OUTER:
        if name in left and outer[name] is not None:
            outer[name] = ",".join(like for value in left[name] for like in _like(config, name, value)) or outer[name]

    others = math.prod(len(split_names(names)) if names else 1 for names in outer.values())
    sizes = {name: len(values) if isinstance(values, list) else 1 for name, values in grid.items()}
    while math.prod(sizes.values()) * others > 2 * samples and max(sizes.values(), default=1) > 1:
        longest = max(sizes, key=sizes.__getitem__)
        grid[longest] = grid[longest][::2]
        sizes[longest] = len(grid[longest])
    points = math.prod(sizes.values()) * others
    controls = {name: dict(given) for name, given in config.controls.items()}
    for condition in conditions:
        factor, arcs = condition.factor, condition.arcs
        name, _, parameter = factor.partition(".")
        if condition.options is None and is_drawn(config, factor):
            low, high = max(condition.low, float(table[factor].min())), min(condition.high, float(table[factor].max()))
            low, high = arcs[arc % len(arcs)] if condition.turn else (low, high)
            declared = _declared(config, name) or {}
            if high > declared[parameter].high:
                continue
            # with a range for one parameter, the others would stay: they get what their rows have
            for other in declared if not declared.keys() & config.controls[name].keys() else ():
                column = table.get(f"{name}.{other}")
                if column is not None and other not in controls[name] and is_drawn(config, f"{name}.{other}"):
                    choices = {"choices": column.cat.categories.tolist()} if declared[other].options else None
                    controls[name][other] = choices or [float(column.min()), float(column.max())]
            controls[name][parameter] = [low, high]
    draws = math.ceil(samples / points) if controls else None
    return _quiet(config, grid=grid, controls=controls, samples=draws, seed=seed, **outer)


def is_drawn(config: SweepConfig, factor: str) -> bool:
    """Whether a sweep draws a parameter by chance, from a range that it can be given."""
    name, dot, parameter = factor.partition(".")
    is_frame = bool(config.path) and parameter == "time"
    known = name in config.controls and parameter in (_declared(config, name) or ())
    return bool(dot) and not is_frame and factor not in config.grid and known


def can_be_given(config: SweepConfig, name: str) -> bool:
    """Whether a sweep can be told a value of its rows; others follow from those, as `path.distance` from the time."""
    instance, dot, parameter = name.partition(".")
    declared = _declared(config, instance)
    return not dot or declared is None or parameter in declared


def _declared(config: SweepConfig, name: str) -> dict[str, Parameter] | None:
    """The parameters of a control by their names; None where these are the scene's."""
    given = config.controls.get(name, {})
    kind = CONTROLS.get(str(given.get("kind", name.partition(":")[0])))
    return None if kind is None or kind.kind == BY_KEY else {one.name: one for one in kind.declared(given)}


def along(
    config: SweepConfig, row: Mapping[str, float | str], factor: str, table: pd.DataFrame, seed: int
) -> SweepConfig:
    """Return a sweep along one factor with everything else as a row has it; the row's own value comes first."""
    column = table[factor]
    if column.dtype == "category":
        others: Sequence[float | str] = column.cat.categories.tolist()
    else:
        others = [float(f"{value:.4g}") for value in np.linspace(column.min(), column.max(), ALONG)]
    values = list(dict.fromkeys([row[factor], *others]))
    grid: dict[str, object] = {name: [row[name]] for name in row if "." in name and can_be_given(config, name)}
    outer = {name: next(iter(_like(config, name, str(row[name]))), None) for name in OUTER}
    if factor in OUTER:
        outer[factor] = ",".join(like for value in values for like in _like(config, factor, str(value)))
    else:
        grid[factor] = values
    controls = {}
    for name, given in config.controls.items():
        kind = CONTROLS.get(str(given.get("kind", name)))
        chosen = {choice.name for choice in getattr(kind, "choices", ())} & {*given}
        if kind and chosen and all(f"{name}.{parameter.name}" in grid for parameter in kind.declared(given)):
            controls[name] = {key: value for key, value in given.items() if key in {*chosen, "kind"}}
    fixed = {name: value for name, value in config.set_.items() if name not in grid}
    alone = {"workers": None, "cluster": None}  # ten pictures take less than a worker takes to load
    kept: dict[str, object] = {"keep_pictures": "all", "set": fixed, **alone}
    return _quiet(config, grid=grid, controls=controls, samples=None, seed=seed, **kept, **outer)


def _like(config: SweepConfig, name: str, value: str) -> list[str]:
    """Of the names that a sweep was given, those that its rows write so."""
    given = split_names(getattr(config, name)) if getattr(config, name) else ()
    return [one for one in given if value in (one, figure_value(one))] or list(given[:1])


def _quiet(config: SweepConfig, **changes: object) -> SweepConfig:
    quiet = {"trials": 0, "verify_spp": None, "keep_pictures": "none", "aov": None, "surface": False}
    sampler = {} if changes.get("controls") else {"sampler": "sobol"}
    return SweepConfig(**{**config.plain(), **quiet, **changes, **sampler})


@dataclass
class Renders:
    """Sweeps in the folder of the run; none any more after an interrupt. `rows` are those of the sweeps that are asked
    about, `table` what varies among them."""

    asked: RunContext[Any]
    sweeps: Sequence[AskedSweep]
    rows: pd.DataFrame
    table: pd.DataFrame
    count: int = 0
    pairs_sought: int = 0  # failures for which pictures were rendered
    interrupted: bool = False
    warnings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.config, self.progress, self.folder = self.asked.config, self.asked.progress, self.asked.run.path

    def _rendered(self, name: str, config: SweepConfig) -> pd.DataFrame | None:
        """The rows of a sweep; None if it was interrupted, or the scene is not to be had any more."""
        if self.interrupted:
            return None
        path = self.folder / PARTS / name
        own = config.model_copy(update={"threads": self.config.threads}) if self.config.threads else config
        try:
            done = carry_out_part(path, own, self.progress)
        except InputError as error:
            if not any(one.endswith(f": {error}") for one in self.warnings):  # once for all pairs of a kind
                self.warnings.append(f"Nothing was rendered for {name}: {error}")
            return None
        assert isinstance(done, SweepSummary)
        self.interrupted = done.goes_on
        self.count += sum(done.renders.values())
        return None if self.interrupted else read_predictions([AskedSweep(path, own, done)])

    def confirmed(self, rules: Sequence[CountedRule], number: int) -> Confirmation | None:
        """Render fresh configurations inside a rule and outside those before it, in the scene of each sweep. They
        confirm it where they alone, beside the rows elsewhere, tell it."""
        if not self.config.confirm:
            return None
        rule, before = rules[number], [earlier.conditions for earlier in rules[:number]]
        under = self.table[covered(rule.conditions, self.table)]
        left = float(beyond(before, under).mean())
        fresh = []
        for place, sweep in enumerate(self.sweeps):
            sides = max((len(c.arcs) for c in rule.conditions if is_drawn(sweep.config, c.factor)), default=1) or 1
            samples = math.ceil(self.config.confirm / len(self.sweeps) / sides / max(left, LEAST_LEFT))
            for side in range(sides):
                part = (number * len(self.sweeps) + place) * SIDES + side
                seed = seeds.stream(self.config.seed, "confirm", part)
                self.progress.message(f"rule {number + 1}: rendering about {samples} configurations inside it")
                config = sweep_inside(sweep.config, self.table, rule.conditions, samples, seed, side)
                rows = self._rendered(f"rule-{number + 1}-{place}" + (f"-{side}" if side else ""), config)
                if rows is not None:
                    inside = rows[covered(rule.conditions, rows) & beyond(before, rows) & is_shown(rows)]
                    fresh.append(inside.assign(unit=inside["unit"].astype(str) + f" of {part}"))
        kept = pd.concat(fresh) if fresh else self.rows[:0]
        if kept.empty:
            return None
        elsewhere = rule.elsewhere.assign(unit=rule.elsewhere["unit"].astype(str))
        again = CountedRule(rule.conditions, kept, elsewhere)
        return Confirmation(**vars(right_of(kept)), held=again.holds)

    def pairs(self, rules: Sequence[CountedRule]) -> Iterator[NearestRight]:
        """The nearest right configurations to typical failures, along the parameters of their rule or else the others.
        A failure that no parameter alone puts right has none."""

        def moved(pair: NearestRight) -> float:
            """How far the value moved, as a share of what the rows have; another name is as far as it goes."""
            column = self.table[pair.parameter]
            if column.dtype == "category":
                return 1.0
            return abs(float(pair.right_at) - float(pair.wrong_at)) / float(column.max() - column.min())

        failures = typical_failures(self.table, rules, self.config.pairs)
        for number, (place, conditions) in enumerate(failures, start=1):
            first = [condition.factor for condition in conditions]
            others = [[factor] for factor in self.table.attrs["units"] if factor not in first]
            self._is_counted = False  # this failure, in `pairs_sought`
            for factors in (first, *others):
                near = [pair for factor in factors if (pair := self._nearest(f"pair-{number}", place, factor))]
                if near:
                    yield min(near, key=moved)
                    break

    def _nearest(self, name: str, place: int, factor: str) -> NearestRight | None:
        """Go along one factor until the prediction is right, twice with other noise; the failure fails in both."""
        config, row = self.sweeps[self.rows["sweep"][place]].config, values_of(self.rows, place)
        if not can_be_given(config, factor):
            return None
        self.progress.message(f"{name}: the nearest right prediction along {factor}")
        label = f"{name}-{factor.replace('.', '_')}"
        passes = []
        for number in range(2):
            seed = seeds.stream(self.config.seed, f"{label} {number}")
            rows = self._rendered(f"{label}-{number}", along(config, row, factor, self.table, seed))
            if rows is None:
                return None
            passes.append(rows)
        self.pairs_sought += not self._is_counted
        self._is_counted = True
        first, second = passes
        own, values = row[factor], first[factor].tolist()
        start, right = values.index(own), np.asarray(first["correct"] & second["correct"])
        if not right.any() or first["correct"][start] or second["correct"][start]:
            return None
        is_number = self.table[factor].dtype != "category"
        at = min(np.flatnonzero(right), key=lambda k: abs(float(values[k]) - float(own)) if is_number else 0.0)
        kept = (path_of(self.folder / PARTS / f"{label}-0", int(k)) for k in (start, at))
        return NearestRight(
            values=row,
            parameter=factor,
            unit=self.table.attrs["units"][factor],
            wrong_at=own,
            right_at=values[at],
            answered=first["label"][start],
            answered_there=first["label"][at],
            pictures=[str(path.relative_to(self.folder)) for path in kept if path.is_file()],
        )

    def clusters(self) -> FailureClusters | None:
        """Render failures of one model's sweeps again, and group them by what it decides by."""
        alone = [number for number, one in enumerate(self.sweeps) if len(one.config.models) == 1]
        alike = [number for number in alone if self.sweeps[number].config.models == self.sweeps[alone[0]].config.models]
        failing = self.rows[~self.rows["correct"] & self.rows["sweep"].isin(alike)]
        if self.interrupted or not self.config.clusters or failing.empty:
            return None
        if len(alike) < len(self.sweeps):
            name = self.sweeps[alike[0]].config.model
            self.warnings.append(f"Kinds are of the failures of model {name} alone, where it was swept by itself.")
        generator = np.random.default_rng(seeds.stream(self.config.seed, "clusters"))
        picked = failing.iloc[np.sort(generator.permutation(len(failing))[: self.config.clusters])]
        self.progress.stage("rendering failures again", len(picked), hint="`clusters` says how many")
        try:
            with interruptible():
                again = [
                    pictures_again(self.sweeps[number].config, rows["step"].tolist(), self.progress)
                    for number, rows in picked.groupby("sweep")
                ]
        except KeyboardInterrupt:
            self.interrupted = True
            return None
        except (InputError, ModelError) as error:
            self.warnings.append(f"No failures were grouped: {error}")
            return None
        self.count += len(picked)
        pictures, features = torch.cat([some for some, _ in again]), again[0][1]
        found = find_clusters(features(pictures).double().numpy(), self.config.seed)
        listed = []
        for number, members in enumerate(found.members, start=1):
            path = self.asked.run.save_image(f"cluster-{number}", pictures[members[0]])
            own = picked.iloc[list(members)]
            listed.append(
                FailureCluster(
                    failures=len(own),
                    answers=dict(Counter(own["label"]).most_common()),
                    values=values_of(own, own.index[0]),
                    picture=str(path.relative_to(self.folder)),
                )
            )
        return FailureClusters(
            features=features.source,
            failures=len(picked),
            silhouette=found.silhouette,
            apart=found.apart,
            listed=listed,
        )


def beyond(rules: Sequence[RuleConditions], rows: pd.DataFrame) -> Mask:
    left = np.ones(len(rows), np.bool_)
    for one in rules:
        left &= ~covered(one, rows)
    return left


def typical_failures(table: pd.DataFrame, rules: Sequence[CountedRule], most: int) -> list[tuple[int, RuleConditions]]:
    """Return the places of at most so many failures with the conditions of the rule that they are under, the most
    typical first. Rules take turns, a row belongs to the first that covers it, and what fails under none of them is the
    last to take one. Of each the failure nearest to the middle of its failures, by ranks, comes first."""
    columns = (table[name] for name in table.attrs["units"])
    numbers = [one.cat.codes if one.dtype == "category" else one for one in columns]
    ranks = np.stack(numbers, axis=1).astype(np.float64).argsort(axis=0).argsort(axis=0) / len(table)
    left: Mask = ~table["correct"].to_numpy()
    queues = []
    for conditions in (*(rule.conditions for rule in rules), ()):
        own = np.flatnonzero(left & covered(conditions, table))
        left[own] = False
        away = np.abs(ranks[own] - ranks[own].mean(axis=0)).sum(axis=1) if len(own) else np.zeros(0)
        queues.append([(int(place), conditions) for place in own[np.argsort(away, kind="stable")]])
    turns = (one for turn in zip_longest(*queues) for one in turn if one is not None)
    return list(islice(turns, most))


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
