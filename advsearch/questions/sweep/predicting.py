"""Predictors of the images of a sweep.

A predictor serves a *group*: images of a sweep that differ in one respect only. Where
they differ in light alone, they are combined from basis images (docs/transport.md);
where they differ in the camera alone, they are made from light on surfaces
(docs/surface-light.md). Some images are traced for comparison; where predicted ones
deviate too much, the group is rendered. A predictor follows from its group alone, so
that a sweep that was stopped continues with the same one.
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
from advsearch.attacks.domain import ProductIndex
from advsearch.engine.acceptance import (
    CHECK_SPP,
    N_VIEWS,
    ComparedView,
    Deviation,
    compare_views,
    compare_with_traced,
)
from advsearch.engine.problem import Problem
from advsearch.engine.surface_light import N_LIGHTS, SurfaceLight
from advsearch.engine.verifier import Verifier
from advsearch.questions.sweep.axes import Axis, Points
from advsearch.runs.results import LinearTransport, PredictionError
from advsearch.scene.assembly import IMAGE_INPUTS
from advsearch.scene.color import round_to_8_bit
from advsearch.scene.mitsuba_backend.surface import RAYS_PER_PIXEL
from advsearch.scene.predictor import (
    MAX_BYTES,
    NOISE,
    NOTHING_MOVES,
    Predictor,
    Refusal,
    RefusalCause,
)
from advsearch.scene.renderer import Renderer
from advsearch.scene.surface.arrangement import (
    CAMERA_INPUTS,
    COLOR_INPUT,
    ENVIRONMENT_INPUT,
    FREE_INPUTS,
)
from advsearch.scene.surface.renderer import (
    SurfaceRenderer,
    find_changed_inputs,
    find_scene_refusal,
)
from advsearch.scene.transport.lights import BasisRenderer, LightBasis, find_lighting
from advsearch.scene.transport.matrix import COLLECTED_SPP
from advsearch.trust.stored_files import scale_limit

MIN_SAVING_FACTOR = 2.0
"""A group is predicted if rendering it takes this many times the samples of a
prediction, comparisons included.
"""


class Groups:
    """How the images of a scene fall into groups that one predictor serves.

    Images of a group differ along some axes, those *within* groups, and have the same
    index along the others, those *between* groups.

    Args:
        grid: grid of the sweep.
        samples: number of samples at each point of the grid.
        within: whether images of a group may differ along each axis of the grid.
        is_sampled: whether they may differ in what is sampled. If not, they differ
            along no axis but `frames`, since other images have other draws.
        frames: the index of the axis with the frames of a drive, which have one draw;
            None without a drive.

    Attributes:
        group_size: number of images of a group.
        n_groups: number of groups.
        n_cached_groups: number of groups that have to be cached so that no predictor is
            made twice, when images come in order: 1 if the images of a group follow
            each other.
    """

    def __init__(
        self,
        grid: ProductIndex,
        samples: int,
        within: tuple[bool, ...],
        is_sampled: bool,
        frames: int | None = None,
    ) -> None:
        """Split the axes into those within and those between groups; see the class."""
        self.grid = grid
        self.samples = samples
        # Samples are like one more axis, the last and fastest.
        self._all_axes = ProductIndex((*grid.sizes, samples))
        # Along an axis the draws change, except from one frame of a drive to the next.
        axis_is_within = [
            may_differ and (is_sampled or axis == frames)
            for axis, may_differ in enumerate(within)
        ]
        self._is_within = (*axis_is_within, is_sampled)
        within_sizes = self._select(self._all_axes.sizes, is_within=True)
        between_sizes = self._select(self._all_axes.sizes, is_within=False)
        self._within = ProductIndex(tuple(within_sizes))
        self._between = ProductIndex(tuple(between_sizes))
        self.group_size = self._within.count
        self.n_groups = self._between.count
        self.n_cached_groups = self._count_cached_groups()

    def _count_cached_groups(self) -> int:
        """Return how many groups alternate when images come in order.

        The last axis is the fastest. If an axis between groups comes after an axis
        within groups, the sweep visits all groups along it, and then comes back to the
        first one. Example: with axes (light 10, pose 3), where images of a group differ
        in light, 3 groups alternate; with (pose 3, light 10) it is 1.
        """
        n_groups = 1
        was_axis_within = False
        for size, is_within in zip(self._all_axes.sizes, self._is_within, strict=True):
            if is_within:
                was_axis_within = True
            elif was_axis_within:
                n_groups *= size
        return n_groups

    def _select(self, values: Sequence[int], *, is_within: bool) -> list[int]:
        """Select the values that belong to axes within groups, or to those between.

        `values` has one for each axis, that of the samples last.
        """
        return [
            value
            for value, within in zip(values, self._is_within, strict=True)
            if within == is_within
        ]

    def find_group(self, number: int) -> int:
        """Return the index of the group of an image of the scene."""
        digits = self._all_axes.digits(number)
        return self._between.index(self._select(digits, is_within=False))

    def find_member(self, number: int, index: int) -> int:
        """Return the number of a member of the group that an image belongs to.

        Image and member have the same index along every axis between groups. The index
        of the member counts the axes within the group, the last one fastest.

        Args:
            number: number of the image.
            index: index of the member in the group, in [0, group_size).
        """
        # the digits of a number are its indices along the axes
        member_digits = list(self._all_axes.digits(number))
        within_axes = [
            axis for axis, is_within in enumerate(self._is_within) if is_within
        ]
        for axis, digit in zip(within_axes, self._within.digits(index), strict=True):
            member_digits[axis] = digit
        return self._all_axes.index(member_digits)


MakeGroups = Callable[[frozenset[str]], Groups]
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
    samples = COLLECTED_SPP
    """Samples per pixel of what predicts."""
    bytes = 0
    """Memory of what groups share."""

    def __init__(self, renderer: Renderer, seed: int) -> None:
        self._renderer = renderer
        self._lighting = find_lighting(renderer)
        self.follows = frozenset(self._lighting.groups)
        self.moves = any(self._lighting.groups.values())

    def find_refusal(self, make_groups: MakeGroups, spp: int) -> Refusal | None:
        """Return why images are rendered; None if they are predicted.

        Images are predicted if that takes at most 1 / `MIN_SAVING_FACTOR` of the
        samples that rendering a group takes, and if the basis images fit into memory.

        Args:
            make_groups: makes the groups.
            spp: samples per pixel of the images.
        """
        renderer = self._renderer
        groups = make_groups(self.follows)
        if renderer.formation.denoiser != "oidn":
            return NOISE
        # The number of lights is the same in all configurations: take the first one.
        inputs = renderer.scene.assembly(renderer.space.inputs(renderer.start))
        n_lights = len(LightBasis(renderer, self._lighting, inputs).inputs_of_light)
        # A basis image for each light, and `N_VIEWS` comparisons with traced images.
        # For each, two halves are traced to estimate the noise, and one as images are.
        basis_samples = n_lights * COLLECTED_SPP
        prediction_samples = basis_samples + N_VIEWS * (2 * CHECK_SPP + spp)
        min_images = math.ceil(MIN_SAVING_FACTOR * prediction_samples / spp)
        if groups.group_size < min_images:
            return Refusal(
                f"basis pictures pay where {min_images} pictures or more differ in "
                f"light alone; here {groups.group_size} do"
            )
        height, width = renderer.formation.resolution
        # about 8 bytes for each pixel of a basis image
        n_bytes = groups.n_cached_groups * n_lights * 8 * height * width
        if n_bytes > scale_limit(MAX_BYTES):
            return Refusal(
                f"basis pictures of {groups.n_groups} groups take too much memory; "
                "make "
                "light the last axes of the grid"
            )
        return None

    def make_predictor(self, u: Tensor, seed: int) -> Predictor:
        """Return the predictor of the images of a group.

        Args:
            u: (d,) configuration of one of them.
            seed: seed of its light paths.
        """
        return BasisRenderer(self._renderer, u, seed, changing=self._lighting)


ARRANGEMENT_SAMPLES = 2_200_000
LIGHT_SAMPLES = 80_000
"""Costs, as the number of rendered samples that take as long: of an arrangement (what
texels of the surfaces see of each other), and of the light of an environment on them.

They take 0.8 and 0.03 s where an image of 128 x 128 pixels with 8 samples per pixel
takes 46 ms.
"""
PREDICTION_SPP = 0.8  # samples per pixel that take as long as a predicted image
ARRANGEMENT_BYTES = 50_000_000  # memory of an arrangement, about
LIGHT_BYTES = 4_000_000  # memory of the light of an environment besides its map, about


def find_break_even(renderer: Renderer, spp: int, arrangements: float = 1.0) -> int:
    """Return how many images under one light make light on surfaces pay.

    Preparing the light and comparing it with traced images has a fixed cost; each image
    that is predicted saves `spp - PREDICTION_SPP`. It pays if the images save
    `MIN_SAVING_FACTOR` times the fixed cost. All costs are in samples per pixel.

    Args:
        renderer: renderer of the images.
        spp: samples per pixel of the images.
        arrangements: arrangements that are found for each light, below 1 if several
            lights share one. An arrangement is what surfaces see of each other.
    """
    height, width = renderer.formation.resolution
    preparation_samples = ARRANGEMENT_SAMPLES * arrangements + LIGHT_SAMPLES
    # a view is traced in two halves, to estimate its noise, and once as images are
    spp_of_view = 2 * CHECK_SPP + spp
    fixed_spp = preparation_samples / (height * width) + N_VIEWS * spp_of_view
    return math.ceil(MIN_SAVING_FACTOR * fixed_spp / (spp - PREDICTION_SPP))


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
    samples = RAYS_PER_PIXEL

    def __init__(self, renderer: Renderer, seed: int) -> None:
        """Find the groups of coordinates that move nothing but the camera.

        Args:
            renderer: renderer of the images.
            seed: seed from which the rays of all arrangements follow.
        """
        self._renderer = renderer
        self._seed = seeds.stream(seed, "surface light")
        self._arrangements: list[SurfaceRenderer] = []
        self._max_arrangements = 0
        # which inputs of the scene change with each group of coordinates
        self._changed_inputs = {
            group.name: find_changed_inputs(renderer, [group.name])
            for group in renderer.space.groups
        }
        self.follows = self._find_groups_changing_only(CAMERA_INPUTS)
        self.moves = any(
            self._changed_inputs[name] & CAMERA_INPUTS for name in self.follows
        )

    def _find_groups_changing_only(self, inputs: frozenset[str]) -> frozenset[str]:
        """Return the groups of coordinates that change nothing but these inputs.

        They may change the finished image, too.
        """
        allowed = inputs | IMAGE_INPUTS
        return frozenset(
            name for name, changed in self._changed_inputs.items() if changed <= allowed
        )

    def find_refusal(self, make_groups: MakeGroups, spp: int) -> Refusal | None:
        """Return why images are rendered; None if they are predicted.

        They are predicted if enough images share their light, the scene has nothing
        that light on surfaces cannot do, and arrangements and light fit into memory. As
        a side effect this sets how many arrangements are cached.

        Args:
            make_groups: makes the groups.
            spp: samples per pixel of the images.
        """
        groups = make_groups(self.follows)
        # An arrangement serves all images between which neither object nor surroundings
        # move: those of several groups, each with light of its own.
        arrangement_groups = make_groups(
            self._find_groups_changing_only(FREE_INPUTS - {COLOR_INPUT})
        )
        self._max_arrangements = arrangement_groups.n_cached_groups
        arrangements_per_light = arrangement_groups.n_groups / groups.n_groups
        min_images = find_break_even(self._renderer, spp, arrangements_per_light)
        if groups.group_size < min_images:
            return Refusal(
                f"light on surfaces pays where {min_images} pictures differ in the "
                f"camera alone; here {groups.group_size} do"
            )
        refusal = find_scene_refusal(self._renderer)
        if refusal is not None:
            return refusal
        environment = self._renderer.scene.get_base_value(ENVIRONMENT_INPUT)
        light_bytes = LIGHT_BYTES + 4 * environment.numel()  # 4 bytes for a float32
        n_bytes = (
            arrangement_groups.n_cached_groups * ARRANGEMENT_BYTES
            + groups.n_cached_groups * light_bytes
        )
        if n_bytes > scale_limit(MAX_BYTES):
            return Refusal(
                f"light of {groups.n_groups} groups takes too much memory; make the "
                "camera the last axes of the grid"
            )
        return None

    def make_predictor(self, u: Tensor, seed: int) -> Predictor:
        """Return the predictor of the images of a group.

        An arrangement that stores what surfaces see of each other is reused if object
        and surroundings stand the same. Else a new one is made and cached; if there are
        too many, the oldest is released.

        Args:
            u: (d,) configuration of one of them.
            seed: not used; all arrangements have the same rays.
        """
        with torch.no_grad():
            inputs = self._renderer.scene.assembly(self._renderer.space.inputs(u))
            for arrangement in self._arrangements:
                if arrangement.is_applicable(inputs):
                    return arrangement.with_fixed_light(inputs)
            if len(self._arrangements) >= self._max_arrangements:
                self._arrangements.pop(0)
            arrangement = SurfaceRenderer(self._renderer, u, self._seed)
            self._arrangements.append(arrangement)
            return arrangement.with_fixed_light(inputs)

    @property
    def bytes(self) -> int:
        """Memory of the arrangements."""
        return sum(arrangement.n_bytes for arrangement in self._arrangements)


@dataclass(frozen=True, eq=False)
class SweptImage:
    """An image of a sweep.

    Attributes:
        image: (H, W, 3), sRGB in [0, 1].
        prediction_spp: samples per pixel of what predicted it; 0 if it was rendered.
        n_traced: images that were traced for it; those for a group count for the first
            image of the group.
    """

    image: Tensor
    prediction_spp: int
    n_traced: int


@dataclass
class SweepPredictor:
    """Makes the images of one scene at one size, by prediction where that pays.

    Attributes:
        problem: problem of a model that gets these images.
        points: the configurations of the scene.
        axes: axes of the grid.
        seed: seed of the predictors.
        specialise: whether anything is predicted.
        images_before: images of the scenes before this one.
        deviations: deviations of the predictors that were compared with traced images.
        seconds: seconds that making and comparing them took.
        rendered_groups: indices of the groups whose images are rendered because
            predictions deviated too much.
        renderer: renderer of the problem.
        method: how images are predicted, or would be.
        refusal: why all images are rendered; None if they are predicted.
    """

    problem: Problem
    points: Points
    axes: tuple[Axis, ...]
    seed: int
    specialise: bool
    images_before: int = 0
    deviations: list[Deviation] = field(default_factory=list)
    seconds: float = 0.0
    rendered_groups: set[int] = field(default_factory=set)
    # images that were traced for each group, by its index
    _traced: dict[int, int] = field(default_factory=dict)
    # Predictors of the groups that are cached, by index; None where images are
    # rendered.
    _predictors: dict[int, Predictor | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.renderer = self.problem.renderer
        self.method, self.refusal = self._choose_method()
        self._groups = self._make_groups(self.method.follows)

    def _choose_method(self) -> tuple[BasisPictures | LightOnSurfaces, Refusal | None]:
        """Choose how images are predicted.

        Returns:
            The cheapest method that pays here, and None. If none pays, a method that is
            not used, and why not: the first one that could follow something that
            varies, since its reason tells the user what to change; else the last one.
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
        if self.renderer.composition_reason or not self.specialise:
            return Refusal(self.renderer.composition_reason or "nothing is left out")
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
            samples=self.points.samples,
            within=tuple(name in follows for name in axis_names),
            is_sampled=follows_all_sampled,
            frames=self.points.units.frames,
        )

    def make_images(self, query_of_image: Mapping[int, Query]) -> dict[int, SweptImage]:
        """Render or predict images.

        Images of the same predictor are collected first, and then predicted all at
        once.

        Args:
            query_of_image: the queries by the number of the image in the scene.

        Returns:
            The images by their numbers.
        """
        images: dict[int, SweptImage] = {}
        numbers_by_predictor: dict[Predictor, list[int]] = {}
        for number, query in query_of_image.items():
            predictor = None  # renders the image
            if self.refusal is None:
                group = self._groups.find_group(number)
                predictor = self._load_predictor(group, number)
            if predictor is None:
                image = self.renderer(query.u, seed=query.seed, spp=self.problem.spp)
                n_traced = self._count_traced(number) + 1
                images[number] = SweptImage(image, prediction_spp=0, n_traced=n_traced)
            else:
                numbers_by_predictor.setdefault(predictor, []).append(number)
        for predictor, numbers in numbers_by_predictor.items():
            predicted = predictor.predict_images(
                [query_of_image[number].u for number in numbers]
            )
            for number, image in zip(numbers, predicted, strict=True):
                n_traced = self._count_traced(number)
                images[number] = SweptImage(image, self.method.samples, n_traced)
        return images

    def _count_traced(self, number: int) -> int:
        """Return how many images were traced to prepare the predictor of an image.

        The predictor serves a group of images. What was traced for it counts for the
        first of them; for the others this is 0.
        """
        first_of_group = self._groups.find_member(number, 0)
        if number != first_of_group:
            return 0
        return self._traced.get(self._groups.find_group(number), 0)

    def _load_predictor(self, group: int, number: int) -> Predictor | None:
        """Return the predictor of a group; None if its images are rendered.

        A new predictor is compared with traced images first. If it deviates too much,
        the images of its group are rendered. A predictor depends on the index of its
        group alone, not on the image that needs it first, so that a sweep that was
        stopped continues with the same predictors. If too many are cached, the oldest
        is released.

        Args:
            group: index of the group.
            number: number of an image of the group, in the scene.
        """
        if group in self._predictors:
            return self._predictors[group]
        if len(self._predictors) >= self._groups.n_cached_groups:
            oldest = next(iter(self._predictors))
            self._predictors.pop(oldest)
        begin = time.perf_counter()
        seed = seeds.stream(self.seed, "light", self.images_before + group)
        # Always from member 0 of the group, whichever of its images comes first.
        predictor = self.method.make_predictor(self._configuration(number, 0), seed)
        deviation = self._compare(predictor, number, seed)
        self.deviations.append(deviation)
        self._traced[group] = predictor.n_traced_images + deviation.n_traced
        if not deviation.is_accepted:
            self.rendered_groups.add(group)
        self._predictors[group] = predictor if deviation.is_accepted else None
        self.seconds += time.perf_counter() - begin
        return self._predictors[group]

    def _compare(self, predictor: Predictor, number: int, seed: int) -> Deviation:
        """Compare predicted images of a group with traced ones.

        The compared images are random members of the group. They and the noise of the
        traced images follow from `seed`.

        Args:
            predictor: predictor of the group.
            number: number of an image of the group, in the scene.
            seed: selects the images that are compared.
        """

        def compute_margin(image: Tensor, u: Tensor) -> float:
            """Return the margin of the model's prediction about an image."""
            return self.problem.judge(round_to_8_bit(image), u).margin

        def compare_view(check: int) -> ComparedView:
            """Compare the prediction of a random configuration of the group."""
            index = seeds.stream(seed, "check", check) % self._groups.group_size
            u = self._configuration(number, index)
            (predicted,) = predictor.predict_images([u])
            noise_seed = seeds.stream(seed, "traced", check)
            return compare_with_traced(
                self.renderer,
                predicted,
                u,
                noise_seed,
                self.problem.spp,
                compute_margin,
            )

        with torch.no_grad():
            return compare_views(compare_view)

    def _configuration(self, number: int, index: int) -> Tensor:
        """Return a configuration (d,) of the group of an image, by its index there."""
        member = self._groups.find_member(number, index)
        return self.points.make_configurations(member, 1, self.images_before)[0]

    @property
    def n_non_finite(self) -> int:
        """How many values were not finite, and were set to 0."""
        return sum(
            predictor.non_finite
            for predictor in self._predictors.values()
            if predictor is not None
        )

    def summarize(self) -> LinearTransport | None:
        """Return what a result states about predicted images.

        It is their worst deviation, the memory and the time, or why images are
        rendered. None if nothing varies that any method could predict.
        """
        if self.refusal is NOTHING_MOVES:
            return None
        if self.refusal is not None:
            return LinearTransport(used=False, reason=str(self.refusal))
        error = None
        if self.deviations:
            worst = max(self.deviations, key=lambda deviation: deviation.levels)
            error = PredictionError.from_values(worst)
        reason = None
        if self.rendered_groups:
            reason = (
                f"{len(self.rendered_groups)} of {self._groups.n_groups} groups were "
                "rendered: "
                "predicted pictures were too far off"
            )
        predictor_bytes = sum(
            predictor.n_bytes
            for predictor in self._predictors.values()
            if predictor is not None
        )
        return LinearTransport(
            used=True,
            method=self.method.name,
            reason=reason,
            entries=0,  # of a matrix, which sweeps do not use
            bytes=self.method.bytes + predictor_bytes,
            seconds=self.seconds,
            renewed=0,
            error=error,
        )


def combine_transport(
    all_summaries: Sequence[LinearTransport | None],
) -> LinearTransport | None:
    """Combine the summaries of the predicted images of several scenes.

    Args:
        all_summaries: all summaries of each scene; None where nothing moves.

    Returns:
        The worst error, the largest memory, all seconds and the first reason, of the
        scenes with predicted images. If none has them, the last summary; None if
        nothing moves in any scene.
    """
    summaries = [summary for summary in all_summaries if summary is not None]
    used = [summary for summary in summaries if summary.used]
    if not used:
        return summaries[-1] if summaries else None
    reasons = [summary.reason for summary in used if summary.reason]
    errors = [summary.error for summary in used if summary.error]
    update = {
        "reason": reasons[0] if reasons else None,  # as an example for all
        "bytes": max(summary.bytes or 0 for summary in used),
        "seconds": math.fsum(summary.seconds or 0.0 for summary in used),
        "error": max(errors, key=lambda error: error.levels or 0.0, default=None),
    }
    return used[0].model_copy(update=update)


def prepare_surface_light(
    verifier: Verifier, at: Tensor, coordinates: Tensor, n_images: int
) -> None:
    """Prepare light on surfaces for trials, if that is cheaper than rendering them.

    The trials vary some numbers around a configuration. If light on surfaces can follow
    these numbers, accurately enough and at less cost, the verifier's state has it as
    `predictor`. If the camera moves, but the light is not used, the state has the
    reason as `predictor_refusal`.

    Args:
        verifier: verifier of the trials, whose sample count is known.
        at: (d,) the configuration.
        coordinates: (k,) indices of the coordinates that vary.
        n_images: about how many trials there are.
    """
    problem = verifier.problem
    varying = set(coordinates.tolist())
    groups = [
        group.name
        for group in problem.space.groups
        if not varying.isdisjoint(range(group.begin, group.begin + group.size))
    ]
    changed_inputs = find_changed_inputs(problem.renderer, groups)
    moves_camera = bool(changed_inputs & CAMERA_INPUTS)
    # light on surfaces cannot follow a change of any other input
    can_follow = changed_inputs <= FREE_INPUTS
    if not moves_camera or not can_follow:
        return
    findings = verifier.state
    refusal = find_scene_refusal(problem.renderer)
    min_images = find_break_even(problem.renderer, findings.spp)
    if refusal is None and n_images < min_images:
        reason = f"light on surfaces pays from {min_images} pictures on"
        refusal = Refusal(reason, RefusalCause.TOO_FEW_STEPS)
    findings.predictor_refusal = refusal
    if refusal is not None:
        return
    title = "finding the light on surfaces"
    verifier.stages.begin(
        "transport", title, N_LIGHTS, hint="`specialise=false` leaves it out"
    )
    light = SurfaceLight(problem, 0, light_u=at, moving_coordinates=coordinates)
    # `prepare` compares predicted images with traced ones, and may refuse.
    light.prepare(verifier.stages.progress.advance)
    findings.predictor_refusal = light.accuracy_refusal
    is_accurate = light.accuracy_refusal is None
    findings.predictor = light if is_accurate else None
