"""What a case of the stability suite is, and small scenes and objectives for it: a picture, a gradient, a search."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.attacks import PGD, Block, Domain, Evaluation, Query, SearchResult, search
from advsearch.controls import Space, make_control, make_space
from advsearch.engine import objective
from advsearch.engine.gradients import Agreement, Loss, Probe, agreement, estimates, probes, reference, smooth_loss
from advsearch.scene import library
from advsearch.scene.assembly import Motion
from advsearch.scene.assets import EnvironmentAsset, Material, Mesh, ObjectAsset
from advsearch.scene.description import describe
from advsearch.scene.formation import ImageFormation
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.parts import ScenePart
from advsearch.scene.renderer import Renderer

OK, FELL_SHORT = "ok", "fell short"


@dataclass(frozen=True)
class Check:
    """One number that decides, and the range that it has to be in (both ends included; NaN is in no range)."""

    what: str
    value: float
    least: float = -math.inf
    most: float = math.inf

    @property
    def ok(self) -> bool:
        """Whether the number is in its range."""
        return self.least <= self.value <= self.most

    def __str__(self) -> str:
        ends = [
            f"{sign} {end:.4g}"
            for sign, end in (("at least", self.least), ("at most", self.most))
            if not math.isinf(end) and self.least != self.most
        ]
        wanted = f"exactly {self.most:.4g}" if self.least == self.most else " and ".join(ends)
        return f"{self.what}: {self.value:.4g}" + (f" (expected {wanted})" if wanted else "")


def holds(what: str, truth: bool) -> Check:
    """Return the check that something is true: 1, else 0."""
    return Check(what, float(truth), 1.0, 1.0)


class Outcome:
    """What a case found: the numbers that decide, and whether every picture and gradient was finite, and none had to be
    made so.

    Attributes:
        relative_error: of a gradient (or of what the case is about) against the reference; None where there is none.
        ending: how the case's search ended, "refused" where the input was, or empty.
        measured: further numbers that are worth printing.
    """

    def __init__(
        self,
        *checks: Check,
        finite: bool = True,
        relative_error: float | None = None,
        ending: str = "",
        measured: Mapping[str, float] | None = None,
    ) -> None:
        self.checks, self.finite, self.relative_error = checks, finite, relative_error
        self.ending, self.measured = ending, measured or {}

    @property
    def status(self) -> str:
        """`OK` where everything was finite and every check holds."""
        return OK if self.finite and all(check.ok for check in self.checks) else FELL_SHORT

    @property
    def decides(self) -> str:
        """The number that decides: of the first check that fails, else of the last one."""
        bad = [check for check in self.checks if not check.ok]
        if not self.finite and not bad:
            return "NaN or infinite values"
        deciding = bad or list(self.checks[-1:])
        return str(deciding[0]) if deciding else ""

    def with_checks(self, *more: Check, **known: Any) -> Outcome:
        """Return it with further checks, and other fields where they are known."""
        fields = {name: value for name, value in vars(self).items() if name != "checks"}
        return Outcome(*self.checks, *more, **{**fields, **known})


Find = Callable[[], Outcome]


@dataclass(frozen=True)
class Case:
    """One extreme.

    Attributes:
        name: unique; what `--case` takes.
        holds: what must hold, in a sentence.
        rule: what handles it.
        control: the controls that it moves; empty where there is no scene.
        cheap: takes about a second or less on two quiet cores, so the tests run it every time.
    """

    name: str
    group: str
    holds: str
    rule: str
    control: str
    cheap: bool
    find: Find


@dataclass(frozen=True)
class CaseGroup:
    """Cases about one thing, in the order in which they run; `name` is what `--group` takes."""

    name: str
    cases: list[Case] = field(default_factory=list)

    def case(
        self, name: str, rule: str, control: str = "", *, holds: str = "", cheap: bool = True
    ) -> Callable[[Find], Find]:
        """Make a function a case of the group; arguments as the attributes of `Case`.

        Where `holds` is not given, the first sentence of its docstring says what must hold.
        """

        def added(find: Find) -> Find:
            said = holds or " ".join((find.__doc__ or "").partition("\n\n")[0].split())
            self.cases.append(Case(name, self.name, said, rule, control, cheap, find))
            return find

        return added


Value = Callable[[Tensor], Tensor]
"""From (d,) float64 in [0, 1] to a number with a graph; the larger the better."""
Disturb = Callable[[Tensor, int], Tensor]
"""From a gradient (d,) float32 and the number of its evaluation to the gradient that the policy sees."""


@dataclass
class Toy:
    """An objective without a renderer, as a search wants it.

    Attributes:
        scale: factor on the objective, as if it were in other units.
        disturb: what becomes of gradients.
        broken: numbers of evaluations whose objective is NaN, as is their gradient.
        threshold: an objective over it is a success.
    """

    value: Value
    domain: Domain
    scale: float = 1.0
    disturb: Disturb | None = None
    broken: frozenset[int] = frozenset()
    threshold: float = math.inf

    def __call__(self, query: Query) -> Evaluation:
        """Answer a query; gradients cost nothing."""
        at = query.u.detach().double().requires_grad_()
        value = self.scale * self.value(at)
        slope = None
        if query.gradient:
            (slope,) = torch.autograd.grad(value, at)
            slope = slope.float()
            if self.disturb is not None:
                slope = self.disturb(slope, query.number)
        objective = float(value.detach())
        if query.number in self.broken:
            objective = math.nan
            slope = None if slope is None else torch.full_like(slope, math.nan)
        return Evaluation(objective, slope, objective > self.threshold, cost=query.samples)


def box_domain(start: Sequence[float]) -> Domain:
    """Return a box in which every number is a block of its own, as parameters of controls are."""
    return Domain(torch.tensor(start), tuple(Block(1, name=f"number {i}") for i in range(len(start))))


def quadratic(peak: Sequence[float], curvatures: Sequence[float]) -> Value:
    """Return minus half the sum of curvature x squared distance from the peak."""
    middle, weights = torch.tensor(peak, dtype=torch.float64), torch.tensor(curvatures, dtype=torch.float64)
    return lambda u: -0.5 * (weights * (u - middle).square()).sum()


def valley(u: Tensor) -> Tensor:
    """Rosenbrock's curved valley (1960), turned over: 0 at its peak u = (0.75, 0.75), condition number there 2508.

    x = 4 u - 2, value = -(100 (x_2 - x_1^2)^2 + (1 - x_1)^2).
    """
    x, y = 4.0 * u[0] - 2.0, 4.0 * u[1] - 2.0
    return -(100.0 * (y - x.square()).square() + (1.0 - x).square())


def hessian(value: Callable[[Tensor], float], u: Tensor, directions: Tensor, steps: Sequence[float]) -> Tensor:
    """Estimate the second derivatives (k, k), float64, of an objective at u (d,) along directions (k, d), by
    differences of k half-widths."""
    moves = [step * direction for step, direction in zip(steps, directions, strict=True)]
    here, found = value(u), torch.zeros(len(moves), len(moves), dtype=torch.float64)
    for i, one in enumerate(moves):
        found[i, i] = (value(u + one) - 2.0 * here + value(u - one)) / steps[i] ** 2
        for j, other in enumerate(moves[:i]):
            crossed = value(u + one + other) - value(u + one - other) - value(u - one + other) + value(u - one - other)
            found[i, j] = found[j, i] = crossed / (4.0 * steps[i] * steps[j])
    return found


def condition_number(second: Tensor) -> float:
    """Return the largest over the smallest absolute eigenvalue of a symmetric matrix (k, k); infinite if that is 0."""
    sizes = torch.linalg.eigvalsh(second.double()).abs()
    return float(sizes.max() / sizes.min()) if float(sizes.min()) > 0.0 else math.inf


BARE = {"ground.size": 0.0}
"""Settings without the ground, so that a dark object has an outline and nothing else."""
SIZE = 24
"""Side of the pictures in pixels."""
SPP = 8
"""Samples a pixel of a picture and of a working gradient."""
REFERENCE_SPP = 64
"""Samples a pixel of a reference render."""
ERROR = 0.1
"""Relative error that the mean of a gradient may have beyond what its noise explains."""
DOUBT = 0.4
"""The noise of a comparison, as a share of the derivative, from which it decides nothing."""
SHARPNESS = 20.0
"""Logits per unit of the linear loss that the searched model answers with."""

ControlSettings = Mapping[str, Mapping[str, object]]


def small(
    object: str | Path | ObjectAsset,
    controls: ControlSettings,
    *,
    environment: str | Path | EnvironmentAsset | None = None,
    settings: Mapping[str, float] | None = None,
    parts: Sequence[ScenePart] = (),
    denoise: str = "none",
) -> Renderer:
    """Return `render(u, seed, spp)` of a small picture: as `Scene.renderer`, with parts of our own.

    Its differences are taken over a pixel: the losses of these cases are smooth.
    """
    description = describe(object, environment or plain_environment(), given=settings)
    for part in parts:
        description = description.with_part(part)
    space = make_space([make_control(name, given) for name, given in controls.items()], description)
    description = space.scene or description
    formation = ImageFormation(denoiser=denoise, resolution=(SIZE, SIZE), gain=description.gain)
    scene = MitsubaScene(description, (SIZE, SIZE), filter=formation.filter)
    motion = Motion(description, (SIZE, SIZE), scene.assembly)
    renderer = Renderer(scene, space, formation, 0, motion=motion)
    renderer.plan = renderer.plan.at_a_pixel()
    return renderer


# ---- things to put into a scene -------------------------------------------------------------------------------------


def plain_environment() -> EnvironmentAsset:
    """Return a sky brighter on one side and above, (16, 32, 3), so that turning it changes something."""
    rows, columns = np.mgrid[0:16, 0:32].astype(np.float32)
    light = 0.4 * (1.0 + 0.6 * np.sin(columns * (2.0 * np.pi / 32.0)) + 0.8 * np.cos(rows * (np.pi / 16.0)))
    return EnvironmentAsset("plain", np.repeat(light[:, :, None], 3, axis=2).clip(0.05).astype(np.float32))


def mesh_of(vertices: Sequence[Sequence[float]], faces: Sequence[Sequence[int]]) -> Mesh:
    """Return a mesh with UVs from x and z, whose normals face +x."""
    points = np.asarray(vertices, np.float32)
    facing = np.tile([1.0, 0.0, 0.0], (len(points), 1))
    low, high = points.min(axis=0), points.max(axis=0)
    uvs = ((points - low) / np.maximum(high - low, 1e-12))[:, 1:]
    return Mesh(points, np.asarray(faces, np.uint32), facing.astype(np.float32), uvs.astype(np.float32))


def thing(mesh: Mesh) -> ObjectAsset:
    """Return an object with a checked texture around a display-referred grey."""
    checks = np.indices((4, 4)).sum(axis=0) % 2
    base = np.float32(0.5) + np.float32(0.3) * (checks - np.float32(0.5))
    texels = np.repeat(base[:, :, None], 3, axis=2).clip(0.0, 1.0).astype(np.float32)
    return ObjectAsset("thing", mesh, texels, Material())


# ---- what is asked of a scene ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Examined:
    """What a scene showed.

    Attributes:
        finite: picture and gradient are finite, and nothing had to be set to zero.
        replaced: pixels and gradient entries that were NaN or infinite and were set to zero.
        inside: the picture is in [0, 1].
        compared: gradients beside their references; empty if that was not asked for.
        gradient: largest absolute entry of the gradient.
        mean: of the picture.
        result: of the short search.
    """

    finite: bool
    replaced: int
    inside: bool
    compared: Mapping[str, Agreement]
    gradient: float
    mean: float
    result: SearchResult

    def findings(self, *more: Check, **known: Any) -> Outcome:
        """Return the findings: the checks that every scene has, and more; `known` are fields in place of its own."""
        checks = [
            holds("the picture is in [0, 1]", self.inside),
            Check("values that were NaN or infinite", float(self.replaced), 0.0, 0.0),
            Check("objectives that were NaN or infinite", float(self.result.non_finite_objectives), 0.0, 0.0),
        ]
        error = None
        if self.compared:
            name, worst = max(self.compared.items(), key=lambda item: (item[1].excess, item[1].error))
            noisy, unsure = max(self.compared.items(), key=lambda item: item[1].doubt)
            checks.append(Check(f"noise of the comparison, {noisy}", unsure.doubt, most=DOUBT))
            checks.append(Check(f"gradient error beyond the noise, {name}", worst.excess, most=ERROR))
            error = worst.error
        measured = {"mean": self.mean, "largest gradient": self.gradient}
        own = {"relative_error": error, "ending": self.result.ending.value, "measured": measured}
        return Outcome(*checks, *more, finite=self.finite, **{**own, **known})


def dark() -> ObjectAsset:
    """Return the mug in black: what moves in the picture is its outline and nothing else, so little noise."""
    return replace(library.load_object("mug"), name="dark-mug", base_color=np.full((4, 4, 3), 0.02, np.float32))


def examine_gradient(
    renderer: Renderer,
    u: Tensor | None = None,
    *,
    compare: bool = True,
    evaluations: int = 3,
    spp: int = SPP,
    seeds: tuple[int, int] = (3, 12),
) -> Examined:
    """Render a configuration, the start by default, differentiate it, compare the gradient with references of some
    seeds (which cost most of the time), and search from there."""
    u = renderer.start if u is None else u
    loss = smooth_loss(renderer.formation.resolution)
    with torch.no_grad():
        picture = renderer(u, seed=0, spp=spp)
    _, gradient = renderer.gradient(loss, u, 0, spp)
    finite = bool(torch.isfinite(picture).all()) and bool(torch.isfinite(gradient).all())
    beside = compared(renderer, u, spp=spp, seeds=seeds) if compare else {}
    result = searched(renderer, u, evaluations, spp=spp)
    inside = float(picture.min()) >= 0.0 and float(picture.max()) <= 1.0
    largest, mean = float(gradient.abs().max()), float(picture.mean())
    return Examined(finite and renderer.non_finite == 0, renderer.non_finite, inside, beside, largest, mean, result)


def compared(
    renderer: Renderer, u: Tensor, *, spp: int = SPP, seeds: tuple[int, int] = (3, 12), repeats: int = 24
) -> dict[str, Agreement]:
    """Compare the plan's own gradient with common-random-number differences, of a linear loss of the raw picture, along
    each probe by its name."""
    before = renderer.formation
    renderer.formation = replace(before, transfer="linear")
    try:
        loss = smooth_loss(before.resolution)
        found: dict[str, Agreement] = {}
        for along in _together(renderer, loss, u, spp):
            high = spp if along[0].group.estimator == "image" else max(spp, REFERENCE_SPP)
            against = [reference(renderer, loss, u, one, seed=1, spp=high, repeats=seeds) for one in along]
            own = estimates(renderer, loss, u, along[0].group.estimator, along, seed=2, spp=spp, repeats=repeats)
            for probe, one, estimate in zip(along, against, own, strict=True):
                found[probe.name] = agreement(estimate, one, against)
        return found
    finally:
        renderer.formation = before


def _together(renderer: Renderer, loss: Loss, u: Tensor, spp: int) -> list[list[Probe]]:
    sets: dict[tuple[str, str], list[Probe]] = {}
    for probe in probes(renderer, loss, u, 0, spp):
        sets.setdefault((probe.group.control, probe.group.estimator), []).append(probe)
    return list(sets.values())


def searched(renderer: Renderer, u: Tensor, evaluations: int, *, spp: int = SPP) -> SearchResult:
    """Search for a picture that a linear model of two classes gets wrong.

    Its logits are 0 and `SHARPNESS` times the rise of the smooth linear loss over the configuration u, less 1.
    """
    loss = smooth_loss(renderer.formation.resolution)
    with torch.no_grad():
        here = float(loss(renderer(u, seed=0, spp=spp)))

    def margin(image: Tensor) -> Tensor:
        return SHARPNESS * (loss(image) - here) - 1.0

    domain = search_domain(renderer, u)
    steps = evaluations * (1 + domain.gradient_cost) + 1
    return search(
        partial(map, Evaluator(renderer, margin, spp)), domain, PGD(), steps=steps, seed=0, candidates=1, repeats=1
    )


class Evaluator:
    """Evaluates configurations of a renderer by a loss of the picture; over 0 is a success."""

    def __init__(self, renderer: Renderer, loss: Loss, spp: int) -> None:
        self.renderer, self.loss, self.spp = renderer, loss, spp

    def __call__(self, query: Query) -> Evaluation:
        """Answer a query."""
        renderer, derivative = self.renderer, None
        u, seed, spp, gradient = query.u, query.number, self.spp * query.samples, query.gradient
        bad, renders = renderer.non_finite, renderer.renders
        if gradient:
            value, derivative = renderer.gradient(self.loss, u, seed, spp, free=gradient == "free")
        else:
            with torch.no_grad():
                value = self.loss(renderer(u, seed=seed, spp=spp))
        objective = float(value)
        cost = (renderer.renders - renders) * query.samples
        return Evaluation(objective, derivative, objective > 0.0, renderer.non_finite - bad, cost)


def search_domain(renderer: Renderer, start: Tensor | None = None) -> Domain:
    """Return where a search of a renderer's space may look, from its start or another one."""
    space = renderer.space
    assert isinstance(space, Space)
    return objective.domain_of(
        space.controls,
        renderer.start if start is None else start,
        gradient_cost=renderer.plan.renders,
        partial_gradients=True,
    )
