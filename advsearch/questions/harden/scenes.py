"""Jobs of `harden` on single scenes, in this process or on workers.

A job makes lessons from a scene, attacks it, or evaluates its plain images.
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
    SceneDescription,
    assets,
    errors,
    results,
    seeds,
    settings,
    workbench,
)
from advsearch.questions.harden.changed_light import (
    change_white_light,
    vary_environment,
)
from advsearch.questions.harden.lessons import Lesson, make_lessons
from advsearch.questions.harden.objects import OBJECTS
from advsearch.questions.harden.result import ALL_OBJECTS, HardenConfig

# names of the splits of scenes
TRAINING = "training"
"""Split that the weights are trained on."""
FURTHER = "further training"
"""Split of further training scenes, each with a single view."""
VALIDATION = "validation"
"""Split by which weights are chosen."""
HELD_OUT = "held out"
"""Split on which the original and the hardened model are measured."""

ROBUST = "robust"
"""Status of a scene in which no attack found a wrong prediction."""

RANDOM_RANGES: dict[str, dict[str, object]] = {
    "camera": {"azimuth": [0.0, 360.0], "elevation": [8.0, 55.0], "roll": [-6.0, 6.0]},
    "environment": {"rotation": [0.0, 360.0], "exposure": [-0.8, 0.5]},
}
"""Ranges of parameters that vary at random from view to view, unless they are searched.
"""

N_VALIDATION_TRIES = 6
"""Random configurations of a validation view that is rendered; the worst one counts."""
CLEAN_SCENES = 4
"""Number of held-out scenes whose plain images are evaluated, for each held-out scene
that is attacked.
"""
CLEAN_VIEWS = 2
"""Plain images of each of these scenes."""
CLEAN_SPP = 16
"""Samples per pixel of these images."""

STRONGER_POLICY = {
    "name": "portfolio",
    "policies": [{"name": "restarts", "policy": "pgd"}, "cmaes", "random"],
}
"""The policy of the stronger search."""
STRONGER_STEPS_FACTOR = 3
"""Steps of the stronger search as a multiple of the usual steps."""

Job = partial[Any]
"""A method of `SceneJobs` with keyword arguments, among them the scene's `number`."""


@dataclass
class SceneJobs:
    """Runs jobs on single scenes, here or on workers.

    The result of a job depends only on its arguments and the settings.

    Attributes:
        config: the settings.
        model: the original model.
        splits: splits of scenes by name.
        progress: reports the jobs.
        executor: runs the jobs on workers; None runs them in this process.
    """

    config: HardenConfig
    model: Model
    splits: Mapping[str, SceneSplit]
    progress: Progress = field(default_factory=workbench.NullProgress)
    executor: Any = None

    def __call__(self, jobs: Iterable[Job]) -> list[Any]:
        return [job(self) for job in jobs]

    def run_jobs(
        self, title: str, jobs: Sequence[Job], hint: str = ""
    ) -> Iterator[tuple[int, Any]]:
        """Run jobs, and yield the index and the result of each, as soon as it is done.

        Args:
            title: title of the stage that the progress reports.
            jobs: the jobs.
            hint: text about how to shorten the stage.
        """
        self.progress.stage(title, len(jobs), hint=hint)
        # Batches end in any order. Each has its job object, whose `id` gives the index.
        index_of_job = {id(job): index for index, job in enumerate(jobs)}
        executor = self.executor or workbench.InProcess(self)
        # each job is a batch by itself
        for batch in executor.compute([job] for job in jobs):
            (job,) = batch.items
            if batch.failure_reason:
                raise errors.ClusterError(
                    f"harden, scene {job.keywords['number']}: {batch.failure_reason}"
                )
            (value,) = batch.value
            worker_counts: dict[str, float | str] = {}
            if executor.stats is not None:
                worker_counts = executor.stats.progress_counts
            self.progress.advance(1, **worker_counts)
            yield index_of_job[id(job)], value

    def sample_lessons(
        self,
        *,
        split: str,
        number: int,
        controls: Sequence[str],
        views: int,
        plain: int,
        shared: bool = False,
        varying_controls: Sequence[str] = (),
    ) -> list[Lesson]:
        """Make lessons of a scene.

        Args:
            split: name of the split.
            number: number of the scene.
            controls: controls that make the views harder together.
            views: number of views that are made harder.
            plain: number of further views of the plain scene.
            shared: whether the views share one adversarial texture.
            varying_controls: further controls that vary at random.
        """
        problem, seed = self.make_problem(
            self.splits[split], number, controls, varying_controls
        )
        # For the validation, many random configurations of a view are rendered, and the
        # worst counts. For the training there are two images of a view (None).
        n_tries = N_VALIDATION_TRIES if split == VALIDATION else None
        return make_lessons(
            problem,
            views,
            seed,
            n_plain=plain,
            n_tries=n_tries,
            shares_texture=shared,
        )

    def attack_held_out(
        self,
        *,
        control: str,
        number: int,
        steps_factor: int,
        weights: bytes | None = None,
    ) -> str:
        """Attack a held-out scene, and return the status of the attack.

        The status is `ROBUST` if the attack found nothing, and the model is right in
        enough trials of the clean scene; see `attack_scene`.

        Args:
            control: control that is searched.
            number: number of the scene.
            steps_factor: multiple of the usual steps. A factor above 1 also selects the
                policy of the stronger search.
            weights: the model's weights as bytes of a safetensors file; None for the
                original ones.
        """
        name, scene = self.splits[HELD_OUT].load_scene(
            number, workbench.collect_scene_parameters(self.config)
        )
        # The seed does not depend on the weights: the models before and after the
        # training are attacked in the same way.
        seed = seeds.derive_seed(self.config.seed, f"measured {control}", number)
        search = self._make_search_settings(steps_factor)
        config = self.make_attack_config((control,), name, seed=seed, **search)
        model = self.model if weights is None else self.with_weights(weights)
        return attack_scene(config, scene, model)

    def _make_search_settings(self, steps_factor: int) -> dict[str, Any]:
        """Return the settings that the stronger search changes; none for the usual one."""
        if steps_factor <= 1:
            return {}
        # Its policies do not all use gradients, which a hardened model may mask.
        return {"policy": STRONGER_POLICY, "steps": steps_factor * self.config.steps}

    def evaluate_plain_images(
        self, *, number: int, weights: bytes
    ) -> dict[str, list[Any]]:
        """Evaluate the original and the hardened model on plain held-out images.

        Args:
            number: number of the scene.
            weights: weights of the hardened model, as bytes of a safetensors file.

        Returns:
            Under "before" (the original model) and "after" (the hardened one) whether
            the model is right about each image. Under "outcomes before" and "outcomes
            after" what happens to the object in the other images, such as "missed".
        """
        split = self.splits[HELD_OUT]
        # A problem needs a searched control. Plain images do not change it, so it may
        # be any.
        first_control = next(iter(self.config.controls))
        problem, _ = self.make_problem(split, number, (first_control,))
        models = {"before": self.model, "after": self.with_weights(weights)}
        evaluations = dict[str, list[Any]]()
        for view in range(CLEAN_VIEWS):
            # Each view of each scene has its own seed, which is the same for both
            # models.
            seed = seeds.derive_seed(split.seed, "plain", number * CLEAN_VIEWS + view)
            for when, evaluation in _evaluate_start(problem, seed, models).items():
                _add_evaluation(evaluations, when, evaluation)
        return evaluations

    def with_weights(self, weights: bytes) -> Model:
        """Return the model with other weights, the bytes of a safetensors file."""
        network = self.model.copy_network()
        network.load_state_dict(safetensors.load(weights))
        return self.model.with_network(network)

    @cached_property
    def matrix_controls(self) -> tuple[str, ...]:
        """The controls whose images a matrix of light transport predicts."""
        return tuple(
            control for control in self.config.controls if self._has_matrix(control)
        )

    @property
    def rendered_controls(self) -> tuple[str, ...]:
        """The controls whose images have to be rendered."""
        return tuple(
            control
            for control in self.config.controls
            if control not in self.matrix_controls
        )

    @cached_property
    def random_controls(self) -> tuple[str, ...]:
        """The rendered controls that can vary at random in scenes with a matrix.

        A control is among them if all `matrix_controls` have a matrix while it varies.
        """
        return tuple(
            name
            for name in self.rendered_controls
            if all(self._has_matrix(other, name) for other in self.matrix_controls)
        )

    def _has_matrix(self, control: str, varying_control: str | None = None) -> bool:
        """Return whether a matrix of light transport predicts the images of a control.

        Args:
            control: the control that is searched.
            varying_control: a control that varies at random at the same time; None for
                none. The method returns False if the two cannot be combined.

        Raises:
            InputError: the control alone cannot be searched in a training scene.
        """
        varying_controls = () if varying_control is None else (varying_control,)
        try:
            # the first training scene stands for all
            problem, _ = self.make_problem(
                self.splits[TRAINING], 0, (control,), varying_controls
            )
            return problem.is_linear
        except InputError:
            if varying_control is None:
                raise
            return False

    @cached_property
    def _held_out_fingerprints(self) -> frozenset[str]:
        """Fingerprints of the objects in all held-out scenes."""
        n_scenes = CLEAN_SCENES * self.config.measured
        held_out_objects = self.splits[HELD_OUT].generate_objects(n_scenes)
        return frozenset(compute_fingerprint(asset) for asset in held_out_objects)

    def make_problem(
        self,
        split: SceneSplit,
        number: int,
        controls: Sequence[str],
        varying_controls: Sequence[str] = (),
    ) -> tuple[Problem, int]:
        """Return the problem of a scene, and the root seed of its samples.

        In addition to the searched controls, those of `RANDOM_RANGES` vary at random,
        such as the camera. One of these is left out if a control of the same kind is
        searched or varied already. Only held-out scenes may have a held-out object.

        Args:
            split: split that the scene belongs to.
            number: number of the scene.
            controls: controls that are searched.
            varying_controls: controls of the run that vary at random at the same time.

        Raises:
            InputError: the scene is not held out, but its object is.
        """
        name, scene = split.load_scene(
            number, workbench.collect_scene_parameters(self.config)
        )
        if split.name != HELD_OUT:
            check_not_held_out(scene.description.object, self._held_out_fingerprints)
        random_ranges = self._make_random_ranges(controls, varying_controls)
        config = self.make_attack_config(controls, name, over=random_ranges)
        problem = workbench.make_problem_on(
            config, scene, self.model, differentiated=False
        )
        return problem, seeds.derive_seed(split.seed, "views", number)

    def _make_random_ranges(
        self, controls: Sequence[str], varying_controls: Sequence[str]
    ) -> dict[str, Any]:
        """Return the ranges of all controls that vary at random, by their names.

        Args:
            controls: controls that are searched.
            varying_controls: controls of the run that vary at random at the same time.
        """
        used_kinds = {_get_kind(control) for control in (*controls, *varying_controls)}
        unused_ranges = {
            kind: ranges
            for kind, ranges in RANDOM_RANGES.items()
            if kind not in used_kinds
        }
        run_ranges = {
            control: self.config.controls[control] for control in varying_controls
        }
        return {**unused_ranges, **run_ranges}

    def make_attack_config(
        self, controls: Sequence[str], name: str, **changes: object
    ) -> AttackConfig:
        """Return the settings of an attack on one scene of the run.

        Args:
            controls: controls that are searched.
            name: name of the object.
            changes: further settings of the attack, such as `steps`, which override
                those of the run.
        """
        searched = {control: self.config.controls[control] for control in controls}
        changed = {
            **self._select_run_settings(searched),
            "object": name,
            # The scene is already loaded with these settings, which would change it again.
            "environment": None,
            "set_": {},
            "exposure": 0.0,
            **changes,
            "controls": searched,
        }
        return AttackConfig.from_config(
            self.config,
            **changed,
            # what a single attack inside of a hardening does not need
            measure="no",
            baseline=False,
            workers=None,
            cluster=None,
        )

    def _select_run_settings(
        self, searched: Mapping[str, Mapping[str, object]]
    ) -> dict[str, Any]:
        """Return the settings of the run that belong to the searched controls.

        Settings that only other controls of the run take are None.

        Args:
            searched: settings of the searched controls by their names.
        """
        selected: dict[str, Any] = {}
        for control, control_settings in searched.items():
            # all such settings of the run; None if the control does not take one
            run_settings = workbench.select_run_settings(
                self.config, control, control_settings
            )
            selected = _add_used_settings(selected, run_settings)
        return selected


def _add_used_settings(
    selected: Mapping[str, Any], run_settings: Mapping[str, Any]
) -> dict[str, Any]:
    """Return selected settings together with those that a control takes.

    Settings that no control takes get the value None. Entries of a setting that is a
    mapping by control, such as `epsilon`, are merged.

    Args:
        selected: settings that other controls take.
        run_settings: all such settings of the run; None if the control does not take
            one.
    """
    used_settings = {
        name: value for name, value in run_settings.items() if value is not None
    }
    none_by_name = dict.fromkeys(run_settings)
    return settings.merge_mappings({**none_by_name, **selected}, used_settings)


def _add_evaluation(
    evaluations: dict[str, list[Any]], when: str, evaluation: Any
) -> None:
    """Add the evaluation of an image to those that `evaluate_plain_images` returns.

    Args:
        evaluations: what has been evaluated so far, which is changed.
        when: "before" or "after".
        evaluation: evaluation of the prediction of the image.
    """
    evaluations.setdefault(when, []).append(evaluation.right)
    if not evaluation.right and evaluation.outcome is not None:
        outcomes = evaluations.setdefault(f"outcomes {when}", [])
        outcomes.append(evaluation.outcome.value)


def _evaluate_start(
    problem: Problem, seed: int, models: Mapping[str, Model]
) -> dict[str, Any]:
    """Return the evaluation of each model's prediction of the plain scene, by name.

    Args:
        problem: problem of the scene.
        seed: seed of the conditions and the noise.
        models: models by name; all see the same image.
    """
    start = problem.domain.start
    # a batch of one image (1, H, W, 3)
    image = problem.picture(start, seed, CLEAN_SPP)[None]
    truth = problem.find_truth(problem.make_full_configuration(start, seed))
    evaluations = dict[str, Any]()
    with torch.no_grad():
        for name, model in models.items():
            evaluations_of_batch = problem.task.judge(model(image), truth)
            evaluations[name] = evaluations_of_batch[0]
    return evaluations


def load_scene_work(config_fields: Mapping[str, Any]) -> SceneJobs:
    """Load what a worker needs to run jobs on scenes.

    Args:
        config_fields: fields of the settings.
    """
    config = HardenConfig(**config_fields)
    (model, *_), _ = workbench.load_models(
        [config.model], workbench.make_task(config.task), config
    )
    # Garbage is collected after each scene. Objects that are frozen here are skipped
    # then, which saves a sixth of the time.
    gc.freeze()
    return SceneJobs(config, model, make_splits(config, model))


def attack_scene(config: AttackConfig, scene: workbench.Scene, model: Model) -> str:
    """Attack a scene, and return the status of the model in it.

    - "found": the attack found an adversarial scene.
    - "already wrong": the model is wrong about the clean scene.
    - "unsteady": neither, but the model is right in too few trials of the clean scene.
      It has to be right in as many as those in which it would have to be wrong about an
      adversarial scene.
    - `ROBUST`: none of these.
    """
    summary = workbench.attack_on(config, scene, model).summary
    if summary.ending == results.INTERRUPTED:
        raise KeyboardInterrupt
    if summary.ending in ("found", "already wrong"):
        return summary.ending
    clean_trials = summary.clean.control
    if clean_trials is None:
        return "unsteady"
    n_needed = workbench.WORST_CASE.count_needed_successes(clean_trials.trials)
    return ROBUST if clean_trials.correct >= n_needed else "unsteady"


# ---- the split
# ----------------------------------------------------------------------------------

SCENE_RANGES = {
    "camera.azimuth": (0.0, 360.0),
    "camera.elevation": (8.0, 55.0),
    "camera.fov": (25.0, 45.0),
    "environment.rotation": (0.0, 360.0),
}
"""Ranges from which scenes sample parameters, in degrees."""
GROUND_BRIGHTNESS_RANGE = (0.1, 0.9)
"""Range of the ground's brightness, sRGB. Each channel differs a little from it."""


@dataclass(frozen=True)
class SceneSplit:
    """A split of scenes, such as "training"; each scene has a number.

    Attributes:
        name: name of the split.
        objects: names of bundled objects, or files.
        environments: names of bundled environments, or files.
        seed: root seed of all samples.
        varied: whether each scene has a random variation of an environment.
    """

    name: str
    objects: tuple[str, ...]
    environments: tuple[str, ...]
    seed: int
    varied: bool = False

    def load_scene(
        self, number: int, fixed_settings: Mapping[str, Any] | None = None
    ) -> tuple[str, workbench.Scene]:
        """Return a scene, and the name of its object.

        The objects take turns. An object in a file without a label is named after the
        file: ``coffee-mug.glb`` is a "coffee mug".

        Args:
            number: number of the scene, from 0.
            fixed_settings: values of scene parameters that are the same in all scenes,
                by name, such as "mug.bsdf.roughness". They override sampled ones.
        """
        name = self._get_object_name(number)
        # Each scene has its own generator, so that it does not depend on the order in
        # which scenes are loaded.
        rng = self.make_generator(number)
        scene = self._load_random_scene(name, rng, fixed_settings or {})
        description = scene.description
        if self.varied and description.environment is not None:
            light = vary_environment(description.environment, rng)
            light = change_white_light(light, rng)
            description = replace(description, environment=light)
        description = _label_object(description, name)
        is_changed = description is not scene.description
        return name, workbench.Scene(description) if is_changed else scene

    def _load_random_scene(
        self, name: str, rng: np.random.Generator, fixed_settings: Mapping[str, Any]
    ) -> workbench.Scene:
        """Load a random instance of an object in a random environment of the split.

        Args:
            name: name of a bundled object, or a file.
            rng: random generator of the scene.
            fixed_settings: values of scene parameters that override sampled ones.
        """
        asset = OBJECTS[name].generate(rng) if name in OBJECTS else Path(name)
        environment = self.environments[int(rng.integers(len(self.environments)))]
        scene_settings = {**_sample_scene_settings(rng), **fixed_settings}
        return workbench.load_scene(asset, environment, settings=scene_settings)

    def _get_object_name(self, number: int) -> str:
        """Return the name of the object of a scene: the objects take turns."""
        return self.objects[number % len(self.objects)]

    def make_generator(self, number: int) -> np.random.Generator:
        """Return the random generator of a scene."""
        return np.random.default_rng(
            [seeds.derive_seed(self.seed, f"{self.name} scene", number)]
        )

    def generate_objects(self, count: int) -> Iterator[assets.ObjectAsset]:
        """Yield the objects of the first `count` scenes.

        A bundled object is another instance in each scene. One in a file is always the
        same, so it is yielded only once.
        """
        for number in range(count):
            name = self._get_object_name(number)
            # Objects take turns, so the first scene of each has its index.
            is_first_time = number == self.objects.index(name)
            if name in OBJECTS:
                yield OBJECTS[name].generate(self.make_generator(number))
            elif is_first_time:
                _, scene = self.load_scene(number)
                yield scene.description.object


def _label_object(description: SceneDescription, file: str) -> SceneDescription:
    """Return a description whose object has a label: without one, that of its file."""
    if description.object.label is not None:
        return description
    labelled_object = replace(description.object, label=_name_class(file))
    return replace(description, object=labelled_object)


def _name_class(file: str) -> str:
    """Return the class that a file is named after: "coffee mug" of "coffee-mug.glb"."""
    return Path(file).stem.replace("-", " ").replace("_", " ")


def _get_kind(control: str) -> str:
    """Return the kind of a control: "light" of "light:key", "camera" of "camera.fov"."""
    return control.partition(":")[0].partition(".")[0]


def _sample_scene_settings(rng: np.random.Generator) -> dict[str, float]:
    """Sample the color of the ground, and the parameters in `SCENE_RANGES`."""
    brightness = rng.uniform(*GROUND_BRIGHTNESS_RANGE)
    tint = rng.normal(0.0, 0.05, 3)
    ground = np.clip(brightness + tint, 0.02, 0.98)
    scene_settings = {
        parameter: rng.uniform(*bounds) for parameter, bounds in SCENE_RANGES.items()
    }
    for channel, value in zip(("red", "green", "blue"), ground.tolist(), strict=True):
        scene_settings[f"ground.{channel}"] = value
    return scene_settings


def make_splits(config: HardenConfig, model: Model) -> dict[str, SceneSplit]:
    """Return the splits of scenes by name: training, further, validation and held-out.

    The held-out scenes have other environments than the rest, and other objects or
    other instances of the same objects, so that what is measured was not trained on.
    Their environments are not varied at random.

    Raises:
        InputError: the model has no class for any of the objects, or an object comes
            from a file and no held-out objects are named.
    """
    objects = _select_objects(config, model)
    _check_other_instances(config, objects)
    training_environments = _environments(config.environment, "train")
    splits = {
        name: SceneSplit(
            name,
            objects,
            training_environments,
            seed=seeds.derive_seed(config.seed, name),
            varied=True,
        )
        for name in (TRAINING, FURTHER, VALIDATION)
    }
    splits[HELD_OUT] = _make_held_out_split(config, objects)
    return splits


def _check_other_instances(config: HardenConfig, objects: Sequence[str]) -> None:
    """Check that there are other objects than those of the training to measure with.

    Raises:
        InputError: an object comes from a file and no held-out objects are named.
    """
    # A bundled object has random instances, a file only one.
    files = [name for name in objects if name not in OBJECTS]
    if files and config.held_out is None:
        raise InputError(
            f"held_out: {', '.join(files)} has no other instances; name other objects "
            "of its class, which are not trained on"
        )


def _make_held_out_split(
    config: HardenConfig, training_objects: tuple[str, ...]
) -> SceneSplit:
    """Return the split that is measured.

    Without the setting `held_out`, it has other instances of the same objects.
    """
    held_out_objects = training_objects
    if config.held_out is not None:
        held_out_objects = settings.split_names(config.held_out)
    return SceneSplit(
        HELD_OUT,
        held_out_objects,
        _environments(config.held_out_environment, "heldout"),
        seed=seeds.derive_seed(config.seed, HELD_OUT),
    )


def _select_objects(config: HardenConfig, model: Model) -> tuple[str, ...]:
    """Return the objects of the training that the model has a class for.

    The class of an object in a file is not known before it is loaded, so these objects
    are always included.

    Raises:
        InputError: there are none.
    """
    objects = tuple(OBJECTS) if config.object == ALL_OBJECTS else config.objects
    known = tuple(
        name
        for name in objects
        if name not in OBJECTS or _has_class(model, OBJECTS[name].label)
    )
    if not known:
        raise InputError(
            f"object: model {model.name} has a class for none of "
            f"{', '.join(objects)}; name other objects"
        )
    return known


def _has_class(model: Model, label: str) -> bool:
    """Return whether a model has a class for a label."""
    try:
        return bool(model.label_set(label).indices)
    except InputError:
        return False


def _environments(names: str | None, bundled_split: str) -> tuple[str, ...]:
    """Return the environments of a setting; without it, those of a bundled split."""
    if names:
        return settings.split_names(names)
    return workbench.library.list_environments(bundled_split)


def compute_fingerprint(asset: assets.ObjectAsset) -> str:
    """Return a hash of an object's mesh and texture."""
    arrays = (asset.mesh.vertices, asset.mesh.faces, asset.base_color)
    data = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    return hashlib.sha256(data).hexdigest()


def check_disjoint(held_out: SceneSplit, training_splits: Sequence[SceneSplit]) -> None:
    """Check that the training has no environment and no object of the measurement.

    Only the first instance of each object is compared here. All others are compared
    when they are sampled, as generating them takes minutes.

    Args:
        held_out: the split that is measured.
        training_splits: all other splits.

    Raises:
        InputError: an environment or a file is in both.
    """
    _check_disjoint_environments(held_out, training_splits)
    # Objects take turns, so that the first scenes have one instance of each.
    held_out_fingerprints = {
        compute_fingerprint(asset)
        for asset in held_out.generate_objects(len(held_out.objects))
    }
    for split in training_splits:
        for asset in split.generate_objects(len(split.objects)):
            check_not_held_out(asset, held_out_fingerprints)


def _check_disjoint_environments(
    held_out: SceneSplit, training_splits: Sequence[SceneSplit]
) -> None:
    """Check that the training has no environment of the measurement.

    Raises:
        InputError: an environment is in both.
    """
    training_environments = {
        name for split in training_splits for name in split.environments
    }
    common = sorted(training_environments & set(held_out.environments))
    if common:
        raise InputError(
            f"held_out_environment: {', '.join(common)} is an environment "
            "of the training, too; name other environments"
        )


def check_not_held_out(
    asset: assets.ObjectAsset, held_out_fingerprints: Set[str]
) -> None:
    """Check that an object of the training is not held out.

    Args:
        asset: the object.
        held_out_fingerprints: fingerprints of the held-out objects.

    Raises:
        InputError: the object is held out.
    """
    if compute_fingerprint(asset) in held_out_fingerprints:
        raise InputError(
            f"held_out: {asset.name} is an object of the training, too; name other "
            "objects"
        )
