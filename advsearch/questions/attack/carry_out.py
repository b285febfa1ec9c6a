"""Load the parts of an attack from its settings, and make its problem from the parts.

Experiments that render and evaluate single configurations, without a search, begin with
`problem_from_config` or `make_problem_on`. The attack itself is in
`advsearch.questions.attack.run`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Policy, make_policy
from advsearch.attacks.objectives import (
    OBJECTIVE_KINDS,
    Objective,
    check_objective,
    list_requested_inputs,
)
from advsearch.attacks.policies import POLICIES
from advsearch.cluster import BatchFunction, Workers, WorkerTask
from advsearch.cluster.workers import open_workers
from advsearch.config import SceneConfig, has_model_url, make_single_value_error
from advsearch.controls import BACKDROP, Space, make_space
from advsearch.controls.base import Control, describe_adjusted_defaults
from advsearch.controls.ranges import has_distribution
from advsearch.engine import judging, loading, naming
from advsearch.engine.journal import make_worker_call
from advsearch.engine.judging import (
    AnyObjective,
    DescribeConfiguration,
    Metrics,
    RenderSurfaces,
)
from advsearch.engine.loading import Controls, Scene, fit_camera
from advsearch.engine.naming import AnyModel, load_models, to_model_list
from advsearch.engine.prediction import CleanMatrix
from advsearch.engine.problem import Problem
from advsearch.engine.rendering import make_facts
from advsearch.engine.shared_paths import find_shared_paths
from advsearch.engine.transport import find_matrix_refusal
from advsearch.errors import InputError
from advsearch.files import JsonObject
from advsearch.models import Model
from advsearch.options import Value, convert_to_setting
from advsearch.progress import Progress
from advsearch.questions.attack.ambient import make_problem_finder
from advsearch.questions.attack.settings import (
    SIZE_OVER_NUMBERS,
    SIZE_OVER_PREDICTED,
    SIZE_OVER_RENDERED,
    SIZE_OVER_SINGLE_PARAMETER,
    STEPS,
    AttackConfig,
)
from advsearch.runs.directory import CONFIG, read_python_only
from advsearch.scene.description import SceneDescription
from advsearch.scene.formation import (
    ALL_OMISSIONS,
    NO_OMISSIONS,
    parse_aovs,
    round_sample_count,
)
from advsearch.scene.photograph_files import (
    is_photograph_folder,
    read_photograph_folder,
)
from advsearch.scene.renderer import Renderer
from advsearch.scene.things import ALL_THINGS
from advsearch.settings import FILES
from advsearch.tasks import AnyTask, Facts, Task, make_task
from advsearch.tasks.together import EnsembleTask, join_models, make_each_thing_task

# the first stage of the progress
LOADING = "loading the scene and the model"
ROLES_IN_SEARCH = frozenset({"objective", "policy", "metric"})
"""Roles of parts that decide how a scene is found, but not whether it is a success."""


def attack_worker(settings: JsonObject) -> BatchFunction:
    """Return the function by which a worker evaluates queries of an attack.

    Args:
        settings: settings of the attack.
    """
    problem = make_problem(load_parts(AttackConfig(**settings)))
    return make_worker_call(make_problem_finder(problem))


@dataclass
class AttackParts:
    """Everything that an attack needs, loaded.

    Attributes:
        config: the settings.
        scene: the clean scene.
        model_and_warnings: the model, and warnings of loading it.
        task: the task, not yet bound to the model.
        controls: the searched controls.
        random_controls: controls that vary by chance.
        objective: name of an objective, or the caller's function.
        policy: policy that searches, which may be of the caller's own class.
        is_stored: whether the run is stored.
        metrics: functions of an image, by the name of their column in the rows.
        clean_matrix: the matrix of light transport of the clean scene. Attacks on the
            same clean scene may share it.
    """

    config: AttackConfig
    scene: Scene
    model_and_warnings: tuple[Model, list[str]]
    task: Task
    controls: tuple[Any, ...]
    random_controls: tuple[Any, ...]
    objective: str | Callable[..., Tensor]
    policy: Policy[Any]
    is_stored: bool
    metrics: Metrics = field(default_factory=dict)
    clean_matrix: CleanMatrix = field(default_factory=CleanMatrix)

    @property
    def all_controls(self) -> tuple[Any, ...]:
        """The searched controls, then those that vary by chance."""
        return (*self.controls, *self.random_controls)

    @property
    def resolution(self) -> tuple[int, int]:
        """Size of the images: the setting, or what the model takes."""
        model, _ = self.model_and_warnings
        return self.config.resolution or model.input_size


def load_parts(
    config: AttackConfig, scene: Scene | None = None, model: Model | None = None
) -> AttackParts:
    """Load everything that a configuration names; nothing is rendered.

    Args:
        config: the settings.
        scene: scene to use instead of the one that the settings name.
        model: model to use instead of the one that the settings name. If both `scene`
            and `model` are passed, the attack is a step of another experiment. Then it
            is not stored, and has no metrics, which are columns of stored rows.
    """
    if scene is None and len(config.objects) > 1:
        raise make_single_value_error("object", config.objects)
    searched, random_controls = make_attack_controls(
        config, config.controls, config.over
    )
    task, objective = make_task_and_objective(config, config.task, config.objective)
    policy = make_policy(config.policy_name, **config.policy_options)
    is_step_of_experiment = scene is not None and model is not None
    is_stored = not is_step_of_experiment
    return AttackParts(
        config=config,
        scene=scene or naming.load_configured_scene(config),
        model_and_warnings=_load_missing_model(model, config, task),
        task=task,
        controls=searched,
        random_controls=random_controls,
        objective=objective,
        policy=policy,
        is_stored=is_stored,
        metrics=judging.load_metrics(config.metrics) if is_stored else {},
    )


def _load_missing_model(
    model: Model | None, config: AttackConfig, task: Task
) -> tuple[Model, list[str]]:
    """Return a model, or load the one of the settings for None, with its warnings."""
    if model is not None:
        return model, []
    return load_ensemble(config.model, config, task)


def load_parts_of_run(run: Path) -> AttackParts:
    """Load what is needed to evaluate the result of an attack's run.

    The objective, the policy and the metrics may have existed only in the Python session
    of the run. Then defaults replace them, because only the search used them.

    Args:
        run: the run directory.

    Raises:
        InputError: the scene, the model, the task or a control exists only in the
            Python session of the run.
    """
    missing = [
        part.text for part in read_python_only(run) if part.role not in ROLES_IN_SEARCH
    ]
    if missing:
        raise InputError(
            f"{run}: {', '.join(missing)}: only the Python session that made the run "
            "has this, and its result cannot be evaluated without it"
        )
    config = AttackConfig.from_yaml(run / CONFIG)
    return load_parts(with_evaluation_only(config))


def move_to_photographs(
    parts: AttackParts, folder: str
) -> tuple[dict[str, AttackParts], dict[str, AttackParts]]:
    """Return the parts of an attack with its scene in each photograph of a folder.

    Each photograph has a camera file next to it. The camera, the pose and the ground
    that the file states replace the settings of the attack. A photograph fixes some
    things, such as the sky. Controls that vary these by chance are left out.

    Args:
        parts: parts of the attack.
        folder: folder of photographs.

    Returns:
        The parts by the name of the photograph's file: in photographs that the attack
        did not use, and in those that it used.

    Raises:
        FileFormatError: the folder cannot be used.
        InputError: the scene cannot be rendered into it.
    """
    config = _set_photograph_folder(parts.config, folder)
    scene = naming.load_configured_scene(config)
    photographs = scene.description.photographs
    if photographs is None:
        raise InputError(
            f"{parts.config.object}: only the Python session that made the run has the "
            "scene"
        )
    used_photographs = list_used_photographs(parts.scene.description)
    # by the name of the photograph's file
    parts_in_unused: dict[str, AttackParts] = {}
    parts_in_used: dict[str, AttackParts] = {}
    for name, description in photographs.scenes.items():
        is_used = bool(used_photographs & list_used_photographs(description))
        parts_by_name = parts_in_used if is_used else parts_in_unused
        scene_in_photograph = replace(scene, description=description)
        parts_by_name[name] = _replace_scene(parts, config, scene_in_photograph)
    return parts_in_unused, parts_in_used


def _replace_scene(
    parts: AttackParts, config: AttackConfig, scene: Scene
) -> AttackParts:
    """Return the parts of an attack with its scene in a photograph.

    Args:
        parts: parts of the attack.
        config: settings with the photograph.
        scene: the scene in the photograph.
    """
    # The control of the kind "backdrop" chooses a photograph by chance. Here each scene
    # is rendered into a single one.
    random_controls = tuple(
        control
        for control in parts.random_controls
        if not control.photograph_refusal and control.kind != BACKDROP
    )
    return replace(
        parts,
        config=config,
        scene=scene,
        random_controls=random_controls,
        clean_matrix=CleanMatrix(),  # not shared: each has another clean scene
    )


def _set_photograph_folder(config: AttackConfig, folder: str) -> AttackConfig:
    """Return settings with which the scene is rendered into the photographs of a folder.

    Settings that the camera files of the photographs replace are left out.

    Args:
        config: settings of the attack.
        folder: folder of photographs with their camera files.

    Raises:
        FileFormatError: the folder cannot be used.
        InputError: the folder has no photographs with camera files.
    """
    _check_photograph_folder(folder)
    # all photographs of a folder have the same kinds of camera files
    view = next(iter(read_photograph_folder(folder).values()))
    other_settings = _drop_settings(config.set_, view.replaced_settings)
    # A camera file may state the occluder and the lens of its photograph.
    changes = {"backdrop": folder, "occluder": None, "set_": other_settings}
    if view.camera is not None:
        changes["camera"] = None
    return config.model_copy(update=changes)


def _check_photograph_folder(folder: str) -> None:
    """Raise an error if a folder has no photographs with their camera files."""
    if not is_photograph_folder(folder):
        raise InputError(
            f"backdrop: expected a folder of photographs with their camera files, got "
            f"{folder}"
        )


def _drop_settings(
    settings: Mapping[str, Any], prefixes: tuple[str, ...]
) -> dict[str, Any]:
    """Return the settings whose names begin with no prefix, such as "camera."."""
    return {
        name: value for name, value in settings.items() if not name.startswith(prefixes)
    }


def list_used_photographs(description: SceneDescription) -> set[str]:
    """Return the digests of the photographs that a scene is rendered into."""
    scenes = [description]
    if description.photographs is not None:
        scenes += description.photographs.scenes.values()
    return {
        scene.backdrop_photograph.digest
        for scene in scenes
        if scene.backdrop_photograph is not None
    }


def make_attack_controls(
    config: AttackConfig, searched: Controls, random: Controls
) -> tuple[tuple[Control, ...], tuple[Control, ...]]:
    """Return the searched controls and those that vary by chance, with their settings.

    Args:
        config: settings of the run. Their budget (`epsilon` and `norm`) is given to the
            searched controls only.
        searched: names, settings or instances of the searched controls.
        random: names, settings or instances of the controls that vary by chance.

    Raises:
        InputError: a searched control has a distribution.
    """
    naming.check_run_settings(config)
    controls = naming.make_configured_controls(config, searched)
    for control in controls:
        _check_no_distribution(control)
    return controls, naming.make_configured_controls(config, random, are_searched=False)


def _check_no_distribution(control: Control) -> None:
    """Raise an error if a searched control has a distribution instead of a range."""
    for name, spec in getattr(control, "specs", {}).items():
        if has_distribution(spec):
            raise InputError(
                f"`controls` {control.name}.{name}: expected values to search, got "
                "a probability distribution; give a range, or put the control into "
                "`over`, where it varies by chance"
            )


def make_task_and_objective(
    config: AttackConfig, task: AnyTask, objective: AnyObjective | None
) -> tuple[Task, AnyObjective]:
    """Make a task and choose its objective.

    Args:
        config: the settings.
        task: a name, settings or an instance.
        objective: a name or a function; None for the objective of the task.

    Returns:
        The task, which is not yet bound to a model, and the objective.

    Raises:
        InputError: the objective does not fit the task or the goal.
    """
    unbound_task = make_task(task)
    if objective is None:
        objective = unbound_task.objective
    check_objective(
        objective,
        unbound_task.name,
        targeted=config.target is not None,
        minimise=config.minimise,
    )
    return unbound_task, objective


def load_ensemble(
    model: AnyModel | Sequence[AnyModel], config: AttackConfig, task: Task
) -> tuple[Model, list[str]]:
    """Load a model, or several models as an ensemble.

    Args:
        model: a name, a file or a module; or a sequence of these.
        config: the settings.
        task: task of the models.

    Returns:
        The model or the ensemble, and warnings of loading.
    """
    models, warnings = load_models(to_model_list(model), task, config)
    if len(models) == 1:
        return models[0], warnings
    return join_models(models, config.resolution), warnings


def check_from_config(config: AttackConfig) -> None:
    """Check that an attack can be made; nothing is rendered.

    Raises:
        InputError: the settings name something that does not exist, contradict each
            other, or give a result that cannot be evaluated.
    """
    parts = load_parts(config)
    # Both calls raise an error if something does not fit; their results are not used.
    _bind_task(parts, is_calibrated=False)
    make_space(
        parts.all_controls, fit_camera(parts.scene.description, parts.resolution)
    )


def problem_from_config(
    config: SceneConfig, *, denoise: str | None = None
) -> tuple[Problem, list[str]]:
    """Load the scene and the model of a configuration, and make their problem.

    Args:
        config: settings of an attack, or of another experiment with a scene and a
            model. Settings of an attack that the other experiment lacks have their
            defaults.
        denoise: denoiser to use instead of the setting.

    Returns:
        The problem, and warnings of loading it.
    """
    attack_config = AttackConfig.from_config(config, denoise=denoise or config.denoise)
    return make_problem_with_warnings(load_parts(attack_config))


def make_problem_with_warnings(
    parts: AttackParts, **changes: object
) -> tuple[Problem, list[str]]:
    """Return the problem of an attack, and warnings of loading it.

    Args:
        parts: parts of the attack.
        **changes: settings to replace. If `model` is among them, the named model is
            loaded instead of that of `parts`.
    """
    config = parts.config.model_copy(update=changes)
    model, warnings = parts.model_and_warnings
    warnings = [*warnings]  # a copy, since `make_problem` appends to the list
    if "model" in changes:
        model, warnings = load_ensemble(config.model, config, parts.task)
    changed_parts = replace(parts, config=config, model_and_warnings=(model, warnings))
    problem = make_problem(changed_parts)
    adjusted = describe_adjusted_defaults(problem.space.adjusted_defaults)
    return problem, [*warnings, *adjusted]


def make_problem_on(
    config: AttackConfig, scene: Scene, model: Model, *, differentiated: bool = True
) -> Problem:
    """Return the problem of a configuration on a loaded scene and a loaded model.

    Args:
        config: the settings; the scene and the model that they name are not used.
        scene: scene to use instead.
        model: model to use instead.
        differentiated: whether derivatives are needed.
    """
    return make_problem(load_parts(config, scene, model), differentiated=differentiated)


def make_problem(parts: AttackParts, *, differentiated: bool = True) -> Problem:
    """Make the problem of an attack: what renders and evaluates configurations.

    Warnings are added to those of loading the model.

    Args:
        parts: the parts of the attack.
        differentiated: whether derivatives are needed.

    Raises:
        InputError: the parts do not fit together.
    """
    config = parts.config
    model, _ = parts.model_and_warnings
    task, make_scene_facts = _bind_task(parts)
    description = fit_camera(parts.scene.description, parts.resolution)
    space = make_space(parts.all_controls, description)
    renderer = _make_attack_renderer(parts, description, space, differentiated)
    objective = _make_attack_objective(parts, task, renderer)
    _check_printable(parts, config, description)
    problem = Problem(
        renderer=renderer,
        space=space,
        model=model,
        task=task,
        make_facts=make_scene_facts,
        objective=objective,
        search_spp=round_sample_count(config.pixel_sampler, config.search_spp),
        seed=config.seed,
        n_searched=len(parts.controls),
        aovs=parse_aovs(config.aov),
        metrics=parts.metrics,
    )
    _prepare_search(parts, problem)
    return problem


def _make_attack_renderer(
    parts: AttackParts,
    description: SceneDescription,
    space: Space,
    differentiated: bool,
) -> Renderer:
    """Make the renderer of an attack.

    Args:
        parts: the parts of the attack.
        description: the scene, with its camera fitted to the size of the images.
        space: space of all controls of the attack.
        differentiated: whether derivatives are needed.
    """
    config = parts.config
    return loading.make_renderer(
        description,
        space,
        parts.resolution,
        denoise=config.denoise,
        seed=config.seed,
        estimators=config.estimators,
        leave_out=ALL_OMISSIONS if config.specialise else NO_OMISSIONS,
        sampler=config.pixel_sampler,
        differentiated=differentiated,
    )


def _make_attack_objective(
    parts: AttackParts, task: Task, renderer: Renderer
) -> Objective:
    """Make the objective of an attack, and add a remark about it to the warnings.

    Args:
        parts: the parts of the attack. Their list of warnings gets the remark.
        task: the task, bound to the model.
        renderer: renders the clean scene if the objective compares with it.
    """
    config = parts.config
    model, warnings = parts.model_and_warnings
    features_seed = seeds.derive_seed(config.seed, "clean features")
    objective, note = judging.make_objective(
        parts.objective, task, model, renderer, features_seed, config.ensemble
    )
    if note:
        warnings.append(note)
    return objective


def _prepare_search(parts: AttackParts, problem: Problem) -> None:
    """Set what the search of an attack needs: shared light paths and its size.

    Raises:
        InputError: the objective requests an input that the problem lacks.
    """
    if parts.config.specialise:
        problem.shared_paths = find_shared_paths(problem)
    _check_objective_inputs(parts, problem)
    problem.steps, problem.conditions_per_evaluation = choose_search_size(
        parts.config, problem
    )


def _check_printable(
    parts: AttackParts, config: AttackConfig, description: Any
) -> None:
    """Raise an error if colors are to be printed and no searched control prints any.

    Args:
        parts: parts of the attack.
        config: the settings; without `printable` nothing is checked.
        description: the scene.
    """
    if not config.printable:
        return
    # `make_space` requires a control that chooses among the photographs of a folder.
    # That control varies by chance, so the searched controls lack it.
    scene = replace(description, photographs=None)
    searched_space = make_space(parts.controls, scene)
    # The result is not used: the call raises an error if nothing can be printed.
    judging.measure_print_terms(searched_space, searched_space.start)


def _check_objective_inputs(parts: AttackParts, problem: Problem) -> None:
    """Raise an error if the objective requests an input that the problem lacks.

    A function of the user requests inputs by the names of its parameters, such as
    `texture`.
    """
    for name in list_requested_inputs(parts.objective):
        start = problem.make_full_configuration(problem.domain.start)
        get_input = problem.make_objective_inputs(start)
        # The result is not used: the call raises an error if there is no such input.
        get_input(name)


def _bind_task(
    parts: AttackParts, *, is_calibrated: bool = True
) -> tuple[Task, Callable[[DescribeConfiguration, RenderSurfaces], Facts]]:
    """Bind the task of an attack to its model, check it, and calibrate it.

    Args:
        parts: the parts of the attack. Their list of warnings gets the remarks of the
            task.
        is_calibrated: whether the task is calibrated, for which a clean image may be
            rendered; else it is only checked.

    Returns:
        The task, and the function that makes its ground truth (facts) of a
        configuration.
    """
    config = parts.config
    task = _bind_to_model(parts)
    scene = parts.scene.description
    make_scene_facts = partial(
        make_facts, scene, config.object, config.label, judge=config.judge
    )
    task = _prepare_bound_task(
        parts, task, make_scene_facts, is_calibrated=is_calibrated
    )
    if config.judge == ALL_THINGS:
        # every thing in the scene is evaluated, not only the object
        task = make_each_thing_task(task)
    return task, make_scene_facts


def _bind_to_model(parts: AttackParts) -> Task:
    """Return the task of an attack for its model, its objective and its target."""
    config = parts.config
    model, _ = parts.model_and_warnings
    task = parts.task
    if isinstance(parts.objective, str):
        task = task.with_objective(parts.objective)
    task = judging.make_ensemble_task(task, model)
    return task.on(model, target=config.target, minimise=config.minimise)


def _prepare_bound_task(
    parts: AttackParts,
    task: Task,
    make_scene_facts: Callable[[DescribeConfiguration], Facts],
    *,
    is_calibrated: bool,
) -> Task:
    """Check and calibrate a task that is bound to its model, or to those of an ensemble.

    See `_bind_task` for the other arguments.

    Args:
        task: the task.
        make_scene_facts: makes the ground truth of a configuration.
    """
    model, _ = parts.model_and_warnings
    # the ground truth of the scene as it is, with no value changed
    clean_facts = make_scene_facts(_describe_no_changes)
    if isinstance(task, EnsembleTask):
        return _prepare_members(parts, task, clean_facts, is_calibrated=is_calibrated)
    return _prepare_task(parts, task, model, clean_facts, is_calibrated=is_calibrated)


def _describe_no_changes() -> dict[str, Value]:
    """Return an empty description, with which all values are those of the scene."""
    return {}


def _prepare_members(
    parts: AttackParts, task: EnsembleTask, clean_facts: Facts, *, is_calibrated: bool
) -> EnsembleTask:
    """Check and calibrate the task of each model of an ensemble.

    See `_prepare_task` for the arguments.
    """
    members = []
    for member, model in zip(task.tasks, task.models, strict=True):
        facts = task.select_facts(member, clean_facts)
        members.append(
            _prepare_task(parts, member, model, facts, is_calibrated=is_calibrated)
        )
    return replace(task, tasks=tuple(members))


def choose_search_size(config: AttackConfig, problem: Problem) -> tuple[int, int]:
    """Return the steps of a search, and how many conditions each step evaluates.

    Conditions are what varies by chance (setting `over`), such as the camera. A number
    that the settings do not state has a default. It depends on how many parameters vary
    by chance, and on whether matrices of light transport can predict the images of the
    search: rendered images cost more.

    Args:
        config: the settings.
        problem: problem of the attack.
    """
    if problem.conditions is None:
        return config.steps or STEPS, 1
    default_steps, default_conditions = _choose_default_size(
        config, problem, problem.conditions.dim
    )
    return config.steps or default_steps, config.draws or default_conditions


def _choose_default_size(
    config: AttackConfig, problem: Problem, n_random_numbers: int
) -> tuple[int, int]:
    """Return the default of `choose_search_size` if conditions vary by chance.

    Args:
        config: the settings.
        problem: problem of the attack.
        n_random_numbers: how many numbers vary by chance.
    """
    varies_single_number = n_random_numbers == 1
    size_if_predicted = (
        SIZE_OVER_SINGLE_PARAMETER if varies_single_number else SIZE_OVER_PREDICTED
    )
    # Preparing a matrix costs more than it saves if there are few steps. So whether
    # images are predicted depends on the number of steps.
    steps_if_predicted, _ = size_if_predicted
    matrix_refusal = find_matrix_refusal(
        problem, config.steps or steps_if_predicted, config.specialise
    )
    if matrix_refusal is None:
        return size_if_predicted
    # The norm "box" stands for parameters that have a range and no epsilon, such as a
    # pose; they are few numbers.
    has_only_ranges = all(block.norm == "box" for block in problem.domain.blocks)
    return SIZE_OVER_NUMBERS if has_only_ranges else SIZE_OVER_RENDERED


def is_describable_by_setting(
    entry: Task | Policy[Any], make: Callable[[Any], object]
) -> bool:
    """Return whether a setting can describe a task or a policy.

    It can if the setting makes an equal task or policy again. That fails, for example,
    for an instance of a user's own class.

    Args:
        entry: the task or policy.
        make: makes a task or policy from a setting.
    """
    try:
        return bool(make(convert_to_setting(entry)) == entry)
    except InputError:
        return False


def with_evaluation_only(config: AttackConfig) -> AttackConfig:
    """Return the settings with which the adversarial scene of a run is evaluated.

    Metrics are dropped. An objective or a policy that is not bundled may exist only in
    the session of the run, and the default replaces it. Whether the scene is a success
    depends on none of these.
    """
    changes: dict[str, object] = {"metrics": {}}
    if config.objective is not None and config.objective not in OBJECTIVE_KINDS:
        changes["objective"] = None
    if config.policy_name not in POLICIES:
        changes["policy"] = AttackConfig.model_fields["policy"].default
    return config.model_copy(update=changes)


def _prepare_task(
    parts: AttackParts,
    task: Task,
    model: Model,
    clean_facts: Facts,
    *,
    is_calibrated: bool,
) -> Task:
    """Check that a model can be right about the scene, and calibrate its task.

    Args:
        parts: the parts of the attack. Their list of warnings gets the remarks of the
            task.
        task: task of the model.
        model: the model, or one member of an ensemble.
        clean_facts: ground truth of the clean scene.
        is_calibrated: whether the task is calibrated, for which a clean image may be
            rendered; else it is only checked.

    Raises:
        InputError: no prediction of the model would be right.
    """
    config = parts.config
    judging.check_truth(task, model, parts.scene, clean_facts, config.image_settings)
    if is_calibrated:
        task = _calibrate_on_scene(parts, task, model)
    _, warnings = parts.model_and_warnings  # the list itself, which is changed
    warnings += [remark for remark in task.output_remarks if remark not in warnings]
    return task


def _calibrate_on_scene(parts: AttackParts, task: Task, model: Model) -> Task:
    """Return the task of a model, calibrated on the scene of an attack."""
    config = parts.config
    return judging.calibrate_task(
        task,
        model,
        scenes=[parts.scene],
        label=config.label,
        judge=config.judge,
        image_settings=config.image_settings,
    )


def open_executor(
    config: SceneConfig, function: str, progress: Progress
) -> AbstractContextManager[Workers | None]:
    """Open the workers that run a function of a configuration.

    The context has None if no workers are requested: then this process does the work.

    Args:
        config: the settings.
        function: path "module:function" of the function that makes a worker's work
            from the settings.
        progress: reports what the workers do.

    Raises:
        InputError: workers are requested for a model behind an address. Only a single
            process may call it, because it counts the calls.
    """
    work = _make_worker_task(config, function)
    # not every experiment has these two settings
    workers = getattr(config, "workers", None)
    cluster = getattr(config, "cluster", None)
    if (workers or cluster) and has_model_url(config.model):
        setting = "workers" if workers else "cluster"
        raise InputError(
            f"{setting}: a model behind an address is called by a single process, which "
            "counts the calls; leave it out"
        )
    return open_workers(
        work, workers=workers, cluster=cluster, report_message=progress.message
    )


def _make_worker_task(config: SceneConfig, function: str) -> WorkerTask:
    """Return how workers make their work from the settings of a run.

    Args:
        config: the settings.
        function: path "module:function" of the function that makes a worker's work.
    """
    # A worker gets the settings of the run, but must not start workers itself.
    in_process = {"workers": None, "cluster": None}
    worker_settings = config.make_repeatable().model_copy(update=in_process).to_json()
    return WorkerTask(
        function,
        worker_settings,
        path_setting_names=FILES,
        threads=config.n_used_threads or 1,
    )
