"""`harden`: trains a copy of a model on its worst cases, and measures it on what training never saw, before and
after."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors import torch as safetensors

from advsearch import seeds
from advsearch.api.attack import LOADING, attack_on, problem_of
from advsearch.api.keywords import HardenKeywords, asks, configured
from advsearch.attacks import clopper_pearson
from advsearch.attacks.verification import WORST_CASE
from advsearch.bundled.objects import OBJECTS
from advsearch.config import AttackConfig, HardenConfig
from advsearch.config.hardening import ALL
from advsearch.engine.hardening.lessons import Lesson, harder, lessons
from advsearch.engine.hardening.pictures import ARCHIVE, FOLDER, save_pictures, write_archive
from advsearch.engine.hardening.split import HELD_OUT, TRAINING, VALIDATION, Split, check_disjoint
from advsearch.engine.hardening.training import Course, Examples, MakeOptimiser, right_share, score
from advsearch.engine.loading import Scene
from advsearch.engine.naming import AnyModel, load_models, model_name, scene_settings
from advsearch.engine.run_settings import RunSettings
from advsearch.errors import InputError
from advsearch.interrupts import interruptible
from advsearch.models import Model
from advsearch.models.imported import split_weights
from advsearch.models.trainable import Trainable, trainable
from advsearch.progress import NullProgress, Progress
from advsearch.report.phrases import percent
from advsearch.runs.directory import ARTIFACTS, RunDirectory
from advsearch.runs.files import write_bytes
from advsearch.runs.results.base import INTERRUPTED
from advsearch.runs.results.harden import HardenedControl, HardenResult, Share, SplitSide, TrainingRound
from advsearch.scene.library import list_environments
from advsearch.settings import split_names
from advsearch.tasks import make_task

if TYPE_CHECKING:
    from typing_extensions import Unpack

WEIGHTS = "hardened.safetensors"
ROUNDS, MEASURED = "rounds", "measured"
"""Notes under which the store keeps what is done."""

OVER: dict[str, dict[str, object]] = {
    "camera": {"azimuth": [0.0, 360.0], "elevation": [8.0, 55.0], "roll": [-6.0, 6.0]},
    "environment": {"rotation": [0.0, 360.0], "exposure": [-0.8, 0.5]},
}
"""What varies by chance from view to view, unless it is searched."""

TRIES = 6
"""Random configurations of a view that is rendered, of which the worst is trained on."""
FIRST_STEPS = 4
"""Steps of a new texture before the training."""
VALIDATION_VIEWS, CLEAN_VIEWS = 2, 2
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
        progress: told how far it is.

    Raises:
        InputError: anything that the caller can put right; nothing is written then.
    """
    config = configured(HardenConfig, model=model_name(model), **settings)
    return _carry_out(config, model, optimiser, beside, progress or NullProgress(), None)


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
    course = Course(student, config.rate, config.epochs, seeds.stream(config.seed, "order"), optimiser, beside)
    with RunDirectory.of(config, resumed) as run:
        work = Hardening(config, run, loaded, course, splits, progress)
        try:
            with interruptible():
                work.carry_out()
            ending = "done"
        except KeyboardInterrupt:
            ending = INTERRUPTED
        result = work.result(ending, warnings, time.perf_counter() - begun)
        run.write_summary(result)
        return result


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
    return {
        name: Split(name, taken, lit, seeds.stream(config.seed, name))
        for name, taken, lit in ((TRAINING, known, training), (VALIDATION, known, training), (HELD_OUT, held, measured))
    }


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
        self.rounds = [TrainingRound.of(one) for one in self._noted(ROUNDS, [])]
        self.measured: dict[str, str] = self._noted(MEASURED, {})
        self.clean: dict[str, Share] = {}
        self._set = scene_settings(self.config.set_, self.config.exposure)

    @property
    def student(self) -> Trainable:
        """What is trained."""
        return self.course.student

    def _noted(self, key: str, otherwise: Any) -> Any:
        return json.loads(self.run.store.note(key) or "null") or otherwise

    # ---- the parts --------------------------------------------------------------------------------------------------

    def carry_out(self) -> None:
        """Measure, train, and measure again."""
        held = [scene for _, scene in self.splits[HELD_OUT].scenes(self.config.measured, self._set)]
        first = [scene for _, scene in self.splits[TRAINING].scenes(self.config.scenes, self._set)]
        check_disjoint({self.splits[HELD_OUT]: held, self.splits[TRAINING]: first})
        self._measure("before", "attacking the model as it is", self.model, 1)
        self._train()
        self._measure("after", "attacking the hardened model", self.student.model, 1)
        self._measure("stronger", "attacking it with a stronger search", self.student.model, TIMES)
        self._look()

    def _alone(self, control: str, name: str, **changes: object) -> AttackConfig:
        """What one control is searched with, on an object of a name."""
        config, given = self.config, self.config.controls[control]
        shared = RunSettings(config.epsilon, config.norm, config.texture_resolution)
        own = vars(shared.alone(control, given))
        found: dict[str, object] = {"object": name, "environment": None, "set_": {}, "exposure": 0.0, **own, **changes}
        found |= {"controls": {control: given}, "measure": "no", "baseline": False}
        return AttackConfig.of(config, **found)

    def _lessons(self, split: Split, number: int, control: str, views: int, tries: int, shared: bool) -> list[Lesson]:
        name, scene = split.scene(number, self._set)
        problem = problem_of(self._alone(control, name, over=_without(control)), scene, self.student.model)
        return lessons(problem, views, tries, seeds.stream(split.seed, "views", number), shared=shared)

    # ---- training ---------------------------------------------------------------------------------------------------

    def _train(self) -> None:
        config, student = self.config, self.student
        scenes = list(range(config.scenes))
        self.progress.stage("drawing scenes to choose weights by", config.scenes * len(config.controls))
        held_back = self._drawn(self.splits[VALIDATION], scenes, VALIDATION_VIEWS)
        if not self.rounds:
            self._keep_round(0, [], held_back)
        pool: list[Lesson] = []
        for number in range(1, config.rounds + 1):
            places = [(number - 1) * config.scenes + one for one in scenes]
            self.progress.stage(f"round {number}: drawing scenes", config.scenes * len(config.controls))
            new = self._drawn(self.splits[TRAINING], places, config.views)
            pool += new
            if number < len(self.rounds):
                continue  # done before this run was stopped
            student.net.load_state_dict(self._weights(number - 1))
            self.progress.stage(f"round {number}: training", self.course.steps(len(pool)))
            harder(pool, student.model, FIRST_STEPS)
            self.course.round(number, pool, lambda: self.progress.advance(1))
            self._keep_round(number, new, held_back, len(pool))
        student.net.load_state_dict(self._weights(self.best))
        state = {name: one.contiguous() for name, one in student.net.state_dict().items()}
        write_bytes(self._artifact(WEIGHTS), safetensors.save(state))
        write_archive(self._artifact(FOLDER), self._artifact(ARCHIVE))

    def _drawn(self, split: Split, places: Sequence[int], views: int) -> list[Lesson]:
        """Lessons of scenes for each control; of every fourth one all views share a texture."""
        found = []
        for control in self.config.controls:
            for number in places:
                shared = split.name == TRAINING and number % 4 == 3
                found += self._lessons(split, number, control, views, TRIES, shared)
                self.progress.advance(1)
        return found

    def _keep_round(self, number: int, new: Sequence[Lesson], held_back: Sequence[Lesson], trained: int = 0) -> None:
        """Judge the weights, and keep them and the round's pictures."""
        found = score(self.student.model, held_back)
        state = {name: one.contiguous() for name, one in self.student.net.state_dict().items()}
        write_bytes(self._artifact(f"round-{number:03d}.safetensors"), safetensors.save(state))
        save_pictures(self._artifact(FOLDER), number, new, self.model.labels)
        row = TrainingRound(lessons=trained, clean=found.clean, robust=found.robust, kept=False)
        self.rounds = [*self.rounds[:number], row]
        self.run.store.set_note(ROUNDS, json.dumps([one.model_dump() for one in self.rounds]))
        clean, worst = percent(found.clean), percent(found.robust)
        self.progress.message(f"round {number}: {clean} of plain pictures right, {worst} of the worst")

    @property
    def best(self) -> int:
        """The round whose weights are kept: the most robust one whose clean accuracy is within what may be lost."""
        least = self.rounds[0].clean - self.config.clean_loss - 1e-9
        allowed = [number for number, one in enumerate(self.rounds) if one.clean >= least]
        return max(allowed, key=lambda number: (self.rounds[number].robust, number))

    def _weights(self, number: int) -> dict[str, torch.Tensor]:
        return safetensors.load(self._artifact(f"round-{number:03d}.safetensors").read_bytes())

    def _artifact(self, name: str) -> Path:
        return self.run.path / ARTIFACTS / name

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
                    beaten = times > 1 and self.measured[f"after {control} {number}"] != "robust"
                    seed = seeds.stream(config.seed, f"measured {control}", number)
                    asked = self._alone(control, name, seed=seed, **harder_search)
                    self.measured[key] = "found before" if beaten else _attacked(asked, scene, model)
                    self.run.store.set_note(MEASURED, json.dumps(self.measured))
                self.progress.advance(1)

    def _look(self) -> None:
        """Ask both models about plain pictures of held-out scenes."""
        count, control = CLEAN_SCENES * self.config.measured, next(iter(self.config.controls))
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
        return _share(sum(all(one == "robust" for one in row) for row in endings), len(endings))

    def result(self, ending: str, warnings: list[str], seconds: float) -> HardenResult:
        """Return what is known."""
        config, done = self.config, ending == "done"
        table = []
        for control in config.controls:
            shares = [self._robust(which, [control]) for which in ("before", "after", "stronger")]
            if all(one is not None for one in shares):
                before, after, stronger = shares
                table.append(HardenedControl(control=control, before=before, after=after, stronger=stronger))
        if done and self.best == 0:
            warnings = [*warnings, "No round kept the clean accuracy, so the weights are the model's own."]
        rounds = [one.model_copy(update={"kept": done and n == self.best}) for n, one in enumerate(self.rounds)]
        weights = self._artifact(WEIGHTS)
        counts = {TRAINING: config.scenes * config.rounds, VALIDATION: config.scenes, HELD_OUT: config.measured}
        views = {TRAINING: config.views, VALIDATION: VALIDATION_VIEWS, HELD_OUT: 1}
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
                    scenes=counts[name],
                    views=views[name],
                )
                for name, one in self.splits.items()
            },
            rounds=rounds,
            hardened=_loads(config.model, weights) if done else None,
            weights=str(weights) if done else None,
            pictures=str(self._artifact(FOLDER)) if done else None,
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
    return "robust" if steady else "unsteady"


def _share(right: int, count: int) -> Share:
    return Share(accuracy=right / count, interval=clopper_pearson(right, count), right=right, count=count)


def _loads(model: str, weights: Path) -> str | None:
    """What `model` takes to load hardened weights into the network of a name; None where code has to make it."""
    name, _ = split_weights(model)
    return f"{name}@{weights}" if name == "reference" or ":" in name else None
