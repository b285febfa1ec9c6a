"""Load the parts of an attack from its settings, and make its problem of these.

 Everything that renders and judges single
configurations begins with `problem_from_config` or `problem_of`;
`advsearch.questions.attack.run` attacks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Policy, make_policy
from advsearch.attacks.objectives import OBJECTIVE_KINDS, asked_by, check_objective
from advsearch.attacks.policies import POLICIES
from advsearch.cluster import Call, Workers, WorkerTask
from advsearch.cluster.workers import open_workers
from advsearch.config import SceneConfig, has_address, one_only
from advsearch.controls import make_space
from advsearch.controls.base import Control, sentences
from advsearch.controls.ranges import by_distribution
from advsearch.engine import judging, loading, naming
from advsearch.engine.journal import worker_call
from advsearch.engine.judging import AnyObjective, Described, Looked, Metrics
from advsearch.engine.loading import Controls, Scene, framed
from advsearch.engine.naming import AnyModel, load_models, several
from advsearch.engine.problem import Problem
from advsearch.engine.rendering import facts_about
from advsearch.engine.transport import CleanMatrix, refusal_of_matrices
from advsearch.errors import InputError
from advsearch.files import JsonObject
from advsearch.models import Model
from advsearch.options import as_setting
from advsearch.progress import Progress
from advsearch.questions.attack.ambient import problems_by_key
from advsearch.questions.attack.settings import (
    OVER_NUMBERS,
    OVER_ONE,
    OVER_PREDICTED,
    OVER_RENDERED,
    STEPS,
    AttackConfig,
)
from advsearch.runs.directory import CONFIG, read_python_only
from advsearch.scene.formation import EVERYTHING, NOTHING, aovs_of, next_count
from advsearch.scene.things import ALL
from advsearch.settings import FILES
from advsearch.tasks import AnyTask, Facts, Task, make_task
from advsearch.tasks.together import Together, each_thing, together

# the first stage of the progress
LOADING = "loading the scene and the model"
ROLES_IN_SEARCH = frozenset({"objective", "policy", "metric"})
"""Roles of parts that decide how a scene is found, but not whether it is a success."""


def attack_worker(settings: JsonObject) -> Call:
    """Return the function by which a worker evaluates queries of an attack.

    Args:
        settings: of the attack.
    """
    problem = problem_on(parts_of(AttackConfig(**settings)))
    return worker_call(problems_by_key(problem))


@dataclass
class AttackParts:
    """Everything that an attack needs, loaded.

    Attributes:
        config: the settings.
        scene: the clean scene.
        loaded: the model, and warnings of loading it.
        task: not yet bound to the model.
        controls: the searched ones.
        over: those that vary by chance.
        objective: a name, or the caller's function.
        policy: may be the caller's.
        keep: whether the run is stored.
        metrics: columns of the rows, by name.
        clean: the matrix of light transport of the clean scene, which attacks may
            share.
    """

    config: AttackConfig
    scene: Scene
    loaded: tuple[Model, list[str]]
    task: Task
    controls: tuple[Any, ...]
    over: tuple[Any, ...]
    objective: str | Callable[..., Tensor]
    policy: Policy[Any]
    keep: bool
    metrics: Metrics = field(default_factory=dict)
    clean: CleanMatrix = field(default_factory=CleanMatrix)


def parts_of(
    config: AttackConfig, scene: Scene | None = None, model: Model | None = None
) -> AttackParts:
    """Load everything that a configuration names; nothing is rendered.

    Args:
        config: the settings.
        scene: used instead of the one that the settings name.
        model: likewise; with both, the attack is not stored.
    """
    if scene is None and len(config.objects) > 1:
        raise one_only("object", config.objects)
    searched, sampled = controls_given(config, config.controls, config.over)
    task, objective = task_and_objective(config, config.task, config.objective)
    policy = make_policy(config.policy_name, **config.policy_options)
    keep = scene is None or model is None
    scene = scene or naming.scene_of(config)
    if model is None:
        loaded = models_as_one(config.model, config, task)
    else:
        loaded = (model, [])
    metrics = judging.load_metrics(config.metrics) if keep else {}
    return AttackParts(
        config, scene, loaded, task, searched, sampled, objective, policy, keep, metrics
    )


def parts_in(run: Path) -> AttackParts:
    """Load what the run of an attack used, as its result is evaluated.

    Raises:
        InputError: some of that exists only in the Python session of the run.
    """
    missing = [
        part.text for part in read_python_only(run) if part.role not in ROLES_IN_SEARCH
    ]
    if missing:
        raise InputError(
            f"{run}: {', '.join(missing)}: only the Python session that "
            "asked has what judges its result"
        )
    return parts_of(judged_alone(AttackConfig.from_yaml(run / CONFIG)))


def controls_given(
    config: AttackConfig, searched: Controls, random: Controls
) -> tuple[tuple[Control, ...], tuple[Control, ...]]:
    """Return the searched controls and those that vary by chance, with their settings.

    Args:
        config: settings of the run; only a search has a budget.
        searched: names, settings or instances.
        random: likewise.

    Raises:
        InputError: a searched control has a distribution.
    """
    naming.check_run_settings(config)
    controls = naming.given_to(config, searched)
    for control in controls:
        for name, spec in getattr(control, "specs", {}).items():
            if by_distribution(spec):
                raise InputError(
                    f"`controls` {control.name}.{name}: expected values to search, "
                    "which are all as good, got how "
                    "likely each is; give a range, or put it into `over`, under which "
                    "it varies by chance"
                )
    return controls, naming.given_to(config, random, are_searched=False)


def task_and_objective(
    config: AttackConfig, task: AnyTask, objective: AnyObjective | None
) -> tuple[Task, AnyObjective]:
    """Make a task and choose its objective.

    Args:
        config: the settings.
        task: a name, settings or an instance.
        objective: None for the task's own.

    Raises:
        InputError: the objective does not fit the task or the goal.
    """
    new_task = make_task(task)
    chosen = new_task.objective if objective is None else objective
    check_objective(
        chosen,
        new_task.name,
        targeted=config.target is not None,
        minimise=config.minimise,
    )
    return new_task, chosen


def models_as_one(
    model: AnyModel | Sequence[AnyModel], config: AttackConfig, task: Task
) -> tuple[Model, list[str]]:
    """Load models, several as one ensemble; return it and warnings."""
    models, warnings = load_models(several(model), task, config)
    if len(models) == 1:
        return models[0], warnings
    return together(models, config.resolution), warnings


def check_from_config(config: AttackConfig) -> None:
    """Check that an attack can be made; nothing is rendered.

    Raises:
        InputError: the settings name what does not exist, contradict themselves, or
            give a result that cannot be evaluated.
    """
    parts = parts_of(config)
    _bind_task(parts, shows=False)
    size = config.resolution or parts.loaded[0].input_size
    make_space((*parts.controls, *parts.over), framed(parts.scene.description, size))


def problem_from_config(
    config: SceneConfig, *, denoise: str | None = None
) -> tuple[Problem, list[str]]:
    """Load what a configuration describes, without searching.

    Args:
        config: the settings.
        denoise: used instead of the setting.

    Returns:
        The problem, and warnings of loading it.
    """
    attack_config = AttackConfig.of(config, denoise=denoise or config.denoise)
    return problem_of_parts(parts_of(attack_config))


def problem_of_parts(
    parts: AttackParts, **changes: object
) -> tuple[Problem, list[str]]:
    """Return the problem of an attack, and warnings of loading it.

    Args:
        parts: of the attack.
        **changes: other settings; of another `model`, its name.
    """
    config = parts.config.model_copy(update=changes)
    model, warnings = parts.loaded
    if "model" in changes:
        loaded = models_as_one(config.model, config, parts.task)
    else:
        loaded = (model, [*warnings])
    problem = problem_on(replace(parts, config=config, loaded=loaded))
    return problem, [*loaded[1], *sentences(problem.space.moved)]


def problem_of(
    config: AttackConfig, scene: Scene, model: Model, *, differentiated: bool = True
) -> Problem:
    """Return the problem of a configuration on a loaded scene and a loaded model.

    Args:
        config: the settings; the scene and the model that they name are not used.
        scene: used instead.
        model: used instead.
        differentiated: whether derivatives are needed.
    """
    return problem_on(parts_of(config, scene, model), differentiated=differentiated)


def problem_on(parts: AttackParts, *, differentiated: bool = True) -> Problem:
    """Make the problem of an attack: what renders and evaluates configurations.

    Warnings are added to those of loading the model.

    Args:
        parts: the parts of the attack.
        differentiated: whether derivatives are needed.

    Raises:
        InputError: the parts do not fit together.
    """
    config = parts.config
    model, warnings = parts.loaded
    task, facts = _bind_task(parts)
    resolution = config.resolution or model.input_size
    description = framed(parts.scene.description, resolution)
    space = make_space((*parts.controls, *parts.over), description)
    renderer = loading.make_renderer(
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
    objective, note = judging.objective_for(
        parts.objective, task, model, renderer, features_seed, config.ensemble
    )
    if note:
        warnings.append(note)
    if config.printable:
        searched_space = make_space(parts.controls, description)
        # raises where nothing can be printed
        judging.print_terms(searched_space, searched_space.start)
    problem = Problem(
        renderer,
        space,
        model,
        task,
        facts,
        objective,
        next_count(config.pixel_sampler, config.search_spp),
        config.seed,
        searched=len(parts.controls),
        aovs=aovs_of(config.aov),
        metrics=parts.metrics,
    )
    for name in asked_by(parts.objective):
        # raises where the objective needs what there is not
        problem.asked(problem.whole(problem.domain.start))(name)
    problem.steps, problem.draws = search_size(config, problem)
    return problem


def _bind_task(
    parts: AttackParts, *, shows: bool = True
) -> tuple[Task, Callable[[Described, Looked], Facts]]:
    """Bind the task of an attack to its model.

    Args:
        parts: the parts of the attack.
        shows: whether a clean image is rendered for a task that needs one.

    Returns:
        The task, and the function that gives it the ground truth of a configuration.
    """
    config = parts.config
    model, warnings = parts.loaded
    task = parts.task
    if isinstance(parts.objective, str):
        task = task.seeking(parts.objective)
    task = judging.task_for(task, model).on(
        model, target=config.target, minimise=config.minimise
    )
    facts = partial(
        facts_about,
        parts.scene.description,
        config.object,
        config.label,
        judge=config.judge,
    )
    ensemble = task if isinstance(task, Together) else None
    members = [(task, model)]
    if ensemble is not None:
        members = list(zip(ensemble.tasks, ensemble.models, strict=True))
    member_tasks = list[Task]()
    for member, network in members:
        known = facts(dict)
        if ensemble is not None:
            known = ensemble.told(member, known)
        judging.check_truth(member, network, parts.scene, known, config.image_settings)
        if shows:
            member = judging.calibrate_task(
                member,
                network,
                [parts.scene],
                config.label,
                config.judge,
                config.image_settings,
            )
        member_tasks.append(member)
        warnings += [remark for remark in member.remarks if remark not in warnings]
    if ensemble is None:
        task = member_tasks[0]
    else:
        task = replace(ensemble, tasks=tuple(member_tasks))
    if config.judge == ALL:
        task = each_thing(task)
    return task, facts


def search_size(config: AttackConfig, problem: Problem) -> tuple[int, int]:
    """Return the steps of a search, and the conditions that each evaluates."""
    if problem.conditions is None:
        return config.steps or STEPS, 1
    default = OVER_PREDICTED
    if problem.conditions.dim == 1:
        default = OVER_ONE
    steps = config.steps or default[0]
    if refusal_of_matrices(problem, steps, config.specialise) is not None:
        # Conditions are rendered.
        is_box = all(block.norm == "box" for block in problem.domain.blocks)
        default = OVER_NUMBERS if is_box else OVER_RENDERED
    default_steps, default_draws = default
    return config.steps or default_steps, config.draws or default_draws


def is_named(entry: Task | Policy[Any], make: Callable[[Any], object]) -> bool:
    """Return whether a setting can name a task or a policy.

    Args:
        entry: the task or policy.
        make: makes one from a setting.
    """
    try:
        return bool(make(as_setting(entry)) == entry)
    except InputError:
        return False


def judged_alone(config: AttackConfig) -> AttackConfig:
    """Return the settings with which the adversarial scene of a run is evaluated.

    Success depends on no metric, and not on the objective or the policy that searched,
    which may exist only in the session of the run.
    """
    changes: dict[str, object] = {"metrics": {}}
    if config.objective is not None and config.objective not in OBJECTIVE_KINDS:
        changes["objective"] = None
    if config.policy_name not in POLICIES:
        changes["policy"] = AttackConfig.model_fields["policy"].default
    return config.model_copy(update=changes)


def executor_for(
    config: SceneConfig, function: str, progress: Progress
) -> AbstractContextManager[Workers | None]:
    """Return the workers that run a function of a configuration.

    None if the settings ask for no workers: then this process does it.

    Args:
        config: the settings.
        function: "module:function", which gets the settings.
        progress: reports what the workers do.

    Raises:
        InputError: the model is behind an address, which one process asks.
    """
    in_process = {"workers": None, "cluster": None}
    worker_settings = config.to_repeat().model_copy(update=in_process).plain()
    work = WorkerTask(function, worker_settings, FILES, config.used_threads or 1)
    workers = getattr(config, "workers", None)
    cluster = getattr(config, "cluster", None)
    if (workers or cluster) and has_address(config.model):
        raise InputError(
            f"{'workers' if workers else 'cluster'}: a model behind an address is "
            "asked by one process, which counts "
            "its calls; leave it out"
        )
    return open_workers(work, workers=workers, cluster=cluster, tell=progress.message)
