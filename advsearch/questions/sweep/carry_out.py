"""`sweep`: the average case of a scene over a grid, over draws by chance, or both."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch

from advsearch.api.keywords import SceneKeywords, asks
from advsearch.cluster import Call
from advsearch.controls import Control
from advsearch.controls.camera import CameraControl, measured_in
from advsearch.engine import judging, loading, naming
from advsearch.engine.journal import check_made_of, worker_call
from advsearch.engine.judging import Metric, load_metrics
from advsearch.engine.loading import Controls, Scene, load_scene
from advsearch.engine.naming import AnyModel, given_to, load_models, model_name
from advsearch.errors import InputError
from advsearch.files import JsonObject
from advsearch.options import as_setting
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.attack.carry_out import LOADING, executor_for, is_named
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.summary import attack_of
from advsearch.questions.sweep.axes import Axis, on_grid, read_axes
from advsearch.questions.sweep.drives import with_frames
from advsearch.questions.sweep.job import (
    Job,
    NamedScene,
    OpenScenes,
    check_all,
    check_scenes,
)
from advsearch.questions.sweep.loop import Sweep
from advsearch.questions.sweep.result import SweepResult
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.tracks import Step
from advsearch.runs.directory import (
    CONFIG,
    RunDirectory,
    begun,
    check_free,
    find_run,
    is_run,
    run_path,
)
from advsearch.runs.listing import finished
from advsearch.runs.summary import read_configuration
from advsearch.scene.description import ENVIRONMENT
from advsearch.scene.formation import aovs_of
from advsearch.scene.things import ALL
from advsearch.settings import PythonOnly, split_names
from advsearch.tasks import AnyTask, OwnTask, Task, function_of, make_task
from advsearch.tasks.together import each_thing

if TYPE_CHECKING:
    from typing_extensions import Unpack

OUTER = ("object", "environment")
OF_A_SCENE = (
    "object",
    "environment",
    "up",
    "facing",
    "size",
    "unit",
    "camera",
    "things",
    "set_",
    "exposure",
)
"""Settings that a scene of the caller's own has."""
WORKER = "advsearch.questions.sweep.carry_out:sweep_worker"  # what a worker does
# what the scene without the adversarial configuration of a run is called beside that
# with it
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


@asks(SweepConfig)
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
    progress: Watched = None,
    **settings: Unpack[SweepKeywords],
) -> SweepResult:
    """Render every configuration of a grid, and draws by chance, and say how often the
    model is right.

    With `run` naming a sweep of the same settings that was stopped, it goes on where
    that was stopped. All other arguments are the settings of `advsearch sweep`.

    Args:
        scene: from `load_scene`, or what that takes; or several. None takes that of
            `adversarial_of`.
        model: from `load_model`, or what that takes; or several, which are shown the
            same pictures. None takes that of `adversarial_of`, and the reference model
            without.
        task: what judges the models' outputs: a name, a mapping with a `name` and
            options, an instance, or a function (output, truth) that says how wrong it
            is, over 0 where it is wrong (docs/tasks.md).
        grid: parameter to its values: a list, a range, or "FIRST:LAST:COUNT".
        samples: draws of `controls` at each point of the grid; by default 1, or 100
            without a grid.
        controls: what is drawn by chance, as for `attack`.
        adversarial_of: an attack that was kept, or its folder, whose adversarial scene
            is swept beside the clean scene, under the same draws; `summary.beside`
            compares the two. Where neither `grid` nor `controls` is given, what the
            attack was over varies.
        metrics: columns of the rows, by name: functions of (image (H, W, 3) sRGB in [0,
            1], output of that picture, truth: the index of the right class) that return
            a number or a dict. `workers` need functions of a module.
        tracker: makes, for each drive, what is called with boxes (n, 4) of a frame, x0,
            y0, x1, y1 in pixels, and their scores (n,), and returns the tracks in it: a
            number and a box each (docs/drives.md). None takes
            `advsearch.questions.sweep.tracks.ConstantVelocity`.
        run: folder to keep the run in; None keeps it in memory, which then grows with
            every configuration.
    """
    options: dict[str, Any] = {
        name: value for name, value in settings.items() if value is not None
    }
    if not isinstance(grid, (Mapping, type(None))):
        raise InputError(
            "grid: expected a mapping from parameters to values, got "
            f"{type(grid).__name__}"
        )
    if isinstance(adversarial_of, AttackResult):
        if adversarial_of.run is None:
            raise InputError(
                "adversarial_of: expected an attack that was kept, got "
                "one that was not; give it a `run`"
            )
        adversarial_of = adversarial_of.run
    brought = dict[str, Any]()
    if adversarial_of is not None:
        file = find_run(str(adversarial_of)) / CONFIG
        brought = SweepConfig.of_attack(file, {"grid": grid, "controls": controls})
    if scene is None and not brought:
        raise InputError(
            "scene: expected what load_scene returns or takes, got nothing; name one"
        )
    if scene is not None:
        brought = {
            name: value for name, value in brought.items() if name not in OF_A_SCENE
        }
    scenes = _several(brought["object"] if scene is None else scene)
    networks = _several(brought.get("model", "reference") if model is None else model)
    controls = controls or brought.get("controls", ())
    task = brought.get("task", task) if task == "classification" else task
    task = make_task(task) if callable(task) else task
    loaded = tuple(
        NamedScene(
            scene.description.object_name, scene.description.environment_name, scene
        )
        for scene in scenes
        if isinstance(scene, Scene)
    )
    if 0 < len(loaded) < len(scenes):
        raise InputError(
            "scene: expected scenes from load_scene or names of objects, "
            "got some of each"
        )
    described: dict[str, object] = {
        "model": ",".join(model_name(one) for one in networks),
        "task": as_setting(task) if isinstance(task, Task) else task,
        "controls": loading.settings_of(controls),
        "grid": dict(grid or {}),
        "samples": samples,
        "adversarial_of": adversarial_of,
        "metrics": judging.metrics_as_settings(metrics or {}),
    }
    if loaded:
        naming.check_not_of_scene(options)
        described |= loading.scene_as_settings(loaded[0].scene)
        described |= {
            what: ",".join(dict.fromkeys(getattr(place, what) for place in loaded))
            for what in OUTER
        }
        described |= {"size": None, "set": {}} if len(loaded) > 1 else {}
    else:
        names = (
            ",".join(split_names(one)) if isinstance(one, str) else str(one)
            for one in scenes
        )
        described["object"] = ",".join(names)
    config = SweepConfig(
        **{**brought, **described, **options, "run": None if run is None else str(run)}
    )
    parts = [
        PythonOnly("model", model_name(one))
        for one in networks
        if naming.exists_here(one)
    ]
    parts += (
        [PythonOnly("scene")] if any(place.scene.only_here for place in loaded) else []
    )
    parts += (
        [PythonOnly("task", task.name)]
        if isinstance(task, Task) and not is_named(task, make_task)
        else []
    )
    parts += [PythonOnly("metric", name) for name in judging.only_here(config.metrics)]
    parts += [PythonOnly("tracker")] if tracker is not None else []
    config = config.with_only_here(
        [*parts, *(PythonOnly("control", name) for name in loading.only_here(controls))]
    )
    if config.workers is not None or config.cluster is not None:
        judging.check_shared(config.metrics)
    for name, what in {
        "keep_pictures": "them",
        "aov": "the layers",
        "surface": "the map",
    }.items():
        if config.run is None and getattr(config, name) not in ("none", None, False):
            raise InputError(
                f"{name}: expected `run` beside it, the folder that keeps "
                f"{what}; name one"
            )
    progress = watcher(progress)
    named = all(
        isinstance(network, (str, Path)) for network in networks
    ) and not isinstance(task, OwnTask)
    if loaded or loading.only_here(controls) or not named:
        naming.check_not_spread(options)
    resumed = None  # or the folder of a sweep of the same settings that was stopped
    if config.run is not None:
        path = run_path(config.run)
        recipe = run_path(config.run) / CONFIG
        if not config.overwrite and is_run(path) and recipe.is_file():
            before = SweepConfig.from_yaml(recipe, config.asked)
            resumed = (
                path
                if before.plain() == config.to_repeat().plain() and not finished(path)
                else None
            )
        if resumed is None:
            check_free(config.run, overwrite=config.overwrite)
    asked = task if isinstance(task, Task) else config.task
    with (
        begun(config)
        if config.run is not None and resumed is None
        else nullcontext(resumed) as begun_in
    ):
        job = _job(
            config, loaded or _places(config), naming.several(networks), asked, controls
        )
        job = replace(
            job,
            metrics=load_metrics(config.metrics, metrics),
            tracker=tracker or job.tracker,
        )
        if config.run is not None:
            return _kept(config, job, progress, begun_in)
        with executor_for(config, WORKER, progress) as executor:
            return Sweep(job, None, progress, executor).carry_out()


def sweep_from_config(
    config: SweepConfig,
    *,
    progress: Progress | None = None,
    resumed: Path | None = None,
) -> SweepResult:
    """Do what a configuration describes and keep it in a run directory; see `sweep`."""
    if config.run is not None and resumed is None:
        check_free(config.run, overwrite=config.overwrite)
    progress = progress or NullProgress()
    progress.stage(LOADING)
    return _kept(config, job_of(config), progress, resumed)


def _beside_adversarial(
    config: SweepConfig,
    places: Sequence[NamedScene],
    drawn: Sequence[Control],
    axes: Sequence[Axis],
) -> tuple[NamedScene, ...]:
    if config.adversarial_of is None:
        return tuple(places)
    folder = find_run(config.adversarial_of)
    summary = attack_of(folder)
    theirs = AttackConfig.from_yaml(folder / CONFIG)
    if summary.adversarial is None:
        raise InputError(
            f"adversarial_of: {folder} ended with {summary.ending!r}, so that there is "
            "no adversarial configuration "
            "to sweep"
        )
    held = given_to(theirs, theirs.controls)
    varied = {control.name for control in drawn} | {axis.instance for axis in axes}
    if twice := sorted(varied & {control.name for control in held}):
        raise InputError(
            f"adversarial_of: the adversarial configuration of {folder} sets "
            f"{twice[0]}, so it can't vary; leave it "
            "out of `grid` and `controls`"
        )
    u = torch.from_numpy(read_configuration(folder))
    name = folder.resolve().name
    clean = [replace(place, held=held, beside_clean=CLEAN) for place in places]
    return (
        *clean,
        *(
            replace(place, u=u, beside_clean=f"{name}'s" if name == CLEAN else name)
            for place in clean
        ),
    )


def _several(given: Any) -> list[Any]:
    listed = list(given) if isinstance(given, (list, tuple)) else [given]
    if not listed:
        raise InputError(
            "scene and model: expected at least one of each, got an empty list"
        )
    return listed


def job_of(config: SweepConfig) -> Job:
    job = _job(config, _places(config), config.models, config.task, config.controls)
    return replace(job, metrics=load_metrics(config.metrics))


def scenes_of(config: SweepConfig) -> OpenScenes:
    """Return what renders pictures of a sweep again; everything that it names is looked
    at first.
    """
    job = job_of(config)
    check_all(job)
    return OpenScenes(job)


def row_parameters(config: SweepConfig) -> set[str]:
    """Load everything that a sweep names, and return the parameters of its rows."""
    job = scenes_of(config).job
    space = job.space(job.places[0], job.sizes[0])
    halfway = torch.full_like(space.start, 0.5)
    return {name for u in (space.start, halfway) for name in space.describe(u)}


def _job(
    config: SweepConfig,
    places: Sequence[NamedScene],
    models: Sequence[AnyModel],
    task: AnyTask,
    controls: Controls,
) -> Job:
    # where no control does, one is added
    travels = ("path", "shutter", "rolling") if config.path is not None else ()
    naming.check_run_settings(config.model_copy(update=dict.fromkeys(travels)))
    drawn = given_to(config, controls)
    grid = config.grid
    if config.path is not None:
        drawn, grid = with_frames(config, drawn)
    axes = read_axes(grid, drawn)
    if config.samples is not None and not drawn:
        raise InputError(
            "samples: expected `controls` beside it, which says what is drawn by "
            "chance; add `controls=pose`, say, or "
            "leave `samples` out"
        )
    if not axes and not drawn and len(places) * len(models) == 1:
        raise InputError(
            "grid: expected something that varies, got nothing; add an axis such as "
            "`grid` pose.yaw=0:360:24, or "
            "`controls=pose` `samples=100`"
        )
    places = _beside_adversarial(config, places, drawn, axes)
    check_scenes(places, drawn, axes)
    sized = all(place.scene.description.object.metres is not None for place in places)
    axes = tuple(
        replace(one, parameter=measured_in(one.parameter, sized))
        if one.control == CameraControl.kind
        else one
        for one in axes
    )
    made = make_task(task)
    _check_different([model_name(model) for model in models])
    networks, warnings = load_models(models, made, config)
    # what a file or a function gives may have another's name
    _check_different([model.name for model in networks])
    scenes = [place.scene for place in places]
    tasks = tuple(
        judging.calibrate_task(
            made.on(network),
            network,
            scenes,
            config.label,
            config.judge,
            config.image_settings,
        )
        for network in networks
    )
    warnings += [remark for task in tasks for remark in task.remarks]
    tasks = tuple(map(each_thing, tasks)) if config.judge == ALL else tasks
    own = {place.object: place.scene.description.object.label for place in places}
    warnings += judging.one_label_for_several(networks, config.label, own)
    for place in places:
        described = place.scene.description
        for control in on_grid(drawn, axes, described):
            described = (
                control.prepare(described) if control.kind == ENVIRONMENT else described
            )
        warnings += described.notes
    job = Job(config, tuple(places), networks, tasks, drawn, axes, aovs_of(config.aov))
    for place in places:
        warnings += job.space(place, job.sizes[0]).notes(place.scene.description)
    return replace(job, warnings=tuple(dict.fromkeys(warnings)))


def _places(config: SweepConfig) -> tuple[NamedScene, ...]:
    passed: Scene | None = config.python_object(naming.SCENE, config.object)
    if passed is not None:
        return (NamedScene(config.object, passed.description.environment_name, passed),)
    objects = naming.different(config.objects, "object")
    environments = naming.different(config.environments, "environment")
    asked = environments[0] if config.environment else None
    scenes = {name: naming.scene_of(config, name, asked) for name in objects}
    if asked is None:
        return tuple(
            NamedScene(name, scene.description.environment_name, scene)
            for name, scene in scenes.items()
        )
    lights = {asked: scenes[objects[0]].description.environment}
    for name in environments[1:]:
        lights[name] = load_scene(
            scenes[objects[0]].description.object, name
        ).description.environment
    return tuple(
        NamedScene(name, light, scenes[name].lit_by(lights[light]))
        for name in objects
        for light in lights
    )


def _check_different(names: Sequence[str]) -> None:
    if len(set(names)) < len(names):
        raise InputError(
            f"model: expected models with different names, got {', '.join(names)}; "
            "from Python, "
            "load_model(..., name=...) gives one"
        )


def _kept(
    config: SweepConfig, job: Job, progress: Progress, resumed: Path | None
) -> SweepResult:
    with (
        RunDirectory.of(config, resumed) as run,
        executor_for(config, WORKER, progress) as executor,
    ):
        functions = {f"metric {name}": one for name, one in job.metrics.items()}
        check_made_of(run, job.models, {**functions, "task": function_of(job.tasks[0])})
        return Sweep(job, run, progress, executor).carry_out()


def sweep_worker(settings: JsonObject) -> Call:
    """Return what evaluates the queries of the sweep that the settings describe: what a
    worker does.
    """
    return worker_call(OpenScenes(job_of(SweepConfig(**settings))).named)
