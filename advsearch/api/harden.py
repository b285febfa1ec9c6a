"""`harden`: trains a copy of a model on its worst cases, and measures it on what training never saw, before and
after."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from advsearch import seeds
from advsearch.api.attack import LOADING, attack_on, problem_of
from advsearch.api.keywords import HardenKeywords, asks, configured
from advsearch.attacks import clopper_pearson
from advsearch.attacks.verification import WORST_CASE
from advsearch.bundled.objects import OBJECTS
from advsearch.config import AttackConfig, HardenConfig
from advsearch.config.hardening import ALL
from advsearch.engine.hardening.lessons import Lesson, RenderedLesson, lessons, plain_lessons
from advsearch.engine.hardening.pictures import FOLDER
from advsearch.engine.hardening.rounds import VALIDATION_VIEWS, WEIGHTS, TrainingRounds
from advsearch.engine.hardening.split import FURTHER, HELD_OUT, TRAINING, VALIDATION, Split, check_disjoint
from advsearch.engine.hardening.training import Course, Examples, MakeOptimiser, right_share
from advsearch.engine.loading import Scene
from advsearch.engine.naming import AnyModel, load_models, model_name, scene_settings
from advsearch.engine.problem import Problem
from advsearch.engine.run_settings import RunSettings
from advsearch.errors import InputError
from advsearch.interrupts import interruptible
from advsearch.models import Model
from advsearch.models.imported import split_weights
from advsearch.models.trainable import Trainable, trainable
from advsearch.progress import NullProgress, Progress
from advsearch.report.hardening import hardened_figure
from advsearch.runs.directory import ARTIFACTS, IMAGES, RunDirectory, is_run, run_path
from advsearch.runs.files import write_bytes
from advsearch.runs.results.base import INTERRUPTED
from advsearch.runs.results.harden import HardenedControl, HardenResult, Share, SplitSide
from advsearch.runs.store import Row
from advsearch.scene.library import list_environments
from advsearch.settings import split_names
from advsearch.tasks import make_task
from advsearch.viewer.pages import write_page

if TYPE_CHECKING:
    from typing_extensions import Unpack

ROBUST = "robust"
"""Of a scene in which nothing was found; otherwise there is an ending."""
MEASURED, MEANS = "measured", "means"
"""Notes under which the store keeps what is done."""

OVER: dict[str, dict[str, object]] = {
    "camera": {"azimuth": [0.0, 360.0], "elevation": [8.0, 55.0], "roll": [-6.0, 6.0]},
    "environment": {"rotation": [0.0, 360.0], "exposure": [-0.8, 0.5]},
}
"""What varies by chance from view to view, unless it is searched."""

TRIES = 6
"""Random configurations of a view that is rendered, of which the worst is trained on."""
CLEAN_VIEWS = 2
PLAIN_VIEWS = 3
"""Further views of each scene as it is."""
FURTHER_SCENES, FURTHER_VIEWS = 3, 2
"""Scenes that come with each one of the training, and views of each, as they are: clean accuracy is lost where there
are too few. What is rendered is searched there too, as its lessons hold few worst pictures."""
CLEAN_SCENES = 4
"""Held-out scenes whose plain pictures are looked at, for each one that is attacked."""
CLEAN_SPP = 16

STRONGER = {"name": "portfolio", "policies": [{"name": "restarts", "policy": "pgd"}, "cmaes", "random"]}
"""The policy of the stronger search, with three times the steps."""
TIMES = 3


@asks(HardenConfig, HardenKeywords)
def harden(
    model: AnyModel = "reference",
    *,
    optimiser: MakeOptimiser | None = None,
    beside: Examples | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    **settings: Unpack[HardenKeywords],
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
        progress: told how far it is.

    Raises:
        InputError: anything that the caller can put right; nothing is written then.
    """
    config = configured(HardenConfig, model=model_name(model), **settings)
    path = run_path(config.run) if resume and config.run is not None else None
    resumed = path if path is not None and is_run(path) else None
    return _carry_out(config, model, optimiser, beside, progress or NullProgress(), resumed)


def harden_from_config(
    config: HardenConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> HardenResult:
    """Do what a configuration describes, or go on with it; see `harden`."""
    return _carry_out(config, config.model, None, None, progress or NullProgress(), resumed)


def _carry_out(
    config: HardenConfig,
    model: AnyModel,
    optimiser: MakeOptimiser | None,
    beside: Examples | None,
    progress: Progress,
    resumed: Path | None,
) -> HardenResult:
    begun = time.perf_counter()
    progress.stage(LOADING)
    RunSettings(config.epsilon, config.norm, config.texture_resolution).check(config.controls)
    task = make_task(config.task)
    (loaded, *_), warnings = load_models([model], task, labels=config.labels, used_threads=config.used_threads)
    student = trainable(loaded, config.layers)
    splits = splits_of(config, loaded)
    course = Course(student, loaded, config.rate, config.epochs, seeds.stream(config.seed, "order"), optimiser, beside)
    with RunDirectory.of(config, resumed) as run:
        _same_means(run, {"optimiser": optimiser is not None, "beside": beside is not None}, resumed)
        work = Hardening(config, run, loaded, course, splits, progress)
        try:
            with interruptible():
                work.carry_out()
            ending = "done"
        except KeyboardInterrupt:
            ending = INTERRUPTED
        result = work.result(ending, warnings, time.perf_counter() - begun)
        for suffix, data in hardened_figure(result).items():
            write_bytes(run.path / IMAGES / f"{config.command}.{suffix}", data)
        run.write_summary(result)
        write_page(run.path, result)
        return result


def _same_means(run: RunDirectory, given: dict[str, bool], resumed: Path | None) -> None:
    """Note what a training has from Python, or refuse to go on with other means than it began with.

    Raises:
        InputError: it had something else.
    """
    if resumed is None:
        run.store.set_note(MEANS, json.dumps(given))
        return
    before = json.loads(run.store.note(MEANS) or "{}")
    for name, was in before.items():
        if was != given[name]:
            raise InputError(
                f"{run.path}: cannot go on: it began {'with' if was else 'without'} `{name}`, which only Python gives; "
                "go on with advsearch.harden(..., run=..., resume=True) and the same arguments"
            )


def splits_of(config: HardenConfig, model: Model) -> dict[str, Split]:
    """Return the sides of the split by name.

    Raises:
        InputError: there is nothing on a side, or one environment on both.
    """
    objects = tuple(OBJECTS) if config.object == ALL else config.objects
    known = tuple(name for name in objects if name not in OBJECTS or _has_class(model, OBJECTS[name].label))
    if not known:
        raise InputError(f"object: model {model.name} has a class for none of {', '.join(objects)}; name others")
    files = [name for name in known if name not in OBJECTS]
    if files and config.held_out is None:
        raise InputError(
            f"held_out: {', '.join(files)} has no other instances; name objects of its class that training never sees"
        )
    held = known if config.held_out is None else split_names(config.held_out)
    training = split_names(config.environment) if config.environment else list_environments("train")
    asked = config.held_out_environment
    measured = split_names(asked) if asked else list_environments("heldout")
    taught = [
        Split(name, known, training, seeds.stream(config.seed, name), True) for name in (TRAINING, FURTHER, VALIDATION)
    ]
    measured_on = Split(HELD_OUT, held, measured, seeds.stream(config.seed, HELD_OUT))
    return {one.name: one for one in (*taught, measured_on)}


def _has_class(model: Model, label: str) -> bool:
    try:
        return bool(model.label_set(label).indices)
    except InputError:
        return False


@dataclass
class Hardening:
    """One run of `harden`.

    Attributes:
        config: what was asked.
        run: keeps what is done.
        model: as it was given.
        course: trains a copy of it.
        splits: by name.
        progress: told how far it is.
    """

    config: HardenConfig
    run: RunDirectory
    model: Model
    course: Course
    splits: Mapping[str, Split]
    progress: Progress

    def __post_init__(self) -> None:
        config = self.config
        amounts = (config.scenes, config.views, config.clean_loss)
        self.rounds = TrainingRounds(self.run, self.course, self._drawn, *amounts, self.progress)
        self.measured: dict[str, str] = json.loads(self.run.store.note(MEASURED) or "{}")
        self.clean: dict[str, Share] = {}
        self._set = scene_settings(self.config.set_, self.config.exposure)

    @property
    def student(self) -> Trainable:
        """What is trained."""
        return self.course.student

    # ---- the parts --------------------------------------------------------------------------------------------------

    def carry_out(self) -> None:
        """Measure, train, and measure again."""
        sides = self.splits
        check_disjoint(sides[HELD_OUT], [sides[name] for name in (TRAINING, FURTHER, VALIDATION)], self._counts)
        self._measure("before", "attacking the model as it is", self.model, 1)
        self.rounds.carry_out(self.config.rounds)
        self._measure("after", "attacking the hardened model", self.student.model, 1)
        self._measure("stronger", "attacking it with a stronger search", self.student.model, TIMES)
        self._look()

    @property
    def _counts(self) -> dict[str, int]:
        """Scenes of each split, by its name; of those that are held out a part is attacked."""
        config = self.config
        held, searched = CLEAN_SCENES * config.measured, config.scenes * config.rounds
        counts = {TRAINING: searched, FURTHER: FURTHER_SCENES * searched}
        return {**counts, VALIDATION: self.rounds.judged, HELD_OUT: held}

    def _alone(self, control: str, name: str, **changes: object) -> AttackConfig:
        """What one control is searched with, on an object of a name."""
        config, given = self.config, self.config.controls[control]
        shared = RunSettings(config.epsilon, config.norm, config.texture_resolution)
        own = vars(shared.alone(control, given))
        found: dict[str, object] = {"object": name, "environment": None, "set_": {}, "exposure": 0.0, **own, **changes}
        found |= {"controls": {control: given}, "measure": "no", "baseline": False}
        return AttackConfig.of(config, **found)

    def _drawn(self, title: str, split: str, places: Sequence[int], views: int) -> list[Lesson]:
        """Lessons of scenes for each control; in every fourth scene of the training all views share a texture, and
        further scenes come on top."""
        side, found, rendered = self.splits[split], list[Lesson](), list[str]()
        further = FURTHER_SCENES if split == TRAINING else 0
        self.progress.stage(title, len(places) * (len(self.config.controls) + further))
        for control in self.config.controls:
            for number in places:
                problem, seed = self._problem(side, number, control)
                drawn = lessons(problem, views, TRIES, seed, shared=split == TRAINING and number % 4 == 3)
                found += drawn + plain_lessons(problem, PLAIN_VIEWS, seed)
                self.progress.advance(1)
            if isinstance(drawn[0], RenderedLesson):
                rendered.append(control)
        return found + self._further([place * further + more for place in places for more in range(further)], rendered)

    def _further(self, places: Sequence[int], rendered: Sequence[str]) -> list[Lesson]:
        """Lessons of scenes that come with those of the training: plain ones, and of controls that are rendered."""
        side, found, first = self.splits[FURTHER], list[Lesson](), next(iter(self.config.controls))
        for number in places:
            for control in dict.fromkeys([first, *rendered]):
                problem, seed = self._problem(side, number, control)
                if control in rendered:
                    found += lessons(problem, FURTHER_VIEWS, TRIES, seed)
                if control == first:
                    found += plain_lessons(problem, FURTHER_VIEWS, seed)
            self.progress.advance(1)
        return found

    def _problem(self, side: Split, number: int, control: str) -> tuple[Problem, int]:
        """What a scene is searched as, and the root of the draws of its lessons."""
        name, scene = side.scene(number, self._set)
        problem = problem_of(self._alone(control, name, over=_without(control)), scene, self.model)
        return problem, seeds.stream(side.seed, "views", number)

    # ---- measurement ------------------------------------------------------------------------------------------------

    def _measure(self, which: str, title: str, model: Model, times: int) -> None:
        """Attack every held-out scene over each control; what is known is not attacked again."""
        config = self.config
        self.progress.stage(title, config.measured * len(config.controls), hint="`measured` and `steps` shorten it")
        harder_search = {} if times == 1 else {"policy": STRONGER, "steps": times * config.steps}
        for number in range(config.measured):
            name, scene = self.splits[HELD_OUT].scene(number, self._set)
            for control in config.controls:
                key = f"{which} {control} {number}"
                if key not in self.measured:
                    beaten = times > 1 and self.measured[f"after {control} {number}"] != ROBUST
                    seed = seeds.stream(config.seed, f"measured {control}", number)
                    asked = self._alone(control, name, seed=seed, **harder_search)
                    self.measured[key] = "found before" if beaten else _attacked(asked, scene, model)
                    self.run.store.set_note(MEASURED, json.dumps(self.measured))
                    wrong = self.measured[key] != ROBUST
                    self.run.record(Row(f"{which} {control}", number, seed=seed, spp=config.verify_spp, success=wrong))
                self.progress.advance(1)

    def _look(self) -> None:
        """Ask both models about plain pictures of held-out scenes."""
        count, control = self._counts[HELD_OUT], next(iter(self.config.controls))
        self.progress.stage("looking at plain pictures of held-out scenes", count)
        seen: list[Lesson] = []
        for number in range(count):
            name, scene = self.splits[HELD_OUT].scene(number, self._set)
            problem = problem_of(self._alone(control, name, over=_without(control)), scene, self.model)
            for view in range(CLEAN_VIEWS):
                seed = seeds.stream(self.splits[HELD_OUT].seed, "plain", number * CLEAN_VIEWS + view)
                picture = problem.picture(problem.domain.start, seed, CLEAN_SPP)
                right = tuple(int(one) for one in problem.truth())
                seen.append(Lesson(right, picture, picture))
            self.progress.advance(1)
        for which, model in (("before", self.model), ("after", self.student.model)):
            self.clean[which] = _share(round(right_share(model, seen, "plain") * len(seen)), len(seen))

    # ---- what came out ----------------------------------------------------------------------------------------------

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
            shares = [self._robust(which, [control]) for which in ("before", "after", "stronger")]
            if all(one is not None for one in shares):
                before, after, stronger = shares
                table.append(HardenedControl(control=control, before=before, after=after, stronger=stronger))
        if done and self.rounds.best == 0:
            warnings = [*warnings, "No round kept the clean accuracy, so the weights are the model's own."]
        rounds = [
            one.model_copy(update={"kept": done and n == self.rounds.best}) for n, one in enumerate(self.rounds.done)
        ]
        weights = self.run.path / ARTIFACTS / WEIGHTS
        views = {TRAINING: config.views, FURTHER: FURTHER_VIEWS, VALIDATION: VALIDATION_VIEWS, HELD_OUT: CLEAN_VIEWS}
        names = list(config.controls)
        return HardenResult(
            run=str(self.run.path),
            environment=",".join(self.splits[TRAINING].environments),
            objects=list(self.splits[TRAINING].objects),
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
                name: SplitSide(
                    objects=list(one.objects),
                    environments=list(one.environments),
                    scenes=self._counts[name],
                    views=views[name],
                )
                for name, one in self.splits.items()
            },
            rounds=rounds,
            hardened=_loads(config.model, weights) if done else None,
            weights=str(weights) if done else None,
            pictures=str(self.run.path / ARTIFACTS / FOLDER) if done else None,
            warnings=warnings,
            seconds={"total": seconds},
            seed=config.seed,
            command_line=config.command_line(),
        )


def _without(control: str) -> dict[str, dict[str, object]]:
    """What varies by chance beside a searched control."""
    kind = control.partition(":")[0].partition(".")[0]
    return {other: given for other, given in OVER.items() if other != kind}


def _attacked(config: AttackConfig, scene: Scene, model: Model) -> str:
    """How an attack ended: "robust" where it found nothing and the clean scene is right in as many trials as a verified
    answer would have to be wrong in."""
    found = attack_on(config, scene, model).summary
    if found.ending == INTERRUPTED:
        raise KeyboardInterrupt
    control = found.clean.control
    steady = control is not None and control.correct >= WORST_CASE.needed(control.trials)
    if found.ending in ("found", "already wrong"):
        return found.ending
    return ROBUST if steady else "unsteady"


def _share(right: int, count: int) -> Share:
    return Share(accuracy=right / count, interval=clopper_pearson(right, count), right=right, count=count)


def _loads(model: str, weights: Path) -> str | None:
    """What `model` takes to load hardened weights into the network of a name; None where code has to make it."""
    name, _ = split_weights(model)
    return f"{name}@{weights}" if name == "reference" or ":" in name else None
