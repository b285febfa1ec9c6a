"""What a sweep evaluates: its scenes, models, controls and axes, and their images."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TypeAlias

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluation, Query, TrialCounts, run_trials
from advsearch.attacks.domain import SeedSequence
from advsearch.controls import Control, Space, make_control, make_space
from advsearch.engine.image_changes import WITHOUT_OBJECT, change_image, meets_claim
from advsearch.engine.journal import Journal, ParallelEvaluator, WorkItem
from advsearch.engine.judging import Metrics, check_truth, make_domain
from advsearch.engine.loading import Scene, fit_camera, make_renderer
from advsearch.engine.problem import Preparation, Problem
from advsearch.engine.record import make_rate
from advsearch.engine.rendering import make_facts
from advsearch.engine.verifier import Verifier, choose_ladder
from advsearch.errors import InputError
from advsearch.models import Model
from advsearch.models.features import Features, features_of
from advsearch.options import Value
from advsearch.progress import Stages
from advsearch.questions.sweep.axes import (
    Axis,
    SampledNumber,
    SceneConfigurations,
    add_grid_axes,
)
from advsearch.questions.sweep.predicting import SweepPredictor, SweptImage
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.summary import WorstVerified
from advsearch.questions.sweep.tracks import ConstantVelocity, Tracker
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results import VerifiedRate
from advsearch.scene.color import round_to_8_bit
from advsearch.scene.description import ENVIRONMENT, OBJECT
from advsearch.scene.formation import round_sample_count
from advsearch.scene.renderer import Renderer
from advsearch.tasks import Facts, Judgement, Task
from advsearch.viewer import thumbnails

KIND = "sweep"  # rows of the sweep, and the stream of their seeds
DEFAULT_SAMPLES = 100  # number of samples of a sweep without a grid
ImageSize: TypeAlias = tuple[int, int]  # (height, width)


@dataclass(frozen=True)
class NamedScene:
    """One of the scenes of a sweep.

    Attributes:
        object_name: name of the object.
        environment_name: name of the environment.
        scene: the loaded scene.
        fixed_controls: controls of an attack, which are fixed in the sweep.
        adversarial_configuration: (d,) the adversarial configuration of these; None
            leaves them at their values in the clean scene.
        arm: name of the arm if clean and adversarial scenes are compared: "clean", or
            the name of the attack's run; empty if nothing is compared.
        photograph_name: name of the scene's photograph in a folder of photographs; empty
            without a folder.
    """

    object_name: str
    environment_name: str
    scene: Scene
    fixed_controls: tuple[Control, ...] = ()
    adversarial_configuration: Tensor | None = None
    arm: str = ""
    photograph_name: str = ""

    @property
    def value_of_scene_axis(self) -> dict[str, str]:
        """The scene's values of the axes that are not controls, as a new dict."""
        names = {"object": self.object_name, "environment": self.environment_name}
        if self.photograph_name:
            names["backdrop"] = self.photograph_name
        if self.arm:
            names["answer"] = self.arm  # the axis of clean and adversarial scenes
        return names


@dataclass(frozen=True)
class Job:
    """Everything that a sweep needs, loaded.

    Images are numbered by scene, then as `SceneConfigurations` numbers them; rows by image, then by
    model.

    Attributes:
        config: the settings.
        scenes: the scenes.
        models: the models, all of which get the same images.
        tasks: a task for each model.
        controls: controls that are sampled.
        axes: axes of the grid.
        aovs: layers of ground truth to store with every image of the first model
            (`scene.formation.AOVS`).
        warnings: warnings of loading.
        metrics: columns of the rows, by name.
        tracker: tracker of drives.
    """

    config: SweepConfig
    scenes: tuple[NamedScene, ...]
    models: tuple[Model, ...]
    tasks: tuple[Task, ...]
    controls: tuple[Control, ...]
    axes: tuple[Axis, ...]
    aovs: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    metrics: Metrics = field(default_factory=dict)
    tracker: Tracker = ConstantVelocity
    _points_by_scene: dict[int, dict[ImageSize, SceneConfigurations]] = field(
        default_factory=dict, init=False, repr=False
    )

    @property
    def samples_per_grid_point(self) -> int:
        """Number of samples at each point of the grid: by default 1, or more without a
        grid.
        """
        is_sampled_only = bool(self.controls) and not self.axes
        default = DEFAULT_SAMPLES if is_sampled_only else 1
        return self.config.samples or default

    @cached_property
    def spp(self) -> int:
        """Samples per pixel, rounded as the sampler of pixels needs it."""
        return round_sample_count(self.config.pixel_sampler, self.config.search_spp)

    @cached_property
    def image_sizes(self) -> tuple[ImageSize, ...]:
        """(height, width) of the images of each model."""
        return tuple(
            self.config.resolution or model.input_size for model in self.models
        )

    @cached_property
    def is_first_of_size(self) -> tuple[bool, ...]:
        """Of each model, whether no model before it gets the same images."""
        return tuple(
            size not in self.image_sizes[:model]
            for model, size in enumerate(self.image_sizes)
        )

    @cached_property
    def images_per_scene(self) -> int:
        """Number of images of a scene, which is the same for all scenes and sizes."""
        return next(iter(self.load_configurations_by_size(0).values())).n_images

    @cached_property
    def seeds(self) -> SeedSequence:
        """The seeds of the noise, by the number of the image."""
        return SeedSequence(self.config.seed, KIND)

    def load_configurations_by_size(
        self, scene: int
    ) -> dict[ImageSize, SceneConfigurations]:
        """Return the configurations of a scene, by the size of the images.

        Those of the last scene are cached.
        """
        if scene not in self._points_by_scene:
            self._points_by_scene.clear()
            self._points_by_scene[scene] = {
                size: self._make_configurations_of_size(scene, size)
                for size in dict.fromkeys(self.image_sizes)
            }
        return self._points_by_scene[scene]

    def _make_configurations_of_size(
        self, scene: int, size: ImageSize
    ) -> SceneConfigurations:
        """Return the configurations of a scene for one size of images."""
        space = self.bind_controls(self.scenes[scene], size)
        return self.make_scene_configurations(space)

    def make_queries(self, numbers: range) -> list[WorkItem]:
        """Return the queries of all models about images of one scene.

        A query is numbered as the row that stores its result: by image, then by model.

        Args:
            numbers: numbers of the images in the sweep, all of one scene.

        Returns:
            The queries by ascending number, each as (name of the problem, None, query).
            The problem's name is the scene's number. None is in place of the
            configuration, which the query has.
        """
        scene = numbers.start // self.images_per_scene
        images_before = scene * self.images_per_scene  # those of the scenes before
        first_in_scene = numbers.start - images_before
        queries = list[Query]()
        # The configurations may differ between sizes, since framing depends on them.
        for size, configurations in self.load_configurations_by_size(scene).items():
            all_u = configurations.make_configurations(
                first_in_scene, len(numbers), before=images_before
            )
            descriptions = configurations.describe_images(all_u, first_in_scene)
            models = self.list_models_of_size(size)
            for number, u, values in zip(numbers, all_u, descriptions, strict=True):
                for model in models:
                    query = self._make_query(number, model, configurations, u, values)
                    queries.append(query)
        # The loop above is by size; rows are by image, then by model.
        queries.sort(key=lambda query: query.row_index)
        return [(str(scene), None, query) for query in queries]

    def list_models_of_size(self, size: ImageSize) -> list[int]:
        """Return the indices of the models that get images of a size."""
        return [
            model
            for model, model_size in enumerate(self.image_sizes)
            if model_size == size
        ]

    def _make_query(
        self,
        number: int,
        model: int,
        configurations: SceneConfigurations,
        u: Tensor,
        values: Mapping[str, Value],
    ) -> Query:
        """Return the query of a model about an image.

        Args:
            number: number of the image in the sweep.
            model: index of the model.
            configurations: configurations of the scene.
            u: (d,) the configuration.
            values: values of the controls.
        """
        scene = number // self.images_per_scene
        # an environment that a control or an axis chooses instead of the scene's
        environment = configurations.space.find_environment_name(values)
        return Query(
            u.clone(),
            seed=self.seeds(configurations.find_noise_index(number)),
            kind=KIND,
            row_index=number * len(self.models) + model,
            spp=self.spp,
            draws_conditions=False,  # `u` has all sampled values already
            values=self._make_row_values(scene, model, environment, values),
            has_success=False,  # a sweep counts right predictions, not successes
            includes_image=self.config.keep_pictures != "none",
        )

    def _make_row_values(
        self,
        scene: int,
        model: int,
        environment: str | None,
        values: Mapping[str, Value],
    ) -> dict[str, Value]:
        """Return the stored values of a row: names of scene and model, and parameters.

        Controls that the adversarial configuration of the scene fixes are left out.

        Args:
            scene: index of the scene.
            model: index of the model.
            environment: name of the environment that replaces that of the scene; None
                if the scene keeps its own.
            values: values of the controls.
        """
        fixed_names = {control.name for control in self.scenes[scene].fixed_controls}
        names = self._name_row(scene, model, environment)
        row_values: dict[str, Value] = {
            name: {"value": text, "unit": ""} for name, text in names.items()
        }
        for name, value in values.items():
            control_name = name.partition(".")[0]
            if control_name not in fixed_names:
                row_values[name] = value
        return row_values

    def _name_row(
        self, scene: int, model: int, environment: str | None
    ) -> dict[str, str]:
        """Return the names of scene and model in a row, by axis.

        See `_make_row_values` for the arguments.
        """
        names = self.scenes[scene].value_of_scene_axis  # a new dict
        if environment is not None:
            names["environment"] = environment
        names["model"] = self.models[model].name
        return names

    def bind_controls(self, named_scene: NamedScene, size: ImageSize) -> Space:
        """Bind all controls of the sweep to a scene.

        The axes of the grid are discrete choices of their controls. Controls that an
        adversarial configuration fixes come first, and are set to it, so that only the
        others are left to vary.

        Args:
            named_scene: the scene.
            size: (height, width) of the images.

        Raises:
            InputError: the adversarial configuration does not fit the scene, or a
                sampled parameter was set.
        """
        description = fit_camera(named_scene.scene.description, size)
        controls = (
            *named_scene.fixed_controls,
            *add_grid_axes(self.controls, self.axes, description),
        )
        if not controls:
            return Space((), None)  # a space without any coordinate
        space = make_space(controls, description)
        if named_scene.fixed_controls:
            space = _fix_controls(named_scene, space)
        _check_sampled_not_set(named_scene, space)
        return space

    def make_scene_configurations(self, space: Space) -> SceneConfigurations:
        """Return the configurations of a space.

        In a comparison without and with an adversarial configuration, the second half
        of the scenes are those with it. They repeat the draws of the first half.
        """
        # In a comparison every scene has the name of an arm, clean ones, too.
        is_comparison = bool(self.scenes[0].arm)
        repeat_after_scenes = len(self.scenes) // 2 if is_comparison else 0  # 0: never
        # one name without a folder of photographs: all are empty then
        photograph_names = {scene.photograph_name for scene in self.scenes}
        return SceneConfigurations(
            space,
            make_domain(space.controls),
            self.axes,
            samples=self.samples_per_grid_point,
            sampler=self.config.sampler,
            seed=self.config.seed,
            repeat_after_scenes=repeat_after_scenes,
            n_scenes=len(self.scenes),
            n_photographs=len(photograph_names),
        )

    def make_ground_truth_facts(
        self, named_scene: NamedScene, values: Mapping[str, Value]
    ) -> Facts:
        """Return what a task needs to know about a scene.

        Args:
            named_scene: the scene.
            values: values of its controls by name; empty if the task does not need
                them.
        """
        return make_facts(
            named_scene.scene.description,
            named_scene.object_name,
            label=self.config.label,
            describe=lambda: values,  # called only by tasks that need the values
            judge=self.config.judge,
        )


def _fix_controls(named_scene: NamedScene, space: Space) -> Space:
    """Fix the first controls of a space to the configuration of a scene.

    Args:
        named_scene: scene with fixed controls. Without a configuration `u`, these are
            fixed to their start, as in the clean arm.
        space: space of all controls, with the fixed ones first.

    Raises:
        InputError: the adversarial configuration does not fit the scene.
    """
    # The space's controls are bound to the scene, and so have a start; those of
    # `named_scene` are not.
    fixed_controls = space.controls[: len(named_scene.fixed_controls)]
    start = torch.cat([control.start for control in fixed_controls])
    if named_scene.adversarial_configuration is None:
        return space.fix_first_controls(start)
    if len(named_scene.adversarial_configuration) != len(start):
        raise InputError(
            "adversarial_of: the adversarial configuration of "
            f"{named_scene.arm} has {len(named_scene.adversarial_configuration)} "
            f"numbers, and {named_scene.object_name} takes {len(start)}: it is "
            "another object, or it has changed since; do the run again"
        )
    return space.fix_first_controls(named_scene.adversarial_configuration)


def _check_sampled_not_set(named_scene: NamedScene, space: Space) -> None:
    """Raise an error if a sampled parameter is fixed with `set`.

    Args:
        named_scene: the scene.
        space: space of what is sampled.
    """
    # What the user fixed with `set` must not be sampled, except for the environment, for
    # which `check_scenes` has other rules.
    set_by_user = named_scene.scene.description.requested - {ENVIRONMENT}
    for group in space.groups:
        if group.setting in set_by_user:
            raise InputError(
                f"`controls` {group.control}: draws {group.parameter} by chance, "
                f"and `set` {group.setting} fixes it; leave it out of one of the "
                "two"
            )


def check_scenes(
    named_scenes: Sequence[NamedScene],
    controls: Sequence[Control],
    axes: Sequence[Axis],
) -> None:
    """Check that nothing varies that is fixed or chosen elsewhere.

    Args:
        named_scenes: all scenes of the sweep.
        controls: controls that are sampled.
        axes: axes of the grid.

    Raises:
        InputError: an axis varies what `set` fixes, or an axis or a control chooses the
            environment although several environments are named.
    """
    # the axes and controls that choose the environment, as the user wrote them
    environment_choices = [
        *_list_environment_axes(named_scenes, controls, axes),
        *_list_environment_controls(controls),
    ]
    all_environments = [scene.environment_name for scene in named_scenes]
    environments = list(dict.fromkeys(all_environments))
    if len(environments) > 1 and environment_choices:
        raise InputError(
            f"`environment={','.join(environments)}` and {environment_choices[0]} both "
            "choose what lights the scene; name all of "
            "them in one of the two, and leave the other out"
        )


def _list_environment_axes(
    named_scenes: Sequence[NamedScene],
    controls: Sequence[Control],
    axes: Sequence[Axis],
) -> list[str]:
    """Return the axes that choose the environment, as the user wrote them.

    See `check_scenes` for the arguments.

    Raises:
        InputError: an axis varies what `set` fixes.
    """
    fixed_settings = _find_fixed_settings(named_scenes)
    environment_axes = list[str]()
    for axis in axes:
        setting = _find_setting(axis, controls)
        # If `set` fixes the environment, an axis may still choose it.
        if setting == ENVIRONMENT:
            environment_axes.append(f"`grid` {axis.name}")
        elif setting in fixed_settings:
            raise InputError(
                f"`grid` {axis.name}: `set` fixes it already; leave it "
                "out of one of the two"
            )
    return environment_axes


def _find_fixed_settings(named_scenes: Sequence[NamedScene]) -> set[str]:
    """Return the settings that the user has fixed in any scene with `set`."""
    return {
        name
        for named_scene in named_scenes
        for name in named_scene.scene.description.requested
    }


def _list_environment_controls(controls: Sequence[Control]) -> list[str]:
    """Return the controls that choose the environment, as the user wrote them."""
    environment_controls = list[str]()
    for control in controls:
        for parameter in control.parameters:
            # A control's settings contain the parameters that it varies.
            is_varied = parameter.name in control.to_settings()
            if control.get_setting_name(parameter) == ENVIRONMENT and is_varied:
                environment_controls.append(f"`controls` {control.name}")
    return environment_controls


def _find_setting(axis: Axis, controls: Sequence[Control]) -> str:
    """Return the name of the scene's setting that an axis varies.

    For example, an axis over "environment.which" varies "environment".
    """
    control = next(
        (control for control in controls if control.name == axis.control_name), None
    )
    if control is None:
        # Any value of the axis is used, since the setting does not depend on it.
        settings = {"kind": axis.control_kind, axis.parameter.name: axis.values[0]}
        control = make_control(axis.control_name, settings)
    return control.get_setting_name(axis.parameter)


def check_job(job: Job) -> tuple[SceneConfigurations, tuple[SampledNumber, ...]]:
    """Check a job by binding every scene, so that errors come before any rendering.

    Returns:
        The configurations of the first scene, and the sampled numbers that tables count by. If
        the range of a number differs between scenes or image sizes, its parts are
        fractions of the range instead of values.

    Raises:
        InputError: controls sample other numbers in one scene than in another.
    """
    pairs = _bind_all_scenes(job)
    _, first_configurations = pairs[0]
    _check_same_layout(pairs)
    # A number may have another range in another scene or size: it has a version in
    # each.
    numbers_of_pair = [configurations.sampled_numbers for _, configurations in pairs]
    sampled = [
        _merge_versions(versions, first_configurations.parts_per_range)
        for versions in zip(*numbers_of_pair, strict=True)
    ]
    return first_configurations, tuple(sampled)


def _bind_all_scenes(job: Job) -> list[tuple[NamedScene, SceneConfigurations]]:
    """Return a pair for each scene and each size of images, and check the right labels.

    Raises:
        InputError: controls cannot be bound to a scene, or no prediction about it would
            be right.
    """
    pairs = list[tuple[NamedScene, SceneConfigurations]]()
    for scene, named_scene in enumerate(job.scenes):
        pairs += [
            (named_scene, configurations)
            for configurations in job.load_configurations_by_size(scene).values()
        ]
        _check_truths(job, named_scene)
    return pairs


def _check_truths(job: Job, named_scene: NamedScene) -> None:
    """Check that each model of a sweep can be right about a scene."""
    facts = job.make_ground_truth_facts(named_scene, {})
    for task, model in zip(job.tasks, job.models, strict=True):
        check_truth(task, model, named_scene.scene, facts, job.config.image_settings)


def _check_same_layout(pairs: Sequence[tuple[NamedScene, SceneConfigurations]]) -> None:
    """Raise an error if controls sample other numbers in one scene than in another."""
    first_scene, first_configurations = pairs[0]
    for named_scene, configurations in pairs:
        if configurations.sampled_layout != first_configurations.sampled_layout:
            raise InputError(
                f"`object` {named_scene.object_name}: its controls draw other numbers than "
                f"those of {first_scene.object_name}; sweep the two by themselves"
            )


def _merge_versions(versions: Sequence[SampledNumber], n_parts: int) -> SampledNumber:
    """Return a sampled number whose parts are the same in all scenes.

    A table counts predictions by the parts of a number's range. If the range differs
    between scenes, the parts become fractions of the range instead of values.

    Args:
        versions: the number in each scene.
        n_parts: number of parts of its range.
    """
    number = versions[0]
    if all(version.range_parts == number.range_parts for version in versions):
        return number
    fractions = tuple([k / n_parts, (k + 1) / n_parts] for k in range(n_parts))
    return replace(
        number, unit="of its range", range_parts=fractions, same_in_all_scenes=False
    )


class SweptScene:
    """One scene, ready to be rendered and evaluated.

    Models may get images of different sizes, and where a control places the camera may
    depend on the size. So there are configurations, a renderer and a predictor for each
    size.

    Attributes:
        number: index of the scene in the sweep.
        job: the job of the sweep.
        configurations_by_size: configurations of the scene, by image size.
        renderer_of_size: renderer of the scene, by image size.
        problems: a problem for each model.
        predictor_of_size: predictor of the scene's images, by image size.
    """

    def __init__(self, job: Job, number: int) -> None:
        """Make renderers, problems and predictors of the scene with this number."""
        self.number = number
        self.job = job
        self.configurations_by_size = job.load_configurations_by_size(number)
        # renderers of the scene without its object, by size, made on demand
        self._empty_renderers: dict[ImageSize, Renderer] = {}
        self.renderer_of_size = {
            size: self._make_renderer(size) for size in self.configurations_by_size
        }
        self.problems = tuple(map(self._make_problem, range(len(job.models))))
        self.predictor_of_size = {
            size: self._make_predictor(size) for size in self.configurations_by_size
        }

    def _make_problem(self, model: int) -> Problem:
        """Return the problem of a model, by its index."""
        job = self.job
        named_scene = job.scenes[self.number]
        size = job.image_sizes[model]
        make_scene_facts = partial(
            make_facts,
            named_scene.scene.description,
            named_scene.object_name,
            job.config.label,
            judge=job.config.judge,
        )
        return Problem(
            renderer=self.renderer_of_size[size],
            space=self.configurations_by_size[size].space,
            model=job.models[model],
            task=job.tasks[model],
            make_facts=make_scene_facts,
            objective=None,  # a sweep searches for nothing
            search_spp=job.spp,
            seed=job.config.seed,
            metrics=job.metrics,
        )

    def _make_predictor(self, size: ImageSize) -> SweepPredictor:
        """Return the predictor of the images of a size; all its models share it."""
        config = self.job.config
        points = self.configurations_by_size[size]
        first_model_of_size = self.job.image_sizes.index(size)
        return SweepPredictor(
            problem=self.problems[first_model_of_size],
            configurations=points,
            axes=self.job.axes,
            seed=seeds.derive_seed(config.seed, "sweep light", self.number),
            specialise=config.specialise,
            # the number of images in the scenes before this one
            images_before=self.number * points.n_images,
        )

    @property
    def n_non_finite(self) -> int:
        """Number of values of images that were not finite and were set to 0."""
        rendered = sum(
            renderer.n_non_finite for renderer in self.renderer_of_size.values()
        )
        predicted = sum(
            images.n_non_finite for images in self.predictor_of_size.values()
        )
        return rendered + predicted

    def evaluate_all(
        self, queries: Sequence[Query], prepared: Preparation | None = None
    ) -> list[Evaluation]:
        """Evaluate queries of consecutive rows.

        An image is made once for each size, and a model gets all images of the batch
        together. The last evaluation also has what concerns the full batch: a summary
        of the predictors, and the number of values that were not finite.

        Args:
            queries: queries of this scene.
            prepared: not used, since sweeps prepare nothing.
        """
        begin = time.perf_counter()
        not_finite_before = self.n_non_finite
        images = {
            size: self._make_images(size, queries)
            for size in self.configurations_by_size
        }
        judgements = self._make_judgements(queries, images)
        # Queries are evaluated together, so each gets an equal part of the time.
        seconds = (time.perf_counter() - begin) / len(queries)
        evaluations = self._make_evaluations(queries, images, judgements, seconds)
        # A predictor that was released since is no longer counted, so that the
        # difference could be negative.
        n_new_non_finite = max(0, self.n_non_finite - not_finite_before)
        predictors = self.predictor_of_size.values()
        summaries = [predictor.summarize() for predictor in predictors]
        evaluations[-1] = replace(
            evaluations[-1], collected_light=summaries, n_non_finite=n_new_non_finite
        )
        return evaluations

    def _make_evaluations(
        self,
        queries: Sequence[Query],
        images: Mapping[ImageSize, Mapping[int, SweptImage]],
        judgements: Mapping[int, Judgement],
        seconds: float,
    ) -> list[Evaluation]:
        """Return the evaluation of each query.

        The first model's evaluation carries the images that are stored. Models of one
        size share an image; its cost counts for the first of them.

        Args:
            queries: queries of this scene.
            images: images by size, then by the number of the image.
            judgements: judgements by the number of the query.
            seconds: seconds that each query took.
        """
        wrong_images = self._find_wrong_images(judgements)
        evaluations = list[Evaluation]()
        for query in queries:
            number, model = divmod(query.row_index, len(self.job.models))
            image = images[self.job.image_sizes[model]][number]
            judgement = judgements[query.row_index]
            evaluation = self._make_evaluation(model, image, judgement, seconds)
            if model == 0:
                is_wrong = number in wrong_images
                evaluation = self._attach_images(evaluation, query, image, is_wrong)
            evaluations.append(evaluation)
        return evaluations

    def _make_evaluation(
        self, model: int, image: SweptImage, judgement: Judgement, seconds: float
    ) -> Evaluation:
        """Return the evaluation of a query without images.

        Args:
            model: index of the model.
            image: image of the query.
            judgement: judgement of the image.
            seconds: seconds that the query took.
        """
        # Models of one size share the image: its cost counts for the first.
        cost = image.n_traced if self.job.is_first_of_size[model] else 0
        return Evaluation.from_judgement(
            judgement,
            cost=cost,
            # its samples per pixel; 0 if the image was rendered
            predicted=image.prediction_spp,
            seconds=seconds,
        )

    def _find_wrong_images(self, judgements: Mapping[int, Judgement]) -> set[int]:
        """Return the numbers of the images in which any model is wrong.

        Args:
            judgements: judgements by the number of the query.
        """
        n_models = len(self.job.models)
        # queries are numbered by image, then by model
        return {
            row_number // n_models
            for row_number, judgement in judgements.items()
            if not judgement.right
        }

    def _make_judgements(
        self,
        queries: Sequence[Query],
        images: Mapping[ImageSize, Mapping[int, SweptImage]],
    ) -> dict[int, Judgement]:
        """Return the judgements of all queries by the queries' indices.

        The index of a query is image * models + model. Judgements include metrics for
        the claims about changed images (`_add_change_metrics`).

        Args:
            queries: queries of all models.
            images: images by size, then by the number of the image.
        """
        n_models = len(self.job.models)
        judgement_of_query: dict[int, Judgement] = {}
        for model in range(len(self.problems)):  # one for each model
            model_queries = [
                query for query in queries if query.row_index % n_models == model
            ]
            if model_queries:
                row_numbers = [query.row_index for query in model_queries]
                judgements = self._judge_model(model, model_queries, images)
                judgement_of_query |= zip(row_numbers, judgements, strict=True)
        return judgement_of_query

    def _judge_model(
        self,
        model: int,
        queries: Sequence[Query],
        images: Mapping[ImageSize, Mapping[int, SweptImage]],
    ) -> list[Judgement]:
        """Return the judgements of the queries of one model.

        Args:
            model: index of the model.
            queries: its queries.
            images: images by size, then by the number of the image.
        """
        size = self.job.image_sizes[model]
        problem = self.problems[model]
        n_models = len(self.job.models)
        image_numbers = [query.row_index // n_models for query in queries]
        batch = torch.stack([images[size][number].image for number in image_numbers])
        judgements = problem.judge_images(
            batch, [query.u for query in queries], [query.values for query in queries]
        )
        return self._add_change_metrics(problem, size, queries, batch, judgements)

    def _attach_images(
        self, evaluation: Evaluation, query: Query, image: SweptImage, is_wrong: bool
    ) -> Evaluation:
        """Return an evaluation of the first model with the images to store.

        These are a thumbnail, and layers of ground truth if the job has `aovs`.

        Args:
            evaluation: the evaluation without images.
            query: the query that was evaluated.
            image: image of the query.
            is_wrong: whether the prediction of any model is wrong.
        """
        job = self.job
        # `keep_pictures` is "all" or "wrong" if the query includes the image.
        stores_thumbnail = job.config.keep_pictures == "all" or is_wrong
        if query.includes_image and stores_thumbnail:
            thumbnail = thumbnails.make_thumbnail(image.image)
            evaluation = replace(evaluation, jpeg=thumbnail)
        if job.aovs:
            evaluation = self._attach_layers(evaluation, query)
        return evaluation

    def _attach_layers(self, evaluation: Evaluation, query: Query) -> Evaluation:
        """Return an evaluation of the first model with layers of ground truth."""
        job = self.job
        surfaces = self.renderer_of_size[job.image_sizes[0]].find_surfaces(query.u)
        layers = {
            name: layer.numpy()
            for name, layer in surfaces.make_layers(job.aovs, OBJECT).items()
        }
        notes = surfaces.describe_layers(job.aovs)
        evaluation = replace(evaluation, layers=(layers, notes))
        return evaluation

    def _add_change_metrics(
        self,
        problem: Problem,
        size: ImageSize,
        queries: Sequence[Query],
        images: Tensor,
        judgements: list[Judgement],
    ) -> list[Judgement]:
        """Return judgements with a metric for each claim about changed images.

        A claim is that the prediction must change, or must not change, if the image is
        changed. The name of the metric is the claim and the change, for example
        "must_change black". The metric is 1 if the prediction meets the claim, else 0.
        The ground truth stays what it was before the change.

        Args:
            problem: problem of the model.
            size: (height, width) of its images.
            queries: n queries.
            images: (n, H, W, 3) images of the queries.
            judgements: judgements of the unchanged images.
        """
        judgements = list(judgements)
        configurations = [query.u for query in queries]
        values = [query.values for query in queries]
        for claim, change in self.job.config.claims:
            if change == WITHOUT_OBJECT:
                changed_images = self._render_empty(size, queries)
            else:
                changed_images = _change_images(images, change, problem.model.cameras)
            after = problem.judge_images(changed_images, configurations, values)
            metric = f"{claim} {change}"
            judgements = _add_metric(judgements, after, claim, metric)
        return judgements

    def _render_empty(self, size: ImageSize, queries: Sequence[Query]) -> Tensor:
        """Render the scene without its object, with the noise of each query.

        This takes a renderer of its own: a renderer whose object was hidden once gives
        images that differ in their last bits from those before.
        """
        if size not in self._empty_renderers:
            self._empty_renderers[size] = self._make_renderer(size)
        renderer = self._empty_renderers[size]
        renderer.scene.input_assembler.is_object_hidden = True
        with torch.no_grad():
            rendered = [renderer(query.u, query.seed, query.spp) for query in queries]
        return torch.stack(list(map(round_to_8_bit, rendered)))

    def _make_renderer(self, size: ImageSize) -> Renderer:
        """Make a renderer of the scene's images at a size."""
        config = self.job.config
        description = fit_camera(self.job.scenes[self.number].scene.description, size)
        return make_renderer(
            description,
            self.configurations_by_size[size].space,
            size,
            config.denoise,
            config.seed,
            sampler=config.pixel_sampler,
        )

    def _make_images(
        self, size: ImageSize, queries: Sequence[Query]
    ) -> dict[int, SweptImage]:
        """Return the images of one size, rounded to 8 bits, by number in the sweep.

        Args:
            size: the size.
            queries: queries of all models, which are numbered by image, then by model.
        """
        images_before = self.number * self.configurations_by_size[size].n_images
        query_of_image = self._find_query_of_image(size, queries, images_before)
        with torch.no_grad():
            images = self.predictor_of_size[size].make_images(query_of_image)
        return {
            images_before + number: replace(image, image=round_to_8_bit(image.image))
            for number, image in images.items()
        }

    def _find_query_of_image(
        self, size: ImageSize, queries: Sequence[Query], images_before: int
    ) -> dict[int, Query]:
        """Return a query of each image of a size, by the number of the image.

        The predictor numbers the images of this scene from 0. Queries of several models
        about an image differ in nothing that concerns the image.

        Args:
            size: the size.
            queries: queries of all models, which are numbered by image, then by model.
            images_before: number of images in the scenes before this one.
        """
        n_models = len(self.job.models)
        return {
            query.row_index // n_models - images_before: query
            for query in queries
            if self.job.image_sizes[query.row_index % n_models] == size
        }

    def render_image(self, query: Query) -> Tensor:
        """Return the image (H, W, 3) of a query to the first model."""
        (image,) = self._make_images(self.job.image_sizes[0], [query]).values()
        return image.image


class SceneLoader:
    """Loads the scenes of a sweep in this process; the last one is cached."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.loaded_scene: SweptScene | None = None

    def load_scene(self, number: int) -> SweptScene:
        """Load the scene with this number, and release the one before."""
        if self.loaded_scene is None or self.loaded_scene.number != number:
            self.loaded_scene = None
            self.loaded_scene = SweptScene(self.job, number)
        return self.loaded_scene

    def load_by_name(self, name: str) -> SweptScene:
        """Load a scene by its number as text.

        That is the name of its problem: see
        `advsearch.engine.journal.make_worker_call`.
        """
        return self.load_scene(int(name))

    def make_queries(self, number: int) -> tuple[SweptScene, list[Query]]:
        """Load the scene of an image; return it and the queries of all models."""
        items = self.job.make_queries(range(number, number + 1))
        scene_name = str(items[0][0])
        return self.load_by_name(scene_name), [query for _, _, query in items]

    def render_image(self, number: int) -> Tensor:
        """Render an image (H, W, 3) as the first model gets it."""
        scene, queries = self.make_queries(number)
        return scene.render_image(queries[0])

    def render_thumbnail(self, number: int) -> bytes:
        """Render an image as the first model gets it, as a small JPEG."""
        return thumbnails.make_thumbnail(self.render_image(number))

    def find_features(self) -> Features:
        """Find the layer of the first model whose features decide its prediction.

        Raises:
            InputError: the task is not classification.
        """
        # `varies`: the ground truth differs between configurations. That of a
        # classifier, the class of the object, does not.
        is_classification = not self.job.tasks[0].varies
        if not is_classification:
            raise InputError(
                f"task {self.job.config.task_name}: features are read of classifiers"
            )
        return features_of(self.job.models[0])


def _change_images(images: Tensor, change: str, n_cameras: int) -> Tensor:
    """Apply a change, such as "black", to each of several images (n, H, W, 3).

    Args:
        images: the images, each of all cameras side by side.
        change: name of the change.
        n_cameras: number of cameras; the image of each is changed by itself.
    """
    return torch.stack([change_image(image, change, n_cameras) for image in images])


def _add_metric(
    before: Sequence[Judgement], after: Sequence[Judgement], claim: str, metric: str
) -> list[Judgement]:
    """Return judgements with the metric of a claim about changed images.

    Args:
        before: (n,) judgements of the unchanged images.
        after: (n,) judgements of the changed images.
        claim: the claim, such as "must_change".
        metric: name of the metric, which is 1 if a prediction meets the claim, else 0.
    """
    judgements = list[Judgement]()
    for judgement, changed in zip(before, after, strict=True):
        is_met = meets_claim(claim, judgement.prediction, changed.prediction)
        metrics = {**(judgement.metrics or {}), metric: float(is_met)}
        judgements.append(replace(judgement, metrics=metrics))
    return judgements


def verify_worst(
    problem: Problem,
    config: SweepConfig,
    u: Tensor,
    run: RunDirectory | None,
    stages: Stages,
) -> WorstVerified | None:
    """Render the worst configuration again, and count wrong predictions.

    The samples per pixel are chosen first, from an ascending list of counts (the
    ladder). The chosen count is the smallest from which on more samples no longer
    change the sign of the margin: it has converged. If the settings state the count,
    the ladder has only this one, which always counts as converged. Renders that the run
    has stored are not made again.

    Args:
        problem: problem of its scene and model.
        config: settings of the sweep.
        u: (d,) the configuration.
        run: None stores nothing.
        stages: stages of the sweep.

    Returns:
        The rate of wrong predictions; None without trials.
    """
    if config.trials == 0:
        return None
    ladder = choose_ladder(config.verify_spp, config.pixel_sampler)
    # The rows of a sweep state no success, so the journal stores none either; trials in
    # memory have one.
    journal = Journal(run, ParallelEvaluator(problem))
    verifier = Verifier(journal, ladder, stages, has_success=False)
    verifier.choose_spp({"worst": u})  # sets `spp` and `sample_count` of its state
    title = "checking the worst configuration with fresh renders"
    verifier.begin_stage(title, config.trials)
    verified_rate = _try_worst(verifier, config, u)
    return WorstVerified(
        **vars(verified_rate),
        converged=_has_converged(verifier),
        renders=verifier.run_state.verification_renders,
    )


def _try_worst(verifier: Verifier, config: SweepConfig, u: Tensor) -> VerifiedRate:
    """Make the trials of a configuration, and return its rate of wrong predictions.

    Args:
        verifier: verifier that has chosen the samples per pixel.
        config: settings of the sweep, with the number and the seed of the trials.
        u: (d,) the configuration.
    """
    spp = verifier.run_state.spp
    trials = run_trials(
        verifier.evaluate_all, u, spp=spp, seed=config.seed, trials=config.trials
    )
    # For an attack, a wrong prediction is a success.
    wrong_trials = [trial for trial in trials if trial.success]
    counts = TrialCounts(len(wrong_trials), len(trials), spp)
    return make_rate(counts, trials, wrong_trials)


def _has_converged(verifier: Verifier) -> bool:
    """Return whether more samples would not change the sign of the margin.

    A sample count that the settings state always counts as converged.
    """
    is_spp_set = len(verifier.spp_ladder) == 1
    sample_count = verifier.run_state.sample_count
    return is_spp_set or (sample_count is not None and sample_count.converged)
