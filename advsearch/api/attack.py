"""`attack`: the worst configuration of a scene inside a budget, searched for and verified, beside a random search."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from advsearch import losses, seeds
from advsearch.api.keywords import AttackKeywords, asks
from advsearch.attacks import Policy, make_policy
from advsearch.attacks.objectives import OBJECTIVE_KINDS, asked_by, check_objective
from advsearch.attacks.policies import POLICIES
from advsearch.cluster.executor import Call, Executor, Work
from advsearch.cluster.opening import executor_of
from advsearch.config import AttackConfig, SceneConfig
from advsearch.config.attack import OVER_NUMBERS, OVER_ONE, OVER_PREDICTED, OVER_RENDERED, STEPS
from advsearch.config.scene import one_only
from advsearch.controls import Space, make_space
from advsearch.controls.base import Control
from advsearch.controls.clean import sentences
from advsearch.engine import run_settings
from advsearch.engine.answers import Described, Looked, check_truth, facts_of, shown
from advsearch.engine.attack_result import AttackParts, AttackResult
from advsearch.engine.going_on import check_made_of
from advsearch.engine.journal import Journal
from advsearch.engine.loading import (
    SCENE,
    Controls,
    Scene,
    framed,
    lent,
    load_scene,
    make_renderer,
    only_here,
    scene_as_settings,
    settings_of,
)
from advsearch.engine.metrics import Metric, Metrics, check_shared, load_metrics, metrics_as_settings
from advsearch.engine.metrics import only_here as metrics_only_here
from advsearch.engine.naming import (
    OF_SCENE,
    AnyModel,
    check_not_of_scene,
    check_not_spread,
    exists_here,
    load_models,
    model_name,
    scene_of,
    scene_settings,
    several,
)
from advsearch.engine.objective import AnyObjective, objective_for, task_for
from advsearch.engine.outcome import summarise
from advsearch.engine.print_terms import print_terms
from advsearch.engine.problem import Problem
from advsearch.engine.record import Stages
from advsearch.engine.sharing import Shared, answering
from advsearch.engine.stages import Attack
from advsearch.engine.transport import CleanMatrix, reason_against
from advsearch.errors import InputError
from advsearch.files import JsonObject
from advsearch.models import Model
from advsearch.models.ensemble import together
from advsearch.options import as_setting, told
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.report.wording import count
from advsearch.runs.directory import CONFIG, RunDirectory, begun, check_free, is_run, run_path
from advsearch.runs.directory import only_here as only_python_has
from advsearch.runs.results.gap import CurveResult
from advsearch.runs.results.matrix import MatrixResult
from advsearch.scene.description import SceneDescription
from advsearch.scene.formation import next_count
from advsearch.scene.leaving_out import EVERYTHING, NOTHING
from advsearch.scene.surfaces import aovs_of
from advsearch.settings import FILES
from advsearch.tasks import AnyTask, Facts, Task, make_task
from advsearch.tasks.own import OwnTask, function_of
from advsearch.tasks.together import Together

if TYPE_CHECKING:
    from typing_extensions import Unpack

LOADING, PREPARING = "loading the scene and the model", "preparing the scene for rendering"
"""What a person who waits is told before the first picture."""


@asks(AttackConfig, AttackKeywords)
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
            right answer, (N,), or a tuple of several. It may ask for more by the names of further parameters: `u`,
            `texture`, `inputs`, `configuration` (docs/own-loss.md). None takes the task's own.
        policy: a name, a mapping with a `name` and options, or an instance.
        over: controls that vary by chance: the answer has to hold for all of their values.
        metrics: columns of the rows, by name: functions of (image (H, W, 3) sRGB in [0, 1], output of that picture,
            truth: the index of the right class) that return a number or a dict. `workers` need functions of a module.
        run: folder to keep the run in; None keeps it in memory only.
        resume: go on with the run of that name, if there is one, where it was stopped; everything else has to be as it
            was.
        progress: True shows a bar, False none, None one on a terminal; or told how far it is.

    Raises:
        InputError: anything that the caller can put right; nothing is written then.
    """
    options = {name: value for name, value in settings.items() if value is not None}
    task = make_task(task) if callable(task) else task
    loaded_already = not all(isinstance(one, (str, Path)) for one in (scene, *several(model)))
    if loaded_already or callable(objective) or only_here(controls) or only_here(over) or isinstance(task, OwnTask):
        check_not_spread(options)
    if not isinstance(policy, (str, Mapping, Policy)):
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
    parts = [f"the model {model_name(one)}" for one in several(model) if exists_here(one)]
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
    searched, drawn = _controls(config, controls, over)
    policy = policy if isinstance(policy, Policy) else config.policy_name
    named = config.objective if objective is None or isinstance(objective, str) else objective
    asked, objective = _asked(config, task if isinstance(task, Task) else config.task, named)
    stopped = run_path(run) if resume and run is not None and is_run(run_path(run)) else None
    with begun(config) if run is not None and stopped is None else nullcontext(stopped) as folder:
        loaded = _model(model, config, asked)
        measured = load_metrics(config.metrics, metrics)
        job = _Job(config, scene, loaded, asked, searched, drawn, objective, policy, run is not None, measured)
        if folder is None:
            return _carry_out(job, watcher(progress))
        return _go_on(job, folder, watcher(progress))


def attack_from_config(
    config: AttackConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> AttackResult | CurveResult | MatrixResult:
    """Do what a configuration describes: one attack, a curve or a matrix of several; see `attack`.

    Args:
        config: what.
        progress: told how far it is.
        resumed: the folder of a run to go on with: what was evaluated is not rendered again.

    Raises:
        InputError: anything that the caller can put right; nothing is written then.
    """
    if config.is_matrix:
        from advsearch.api.gap import matrix_from_config

        return matrix_from_config(config, progress=progress, resumed=resumed)
    if config.is_curve:
        from advsearch.api.gap import curve_from_config

        return curve_from_config(config, progress=progress, resumed=resumed)
    return attack_once(config, progress=progress, resumed=resumed)


def attack_once(
    config: AttackConfig,
    *,
    progress: Progress | None = None,
    resumed: Path | None = None,
    clean: CleanMatrix | None = None,
) -> AttackResult:
    """Attack one object with one epsilon, in a run directory; arguments and errors as for `attack_from_config`.

    `clean` is shared with attacks whose configurations differ in epsilon alone.
    """
    if config.run is not None and resumed is None:
        check_free(config.run, overwrite=config.overwrite)
    progress = progress or NullProgress()
    progress.stage(LOADING)
    job = replace(_job(config), clean=clean or CleanMatrix())
    return _carry_out(job, progress) if resumed is None else _go_on(job, resumed, progress)


def problem_from_config(config: SceneConfig, *, denoise: str | None = None) -> tuple[Problem, list[str]]:
    """Load what a configuration describes without searching: the problem, and warnings on the way.

    Args:
        config: what.
        denoise: another denoiser than the configuration's.
    """
    job = _job(AttackConfig.of(config, denoise=denoise or config.denoise))
    problem = _problem(job)
    return problem, [*job.loaded[1], *sentences(problem.space.moved)]


def parts_of(config: AttackConfig) -> AttackParts:
    """Find and load everything that a configuration names; nothing is rendered.

    Raises:
        InputError: as for `attack_from_config`.
    """
    return _job(config)


def parts_in(run: Path) -> AttackParts:
    """Find and load everything that the run of an attack was asked with, as its answer is judged.

    Raises:
        InputError: only the Python session that asked has what judges it.
    """
    if needed := [one for one in only_python_has(run) if not one.startswith(SEARCHED_WITH)]:
        raise InputError(f"{run}: {', '.join(needed)}: only the Python session that asked has what judges its answer")
    return _job(judged_alone(AttackConfig.from_yaml(run / CONFIG)))


def problem_of_parts(parts: AttackParts, **changes: object) -> tuple[Problem, list[str]]:
    """Return the problem that an attack was asked with, and warnings on the way.

    Args:
        parts: as a result has them.
        **changes: settings that are different; of another `model`, its name.
    """
    assert isinstance(parts, _Job)
    config = parts.config.model_copy(update=changes)
    model = _model(config.model, config, parts.task) if "model" in changes else (parts.loaded[0], [*parts.loaded[1]])
    job = replace(parts, config=config, loaded=model)
    problem = _problem(job)
    return problem, [*job.loaded[1], *sentences(problem.space.moved)]


def problem_of(config: AttackConfig, scene: Scene, model: Model, *, differentiated: bool = True) -> Problem:
    """Return the problem of a configuration on a scene and a model that are there, in place of those that it names.

    Args:
        config: what is asked for.
        scene: a loaded one.
        model: a loaded one.
        differentiated: whether outlines may be; see `make_renderer`.

    Raises:
        InputError: as for `attack_from_config`.
    """
    return _problem(_given(config, scene, model), differentiated=differentiated)


def attack_on(config: AttackConfig, scene: Scene, model: Model) -> AttackResult:
    """Attack a model on a scene that are there, in place of those that the configuration names; nothing is kept.

    Raises:
        InputError: as for `attack_from_config`.
    """
    return _carry_out(_given(config, scene, model), NullProgress())


def _own_name(objective: Callable[..., Tensor]) -> str:
    """What an objective of the caller's is called; never as one of ours."""
    name = str(getattr(objective, "__name__", None) or type(objective).__name__)
    return f"own {name}" if name in OBJECTIVE_KINDS else name


def _policy_of(setting: str | Mapping[str, Any]) -> Policy[Any]:
    config = AttackConfig(object="mug", policy=setting)
    return make_policy(config.policy_name, **config.policy_options)


def is_named(entry: Task | Policy[Any], make: Callable[[Any], object]) -> bool:
    """Whether a file can name a task or a policy, with all of its options."""
    try:
        return bool(make(as_setting(entry)) == entry)
    except InputError:
        return False


SEARCHED_WITH = ("the objective", "the policy", "the metric")
"""How the parts of a run begin that say nothing of whether its answer is right."""


def judged_alone(config: AttackConfig) -> AttackConfig:
    """Return what an answer of a run is judged with: what counts as success needs no metric, and neither an objective
    nor a policy that only the session had which searched with them."""
    change: dict[str, object] = {"metrics": {}}
    if config.objective is not None and config.objective not in OBJECTIVE_KINDS:
        change["objective"] = None
    if config.policy_name not in POLICIES:
        change["policy"] = AttackConfig.model_fields["policy"].default
    return config.model_copy(update=change)


def _scene(scene: Scene | str | Path | Mapping[str, Any], object: str | None, settings: AttackKeywords) -> Scene:
    """The scene as it was given, or the one that a name and the settings describe."""
    if isinstance(scene, Scene):
        check_not_of_scene({**settings, "object": object})
        return scene
    said = SceneConfig(**{"object": "mug", **{name: one for name, one in settings.items() if name in OF_SCENE}})
    given = scene_settings(said)
    if object is not None:
        return load_scene(object, said.environment, scene=scene, up=said.up, settings=given, camera=said.camera)
    if isinstance(scene, Mapping):
        raise InputError("object: which shape of the scene is it? Give its id")
    return load_scene(scene, said.environment, up=said.up, settings=given, camera=said.camera)


def _set_by(scene: Scene, exposure: float | None) -> dict[str, float | str]:
    """The parameters of the scene that were fixed, but for the exposure where an option says it."""
    fixed = scene.description.given_values
    if exposure:
        fixed.pop("camera.exposure", None)
    return fixed


# ---- from names to things -------------------------------------------------------------------------------------------


@dataclass
class _Job:
    """Everything that was asked for, found and loaded."""

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


def _job(config: AttackConfig) -> _Job:
    """Find and load everything that a configuration names."""
    if len(config.objects) > 1:
        raise one_only("object", config.objects)
    searched, drawn = _controls(config, config.controls, config.over)
    task, objective = _asked(config, config.task, config.objective)
    policy = make_policy(config.policy_name, **config.policy_options)
    scene = lent(SCENE, config.object) or scene_of(config)
    model = _model(config.model, config, task)
    metrics = load_metrics(config.metrics)
    return _Job(config, scene, model, task, searched, drawn, objective, policy, True, metrics)


def _given(config: AttackConfig, scene: Scene, model: Model) -> _Job:
    """Find what a configuration names besides its scene and its model."""
    searched, drawn = _controls(config, config.controls, config.over)
    task, objective = _asked(config, config.task, config.objective)
    policy = make_policy(config.policy_name, **config.policy_options)
    return _Job(config, scene, (model, []), task, searched, drawn, objective, policy, False)


def _controls(
    config: AttackConfig, searched: Controls, drawn: Controls
) -> tuple[tuple[Control, ...], tuple[Control, ...]]:
    """The controls that are searched and those that vary by chance, with the run's settings; only a search has a
    budget."""
    run_settings.check(config)
    without_budget = config.model_copy(update={"epsilon": None})
    return run_settings.given_to(config, searched), run_settings.given_to(without_budget, drawn)


def _asked(config: AttackConfig, task: AnyTask, objective: AnyObjective | None) -> tuple[Task, AnyObjective]:
    """The task, and the objective that was asked for or else the task's own, checked before anything is loaded."""
    made = make_task(task)
    wanted = made.objective if objective is None else objective
    check_objective(wanted, made.name, targeted=config.target is not None, minimise=config.minimise)
    return made, wanted


def _model(model: AnyModel | Sequence[AnyModel], config: AttackConfig, task: Task) -> tuple[Model, list[str]]:
    """Load the model, or the models of an ensemble as one; their warnings become sentences of the run."""
    models, warnings = load_models(several(model), task, config)
    return models[0] if len(models) == 1 else together(models, config.resolution), warnings


def check_from_config(config: AttackConfig) -> None:
    """Refuse what a configuration names that is not there, contradicts itself, or could not be judged; nothing is
    rendered.

    Raises:
        InputError: as for `attack_from_config`.
    """
    job = _job(config)
    _task(job, shows=False)
    _space(job, framed(job.scene.description, config.resolution or job.loaded[0].input_size))


def _task(job: _Job, *, shows: bool = True) -> tuple[Task, Callable[[Described, Looked], Facts]]:
    """The task on the model, and what gives it facts; refuses what cannot be judged.

    With `shows`, the task is shown a clean picture where it asks for one.
    """
    config, (model, _) = job.config, job.loaded
    asked = job.task.seeking(job.objective) if isinstance(job.objective, str) else job.task
    task = task_for(asked, model).on(model, target=config.target, minimise=config.minimise)
    facts = partial(facts_of, job.scene, config.object, config.label)
    alone = zip(task.tasks, task.models, strict=True) if isinstance(task, Together) else [(task, model)]
    tasks = list[Task]()
    for one, network in alone:
        known = task.told(one, facts(dict)) if isinstance(task, Together) else facts(dict)
        check_truth(one, network, job.scene, known, config)
        tasks.append(shown(one, network, [job.scene], config) if shows else one)
        job.loaded[1].extend(remark for remark in tasks[-1].remarks if remark not in job.loaded[1])
    task = replace(task, tasks=tuple(tasks)) if isinstance(task, Together) else tasks[0]
    return task, facts


def _space(job: _Job, description: SceneDescription) -> Space:
    """The searched controls and those that vary by chance, on a framed scene."""
    return make_space((*job.controls, *job.over), description)


def _problem(job: _Job, *, differentiated: bool = True) -> Problem:
    config, (model, _) = job.config, job.loaded
    description = job.scene.description
    task, facts = _task(job)
    resolution = config.resolution or model.input_size
    description = framed(description, resolution)
    space = _space(job, description)
    renderer = make_renderer(
        description,
        space,
        resolution,
        config.denoise,
        config.seed,
        config.estimators,
        leave_out=EVERYTHING if config.specialise else NOTHING,
        sampler=config.pixel_sampler,
        differentiated=differentiated,
    )
    features_seed = seeds.stream(config.seed, "clean features")
    objective, note = objective_for(job.objective, task, model, renderer, features_seed, config.ensemble)
    if note:
        job.loaded[1].append(note)
    if config.printable:
        searched = make_space(job.controls, description)
        print_terms(searched, searched.start)  # refuses where nothing can be printed
    problem = Problem(
        renderer,
        space,
        model,
        task,
        facts,
        objective,
        next_count(config.pixel_sampler, config.search_spp),
        config.seed,
        searched=len(job.controls),
        aovs=aovs_of(config.aov),
        metrics=job.metrics,
    )
    for name in asked_by(job.objective):
        problem.asked(problem.whole(problem.domain.start))(name)  # refuses what is not there
    problem.steps, problem.draws = search_size(config, problem)
    return problem


def search_size(config: AttackConfig, problem: Problem) -> tuple[int, int]:
    """Return the steps of a search, and how many conditions each looks at: what was asked for, or what is right for
    one picture, or for many conditions: predicted, rendered, or rendered where only a few numbers are searched."""
    if problem.conditions is None:
        return config.steps or STEPS, 1
    usual = OVER_ONE if problem.conditions.dim == 1 else OVER_PREDICTED
    predicted = reason_against(problem, config.steps or usual[0], config.specialise) is None
    balls = any(block.norm != "box" for block in problem.domain.blocks)
    steps, draws = usual if predicted else OVER_RENDERED if balls else OVER_NUMBERS
    return config.steps or steps, config.draws or draws


# ---- carrying it out ------------------------------------------------------------------------------------------------


def _carry_out(job: _Job, progress: Progress, run: RunDirectory | None = None) -> AttackResult:
    """Do it all, in a run directory of its own unless one is given that was begun already."""
    stages = Stages(progress)
    stages.begin("setup", PREPARING)
    problem = _problem(job)
    own = job.scene.description
    warnings = [*(problem.space.scene or own).notes, *job.loaded[1], *sentences(problem.space.moved)]
    for text in warnings:
        progress.message(text)
    policy = _policy(job, problem)
    with _directory(job, run) as kept:
        if kept is not None:
            functions = {f"metric {name}": one for name, one in job.metrics.items()}
            objective = {"objective": job.objective} if callable(job.objective) else {}
            check_made_of(kept, [job.loaded[0]], {**functions, **objective, "task": function_of(job.task)})
        with executor_for(job.config, "advsearch.api.attack:attack_answers", progress) as executor:
            journal = Journal(kept, Shared(problem, executor))
            if problem.conditions is not None and None in (job.config.steps, job.config.draws):
                progress.message(
                    f"One answer for many conditions: {count(problem.steps, 'step')}, each over "
                    f"{count(problem.draws, 'condition')}; `steps` and `draws` change that."
                )
            findings = Attack(journal, job.config, policy, stages, clean=job.clean).carry_out()
        named = job.objective if isinstance(job.objective, str) else job.config.objective
        found = summarise(job.config, named, findings, journal, stages, warnings)
        parts = replace(job, clean=CleanMatrix())  # without the matrix of light transport, which may be large
        return replace(found, parts=lambda: parts)


def attack_answers(settings: JsonObject) -> Call:
    """Return what answers the queries of the attack that the settings describe: what a worker does."""
    problem = _problem(_job(AttackConfig(**settings)))
    return answering(lambda name: problem)


def executor_for(
    config: SceneConfig, function: str, progress: Progress, *, ahead: bool = True
) -> AbstractContextManager[Executor | None]:
    """Return what carries out a function of a configuration, as its workers and cluster say; None for this process.

    Args:
        config: its settings are the function's.
        function: see `Work`, as `ahead`.
        progress: told what a person should read.
        ahead: see there.
    """
    settings = config.to_repeat().model_copy(update={"workers": None, "cluster": None}).plain()
    work = Work(function, settings, FILES, config.used_threads or 1, ahead=ahead)
    workers, cluster = (getattr(config, name, None) for name in ("workers", "cluster"))
    return executor_of(work, workers=workers, cluster=cluster, tell=progress.message)


def _policy(job: _Job, problem: Problem) -> Policy[Any]:
    """The policy. Where a model lets no gradient through, `auto` climbs by differences of whole pictures."""
    balls = all(block.norm != "box" for block in problem.domain.blocks)
    name = job.policy if isinstance(job.policy, str) else job.policy.name
    if name == "auto" and balls and not problem.model.differentiable:
        return make_policy("nes")
    if not isinstance(job.policy, str):
        return with_derivatives(job.policy, job.config)
    return with_derivatives(make_policy(job.policy, **job.config.policy_options), job.config)


def with_derivatives(policy: Policy[Any], config: AttackConfig) -> Policy[Any]:
    """Refuse settings of derivatives beside a policy that takes none; return the policy."""
    given = "estimators" if config.estimators else "measure" if config.measure == "full" else None
    if given and not policy.uses_gradient:
        raise InputError(f"{given}: policy {policy.name} takes no derivatives; leave one of the two out")
    return policy


def _go_on(job: _Job, run: str | Path, progress: Progress) -> AttackResult:
    """Carry out what is left of a run."""
    with RunDirectory.of(job.config, run) as kept:
        return _carry_out(job, progress, kept)


@contextmanager
def _directory(job: _Job, run: RunDirectory | None) -> Iterator[RunDirectory | None]:
    if run is not None or not job.keep:
        yield run
        return
    with RunDirectory.of(job.config) as made:
        yield made
