"""`advsearch.attack`: an attack on what a session has: scenes, models, controls, tasks, objectives and policies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from torch import Tensor

from advsearch import losses
from advsearch.api.keywords import Names, SceneKeywords, asks
from advsearch.attacks import Policy, make_policy
from advsearch.attacks.objectives import OBJECTIVE_KINDS
from advsearch.config import SceneConfig
from advsearch.engine import judging, loading, naming
from advsearch.engine.judging import Metric
from advsearch.engine.loading import Controls, Scene
from advsearch.engine.naming import AnyModel, model_name, several
from advsearch.errors import InputError
from advsearch.options import as_setting, told
from advsearch.progress import Watched, watcher
from advsearch.questions.attack.carry_out import (
    AttackParts,
    controls_given,
    is_named,
    models_as_one,
    task_and_objective,
)
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.attack.run import run_attack
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import begun, is_run, run_path
from advsearch.settings import PythonOnly
from advsearch.tasks import AnyTask, OwnTask, Task, make_task

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
    **settings: Unpack[AttackKeywords],
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
    options: dict[str, Any] = {name: value for name, value in settings.items() if value is not None}
    task = make_task(task) if callable(task) else task
    loaded_already = not all(isinstance(network, (str, Path)) for network in (scene, *several(model)))
    own_controls = [*loading.only_here(controls), *loading.only_here(over)]
    if loaded_already or callable(objective) or own_controls or isinstance(task, OwnTask):
        naming.check_not_spread(options)

    def policy_of(setting: Any) -> Policy[Any]:
        asked = AttackConfig(object="mug", policy=setting)
        return make_policy(asked.policy_name, **asked.policy_options)

    if not isinstance(policy, (str, Mapping, Policy)) or not policy:
        raise InputError(
            f"policy: expected a name, a mapping with a `name` and options, or an instance, got {told(policy)}"
        )
    if isinstance(scene, Scene):
        naming.check_not_of_scene({**options, "object": object})
    else:
        of_scene = {name: options[name] for name in naming.OF_SCENE if name in options}
        place = SceneConfig(**{"object": "mug", **of_scene})
        light, more = place.environment, naming.told_of_scene(place)
        if object is not None:
            scene = loading.load_scene(object, light, scene=scene, **more)
        elif isinstance(scene, Mapping):
            raise InputError("object: which shape of the scene is it? Give its id")
        else:
            scene = loading.load_scene(scene, light, **more)
    own_name = str(getattr(objective, "__name__", None) or type(objective).__name__)  # where it is the caller's
    own_name = f"own {own_name}" if own_name in OBJECTIVE_KINDS else own_name  # never as one of ours
    fixed: dict[str, float | str] = scene.description.given_values
    if options.get("exposure"):  # the option says it
        fixed.pop("camera.exposure", None)
    described = {
        **loading.scene_as_settings(scene),
        "model": ",".join(map(model_name, several(model))),
        "controls": loading.settings_of(controls),
        "over": loading.settings_of(over),
        "task": as_setting(task) if isinstance(task, Task) else task,
        "objective": own_name if callable(objective) else objective,
        "policy": as_setting(policy) if isinstance(policy, Policy) else policy,
        "set": fixed,
        "metrics": judging.metrics_as_settings(metrics or {}),
    }
    config = AttackConfig(**{**described, **options, "run": None if run is None else str(run)})
    losses.check_aim(objective, targeted=config.target is not None)
    parts = [PythonOnly("model", model_name(network)) for network in several(model) if naming.exists_here(network)]
    parts += [PythonOnly("scene")] if scene.only_here else []
    parts += [PythonOnly("task", task.name)] if isinstance(task, Task) and not is_named(task, make_task) else []
    parts += [PythonOnly("objective", own_name)] if callable(objective) else []
    parts += (
        [PythonOnly("policy", policy.name)] if isinstance(policy, Policy) and not is_named(policy, policy_of) else []
    )
    parts += [PythonOnly("control", name) for name in own_controls]
    parts += [PythonOnly("metric", name) for name in judging.only_here(config.metrics)]
    if config.workers is not None or config.cluster is not None:
        judging.check_shared(config.metrics)
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
    if not isinstance(policy, Policy):
        policy = make_policy(config.policy_name, **config.policy_options)
    named = config.objective if objective is None or isinstance(objective, str) else objective
    asked, objective = task_and_objective(config, task if isinstance(task, Task) else config.task, named)
    stopped = run_path(run) if resume and run is not None and is_run(run_path(run)) else None
    with begun(config) if run is not None and stopped is None else nullcontext(stopped) as folder:
        loaded = models_as_one(model, config, asked)
        measured = judging.load_metrics(config.metrics, metrics)
        job = AttackParts(config, scene, loaded, asked, searched, drawn, objective, policy, run is not None, measured)
        return run_attack(job, watcher(progress), folder)
