"""Predictors of the images of a sweep.

Each serves a *group* of images that have the rest in common, and follows from the group
alone, so that a sweep that was stopped goes on with the same. Some images are traced
for comparison; where predicted ones deviate too much, the group is rendered. Where
light alone differs, images are combined from basis images (docs/transport.md); where
the camera alone differs, from light on surfaces (docs/surface-light.md).
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

MIN_SAVING_FACTOR = 2.0
"""A group is predicted if rendering it takes this many times the samples of a
prediction, comparisons included.
"""


class Groups:
    """How the images of a scene fall into groups that one predictor serves.

    Args:
        grid: of the sweep.
        samples: at each point of the grid.
        within: whether images of a group may differ along each axis of the grid.
        drawn: whether they may differ in what is sampled.
        frames: the axis with the frames of a drive, which have one draw.

    Attributes:
        size: images of a group.
        count: groups.
        at_once: groups that have to be cached, so that no predictor is made twice.
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
        # Samples are like one more axis, the fastest.
        self._all_axes = Product((*grid.sizes, samples))
        axis_is_within = [
            may_differ and (drawn or axis == frames)
            for axis, may_differ in enumerate(within)
        ]
        self._is_within = (*axis_is_within, drawn)
        within_sizes = self._select(self._all_axes.sizes, True)
        between_sizes = self._select(self._all_axes.sizes, False)
        self._within = Product(tuple(within_sizes))
        self._between = Product(tuple(between_sizes))
        self.size = self._within.count
        self.count = self._between.count
        self.at_once = 1
        if True in self._is_within:
            # Groups differ along slower axes one after the other.
            first_within = self._is_within.index(True)
            for axis in range(first_within, len(self._is_within)):
                if not self._is_within[axis]:
                    self.at_once *= self._all_axes.sizes[axis]

    def _select(self, values: Sequence[int], is_within: bool) -> list[int]:
        """Return the values of the axes within groups, or of those between."""
        return [
            value
            for value, within in zip(values, self._is_within, strict=True)
            if within == is_within
        ]

    def group(self, number: int) -> int:
        """Return the index of the group of an image of the scene."""
        digits = self._all_axes.digits(number)
        return self._between.index(self._select(digits, False))

    def member(self, number: int, index: int) -> int:
        """Return the number of another image of the group of an image.

        Args:
            number: of the image.
            index: index of the other one in the group.
        """
        within_digits = iter(self._within.digits(index))
        digits = self._all_axes.digits(number)
        return self._all_axes.index(
            [
                next(within_digits) if is_within else digit
                for digit, is_within in zip(digits, self._is_within, strict=True)
            ]
        )


Fall = Callable[[frozenset[str]], Groups]
"""Makes the groups whose images may differ in some groups of coordinates
(`control.parameter`).
"""


class BasisPictures:
    """Predicts the images of a scene at one size by a basis image of each light.

    Attributes:
        follows: groups of coordinates in which the images of a group may differ.
        moves: whether one of these changes more than the finished image.
    """

    name = "basis pictures"
    samples = SPP
    """Samples per pixel of what predicts."""
    bytes = 0
    """Memory of what groups share."""

    def __init__(self, renderer: Renderer, seed: int) -> None:
        self._renderer = renderer
        self._moving = lighting(renderer)
        self.follows = frozenset(self._moving.groups)
        self.moves = any(self._moving.groups.values())

    def find_refusal(self, fall: Fall, spp: int) -> Refusal | None:
        """Return why images are rendered; None if they are predicted.

        Args:
            fall: makes the groups.
            spp: samples per pixel of the images.
        """
        renderer = self._renderer
        groups = fall(self.follows)
        if renderer.formation.denoiser != "oidn":
            return NOISE
        inputs = renderer.scene.assembly(renderer.space.inputs(renderer.start))
        n_lights = len(Lights(renderer, self._moving, inputs).alone)
        prediction_samples = n_lights * SPP + VIEWS * (2 * CHECK_SPP + spp)
        min_images = math.ceil(MIN_SAVING_FACTOR * prediction_samples / spp)
        if groups.size < min_images:
            return Refusal(
                f"basis pictures pay where {min_images} pictures or more differ in "
                f"light alone; here {groups.size} do"
            )
        height, width = renderer.formation.resolution
        n_bytes = groups.at_once * n_lights * 8 * height * width
        if n_bytes > scaled(MOST_BYTES):
            return Refusal(
                f"basis pictures of {groups.count} groups take too much memory; make "
                "light the last axes of the grid"
            )
        return None

    def make_predictor(self, u: Tensor, seed: int) -> Predictor:
        """Return the predictor of the images of a group.

        Args:
            u: (d,) configuration of one of them.
            seed: of its light paths.
        """
        return BasisRenderer(self._renderer, u, seed, moving=self._moving)


ARRANGEMENT_SAMPLES = 2_200_000
LIGHT_SAMPLES = 80_000
"""Samples that take as long as finding what texels see, and the light of an
environment: 0.8 and 0.03 s where an image of 128 x 128 pixels with 8 samples per pixel
takes 46 ms.
"""
PREDICTION_SPP = 0.8  # samples per pixel that take as long as a predicted image
ARRANGEMENT_BYTES = 50_000_000  # memory of an arrangement, about
LIGHT_BYTES = 4_000_000  # memory of the light of an environment besides its map, about


def find_break_even(renderer: Renderer, spp: int, arrangements: float = 1.0) -> int:
    """Return how many images under one light make light on surfaces pay.

    Args:
        renderer: of the images.
        spp: samples per pixel of the images.
        arrangements: arrangements that are found for each light.
    """
    height, width = renderer.formation.resolution
    light_samples = (ARRANGEMENT_SAMPLES * arrangements + LIGHT_SAMPLES) / (
        height * width
    )
    check_samples = VIEWS * (2 * CHECK_SPP + spp)
    samples = light_samples + check_samples
    return math.ceil(MIN_SAVING_FACTOR * samples / (spp - PREDICTION_SPP))


class LightOnSurfaces:
    """Predicts the images of a scene at one size by light that is stored on surfaces.

    Groups in which object and surroundings stand the same share an *arrangement*: what
    these see of each other. Its rays are the same wherever things stand, so that it
    does not matter which of the groups is first.

    Attributes:
        follows: groups of coordinates in which the images of a group may differ.
        moves: whether one of these moves the camera.
    """

    name = "surface light"
    samples = RAYS

    def __init__(self, renderer: Renderer, seed: int) -> None:
        self._renderer = renderer
        self._seed = seeds.stream(seed, "surface light")
        self._arrangements: list[SurfaceRenderer] = []
        self._max_arrangements = 0
        self._changed_inputs = {
            group.name: varied(renderer, [group.name])
            for group in renderer.space.groups
        }
        self.follows = self._find_groups_changing_only(CAMERAS)
        self.moves = any(self._changed_inputs[name] & CAMERAS for name in self.follows)

    def _find_groups_changing_only(self, inputs: frozenset[str]) -> frozenset[str]:
        """Return the groups of coordinates that change nothing but these inputs.

        They may change the finished image, too.
        """
        allowed = inputs | ON_PICTURE
        return frozenset(
            name for name, changed in self._changed_inputs.items() if changed <= allowed
        )

    def find_refusal(self, fall: Fall, spp: int) -> Refusal | None:
        """Return why images are rendered; None if they are predicted.

        Args:
            fall: makes the groups.
            spp: samples per pixel of the images.
        """
        groups = fall(self.follows)
        arranged = fall(self._find_groups_changing_only(FREE - {COLOR}))
        self._max_arrangements = arranged.at_once
        min_images = find_break_even(self._renderer, spp, arranged.count / groups.count)
        if groups.size < min_images:
            return Refusal(
                f"light on surfaces pays where {min_images} pictures differ in the "
                f"camera alone; here {groups.size} do"
            )
        refusal = why_not_kept(self._renderer)
        if refusal is not None:
            return refusal
        light_bytes = LIGHT_BYTES + 4 * self._renderer.scene.base(MAP).numel()
        n_bytes = arranged.at_once * ARRANGEMENT_BYTES + groups.at_once * light_bytes
        if n_bytes > scaled(MOST_BYTES):
            return Refusal(
                f"light of {groups.count} groups takes too much memory; make the "
                "camera the last axes of the grid"
            )
        return None

    def make_predictor(self, u: Tensor, seed: int) -> Predictor:
        """Return the predictor of the images of a group.

        Args:
            u: (d,) configuration of one of them.
            seed: not used; all arrangements have the same rays.
        """
        with torch.no_grad():
            inputs = self._renderer.scene.assembly(self._renderer.space.inputs(u))
            for arrangement in self._arrangements:
                if arrangement.stands(inputs):
                    return arrangement.under(inputs)
            if len(self._arrangements) >= self._max_arrangements:
                self._arrangements.pop(0)
            arrangement = SurfaceRenderer(self._renderer, u, self._seed)
            self._arrangements.append(arrangement)
            return arrangement.under(inputs)

    @property
    def bytes(self) -> int:
        """Memory of the arrangements."""
        return sum(arrangement.bytes for arrangement in self._arrangements)


@dataclass(frozen=True, eq=False)
class SweptPicture:
    """An image of a sweep.

    Attributes:
        picture: (H, W, 3), sRGB in [0, 1].
        predicted: samples per pixel of what predicted it; 0 if it was rendered.
        traced: images that were traced for it; those for a group count for the first
            image of the group.
    """

    picture: Tensor
    predicted: int
    traced: int


@dataclass
class PredictedSweep:
    """Makes the images of one scene at one size, by prediction where that pays.

    Attributes:
        problem: of a model that gets these images.
        points: the configurations of the scene.
        axes: of the grid.
        seed: of the predictors.
        specialise: whether anything is predicted.
        before: images of the scenes before this one.
        deviations: of the predictors that were compared with traced images.
        seconds: that making and comparing them took.
        left: groups whose images are rendered because predictions deviated too much.
        method: how images are predicted, or would be.
        refusal: why all images are rendered; None if they are predicted.
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
    # images that were traced for each group
    _traced: dict[int, int] = field(default_factory=dict)
    # None where the images of a group are rendered
    _predictors: dict[int, Predictor | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.renderer = self.problem.renderer
        self.method, self.refusal = self._choose_method()
        self._groups = self._make_groups(self.method.follows)

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
        for method, refusal in refused:
            if refusal is not NOTHING_MOVES:
                return method, refusal
        return refused[-1]

    def _find_refusal(self, method: BasisPictures | LightOnSurfaces) -> Refusal | None:
        """Return why a method does not predict these images; None if it does."""
        if not method.moves:
            return NOTHING_MOVES
        if self.renderer.composed or not self.specialise:
            return Refusal(self.renderer.composed or "nothing is left out")
        return method.find_refusal(self._make_groups, self.problem.spp)

    def _make_groups(self, follows: frozenset[str]) -> Groups:
        """Return the groups whose images may differ in some groups of coordinates."""
        axis_names = [axis.name for axis in self.axes]
        follows_all_sampled = all(
            group.name in follows
            for group in self.renderer.space.groups
            if group.name not in axis_names
        )
        return Groups(
            self.points.grid,
            self.points.samples,
            tuple(name in follows for name in axis_names),
            follows_all_sampled,
            self.points.units.frames,
        )

    def pictures(self, query_of_image: Mapping[int, Query]) -> dict[int, SweptPicture]:
        """Render or predict images.

        Args:
            query_of_image: the queries by the number of the image in the scene.

        Returns:
            The images by their numbers.
        """
        images: dict[int, SweptPicture] = {}
        numbers_by_predictor: dict[Predictor, list[int]] = {}
        for number, query in query_of_image.items():
            predictor = None
            if self.refusal is None:
                group = self._groups.group(number)
                predictor = self._load_predictor(group, number)
            if predictor is None:
                image = self.renderer(query.u, seed=query.seed, spp=self.problem.spp)
                n_traced = self._count_traced(number) + 1
                images[number] = SweptPicture(image, predicted=0, traced=n_traced)
            else:
                numbers_by_predictor.setdefault(predictor, []).append(number)
        for predictor, numbers in numbers_by_predictor.items():
            predicted = predictor.pictures(
                [query_of_image[number].u for number in numbers]
            )
            for number, image in zip(numbers, predicted, strict=True):
                n_traced = self._count_traced(number)
                images[number] = SweptPicture(image, self.method.samples, n_traced)
        return images

    def _count_traced(self, number: int) -> int:
        """Return the images that were traced for the group of its first image.

        Of the other images of the group it is 0.
        """
        if number != self._groups.member(number, 0):
            return 0
        return self._traced.get(self._groups.group(number), 0)

    def _load_predictor(self, group: int, number: int) -> Predictor | None:
        """Return the predictor of a group; None if its images are rendered.

        It is made by the group alone, so that a sweep that was stopped goes on with the
        same.

        Args:
            group: its index.
            number: of an image of the group, in the scene.
        """
        if group in self._predictors:
            return self._predictors[group]
        if len(self._predictors) >= self._groups.at_once:
            self._predictors.pop(next(iter(self._predictors)))
        begin = time.perf_counter()
        seed = seeds.stream(self.seed, "light", self.before + group)
        predictor = self.method.make_predictor(self._configuration(number, 0), seed)
        deviation = self._compare(predictor, number, seed)
        self.deviations.append(deviation)
        self._traced[group] = predictor.lights + deviation.pictures
        if not deviation.good:
            self.left.add(group)
        self._predictors[group] = predictor if deviation.good else None
        self.seconds += time.perf_counter() - begin
        return self._predictors[group]

    def _compare(self, predictor: Predictor, number: int, seed: int) -> Deviation:
        """Compare predicted images of a group with traced ones.

        Args:
            predictor: of the group.
            number: of an image of the group, in the scene.
            seed: selects the images that are compared.
        """

        def margin(image: Tensor, u: Tensor) -> float:
            return self.problem.judge(to_8_bit(image), u).margin

        def view(check: int) -> ComparedView:
            index = seeds.stream(seed, "check", check) % self._groups.size
            u = self._configuration(number, index)
            (predicted,) = predictor.pictures([u])
            noise_seed = seeds.stream(seed, "traced", check)
            return view_of(
                self.renderer, predicted, u, noise_seed, self.problem.spp, margin
            )

        with torch.no_grad():
            return compared(view)

    def _configuration(self, number: int, index: int) -> Tensor:
        """Return a configuration (d,) of the group of an image, by its index there."""
        member = self._groups.member(number, index)
        return self.points.configurations(member, 1, self.before)[0]

    @property
    def not_finite(self) -> int:
        """How many values were not finite, and were set to 0."""
        return sum(
            predictor.non_finite
            for predictor in self._predictors.values()
            if predictor is not None
        )

    def summary(self) -> LinearTransport | None:
        """Return what a result holds of the predictions.

        None if nothing moves that any method follows.
        """
        if self.refusal is NOTHING_MOVES:
            return None
        if self.refusal is not None:
            return LinearTransport(used=False, reason=str(self.refusal))
        error = None
        if self.deviations:
            worst = max(self.deviations, key=lambda deviation: deviation.levels)
            error = PredictionError.of(worst)
        reason = None
        if self.left:
            reason = (
                f"{len(self.left)} of {self._groups.count} groups were rendered: "
                "predicted pictures were too far off"
            )
        predictor_bytes = sum(
            predictor.bytes
            for predictor in self._predictors.values()
            if predictor is not None
        )
        return LinearTransport(
            used=True,
            way=self.method.name,
            reason=reason,
            entries=0,
            bytes=self.method.bytes + predictor_bytes,
            seconds=self.seconds,
            renewed=0,
            error=error,
        )


def combined(all_summaries: Sequence[LinearTransport | None]) -> LinearTransport | None:
    """Combine what predicted the images of several scenes.

    Returns:
        The worst error, the largest memory, and all seconds; None if nothing moves in
        any scene.
    """
    summaries = [summary for summary in all_summaries if summary is not None]
    used = [summary for summary in summaries if summary.used]
    if not used:
        return summaries[-1] if summaries else None
    reasons = [summary.reason for summary in used if summary.reason]
    errors = [summary.error for summary in used if summary.error]
    update = {
        "reason": reasons[0] if reasons else None,
        "bytes": max(summary.bytes or 0 for summary in used),
        "seconds": math.fsum(summary.seconds or 0.0 for summary in used),
        "error": max(errors, key=lambda error: error.levels or 0.0, default=None),
    }
    return used[0].model_copy(update=update)


def prepare_surface_light(
    verifier: Verifier, at: Tensor, coordinates: Tensor, n_images: int
) -> None:
    """Prepare light on surfaces around a configuration, if it is cheaper than renders.

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
    min_images = find_break_even(problem.renderer, findings.spp)
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
