"""`advsearch.attack`: an attack on what a session has, scenes, models, controls, tasks, objectives and policies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from torch import Tensor

from advsearch import losses
from advsearch.api.keywords import asks
from advsearch.attacks import Policy, make_policy
from advsearch.attacks.objectives import OBJECTIVE_KINDS
from advsearch.config import SceneConfig
from advsearch.engine.judging import Metric, check_shared, load_metrics, metrics_as_settings
from advsearch.engine.judging import only_here as metrics_only_here
from advsearch.engine.loading import Controls, Scene, load_scene, only_here, scene_as_settings, settings_of
from advsearch.engine.naming import (
    OF_SCENE,
    AnyModel,
    check_not_of_scene,
    check_not_spread,
    exists_here,
    model_name,
    several,
    told_of_scene,
)
from advsearch.errors import InputError
from advsearch.options import as_setting, told
from advsearch.progress import Watched, watcher
from advsearch.questions.attack.carry_out import (
    AttackParts,
    carry_out,
    controls_given,
    is_named,
    models_as_one,
    task_and_objective,
)
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import begun, is_run, run_path
from advsearch.tasks import AnyTask, OwnTask, Task, make_task


@asks(AttackConfig)
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
    progress: Watched = None,
    **settings: Any,
) -> AttackResult:
    """Search for the worst configuration of a scene, verify it, and return everything that is known about it.

    All other arguments are the settings of `advsearch attack`; `environment`, `up`, `set` and `exposure` belong to a
    scene that is named here, not to one that is loaded.

    Args:
        scene: from `load_scene`, or what that takes.
        model: from `load_model`, or what that takes; with `ensemble`, several.
        object: the node or shape that is the object, where `scene` is a file or dictionary that holds several.
        task: what judges the model's output: a name, a mapping with a `name` and options, an instance, or a function
            (output, truth) that says how wrong it is, over 0 where it is wrong (docs/tasks.md).
        controls: what may vary: names, instances, or a mapping from names to settings.
        objective: "margin", "log_odds", "cross_entropy", "dlr", "feature_distance", "score", or a function of (output,
            images (N, H, W, 3), truth, or the target where there is one) or of (output, labels) that returns (N,)
            values, which are maximised; in classification the output is logits (N, C) and the truth the index of the
            right label, (N,), or a tuple of several. It may ask for more by the names of further parameters: `u`,
            `texture`, `inputs`, `configuration` (docs/own-loss.md). None takes the task's own.
        policy: a name, a mapping with a `name` and options, or an instance.
        over: controls that vary by chance: the configuration has to hold for all of their values.
        metrics: columns of the rows, by name: functions of (image (H, W, 3) sRGB in [0, 1], output of that picture,
            truth: the index of the right class) that return a number or a dict. `workers` need functions of a module.
        run: folder to keep the run in; None keeps it in memory only.
        resume: go on with the run of that name, if there is one, where it was stopped; everything else has to be as it
            was.
    """
    options = {name: value for name, value in settings.items() if value is not None}
    task = make_task(task) if callable(task) else task
    loaded_already = not all(isinstance(network, (str, Path)) for network in (scene, *several(model)))
    if loaded_already or callable(objective) or only_here(controls) or only_here(over) or isinstance(task, OwnTask):
        check_not_spread(options)
    if not isinstance(policy, (str, Mapping, Policy)) or not policy:
        raise InputError(
            f"policy: expected a name, a mapping with a `name` and options, or an instance, got {told(policy)}"
        )
    scene = _scene(scene, object, settings)
    fixed: dict[str, float | str] = scene.description.given_values
    if settings.get("exposure"):  # the option says it
        fixed.pop("camera.exposure", None)
    described = {
        **scene_as_settings(scene),
        "model": ",".join(map(model_name, several(model))),
        "controls": settings_of(controls),
        "over": settings_of(over),
        "task": as_setting(task) if isinstance(task, Task) else task,
        "objective": _own_name(objective) if callable(objective) else objective,
        "policy": as_setting(policy) if isinstance(policy, Policy) else policy,
        "set": fixed,
        "metrics": metrics_as_settings(metrics or {}),
    }
    config = AttackConfig(**{**described, **options, "run": None if run is None else str(run)})
    losses.check_aim(objective, targeted=config.target is not None)
    parts = [f"the model {model_name(network)}" for network in several(model) if exists_here(network)]
    parts += ["the scene"] if scene.only_here else []
    parts += [f"the task {task.name}"] if isinstance(task, Task) and not is_named(task, make_task) else []
    parts += [f"the objective {config.objective}"] if callable(objective) else []
    parts += [f"the policy {policy.name}"] if isinstance(policy, Policy) and not is_named(policy, _policy_of) else []
    parts += [f"the control {name}" for name in (*only_here(controls), *only_here(over))]
    parts += [f"the metric {name}" for name in metrics_only_here(config.metrics)]
    if config.workers is not None or config.cluster is not None:
        check_shared(config.metrics)
    config = config.with_only_here(parts)
    if config.is_matrix and config.ensemble is None:
        raise InputError(
            "model: expected one, got several; add `ensemble`, which attacks them together, or attack each by itself"
        )
    if config.epsilons:
        listed = ", ".join(f"{epsilon:g}" for epsilon in config.epsilons)
        raise InputError(
            f"epsilon: expected one, got {listed}; attack with each, or have `advsearch attack` draw the curve"
        )
    if config.aov is not None and config.run is None:
        raise InputError("aov: expected `run` beside it, the folder that keeps the layers; name one")
    searched, drawn = controls_given(config, controls, over)
    policy = policy if isinstance(policy, Policy) else config.policy_name
    named = config.objective if objective is None or isinstance(objective, str) else objective
    asked, objective = task_and_objective(config, task if isinstance(task, Task) else config.task, named)
    stopped = run_path(run) if resume and run is not None and is_run(run_path(run)) else None
    with begun(config) if run is not None and stopped is None else nullcontext(stopped) as folder:
        loaded = models_as_one(model, config, asked)
        measured = load_metrics(config.metrics, metrics)
        job = AttackParts(config, scene, loaded, asked, searched, drawn, objective, policy, run is not None, measured)
        return carry_out(job, watcher(progress), folder)


def _own_name(objective: Callable[..., Tensor]) -> str:
    """What an objective of the caller's is called; never as one of ours."""
    name = str(getattr(objective, "__name__", None) or type(objective).__name__)
    return f"own {name}" if name in OBJECTIVE_KINDS else name


def _policy_of(setting: str | Mapping[str, Any]) -> Policy[Any]:
    config = AttackConfig(object="mug", policy=setting)
    return make_policy(config.policy_name, **config.policy_options)


def _scene(scene: Scene | str | Path | Mapping[str, Any], object: str | None, settings: Mapping[str, Any]) -> Scene:
    if isinstance(scene, Scene):
        check_not_of_scene({**settings, "object": object})
        return scene
    config = SceneConfig(**{"object": "mug", **{name: settings[name] for name in OF_SCENE if name in settings}})
    more = told_of_scene(config)
    if object is not None:
        return load_scene(object, config.environment, scene=scene, **more)
    if isinstance(scene, Mapping):
        raise InputError("object: which shape of the scene is it? Give its id")
    return load_scene(scene, config.environment, **more)
