"""`attack`: the worst configuration of a scene inside a budget, searched for and verified, beside a random search."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from advsearch import seeds, threads
from advsearch.api.outcome import AttackResult, summarise
from advsearch.api.problem import Problem
from advsearch.api.record import Findings, Recorder, Stages
from advsearch.api.scene import Controls, Scene, as_controls, framed, load_scene, make_renderer
from advsearch.attacks import (
    POLICIES,
    Ending,
    Evaluation,
    Policy,
    SearchResult,
    StepRecord,
    Trial,
    Verification,
    already_wrong,
    choose_spp,
    count_right,
    get_objective,
    make_policy,
    planned_renders,
    run_trials,
    search,
    verify,
)
from advsearch.attacks.sample_count import LADDER
from advsearch.config import AttackConfig
from advsearch.controls import CONTROLS, make_space
from advsearch.errors import InputError
from advsearch.evaluation.gradients import inside
from advsearch.evaluation.planning import cosines, measured_plan, tuned
from advsearch.models import LabelSet, Model, ModelWarning, load_model
from advsearch.progress import NullProgress, Progress
from advsearch.runs.directory import RunDirectory, check_free
from advsearch.scene.formation import to_8_bit

FIRST_LOOK = 4
"""Renders that decide whether a start is worth attacking; the verdict itself takes the full trials."""


def attack(
    scene: Scene | str | Path,
    model: Model | nn.Module | str | Path = "reference",
    *,
    controls: Controls = ("texture",),
    objective: str | Callable[..., Tensor] = "margin",
    policy: str | Policy[Any] = "auto",
    run: str | Path | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> AttackResult:
    """Search for the worst configuration of a scene, verify it, and return everything that is known about it.

    Args:
        scene: from `load_scene`, or what that takes.
        model: from `load_model`, or what that takes.
        controls: what may vary: names, instances, or a mapping from names to settings.
        objective: "margin", "cross_entropy", or a function of (logits (N, C), images (N, H, W, 3), label indices) that
            returns (N,) values, which are maximised.
        policy: a name, or an instance with options of its own.
        run: folder to keep the run in; None keeps it in memory only.
        progress: told how far it is.
        **options: any other field of `advsearch.config.AttackConfig` by name: `label`, `epsilon`, `norm`, `steps`,
            `spp`, `trials`, `denoise`, `baseline`, `seed`, `deterministic`, ...

    Raises:
        InputError: anything that the caller can put right; nothing is written then.
    """
    scene = scene if isinstance(scene, Scene) else load_scene(scene)
    instances = as_controls(controls)
    described = {
        "object": scene.description.object_spec or scene.description.object.name,
        "environment": scene.description.environment_spec or scene.description.environment.name,
        "up": scene.description.up,
        "model": model if isinstance(model, str) else getattr(model, "name", None) or type(model).__name__,
        "controls": {one.name: one.settings() for one in instances},
        "objective": objective if isinstance(objective, str) else getattr(objective, "__name__", "custom"),
        "policy": policy if isinstance(policy, str) else policy.name,
        "set": {name: value for name, value in scene.description.values.items() if value is not None},
    }
    config = AttackConfig(**{**described, **options, "run": None if run is None else str(run)})
    job = _Job(config, scene, _model(model, config), instances, objective, policy, run is not None)
    return _carry_out(job, progress or NullProgress())


def attack_from_config(config: AttackConfig, *, progress: Progress | None = None) -> AttackResult:
    """Do what a configuration describes and keep it in a run directory; see `attack`."""
    if config.run is not None:
        check_free(config.run, overwrite=config.overwrite)
    progress = progress or NullProgress()
    progress.stage("set-up")
    return _carry_out(_job(config), progress)


def problem_from_config(config: AttackConfig, *, denoise: str | None = None) -> tuple[Problem, list[str]]:
    """Load what a configuration describes without searching: the problem, and warnings on the way.

    Args:
        config: what.
        denoise: another denoiser than the configuration's.
    """
    job = _job(config if denoise is None else config.model_copy(update={"denoise": denoise}))
    return _problem(job), job.loaded[1]


# ---- from names to things -------------------------------------------------------------------------------------------


@dataclass
class _Job:
    """Everything that was asked for, found and loaded."""

    config: AttackConfig
    scene: Scene
    loaded: tuple[Model, list[str]]
    controls: tuple[Any, ...]
    objective: str | Callable[..., Tensor]
    policy: str | Policy[Any]
    keep: bool


def _job(config: AttackConfig) -> _Job:
    """Find and load everything that a configuration names."""
    controls = as_controls({kind: _control_settings(kind, config, given) for kind, given in config.controls.items()})
    objective, policy = get_objective(config.objective), make_policy(config.policy, **_policy_options(config))
    given: dict[str, Any] = dict(config.set_)
    if config.exposure:
        if "camera.exposure" in given:
            raise InputError("--exposure and --set camera.exposure say the same thing; leave one of them out")
        given["camera.exposure"] = config.exposure
    scene = load_scene(config.object, config.environment, up=config.up, settings=given)
    model = _model(config.model, config)
    return _Job(config, scene, model, controls, objective, policy, True)


def _model(model: Model | nn.Module | str | Path, config: AttackConfig) -> tuple[Model, list[str]]:
    """Load the model; its warnings become sentences of the run."""
    threads.configure(1 if config.deterministic else config.threads)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ModelWarning)
        loaded = load_model(model, labels=config.labels)
    said = [str(one.message) for one in caught if issubclass(one.category, ModelWarning)]
    for one in caught:
        if not issubclass(one.category, ModelWarning):
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    return loaded, said


def _control_settings(asked: str, config: AttackConfig, given: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of one control: its own over the run's `epsilon`, `norm` and `texture_resolution`."""
    kind = str(given.get("kind") or asked.partition(":")[0].partition(".")[0])
    if kind not in CONTROLS:
        return dict(given)
    known = {choice.name for choice in CONTROLS[kind].choices}
    shared = {"epsilon": config.epsilon, "norm": config.norm, "resolution": config.texture_resolution}
    if kind != "texture":
        shared = {"epsilon": config.epsilon}
    return {**{name: value for name, value in shared.items() if name in known}, **given}


def _policy_options(config: AttackConfig) -> dict[str, Any]:
    return {} if config.step_size is None else {"step_size": config.step_size}


def _label_set(model: Model, config: AttackConfig, label: str | None) -> LabelSet:
    """The right answers: what was said, or else the object's own label."""
    if config.label is not None:
        try:
            return model.label_set(config.label)
        except InputError as error:
            raise InputError(f"--label: {error}") from None
    if label is None:
        raise InputError(
            f'--label: expected the right answers for {config.object}, got none; add --label "name" with a class of '
            f"model {model.name}"
        )
    try:
        return model.label_set(label)
    except InputError as error:
        raise InputError(
            f"the object's own label does not fit the model; say which is right with --label ({error})"
        ) from None


def _problem(job: _Job) -> Problem:
    config, (model, _) = job.config, job.loaded
    description = job.scene.description
    labels = _label_set(model, config, description.object.label)
    resolution = config.resolution or (model.input_size[0], model.input_size[1])
    description = framed(description, resolution)
    space = make_space(job.controls, description)
    renderer = make_renderer(description, space, resolution, config.denoise, config.seed, config.estimators)
    objective = get_objective(job.objective)
    return Problem(renderer, space, model, labels, objective, config.search_spp, config.seed)


# ---- the stages -----------------------------------------------------------------------------------------------------


def _carry_out(job: _Job, progress: Progress) -> AttackResult:
    stages = Stages(progress)
    stages.begin("setup", "set-up")
    problem = _problem(job)
    said = [*job.scene.description.object.warnings, *job.scene.description.environment.warnings, *job.loaded[1]]
    for text in said:
        progress.message(text)
    _measure(problem, job.config)
    with _directory(job) as run:
        recorder = Recorder(run, problem)
        findings = Findings()
        try:
            _stages(problem, job, findings, recorder, stages)
        except KeyboardInterrupt:
            findings.interrupted = True
        stages.end()
        return summarise(job.config, problem, findings, recorder, stages, said)


def _measure(problem: Problem, config: AttackConfig) -> None:
    """Replace the first gradient plan by a measured one, as far as the configuration wants that."""
    renderer, policy = problem.renderer, make_policy(config.policy) if config.policy in POLICIES else None
    if config.measure == "no" or (policy is not None and not policy.uses_gradient):
        return
    u, seed = inside(renderer), seeds.stream(config.seed, "measure")
    renderer.plan = measured_plan(renderer, problem.loss, u, seed=seed, spp=problem.spp, every=config.measure == "full")
    if config.measure == "full":
        table = cosines(renderer, problem.loss, u, seed=seed)
        renderer.plan, spp = tuned(renderer.plan, table)
        problem.spp = problem.spp if config.spp is not None or spp is None else spp
    problem.refresh()


@contextmanager
def _directory(job: _Job) -> Iterator[RunDirectory | None]:
    if not job.keep:
        yield None
        return
    with RunDirectory.create_for(job.config) as run:
        yield run


def _stages(problem: Problem, job: _Job, findings: Findings, recorder: Recorder, stages: Stages) -> None:
    config = job.config
    policy = make_policy(job.policy) if isinstance(job.policy, str) else job.policy
    if not _worth_attacking(problem, config, findings, recorder, stages):
        return
    _search(problem, policy, config, findings, recorder, stages)
    if findings.search is not None and findings.search.ending is Ending.INTERRUPTED:
        raise KeyboardInterrupt
    _verify(problem, config, findings, recorder, stages)


def _worth_attacking(
    problem: Problem, config: AttackConfig, findings: Findings, recorder: Recorder, stages: Stages
) -> bool:
    """Look at the clean configuration; one that is wrong in every first look goes through the full trials at once."""
    start = problem.domain.start
    seed = seeds.stream(config.seed, "first look")
    findings.first_look = run_trials(problem.trial, start, spp=config.search_spp, seed=seed, trials=FIRST_LOOK)
    if any(trial.right for trial in findings.first_look):
        return True
    _choose_spp(problem, {"clean": start}, config, findings, stages)
    stages.begin("verification", "verification", config.trials)
    _clean_trials(problem, config, findings, recorder, stages)
    return not already_wrong(count_right(findings.clean, findings.spp))


def _search(
    problem: Problem, policy: Policy[Any], config: AttackConfig, findings: Findings, recorder: Recorder, stages: Stages
) -> None:
    """The search, and the random one beside it."""
    stages.begin("search", "search", planned_renders(config.steps))
    every = max(1, -(-config.steps // 60))

    def keep(index: int, image: Tensor) -> None:
        if index < config.steps and index % every == 0:
            findings.frames.append(to_8_bit(image).numpy())

    def told(kind: str) -> Callable[[StepRecord, Tensor, Evaluation], None]:
        def on_step(record: StepRecord, u: Tensor, evaluation: Evaluation) -> None:
            recorder.step(kind, record, u, evaluation)
            stages.progress.advance(1, best=record.best)

        return on_step

    findings.search = search(
        problem.evaluator("search", keep),
        problem.domain,
        policy,
        steps=config.steps,
        seed=config.seed,
        on_step=told("search"),
    )
    if not config.baseline or policy.name == "random" or findings.search.ending is Ending.INTERRUPTED:
        return
    stages.begin("baseline", "random baseline", planned_renders(config.steps))
    baseline = search(
        problem.evaluator("baseline"),
        problem.domain,
        make_policy("random"),
        steps=config.steps,
        seed=seeds.stream(config.seed, "baseline"),
        on_step=told("baseline"),
    )
    if baseline.ending is Ending.INTERRUPTED:
        raise KeyboardInterrupt
    findings.baseline = baseline


def _verify(problem: Problem, config: AttackConfig, findings: Findings, recorder: Recorder, stages: Stages) -> None:
    """Choose the sample count, then try the clean configuration, the answer and the baseline's with the same seeds."""
    found, baseline = findings.search, findings.baseline
    if found is None:
        raise RuntimeError("nothing was searched, so there is nothing to verify")
    answer = problem.domain.project(found.best_u)
    _choose_spp(problem, {"clean": problem.domain.start, "adversarial": answer}, config, findings, stages)
    stages.begin("verification", "verification", (2 + (baseline is not None)) * config.trials)
    _clean_trials(problem, config, findings, recorder, stages)
    findings.verification = _verified(problem, found, config, findings, recorder, stages)
    if baseline is not None:
        findings.baseline_verification = _verified(problem, baseline, config, findings, recorder, stages)


def _choose_spp(
    problem: Problem, candidates: dict[str, Tensor], config: AttackConfig, findings: Findings, stages: Stages
) -> None:
    ladder = LADDER if config.verify_spp is None else (config.verify_spp,)
    stages.begin("verification", "sample count")
    margins = {name: _margin_of(problem, u, stages) for name, u in candidates.items()}
    findings.sample_count = choose_spp(margins, seed=config.seed, ladder=ladder)
    findings.verification_renders += findings.sample_count.renders


def _clean_trials(
    problem: Problem, config: AttackConfig, findings: Findings, recorder: Recorder, stages: Stages
) -> None:
    """The control group: the clean configuration under the seeds that every other group gets."""
    findings.clean = run_trials(
        problem.trial,
        problem.domain.start,
        spp=findings.spp,
        seed=config.seed,
        trials=config.trials,
        group="clean",
        on_trial=_teller("control", findings, recorder, stages),
    )


def _verified(
    problem: Problem,
    found: SearchResult,
    config: AttackConfig,
    findings: Findings,
    recorder: Recorder,
    stages: Stages,
) -> Verification:
    """Verify one search's answer against the control group."""
    return verify(
        problem.trial,
        problem.domain,
        found.best_u,
        claim=found.ending,
        spp=findings.spp,
        seed=config.seed,
        trials=config.trials,
        clean=findings.clean,
        on_trial=_teller("verification", findings, recorder, stages),
    )


def _teller(kind: str, findings: Findings, recorder: Recorder, stages: Stages) -> Callable[[str, int, Trial], None]:
    def on_trial(group: str, number: int, trial: Trial) -> None:
        recorder.trial(kind, number, findings.spp, trial)
        findings.verification_renders += 1
        stages.progress.advance(1)

    return on_trial


def _margin_of(problem: Problem, u: Tensor, stages: Stages) -> Callable[[int, int], float]:
    def margin(spp: int, seed: int) -> float:
        stages.progress.advance(1, samples=spp)
        return problem.trial(u, seed, spp).margin

    return margin
