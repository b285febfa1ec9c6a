"""`harden`: trains a copy of a model on its worst cases, and measures it on what training never saw, before and
after."""

from __future__ import annotations

import gc
import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from advsearch import seeds
from advsearch.api.keywords import asks, configured
from advsearch.attacks import clopper_pearson
from advsearch.cluster import Executor, InProcess
from advsearch.engine.journal import check_made_of
from advsearch.engine.naming import AnyModel, check_not_spread, check_run_settings, load_models, model_name
from advsearch.errors import ClusterError, InputError, ModelError
from advsearch.interrupts import interruptible
from advsearch.models.reference import trainable
from advsearch.models.source import split_weights
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.attack.parts import LOADING, executor_for
from advsearch.questions.harden.answer import HardenedControl, HardenResult, Share, SplitSide, hardened_figure
from advsearch.questions.harden.lessons import FOLDER, Lesson
from advsearch.questions.harden.scenes import (
    CLEAN_SCENES,
    CLEAN_VIEWS,
    FURTHER,
    HELD_OUT,
    ROBUST,
    TIMES,
    TRAINING,
    VALIDATION,
    Attacking,
    Drawing,
    Looking,
    SceneWork,
    Wanted,
    check_disjoint,
    splits_of,
)
from advsearch.questions.harden.settings import PLAIN_SCENES, RENDERED_SCENES, HardenConfig
from advsearch.questions.harden.training import (
    VALIDATION_VIEWS,
    WEIGHTS,
    Course,
    Examples,
    MakeOptimiser,
    TrainingRounds,
    right_share,
)
from advsearch.runs.directory import ARTIFACTS, IMAGES, RunDirectory, is_run, run_path
from advsearch.runs.files import write_bytes
from advsearch.runs.results import INTERRUPTED, SharedWork
from advsearch.runs.store import Row
from advsearch.tasks import make_task
from advsearch.viewer.pages import keep_answer

MEASURED, MEANS = "measured", "means"
"""Notes under which the store keeps what is done."""
MEASUREMENTS = ("before", "stronger_before", "after", "stronger")
"""What is measured over each control, by its name in the table."""
SHARED, MOVED = 0.25, 0.5
"""Shares of the scenes with a texture in which all views have the same, and in which rendered controls vary too."""


@asks(HardenConfig)
def harden(
    model: AnyModel = "reference",
    *,
    optimiser: MakeOptimiser | None = None,
    beside: Examples | None = None,
    resume: bool = False,
    progress: Watched = None,
    **settings: Any,
) -> HardenResult:
    """Train a copy of a model on its worst cases, and prove what it is better at (docs/harden.md).

    All other arguments are the settings of `advsearch harden`. The run is kept, in `run` or under runs/. The model that
    is given stays as it is.

    Args:
        model: a classifier: what `load_model` takes, and no exported program.
        optimiser: makes one of the list of parameters, such as ``lambda p: torch.optim.SGD(p, 0.01)``; its learning
            rate is then the highest, in place of `rate`.
        beside: batches of further examples, such as a `DataLoader`: images (N, H, W, 3) sRGB in [0, 1], class indices
            (N,). One is taken with each step.
        resume: go on with the run of that name, if there is one, where it was stopped; everything else has to be as it
            was.
    """
    if not isinstance(model, (str, Path)):
        check_not_spread(settings)
    config = configured(HardenConfig, model=model_name(model), **settings)
    path = run_path(config.run) if resume and config.run is not None else None
    resumed = path if path is not None and is_run(path) else None
    return harden_from_config(
        config, progress=watcher(progress), resumed=resumed, model=model, optimiser=optimiser, beside=beside
    )


def harden_from_config(
    config: HardenConfig,
    *,
    progress: Progress | None = None,
    resumed: Path | None = None,
    model: AnyModel | None = None,
    optimiser: MakeOptimiser | None = None,
    beside: Examples | None = None,
) -> HardenResult:
    """Do what a configuration describes, or go on with it; see `harden`. None takes the configuration's model."""
    begun, progress = time.perf_counter(), progress or NullProgress()
    progress.stage(LOADING)
    check_run_settings(config)
    task = make_task(config.task)
    try:
        (loaded, *_), warnings = load_models([config.model if model is None else model], task, config)
    except ModelError as error:
        raise ModelError(f"{str(error).partition(': use `task=')[0]}; harden trains classifiers") from error
    course = Course(trainable(loaded, config.layers), loaded, config, optimiser, beside)
    splits = splits_of(config, loaded)
    with RunDirectory.of(config, resumed) as run:
        _same_means(run, {"optimiser": optimiser is not None, "beside": beside is not None})
        check_made_of(run, [loaded])
        work = Hardening(run, course, SceneWork(config, loaded, splits), progress)
        try:
            with (
                interruptible(),
                executor_for(config, "advsearch.questions.harden.scenes:scenes_of", progress) as executor,
            ):
                work.carry_out(executor or InProcess(work.scenes))
            ending = "done"
        except KeyboardInterrupt:
            ending = INTERRUPTED
        result = work.result(ending, warnings, time.perf_counter() - begun)
        for suffix, data in hardened_figure(result).items():
            write_bytes(run.path / IMAGES / f"{config.command}.{suffix}", data)
        return keep_answer(run, result)


def _same_means(run: RunDirectory, given: dict[str, bool]) -> None:
    """Note what a training has from Python, or refuse (InputError) to go on with other means than it began with."""
    before = json.loads(run.store.note(MEANS) or "{}")
    if not before:
        run.store.set_note(MEANS, json.dumps(given))
    for name, was in before.items():
        if was != given[name]:
            raise InputError(
                f"{run.path}: cannot go on: it began {'with' if was else 'without'} `{name}`, which only Python gives; "
                "go on with advsearch.harden(..., run=..., resume=True) and the same arguments"
            )


class Hardening:
    """One run of `harden`: a course that trains a copy of the model, and scenes, with what was asked and the model as
    it was given."""

    def __init__(self, run: RunDirectory, course: Course, scenes: SceneWork, progress: Progress) -> None:
        self.run, self.course, self.scenes, self.progress = run, course, scenes, progress
        self.config, self.seconds = scenes.config, dict[str, float]()
        self.rounds = TrainingRounds(run, course, self.drawn, progress)
        self.measured: dict[str, str] = json.loads(run.store.note(MEASURED) or "{}")
        self.clean: dict[str, Share] = {}
        self._executor: Executor = InProcess(scenes)

    @cached_property
    def further(self) -> int:
        """Scenes that come with each one of the training."""
        return RENDERED_SCENES if self.scenes.rendered else PLAIN_SCENES

    @property
    def counts(self) -> dict[str, int]:
        """Scenes of each split, by its name; of those that are held out a part is attacked."""
        searched, held = self.config.scenes * self.config.rounds, CLEAN_SCENES * self.config.measured
        return {TRAINING: searched, FURTHER: self.further * searched, VALIDATION: self.rounds.judged, HELD_OUT: held}

    def carry_out(self, executor: Executor) -> None:
        """Measure, train, and measure again; the executor does what there is to do with scenes."""
        self._executor, sides = executor, self.scenes.splits
        check_disjoint(sides[HELD_OUT], [sides[name] for name in (TRAINING, FURTHER, VALIDATION)])
        gc.freeze()  # as of `scenes_of`
        try:
            with self._timed("measurement"):
                self._measure("before", "attacking the model as it is")
                self._measure("stronger_before", "attacking it with a stronger search", known="before")
            with self._timed("training"):
                self.rounds.carry_out()
            with self._timed("measurement"):
                weights = (self.run.path / ARTIFACTS / WEIGHTS).read_bytes()
                self._measure("after", "attacking the hardened model", weights)
                self._measure("stronger", "attacking it with a stronger search", weights, known="after")
                wanted = [Looking(number) for number in range(self.counts[HELD_OUT])]
                self.progress.stage("looking at plain pictures of held-out scenes", len(wanted))
                seen = [one for _, some in self._each(wanted) for one in some]
                for which, model in (("before", self.scenes.model), ("after", self.course.student.model)):
                    self.clean[which] = _share(round(right_share(model, seen, "plain") * len(seen)), len(seen))
        finally:
            gc.unfreeze()

    @contextmanager
    def _timed(self, part: str) -> Iterator[None]:
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[part] = self.seconds.get(part, 0.0) + time.perf_counter() - begun

    def _each(self, wanted: Sequence[Wanted]) -> Iterator[tuple[int, Any]]:
        """Have done what is wanted of scenes; yield the place of each and what came of it, in any order."""
        places = {id(one): place for place, one in enumerate(wanted)}
        for done in self._executor.results([one] for one in wanted):
            (one,) = done.items
            if done.lost:
                raise ClusterError(f"harden, scene {one.number}: {done.lost}")
            facts = self._executor.facts
            self.progress.advance(1, **({} if facts is None else facts.told))
            yield places[id(one)], done.value[0]

    def drawn(self, title: str, split: str, places: Sequence[int], views: int) -> list[Lesson]:
        """Return lessons of scenes: for each control whose pictures a matrix says, and for all others together.

        In the training a fourth of the scenes have one texture for all views, in half of them the controls that are
        rendered vary by chance, and further scenes come on top: of what is rendered new scenes teach more than further
        views. Of what is rendered one in so many scenes is drawn as it is, too: there the given model's answers count.
        """
        linear, rendered, training = self.scenes.linear, self.scenes.rendered, split == TRAINING
        wanted = list[Drawing]()
        for one in linear:
            for number in places:
                shared, moved = self.chance(one, number) if training else (False, False)
                wanted.append(Drawing(split, number, (one,), views, 1, shared, self.scenes.beside if moved else ()))
        more = [self.further * place + one for place in places for one in range(self.further)] if training else []
        if rendered:
            harder, plain = (1, 1) if training else (views, 0)
            wanted += [Drawing(split, number, rendered, harder, plain) for number in places]
            wanted += [Drawing(FURTHER, number, rendered, 1, 0) for number in more]
        else:
            wanted += [Drawing(FURTHER, number, linear[:1], 0, 1) for number in more]
        self.progress.stage(title, len(wanted))
        found = dict(self._each(wanted))
        return [one for place in range(len(wanted)) for one in found[place]]

    def chance(self, control: str, number: int) -> tuple[bool, bool]:
        """Return whether all views of a scene have one texture, and whether other controls vary beside it. Not by
        turns, as the objects take turns."""
        shared, moved = np.random.default_rng(seeds.stream(self.config.seed, f"views of {control}", number)).random(2)
        return bool(shared < SHARED), bool(moved < MOVED)

    def _measure(self, which: str, title: str, weights: bytes | None = None, *, known: str | None = None) -> None:
        """Attack the model, as it was given or with other weights, on every held-out scene over each control; what is
        measured is not attacked again. With the name of what is `known` of the usual search: by the stronger one, and
        what that had found is not sought any harder."""
        config, wanted = self.config, list[Attacking]()
        times = 1 if known is None else TIMES
        for number in range(config.measured):
            for control in config.controls:
                if f"{which} {control} {number}" in self.measured:
                    continue
                if known is not None and self.measured[f"{known} {control} {number}"] != ROBUST:
                    self._note(which, control, number, "found before")
                else:
                    wanted.append(Attacking(control, number, times, weights))
        self.progress.stage(title, len(wanted), hint="`measured` and `steps` shorten it")
        for place, ending in self._each(wanted):
            self._note(which, wanted[place].control, wanted[place].number, ending)

    def _note(self, which: str, control: str, number: int, ending: str) -> None:
        self.measured[f"{which} {control} {number}"] = ending
        self.run.store.set_note(MEASURED, json.dumps(self.measured))
        seed = seeds.stream(self.config.seed, f"measured {control}", number)
        wrong = ending != ROBUST
        self.run.record(Row(f"{which} {control}", number, seed=seed, spp=self.config.verify_spp, success=wrong))

    def _robust(self, which: str, controls: Sequence[str]) -> Share | None:
        """Scenes that are robust to the searches over all of some controls; None where some are not known."""
        scenes = range(self.config.measured)
        endings = [[self.measured.get(f"{which} {control} {number}") for control in controls] for number in scenes]
        if any(one is None for row in endings for one in row):
            return None
        return _share(sum(all(one == ROBUST for one in row) for row in endings), len(endings))

    def result(self, ending: str, warnings: list[str], seconds: float) -> HardenResult:
        """Return what is known."""
        config, done = self.config, ending == "done"
        table = []
        for control in config.controls:
            shares = {which: self._robust(which, [control]) for which in MEASUREMENTS}
            if all(one is not None for one in shares.values()):
                table.append(HardenedControl(control=control, **shares))
        if done and self.rounds.best == 0:
            warnings = [*warnings, "No round kept the clean accuracy, so the weights are the model's own."]
        rounds = [
            one.model_copy(update={"kept": done and n == self.rounds.best}) for n, one in enumerate(self.rounds.done)
        ]
        weights = self.run.path / ARTIFACTS / WEIGHTS
        views = {TRAINING: config.views, FURTHER: 1, VALIDATION: VALIDATION_VIEWS, HELD_OUT: CLEAN_VIEWS}
        names, facts, (name, _) = list(config.controls), self._executor.facts, split_weights(config.model)
        return HardenResult(
            run=str(self.run.path),
            environment=",".join(self.scenes.splits[TRAINING].environments),
            objects=list(self.scenes.splits[TRAINING].objects),
            controls=names,
            model=config.model,
            task=config.task_name,
            ending=ending,
            before=self._robust("before", names),
            after=self._robust("after", names),
            clean_before=self.clean.get("before"),
            clean_after=self.clean.get("after"),
            table=table,
            search=f"{config.policy_name}, {config.steps} steps",
            stronger_search=f"portfolio of pgd with restarts, cmaes and random, {TIMES * config.steps} steps",
            split={
                side: SplitSide(
                    objects=list(one.objects),
                    environments=list(one.environments),
                    scenes=self.counts[side],
                    views=views[side],
                )
                for side, one in self.scenes.splits.items()
            },
            rounds=rounds,
            hardened=f"{name}@{weights}" if done and (name == "reference" or ":" in name) else None,  # or code makes it
            weights=str(weights) if done else None,
            pictures=str(self.run.path / ARTIFACTS / FOLDER) if done else None,
            shared=SharedWork.of_facts(facts, facts.machines if facts else {}),
            warnings=warnings,
            seconds={**self.seconds, "total": seconds},
            seed=config.seed,
            command_line=config.command_line(),
        )


def _share(right: int, count: int) -> Share:
    return Share(accuracy=right / count, interval=clopper_pearson(right, count), right=right, count=count)
