"""`advsearch.attack`: attack scenes and models of a Python session."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from torch import Tensor

from advsearch import losses
from advsearch.api.keywords import Names, SceneKeywords, with_settings_signature
from advsearch.attacks import Policy, make_policy
from advsearch.attacks.objectives import OBJECTIVE_KINDS
from advsearch.config import SceneConfig
from advsearch.engine import judging, loading, naming
from advsearch.engine.judging import Metric
from advsearch.engine.loading import Controls, Scene
from advsearch.engine.naming import AnyModel, get_model_name, list_models
from advsearch.errors import InputError
from advsearch.options import describe_value, to_setting
from advsearch.progress import ProgressOption, as_progress
from advsearch.questions.attack.carry_out import (
    AttackParts,
    is_named,
    load_ensemble,
    make_attack_controls,
    make_task_and_objective,
)
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.attack.run import run_attack
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import create_before_work, is_run, locate_run
from advsearch.settings import PythonOnly
from advsearch.tasks import AnyTask, FunctionTask, Task, make_task

if TYPE_CHECKING:
    from typing_extensions import Unpack


class AttackKeywords(SceneKeywords, total=False):
    """Settings that `attack` takes as keywords, besides its own arguments."""

    spp: int | Literal["auto"] | None
    epsilon: float | Mapping[str, Any] | tuple[float, ...] | None
    norm: Literal["linf", "l2"] | None
    estimators: str | Mapping[str, str]
    ensemble: Literal["mean", "worst"] | None
    measure: Literal["no", "quick", "full"]
    steps: int | None
    seconds: float | None
    target: Path | Names | None
    minimise: bool
    smallest: bool
    printable: bool
    draws: int | None
    average: int
    baseline: bool
    trials: int | None


@with_settings_signature(AttackConfig)
def attack(
    scene: Scene | str | Path | Mapping[str, object],
    model: AnyModel | Sequence[AnyModel] = "reference",
    *,
    object: str | None = None,
    task: AnyTask = "classification",
    controls: Controls = ("texture",),
    objective: str | Callable[..., Tensor] | None = None,
    policy: str | Mapping[str, object] | Policy[Any] = "auto",
    over: Controls = (),
    metrics: Mapping[str, str | Metric] | None = None,
    run: str | Path | None = None,
    resume: bool = False,
    progress: ProgressOption = None,
    **settings: Unpack[AttackKeywords],
) -> AttackResult:
    """Search for the worst configuration of a scene, verify it, and return the result.

    All other arguments are the settings of `advsearch attack`; `environment`, `up`,
    `set` and `exposure` belong to a scene that is named here, not to one that is
    loaded.

    Args:
        scene: scene from `load_scene`, or what that takes.
        model: model from `load_model`, or what that takes; with `ensemble`, several.
        object: the node or shape that is the object, where `scene` is a file or
            dictionary that holds several.
        task: what judges the model's output: a name, a mapping with a `name` and
            options, an instance, or a function (output, truth) that says how wrong it
            is, over 0 where it is wrong (docs/tasks.md).
        controls: what may vary: names, instances, or a mapping from names to settings.
        objective: "margin", "log_odds", "cross_entropy", "dlr", "feature_distance",
            "score", or a function of (output, images (N, H, W, 3), truth, or the target
            where there is one) or of (output, labels) that returns (N,) values, which
            are maximised; in classification the output is logits (N, C) and the truth
            the index of the right label, (N,), or a tuple of several. It may ask for
            more by the names of further parameters: `u`, `texture`, `inputs`,
            `configuration` (docs/own-loss.md). None takes the task's own.
        policy: a name, a mapping with a `name` and options, or an instance.
        over: controls that vary by chance: the configuration has to hold for all of
            their values.
        metrics: columns of the rows, by name: functions of (image (H, W, 3) sRGB in [0,
            1], output of that picture, truth: the index of the right class) that return
            a number or a dict. `workers` need functions of a module.
        run: folder to keep the run in; None keeps it in memory only.
        resume: go on with the run of that name, if there is one, where it was stopped;
            everything else has to be as it was.
    """
    options = _drop_unset(settings)
    if callable(task):
        task = make_task(task)
    _check_policy(policy)
    session_controls = [
        *loading.list_session_only_controls(controls),
        *loading.list_session_only_controls(over),
    ]
    _check_can_use_workers(scene, model, task, objective, session_controls, options)
    scene = _load_scene(scene, object, options)

    # the settings as `run.yaml` states them
    config = _make_config(
        scene, model, task, controls, objective, policy, over, metrics, run, options
    )
    losses.check_direction(objective, targeted=config.target is not None)

    python_only = _find_python_only(
        config, scene, model, task, objective, policy, session_controls
    )
    config = config.with_python_only_parts(python_only)
    _check_single(config)

    # The caller's objects are used, and what is only named is made.
    searched, random_controls = make_attack_controls(config, controls, over)
    if not isinstance(policy, Policy):
        policy = make_policy(config.policy_name, **config.policy_options)
    loaded_task, objective = make_task_and_objective(
        config,
        task if isinstance(task, Task) else config.task,
        objective if callable(objective) else config.objective,
    )
    context = _open_run(run, resume, config)
    with context as directory:
        parts = AttackParts(
            config,
            scene,
            model_and_warnings=load_ensemble(model, config, loaded_task),
            task=loaded_task,
            controls=searched,
            random_controls=random_controls,
            objective=objective,
            policy=policy,
            is_stored=run is not None,
            metrics=judging.load_metrics(config.metrics, metrics),
        )
        return run_attack(parts, as_progress(progress), directory)


def _check_policy(policy: object) -> None:
    """Check that a policy is named, described or made.

    Raises:
        InputError: it is not.
    """
    if not isinstance(policy, (str, Mapping, Policy)) or not policy:
        raise InputError(
            "policy: expected a name, a mapping with a `name` and options, or an "
            f"instance, got {describe_value(policy)}"
        )


def _drop_unset(settings: Mapping[str, object]) -> dict[str, Any]:
    """Return the settings that are not None."""
    return {name: value for name, value in settings.items() if value is not None}


def _check_can_use_workers(
    scene: Scene | str | Path | Mapping[str, object],
    model: AnyModel | Sequence[AnyModel],
    task: str | Mapping[str, object] | Task,
    objective: str | Callable[..., Tensor] | None,
    session_controls: Sequence[Any],
    options: Mapping[str, Any],
) -> None:
    """Raise an error if workers are requested for objects that they cannot load.

    Workers are other processes. They load everything by its name, and do not have the
    objects of this session.

    Args:
        scene: scene as the caller passed it; names and paths can be loaded.
        model: model or models as the caller passed them.
        task: task as the caller passed it.
        objective: a name, or a function of the session.
        session_controls: names of the controls that exist in this session only.
        options: the settings that the caller passed, perhaps with `workers`.

    Raises:
        InputError: such a setting is among `options`.
    """
    objects = [
        value
        for value in (scene, *list_models(model))
        if not isinstance(value, (str, Path))
    ]
    has_functions = callable(objective) or isinstance(task, FunctionTask)
    if objects or has_functions or session_controls:
        naming.check_no_worker_settings(options)


def _make_config(
    scene: Scene,
    model: AnyModel | Sequence[AnyModel],
    task: Any,
    controls: Controls,
    objective: str | Callable[..., Tensor] | None,
    policy: str | Mapping[str, object] | Policy[Any],
    over: Controls,
    metrics: Mapping[str, str | Metric] | None,
    run: str | Path | None,
    options: dict[str, Any],
) -> AttackConfig:
    """Return the settings of an attack, as `run.yaml` states them.

    Objects of the caller, such as a loaded model, are replaced by their names.

    Args:
        scene: the loaded scene.
        model: model or models.
        task: a name, settings or an instance.
        controls: controls that are searched.
        objective: a name or a function; None for the task's own.
        policy: a name, settings or an instance.
        over: controls that vary by chance.
        metrics: functions by name.
        run: the run directory; None stores nothing.
        options: all other settings, by name.
    """
    objective_name = _name_objective(objective) if callable(objective) else objective
    described = {
        **loading.scene_to_settings(scene),
        "model": ",".join(map(get_model_name, list_models(model))),
        "controls": loading.controls_to_settings(controls),
        "over": loading.controls_to_settings(over),
        "task": to_setting(task) if isinstance(task, Task) else task,
        "objective": objective_name,
        "policy": to_setting(policy) if isinstance(policy, Policy) else policy,
        "metrics": judging.metrics_to_settings(metrics or {}),
    }
    if options.get("exposure"):  # which replaces the exposure of the scene
        described["set"].pop("camera.exposure", None)
    return AttackConfig(
        **{**described, **options, "run": None if run is None else str(run)}
    )


def _open_run(run: str | Path | None, resume: bool, config: AttackConfig) -> Any:
    """Return a context with the run directory of an attack; None without one.

    It is that of a run that is continued, or a new one.

    Args:
        run: name or folder of the run; None keeps none.
        resume: whether a run that is there is continued.
        config: the settings.
    """
    resumed = None
    if resume and run is not None and is_run(locate_run(run)):
        resumed = locate_run(run)
    context: Any = nullcontext(resumed)
    if run is not None and resumed is None:
        context = create_before_work(config)
    return context


def _find_python_only(
    config: AttackConfig,
    scene: Scene,
    model: AnyModel | Sequence[AnyModel],
    task: AnyTask,
    objective: str | Callable[..., Tensor] | None,
    policy: str | Mapping[str, object] | Policy[Any],
    session_controls: Sequence[str],
) -> list[PythonOnly]:
    """Return what exists in this session only, so that no command can repeat it.

    Args:
        config: the settings.
        scene: the loaded scene.
        model: model as the caller passed it.
        task: task as the caller passed it.
        objective: a name, or a function of the session.
        policy: a name, settings or an instance.
        session_controls: names of the controls that exist in this session only.
    """
    parts = [
        PythonOnly("model", get_model_name(network))
        for network in list_models(model)
        if naming.is_session_only(network)
    ]
    if scene.is_session_only:
        parts.append(PythonOnly("scene"))
    if isinstance(task, Task) and not is_named(task, make_task):
        parts.append(PythonOnly("task", task.name))
    if callable(objective):
        parts.append(PythonOnly("objective", _name_objective(objective)))
    if isinstance(policy, Policy) and not is_named(policy, _make_policy):
        parts.append(PythonOnly("policy", policy.name))
    parts += [PythonOnly("control", name) for name in session_controls]
    parts += [
        PythonOnly("metric", name)
        for name in judging.list_session_only_metrics(config.metrics)
    ]
    return parts


def _load_scene(
    scene: Scene | str | Path | Mapping[str, object],
    shape: str | None,
    options: Mapping[str, Any],
) -> Scene:
    """Return a scene, loaded with the options that belong to it.

    Args:
        scene: loaded scene, a file, a name, or a dictionary of Mitsuba.
        shape: id of the shape that is the object, if the scene has several.
        options: the settings that the caller passed; those of the scene are used.
    """
    if isinstance(scene, Scene):
        naming.check_no_scene_settings({**options, "object": shape})
        return scene
    scene_options = {
        name: options[name] for name in naming.SCENE_SETTINGS if name in options
    }
    # A configuration needs some object. "mug" is not used: only other settings are.
    config = SceneConfig(**{"object": "mug", **scene_options})
    environment = config.environment
    keywords = naming.make_scene_kwargs(config)
    if shape is not None:
        return loading.load_scene(shape, environment, scene=scene, **keywords)
    if isinstance(scene, Mapping):
        raise InputError("object: which shape of the scene is it? Give its id")
    return loading.load_scene(scene, environment, **keywords)


def _name_objective(objective: Callable[..., Tensor]) -> str:
    """Name an objective of the caller, never as one of the built-in ones."""
    name = str(getattr(objective, "__name__", None) or type(objective).__name__)
    return f"own {name}" if name in OBJECTIVE_KINDS else name


def _make_policy(setting: Any) -> Policy[Any]:
    """Make the policy that a setting names."""
    # Only the policy of this configuration is used, but it needs some object.
    config = AttackConfig(object="mug", policy=setting)
    return make_policy(config.policy_name, **config.policy_options)


def _check_single(config: AttackConfig) -> None:
    """Check that the settings are of one attack, which can be made.

    Raises:
        InputError: they are of several attacks, or need a run directory or functions
            that workers can load.
    """
    if config.workers is not None or config.cluster is not None:
        judging.check_metrics_importable(config.metrics)
    if config.is_matrix and config.ensemble is None:
        raise InputError(
            "model: expected one, got several; add `ensemble`, which attacks them "
            "together, or attack each by itself"
        )
    if config.epsilons:
        epsilons = ", ".join(f"{epsilon:g}" for epsilon in config.epsilons)
        raise InputError(
            f"epsilon: expected one, got {epsilons}; attack with each, or have "
            "`advsearch attack` draw the curve"
        )
    if config.aov is not None and config.run is None:
        raise InputError(
            "aov: expected `run` beside it, the folder that keeps the layers; name one"
        )
