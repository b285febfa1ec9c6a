"""An attack, from its parts to its result.

`run_attack` makes the full attack. It calls `search_and_verify`, whose stages are in
`advsearch.questions.attack.stages`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from advsearch import seeds
from advsearch.attacks import Policy, SearchResult, make_policy
from advsearch.attacks.candidates import scale_domain
from advsearch.attacks.policies import WithoutAscent
from advsearch.attacks.trials import LADDER
from advsearch.attacks.verification import OVER_LOOKS, TRIAL_LOOKS
from advsearch.controls.base import describe_adjusted_defaults
from advsearch.engine.journal import Journal, ParallelEvaluator, check_digests
from advsearch.engine.loading import Scene
from advsearch.engine.prediction import CleanMatrix
from advsearch.engine.problem import Problem
from advsearch.engine.record import RunState
from advsearch.engine.verifier import Verifier, choose_ladder
from advsearch.errors import InputError
from advsearch.interrupts import reraise_lost_interrupt
from advsearch.models import Model, RemoteNetwork
from advsearch.progress import NullProgress, Progress, Stages
from advsearch.questions.attack.carry_out import (
    LOADING,
    AttackParts,
    load_parts,
    make_problem,
    open_executor,
)
from advsearch.questions.attack.outcome import make_result
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.stages import (
    UNPRINTED,
    Measure,
    Searches,
    choose_predictor,
    evaluate_clean_scene,
    find_smallest,
    is_already_wrong,
    plan_renders,
    verify_searches,
)
from advsearch.report.wording import format_count
from advsearch.runs.directory import RunDirectory, check_free
from advsearch.runs.twins import read_twins
from advsearch.tasks import get_task_function

PREPARING = "preparing the scene for rendering"
WORKER = "advsearch.questions.attack.carry_out:attack_worker"


def attack_once(
    config: AttackConfig,
    *,
    progress: Progress | None = None,
    resumed: Path | None = None,
    clean: CleanMatrix | None = None,
) -> AttackResult:
    """Attack one object with one epsilon, and store the run.

    Args:
        config: the settings, which name the object, the model and everything else.
        progress: reports the progress; None for no reports.
        resumed: the directory of the run that is continued; None for a new one.
        clean: the matrix of light transport of the clean scene, to share it with
            attacks whose settings differ only in epsilon; None to share none.
    """
    if config.run is not None and resumed is None:
        check_free(config.run, overwrite=config.overwrite)
    progress = progress or NullProgress()
    progress.stage(LOADING)
    parts = load_parts(config)
    parts.clean_matrix = clean or parts.clean_matrix
    return run_attack(parts, progress, resumed)


def attack_on(config: AttackConfig, scene: Scene, model: Model) -> AttackResult:
    """Attack a loaded scene and a loaded model; nothing is stored."""
    return run_attack(load_parts(config, scene, model), NullProgress())


def run_attack(
    parts: AttackParts, progress: Progress, resumed: str | Path | None = None
) -> AttackResult:
    """Search for the worst configuration, verify it, and return the result.

    Args:
        parts: scene, model, task, controls and policy, with the settings of the attack.
        progress: reports the progress.
        resumed: the directory of the run that is continued; None for a new one.

    Raises:
        InputError: parts do not fit together, or the run that is continued was made
            with other parts.
    """
    config = parts.config
    if config.twins is not None:
        # The result is not used: the call raises an error if the run is corrupt.
        read_twins(config.twins)
    with ExitStack() as stack:
        run = None
        if resumed is not None:
            run = stack.enter_context(RunDirectory.open(config, resumed))
        stages = Stages(progress)
        stages.begin("setup", PREPARING)
        problem = make_problem(parts)
        warnings = _report_warnings(parts, progress, problem)
        policy = choose_policy(parts.policy, problem, _find_gradient_setting(config))
        # The directory of a new run is made only now, as the parts fit together.
        if run is None and parts.is_stored:
            run = stack.enter_context(RunDirectory.open(config))
        _check_same_parts(run, parts)
        with open_executor(config, WORKER, progress) as executor:
            # replays stored rows, renders and stores the others
            journal = Journal(run, ParallelEvaluator(problem, executor))
            _report_search_size(progress, config, problem)
            findings = _search(parts, config, policy, journal, stages)
        result = _make_attack_result(parts, journal, stages, findings, warnings)
        # without the matrix of light transport, which may be large
        stored_parts = replace(parts, clean_matrix=CleanMatrix())
        return replace(result, parts=lambda: stored_parts)


def _check_same_parts(run: RunDirectory | None, parts: AttackParts) -> None:
    """Raise an error if a run was made with another model or other functions.

    Args:
        run: the run directory, with the digests of what made it, which a new run gets
            here; None if nothing is stored.
        parts: parts of the attack.
    """
    if run is not None:
        model, _ = parts.model_and_warnings
        check_digests(run, [model], find_user_functions(parts))


def _make_attack_result(
    parts: AttackParts,
    journal: Journal,
    stages: Stages,
    findings: RunState,
    warnings: list[str],
) -> AttackResult:
    """Make the result of an attack from its findings, and store it in the run, if any.

    Args:
        parts: parts of the attack.
        journal: journal of the run.
        stages: stages of the run, with the seconds that each took.
        findings: findings of the attack.
        warnings: warnings so far; what calls of a remote model cost is added.
    """
    config = parts.config
    run = journal.run_directory
    module = journal.problem.model.module
    if isinstance(module, RemoteNetwork):
        warnings.append(module.spending_sentence)
    return make_result(
        findings,
        journal,
        stages,
        warnings,
        object_name=config.object,
        judge=config.judge,
        policy=config.policy_name,
        objective=_find_objective_name(parts),
        printable=config.printable,
        command_line=config.command_line(None if run is None else run.path),
        python_only=config.python_only,
        twins=config.twins,
    )


def _find_objective_name(parts: AttackParts) -> str | None:
    """Return the name of the objective; None for the task's own."""
    if isinstance(parts.objective, str):
        return parts.objective
    return parts.config.objective  # the settings name a function


def _report_warnings(
    parts: AttackParts, progress: Progress, problem: Problem
) -> list[str]:
    """Report and return the warnings of loading and of the controls.

    Args:
        parts: parts of the attack, with the warnings of loading the model.
        progress: gets each warning as a message.
        problem: problem of the attack, whose controls have notes on the scene.
    """
    _, loading_notes = parts.model_and_warnings
    warnings = [
        *problem.space.list_notes(parts.scene.description),
        *loading_notes,
        *describe_adjusted_defaults(problem.space.adjusted_defaults),
    ]
    for text in warnings:
        progress.message(text)
    return warnings


def _report_search_size(
    progress: Progress, config: AttackConfig, problem: Problem
) -> None:
    """Report the chosen numbers of steps and conditions, if conditions vary by chance."""
    is_size_chosen = config.steps is None or config.draws is None
    if problem.conditions is not None and is_size_chosen:
        steps = format_count(problem.steps, "step")
        conditions = format_count(problem.conditions_per_evaluation, "condition")
        progress.message(
            f"One configuration for many conditions: {steps}, each over {conditions}; "
            "`steps` and `draws` change that."
        )


def _search(
    parts: AttackParts,
    config: AttackConfig,
    policy: Policy[Any],
    journal: Journal,
    stages: Stages,
) -> Any:
    """Search and verify the worst configuration, with the settings of the attack.

    Args:
        parts: parts of the attack, of which the clean matrix is used.
        config: the settings.
        policy: policy that searches.
        journal: journal of the run.
        stages: reports what is done.

    Returns:
        The findings, a `RunState`.
    """
    # Trials end as soon as the verdict is clear, unless their number is fixed. The
    # search of the smallest change, which needs many verdicts, has a fixed number.
    has_trial_count = config.trials is not None or config.smallest
    return search_and_verify(
        policy,
        journal,
        stages,
        clean=parts.clean_matrix,
        smallest=config.smallest,
        seconds=config.seconds,
        baseline=config.baseline,
        printable=config.printable,
        max_extra_repeats=config.max_extra_repeats,
        average=config.average,
        trials=config.trial_count if has_trial_count else None,
        ladder=choose_ladder(config.verify_spp, config.pixel_sampler),
        specialise=config.specialise,
        measure=config.measure,
        deterministic=config.deterministic,
        chooses_spp=config.spp is None,
    )


def search_and_verify(
    policy: Policy[Any],
    journal: Journal,
    stages: Stages,
    *,
    clean: CleanMatrix | None = None,
    smallest: bool = False,
    seconds: float | None = None,
    baseline: bool = True,
    printable: bool = False,
    max_extra_repeats: int = 0,
    average: int = 0,
    trials: int | None = None,
    ladder: Sequence[int] = LADDER,
    specialise: bool = True,
    measure: Measure = "quick",
    deterministic: bool = False,
    chooses_spp: bool = False,
) -> RunState:
    """Search a problem with a policy and at random, and verify what was found.

    After Ctrl-C the findings so far are returned.

    Args:
        policy: proposes configurations.
        journal: journal of the problem; it replays what is stored of the run.
        stages: reports what is done.
        clean: the matrix of light transport of the clean scene, if attacks share it.
        smallest: whether the smallest budget in which the model is wrong is searched,
            instead of the worst configuration.
        seconds: seconds that the search may take; None for no limit.
        baseline: whether a random search with as many renders is made.
        printable: whether the objective includes print terms, which keep colors
            printable. Then a search without them is made, too.
        max_extra_repeats: maximum number of further renders of candidates that are
            close to the best.
        average: number of random configurations to evaluate.
        trials: renders that verify a configuration; None for as many as its verdict
            needs.
        ladder: samples per pixel that a verification may take, ascending.
        specialise: whether renders may leave out what the search does not need, and
            images may be predicted.
        measure: which gradient estimators are measured.
        deterministic: whether counted renders, and not measured times, decide which
            estimator is best.
        chooses_spp: whether a full measurement may choose the samples per pixel of the
            search.
    """
    problem = journal.problem
    # for the first renders, as `plan_renders` may choose another one for the search
    first_spp = problem.search_spp
    findings = RunState()
    look_sizes = _choose_look_sizes(problem, trials)
    verifier = Verifier(journal, ladder, stages, findings, look_sizes)
    searches = Searches(
        journal,
        stages,
        findings,
        printable=printable,
        max_extra_repeats=max_extra_repeats,
    )
    run_searches: Callable[[], None] = partial(
        search_with_baselines, searches, policy, seconds=seconds, baseline=baseline
    )
    if smallest:
        _check_has_budget(problem)
        run_searches = partial(find_smallest, searches, policy, verifier)
    choose_render_plan = partial(
        plan_renders,
        policy,
        journal,
        stages,
        specialise=specialise,
        measure=measure,
        deterministic=deterministic,
        chooses_spp=chooses_spp,
    )
    prepare_predictor = partial(
        choose_predictor,
        policy,
        journal,
        stages,
        findings,
        specialise=specialise,
        clean=clean or CleanMatrix(),
    )
    try:
        with reraise_lost_interrupt():
            choose_render_plan()
            findings.first_look_trials = evaluate_clean_scene(
                journal, stages, first_spp
            )
            if not is_already_wrong(verifier, in_any_case=smallest):
                findings.predictor = prepare_predictor()
                run_searches()
                verify_searches(verifier, is_smallest=smallest)
            if average:
                verifier.try_random(average)
    except KeyboardInterrupt:
        findings.interrupted = True
    stages.end()
    return findings


def _check_has_budget(problem: Problem) -> None:
    """Raise an error if nothing that is searched has a budget, which could shrink."""
    # The result is not used: the call raises the error.
    scale_domain(problem.domain, 1.0)


def _choose_look_sizes(problem: Problem, trials: int | None) -> tuple[int, ...]:
    """Return the numbers of trials after which a verification may end.

    After each of these numbers a verification looks at its trials, and ends if they
    suffice for a verdict. Conditions that vary by chance need more trials.

    Args:
        problem: problem of the attack.
        trials: the requested number; None for as many as the verdict needs.
    """
    if trials is not None:
        return (trials,)
    return TRIAL_LOOKS if problem.conditions is None else OVER_LOOKS


def search_with_baselines(
    searches: Searches, policy: Policy[Any], *, seconds: float | None, baseline: bool
) -> None:
    """Search with a policy, and make up to two other searches to compare it with.

    One is a search without print terms, if the objective has print terms, which keep
    colors printable. The other is a random search, if it is requested and the policy is
    not itself random.

    Args:
        searches: searches of the attack.
        policy: policy that searches.
        seconds: seconds that its search may take; None for no limit.
        baseline: whether a random search is made.
    """
    steps = searches.problem.steps
    search_result = _search_with_policy(searches, policy, seconds)
    if seconds is not None:
        # The other searches are as long as the first one was within the time.
        steps = max(1, _count_history_renders(search_result))
    if searches.printable:
        _search_without_print_terms(searches, policy, steps)
    if baseline and policy.name != "random":
        _search_at_random(searches, steps)


def _count_history_renders(result: SearchResult) -> int:
    """Count the images that a search rendered, without those of its ranking."""
    history = result.history  # lacks the ranking
    return history[-1].renders if history else 0


def _search_with_policy(
    searches: Searches, policy: Policy[Any], seconds: float | None
) -> SearchResult:
    """Search with a policy; `seconds` limit the time, None does not."""
    problem = searches.problem
    findings = searches.run_state
    searches.begin_stage(
        "search",
        f"searching with {policy.name}",
        problem.steps,
        shorter="`steps` or `seconds` shorten it",
    )
    findings.search_result = searches.run_search(
        "search",
        policy,
        problem.steps,
        problem.seed,
        frames=findings.search_frames,
        seconds=seconds,
    )
    return findings.search_result


def _search_without_print_terms(
    searches: Searches, policy: Policy[Any], steps: int
) -> None:
    """Search again without print terms, with a number of steps."""
    title = "searching without print terms, to see what they cost"
    searches.begin_stage(
        "without print terms",
        title,
        steps,
        shorter="`printable=false` leaves out this search and the print terms",
    )
    searches.run_state.result_without_print_terms = searches.run_search(
        UNPRINTED, policy, steps, searches.problem.seed
    )


def _search_at_random(searches: Searches, steps: int) -> None:
    """Search at random with a number of steps, to compare the policy with."""
    searches.begin_stage(
        "baseline",
        "searching at random, to compare",
        steps,
        shorter="`baseline=false` leaves it out",
    )
    seed = seeds.derive_seed(searches.problem.seed, "baseline")
    searches.run_state.random_search_result = searches.run_search(
        "baseline", make_policy("random"), steps, seed
    )


def choose_policy(
    policy: Policy[Any], problem: Problem, gradient_setting: str | None = None
) -> Policy[Any]:
    """Return the policy that searches a problem: the requested one, or a special `auto`.

    `auto` follows the model's gradient. What replaces it depends on the model and on
    what is searched: ranges, such as a pose, or budgets with an epsilon, such as a
    texture's.

    - A remote model, behind an address, has no gradient. If only ranges are searched,
      `auto` leaves out its gradient steps, and keeps its samples and its surrogate
      model. Otherwise "nes" replaces it, which estimates a gradient from differences.
    - If a local model has no gradient, and only budgets are searched, "nes" replaces
      `auto`. If any range is searched, `auto` stays.

    Args:
        policy: the requested policy.
        problem: problem that is searched.
        gradient_setting: name of a setting about derivatives that the user has set;
            None if none is set.

    Raises:
        InputError: the policy needs the gradient of a remote model, or takes no
            derivatives although a setting about them is set.
    """
    if isinstance(problem.model.module, RemoteNetwork):
        policy = _choose_remote_policy(policy, problem)
    elif policy.name == "auto" and not problem.model.differentiable:
        has_only_budgets = "box" not in _list_norms(problem)
        if has_only_budgets:
            policy = make_policy("nes")
    _check_takes_derivatives(policy, gradient_setting)
    return policy


def _check_takes_derivatives(policy: Policy[Any], gradient_setting: str | None) -> None:
    """Raise an error if a setting about derivatives is set and a policy takes none."""
    if gradient_setting and not policy.uses_gradient:
        raise InputError(
            f"{gradient_setting}: policy {policy.name} takes no "
            "derivatives; leave one of the two out"
        )


def _choose_remote_policy(policy: Policy[Any], problem: Problem) -> Policy[Any]:
    """Return the policy that searches a remote model, which has no gradient.

    Raises:
        InputError: the policy needs a gradient.
    """
    if policy.name == "auto":
        has_only_ranges = _list_norms(problem) == {"box"}
        # `WithoutAscent` is `auto` without gradient steps
        return WithoutAscent() if has_only_ranges else make_policy("nes")
    if policy.uses_gradient:
        raise InputError(
            f"policy: {policy.name} follows the model's gradient, and "
            f"{problem.model.name}, behind an address, has "
            "none; use auto, cmaes, nes, random, sobol or grid"
        )
    return policy


def _list_norms(problem: Problem) -> set[str]:
    """Return the norms of what is searched: "box" of ranges, others of budgets."""
    return {block.norm for block in problem.domain.blocks}


def _find_gradient_setting(config: AttackConfig) -> str | None:
    """Return the name of a setting about derivatives that is set; None if none is."""
    if config.estimators:
        return "estimators"
    return "measure" if config.measure == "full" else None


def find_user_functions(parts: AttackParts) -> dict[str, Callable[..., Any] | None]:
    """Return the caller's own functions by their role, such as "objective".

    A run stores their digests, since it can only be continued with the same functions.
    The value of "task" is None if the task is not a function.
    """
    functions: dict[str, Callable[..., Any] | None] = {
        f"metric {name}": metric for name, metric in parts.metrics.items()
    }
    if callable(parts.objective):
        functions["objective"] = parts.objective
    functions["task"] = get_task_function(parts.task)
    return functions
