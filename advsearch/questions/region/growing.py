"""`region`: the box around a configuration in which the model's verdict stays, and a map of its margin."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks.domain import batches
from advsearch.attacks.evaluation import most_at_once
from advsearch.engine.journal import Journal, Shared
from advsearch.engine.problem import Problem
from advsearch.engine.record import Stages
from advsearch.engine.surface_light import LIGHTS, SurfaceLight
from advsearch.engine.verifier import Verifier, ladder_of
from advsearch.errors import InputError, UnknownNameError
from advsearch.experiment import RunContext
from advsearch.options import OUT_OF_VIEW
from advsearch.questions.attack.carry_out import LOADING, problem_from_config
from advsearch.questions.attack.outcome import transport_of
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.region.result import AxisRange, BoxSide, GrownRegion, MarginMap, RegionConfig, RegionResult
from advsearch.questions.sweep.predicting import pays_from
from advsearch.report.figures import MARGIN, axis_title, figure_of, heat
from advsearch.runs.directory import CONFIG, RunDirectory, find_run
from advsearch.runs.summary import read_configuration
from advsearch.scene.predictor import Refusal, RefusalCause
from advsearch.scene.surface import renderer as surface_renderer
from advsearch.scene.surface.arrangement import CAMERAS, FREE
from advsearch.settings import split_names
from advsearch.statistics.intervals import clopper_pearson
from advsearch.trust.writing import write_bytes

MOST = 8  # A box is grown in at most so many parameters
AT_CENTRE = 20  # Trials of the centre


@dataclass(frozen=True, eq=False)
class Varied:
    """The parameters in which the box grows: their names, (k,) where they lie in u, and the groups of numbers that they
    belong to; and the centre (d,)."""

    names: tuple[str, ...]
    places: Tensor
    groups: frozenset[str]
    centre: Tensor

    def at(self, values: Tensor) -> Tensor:
        """Return the centre with other values (k,) of these parameters."""
        u = self.centre.clone()
        u[self.places] = values
        return u


def region_around(asked: RunContext[RegionConfig]) -> RegionResult:
    config, stages = asked.config, Stages(asked.progress)
    stages.begin("setup", LOADING)
    budget: dict[str, object] = {}
    if config.around is not None:  # its centre has to lie within
        searched = AttackConfig.from_yaml(find_run(config.around) / CONFIG)
        budget = {"epsilon": searched.epsilon, "norm": searched.norm}
    problem, warnings = problem_from_config(AttackConfig.of(config, **budget))
    for text in warnings:
        stages.progress.message(text)
    varied = _varied(problem, config)
    verifier = Verifier(Journal(asked.run, Shared(problem)), ladder_of(config.verify_spp, config.pixel_sampler), stages)
    findings, grown = verifier.findings, GrownRegion()
    with asked.until_interrupted():
        grown = _grown(verifier, config, varied, asked.run)
    stages.end()
    renders = {"verification": findings.verification_renders, "products": findings.predicted_trials}
    renders["verification"] += findings.transport.traced if findings.transport else 0
    return asked.result(
        RegionResult,
        **vars(grown),
        environment=problem.environment,
        model=problem.model.name,
        task=problem.task.title,
        controls=[bound.name for bound in problem.space.controls],
        image_formation=problem.renderer.formation,
        clean={"moved": problem.space.moved},
        warnings=warnings,
        transport=transport_of(findings) if findings.transport or findings.rendered_because else None,
        renders={name: number for name, number in renders.items() if number or name == "verification"},
        seconds={**stages.seconds, "total": stages.total},
    )


def _grown(verifier: Verifier, config: RegionConfig, varied: Varied, run: RunDirectory) -> GrownRegion:
    stages = verifier.stages
    verifier.choose_spp({"centre": varied.centre})
    verdict, spp = _verdict(verifier, varied.centre), verifier.findings.spp
    light = _light(verifier, config, varied)
    hint = f"pictures of {spp} samples a pixel; fewer parameters in `vary` or `verify_spp` shorten it"
    stages.begin("search", "growing the box", MOST_PROBED * len(varied.names), hint=hint, at_most=True)
    checking = False

    def on_check() -> None:
        nonlocal checking
        if not checking:
            most = ATTEMPTS * config.samples
            hint = f"{config.samples} pictures, and as many again where one is an exception; `samples` shortens it"
            stages.begin("search", "checking the box with fresh samples", most, hint=hint, at_most=True)
        checking = True

    def same(values: Tensor, number: int) -> bool:
        predictor = None if checking else light
        (trial,) = verifier.trials("region", {number: varied.at(values)}, sought=False, predictor=predictor)
        seen = trial.prediction.label != OUT_OF_VIEW  # a picture without the object is neither right nor wrong
        return seen and trial.success == verdict and not trial.not_a_number

    seed, centre = seeds.stream(config.seed, "region"), varied.centre[varied.places]
    grown = grow(same, centre, seed=seed, samples=config.samples, on_check=on_check)
    box = _box(verifier.problem, grown, varied)
    return GrownRegion(
        verdict="wrong" if verdict else "right",
        box=box,
        same=grown.same,
        samples=grown.samples,
        rate=grown.same / grown.samples,
        interval=grown.interval,
        volume=grown.volume,
        spp=spp,
        map=_map(verifier, config.map, varied, box, run, light) if config.map else None,
    )


def _light(verifier: Verifier, config: RegionConfig, varied: Varied) -> SurfaceLight | None:
    """What predicts pictures of the growing box and of the map, where a camera moves and that pays
    (docs/surface-light.md); fresh samples of the box are rendered."""
    problem, stages, findings = verifier.problem, verifier.stages, verifier.findings
    moved = surface_renderer.varied(problem.renderer, varied.groups)
    if not config.specialise or not moved & CAMERAS or not moved <= FREE:
        return None
    reason, least = surface_renderer.why_not_kept(problem.renderer), pays_from(problem.renderer, findings.spp)
    if reason is None and USUAL * len(varied.names) + config.map**2 < least:
        reason = Refusal(f"light on surfaces pays from {least} pictures on", RefusalCause.TOO_FEW_STEPS)
    if reason is None:
        stages.begin("transport", "finding the light on surfaces", LIGHTS, hint="`specialise=false` leaves it out")
        light = SurfaceLight(problem, 0, at=varied.centre, places=varied.places)
        light.prepare(stages.progress.advance)
        findings.transport, reason = light, light.too_far_off
        if reason is None:
            return light
    findings.transport, findings.rendered_because = None, reason
    return None


def _varied(problem: Problem, config: RegionConfig) -> Varied:
    places: dict[str, tuple[int, str]] = {}
    for group in problem.space.groups:
        for number in range(0 if group.options else group.size):
            places[group.name + (f".{number}" if group.size > 1 else "")] = group.begin + number, group.name
    names = tuple(places) if config.vary is None else split_names(config.vary)
    for name in names:
        if name not in places:
            raise UnknownNameError("parameter in `vary`", name, places)
    if not 1 <= len(names) <= MOST:
        raise InputError(f"vary: expected 1 to {MOST} parameters, got {len(names)}; name some of {', '.join(places)}")
    if config.map and len(names) != 2:
        raise InputError(f"map: expected two parameters in `vary`, got {len(names)}: {', '.join(names)}")
    centre = problem.domain.start.clone()
    if config.around is not None:
        values = torch.from_numpy(read_configuration(find_run(config.around)))
        if values.shape != centre.shape:
            raise InputError(
                f"`around` {config.around}: expected a run over the same controls, whose configuration has "
                f"{problem.domain.dim} numbers, got one with {len(values)}; leave `controls` out so that the run's own "
                "are taken"
            )
        centre = problem.domain.project(values)
    at, groups = zip(*(places[name] for name in names), strict=True)
    return Varied(names, torch.tensor(at), frozenset(groups), centre)


def _verdict(verifier: Verifier, centre: Tensor) -> bool:
    """Whether the model is wrong at the centre; refuses where that depends on the noise, or is not a number."""
    verifier.stages.begin("verification", "looking at the centre", AT_CENTRE)
    wrong = nothing = hidden = 0
    for trial in verifier.trials("centre", dict.fromkeys(range(AT_CENTRE), centre), sought=False):
        wrong, nothing = wrong + trial.success, nothing + trial.not_a_number
        hidden += trial.prediction.label == OUT_OF_VIEW
    if hidden:
        raise InputError(
            f"the object is not to be seen in {hidden} of {AT_CENTRE} trials at the centre, so there is no verdict; "
            "choose another centre"
        )
    if nothing:
        raise InputError(
            f"the model's prediction is not a number in {nothing} of {AT_CENTRE} trials at the centre, so there is no "
            "verdict; choose another centre, or mend the model"
        )
    verdict = verifier.problem.rule.decided(wrong, AT_CENTRE)
    if verdict is None:
        raise InputError(
            f"the model is wrong in {wrong} of {AT_CENTRE} trials at the centre, so its verdict there depends on the "
            "noise; choose another centre, or more samples with `verify_spp`"
        )
    return verdict


def _box(problem: Problem, grown: GrownBox, varied: Varied) -> list[BoxSide]:
    corners = grown.low, grown.high, grown.centre
    ends = [problem.describe(varied.at(values)) for values in corners]
    rows = []
    for place, name in enumerate(varied.names):
        stem, _, number = name.rpartition(".")
        known = name if name in ends[0] else stem
        if known in ends[0]:
            low, high, centre = (_number(end[known], number if known == stem else "") for end in ends)
            unit = str(ends[0][known].get("unit", ""))
        else:  # one of many numbers, which nobody describes
            low, high, centre = (float(side[place]) for side in corners)
            unit = "of the range"
        rows.append(BoxSide(name=name, unit=unit, low=low, high=high, centre=centre))
    return rows


def _number(described: Any, number: str) -> float:
    value = described["value"]
    return float(value[int(number)] if number else value)


def _map(
    verifier: Verifier, side: int, varied: Varied, box: Sequence[BoxSide], run: RunDirectory, light: SurfaceLight | None
) -> MarginMap:
    """Draw the margin over two parameters, with the line at which the verdict changes, and the box."""
    hint = f"{side * side} pictures of {verifier.findings.spp} samples a pixel; `map` or `verify_spp` shorten it"
    verifier.stages.begin("map", "drawing the map", side * side, hint=hint)
    steps = torch.linspace(0.0, 1.0, side) if side > 1 else torch.tensor([0.5])
    margins = list[float]()
    for numbers in batches(0, side * side, most_at_once(verifier.problem.domain.dim)):
        places = {number: varied.at(torch.stack([steps[number % side], steps[number // side]])) for number in numbers}
        margins += [-trial.score for trial in verifier.trials("map", places, sought=False, predictor=light)]
    rows = [margins[begin : begin + side] for begin in range(0, len(margins), side)]
    ends = [verifier.problem.describe(varied.at(torch.full((2,), end))) for end in (0.0, 1.0)]
    ranges = []
    for grown in box:
        low, high = (_number(end[grown.name], "") for end in ends) if grown.name in ends[0] else (0.0, 1.0)
        ranges.append(AxisRange(name=grown.name, unit=grown.unit, low=low, high=high))
    first, second = ranges
    across, up = box

    def draw(axes: Any) -> None:
        extent = (first.low, first.high, second.low, second.high)
        heat(axes, rows, extent, MARGIN, axis_title(first.name, first.unit), axis_title(second.name, second.unit))
        if min(margins) < 0.0 < max(margins):
            axes.contour(rows, levels=[0.0], extent=extent, colors="black", linewidths=1.0)
        corners_x = [across.low, across.high, across.high, across.low, across.low]
        corners_y = [up.low, up.low, up.high, up.high, up.low]
        axes.plot(corners_x, corners_y, color="black", linestyle="--", label="region")
        axes.plot(across.centre, up.centre, "k+", label="centre")
        axes.legend(loc="upper right", frameon=True)

    for suffix, data in figure_of(draw, (6.0, 4.6)).items():
        write_bytes(run.path / "images" / f"map.{suffix}", data)
    return MarginMap(axes=(first, second), margins=rows)


Same = Callable[[Tensor, int], bool]
"""(u, number) -> whether the prediction at u is that of the centre; number numbers its seed."""


@dataclass(frozen=True, eq=False)
class GrownBox:
    """A box in the unit box in which the prediction stays the same: the centre (d,) and its corners (d,), how many of
    the final samples had the centre's prediction, and pictures in all."""

    centre: Tensor
    low: Tensor
    high: Tensor
    same: int
    samples: int
    renders: int

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the share of the box with the centre's prediction; see the module."""
        return clopper_pearson(self.same, self.samples, 1.0 - 0.05 / ATTEMPTS)

    @property
    def volume(self) -> float:
        return float((self.high - self.low).prod())


LEVELS, ATTEMPTS = 6, 4  # How often the step of the faces is halved, and final checks at most
PROBES = 8  # Random points at which what a face would win is probed
USUAL, MOST_PROBED = 100, 400
"""Pictures of growing for each parameter, usually and at most: that is more than twice what boxes, balls, planes and
noise have taken."""
SHORTEST = 1e-3  # A face does not move by less


def grow(
    same: Same, centre: Tensor, *, seed: int, samples: int = 200, on_check: Callable[[], None] = lambda: None
) -> GrownBox:
    """Grow a box around the centre (d,) in [0, 1], then check it with `samples` points that nothing was fitted to.

    Each face in turn tries to move out by a share of what is left to the bound (1/2 at first, halved at every level at
    which no face can move any more). The slab that it would win is probed at random points; if all have the centre's
    prediction, it moves. Growing ends after `MOST_PROBED` pictures for each parameter at the latest. Then the box is
    sampled; on an exception, the face that cuts off the least of the box moves in to it and the box is sampled anew,
    with other seeds, `ATTEMPTS` times at most; the last check counts whatever it shows. `on_check` is told the
    beginning of each.
    """
    if samples < 1:
        raise InputError(f"samples: expected at least 1, got {samples}")
    if not bool(((centre >= 0.0) & (centre <= 1.0)).all()):
        raise InputError("the centre of a region has to lie inside the ranges of its parameters")
    low, high = centre.clone(), centre.clone()
    judged = drawn = 0

    def holds(u: Tensor) -> bool:
        nonlocal judged
        judged += 1
        return same(u, judged - 1)

    def points(bottom: Tensor, top: Tensor, number: int) -> Tensor:
        """(number, d) uniform in a box, other ones at every call."""
        nonlocal drawn
        generator = torch.Generator().manual_seed(seeds.stream(seed, "region", drawn))
        drawn += 1
        return torch.lerp(bottom, top, torch.rand(number, len(centre), generator=generator))

    def push(face: int, share: float) -> bool:
        """Move a face out if the slab that it wins has the centre's prediction; whether it moved."""
        axis, up = divmod(face, 2)
        room = float(1.0 - high[axis] if up else low[axis])
        step = room if room < 4.0 * SHORTEST else share * room
        if room <= 0.0 or (step < SHORTEST and step != room):
            return False
        bottom, top = low.clone(), high.clone()
        if up:
            bottom[axis], top[axis] = high[axis], high[axis] + step
        else:
            bottom[axis], top[axis] = low[axis] - step, low[axis]
        probes = points(bottom, top, PROBES)
        probes[0, axis] = outer = top[axis] if up else bottom[axis]
        if not all(holds(point) for point in probes):
            return False
        (high if up else low)[axis] = outer.clamp(0.0, 1.0)
        return True

    share, faces = 0.5, range(2 * len(centre))
    last = MOST_PROBED * len(centre) - len(faces) * PROBES
    for _ in range(LEVELS):
        while judged <= last and any([push(face, share) for face in faces]):
            pass
        share /= 2.0
    for attempt in range(ATTEMPTS):
        on_check()
        tried = points(low, high, samples)
        wrong = tried[[not holds(point) for point in tried]]
        if len(wrong) == 0 or attempt == ATTEMPTS - 1:
            break
        for point in wrong:  # the face that takes the least of the box away moves in, so that the point lies outside
            if bool(((point >= low) & (point <= high)).all()):
                width = (high - low).clamp_min(1e-12)
                loss = torch.where(point > centre, (high - point) / width, (point - low) / width)
                axis = int(torch.where(point == centre, torch.inf, loss).argmin())  # the centre stays inside
                face = high if point[axis] > centre[axis] else low
                face[axis] = torch.lerp(centre[axis], point[axis], 0.98)
    return GrownBox(centre, low, high, samples - len(wrong), samples, judged)
