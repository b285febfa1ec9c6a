"""Find how bright ambient light may be before an adversarial pattern of light fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial

from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Ending, Verification, verify
from advsearch.engine.journal import ParallelEvaluator, ProblemKey
from advsearch.engine.problem import Problem
from advsearch.engine.verifier import Verifier

MAX_LUX = 1e5  # direct sun: nothing brighter is tried
N_BISECTIONS = 2
"""Bisections between the brightest ambient light in which the configuration holds and
the darkest in which it fails. They begin with a factor of 2 between the two, and end
with 1.19.
"""


def find_ambient(verifier: Verifier, u: Tensor) -> None:
    """Find the ambient light in which a verified configuration no longer holds.

    It is searched for the light of a projector. The ambient light is doubled until the
    configuration fails; then the limit is bisected between the last two lights. Exposure
    follows the ambient light, so that the projector's light gets darker in the image.
    Nothing else changes. The trials have the same seeds in every light, and no other
    stage uses these seeds. The results are stored in `verification_by_lux` of the run
    state.

    Args:
        verifier: verifier of the attack.
        u: (d,) the configuration.
    """
    findings = verifier.run_state
    scene_lux = _find_scene_lux(verifier.problem)
    if scene_lux is None or findings.verification is None:
        return  # no light of the attack competes with the ambient light
    findings.verification_by_lux[scene_lux] = findings.verification
    holds = partial(_holds_in_light, verifier, u, scene_lux)
    holding_lux, failing_lux = _double_until_failing(holds, scene_lux)
    holds_in_direct_sun = failing_lux not in findings.verification_by_lux
    if not holds_in_direct_sun:  # else the failing light was not tried
        _bisect_ambient(holds, holding_lux, failing_lux)


def _holds_in_light(
    verifier: Verifier, u: Tensor, scene_lux: float, lux: float
) -> bool:
    """Verify a configuration in an ambient light, and store the result.

    Args:
        verifier: verifier of the attack.
        u: (d,) the configuration.
        scene_lux: the ambient light of the scene.
        lux: the ambient light to try.
    """
    verification = _verify_in_light(verifier, u, lux=lux, factor=lux / scene_lux)
    verifier.run_state.verification_by_lux[lux] = verification
    return verification.ending is Ending.FOUND


def _double_until_failing(
    holds: Callable[[float], bool], scene_lux: float
) -> tuple[float, float]:
    """Double the ambient light until a configuration fails or `MAX_LUX` is exceeded.

    Args:
        holds: tries the configuration in an ambient light, in lux.
        scene_lux: the ambient light of the scene, in which it holds.

    Returns:
        The brightest light in which it holds, and twice that light. In the latter it
        fails, unless that is beyond `MAX_LUX` and was not tried.
    """
    holding_lux = scene_lux
    failing_lux = 2.0 * scene_lux
    while failing_lux <= MAX_LUX and holds(failing_lux):
        holding_lux = failing_lux
        failing_lux = 2.0 * failing_lux
    return holding_lux, failing_lux


def _bisect_ambient(
    holds: Callable[[float], bool], holding_lux: float, failing_lux: float
) -> None:
    """Try ambient lights between one in which a configuration holds and one in which not.

    Args:
        holds: tries the configuration in an ambient light, in lux, and stores the result.
        holding_lux: ambient light in which it holds.
        failing_lux: brighter ambient light in which it fails.
    """
    for _ in range(N_BISECTIONS):
        # halfway on a logarithmic scale
        middle_lux = (holding_lux * failing_lux) ** 0.5
        if holds(middle_lux):
            holding_lux = middle_lux
        else:
            failing_lux = middle_lux


def _verify_in_light(
    verifier: Verifier, u: Tensor, lux: float, factor: float
) -> Verification:
    """Verify a configuration in another ambient light.

    Args:
        verifier: verifier of the attack.
        u: (d,) the configuration.
        lux: the ambient light.
        factor: the ambient light as a multiple of the scene's.
    """
    problem = verifier.problem
    verifier_in_light = _move_into_light(verifier, lux, factor)
    seed = seeds.derive_seed(problem.seed, "ambient")  # the same in every light
    return verify(
        verifier_in_light.evaluate_all,
        problem.domain,
        u,
        claim=Ending.FOUND,
        spp=verifier.run_state.spp,
        seed=seed,
        trials=verifier.look_sizes,
        rule=problem.verification_rule,
        kind=f"ambient {lux:.6g} lux",
        control_kind=f"control {lux:.6g} lux",
    )


def _move_into_light(verifier: Verifier, lux: float, factor: float) -> Verifier:
    """Begin a stage, and return a verifier that renders the scene in an ambient light.

    Args:
        verifier: verifier of the attack.
        lux: the ambient light.
        factor: the ambient light as a multiple of the scene's.
    """
    # trials of the clean scene, and as many of the configuration
    n_renders = 2 * verifier.n_trials
    title = f"trying it in ambient light of {lux:.3g} lux"
    verifier.begin_stage(title, n_renders, name="ambient", at_most=True)
    # Workers make the problem in that light from its key, see `make_problem_finder`.
    problem_key = factor
    workers = verifier.journal.evaluator.workers
    problem_in_light = with_ambient_light(verifier.problem, factor)
    evaluator = ParallelEvaluator(problem_in_light, workers, problem_key)
    journal = replace(verifier.journal, evaluator=evaluator)
    return replace(verifier, journal=journal)


def _find_scene_lux(problem: Problem) -> float | None:
    """Return the ambient light of the scene in lux, if a searched control depends on it.

    Such a control adds light to the scene, as a projector does. None if there is no such
    control, or if the ambient light itself is searched.
    """
    for control in problem.searched_space.controls:
        if control.competes_with_ambient:
            return control.ambient_lux  # None if the control searches it
    return None


def make_problem_finder(problem: Problem) -> Callable[[ProblemKey], Problem]:
    """Return the function by which a worker finds the problem of a query.

    A query names its problem by a key. A float is a factor by which the ambient light
    of the run's problem is multiplied. Any other key stands for the run's problem.

    Args:
        problem: problem of the run.
    """

    # Lights are tried one after another, so that older problems are not needed again.
    @lru_cache(maxsize=2)
    def make_problem_in_light(factor: float) -> Problem:
        return with_ambient_light(problem, factor)

    def find_problem(key: ProblemKey) -> Problem:
        if isinstance(key, float):
            return make_problem_in_light(key)
        return problem

    return find_problem


def with_ambient_light(problem: Problem, factor: float) -> Problem:
    """Return the problem with its ambient light multiplied by a factor."""
    controls = [control.scale_ambient(factor) for control in problem.space.controls]
    space = replace(problem.space, controls=tuple(controls))
    renderer = problem.renderer.copy_with()
    renderer.space = space
    return replace(problem, space=space, renderer=renderer)
