"""From the settings of an attack to its parts, and from these to its problem.

What settings name is found and loaded. Everything that renders and judges single
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
from advsearch.questions.attack import settings as numbers
from advsearch.questions.attack.ambient import problems_by_key
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import CONFIG, read_python_only
from advsearch.scene.formation import EVERYTHING, NOTHING, aovs_of, next_count
from advsearch.scene.things import ALL
from advsearch.settings import FILES
from advsearch.tasks import AnyTask, Facts, Task, make_task
from advsearch.tasks.together import Together, each_thing, together

# what a person who waits is told before the first image
LOADING = "loading the scene and the model"
ROLES_IN_SEARCH = frozenset({"objective", "policy", "metric"})
"""Roles of parts that decide how a scene was found, and not whether its result is
right.
"""


def attack_worker(settings: JsonObject) -> Call:
    """Return what evaluates the queries of the attack that the settings describe: what
    a worker does.
    """
    problem = problem_on(parts_of(AttackConfig(**settings)))
    return worker_call(problems_by_key(problem))


@dataclass
class AttackParts:
    """Everything that was asked for, found and loaded: the model and what was said of
    it, a task that is not yet on the model, the controls that are searched and those
    `over` that vary by chance; objective and policy may be the caller's own. Attacks
    may share `clean`, the matrix of light transport of the clean scene. A run is kept
    in a folder, or (`keep`) not.
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
    """Find and load everything that a configuration names, or all but a scene and a
    model, with which nothing is kept; nothing is rendered.
    """
    if scene is None and len(config.objects) > 1:
        raise one_only("object", config.objects)
    searched, drawn = controls_given(config, config.controls, config.over)
    task, objective = task_and_objective(config, config.task, config.objective)
    policy = make_policy(config.policy_name, **config.policy_options)
    keep = scene is None or model is None
    scene = scene or naming.scene_of(config)
    loaded = models_as_one(config.model, config, task) if model is None else (model, [])
    metrics = judging.load_metrics(config.metrics) if keep else {}
    return AttackParts(
        config, scene, loaded, task, searched, drawn, objective, policy, keep, metrics
    )


def parts_in(run: Path) -> AttackParts:
    """Find and load everything that the run of an attack was asked with, as its result
    is judged.
    """
    if needed := [
        part.text for part in read_python_only(run) if part.role not in ROLES_IN_SEARCH
    ]:
        raise InputError(
            f"{run}: {', '.join(needed)}: only the Python session that "
            "asked has what judges its result"
        )
    return parts_of(judged_alone(AttackConfig.from_yaml(run / CONFIG)))


def controls_given(
    config: AttackConfig, searched: Controls, drawn: Controls
) -> tuple[tuple[Control, ...], tuple[Control, ...]]:
    """The controls that are searched and those that vary by chance, with the run's
    settings; only a search has a budget.
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
    return controls, naming.given_to(config, drawn, are_searched=False)


def task_and_objective(
    config: AttackConfig, task: AnyTask, objective: AnyObjective | None
) -> tuple[Task, AnyObjective]:
    made = make_task(task)
    wanted = made.objective if objective is None else objective
    check_objective(
        wanted, made.name, targeted=config.target is not None, minimise=config.minimise
    )
    return made, wanted


def models_as_one(
    model: AnyModel | Sequence[AnyModel], config: AttackConfig, task: Task
) -> tuple[Model, list[str]]:
    models, warnings = load_models(several(model), task, config)
    return models[0] if len(models) == 1 else together(
        models, config.resolution
    ), warnings


def check_from_config(config: AttackConfig) -> None:
    """Refuse what a configuration names that is not there, contradicts itself, or could
    not be judged; nothing is rendered.
    """
    job = parts_of(config)
    _task(job, shows=False)
    size = config.resolution or job.loaded[0].input_size
    make_space((*job.controls, *job.over), framed(job.scene.description, size))


def problem_from_config(
    config: SceneConfig, *, denoise: str | None = None
) -> tuple[Problem, list[str]]:
    """Load what a configuration describes without searching: the problem, and warnings
    on the way.
    """
    return problem_of_parts(
        parts_of(AttackConfig.of(config, denoise=denoise or config.denoise))
    )


def problem_of_parts(
    parts: AttackParts, **changes: object
) -> tuple[Problem, list[str]]:
    """Return the problem that an attack was asked with, other settings in `changes` (of
    another `model`, its name), and warnings on the way.
    """
    config = parts.config.model_copy(update=changes)
    (model, warnings) = parts.loaded
    loaded = (
        models_as_one(config.model, config, parts.task)
        if "model" in changes
        else (model, [*warnings])
    )
    problem = problem_on(replace(parts, config=config, loaded=loaded))
    return problem, [*loaded[1], *sentences(problem.space.moved)]


def problem_of(
    config: AttackConfig, scene: Scene, model: Model, *, differentiated: bool = True
) -> Problem:
    """Return the problem of a configuration on a scene and a model that are there, in
    place of those that it names.
    """
    return problem_on(parts_of(config, scene, model), differentiated=differentiated)


def problem_on(job: AttackParts, *, differentiated: bool = True) -> Problem:
    config = job.config
    (model, warnings) = job.loaded
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
    objective, note = judging.objective_for(
        job.objective, task, model, renderer, features_seed, config.ensemble
    )
    warnings += [note] if note else []
    if config.printable:
        searched = make_space(job.controls, description)
        # refuses where nothing can be printed
        judging.print_terms(searched, searched.start)
    spp = next_count(config.pixel_sampler, config.search_spp)
    problem = Problem(
        renderer, space, model, task, facts, objective, spp, config.seed, searched=len(job.controls),
        aovs=aovs_of(config.aov), metrics=job.metrics,
    )  # fmt: skip
    for name in asked_by(job.objective):
        # refuses what is not there
        problem.asked(problem.whole(problem.domain.start))(name)
    problem.steps, problem.draws = search_size(config, problem)
    return problem


def _task(
    job: AttackParts, *, shows: bool = True
) -> tuple[Task, Callable[[Described, Looked], Facts]]:
    """The task on the model, which with `shows` sees a clean picture where it asks for
    one, and what gives it facts.
    """
    config = job.config
    (model, warnings) = job.loaded
    asked = (
        job.task.seeking(job.objective) if isinstance(job.objective, str) else job.task
    )
    task = judging.task_for(asked, model).on(
        model, target=config.target, minimise=config.minimise
    )
    facts = partial(
        facts_about,
        job.scene.description,
        config.object,
        config.label,
        judge=config.judge,
    )
    image_settings = config.image_settings
    several = task if isinstance(task, Together) else None
    tasks = list[Task]()
    for part, network in (
        zip(several.tasks, several.models, strict=True) if several else [(task, model)]
    ):
        known = several.told(part, facts(dict)) if several else facts(dict)
        judging.check_truth(part, network, job.scene, known, image_settings)
        if shows:
            part = judging.calibrate_task(
                part, network, [job.scene], config.label, config.judge, image_settings
            )
        tasks.append(part)
        warnings += [remark for remark in tasks[-1].remarks if remark not in warnings]
    task = replace(several, tasks=tuple(tasks)) if several else tasks[0]
    return each_thing(task) if config.judge == ALL else task, facts


def search_size(config: AttackConfig, problem: Problem) -> tuple[int, int]:
    if problem.conditions is None:
        return config.steps or numbers.STEPS, 1
    usual = numbers.OVER_ONE if problem.conditions.dim == 1 else numbers.OVER_PREDICTED
    # they are rendered
    if (
        refusal_of_matrices(problem, config.steps or usual[0], config.specialise)
        is not None
    ):
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
    """Return what the adversarial scene of a run is judged with: what counts as success
    needs no metric, and neither an objective nor a policy that only the session had
    which searched with them.
    """
    change: dict[str, object] = {"metrics": {}}
    if config.objective is not None and config.objective not in OBJECTIVE_KINDS:
        change["objective"] = None
    if config.policy_name not in POLICIES:
        change["policy"] = AttackConfig.model_fields["policy"].default
    return config.model_copy(update=change)


def executor_for(
    config: SceneConfig, function: str, progress: Progress
) -> AbstractContextManager[Workers | None]:
    """Return what carries out a function of a configuration, as its workers and cluster
    say; None for this process.
    """
    settings = (
        config.to_repeat().model_copy(update={"workers": None, "cluster": None}).plain()
    )
    work = WorkerTask(function, settings, FILES, config.used_threads or 1)
    workers, cluster = (getattr(config, name, None) for name in ("workers", "cluster"))
    if (workers or cluster) and has_address(config.model):
        raise InputError(
            f"{'workers' if workers else 'cluster'}: a model behind an address is "
            "asked by one process, which counts "
            "its calls; leave it out"
        )
    return open_workers(work, workers=workers, cluster=cluster, tell=progress.message)
