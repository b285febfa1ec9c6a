"""What predicts pictures of a sweep, for each *group* of pictures that have the rest in
common, and by the group alone, so that a sweep that was stopped goes on with the same.
Some are traced beside; where predicted ones are too far off, the group is rendered.
Where light alone differs, pictures are put together from basis pictures
(docs/transport.md); where the camera alone differs, from light on surfaces
(docs/surface-light.md).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Query
from advsearch.attacks.domain import Product
from advsearch.engine.acceptance import (
    CHECK_SPP,
    VIEWS,
    ComparedView,
    Deviation,
    compared,
    view_of,
)
from advsearch.engine.problem import Problem
from advsearch.engine.surface_light import LIGHTS, SurfaceLight
from advsearch.engine.verifier import Verifier
from advsearch.questions.sweep.axes import Axis, Points
from advsearch.runs.results import LinearTransport, PredictionError
from advsearch.scene.assembly import ON_PICTURE
from advsearch.scene.color import to_8_bit
from advsearch.scene.mitsuba_backend.surface import RAYS
from advsearch.scene.predictor import (
    MOST_BYTES,
    NOISE,
    NOTHING_MOVES,
    Predictor,
    Refusal,
    RefusalCause,
)
from advsearch.scene.renderer import Renderer
from advsearch.scene.surface.arrangement import CAMERAS, COLOR, FREE, MAP
from advsearch.scene.surface.renderer import SurfaceRenderer, varied, why_not_kept
from advsearch.scene.transport.lights import BasisRenderer, Lights, lighting
from advsearch.scene.transport.matrix import SPP
from advsearch.trust.stored_files import scaled

PAYS = 2.0
"""Times the samples that a prediction takes, comparisons included, that a group has to
take rendered, for it to pay.
"""


class Groups:
    """How the pictures of a scene fall into groups: whether they may differ along each
    axis of the grid (`within`), and in what is `drawn`. The frames of a drive, on the
    axis `frames`, have one draw.
    """

    def __init__(
        self,
        grid: Product,
        samples: int,
        within: tuple[bool, ...],
        drawn: bool,
        frames: int | None = None,
    ) -> None:
        self.grid = grid
        self.samples = samples
        # draws are like one more axis, the fastest
        self._all = Product((*grid.sizes, samples))
        self._free = (
            *(
                within[axis] and (drawn or axis == frames)
                for axis in range(len(within))
            ),
            drawn,
        )
        axes = list(zip(self._all.sizes, self._free, strict=True))
        self._within = Product(tuple(size for size, free in axes if free))
        self._between = Product(tuple(size for size, free in axes if not free))
        self.size = self._within.count
        self.count = self._between.count
        first = self._free.index(True) if True in self._free else len(axes)
        # how many have to be held at once, so that none is made twice
        self.at_once = math.prod(size for size, free in axes[first:] if not free)

    def group(self, number: int) -> int:
        """Return the number of the group of a picture of the scene."""
        digits = zip(self._all.digits(number), self._free, strict=True)
        return self._between.index([digit for digit, free in digits if not free])

    def member(self, number: int, place: int) -> int:
        """Return the number of the picture at a place among those of the group of
        another one.
        """
        own = iter(self._within.digits(place))
        digits = zip(self._all.digits(number), self._free, strict=True)
        return self._all.index([next(own) if free else digit for digit, free in digits])


Fall = Callable[[frozenset[str]], Groups]
"""How pictures fall into groups that may differ in some groups of coordinates
(`control.parameter`).
"""


class BasisPictures:
    """Predicts pictures of one scene at one size by a basis picture of each light. It
    `follows` groups of coordinates: the pictures of a group may differ in these, and
    one `moves` if it changes more than the finished picture.
    """

    name = "basis pictures"
    samples = SPP
    """Samples a pixel of what predicts."""
    bytes = 0
    """Memory of what groups share."""

    def __init__(self, renderer: Renderer, seed: int) -> None:
        self._renderer = renderer
        self._moving = lighting(renderer)
        self.follows, self.moves = (
            frozenset(self._moving.groups),
            any(self._moving.groups.values()),
        )

    def find_refusal(self, fall: Fall, spp: int) -> Refusal | None:
        """Return why pictures of so many samples a pixel are rendered; None if they are
        predicted.
        """
        renderer = self._renderer
        groups = fall(self.follows)
        if renderer.formation.denoiser != "oidn":
            return NOISE
        inputs = renderer.scene.assembly(renderer.space.inputs(renderer.start))
        lights = len(Lights(renderer, self._moving, inputs).alone)
        least = math.ceil(PAYS * (lights * SPP + VIEWS * (2 * CHECK_SPP + spp)) / spp)
        if groups.size < least:
            return Refusal(
                f"basis pictures pay where {least} pictures or more differ in light "
                f"alone; here {groups.size} do"
            )
        height, width = renderer.formation.resolution
        if groups.at_once * lights * 8 * height * width > scaled(MOST_BYTES):
            return Refusal(
                f"basis pictures of {groups.count} groups take too much memory; make "
                "light the last axes of the grid"
            )
        return None

    def make_predictor(self, u: Tensor, seed: int) -> Predictor:
        """Return what predicts the pictures that have everything else in common with a
        configuration.
        """
        return BasisRenderer(self._renderer, u, seed, moving=self._moving)


ARRANGED = 2_200_000
LIT = 80_000
"""Samples that take as long as finding what texels see, and the light of an
environment: 0.8 and 0.03 s where a picture of 128 x 128 pixels with 8 samples a pixel
takes 46 ms.
"""
SHOWN = 0.8  # samples a pixel that take as long as a predicted picture
ARRANGED_BYTES = 50_000_000  # memory of an arrangement, about
LIT_BYTES = 4_000_000  # memory of the light of an environment beside its map, about


def pays_from(renderer: Renderer, spp: int, arrangements: float = 1.0) -> int:
    """Return how many pictures under one light have to be wanted for it to pay, where
    what texels see is found `arrangements` times for each light.
    """
    height, width = renderer.formation.resolution
    samples = (ARRANGED * arrangements + LIT) / (height * width) + VIEWS * (
        2 * CHECK_SPP + spp
    )
    return math.ceil(PAYS * samples / (spp - SHOWN))


class LightOnSurfaces:
    """The same by light that is kept on surfaces. Groups in which object and
    surroundings stand the same share what these see of each other; its rays are the
    same wherever things stand, so that it does not matter which of the groups is first.
    """

    name = "surface light"
    samples = RAYS

    def __init__(self, renderer: Renderer, seed: int) -> None:
        self._renderer, self._seed = renderer, seeds.stream(seed, "surface light")
        self._arranged: list[SurfaceRenderer] = []
        self._changes = {
            group.name: varied(renderer, [group.name])
            for group in renderer.space.groups
        }
        self.follows = self._changing(CAMERAS)
        self.moves = any(self._changes[name] & CAMERAS for name in self.follows)

    def _changing(self, inputs: frozenset[str]) -> frozenset[str]:
        """The groups of coordinates that change nothing but these inputs, and the
        finished picture.
        """
        return frozenset(
            name
            for name, found in self._changes.items()
            if found <= inputs | ON_PICTURE
        )

    def find_refusal(self, fall: Fall, spp: int) -> Refusal | None:
        groups = fall(self.follows)
        arranged = fall(self._changing(FREE - {COLOR}))
        self._most_arranged = arranged.at_once
        least = pays_from(self._renderer, spp, arranged.count / groups.count)
        if groups.size < least:
            return Refusal(
                f"light on surfaces pays where {least} pictures differ in the camera "
                f"alone; here {groups.size} do"
            )
        if (reason := why_not_kept(self._renderer)) is not None:
            return reason
        lit = LIT_BYTES + 4 * self._renderer.scene.base(MAP).numel()
        if arranged.at_once * ARRANGED_BYTES + groups.at_once * lit > scaled(
            MOST_BYTES
        ):
            return Refusal(
                f"light of {groups.count} groups takes too much memory; make the "
                "camera the last axes of the grid"
            )
        return None

    def make_predictor(self, u: Tensor, seed: int) -> Predictor:
        with torch.no_grad():
            inputs = self._renderer.scene.assembly(self._renderer.space.inputs(u))
            arranged = next((one for one in self._arranged if one.stands(inputs)), None)
            if arranged is None:
                if len(self._arranged) >= self._most_arranged:
                    self._arranged.pop(0)
                arranged = SurfaceRenderer(self._renderer, u, self._seed)
                self._arranged.append(arranged)
            return arranged.under(inputs)

    @property
    def bytes(self) -> int:
        return sum(one.bytes for one in self._arranged)


@dataclass(frozen=True, eq=False)
class SweptPicture:
    """A picture (H, W, 3), sRGB in [0, 1]; the samples a pixel of what predicted it, 0
    if it was rendered; and how many were traced for it, of the first of a group all
    that were traced for the group.
    """

    picture: Tensor
    predicted: int
    traced: int


@dataclass
class PredictedSweep:
    """Makes pictures of one scene at one size, as a problem of one of the models has
    them.

    `before` it, the other scenes have so many pictures. Every picture is rendered where
    there is a `refusal`, and in groups that are `left` since predictions were too far
    off.
    """

    problem: Problem
    points: Points
    axes: tuple[Axis, ...]
    seed: int
    specialise: bool
    before: int = 0
    deviations: list[Deviation] = field(default_factory=list)
    seconds: float = 0.0
    left: set[int] = field(default_factory=set)
    _spent: dict[int, int] = field(default_factory=dict)
    _held: dict[int, Predictor | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.renderer = self.problem.renderer
        self.method, self.refusal = self._choose_method()
        self._groups = self._fall(self.method.follows)

    def _choose_method(self) -> tuple[BasisPictures | LightOnSurfaces, Refusal | None]:
        """Return the cheapest method that pays here, without a refusal.

        If none does, return the first that could follow something that varies, and why
        it is not used.
        """
        refused: list[tuple[BasisPictures | LightOnSurfaces, Refusal]] = []
        for method_type in (BasisPictures, LightOnSurfaces):  # cheapest first
            method = method_type(self.renderer, self.seed)
            refusal = self._find_refusal(method)
            if refusal is None:
                return method, None
            refused.append((method, refusal))
        return next(
            (pair for pair in refused if pair[1] is not NOTHING_MOVES), refused[-1]
        )

    def _find_refusal(self, method: BasisPictures | LightOnSurfaces) -> Refusal | None:
        """Return why a method does not predict these pictures; None if it does."""
        if not method.moves:
            return NOTHING_MOVES
        if self.renderer.composed or not self.specialise:
            return Refusal(self.renderer.composed or "nothing is left out")
        return method.find_refusal(self._fall, self.problem.spp)

    def _fall(self, follows: frozenset[str]) -> Groups:
        of_grid = [axis.name for axis in self.axes]
        drawn = all(
            group.name in follows
            for group in self.renderer.space.groups
            if group.name not in of_grid
        )
        within = tuple(name in follows for name in of_grid)
        return Groups(
            self.points.grid,
            self.points.samples,
            within,
            drawn,
            self.points.units.frames,
        )

    def pictures(self, asked: Mapping[int, Query]) -> dict[int, SweptPicture]:
        """Return pictures by their numbers in the scene, each rendered or predicted."""
        pictures: dict[int, SweptPicture] = {}
        waiting: dict[Predictor, list[int]] = {}
        for number, query in asked.items():
            predictor = (
                None
                if self.refusal is not None
                else self._of(self._groups.group(number), number)
            )
            if predictor is None:
                picture = self.renderer(query.u, seed=query.seed, spp=self.problem.spp)
                pictures[number] = SweptPicture(
                    picture, predicted=0, traced=self._spent_on(number) + 1
                )
            else:
                waiting.setdefault(predictor, []).append(number)
        for predictor, numbers in waiting.items():
            predicted = predictor.pictures([asked[number].u for number in numbers])
            for number, picture in zip(numbers, predicted, strict=True):
                pictures[number] = SweptPicture(
                    picture, self.method.samples, self._spent_on(number)
                )
        return pictures

    def _spent_on(self, number: int) -> int:
        """Pictures that were traced for a group, said of its first picture alone."""
        first = number == self._groups.member(number, 0)
        return self._spent.get(self._groups.group(number), 0) * first

    def _of(self, group: int, number: int) -> Predictor | None:
        """What predicts the pictures of a group, of which this is one; None where they
        are rendered.
        """
        if group in self._held:
            return self._held[group]
        if len(self._held) >= self._groups.at_once:
            self._held.pop(next(iter(self._held)))
        begun = time.perf_counter()
        seed = seeds.stream(self.seed, "light", self.before + group)
        made = self.method.make_predictor(self._configuration(number, 0), seed)

        def margin(picture: Tensor, u: Tensor) -> float:
            return self.problem.judge(to_8_bit(picture), u).margin

        def view(check: int) -> ComparedView:
            u = self._configuration(
                number, seeds.stream(seed, "check", check) % self._groups.size
            )
            (predicted,) = made.pictures([u])
            noise = seeds.stream(seed, "traced", check)
            return view_of(self.renderer, predicted, u, noise, self.problem.spp, margin)

        with torch.no_grad():
            deviation = compared(view)
        self.deviations.append(deviation)
        self._spent[group] = made.lights + deviation.pictures
        if not deviation.good:
            self.left.add(group)
        self._held[group] = made if deviation.good else None
        self.seconds += time.perf_counter() - begun
        return self._held[group]

    def _configuration(self, number: int, place: int) -> Tensor:
        member = self._groups.member(number, place)
        return self.points.configurations(member, 1, self.before)[0]

    @property
    def not_finite(self) -> int:
        """How many values were not finite, and were set to 0."""
        return sum(one.non_finite for one in self._held.values() if one is not None)

    def summary(self) -> LinearTransport | None:
        """What a result holds of it; None where nothing moves that it follows."""
        if self.refusal is NOTHING_MOVES:
            return None
        if self.refusal is not None:
            return LinearTransport(used=False, reason=str(self.refusal))
        worst = (
            max(self.deviations, key=lambda one: one.levels)
            if self.deviations
            else None
        )
        several = (
            f"{len(self.left)} of {self._groups.count} groups were rendered: "
            "predicted pictures were too far off"
        )
        return LinearTransport(
            used=True,
            way=self.method.name,
            reason=several if self.left else None,
            entries=0,
            bytes=self.method.bytes
            + sum(one.bytes for one in self._held.values() if one is not None),
            seconds=self.seconds,
            renewed=0,
            error=None if worst is None else PredictionError.of(worst),
        )


def combined(found: Sequence[LinearTransport | None]) -> LinearTransport | None:
    """Return what a result holds of several scenes: the worst error, the largest
    memory, all seconds.
    """
    told = [one for one in found if one is not None]
    used = [one for one in told if one.used]
    if not used:
        return told[-1] if told else None
    worst = {
        "reason": next((one.reason for one in used if one.reason), None),
        "bytes": max(one.bytes or 0 for one in used),
        "seconds": math.fsum(one.seconds or 0.0 for one in used),
        "error": max(
            (one.error for one in used if one.error),
            key=lambda error: error.levels or 0.0,
            default=None,
        ),
    }
    return used[0].model_copy(update=worst)


def prepare_surface_light(
    verifier: Verifier, at: Tensor, coordinates: Tensor, n_images: int
) -> None:
    """Find the light on surfaces around a configuration, if it predicts trials there
    more cheaply than renders.

    The verifier's findings then have it as `transport`, or state why images are
    rendered where cameras move.

    Args:
        verifier: of the trials, whose sample count is known.
        at: the configuration (d,).
        coordinates: of the numbers that vary (k,).
        n_images: trials, about.
    """
    problem = verifier.problem
    varying = set(coordinates.tolist())
    groups = [
        group.name
        for group in problem.space.groups
        if not varying.isdisjoint(range(group.begin, group.begin + group.size))
    ]
    changed_inputs = varied(problem.renderer, groups)
    if not changed_inputs & CAMERAS or not changed_inputs <= FREE:
        return
    findings = verifier.findings
    findings.rendered_because = why_not_kept(problem.renderer)
    min_images = pays_from(problem.renderer, findings.spp)
    if findings.rendered_because is None and n_images < min_images:
        reason = f"light on surfaces pays from {min_images} pictures on"
        findings.rendered_because = Refusal(reason, RefusalCause.TOO_FEW_STEPS)
    if findings.rendered_because is not None:
        return
    title = "finding the light on surfaces"
    verifier.stages.begin(
        "transport", title, LIGHTS, hint="`specialise=false` leaves it out"
    )
    light = SurfaceLight(problem, 0, at=at, places=coordinates)
    light.prepare(verifier.stages.progress.advance)
    findings.transport = light
    findings.rendered_because = light.too_far_off
    if findings.rendered_because is not None:
        findings.transport = None
