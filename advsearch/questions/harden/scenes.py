"""What `harden` does with single scenes, here or on workers: draws lessons from one,
attacks one, or looks at one.
"""

from __future__ import annotations

import gc
import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import torch as safetensors

from advsearch.extend import (
    AttackConfig,
    InputError,
    Model,
    Problem,
    Progress,
    assets,
    results,
    seeds,
    settings,
    workbench,
)
from advsearch.questions.harden.changed_light import varied, white_light_changed
from advsearch.questions.harden.lessons import Lesson, lessons
from advsearch.questions.harden.objects import OBJECTS
from advsearch.questions.harden.result import ALL, HardenConfig

TRAINING = "training"
FURTHER = "further training"
VALIDATION = "validation"
HELD_OUT = "held out"
"""The splits: what the weights are fitted to (the second mostly as it is), what chooses
among them, and what is measured in the end.
"""

ROBUST = "robust"  # of a scene in which nothing was found; otherwise there is an ending

OVER: dict[str, dict[str, object]] = {
    "camera": {"azimuth": [0.0, 360.0], "elevation": [8.0, 55.0], "roll": [-6.0, 6.0]},
    "environment": {"rotation": [0.0, 360.0], "exposure": [-0.8, 0.5]},
}
"""What varies by chance from view to view, unless it is searched."""

# random configurations of a view that is rendered to choose weights by, of which the
# worst counts
TRIES_TO_CHOOSE = 6
CLEAN_SCENES = 4
CLEAN_VIEWS = 2
CLEAN_SPP = 16
"""Held-out scenes whose plain pictures are looked at, for each one that is attacked,
the views of each, and their samples a pixel.
"""

STRONGER = {
    "name": "portfolio",
    "policies": [{"name": "restarts", "policy": "pgd"}, "cmaes", "random"],
}
"""The policy of the stronger search, with three times the steps."""
TIMES = 3

# a method of `SceneWork` and its arguments: what is wanted of the scene `number`
Wanted = partial[Any]


@dataclass
class SceneWork:
    """What is done with single scenes and the given model: pure functions, carried out
    here or by an executor.
    """

    config: HardenConfig
    model: Model
    splits: Mapping[str, SceneSide]
    progress: Progress = field(default_factory=workbench.NullProgress)
    executor: Any = None

    def __call__(self, wanted: Iterable[Wanted]) -> list[Any]:
        return [each(self) for each in wanted]

    def each(
        self, title: str, wanted: Sequence[Wanted], hint: str = ""
    ) -> Iterator[tuple[int, Any]]:
        """Have done what is wanted of scenes; yield the place of each and what came of
        it, in any order.
        """
        self.progress.stage(title, len(wanted), hint=hint)
        places = {id(each): place for place, each in enumerate(wanted)}
        executor = self.executor or workbench.InProcess(self)
        for done in executor.results([each] for each in wanted):
            (each,) = done.items
            (value,) = done.require_value(f"harden, scene {each.keywords['number']}")
            self.progress.advance(
                1, **({} if executor.facts is None else executor.facts.told)
            )
            yield places[id(each)], value

    def drawn(
        self, *, side: str, number: int, controls: Sequence[str], views: int, plain: int, shared: bool = False,
        beside: Sequence[str] = (),
    ) -> list[Lesson]:  # fmt: skip
        """Draw lessons of a scene of a side: views that its controls make harder
        together, in which those `beside` vary by chance and which may share one
        adversarial texture, and `plain` views of it as it is.
        """
        problem, seed = self.problem(self.splits[side], number, controls, beside)
        tries = TRIES_TO_CHOOSE if side == VALIDATION else None
        return lessons(problem, views, seed, plain=plain, tries=tries, shared=shared)

    def attacked(
        self, *, control: str, number: int, times: int, weights: bytes | None = None
    ) -> str:
        """Attack a held-out scene, `times` as long as usual: more than once is the
        stronger search. Weights of the model are safetensors; None for those that it
        was given with. Return how it ended: `ROBUST` where it found nothing and the
        clean scene is right in as many trials as a verified answer would have to be
        wrong in.
        """
        name, scene = self.splits[HELD_OUT].scene(
            number, workbench.scene_settings(self.config)
        )
        seed = seeds.stream(self.config.seed, f"measured {control}", number)
        harder = (
            {}
            if times == 1
            else {"policy": STRONGER, "steps": times * self.config.steps}
        )
        config = self.attack((control,), name, seed=seed, **harder)
        return attacked(
            config, scene, self.model if weights is None else self.with_weights(weights)
        )

    def looked_at(self, *, number: int, weights: bytes) -> dict[str, list[Any]]:
        """Return whether plain pictures of a held-out scene are right "before", with
        the given weights, and "after"; and under "outcomes before" and "outcomes after"
        what becomes of the object in those that are not.
        """
        side = self.splits[HELD_OUT]
        right = dict[str, list[Any]]()
        problem, _ = self.problem(side, number, tuple(self.config.controls)[:1])
        for view in range(CLEAN_VIEWS):
            seed = seeds.stream(side.seed, "plain", number * CLEAN_VIEWS + view)
            picture = problem.picture(problem.domain.start, seed, CLEAN_SPP)[None]
            truth = problem.truth(problem.whole(problem.domain.start, seed))
            for when, model in (
                ("before", self.model),
                ("after", self.with_weights(weights)),
            ):
                with torch.no_grad():
                    judgement = problem.task.judge(model(picture), truth)[0]
                right.setdefault(when, []).append(judgement.right)
                if not judgement.right and judgement.outcome is not None:
                    right.setdefault(f"outcomes {when}", []).append(
                        judgement.outcome.value
                    )
        return right

    def with_weights(self, weights: bytes) -> Model:
        network = self.model.copy_network()
        network.load_state_dict(safetensors.load(weights))
        return self.model.with_network(network)

    @cached_property
    def linear(self) -> tuple[str, ...]:
        """The controls whose pictures a matrix of light transport says."""
        return tuple(
            control for control in self.config.controls if self._has_matrix(control)
        )

    @property
    def rendered(self) -> tuple[str, ...]:
        return tuple(
            control for control in self.config.controls if control not in self.linear
        )

    @cached_property
    def beside(self) -> tuple[str, ...]:
        """The controls that are rendered which can vary by chance beside every
        matrix.
        """
        return tuple(
            name
            for name in self.rendered
            if all(self._has_matrix(other, name) for other in self.linear)
        )

    def _has_matrix(self, *controls: str) -> bool:
        """Whether a matrix says the pictures of the first control, the others varying
        by chance.
        """
        try:
            return self.problem(self.splits[TRAINING], 0, controls[:1], controls[1:])[
                0
            ].is_linear
        except InputError:
            if len(controls) > 1:
                return False
            raise

    @cached_property
    def _measured(self) -> frozenset[str]:
        return frozenset(
            map(
                fingerprint,
                self.splits[HELD_OUT].assets(CLEAN_SCENES * self.config.measured),
            )
        )

    def problem(
        self,
        side: SceneSide,
        number: int,
        controls: Sequence[str],
        beside: Sequence[str] = (),
    ) -> tuple[Problem, int]:
        """Return what a scene is searched as, with controls that vary by chance
        `beside`, and the root of its draws.
        """
        name, scene = side.scene(number, workbench.scene_settings(self.config))
        if side.name != HELD_OUT:
            check_unmeasured(scene.description.object, self._measured)
        kinds = {
            control.partition(":")[0].partition(".")[0]
            for control in (*controls, *beside)
        }
        over = {other: ranges for other, ranges in OVER.items() if other not in kinds}
        over |= {control: self.config.controls[control] for control in beside}
        problem = workbench.problem_of(
            self.attack(controls, name, over=over),
            scene,
            self.model,
            differentiated=False,
        )
        return problem, seeds.stream(side.seed, "views", number)

    def attack(
        self, controls: Sequence[str], name: str, **changes: object
    ) -> AttackConfig:
        """Return what some of the controls are searched with, on an object of a
        name.
        """
        searched = {control: self.config.controls[control] for control in controls}
        changed: dict[str, Any] = {}  # None is what none of the controls takes
        for control, ranges in searched.items():
            alone = workbench.settings_alone(self.config, control, ranges)
            taken = {
                setting: value for setting, value in alone.items() if value is not None
            }
            changed = settings.merged({**dict.fromkeys(alone), **changed}, taken)
        changed |= {
            "object": name,
            "environment": None,
            "set_": {},
            "exposure": 0.0,
            **changes,
            "controls": searched,
        }
        return AttackConfig.of(
            self.config,
            **changed,
            measure="no",
            baseline=False,
            workers=None,
            cluster=None,
        )


def scenes_of(described: Mapping[str, Any]) -> SceneWork:
    """Return what does what is wanted of scenes of the hardening that settings
    describe: what a worker does.
    """
    config = HardenConfig(**described)
    (model, *_), _ = workbench.load_models(
        [config.model], workbench.make_task(config.task), config
    )
    # what a scene leaves is collected after each; a sixth of the time goes into looking
    # at all the rest
    gc.freeze()
    return SceneWork(config, model, splits_of(config, model))


def attacked(config: AttackConfig, scene: workbench.Scene, model: Model) -> str:
    """Attack, and return how it ended; `ROBUST` where nothing was found and the clean
    scene is steadily right.
    """
    summary = workbench.attack_on(config, scene, model).summary
    if summary.ending == results.INTERRUPTED:
        raise KeyboardInterrupt
    if summary.ending in ("found", "already wrong"):
        return summary.ending
    control = summary.clean.control
    steady = control is not None and control.correct >= workbench.WORST_CASE.needed(
        control.trials
    )
    return ROBUST if steady else "unsteady"


# ---- the split
# ------------------------------------------------------------------------------------------------------

RANGES = {
    "camera.azimuth": (0.0, 360.0),
    "camera.elevation": (8.0, 55.0),
    "camera.fov": (25.0, 45.0),
    "environment.rotation": (0.0, 360.0),
}
"""Ranges from which scenes draw parameters, in degrees."""
# the range of the ground's level, sRGB, around which the channels differ
GROUND = (0.1, 0.9)


@dataclass(frozen=True)
class SceneSide:
    """One side of the split: objects (bundled ones, or files) and environments, and the
    root of its draws. With `varied` each scene has an environment of its own, made from
    one of these.
    """

    name: str
    objects: tuple[str, ...]
    environments: tuple[str, ...]
    seed: int
    varied: bool = False

    def scene(
        self, number: int, given: Mapping[str, Any] | None = None
    ) -> tuple[str, workbench.Scene]:
        """Return the scene with this number, from 0, and the name of its object; the
        objects take turns. Parameters that are given are fixed. An object in a file
        without a label is called as it: ``coffee-mug.glb``, "coffee mug".
        """
        name = self.objects[number % len(self.objects)]
        rng = self._draws(number)
        made = OBJECTS[name].generate(rng) if name in OBJECTS else Path(name)
        environment = self.environments[int(rng.integers(len(self.environments)))]
        ground = np.clip(rng.uniform(*GROUND) + rng.normal(0.0, 0.05, 3), 0.02, 0.98)
        drawn = {parameter: rng.uniform(*ends) for parameter, ends in RANGES.items()}
        drawn |= dict(
            zip(
                ("ground.red", "ground.green", "ground.blue"),
                ground.tolist(),
                strict=True,
            )
        )
        scene = workbench.load_scene(
            made, environment, settings={**drawn, **(given or {})}
        )
        described = scene.description
        if self.varied and described.environment is not None:
            light = white_light_changed(varied(described.environment, rng), rng)
            described = replace(described, environment=light)
        if described.object.label is None:
            label = Path(name).stem.replace("-", " ").replace("_", " ")
            described = replace(
                described, object=replace(described.object, label=label)
            )
        return name, scene if described is scene.description else workbench.Scene(
            described
        )

    def _draws(self, number: int) -> np.random.Generator:
        return np.random.default_rng(
            [seeds.stream(self.seed, f"{self.name} scene", number)]
        )

    def assets(self, count: int) -> Iterator[assets.ObjectAsset]:
        """Yield the objects of the first `count` scenes; what a file holds comes
        once.
        """
        for number in range(count):
            name = self.objects[number % len(self.objects)]
            if name in OBJECTS:
                yield OBJECTS[name].generate(self._draws(number))
            elif number == self.objects.index(name):
                yield self.scene(number)[1].description.object


def splits_of(config: HardenConfig, model: Model) -> dict[str, SceneSide]:
    """Return the sides of the split by name; an InputError where there is nothing on a
    side.
    """

    def has_class(label: str) -> bool:
        try:
            return bool(model.label_set(label).indices)
        except InputError:
            return False

    objects = tuple(OBJECTS) if config.object == ALL else config.objects
    known = tuple(
        name
        for name in objects
        if name not in OBJECTS or has_class(OBJECTS[name].label)
    )
    if not known:
        raise InputError(
            f"object: model {model.name} has a class for none of "
            f"{', '.join(objects)}; name others"
        )
    files = [name for name in known if name not in OBJECTS]
    if files and config.held_out is None:
        raise InputError(
            f"held_out: {', '.join(files)} has no other instances; name objects of its "
            "class that training never sees"
        )
    lit = [
        settings.split_names(names)
        if names
        else workbench.library.list_environments(bundled)
        for names, bundled in (
            (config.environment, "train"),
            (config.held_out_environment, "heldout"),
        )
    ]
    sides = {name: (known, lit[0], True) for name in (TRAINING, FURTHER, VALIDATION)}
    sides[HELD_OUT] = (
        known if config.held_out is None else settings.split_names(config.held_out),
        lit[1],
        False,
    )
    return {
        name: SceneSide(name, a, b, seeds.stream(config.seed, name), c)
        for name, (a, b, c) in sides.items()
    }


def fingerprint(asset: assets.ObjectAsset) -> str:
    parts = asset.mesh.vertices, asset.mesh.faces, asset.base_color
    return hashlib.sha256(
        b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    ).hexdigest()


def check_disjoint(held: SceneSide, taught: Sequence[SceneSide]) -> None:
    """Refuse, by an InputError, to measure what is trained on: one of the training's
    environments, or of its files. Of each bundled object the first instance is looked
    at; all others, which take minutes, when they are drawn.
    """
    both = sorted(
        {name for split in taught for name in split.environments}
        & set(held.environments)
    )
    if both:
        raise InputError(
            f"held_out_environment: {', '.join(both)} is an environment "
            "of the training too; name others"
        )
    measured = set(map(fingerprint, held.assets(len(held.objects))))
    for split in taught:
        for asset in split.assets(len(split.objects)):
            check_unmeasured(asset, measured)


def check_unmeasured(asset: assets.ObjectAsset, measured: Set[str]) -> None:
    """Refuse, by an InputError, to train on an object whose fingerprint is among those
    of what is measured.
    """
    if fingerprint(asset) in measured:
        raise InputError(
            f"held_out: {asset.name} is an object of the training too; name others"
        )
