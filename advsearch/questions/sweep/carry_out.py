"""`sweep`: the average case of a scene over a grid, random draws, or both."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch

from advsearch.api.keywords import (
    SceneKeywords,
    with_settings_signature,
)
from advsearch.calls import drop_unset
from advsearch.cluster import BatchFunction
from advsearch.controls import BACKDROP, Control
from advsearch.controls.camera import CameraControl, adapt_length_unit
from advsearch.engine import judging, loading, naming
from advsearch.engine.journal import check_digests, make_worker_call
from advsearch.engine.judging import Metric, load_metrics
from advsearch.engine.loading import Controls, Scene, load_scene
from advsearch.engine.naming import (
    AnyModel,
    get_model_name,
    load_models,
    make_configured_controls,
)
from advsearch.errors import InputError
from advsearch.files import JsonObject
from advsearch.models import Model
from advsearch.options import convert_to_setting
from advsearch.progress import NullProgress, Progress, ProgressOption, as_progress
from advsearch.questions.attack.carry_out import (
    LOADING,
    is_describable_by_setting,
    open_executor,
)
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.summary import load_attack_summary
from advsearch.questions.sweep.axes import Axis, add_grid_axes, parse_axes
from advsearch.questions.sweep.drives import add_frame_axis
from advsearch.questions.sweep.job import (
    Job,
    NamedScene,
    SceneLoader,
    check_job,
    check_scenes,
)
from advsearch.questions.sweep.loop import Sweep
from advsearch.questions.sweep.result import SweepResult
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.tracks import Step
from advsearch.runs.directory import (
    CONFIG,
    RunDirectory,
    check_free,
    create_before_work,
    find_run,
    is_run,
    locate_run,
)
from advsearch.runs.listing import is_finished
from advsearch.runs.summary import read_configuration
from advsearch.runs.twins import read_twins
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.description import ENVIRONMENT
from advsearch.scene.formation import parse_aovs
from advsearch.scene.things import ALL_THINGS
from advsearch.settings import PythonOnly, split_names
from advsearch.tasks import AnyTask, FunctionTask, Task, get_task_function, make_task
from advsearch.tasks.together import make_each_thing_task

if TYPE_CHECKING:
    from typing_extensions import Unpack

SCENE_SETTINGS = (
    "object",
    "environment",
    "up",
    "facing",
    "size",
    "unit",
    "camera",
    "things",
    "backdrop",
    "occluder",
    "set_",
    "exposure",
)
"""Settings that describe a scene. If the caller passed a loaded scene, it has them."""
WORKER = "advsearch.questions.sweep.carry_out:sweep_worker"
# name of the scene without the adversarial configuration of a run
CLEAN = "clean"
AnyScene = Scene | str | Path


class SweepKeywords(SceneKeywords, total=False):
    """Settings that `sweep` takes as keywords, besides its own arguments."""

    spp: int | None
    sampler: Literal["sobol", "random"]
    batch: int
    fps: float
    keep_pictures: Literal["all", "wrong", "none"]
    must_change: str | Path | None
    must_not_change: str | Path | None
    surface: bool
    trials: int


@with_settings_signature(SweepConfig)
def sweep(
    scene: AnyScene | Sequence[AnyScene] | None = None,
    model: AnyModel | Sequence[AnyModel] | None = None,
    grid: Mapping[str, object] | None = None,
    *,
    task: AnyTask = "classification",
    samples: int | None = None,
    controls: Controls = (),
    adversarial_of: str | Path | AttackResult | None = None,
    metrics: Mapping[str, str | Metric] | None = None,
    tracker: Callable[[], Step] | None = None,
    run: str | Path | None = None,
    progress: ProgressOption = None,
    **settings: Unpack[SweepKeywords],
) -> SweepResult:
    """Measure how often the model is right over a grid, random draws, or both.

    Every configuration is rendered and evaluated. If `run` names a stopped sweep with
    the same settings, that sweep continues. All other arguments are the settings of
    `advsearch sweep`.

    Args:
        scene: scene from `load_scene`, or what that takes; or several. None takes that
            of `adversarial_of`.
        model: model from `load_model`, or what that takes; or several, which are run on
            the same images. None takes that of `adversarial_of`; without an attack it
            takes the reference model.
        task: what evaluates the models' outputs: a name, a mapping with a `name` and
            options, an instance, or a function (output, truth) that returns how wrong
            the output is, above 0 if it is wrong (docs/tasks.md).
        grid: parameter to its values: a list, a range, or "FIRST:LAST:COUNT".
        samples: number of draws of `controls` at each point of the grid; by default 1,
            or 100 without a grid.
        controls: what is sampled, as for `attack`.
        adversarial_of: a stored attack, or its directory. Its adversarial scene is
            swept in addition to the clean scene, with the same draws; `summary.arms`
            compares the two. If neither `grid` nor `controls` is passed, the conditions
            over which the attack was made robust (its `over`) vary.
        metrics: columns of the rows, by name: functions of (image (H, W, 3) sRGB in [0,
            1], output of that picture, truth: the index of the right class) that return
            a number or a dict. `workers` need functions of a module.
        tracker: called without arguments for each drive; returns a function that is
            called once a frame with the detected boxes (n, 4), x0, y0, x1, y1 in
            pixels, and their scores (n,). This function returns the tracks in the
            frame, each as a number and a box (docs/drives.md). None takes
            `advsearch.questions.sweep.tracks.ConstantVelocity`.
        run: directory to store the run in; None keeps it in memory, which then grows
            with every configuration.
    """
    _check_grid(grid)
    # Settings that the caller does not pass are taken from the attack, if there is one.
    attack_run = _find_attack_run(adversarial_of)
    defaults = _load_defaults(attack_run, scene, grid, controls)
    scenes = _make_list(defaults["object"] if scene is None else scene)
    default_model = defaults.get("model", "reference")
    request = SweepRequest(
        scenes=scenes,
        models=_make_list(default_model if model is None else model),
        controls=controls or defaults.get("controls", ()),
        task=_resolve_task(task, defaults),
        loaded_scenes=_name_loaded_scenes(scenes),
        metrics=metrics,
        tracker=tracker,
    )
    varied = {
        "grid": dict(grid or {}),
        "samples": samples,
        "adversarial_of": attack_run,
    }
    set_options = drop_unset(settings)
    run_setting = {"run": None if run is None else str(run)}
    described = {**request.to_settings(set_options), **varied}
    # A later mapping overrides earlier ones: what is passed overrides the attack.
    config = SweepConfig(**{**defaults, **described, **set_options, **run_setting})
    config = config.with_python_only_parts(request.find_python_only(config))
    _check_config(config)
    progress = as_progress(progress)
    request.check_can_use_workers(set_options)
    return _run_config(config, request, progress)


def _check_grid(grid: object) -> None:
    """Raise an error if a grid is no mapping, and not None."""
    if not isinstance(grid, (Mapping, type(None))):
        raise InputError(
            "grid: expected a mapping from parameters to values, got "
            f"{type(grid).__name__}"
        )


@dataclass(frozen=True, eq=False)
class SweepRequest:
    """What the caller of `sweep` passed: names, settings, or objects of the session.

    Attributes:
        scenes: scenes as the caller passed them: `Scene`s, or names of objects.
        models: models: names, files or objects.
        controls: controls that are sampled.
        task: task of all models.
        loaded_scenes: the loaded ones of `scenes`: all of them or none.
        metrics: functions or their names, by the name of the metric.
        tracker: makes the tracker of a drive; None takes the default one.
    """

    scenes: Sequence[Any]
    models: Sequence[Any]
    controls: Controls
    task: AnyTask
    loaded_scenes: tuple[NamedScene, ...]
    metrics: Mapping[str, str | Metric] | None
    tracker: Callable[[], Step] | None

    def to_settings(self, set_options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings that describe what was passed, with names of objects.

        Args:
            set_options: the other settings that the caller passed.

        Raises:
            InputError: scenes are loaded, and a setting of a scene was passed.
        """
        task = self.task
        described: dict[str, Any] = {
            "model": ",".join(get_model_name(model) for model in self.models),
            "task": convert_to_setting(task) if isinstance(task, Task) else task,
            "controls": loading.controls_to_settings(self.controls),
            "metrics": judging.metrics_to_settings(self.metrics or {}),
        }
        if self.loaded_scenes:
            naming.check_no_scene_settings(set_options)
        return described | _describe_scenes(self.scenes, self.loaded_scenes)

    def find_python_only(self, config: SweepConfig) -> list[PythonOnly]:
        """Return what exists only in this session, so that no command can repeat it.

        That may be models, the scene, the task, metrics, the tracker and controls.

        Args:
            config: the settings.
        """
        metric_names = judging.list_session_only_metrics(config.metrics)
        control_names = loading.list_session_only_controls(self.controls)
        return [
            *self._find_session_models(),
            *self._find_session_scene_and_task(),
            *(PythonOnly("metric", name) for name in metric_names),
            *([] if self.tracker is None else [PythonOnly("tracker")]),
            *(PythonOnly("control", name) for name in control_names),
        ]

    def _find_session_models(self) -> list[PythonOnly]:
        """Return the models that exist only in this session."""
        return [
            PythonOnly("model", get_model_name(model))
            for model in self.models
            if naming.is_session_only(model)
        ]

    def _find_session_scene_and_task(self) -> list[PythonOnly]:
        """Return the scene and the task, if they exist only in this session."""
        parts = []
        if any(scene.scene.is_session_only for scene in self.loaded_scenes):
            parts.append(PythonOnly("scene"))
        # A task is describable if its setting makes an equal one.
        task = self.task
        if isinstance(task, Task) and not is_describable_by_setting(task, make_task):
            parts.append(PythonOnly("task", task.name))
        return parts

    def check_can_use_workers(self, set_options: Mapping[str, Any]) -> None:
        """Raise an error if workers are requested for objects that they cannot load.

        Workers are other processes. They load everything by its name, and do not have
        the objects of this session.

        Args:
            set_options: the settings that the caller passed.

        Raises:
            InputError: such a setting is among `set_options`.
        """
        are_models_named = all(isinstance(model, (str, Path)) for model in self.models)
        is_task_named = not isinstance(self.task, FunctionTask)
        session_controls = loading.list_session_only_controls(self.controls)
        has_session_objects = bool(self.loaded_scenes) or bool(session_controls)
        if has_session_objects or not are_models_named or not is_task_named:
            naming.check_no_worker_settings(set_options)


def _resolve_task(task: AnyTask, defaults: Mapping[str, Any]) -> AnyTask:
    """Return the task to use; a function is made a `Task`.

    Args:
        task: task as the caller passed it.
        defaults: settings of the attack; empty without one.
    """
    # "classification" is the default of the argument. So a caller who passes it gets
    # the task of the attack, too.
    if task == "classification":
        task = defaults.get("task", task)
    return make_task(task) if callable(task) else task


def _find_attack_run(
    adversarial_of: str | Path | AttackResult | None,
) -> str | Path | None:
    """Return the run of an attack.

    Raises:
        InputError: the attack was not stored in a run directory.
    """
    if not isinstance(adversarial_of, AttackResult):
        return adversarial_of
    if adversarial_of.run is None:
        raise InputError(
            "adversarial_of: expected an attack that was kept, got "
            "one that was not; give it a `run`"
        )
    return adversarial_of.run


def _load_defaults(
    attack_run: str | Path | None, scene: object, grid: object, controls: object
) -> dict[str, Any]:
    """Return the settings that a sweep takes from the run of an attack.

    Args:
        attack_run: the run directory of the attack; None without one.
        scene: the scene that the caller passed, or None. If there is one, the settings
            of the attack's scene are left out.
        grid: the grid that the caller passed, or None.
        controls: the controls that the caller passed.

    Raises:
        InputError: there is neither a scene nor a run.
    """
    defaults = dict[str, Any]()
    if attack_run is not None:
        file = find_run(str(attack_run)) / CONFIG
        # The function needs to know whether the sweep states what varies.
        defaults = SweepConfig.load_attack_defaults(
            file, {"grid": grid, "controls": controls}
        )
    if scene is None and not defaults:
        raise InputError(
            "scene: expected what load_scene returns or takes, got nothing; name one"
        )
    if scene is None:
        return defaults
    # The scene that the caller passed replaces that of the attack.
    return {
        name: value for name, value in defaults.items() if name not in SCENE_SETTINGS
    }


def _name_loaded_scenes(scenes: Sequence[Any]) -> tuple[NamedScene, ...]:
    """Return the scenes that the caller has loaded: all of them, or none.

    Args:
        scenes: scenes as the caller passed them: `Scene`s, or names of objects.

    Raises:
        InputError: some are loaded, and others are names.
    """
    loaded = tuple(_name_scene(scene) for scene in scenes if isinstance(scene, Scene))
    if 0 < len(loaded) < len(scenes):
        raise InputError(
            "scene: expected scenes from load_scene or names of objects, "
            "got some of each"
        )
    return loaded


def _name_scene(scene: Scene) -> NamedScene:
    """Return a scene with the names of its object and its environment."""
    description = scene.description
    return NamedScene(description.object_name, description.environment_name, scene)


def _describe_scenes(
    scenes: Sequence[Any], loaded: Sequence[NamedScene]
) -> dict[str, object]:
    """Return the settings that describe the scenes.

    Args:
        scenes: scenes as the caller passed them.
        loaded: the loaded ones: all of them or none.
    """
    if loaded:
        return _describe_loaded_scenes(loaded)
    # `scene` may list several names, as "mug, bowl": spaces and empty names are removed.
    names = [
        ",".join(split_names(scene)) if isinstance(scene, str) else str(scene)
        for scene in scenes
    ]
    return {"object": ",".join(names)}


def _describe_loaded_scenes(loaded: Sequence[NamedScene]) -> dict[str, object]:
    """Return the settings that describe scenes which the caller has loaded."""
    # The settings that are not replaced below are the same in all scenes.
    settings: dict[str, object] = dict(loading.scene_to_settings(loaded[0].scene))
    # each name once, in the order of the scenes
    object_names = dict.fromkeys(scene.object_name for scene in loaded)
    environment_names = dict.fromkeys(scene.environment_name for scene in loaded)
    settings["object"] = ",".join(object_names)
    settings["environment"] = ",".join(environment_names)
    if len(loaded) > 1:
        # Size and `set` (values of the scene's parameters) differ between scenes, and
        # no setting can state several.
        settings |= {"size": None, "set": {}}
    return settings


def _check_config(config: SweepConfig) -> None:
    """Check that the settings of a sweep can be met.

    Raises:
        InputError: workers cannot load a metric, or files are to be stored and there is
            no run directory.
    """
    if config.workers is not None or config.cluster is not None:
        judging.check_metrics_importable(config.metrics)
    # settings that store files in the run, and what the error message calls the files
    name_of_files = {
        "keep_pictures": "them",
        "aov": "the layers",
        "surface": "the map",
    }
    for setting, files in name_of_files.items():
        stores_files = getattr(config, setting) not in ("none", None, False)
        if config.run is None and stores_files:
            raise InputError(
                f"{setting}: expected `run` beside it, the folder that keeps "
                f"{files}; name one"
            )


def _run_config(
    config: SweepConfig, request: SweepRequest, progress: Progress
) -> SweepResult:
    """Load and run a sweep, in its run directory if it has one.

    Args:
        config: the settings.
        request: what the caller passed.
        progress: reports the progress.
    """
    run_context = _open_run_before_work(config)
    if config.twins is not None:
        read_twins(config.twins)  # a check before the work: raises if it is corrupt
    with run_context as directory:
        job = _make_requested_job(config, request)
        if config.run is not None:
            return _run_in_directory(config, job, progress, directory)
        with open_executor(config, WORKER, progress) as executor:
            return Sweep(job, None, progress, executor).execute()


def _open_run_before_work(config: SweepConfig) -> Any:
    """Return a context with the run directory of a sweep, created if it is new.

    The context has the directory of a stopped sweep that is continued, or a new one. It
    has None if the sweep is not stored, or overwrites another run.
    """
    resumed = _find_resumable(config)
    if config.run is None or resumed is not None:
        return nullcontext(resumed)
    check_free(config.run, overwrite=config.overwrite)
    return create_before_work(config)


def _make_requested_job(config: SweepConfig, request: SweepRequest) -> Job:
    """Load what a caller passed, and what the settings name.

    Args:
        config: the settings.
        request: what the caller passed; scenes that are not loaded are loaded.
    """
    loaded = expand_photographs(config, request.loaded_scenes)
    named_scenes = loaded or load_scenes(config)
    task = request.task if isinstance(request.task, Task) else config.task
    models = naming.to_model_list(request.models)
    job = _make_job(config, named_scenes, models, task, request.controls)
    return replace(
        job,
        metrics=load_metrics(config.metrics, request.metrics),
        tracker=request.tracker or job.tracker,
    )


def _find_resumable(config: SweepConfig) -> Path | None:
    """Return the directory of a sweep of the same settings that was stopped.

    None if there is no such sweep, or if `overwrite` requests a new one.
    """
    if config.run is None:
        return None
    path = locate_run(config.run)
    config_file = path / CONFIG
    has_run = is_run(path) and config_file.is_file()
    if config.overwrite or not has_run:
        return None
    # `make_repeatable` returns the settings as a run stores them.
    stored = SweepConfig.from_yaml(config_file, config.session_settings)
    has_same_settings = stored.to_json() == config.make_repeatable().to_json()
    can_continue = has_same_settings and not is_finished(path)
    return path if can_continue else None


def sweep_from_config(
    config: SweepConfig,
    *,
    progress: Progress | None = None,
    resumed: Path | None = None,
) -> SweepResult:
    """Run the sweep that a configuration describes, in its run directory.

    This is what the command `advsearch sweep` calls; `sweep` is the Python form.

    Args:
        config: the settings.
        progress: None reports nothing.
        resumed: the run directory, to continue a sweep that was stopped.
    """
    if config.run is not None and resumed is None:
        check_free(config.run, overwrite=config.overwrite)
    if config.twins is not None:
        read_twins(config.twins)  # a check before the work: raises if it is corrupt
    progress = progress or NullProgress()
    progress.stage(LOADING)
    return _run_in_directory(config, load_job(config), progress, resumed)


def _add_adversarial_arm(
    config: SweepConfig,
    named_scenes: Sequence[NamedScene],
    sampled: Sequence[Control],
    axes: Sequence[Axis],
) -> tuple[NamedScene, ...]:
    """Return the clean scenes, then the same with an adversarial configuration.

    These are the two arms of a comparison. Without `adversarial_of` nothing is
    compared, and the scenes stay as they are.

    Args:
        config: the settings.
        named_scenes: the scenes.
        sampled: controls that are sampled.
        axes: axes of the grid.

    Raises:
        InputError: the attack has no adversarial configuration, or what it sets varies.
    """
    if config.adversarial_of is None:
        return tuple(named_scenes)
    directory = find_run(config.adversarial_of)
    attack_config = _load_attack_config(directory)
    fixed_controls = make_configured_controls(attack_config, attack_config.controls)
    _check_not_varied(fixed_controls, sampled, axes, directory)
    u = torch.from_numpy(read_configuration(directory))
    arm = _name_adversarial_arm(directory)
    # The attack's controls are fixed in both arms. Without an adversarial configuration
    # they have their values in the clean scene.
    clean = [
        replace(scene, fixed_controls=fixed_controls, arm=CLEAN)
        for scene in named_scenes
    ]
    adversarial = [
        replace(scene, adversarial_configuration=u, arm=arm) for scene in clean
    ]
    return (*clean, *adversarial)


def _load_attack_config(directory: Path) -> AttackConfig:
    """Return the settings of an attack that has an adversarial configuration.

    Args:
        directory: the run directory of the attack.

    Raises:
        InputError: it has no adversarial configuration.
    """
    summary = load_attack_summary(directory)
    attack_config = AttackConfig.from_yaml(directory / CONFIG)
    if summary.adversarial is None:
        raise InputError(
            f"adversarial_of: {directory} ended with {summary.ending!r}, so that there "
            "is no adversarial configuration "
            "to sweep"
        )
    return attack_config


def _name_adversarial_arm(directory: Path) -> str:
    """Return the name of the adversarial arm: that of the attack's run directory.

    Each of the two arms has a name; that of the attack's run may be "clean", too.
    """
    arm = directory.resolve().name
    return f"{arm}'s" if arm == CLEAN else arm


def _make_list(value: Any) -> list[Any]:
    """Return scenes or models as a list.

    Raises:
        InputError: the list is empty.
    """
    values = list(value) if isinstance(value, (list, tuple)) else [value]
    if not values:
        raise InputError(
            "scene and model: expected at least one of each, got an empty list"
        )
    return values


def load_job(config: SweepConfig) -> Job:
    """Load everything that a configuration names."""
    named_scenes = load_scenes(config)
    job = _make_job(config, named_scenes, config.models, config.task, config.controls)
    return replace(job, metrics=load_metrics(config.metrics))


def load_scenes_of_sweep(config: SweepConfig) -> SceneLoader:
    """Return what renders images of a sweep again, after checking all that it names."""
    job = load_job(config)
    check_job(job)
    return SceneLoader(job)


def row_parameters(config: SweepConfig) -> set[str]:
    """Load everything that a sweep names, and return the parameters of its rows."""
    job = load_scenes_of_sweep(config).job
    space = job.bind_controls(job.scenes[0], job.image_sizes[0])
    center = torch.full_like(space.start, 0.5)
    # One choice may describe parameters that another choice does not have.
    return {*space.describe(space.start), *space.describe(center)}


def _check_not_varied(
    fixed_controls: Sequence[Control],
    sampled: Sequence[Control],
    axes: Sequence[Axis],
    attack_run: Path,
) -> None:
    """Check that a sweep does not vary what an adversarial configuration sets.

    Args:
        fixed_controls: controls of the attack.
        sampled: controls that are sampled.
        axes: axes of the grid.
        attack_run: run directory of the attack, for the message.

    Raises:
        InputError: a control is both fixed and varied.
    """
    varied_names = {control.name for control in sampled}
    varied_names |= {axis.control_name for axis in axes}
    fixed_names = {control.name for control in fixed_controls}
    clashes = sorted(varied_names & fixed_names)
    if clashes:
        raise InputError(
            f"adversarial_of: the adversarial configuration of {attack_run} sets "
            f"{clashes[0]}, so it can't vary; leave it "
            "out of `grid` and `controls`"
        )


def _make_job(
    config: SweepConfig,
    named_scenes: Sequence[NamedScene],
    models: Sequence[AnyModel],
    task: AnyTask,
    controls: Controls,
) -> Job:
    """Load models and tasks, and check that they can be swept over these scenes.

    With a `path`, the frames of drives become an axis; with `adversarial_of`, each
    scene comes a second time, with the adversarial configuration.

    Args:
        config: the settings.
        named_scenes: the clean scenes.
        models: names, files or modules of the models.
        task: task of all models.
        controls: controls that are sampled.

    Raises:
        InputError: something in the settings does not fit together.
    """
    _check_run_settings(config)
    sampled = make_configured_controls(config, controls)
    grid = config.grid
    if config.path is not None:
        sampled, grid = add_frame_axis(config, sampled)
    axes = parse_axes(grid, sampled)
    n_combinations = len(named_scenes) * len(models)
    _check_something_varies(config, axes, sampled, n_combinations)
    named_scenes = _add_adversarial_arm(config, named_scenes, sampled, axes)
    check_scenes(named_scenes, sampled, axes)
    axes = _set_camera_units(axes, named_scenes)
    networks, tasks, warnings = _load_models_and_tasks(
        config, named_scenes, models, task
    )
    warnings += _find_scene_notes(named_scenes, sampled, axes)
    job = Job(
        config=config,
        scenes=named_scenes,
        models=networks,
        tasks=tasks,
        controls=sampled,
        axes=axes,
        aovs=parse_aovs(config.aov),
    )
    return _add_warnings(job, [*warnings, *_find_control_notes(job)])


def _add_warnings(job: Job, warnings: Iterable[str]) -> Job:
    """Return a job with warnings, each once: several scenes may have the same."""
    return replace(job, warnings=tuple(dict.fromkeys(warnings)))


def _check_run_settings(config: SweepConfig) -> None:
    """Check the settings of a sweep that do not fit together.

    Settings of a path need a control that travels along it. They are left out of the
    check, since `add_frame_axis` adds such a control if there is none.

    Raises:
        InputError: two settings do not fit together.
    """
    checked_config = config
    if config.path is not None:
        no_path = {"path": None, "shutter": None, "rolling": None}
        checked_config = config.model_copy(update=no_path)
    naming.check_run_settings(checked_config)


def _find_control_notes(job: Job) -> list[str]:
    """Return the notes of the controls on each scene."""
    notes = list[str]()
    # Notes do not depend on the size of images: the first model's is used.
    for named_scene in job.scenes:
        space = job.bind_controls(named_scene, job.image_sizes[0])
        notes += space.list_notes(named_scene.scene.description)
    return notes


def _check_something_varies(
    config: SweepConfig,
    axes: Sequence[Axis],
    sampled: Sequence[Control],
    n_combinations: int,
) -> None:
    """Check that a sweep has more than one image to evaluate.

    Args:
        config: the settings.
        axes: axes of the grid.
        sampled: controls that are sampled.
        n_combinations: scenes times models.

    Raises:
        InputError: `samples` is set but nothing is sampled, or nothing varies at all.
    """
    _check_samples_have_controls(config, sampled)
    if not axes and not sampled and n_combinations == 1:
        raise InputError(
            "grid: expected something that varies, got nothing; add an axis such as "
            "`grid` pose.yaw=0:360:24, or "
            "`controls=pose` `samples=100`"
        )


def _check_samples_have_controls(
    config: SweepConfig, sampled: Sequence[Control]
) -> None:
    """Raise an error if `samples` is set but no control is sampled."""
    if config.samples is not None and not sampled:
        raise InputError(
            "samples: expected `controls` beside it, which says what is drawn by "
            "chance; add `controls=pose`, say, or "
            "leave `samples` out"
        )


def _set_camera_units(
    axes: Sequence[Axis], named_scenes: Sequence[NamedScene]
) -> tuple[Axis, ...]:
    """Return the axes, with those of cameras in meters if all objects have a size."""
    # Without a size in meters, distances are in sizes of the object.
    are_sized = all(
        named_scene.scene.description.object.size_in_metres is not None
        for named_scene in named_scenes
    )
    return tuple(
        replace(axis, parameter=adapt_length_unit(axis.parameter, are_sized))
        if axis.control_kind == CameraControl.kind
        else axis
        for axis in axes
    )


def _load_models_and_tasks(
    config: SweepConfig,
    named_scenes: Sequence[NamedScene],
    models: Sequence[AnyModel],
    task: AnyTask,
) -> tuple[tuple[Model, ...], tuple[Task, ...], list[str]]:
    """Load the models, and make a task for each.

    Each model has a task of its own, since a task may depend on the model's classes and
    be calibrated with its outputs.

    Args:
        config: the settings.
        named_scenes: all scenes of the sweep, on which tasks are calibrated.
        models: names, files or modules.
        task: task of all models.

    Returns:
        The models, the tasks, and remarks on both.
    """
    shared_task = make_task(task)
    networks, warnings = _load_distinct_models(models, shared_task, config)
    scenes = [named_scene.scene for named_scene in named_scenes]
    tasks = tuple(
        _calibrate_for_model(config, shared_task, network, scenes)
        for network in networks
    )
    # Remarks are collected before `make_each_thing_task` wraps the tasks below: the
    # wrappers have none.
    for network_task in tasks:
        warnings += network_task.output_remarks
    if config.judge == ALL_THINGS:
        tasks = tuple(map(make_each_thing_task, tasks))
    warnings += judging.find_label_warnings(
        networks, config.label, _find_object_labels(named_scenes)
    )
    return networks, tasks, warnings


def _find_object_labels(named_scenes: Sequence[NamedScene]) -> dict[str, str | None]:
    """Return the label of each object by its name."""
    return {
        named_scene.object_name: named_scene.scene.description.object.label
        for named_scene in named_scenes
    }


def _load_distinct_models(
    models: Sequence[AnyModel], task: Task, config: SweepConfig
) -> tuple[tuple[Model, ...], list[str]]:
    """Load models, and check that their names differ.

    Args:
        models: names, files or modules.
        task: task of all models.
        config: the settings.

    Returns:
        The models, and warnings of loading.
    """
    _check_distinct_names([get_model_name(model) for model in models])
    networks, warnings = load_models(models, task, config)
    # Several files or functions may return models of the same name.
    _check_distinct_names([network.name for network in networks])
    return networks, warnings


def _calibrate_for_model(
    config: SweepConfig, shared_task: Task, network: Model, scenes: Sequence[Scene]
) -> Task:
    """Return the task of one model, calibrated with its outputs.

    Args:
        config: the settings.
        shared_task: task of all models.
        network: the model.
        scenes: all scenes of the sweep.
    """
    return judging.calibrate_task(
        shared_task.on(network),  # a copy for this model
        network,
        scenes,
        config.label,
        config.judge,
        config.image_settings,
    )


def _find_scene_notes(
    named_scenes: Sequence[NamedScene],
    controls: Sequence[Control],
    axes: Sequence[Axis],
) -> list[str]:
    """Return the notes on the scenes, such as what an importer could not read.

    A control of environments may load files; the notes on these are included.

    Args:
        named_scenes: all scenes of the sweep.
        controls: controls that are sampled.
        axes: axes of the grid.
    """
    notes = list[str]()
    for named_scene in named_scenes:
        description = named_scene.scene.description
        # the sampled controls, and those of the axes
        for control in add_grid_axes(controls, axes, description):
            if control.kind == ENVIRONMENT:
                # `prepare` loads the environments. It returns a description that also
                # has the notes on their files.
                description = control.prepare(description)
        notes += description.notes
    return notes


def load_scenes(config: SweepConfig) -> tuple[NamedScene, ...]:
    """Load the scenes of a configuration: every object in every environment.

    They are sorted by object, then by environment. Without an `environment`, each
    object has that of its own scene. A scene that a Python caller passed is the only
    one. If `backdrop` is a folder, each scene is repeated in every photograph.

    Args:
        config: settings of the sweep.
    """
    return expand_photographs(config, _load_named_scenes(config))


def _load_named_scenes(config: SweepConfig) -> list[NamedScene]:
    """Load the scenes of a configuration, before `expand_photographs`.

    They are every object in every environment. Without the setting `environment`, each
    object has the environment of its own scene. A scene that a Python caller passed is
    the only one. If `backdrop` is a folder, each scene is in its first photograph.
    """
    session_scene: Scene | None = config.get_python_object(naming.SCENE, config.object)
    if session_scene is not None:  # passed by a Python caller
        name = session_scene.description.environment_name
        return [NamedScene(config.object, name, session_scene)]
    objects = naming.check_distinct(config.objects, "object")
    environments = naming.check_distinct(config.environments, "environment")
    # Without the setting, `config.environments` is a default that is not used here.
    first_environment = environments[0] if config.environment else None
    scenes = {
        name: naming.load_configured_scene(config, name, first_environment)
        for name in objects
    }
    if first_environment is None:
        return [
            NamedScene(name, scene.description.environment_name, scene)
            for name, scene in scenes.items()
        ]
    return _combine_with_environments(scenes, environments)


def _combine_with_environments(
    scenes: Mapping[str, Scene], environments: Sequence[str]
) -> list[NamedScene]:
    """Return every object in every environment, sorted by object.

    Args:
        scenes: the scene of each object in the first environment, by the object's name.
        environments: names of the environments.
    """
    first_scene = next(iter(scenes.values()))
    environment_by_name = _load_environments(first_scene, environments)
    return [
        NamedScene(name, environment_name, scenes[name].with_environment(environment))
        for name in scenes
        for environment_name, environment in environment_by_name.items()
    ]


def _load_environments(
    first_scene: Scene, names: Sequence[str]
) -> dict[str, EnvironmentAsset | None]:
    """Load each environment once, with the first object, to use it for all others.

    Args:
        first_scene: the scene of the first object in the first environment.
        names: names of the environments.

    Returns:
        The environments by name.
    """
    description = first_scene.description
    environment_by_name = {names[0]: description.environment}
    for name in names[1:]:
        scene = load_scene(description.object, name)
        environment_by_name[name] = scene.description.environment
    return environment_by_name


def expand_photographs(
    config: SweepConfig, scenes: Iterable[NamedScene]
) -> tuple[NamedScene, ...]:
    """Return the scenes, each in every photograph of its folder of photographs.

    Scenes without such a folder stay as they are. So do all scenes if a control of the
    sweep or an axis of its grid chooses the photograph.

    Args:
        config: the settings, which name the controls and the axes.
        scenes: the scenes, each in its first photograph.
    """
    if _chooses_photograph(config):
        return tuple(scenes)
    return tuple(
        in_photograph
        for named_scene in scenes
        for in_photograph in _expand_folder(named_scene)
    )


def _chooses_photograph(config: SweepConfig) -> bool:
    """Return whether a control of a sweep, or an axis of its grid, chooses a photograph."""
    control_names = [
        *config.controls,
        *(axis_name.partition(".")[0] for axis_name in config.grid),
    ]
    kinds = [
        # a name that is no control has no `kind`
        getattr(config.find_control_type(name), "kind", "")
        for name in control_names
    ]
    return BACKDROP in kinds


def _expand_folder(named_scene: NamedScene) -> list[NamedScene]:
    """Return a scene in every photograph of its folder; itself without a folder."""
    folder = named_scene.scene.description.photographs
    if folder is None:
        return [named_scene]
    return [
        replace(
            named_scene,
            scene=replace(named_scene.scene, description=description),
            environment_name=description.environment_name,
            photograph_name=name,
        )
        for name, description in folder.scenes.items()
    ]


def _check_distinct_names(names: Sequence[str]) -> None:
    """Check that no two models have the same name: results are listed by it."""
    if len(set(names)) < len(names):
        raise InputError(
            f"model: expected models with different names, got {', '.join(names)}; "
            "from Python, load_model(..., name=...) gives one"
        )


def _run_in_directory(
    config: SweepConfig, job: Job, progress: Progress, resumed: Path | None
) -> SweepResult:
    """Run a sweep in its run directory, or continue one that was stopped.

    Args:
        config: the settings.
        job: the loaded scenes, models and controls.
        progress: reports the progress.
        resumed: the run directory of the sweep to continue; None for a new one.
    """
    with (
        RunDirectory.open(config, resumed) as run,
        open_executor(config, WORKER, progress) as executor,
    ):
        functions: dict[str, Callable[..., Any] | None] = {
            f"metric {name}": function for name, function in job.metrics.items()
        }
        functions["task"] = get_task_function(job.tasks[0])
        # A sweep can only be continued with the same models and functions.
        check_digests(run, job.models, functions)
        return Sweep(job, run, progress, executor).execute()


def sweep_worker(settings: JsonObject) -> BatchFunction:
    """Return the function by which a worker evaluates queries of a sweep.

    Args:
        settings: settings of the sweep.
    """
    return make_worker_call(SceneLoader(load_job(SweepConfig(**settings))).load_by_name)
