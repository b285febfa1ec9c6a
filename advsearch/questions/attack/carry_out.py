"""`attack`: the worst configuration of a scene inside a budget, searched for and verified, beside a random search.

What a configuration names is found and loaded, and makes a problem: everything that renders and judges single
configurations begins with `problem_from_config` or `problem_of`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from advsearch import losses, seeds
from advsearch.api.keywords import asks
from advsearch.attacks import Policy, make_policy
from advsearch.attacks.objectives import OBJECTIVE_KINDS, asked_by, check_objective
from advsearch.attacks.policies import POLICIES, WithoutAscent
from advsearch.cluster import Call, Workers, WorkerTask
from advsearch.cluster.workers import open_workers
from advsearch.config import SceneConfig, has_address, one_only
from advsearch.controls import make_space
from advsearch.controls.base import Control, sentences
from advsearch.controls.ranges import by_distribution
from advsearch.engine import judging, loading, naming
from advsearch.engine.journal import Journal, Shared, check_made_of, worker_call
from advsearch.engine.judging import AnyObjective, Described, Looked, Metric, Metrics
from advsearch.engine.loading import SCENE, Controls, Scene, framed
from advsearch.engine.naming import AnyModel, load_models, model_name, several
from advsearch.engine.problem import Problem
from advsearch.engine.transport import CleanMatrix, refusal_of_matrices
from advsearch.errors import InputError
from advsearch.files import JsonObject
from advsearch.models import Model, RemoteNetwork
from advsearch.options import as_setting, told
from advsearch.progress import NullProgress, Progress, Stages, Watched, watcher
from advsearch.questions.attack import settings as numbers
from advsearch.questions.attack.ambient import problems_by_key
from advsearch.questions.attack.outcome import summarise
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.stages import Attack
from advsearch.report.wording import count
from advsearch.runs.directory import CONFIG, RunDirectory, begun, check_free, is_run, read_python_only, run_path
from advsearch.scene.formation import EVERYTHING, NOTHING, aovs_of, next_count
from advsearch.scene.things import ALL
from advsearch.settings import FILES, PythonOnly
from advsearch.tasks import AnyTask, Facts, OwnTask, Task, function_of, make_task
from advsearch.tasks.together import Together, each_thing, together

LOADING, PREPARING = "loading the scene and the model", "preparing the scene for rendering"
"""What a person who waits is told before the first picture."""
ROLES_IN_SEARCH = frozenset({"objective", "policy", "metric"})
"""Roles of parts that decide how a scene was found, and not whether its result is right."""


def attack_once(
    config: AttackConfig, *, progress: Progress | None = None, resumed: Path | None = None,
    clean: CleanMatrix | None = None,
) -> AttackResult:  # fmt: skip
    """Attack one object with one epsilon, in a run directory; otherwise as `attack`.

    `clean` is shared with attacks whose configurations differ in epsilon alone.
    """
    if config.run is not None and resumed is None:
        check_free(config.run, overwrite=config.overwrite)
    progress = progress or NullProgress()
    progress.stage(LOADING)
    job = parts_of(config)
    job.clean = clean or job.clean
    return carry_out(job, progress, resumed)


def attack_on(config: AttackConfig, scene: Scene, model: Model) -> AttackResult:
    return carry_out(parts_of(config, scene, model), NullProgress())


def carry_out(job: AttackParts, progress: Progress, resumed: str | Path | None = None) -> AttackResult:
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
            functions = {f"metric {name}": metric for name, metric in job.metrics.items()}
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
        if isinstance(problem.model.module, RemoteNetwork):
            warnings.append(problem.model.module.sentence)
        named = job.objective if isinstance(job.objective, str) else job.config.objective
        result = summarise(job.config, named, findings, journal, stages, warnings)
        parts = replace(job, clean=CleanMatrix())  # without the matrix of light transport, which may be large
        return replace(result, parts=lambda: parts)


def attack_worker(settings: JsonObject) -> Call:
    """Return what evaluates the queries of the attack that the settings describe: what a worker does."""
    problem = problem_on(parts_of(AttackConfig(**settings)))
    return worker_call(problems_by_key(problem))


def _policy(job: AttackParts, problem: Problem) -> Policy[Any]:
    """Where a model lets no gradient through, `auto` climbs by differences; behind an address it climbs nowhere."""
    config, norms = job.config, {block.norm for block in problem.domain.blocks}
    policy = make_policy(job.policy, **config.policy_options) if isinstance(job.policy, str) else job.policy
    if isinstance(problem.model.module, RemoteNetwork):
        if policy.name == "auto":
            policy = WithoutAscent() if norms == {"box"} else make_policy("nes")
        elif policy.uses_gradient:
            raise InputError(
                f"policy: {policy.name} follows the model's gradient, and {problem.model.name}, behind an address, has "
                "none; use auto, cmaes, nes, random, sobol or grid"
            )
    elif policy.name == "auto" and "box" not in norms and not problem.model.differentiable:
        return make_policy("nes")
    asked = "estimators" if config.estimators else "measure" if config.measure == "full" else None
    if asked and not policy.uses_gradient:
        raise InputError(f"{asked}: policy {policy.name} takes no derivatives; leave one of the two out")
    return policy


@dataclass
class AttackParts:
    """Everything that was asked for, found and loaded: the model and what was said of it, a task that is not yet on the
    model, the controls that are searched and those `over` that vary by chance; objective and policy may be the caller's
    own. Attacks may share `clean`, the matrix of light transport of the clean scene. A run is kept in a folder, or
    (`keep`) not."""

    config: AttackConfig
    scene: Scene
    loaded: tuple[Model, list[str]]
    task: Task
    controls: tuple[Any, ...]
    over: tuple[Any, ...]
    objective: str | Callable[..., Tensor]
    policy: str | Policy[Any]
    keep: bool
    metrics: Metrics = field(default_factory=dict)
    clean: CleanMatrix = field(default_factory=CleanMatrix)


def parts_of(config: AttackConfig, scene: Scene | None = None, model: Model | None = None) -> AttackParts:
    """Find and load everything that a configuration names, or all but a scene and a model, with which nothing is kept;
    nothing is rendered."""
    if scene is None and len(config.objects) > 1:
        raise one_only("object", config.objects)
    searched, drawn = controls_given(config, config.controls, config.over)
    task, objective = task_and_objective(config, config.task, config.objective)
    policy, keep = make_policy(config.policy_name, **config.policy_options), scene is None or model is None
    scene = scene or loading.lent(SCENE, config.object) or naming.scene_of(config)
    loaded = models_as_one(config.model, config, task) if model is None else (model, [])
    metrics = judging.load_metrics(config.metrics) if keep else {}
    return AttackParts(config, scene, loaded, task, searched, drawn, objective, policy, keep, metrics)


def parts_in(run: Path) -> AttackParts:
    """Find and load everything that the run of an attack was asked with, as its result is judged."""
    if needed := [part.text for part in read_python_only(run) if part.role not in ROLES_IN_SEARCH]:
        raise InputError(f"{run}: {', '.join(needed)}: only the Python session that asked has what judges its result")
    return parts_of(judged_alone(AttackConfig.from_yaml(run / CONFIG)))


def controls_given(
    config: AttackConfig, searched: Controls, drawn: Controls
) -> tuple[tuple[Control, ...], tuple[Control, ...]]:
    """The controls that are searched and those that vary by chance, with the run's settings; only a search has a
    budget."""
    naming.check_run_settings(config)
    controls = naming.given_to(config, searched)
    for control in controls:
        for name, spec in getattr(control, "specs", {}).items():
            if by_distribution(spec):
                raise InputError(
                    f"`controls` {control.name}.{name}: expected values to search, which are all as good, got how "
                    "likely each is; give a range, or put it into `over`, under which it varies by chance"
                )
    return controls, naming.given_to(config.model_copy(update={"epsilon": None}), drawn)


def task_and_objective(
    config: AttackConfig, task: AnyTask, objective: AnyObjective | None
) -> tuple[Task, AnyObjective]:
    made = make_task(task)
    wanted = made.objective if objective is None else objective
    check_objective(wanted, made.name, targeted=config.target is not None, minimise=config.minimise)
    return made, wanted


def models_as_one(model: AnyModel | Sequence[AnyModel], config: AttackConfig, task: Task) -> tuple[Model, list[str]]:
    models, warnings = load_models(several(model), task, config)
    return models[0] if len(models) == 1 else together(models, config.resolution), warnings


def check_from_config(config: AttackConfig) -> None:
    """Refuse what a configuration names that is not there, contradicts itself, or could not be judged; nothing is
    rendered."""
    job = parts_of(config)
    _task(job, shows=False)
    size = config.resolution or job.loaded[0].input_size
    make_space((*job.controls, *job.over), framed(job.scene.description, size))


def problem_from_config(config: SceneConfig, *, denoise: str | None = None) -> tuple[Problem, list[str]]:
    """Load what a configuration describes without searching: the problem, and warnings on the way."""
    return problem_of_parts(parts_of(AttackConfig.of(config, denoise=denoise or config.denoise)))


def problem_of_parts(parts: AttackParts, **changes: object) -> tuple[Problem, list[str]]:
    """Return the problem that an attack was asked with, other settings in `changes` (of another `model`, its name), and
    warnings on the way."""
    config, (model, warnings) = parts.config.model_copy(update=changes), parts.loaded
    loaded = models_as_one(config.model, config, parts.task) if "model" in changes else (model, [*warnings])
    problem = problem_on(replace(parts, config=config, loaded=loaded))
    return problem, [*loaded[1], *sentences(problem.space.moved)]


def problem_of(config: AttackConfig, scene: Scene, model: Model, *, differentiated: bool = True) -> Problem:
    """Return the problem of a configuration on a scene and a model that are there, in place of those that it names."""
    return problem_on(parts_of(config, scene, model), differentiated=differentiated)


def problem_on(job: AttackParts, *, differentiated: bool = True) -> Problem:
    config, (model, warnings) = job.config, job.loaded
    task, facts = _task(job)
    resolution = config.resolution or model.input_size
    description = framed(job.scene.description, resolution)
    space = make_space((*job.controls, *job.over), description)
    renderer = loading.make_renderer(
        description, space, resolution, config.denoise, config.seed, config.estimators,
        leave_out=EVERYTHING if config.specialise else NOTHING, sampler=config.pixel_sampler,
        differentiated=differentiated,
    )  # fmt: skip
    features_seed = seeds.stream(config.seed, "clean features")
    objective, note = judging.objective_for(job.objective, task, model, renderer, features_seed, config.ensemble)
    warnings += [note] if note else []
    if config.printable:
        searched = make_space(job.controls, description)
        judging.print_terms(searched, searched.start)  # refuses where nothing can be printed
    spp = next_count(config.pixel_sampler, config.search_spp)
    problem = Problem(
        renderer, space, model, task, facts, objective, spp, config.seed, searched=len(job.controls),
        aovs=aovs_of(config.aov), metrics=job.metrics,
    )  # fmt: skip
    for name in asked_by(job.objective):
        problem.asked(problem.whole(problem.domain.start))(name)  # refuses what is not there
    problem.steps, problem.draws = search_size(config, problem)
    return problem


def _task(job: AttackParts, *, shows: bool = True) -> tuple[Task, Callable[[Described, Looked], Facts]]:
    """The task on the model, which with `shows` sees a clean picture where it asks for one, and what gives it facts."""
    config, (model, warnings) = job.config, job.loaded
    asked = job.task.seeking(job.objective) if isinstance(job.objective, str) else job.task
    task = judging.task_for(asked, model).on(model, target=config.target, minimise=config.minimise)
    facts = partial(judging.facts_of, job.scene, config.object, config)
    several = task if isinstance(task, Together) else None
    tasks = list[Task]()
    for part, network in zip(several.tasks, several.models, strict=True) if several else [(task, model)]:
        known = several.told(part, facts(dict)) if several else facts(dict)
        judging.check_truth(part, network, job.scene, known, config)
        tasks.append(judging.shown(part, network, [job.scene], config) if shows else part)
        warnings += [remark for remark in tasks[-1].remarks if remark not in warnings]
    task = replace(several, tasks=tuple(tasks)) if several else tasks[0]
    return each_thing(task) if config.judge == ALL else task, facts


def search_size(config: AttackConfig, problem: Problem) -> tuple[int, int]:
    if problem.conditions is None:
        return config.steps or numbers.STEPS, 1
    usual = numbers.OVER_ONE if problem.conditions.dim == 1 else numbers.OVER_PREDICTED
    if refusal_of_matrices(problem, config.steps or usual[0], config.specialise) is not None:  # they are rendered
        boxes = all(block.norm == "box" for block in problem.domain.blocks)
        usual = numbers.OVER_NUMBERS if boxes else numbers.OVER_RENDERED
    steps, draws = usual
    return config.steps or steps, config.draws or draws


def is_named(entry: Task | Policy[Any], make: Callable[[Any], object]) -> bool:
    try:
        return bool(make(as_setting(entry)) == entry)
    except InputError:
        return False


def judged_alone(config: AttackConfig) -> AttackConfig:
    """Return what the adversarial scene of a run is judged with: what counts as success needs no metric, and neither an
    objective nor a policy that only the session had which searched with them."""
    change: dict[str, object] = {"metrics": {}}
    if config.objective is not None and config.objective not in OBJECTIVE_KINDS:
        change["objective"] = None
    if config.policy_name not in POLICIES:
        change["policy"] = AttackConfig.model_fields["policy"].default
    return config.model_copy(update=change)


def executor_for(config: SceneConfig, function: str, progress: Progress) -> AbstractContextManager[Workers | None]:
    """Return what carries out a function of a configuration, as its workers and cluster say; None for this process."""
    settings = config.to_repeat().model_copy(update={"workers": None, "cluster": None}).plain()
    work = WorkerTask(function, settings, FILES, config.used_threads or 1)
    workers, cluster = (getattr(config, name, None) for name in ("workers", "cluster"))
    if (workers or cluster) and has_address(config.model):
        raise InputError(
            f"{'workers' if workers else 'cluster'}: a model behind an address is asked by one process, which counts "
            "its calls; leave it out"
        )
    return open_workers(work, workers=workers, cluster=cluster, tell=progress.message)


# ---------------------------------------------------------------------------------------------------------------------
# `advsearch.attack`: an attack on what a session has, scenes, models, controls, tasks, objectives and policies.


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
        naming.check_not_of_scene({**settings, "object": object})
    else:
        of_scene = {name: settings[name] for name in naming.OF_SCENE if name in settings}
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
    if settings.get("exposure"):  # the option says it
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
    policy = policy if isinstance(policy, Policy) else config.policy_name
    named = config.objective if objective is None or isinstance(objective, str) else objective
    asked, objective = task_and_objective(config, task if isinstance(task, Task) else config.task, named)
    stopped = run_path(run) if resume and run is not None and is_run(run_path(run)) else None
    with begun(config) if run is not None and stopped is None else nullcontext(stopped) as folder:
        loaded = models_as_one(model, config, asked)
        measured = judging.load_metrics(config.metrics, metrics)
        job = AttackParts(config, scene, loaded, asked, searched, drawn, objective, policy, run is not None, measured)
        return carry_out(job, watcher(progress), folder)
