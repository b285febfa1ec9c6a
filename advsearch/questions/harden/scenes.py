"""What `harden` does with single scenes, in this process or on workers: draws lessons from one, attacks one, or looks
at one as it is."""

from __future__ import annotations

import gc
import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import torch as safetensors

from advsearch import seeds
from advsearch.attacks.verification import WORST_CASE
from advsearch.bundled.changed_light import varied, white_light_changed
from advsearch.bundled.objects import OBJECTS
from advsearch.cluster import Call, Executor, InProcess
from advsearch.engine.loading import Scene, load_scene
from advsearch.engine.naming import RUN_SETTINGS, load_models, scene_settings, settings_alone
from advsearch.engine.problem import Problem
from advsearch.errors import ClusterError, InputError
from advsearch.files import JsonObject
from advsearch.models import Model
from advsearch.models.reference import copied_network
from advsearch.models.source import frozen
from advsearch.progress import NullProgress, Progress
from advsearch.questions.attack.carry_out import attack_on, problem_of
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.harden.lessons import Lesson, has_matrix, lessons, plain_lessons
from advsearch.questions.harden.result import ALL, HardenConfig
from advsearch.runs.results import INTERRUPTED
from advsearch.scene.assets import ObjectAsset
from advsearch.scene.library import list_environments
from advsearch.scene.settings import Given
from advsearch.settings import split_names
from advsearch.settings.values import merged
from advsearch.tasks import make_task

TRAINING, FURTHER, VALIDATION, HELD_OUT = "training", "further training", "validation", "held out"
"""The splits: what the weights are fitted to (the second mostly as it is), what chooses among them, and what is
measured in the end."""

ROBUST = "robust"  # of a scene in which nothing was found; otherwise there is an ending

OVER: dict[str, dict[str, object]] = {
    "camera": {"azimuth": [0.0, 360.0], "elevation": [8.0, 55.0], "roll": [-6.0, 6.0]},
    "environment": {"rotation": [0.0, 360.0], "exposure": [-0.8, 0.5]},
}
"""What varies by chance from view to view, unless it is searched."""

TRIES_TO_CHOOSE = 6  # random configurations of a view that is rendered to choose weights by, of which the worst counts
CLEAN_SCENES, CLEAN_VIEWS = 4, 2
"""Held-out scenes whose plain pictures are looked at, for each one that is attacked, and the views of each."""
CLEAN_SPP = 16

STRONGER = {"name": "portfolio", "policies": [{"name": "restarts", "policy": "pgd"}, "cmaes", "random"]}
"""The policy of the stronger search, with three times the steps."""
TIMES = 3


@dataclass(frozen=True)
class Drawing:
    """Lessons that are wanted of a scene of the split `side`: `views` that its controls make harder together, in which
    those `beside` vary by chance and which may share one adversarial texture, and `plain` views of it as it is."""

    side: str
    number: int
    controls: tuple[str, ...]
    views: int
    plain: int
    shared: bool = False
    beside: tuple[str, ...] = ()

    def done(self, work: SceneWork) -> list[Lesson]:
        problem, seed = work.problem(work.splits[self.side], self.number, self.controls, self.beside)
        tries = TRIES_TO_CHOOSE if self.side == VALIDATION else None
        found = lessons(problem, self.views, seed, tries=tries, shared=self.shared) if self.views else []
        return found + plain_lessons(problem, self.plain, seed)


@dataclass(frozen=True)
class Attacking:
    """An attack that is wanted on a held-out scene, `times` as long as usual: more than once is the stronger search.
    Weights of the model are safetensors; None for those that it was given with."""

    control: str
    number: int
    times: int
    weights: bytes | None = field(repr=False)

    def done(self, work: SceneWork) -> str:
        """How it ended: `ROBUST` where it found nothing and the clean scene is right in as many trials as a verified
        answer would have to be wrong in."""
        config = work.config
        name, scene = work.splits[HELD_OUT].scene(self.number, scene_settings(config))
        seed = seeds.stream(config.seed, f"measured {self.control}", self.number)
        harder = {} if self.times == 1 else {"policy": STRONGER, "steps": self.times * config.steps}
        asked = work.attack((self.control,), name, seed=seed, **harder)
        return attacked(asked, scene, work.model if self.weights is None else work.with_weights(self.weights))


@dataclass(frozen=True)
class Looking:
    """A look at plain pictures of a held-out scene, with these weights and those that the model was given with."""

    number: int
    weights: bytes = field(repr=False)

    def done(self, work: SceneWork) -> tuple[int, int]:
        """How many of them are right with the given weights, and with these."""
        side, right = work.splits[HELD_OUT], [0, 0]
        problem, _ = work.problem(side, self.number, tuple(work.config.controls)[:1])
        for view in range(CLEAN_VIEWS):
            seed = seeds.stream(side.seed, "plain", self.number * CLEAN_VIEWS + view)
            picture = problem.picture(problem.domain.start, seed, CLEAN_SPP)[None]
            truth = problem.truth(problem.whole(problem.domain.start, seed))
            for place, model in enumerate((work.model, work.with_weights(self.weights))):
                with torch.no_grad():
                    right[place] += bool(problem.task.loss(model(picture), truth)[0] <= 0.0)
        return right[0], right[1]


Wanted = Drawing | Attacking | Looking


def splits_of(config: HardenConfig, model: Model) -> dict[str, Split]:
    """Return the sides of the split by name; an InputError where there is nothing on a side."""

    def has_class(label: str) -> bool:
        try:
            return bool(model.label_set(label).indices)
        except InputError:
            return False

    objects = tuple(OBJECTS) if config.object == ALL else config.objects
    known = tuple(name for name in objects if name not in OBJECTS or has_class(OBJECTS[name].label))
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
    sides = {name: (known, training, True) for name in (TRAINING, FURTHER, VALIDATION)}
    sides[HELD_OUT] = held, measured, False
    return {name: Split(name, a, b, seeds.stream(config.seed, name), c) for name, (a, b, c) in sides.items()}


def scenes_of(settings: JsonObject) -> Call:
    """Return what does what is wanted of scenes of the hardening that the settings describe: what a worker does."""
    config = HardenConfig(**settings)
    (model, *_), _ = load_models([config.model], make_task(config.task), config)
    gc.freeze()  # what a scene leaves is collected after each; a sixth of the time goes into looking at all the rest
    return SceneWork(config, model, splits_of(config, model))


@dataclass
class SceneWork:
    """What is done with single scenes, with the model as it was given; pure functions of what is wanted, which this
    process does, or an executor."""

    config: HardenConfig
    model: Model
    splits: Mapping[str, Split]
    progress: Progress = field(default_factory=NullProgress)
    executor: Executor | None = None

    def __call__(self, wanted: Iterable[Wanted]) -> list[Any]:
        """Return what came of each."""
        return [one.done(self) for one in wanted]

    def each(self, title: str, wanted: Sequence[Wanted], hint: str = "") -> Iterator[tuple[int, Any]]:
        """Have done what is wanted of scenes; yield the place of each and what came of it, in any order."""
        self.progress.stage(title, len(wanted), hint=hint)
        places, executor = {id(one): place for place, one in enumerate(wanted)}, self.executor or InProcess(self)
        for done in executor.results([one] for one in wanted):
            (one,) = done.items
            if done.lost:
                raise ClusterError(f"harden, scene {one.number}: {done.lost}")
            self.progress.advance(1, **({} if executor.facts is None else executor.facts.told))
            yield places[id(one)], done.value[0]

    def with_weights(self, weights: bytes) -> Model:
        """Return the model with other weights, safetensors."""
        network = copied_network(self.model)
        network.load_state_dict(safetensors.load(weights))
        return replace(self.model, module=frozen(network, self.model.name))

    @cached_property
    def linear(self) -> tuple[str, ...]:
        """The controls whose pictures a matrix of light transport says."""
        return tuple(control for control in self.config.controls if self._has_matrix(control))

    @property
    def rendered(self) -> tuple[str, ...]:
        """The other controls."""
        return tuple(control for control in self.config.controls if control not in self.linear)

    @cached_property
    def beside(self) -> tuple[str, ...]:
        """The controls that are rendered which can vary by chance beside every matrix."""
        return tuple(one for one in self.rendered if all(self._has_matrix(other, one) for other in self.linear))

    def _has_matrix(self, *controls: str) -> bool:
        """Whether a matrix says the pictures of the first control, the others varying by chance."""
        try:
            return has_matrix(self.problem(self.splits[TRAINING], 0, controls[:1], controls[1:])[0])
        except InputError:
            if len(controls) > 1:
                return False
            raise

    @cached_property
    def _measured(self) -> frozenset[str]:
        """Fingerprints of the objects of all held-out scenes."""
        count = CLEAN_SCENES * self.config.measured
        return frozenset(fingerprint(asset) for asset in self.splits[HELD_OUT].assets(count))

    def problem(
        self, side: Split, number: int, controls: Sequence[str], beside: Sequence[str] = ()
    ) -> tuple[Problem, int]:
        """Return what a scene is searched as, with controls that vary by chance beside, and the root of the draws of
        its lessons."""
        name, scene = side.scene(number, scene_settings(self.config))
        if side.name != HELD_OUT:
            check_unmeasured(scene.description.object, self._measured)
        kinds = {control.partition(":")[0].partition(".")[0] for control in (*controls, *beside)}
        over = {other: ranges for other, ranges in OVER.items() if other not in kinds}
        over |= {control: self.config.controls[control] for control in beside}
        problem = problem_of(self.attack(controls, name, over=over), scene, self.model, differentiated=False)
        return problem, seeds.stream(side.seed, "views", number)

    def attack(self, controls: Sequence[str], name: str, **changes: object) -> AttackConfig:
        """Return what some of the controls are searched with, on an object of a name."""
        searched = {control: self.config.controls[control] for control in controls}
        own: dict[str, object] = dict.fromkeys(RUN_SETTINGS)
        for control, given in searched.items():
            alone = settings_alone(self.config, control, given)
            own = merged(own, {setting: value for setting, value in alone.items() if value is not None})
        own |= {"object": name, "environment": None, "set_": {}, "exposure": 0.0, **changes, "controls": searched}
        return AttackConfig.of(self.config, **own, measure="no", baseline=False, workers=None, cluster=None)


def attacked(config: AttackConfig, scene: Scene, model: Model) -> str:
    """Attack, and return how it ended; `ROBUST` where nothing was found and the clean scene is steadily right."""
    found = attack_on(config, scene, model).summary
    if found.ending == INTERRUPTED:
        raise KeyboardInterrupt
    control = found.clean.control
    steady = control is not None and control.correct >= WORST_CASE.needed(control.trials)
    if found.ending in ("found", "already wrong"):
        return found.ending
    return ROBUST if steady else "unsteady"


ELEVATION, FIELD, GROUND = (8.0, 55.0), (25.0, 45.0), (0.1, 0.9)
"""Ranges from which scenes draw the camera's elevation and field of view in degrees, and the ground's colour (sRGB)."""


@dataclass(frozen=True)
class Split:
    """One side of the split: objects (bundled ones, or files) and environments, and the root of its draws. With
    `varied` each scene has an environment of its own, made from one of these."""

    name: str
    objects: tuple[str, ...]
    environments: tuple[str, ...]
    seed: int
    varied: bool = False

    def scene(self, number: int, given: Given | None = None) -> tuple[str, Scene]:
        """Return the scene with this number, from 0, and the name of its object; the objects take turns. Parameters
        that are given are fixed. An object in a file without a label is called as it: ``coffee-mug.glb``, "coffee mug".
        """
        name, rng = self.objects[number % len(self.objects)], self._draws(number)
        made = OBJECTS[name].generate(rng) if name in OBJECTS else Path(name)
        environment = self.environments[int(rng.integers(len(self.environments)))]
        ground = np.clip(rng.uniform(*GROUND) + rng.normal(0.0, 0.05, 3), 0.02, 0.98)
        names = ("camera.azimuth", "camera.elevation", "camera.fov", "environment.rotation")
        ends = ((0.0, 360.0), ELEVATION, FIELD, (0.0, 360.0))
        drawn = {name: rng.uniform(*both) for name, both in zip(names, ends, strict=True)}
        drawn |= {
            f"ground.{channel}": float(level) for channel, level in zip(("red", "green", "blue"), ground, strict=True)
        }
        scene = load_scene(made, environment, settings={**drawn, **(given or {})})
        own = scene.description
        if self.varied and own.environment is not None:
            own = replace(own, environment=white_light_changed(varied(own.environment, rng), rng))
        if own.object.label is None:
            label = Path(name).stem.replace("-", " ").replace("_", " ")
            own = replace(own, object=replace(own.object, label=label))
        return name, scene if own is scene.description else Scene(own)

    def _draws(self, number: int) -> np.random.Generator:
        return np.random.default_rng([seeds.stream(self.seed, f"{self.name} scene", number)])

    def assets(self, count: int) -> Iterator[ObjectAsset]:
        """Yield the objects of the first `count` scenes; what a file holds comes once."""
        files = set[str]()
        for number in range(count):
            name = self.objects[number % len(self.objects)]
            if name in OBJECTS:
                yield OBJECTS[name].generate(self._draws(number))
            elif name not in files:
                files.add(name)
                yield self.scene(number)[1].description.object


def fingerprint(asset: ObjectAsset) -> str:
    """Return what is equal for equal shapes with equal textures."""
    found = hashlib.sha256()
    for part in (asset.mesh.vertices, asset.mesh.faces, asset.base_color):
        found.update(np.ascontiguousarray(part).tobytes())
    return found.hexdigest()


def check_disjoint(held: Split, taught: Sequence[Split]) -> None:
    """Refuse, by an InputError, to measure what is trained on: one of the training's environments, or of its files. Of
    each bundled object the first instance is looked at; all others, which take minutes, when they are drawn."""
    both = sorted({name for split in taught for name in split.environments} & set(held.environments))
    if both:
        raise InputError(f"held_out_environment: {', '.join(both)} is an environment of the training too; name others")
    measured = {fingerprint(asset) for asset in held.assets(len(held.objects))}
    for split in taught:
        for asset in split.assets(len(split.objects)):
            check_unmeasured(asset, measured)


def check_unmeasured(asset: ObjectAsset, measured: Set[str]) -> None:
    """Refuse, by an InputError, to train on an object whose fingerprint is among those of what is measured."""
    if fingerprint(asset) in measured:
        raise InputError(f"held_out: {asset.name} is an object of the training too; name others")
