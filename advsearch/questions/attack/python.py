"""`advsearch.attack`: attack scenes and models of a Python session."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from torch import Tensor

from advsearch import losses
from advsearch.api.keywords import (
    Names,
    SceneKeywords,
    with_settings_signature,
)
from advsearch.attacks import Policy, make_policy
from advsearch.attacks.objectives import OBJECTIVE_KINDS
from advsearch.calls import drop_unset
from advsearch.config import SceneConfig
from advsearch.engine import judging, loading, naming
from advsearch.engine.judging import Metric
from advsearch.engine.loading import Controls, Scene
from advsearch.engine.naming import AnyModel, get_model_name, to_model_list
from advsearch.errors import InputError
from advsearch.options import convert_to_setting, describe_value
from advsearch.progress import ProgressOption, as_progress
from advsearch.questions.attack.carry_out import (
    AttackParts,
    is_describable_by_setting,
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

    All other arguments are the settings of `advsearch attack`. The settings
    `environment`, `up`, `set` and `exposure` apply only if `scene` is a name or a file,
    and not if it is a loaded scene.

    Args:
        scene: scene from `load_scene`, or an object's name or file that it takes.
        model: model from `load_model`, or a name, file or module that it takes; with
            `ensemble`, a sequence of several.
        object: the node or shape that is the object, if `scene` is a file or dictionary
            with several.
        task: task that evaluates the model's output: a name, a mapping with a `name`
            and options, an instance, or a function (output, truth) that returns how
            wrong the output is, above 0 if it is wrong (docs/tasks.md).
        controls: what may vary: names, instances, or a mapping from names to settings.
        objective: what is maximised: "margin", "log_odds", "cross_entropy", "dlr",
            "feature_distance", "score", or a function that returns (N,) values. Its
            parameters are (output, images, truth) or (output, labels), with images (N,
            H, W, 3); if there is a target, it takes the place of the truth. In
            classification the output is logits (N, C), and the truth is the index of
            the right label, (N,), or a tuple of several. The function gets more if it
            has parameters with the names `u`, `texture`, `inputs` or `configuration`
            (docs/own-loss.md). None takes the objective of the task.
        policy: a name, a mapping with a `name` and options, or an instance.
        over: controls that vary by chance: the configuration has to hold for all of
            their values.
        metrics: functions by the name of their column in the rows. Each takes (image
            (H, W, 3) sRGB in [0, 1], output for that image, truth: the index of the
            right class), and returns a number or a dict. With `workers`, they have to be
            functions of a module.
        run: directory in which the run is stored; None keeps the result in memory only.
        resume: continue the run in that directory, if there is one, from where it was
            stopped. All other arguments have to be the same as before.
    """
    options = drop_unset(settings)
    if callable(task):  # a function of the caller
        task = make_task(task)
    _check_policy(policy)
    request = AttackRequest(
        model=model,
        task=task,
        controls=controls,
        objective=objective,
        policy=policy,
        over=over,
        metrics=metrics,
        session_controls=_list_session_controls(controls, over),
    )
    request.check_can_use_workers(scene, options)
    scene = _load_scene(scene, object, options)
    config = request.make_checked_config(scene, run, options)

    # The caller's own objects are used. The others are made from the settings.
    searched, random_controls = make_attack_controls(config, controls, over)
    if not isinstance(policy, Policy):
        policy = _make_configured_policy(config)
    loaded_task, objective = request.choose_task_and_objective(config)
    # `directory` is None if nothing is stored, or if another run is overwritten.
    with _open_run(run, resume, config) as directory:
        parts = AttackParts(
            config=config,
            scene=scene,
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
    """Check that a policy is a name, a mapping or an instance.

    Raises:
        InputError: it is none of these, or empty.
    """
    if not isinstance(policy, (str, Mapping, Policy)) or not policy:
        raise InputError(
            "policy: expected a name, a mapping with a `name` and options, or an "
            f"instance, got {describe_value(policy)}"
        )


def _list_session_controls(searched: Controls, random: Controls) -> list[str]:
    """Return the names of the controls that exist in this session only."""
    return [
        *loading.list_session_only_controls(searched),
        *loading.list_session_only_controls(random),
    ]


@dataclass(frozen=True, eq=False)
class AttackRequest:
    """What the caller of `attack` passed: names, settings, or objects of the session.

    Attributes:
        model: model or models.
        task: a name, settings or an instance.
        controls: controls that are searched.
        objective: a name or a function; None for the objective of the task.
        policy: a name, settings or an instance.
        over: controls that vary by chance.
        metrics: functions by name.
        session_controls: names of the controls that exist in this session only.
    """

    model: AnyModel | Sequence[AnyModel]
    task: str | Mapping[str, object] | Task
    controls: Controls
    objective: str | Callable[..., Tensor] | None
    policy: str | Mapping[str, object] | Policy[Any]
    over: Controls
    metrics: Mapping[str, str | Metric] | None
    session_controls: Sequence[str]

    def check_can_use_workers(
        self,
        scene: Scene | str | Path | Mapping[str, object],
        options: Mapping[str, Any],
    ) -> None:
        """Raise an error if workers are requested but cannot load what was passed.

        Workers are other processes. They load everything by its name, and do not have
        the objects of this session.

        Args:
            scene: scene as the caller passed it; names and paths can be loaded.
            options: the settings that the caller passed, perhaps with `workers`.

        Raises:
            InputError: workers are requested, and some object exists in this session
                only.
        """
        objects = [
            value
            for value in (scene, *to_model_list(self.model))
            if not isinstance(value, (str, Path))
        ]
        has_functions = callable(self.objective) or isinstance(self.task, FunctionTask)
        if objects or has_functions or self.session_controls:
            naming.check_no_worker_settings(options)

    def make_checked_config(
        self, scene: Scene, run: str | Path | None, options: dict[str, Any]
    ) -> AttackConfig:
        """Return the settings of a single attack that can be made.

        They have the names of the caller's objects, and state which of these exist in
        this session only.

        Args:
            scene: the loaded scene.
            run: the run directory; None stores nothing.
            options: all other settings, by name.

        Raises:
            InputError: the attack cannot be made, or is several attacks.
        """
        config = self._make_config(scene, run, options)
        losses.check_direction(self.objective, targeted=config.target is not None)
        python_only = self._find_python_only(config, scene)
        config = config.with_python_only_parts(python_only)
        _check_single_attack(config)
        return config

    def _make_config(
        self, scene: Scene, run: str | Path | None, options: dict[str, Any]
    ) -> AttackConfig:
        """Return the settings of an attack, as `run.yaml` states them.

        Objects of the caller, such as a loaded model, are replaced by their names. See
        `make_checked_config` for the arguments.
        """
        described = {**loading.scene_to_settings(scene), **self._to_settings()}
        if options.get("exposure"):  # this setting replaces the exposure of the scene
            described["set"].pop("camera.exposure", None)
        run_path = None if run is None else str(run)
        return AttackConfig(**{**described, **options, "run": run_path})

    def _to_settings(self) -> dict[str, Any]:
        """Return the settings that describe what was passed, without the scene."""
        objective = self.objective
        if callable(objective):
            objective = _name_objective(objective)
        return {
            "model": ",".join(map(get_model_name, to_model_list(self.model))),
            "controls": loading.controls_to_settings(self.controls),
            "over": loading.controls_to_settings(self.over),
            "task": _describe_instance(self.task, Task),
            "objective": objective,
            "policy": _describe_instance(self.policy, Policy),
            "metrics": judging.metrics_to_settings(self.metrics or {}),
        }

    def _find_python_only(self, config: AttackConfig, scene: Scene) -> list[PythonOnly]:
        """Return what exists in this session only, so that no command can repeat it.

        Args:
            config: the settings.
            scene: the loaded scene.
        """
        parts = self._find_session_only_models()
        if scene.is_session_only:
            parts.append(PythonOnly("scene"))
        parts += self._find_undescribable_parts()
        parts += [PythonOnly("control", name) for name in self.session_controls]
        metrics = judging.list_session_only_metrics(config.metrics)
        parts += [PythonOnly("metric", name) for name in metrics]
        return parts

    def _find_session_only_models(self) -> list[PythonOnly]:
        """Return the models that exist in this session only."""
        return [
            PythonOnly("model", get_model_name(network))
            for network in to_model_list(self.model)
            if naming.is_session_only(network)
        ]

    def _find_undescribable_parts(self) -> list[PythonOnly]:
        """Return the task, the objective and the policy that no setting describes."""
        parts = []
        task = self.task
        if isinstance(task, Task) and not is_describable_by_setting(task, make_task):
            parts.append(PythonOnly("task", task.name))
        if callable(self.objective):
            parts.append(PythonOnly("objective", _name_objective(self.objective)))
        policy = self.policy
        if isinstance(policy, Policy) and not is_describable_by_setting(
            policy, _make_policy
        ):
            parts.append(PythonOnly("policy", policy.name))
        return parts

    def choose_task_and_objective(
        self, config: AttackConfig
    ) -> tuple[Task, str | Callable[..., Tensor]]:
        """Return the caller's task and objective, or those that the settings name."""
        return make_task_and_objective(
            config,
            self.task if isinstance(self.task, Task) else config.task,
            self.objective if callable(self.objective) else config.objective,
        )


def _describe_instance(value: Any, kind: type[Any]) -> Any:
    """Return the setting that describes an instance of a class; other values as is."""
    return convert_to_setting(value) if isinstance(value, kind) else value


def _open_run(run: str | Path | None, resume: bool, config: AttackConfig) -> Any:
    """Return a context with the run directory of an attack.

    The context has the path of an existing run that is continued, or of a new one. It
    has None if nothing is stored.

    Args:
        run: name or directory of the run; None stores nothing.
        resume: whether the run is continued if it exists.
        config: the settings, which have the name of the run, too.
    """
    if run is None:
        return nullcontext(None)
    if resume and is_run(locate_run(run)):
        return nullcontext(locate_run(run))
    return create_before_work(config)


def _load_scene(
    scene: Scene | str | Path | Mapping[str, object],
    shape: str | None,
    options: Mapping[str, Any],
) -> Scene:
    """Return a scene, loaded with the options that belong to it.

    Args:
        scene: a loaded scene, the name of an object, a file, or a dictionary of Mitsuba.
        shape: id of the shape that is the object, if the scene has several.
        options: the settings that the caller passed; those of the scene are used.
    """
    if isinstance(scene, Scene):
        naming.check_no_scene_settings({**options, "object": shape})
        return scene
    environment, keywords = _make_loading_keywords(options)
    # The first argument of `load_scene` is the object: one shape of a scene with several
    # shapes, or the name or file that `scene` is.
    if shape is not None:
        return loading.load_scene(shape, environment, scene=scene, **keywords)
    if isinstance(scene, Mapping):
        raise InputError("object: which shape of the scene is it? Give its id")
    return loading.load_scene(scene, environment, **keywords)


def _make_loading_keywords(
    options: Mapping[str, Any],
) -> tuple[str | None, dict[str, Any]]:
    """Return the environment and the other keywords with which a scene is loaded.

    Args:
        options: the settings that the caller passed; those of the scene are used.
    """
    scene_options = {
        name: options[name] for name in naming.SCENE_SETTINGS if name in options
    }
    # The setting `object` is required, but only the other settings are used.
    config = SceneConfig(**{"object": "mug", **scene_options})
    return config.environment, naming.make_scene_kwargs(config)


def _name_objective(objective: Callable[..., Tensor]) -> str:
    """Return a name for an objective of the caller.

    It is that of the function, or of the class of an instance that can be called. If
    this is also the name of a built-in objective, "own" is put before it.
    """
    name = str(getattr(objective, "__name__", None) or type(objective).__name__)
    return f"own {name}" if name in OBJECTIVE_KINDS else name


def _make_policy(setting: Any) -> Policy[Any]:
    """Make the policy that a setting names."""
    # The setting `object` is required, but only the policy is used.
    return _make_configured_policy(AttackConfig(object="mug", policy=setting))


def _make_configured_policy(config: AttackConfig) -> Policy[Any]:
    """Make the policy that settings name, with its options."""
    return make_policy(config.policy_name, **config.policy_options)


def _check_single_attack(config: AttackConfig) -> None:
    """Check that the settings describe a single attack, which can be made.

    Raises:
        InputError: they describe several attacks; or they request workers, which cannot
            load one of the metrics; or they request image layers (`aov`), but no run
            directory in which these are saved.
    """
    if config.workers is not None or config.cluster is not None:
        judging.check_metrics_importable(config.metrics)
    _check_not_study(config)
    if config.aov is not None and config.run is None:
        raise InputError("aov: needs `run`, the directory that the layers are saved in")


def _check_not_study(config: AttackConfig) -> None:
    """Raise an error if the settings describe attacks on several models or epsilons."""
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
