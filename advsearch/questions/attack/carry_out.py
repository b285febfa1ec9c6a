"""`attack`: the worst configuration of a scene inside a budget, searched for and verified, beside a random search."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor

from advsearch import losses
from advsearch.api.keywords import asks
from advsearch.attacks import Policy, make_policy
from advsearch.attacks.objectives import OBJECTIVE_KINDS
from advsearch.attacks.policies import WithoutAscent
from advsearch.cluster import Call
from advsearch.config import SceneConfig
from advsearch.controls.values import sentences
from advsearch.engine.journal import Journal, Shared, check_made_of, worker_call
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
from advsearch.engine.problem import Problem
from advsearch.engine.record import Stages
from advsearch.engine.transport import CleanMatrix
from advsearch.errors import InputError
from advsearch.files import JsonObject
from advsearch.models import Model
from advsearch.models.address import Asked
from advsearch.options import as_setting, told
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.attack.ambient import problems_by_name
from advsearch.questions.attack.outcome import summarise
from advsearch.questions.attack.parts import (
    LOADING,
    AttackParts,
    controls_given,
    executor_for,
    is_named,
    models_as_one,
    parts_given,
    parts_of,
    problem_on,
    task_and_objective,
    with_derivatives,
)
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.stages import Attack
from advsearch.report.wording import count
from advsearch.runs.directory import RunDirectory, begun, check_free, is_run, run_path
from advsearch.tasks import AnyTask, OwnTask, Task, function_of, make_task

PREPARING = "preparing the scene for rendering"
"""What a person who waits is told before the first picture."""


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
    described = {
        **scene_as_settings(scene),
        "model": ",".join(map(model_name, several(model))),
        "controls": settings_of(controls),
        "over": settings_of(over),
        "task": as_setting(task) if isinstance(task, Task) else task,
        "objective": _own_name(objective) if callable(objective) else objective,
        "policy": as_setting(policy) if isinstance(policy, Policy) else policy,
        "set": _set_by(scene, settings.get("exposure")),
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
        listed = ", ".join(f"{one:g}" for one in config.epsilons)
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
        return _carry_out(job, watcher(progress), folder)


def attack_once(
    config: AttackConfig,
    *,
    progress: Progress | None = None,
    resumed: Path | None = None,
    clean: CleanMatrix | None = None,
) -> AttackResult:
    """Attack one object with one epsilon, in a run directory; otherwise as `attack`.

    `clean` is shared with attacks whose configurations differ in epsilon alone.
    """
    if config.run is not None and resumed is None:
        check_free(config.run, overwrite=config.overwrite)
    progress = progress or NullProgress()
    progress.stage(LOADING)
    job = replace(parts_of(config), clean=clean or CleanMatrix())
    return _carry_out(job, progress, resumed)


def attack_on(config: AttackConfig, scene: Scene, model: Model) -> AttackResult:
    """Attack a model on a scene that are there, in place of those that the configuration names; nothing is kept.

    Raises:
        InputError: as for `attack`.
    """
    return _carry_out(parts_given(config, scene, model), NullProgress())


def _own_name(objective: Callable[..., Tensor]) -> str:
    """What an objective of the caller's is called; never as one of ours."""
    name = str(getattr(objective, "__name__", None) or type(objective).__name__)
    return f"own {name}" if name in OBJECTIVE_KINDS else name


def _policy_of(setting: str | Mapping[str, Any]) -> Policy[Any]:
    config = AttackConfig(object="mug", policy=setting)
    return make_policy(config.policy_name, **config.policy_options)


def _scene(scene: Scene | str | Path | Mapping[str, Any], object: str | None, settings: Mapping[str, Any]) -> Scene:
    """The scene as it was given, or the one that a name and the settings describe."""
    if isinstance(scene, Scene):
        check_not_of_scene({**settings, "object": object})
        return scene
    said = SceneConfig(**{"object": "mug", **{name: one for name, one in settings.items() if name in OF_SCENE}})
    given = told_of_scene(said)
    if object is not None:
        return load_scene(object, said.environment, scene=scene, **given)
    if isinstance(scene, Mapping):
        raise InputError("object: which shape of the scene is it? Give its id")
    return load_scene(scene, said.environment, **given)


def _set_by(scene: Scene, exposure: float | None) -> dict[str, float | str]:
    """The parameters of the scene that were fixed, but for the exposure where an option says it."""
    fixed = scene.description.given_values
    if exposure:
        fixed.pop("camera.exposure", None)
    return fixed


def _carry_out(job: AttackParts, progress: Progress, resumed: str | Path | None = None) -> AttackResult:
    """Do it all, or what is left of a run, in a run directory if it is kept."""
    with ExitStack() as stack:
        kept = None if resumed is None else stack.enter_context(RunDirectory.of(job.config, resumed))
        stages = Stages(progress)
        stages.begin("setup", PREPARING)
        problem = problem_on(job)
        warnings = [*problem.space.notes(job.scene.description), *job.loaded[1], *sentences(problem.space.moved)]
        for text in warnings:
            progress.message(text)
        policy = _policy(job, problem)
        if kept is None and job.keep:
            kept = stack.enter_context(RunDirectory.of(job.config))
        if kept is not None:
            functions = {f"metric {name}": one for name, one in job.metrics.items()}
            objective = {"objective": job.objective} if callable(job.objective) else {}
            check_made_of(kept, [job.loaded[0]], {**functions, **objective, "task": function_of(job.task)})
        with executor_for(job.config, "advsearch.questions.attack.carry_out:attack_worker", progress) as executor:
            journal = Journal(kept, Shared(problem, executor))
            if problem.conditions is not None and None in (job.config.steps, job.config.draws):
                progress.message(
                    f"One configuration for many conditions: {count(problem.steps, 'step')}, each over "
                    f"{count(problem.draws, 'condition')}; `steps` and `draws` change that."
                )
            findings = Attack(journal, job.config, policy, stages, clean=job.clean).carry_out()
        if isinstance(problem.model.module, Asked):
            warnings.append(problem.model.module.line.sentence)
        named = job.objective if isinstance(job.objective, str) else job.config.objective
        result = summarise(job.config, named, findings, journal, stages, warnings)
        parts = replace(job, clean=CleanMatrix())  # without the matrix of light transport, which may be large
        return replace(result, parts=lambda: parts)


def attack_worker(settings: JsonObject) -> Call:
    """Return what evaluates the queries of the attack that the settings describe: what a worker does."""
    problem = problem_on(parts_of(AttackConfig(**settings)))
    return worker_call(problems_by_name(problem))


def _policy(job: AttackParts, problem: Problem) -> Policy[Any]:
    """The policy. Where a model lets no gradient through, `auto` climbs by differences of whole pictures. A model
    behind an address has none, so that `auto` climbs nowhere else, and others that climb are refused."""
    balls = all(block.norm != "box" for block in problem.domain.blocks)
    name = job.policy if isinstance(job.policy, str) else job.policy.name
    if isinstance(problem.model.module, Asked):
        if name == "auto":
            boxes = all(block.norm == "box" for block in problem.domain.blocks)
            return with_derivatives(WithoutAscent() if boxes else make_policy("nes"), job.config)
        policy = make_policy(job.policy, **job.config.policy_options) if isinstance(job.policy, str) else job.policy
        if policy.uses_gradient:
            raise InputError(
                f"policy: {name} follows the model's gradient, and {problem.model.name}, behind an address, has none; "
                "use auto, cmaes, nes, random, sobol or grid"
            )
    if name == "auto" and balls and not problem.model.differentiable:
        return make_policy("nes")
    if not isinstance(job.policy, str):
        return with_derivatives(job.policy, job.config)
    return with_derivatives(make_policy(job.policy, **job.config.policy_options), job.config)
