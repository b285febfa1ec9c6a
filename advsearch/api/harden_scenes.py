"""What `harden` does with single scenes, in this process or on workers: draws lessons from one, attacks one, or looks
at one as it is."""

from __future__ import annotations

import gc
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from safetensors import torch as safetensors

from advsearch import seeds
from advsearch.api.attack import attack_on, problem_of
from advsearch.attacks.verification import WORST_CASE
from advsearch.bundled.objects import OBJECTS
from advsearch.cluster.executor import Call
from advsearch.config import AttackConfig, HardenConfig
from advsearch.config.hardening import ALL
from advsearch.engine import run_settings
from advsearch.engine.hardening.lessons import Lesson, has_matrix, lessons, plain_lessons
from advsearch.engine.hardening.split import (
    FURTHER,
    HELD_OUT,
    TRAINING,
    VALIDATION,
    Split,
    check_unmeasured,
    fingerprint,
)
from advsearch.engine.loading import Scene
from advsearch.engine.naming import load_models, scene_settings
from advsearch.engine.problem import Problem
from advsearch.errors import InputError
from advsearch.files import JsonObject
from advsearch.models import Model
from advsearch.models.trainable import trainable
from advsearch.runs.results.base import INTERRUPTED
from advsearch.scene.formation import levels_of
from advsearch.scene.library import list_environments
from advsearch.scene.settings import Given
from advsearch.settings import split_names
from advsearch.tasks import make_task

ROBUST = "robust"
"""Of a scene in which nothing was found; otherwise there is an ending."""

OVER: dict[str, dict[str, object]] = {
    "camera": {"azimuth": [0.0, 360.0], "elevation": [8.0, 55.0], "roll": [-6.0, 6.0]},
    "environment": {"rotation": [0.0, 360.0], "exposure": [-0.8, 0.5]},
}
"""What varies by chance from view to view, unless it is searched."""

TRIES_TO_CHOOSE = 6
"""Random configurations of a view that is rendered to choose weights by, of which the worst counts."""
CLEAN_SCENES, CLEAN_VIEWS = 4, 2
"""Held-out scenes whose plain pictures are looked at, for each one that is attacked, and the views of each."""
CLEAN_SPP = 16

STRONGER = {"name": "portfolio", "policies": [{"name": "restarts", "policy": "pgd"}, "cmaes", "random"]}
"""The policy of the stronger search, with three times the steps."""
TIMES = 3


@dataclass(frozen=True)
class Drawing:
    """Lessons that are wanted of a scene.

    Attributes:
        side: name of the split.
        number: of the scene.
        controls: that make them harder together; none for plain ones alone.
        views: that are made harder.
        plain: views of the scene as it is.
        shared: whether all views share one adversarial texture.
        beside: controls that vary by chance from view to view.
    """

    side: str
    number: int
    controls: tuple[str, ...]
    views: int
    plain: int
    shared: bool = False
    beside: tuple[str, ...] = ()


@dataclass(frozen=True)
class Attacking:
    """An attack that is wanted on a held-out scene.

    Attributes:
        control: that is searched.
        number: of the scene.
        times: how much longer than usual; more than once is the stronger search.
        weights: of the model, safetensors; None for those that it was given with.
    """

    control: str
    number: int
    times: int
    weights: bytes | None = field(repr=False)


@dataclass(frozen=True)
class Looking:
    """Plain pictures that are wanted of a held-out scene.

    Attributes:
        number: of the scene.
    """

    number: int


Wanted = Drawing | Attacking | Looking


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


def scenes_of(settings: JsonObject) -> Call:
    """Return what does what is wanted of scenes of the hardening that the settings describe: what a worker does."""
    config = HardenConfig(**settings)
    task = make_task(config.task)
    (model, *_), _ = load_models([config.model], task, config)
    gc.freeze()  # what a scene leaves is collected after each; a sixth of the time goes into looking at all the rest
    return SceneWork(config, model, splits_of(config, model))


@dataclass
class SceneWork:
    """What is done with single scenes; pure functions of what is wanted.

    Attributes:
        config: of the run.
        model: as it was given.
        splits: by name.
    """

    config: HardenConfig
    model: Model
    splits: Mapping[str, Split]

    def __call__(self, wanted: Iterable[Wanted]) -> list[list[Lesson] | str]:
        """Return what came of each: lessons, or how an attack ended."""
        return [self._done(one) for one in wanted]

    def _done(self, one: Wanted) -> list[Lesson] | str:
        if isinstance(one, Attacking):
            return self._attack(one)
        return self._look(one) if isinstance(one, Looking) else self._draw(one)

    @cached_property
    def linear(self) -> tuple[str, ...]:
        """The controls whose pictures a matrix of light transport says; the others are rendered."""
        side = self.splits[TRAINING]
        return tuple(one for one in self.config.controls if has_matrix(self._problem(side, 0, (one,))[0]))

    @cached_property
    def rendered(self) -> tuple[str, ...]:
        """The controls whose pictures no matrix says."""
        return tuple(one for one in self.config.controls if one not in self.linear)

    @cached_property
    def beside(self) -> tuple[str, ...]:
        """The controls that are rendered which can vary by chance beside every matrix."""
        return tuple(one for one in self.rendered if self._can_vary(one))

    def _can_vary(self, control: str) -> bool:
        side = self.splits[TRAINING]
        try:
            return all(has_matrix(self._problem(side, 0, (one,), (control,))[0]) for one in self.linear)
        except InputError:
            return False

    @cached_property
    def _measured(self) -> frozenset[str]:
        """Fingerprints of the objects of all held-out scenes."""
        count = CLEAN_SCENES * self.config.measured
        return frozenset(fingerprint(asset) for asset in self.splits[HELD_OUT].assets(count))

    def _draw(self, one: Drawing) -> list[Lesson]:
        problem, seed = self._problem(self.splits[one.side], one.number, one.controls, one.beside)
        tries = TRIES_TO_CHOOSE if one.side == VALIDATION else None
        found = lessons(problem, one.views, seed, tries=tries, shared=one.shared) if one.views else []
        return found + plain_lessons(problem, one.plain, seed)

    def _attack(self, one: Attacking) -> str:
        """How an attack ended: "robust" where it found nothing and the clean scene is right in as many trials as a
        verified answer would have to be wrong in."""
        config, model = self.config, self.model
        if one.weights is not None:
            student = trainable(model)
            student.net.load_state_dict(safetensors.load(one.weights))
            model = student.model
        name, scene = self.splits[HELD_OUT].scene(one.number, self._set)
        seed = seeds.stream(config.seed, f"measured {one.control}", one.number)
        harder_search = {} if one.times == 1 else {"policy": STRONGER, "steps": one.times * config.steps}
        return attacked(self._of((one.control,), name, seed=seed, **harder_search), scene, model)

    def _look(self, one: Looking) -> list[Lesson]:
        side, controls = self.splits[HELD_OUT], tuple(self.config.controls)[:1]
        problem, _ = self._problem(side, one.number, controls)
        right, found = tuple(int(index) for index in problem.truth()), list[Lesson]()
        for view in range(CLEAN_VIEWS):
            seed = seeds.stream(side.seed, "plain", one.number * CLEAN_VIEWS + view)
            found.append(Lesson(right, levels_of(problem.picture(problem.domain.start, seed, CLEAN_SPP))))
        return found

    def _problem(
        self, side: Split, number: int, controls: Sequence[str], beside: Sequence[str] = ()
    ) -> tuple[Problem, int]:
        """What a scene is searched as, with controls that vary by chance beside, and the root of its lessons' draws."""
        name, scene = side.scene(number, self._set)
        if side.name != HELD_OUT:
            check_unmeasured(scene.description.object, self._measured)
        kinds = {control.partition(":")[0].partition(".")[0] for control in (*controls, *beside)}
        over = {other: given for other, given in OVER.items() if other not in kinds}
        over |= {control: self.config.controls[control] for control in beside}
        problem = problem_of(self._of(controls, name, over=over), scene, self.model, differentiated=False)
        return problem, seeds.stream(side.seed, "views", number)

    @property
    def _set(self) -> Given:
        return scene_settings(self.config)

    def _of(self, controls: Sequence[str], name: str, **changes: object) -> AttackConfig:
        """What some of the controls are searched with, on an object of a name."""
        config, given = self.config, {control: self.config.controls[control] for control in controls}
        own: dict[str, object] = dict.fromkeys(run_settings.RUN_SETTINGS)
        for control in controls:
            for setting, value in run_settings.alone(config, control, given[control]).items():
                before = own[setting]
                if isinstance(before, Mapping) and isinstance(value, Mapping):
                    own[setting] = {**before, **value}
                elif value is not None:
                    own[setting] = value
        found: dict[str, object] = {"object": name, "environment": None, "set_": {}, "exposure": 0.0, **own, **changes}
        found |= {"controls": given, "measure": "no", "baseline": False, "workers": None, "cluster": None}
        return AttackConfig.of(config, **found)


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
