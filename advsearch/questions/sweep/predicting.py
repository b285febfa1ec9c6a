"""Predictors of the images of a sweep.

A predictor serves a *group*: images of a sweep that differ in one respect only. If they
differ only in light, they are combined from basis images (docs/transport.md). If they
differ only in the camera, they are made from light on surfaces (docs/surface-light.md).
Some images are traced for comparison; if predicted ones deviate too much, the group is
rendered. A predictor depends only on its group, so that a sweep that was stopped
continues with the same one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

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
from advsearch.questions.sweep.axes import Axis, SceneConfigurations
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
from advsearch.scene.transport.lights import (
    BasisRenderer,
    LightBasis,
    find_light_groups,
)
from advsearch.scene.transport.matrix import COLLECTED_SPP
from advsearch.trust.stored_files import scale_limit

MIN_SAVING_FACTOR = 2.0
"""A group is predicted if rendering it takes at least this many times the samples of a
prediction, including the comparisons.
"""


BASIS_PIXEL_BYTES = 8  # approximate memory of a pixel of a basis image


class Groups:
    """Divides the images of a scene into groups, each of which one predictor serves.

    Images of a group differ along some axes, those *within* groups, and have the same
    index along the others, those *between* groups.

    Args:
        grid: grid of the sweep.
        samples: number of samples at each point of the grid.
        within: for each axis of the grid, whether images of a group may differ along
            it.
        may_draws_differ: whether images of a group may differ in what is sampled. If
            not, they differ along no axis but `frame_axis`, since other images have
            other draws.
        frame_axis: the index of the axis with the frames of a drive, which have one
            draw; None without a drive.

    Attributes:
        group_size: number of images of a group.
        n_groups: number of groups.
        n_groups_to_cache: number of groups to cache so that no predictor is made
            twice if images come in order: 1 if the images of a group follow each other.
    """

    def __init__(
        self,
        grid: ProductIndex,
        samples: int,
        within: tuple[bool, ...],
        may_draws_differ: bool,
        frame_axis: int | None = None,
    ) -> None:
        """Split the axes into those within and those between groups; see the class."""
        self.grid = grid
        self.samples = samples
        # Samples are like one more axis, the last and fastest.
        self._all_axes = ProductIndex((*grid.sizes, samples))
        # Two images along any axis but that of the frames have different draws.
        is_within = [
            may_differ and (may_draws_differ or axis == frame_axis)
            for axis, may_differ in enumerate(within)
        ]
        # The samples, whose axis is the last, have different draws, too.
        self._is_within = (*is_within, may_draws_differ)
        within_sizes = self._select(self._all_axes.sizes, is_within=True)
        between_sizes = self._select(self._all_axes.sizes, is_within=False)
        self._within = ProductIndex(tuple(within_sizes))
        self._between = ProductIndex(tuple(between_sizes))
        self.group_size = self._within.count
        self.n_groups = self._between.count
        self.n_groups_to_cache = self._count_alternating_groups()

    def _count_alternating_groups(self) -> int:
        """Return how many groups alternate when images come in order.

        The last axis is the fastest. If an axis between groups comes after an axis
        within groups, the images visit all groups along it, and then come back to the
        first one. For example, let the images of a group differ in light. With the axes
        (light 10, pose 3), 3 groups alternate; with (pose 3, light 10) it is 1.
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

    def find_group_of_image(self, number: int) -> int:
        """Return the index of the group of an image of the scene."""
        digits = self._all_axes.digits(number)
        return self._between.index(self._select(digits, is_within=False))

    def find_image_of_group(self, number: int, index: int) -> int:
        """Return the number of an image, by its index in the group of another image.

        Both images have the same index along every axis between groups. The index in
        the group counts along the axes within groups, the last one fastest.

        Args:
            number: number of any image of the group, in the scene.
            index: index of the image to find in the group, in [0, group_size).
        """
        # The digits of a number are the indices along the axes (mixed radix).
        member_digits = list(self._all_axes.digits(number))
        within_axes = [
            axis for axis, is_within in enumerate(self._is_within) if is_within
        ]
        for axis, digit in zip(within_axes, self._within.digits(index), strict=True):
            member_digits[axis] = digit
        return self._all_axes.index(member_digits)


MakeGroups = Callable[[frozenset[str]], Groups]
"""Returns the groups whose images may differ in the named parameters, each given as
"control.parameter", and in no others.
"""


class BasisPictures:
    """Predicts images at one size of a scene by a basis image of each light.

    Images of a group differ only in the strength of lights: they are weighted sums of
    the basis images.

    Attributes:
        parameters: names (control.parameter) of the parameters in which images of a
            group may differ.
        changes_scene: whether a parameter among these changes more than the finished
            image, as exposure does.
    """

    name = "basis pictures"
    samples = COLLECTED_SPP
    """Samples per pixel of a basis image."""
    bytes = 0
    """Memory that groups share."""

    def __init__(self, renderer: Renderer, seed: int) -> None:
        self._renderer = renderer
        self._lighting = find_light_groups(renderer)
        self.parameters = frozenset(self._lighting.inputs_by_group)
        self.changes_scene = any(self._lighting.inputs_by_group.values())

    def find_refusal(self, make_groups: MakeGroups, spp: int) -> Refusal | None:
        """Return why images are rendered; None if they are predicted.

        Images are predicted if that takes at most 1 / `MIN_SAVING_FACTOR` of the
        samples that rendering a group takes, and if the basis images fit into memory.

        Args:
            make_groups: returns the groups whose images differ in some parameters.
            spp: samples per pixel of the images.
        """
        groups = make_groups(self.parameters)
        # Only an image without noise can be predicted from basis images.
        is_denoised = self._renderer.formation.denoiser == "oidn"
        if not is_denoised:
            return NOISE
        n_lights = self._count_lights()
        prediction_samples = n_lights * COLLECTED_SPP + _count_check_samples(spp)
        # Rendering a group takes `spp` for each image.
        min_images = math.ceil(MIN_SAVING_FACTOR * prediction_samples / spp)
        if groups.group_size < min_images:
            return Refusal(
                f"basis pictures pay where {min_images} pictures or more differ in "
                f"light alone; here {groups.group_size} do"
            )
        return self._find_memory_refusal(groups, n_lights)

    def _count_lights(self) -> int:
        """Count the lights, whose number is the same in all configurations."""
        renderer = self._renderer
        start_inputs = renderer.space.inputs(renderer.start)
        inputs = renderer.scene.input_assembler(start_inputs)
        return len(LightBasis(renderer, self._lighting, inputs).inputs_of_light)

    def _find_memory_refusal(self, groups: Groups, n_lights: int) -> Refusal | None:
        """Return a refusal if the basis images take too much memory; else None."""
        height, width = self._renderer.formation.resolution
        bytes_per_basis_image = BASIS_PIXEL_BYTES * height * width
        n_bytes = groups.n_groups_to_cache * n_lights * bytes_per_basis_image
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
            u: (d,) configuration of any image of the group: they differ only in light,
                which the predictor takes from the image to predict.
            seed: seed of the light paths of its basis images.
        """
        return BasisRenderer(self._renderer, u, seed, changing=self._lighting)


ARRANGEMENT_SAMPLES = 2_200_000
LIGHT_SAMPLES = 80_000
"""Costs, as the number of rendered samples that take as long: of an arrangement (what
texels of the surfaces see of each other), and of an environment's light on them.

They take 0.8 s and 0.03 s; an image of 128 x 128 pixels with 8 samples per pixel takes
46 ms.
"""
PREDICTION_SPP = 0.8  # samples per pixel that take as long as a predicted image
ARRANGEMENT_BYTES = 50_000_000  # approximate memory of an arrangement
LIGHT_BYTES = 4_000_000  # approximate memory of an environment's light, without its map


def _count_check_samples(spp: int) -> int:
    """Return how many samples per pixel the comparison with traced images takes.

    Of each of the `N_VIEWS` compared images two halves are traced, to estimate the
    noise, and once the image itself, with `spp`.
    """
    return N_VIEWS * (2 * CHECK_SPP + spp)


def find_break_even(renderer: Renderer, spp: int, arrangements: float = 1.0) -> int:
    """Return the number of images under one light for which light on surfaces pays.

    Preparing the light and comparing it with traced images has a fixed cost; each image
    that is predicted saves `spp - PREDICTION_SPP`. The light is used if the images save
    `MIN_SAVING_FACTOR` times the fixed cost. All costs are in samples per pixel.

    Args:
        renderer: renderer of the images.
        spp: samples per pixel of the images, at least 1.
        arrangements: number of arrangements that are found for each light; below 1 if
            several lights share one. An arrangement is what surfaces see of each other.
    """
    height, width = renderer.formation.resolution
    preparation_samples = ARRANGEMENT_SAMPLES * arrangements + LIGHT_SAMPLES
    fixed_spp = preparation_samples / (height * width) + _count_check_samples(spp)
    return math.ceil(MIN_SAVING_FACTOR * fixed_spp / (spp - PREDICTION_SPP))


class LightOnSurfaces:
    """Predicts images at one size of a scene by light that is stored on surfaces.

    Images of a group differ only in the camera. Groups in which object and surroundings
    do not move share an *arrangement*: what their surfaces see of each other. Its rays
    are the same for every group, so that it does not matter which group is first.

    Attributes:
        parameters: names (control.parameter) of the parameters in which images of a
            group may differ.
        changes_scene: whether a parameter among these moves the camera.
    """

    name = "surface light"
    samples = RAYS_PER_PIXEL

    def __init__(self, renderer: Renderer, seed: int) -> None:
        """Find the parameters that move nothing but the camera.

        Args:
            renderer: renderer of the images.
            seed: seed from which the rays of all arrangements follow.
        """
        self._renderer = renderer
        self._seed = seeds.derive_seed(seed, "surface light")
        # An arrangement is where object and surroundings are.
        self._arrangements: list[SurfaceRenderer] = []
        self._max_arrangements = 0  # `find_refusal` sets it
        # which inputs of the scene change with each parameter
        self._changed_inputs = {
            group.name: find_changed_inputs(renderer, [group.name])
            for group in renderer.space.groups
        }
        self.parameters = self._find_parameters_changing_only(CAMERA_INPUTS)
        # `parameters` includes those that change only the finished image.
        self.changes_scene = any(
            self._changed_inputs[name] & CAMERA_INPUTS for name in self.parameters
        )

    def _find_parameters_changing_only(self, inputs: frozenset[str]) -> frozenset[str]:
        """Return the names of the parameters that change nothing but these inputs.

        A change of the finished image, such as exposure, is allowed, too: it is applied
        to predicted images as to rendered ones.
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
            make_groups: returns the groups whose images differ in some parameters.
            spp: samples per pixel of the images.
        """
        # The images of one of these groups have the same light.
        light_groups = make_groups(self.parameters)
        # The images of one of these groups have the same arrangement: neither object
        # nor surroundings move, and the object has one color.
        parameters = self._find_parameters_changing_only(FREE_INPUTS - {COLOR_INPUT})
        arrangement_groups = make_groups(parameters)
        self._max_arrangements = arrangement_groups.n_groups_to_cache
        # below 1 if several lights share an arrangement
        arrangements_per_light = arrangement_groups.n_groups / light_groups.n_groups
        min_images = find_break_even(self._renderer, spp, arrangements_per_light)
        if light_groups.group_size < min_images:
            return Refusal(
                f"light on surfaces pays where {min_images} pictures differ in the "
                f"camera alone; here {light_groups.group_size} do"
            )
        refusal = find_scene_refusal(self._renderer)
        if refusal is not None:
            return refusal
        return self._find_light_memory_refusal(arrangement_groups, light_groups)

    def _find_light_memory_refusal(
        self, arrangement_groups: Groups, light_groups: Groups
    ) -> Refusal | None:
        """Return a refusal if arrangements and light take too much memory; else None.

        Args:
            arrangement_groups: groups whose images have the same arrangement.
            light_groups: groups whose images have the same light.
        """
        environment = self._renderer.scene.get_base_value(ENVIRONMENT_INPUT)
        light_bytes = LIGHT_BYTES + 4 * environment.numel()  # 4 bytes for a float32
        n_bytes = (
            arrangement_groups.n_groups_to_cache * ARRANGEMENT_BYTES
            + light_groups.n_groups_to_cache * light_bytes
        )
        if n_bytes > scale_limit(MAX_BYTES):
            return Refusal(
                f"light of {light_groups.n_groups} groups takes too much memory; make the "
                "camera the last axes of the grid"
            )
        return None

    def make_predictor(self, u: Tensor, seed: int) -> Predictor:
        """Return the predictor of the images of a group.

        The arrangement of another group is reused if object and surroundings have not
        moved. Else a new one is made and cached; if too many are cached, the one that
        was made first is released.

        Args:
            u: (d,) configuration of any image of the group: they differ only in the
                camera, which the predictor takes from the image to predict.
            seed: not used; all arrangements have the same rays.
        """
        with torch.no_grad():
            space_inputs = self._renderer.space.inputs(u)
            inputs = self._renderer.scene.input_assembler(space_inputs)
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
        n_traced: number of images that were traced for it. Those that were traced to
            prepare a predictor count for the first image of the group.
    """

    image: Tensor
    prediction_spp: int
    n_traced: int


@dataclass
class SweepPredictor:
    """Makes the images of one scene at one size, predicted if that saves time.

    Attributes:
        problem: problem of a model that gets these images.
        configurations: the configurations of the scene.
        axes: axes of the grid.
        seed: seed of the predictors.
        specialise: whether images may be predicted.
        images_before: number of images of the scenes before this one.
        deviations: deviations of the predictors from traced images.
        seconds: seconds that making and comparing the predictors took.
        rendered_groups: indices of the groups whose images are rendered because
            predictions deviated too much.
        renderer: renderer of the problem.
        method: method that predicts images, or would if it were not refused.
        refusal: why all images are rendered; None if they are predicted.
    """

    problem: Problem
    configurations: SceneConfigurations
    axes: tuple[Axis, ...]
    seed: int
    specialise: bool
    images_before: int = 0
    deviations: list[Deviation] = field(default_factory=list)
    seconds: float = 0.0
    rendered_groups: set[int] = field(default_factory=set)
    # number of images that were traced to prepare the predictor of each group
    _n_traced_of_group: dict[int, int] = field(default_factory=dict)
    # The cached predictors by the index of the group; None if its predictions deviated
    # too much, so that its images are rendered.
    _predictors: dict[int, Predictor | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.renderer = self.problem.renderer
        self.method, self.refusal = self._choose_method()
        self._groups = self._make_groups(self.method.parameters)

    def _choose_method(self) -> tuple[BasisPictures | LightOnSurfaces, Refusal | None]:
        """Choose the method that predicts images.

        Returns:
            The cheapest method that is not refused, and None. If all are refused, one
            of them and why it is refused, for the user to read. That is the first one
            which could predict something that varies, since its reason says what to
            change; else the last one.
        """
        refused: list[tuple[BasisPictures | LightOnSurfaces, Refusal]] = []
        for method_type in (BasisPictures, LightOnSurfaces):  # cheapest first
            method = method_type(self.renderer, self.seed)
            refusal = self._find_refusal(method)
            if refusal is None:
                return method, None
            refused.append((method, refusal))
        for method, refusal in refused:
            could_predict_something = refusal is not NOTHING_MOVES
            if could_predict_something:
                return method, refusal
        return refused[-1]

    def _find_refusal(self, method: BasisPictures | LightOnSurfaces) -> Refusal | None:
        """Return why a method does not predict these images; None if it does."""
        if not method.changes_scene:
            return NOTHING_MOVES
        if self.renderer.composition_reason or not self.specialise:
            return Refusal(self.renderer.composition_reason or "nothing is left out")
        return method.find_refusal(self._make_groups, self.problem.search_spp)

    def _make_groups(self, parameters: frozenset[str]) -> Groups:
        """Divide the images into groups whose images may differ in some parameters.

        Args:
            parameters: names (control.parameter) of these parameters. What is sampled
                may differ in a group only if all sampled parameters are among them.
        """
        axis_names = [axis.name for axis in self.axes]
        # Here a group is the coordinates of one parameter.
        parameter_names = [group.name for group in self.renderer.space.groups]
        sampled_names = [name for name in parameter_names if name not in axis_names]
        return Groups(
            self.configurations.grid,
            samples=self.configurations.samples_per_grid_point,
            within=tuple(name in parameters for name in axis_names),
            may_draws_differ=parameters.issuperset(sampled_names),
            frame_axis=self.configurations.independent_units.frames,
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
            predictor = self._find_predictor_of_image(number)
            if predictor is None:
                images[number] = self._render_swept_image(number, query)
            else:
                numbers_by_predictor.setdefault(predictor, []).append(number)
        for predictor, numbers in numbers_by_predictor.items():
            queries = [query_of_image[number] for number in numbers]
            images |= self._predict_swept_images(predictor, numbers, queries)
        return images

    def _find_predictor_of_image(self, number: int) -> Predictor | None:
        """Return the predictor of an image of the scene; None if it is rendered."""
        if self.refusal is not None:
            return None
        group = self._groups.find_group_of_image(number)
        return self._load_predictor(group, number)

    def _predict_swept_images(
        self, predictor: Predictor, numbers: Sequence[int], queries: Sequence[Query]
    ) -> dict[int, SweptImage]:
        """Predict images by one predictor, by their numbers in the scene.

        Args:
            predictor: the predictor.
            numbers: (n,) numbers of the images.
            queries: (n,) their queries.
        """
        predicted = predictor.predict_images([query.u for query in queries])
        images: dict[int, SweptImage] = {}
        for number, image in zip(numbers, predicted, strict=True):
            n_traced = self._count_traced(number)
            images[number] = SweptImage(
                image, prediction_spp=self.method.samples, n_traced=n_traced
            )
        return images

    def _render_swept_image(self, number: int, query: Query) -> SweptImage:
        """Render an image by its number in the scene."""
        image = self.renderer(query.u, seed=query.seed, spp=self.problem.search_spp)
        # Images may have been traced for a predictor that was then rejected.
        n_traced = self._count_traced(number) + 1
        return SweptImage(image, prediction_spp=0, n_traced=n_traced)

    def _count_traced(self, number: int) -> int:
        """Return how many images were traced to prepare the predictor of an image.

        The predictor serves a group of images. What was traced for it counts for the
        first of them; for the others this is 0.
        """
        first_of_group = self._groups.find_image_of_group(number, 0)
        if number != first_of_group:
            return 0
        return self._n_traced_of_group.get(self._groups.find_group_of_image(number), 0)

    def _load_predictor(self, group: int, number: int) -> Predictor | None:
        """Return the predictor of a group; None if its images are rendered.

        A predictor is cached. If too many are cached, the one that was made first is
        released.

        Args:
            group: index of the group.
            number: number of an image of the group, in the scene.
        """
        if group in self._predictors:
            return self._predictors[group]
        if len(self._predictors) >= self._groups.n_groups_to_cache:
            oldest = next(iter(self._predictors))
            self._predictors.pop(oldest)
        begin = time.perf_counter()
        self._predictors[group] = self._make_accurate_predictor(group, number)
        self.seconds += time.perf_counter() - begin
        return self._predictors[group]

    def _make_accurate_predictor(self, group: int, number: int) -> Predictor | None:
        """Make the predictor of a group, and compare it with traced images.

        It depends only on the index of its group, not on the image that needs it first,
        so that a sweep that was stopped continues with the same predictors.

        Args:
            group: index of the group.
            number: number of an image of the group, in the scene.

        Returns:
            The predictor; None if it deviates too much. Then the images of its group
            are rendered.
        """
        # A scene has no more groups than images. So no two groups of the sweep have
        # the same index.
        group_index = self.images_before + group
        seed = seeds.derive_seed(self.seed, "light", group_index)
        # that of the first image of the group, whichever image comes first
        configuration = self._make_configuration(number, index=0)
        predictor = self.method.make_predictor(configuration, seed)
        deviation = self._compare(predictor, number, seed)
        self.deviations.append(deviation)
        self._n_traced_of_group[group] = predictor.n_traced_images + deviation.n_traced
        if deviation.is_accepted:
            return predictor
        self.rendered_groups.add(group)
        return None

    def _compare(self, predictor: Predictor, number: int, seed: int) -> Deviation:
        """Compare predicted images of a group with traced ones.

        The compared images are random members of the group, of which one may be taken
        more than once. They and the noise of the traced images follow from `seed`.

        Args:
            predictor: predictor of the group.
            number: number of an image of the group, in the scene.
            seed: seed of the comparison.
        """
        compare_view = partial(self._compare_view, predictor, number, seed)
        with torch.no_grad():
            return compare_views(compare_view)  # calls it once for each view

    def _compare_view(
        self, predictor: Predictor, number: int, seed: int, check: int
    ) -> ComparedView:
        """Compare a random image of a group with a traced one.

        See `_compare` for the other arguments.

        Args:
            check: index of the comparison, for the seeds.
        """
        index = seeds.derive_seed(seed, "check", check) % self._groups.group_size
        u = self._make_configuration(number, index)
        (predicted,) = predictor.predict_images([u])
        return compare_with_traced(
            self.renderer,
            predicted,
            u,
            seeds.derive_seed(seed, "traced", check),
            self.problem.search_spp,
            self._compute_margin_in_8_bits,
        )

    def _compute_margin_in_8_bits(self, image: Tensor, u: Tensor) -> float:
        """Return the margin of the model's prediction about an image.

        The model gets images in 8 bits; other deviations are computed without rounding.
        """
        return self.problem.judge(round_to_8_bit(image), u).margin

    def _make_configuration(self, number: int, index: int) -> Tensor:
        """Return the configuration (d,) of an image of a group.

        Args:
            number: number of any image of the group, in the scene.
            index: index of the image in the group.
        """
        member = self._groups.find_image_of_group(number, index)
        return self.configurations.make_configurations(member, 1, self.images_before)[0]

    @property
    def n_non_finite(self) -> int:
        """Number of values of predicted images that were not finite and set to 0."""
        return sum(
            predictor.n_non_finite
            for predictor in self._predictors.values()
            if predictor is not None
        )

    def summarize(self) -> LinearTransport | None:
        """Return what a result states about predicted images.

        That is the worst deviation, the memory and the time, or why images are
        rendered. None if nothing varies that a method could predict.
        """
        if self.refusal is NOTHING_MOVES:
            return None
        if self.refusal is not None:
            return LinearTransport(used=False, reason=str(self.refusal))
        # `entries` and `renewed` are about the matrix of an attack. Sweeps have none.
        return LinearTransport(
            used=True,
            method=self.method.name,
            reason=self._explain_rendered_groups(),
            entries=0,
            bytes=self.method.bytes + self._count_predictor_bytes(),
            seconds=self.seconds,
            renewed=0,
            error=self._find_worst_error(),
        )

    def _explain_rendered_groups(self) -> str | None:
        """Return why some groups were rendered; None if none was."""
        if not self.rendered_groups:
            return None
        return (
            f"{len(self.rendered_groups)} of {self._groups.n_groups} groups were "
            "rendered: predicted pictures were too far off"
        )

    def _find_worst_error(self) -> PredictionError | None:
        """Return the largest deviation from traced images; None if none was compared."""
        if not self.deviations:
            return None
        worst = max(self.deviations, key=lambda deviation: deviation.levels)
        return PredictionError.from_values(worst)

    def _count_predictor_bytes(self) -> int:
        """Count the memory of the cached predictors."""
        return sum(
            predictor.n_bytes
            for predictor in self._predictors.values()
            if predictor is not None
        )


def combine_transport(
    all_summaries: Sequence[LinearTransport | None],
) -> LinearTransport | None:
    """Combine the summaries of the predicted images of several scenes.

    Args:
        all_summaries: summaries of all scenes and image sizes; None if nothing moves.

    Returns:
        The worst error, the largest memory, all seconds and the first reason, over the
        summaries with predicted images. If there are none, the last summary; None if
        nothing moves in any scene.
    """
    summaries = [summary for summary in all_summaries if summary is not None]
    with_predictions = [summary for summary in summaries if summary.used]
    if not with_predictions:
        return summaries[-1] if summaries else None
    reasons = [summary.reason for summary in with_predictions if summary.reason]
    errors = [summary.error for summary in with_predictions if summary.error]
    all_bytes = [summary.bytes or 0 for summary in with_predictions]
    all_seconds = [summary.seconds or 0.0 for summary in with_predictions]
    update = {
        "reason": reasons[0] if reasons else None,  # as an example for all
        "bytes": max(all_bytes),
        "seconds": math.fsum(all_seconds),
        # `levels` is how far an image was off, in levels of 8 bits.
        "error": max(errors, key=lambda error: error.levels or 0.0, default=None),
    }
    # The other fields, such as the method, are the same in all scenes.
    return with_predictions[0].model_copy(update=update)


def prepare_surface_light(
    verifier: Verifier, at: Tensor, coordinates: Tensor, n_images: int
) -> None:
    """Prepare light on surfaces for trials, if that is cheaper than rendering them.

    The trials vary some coordinates of a configuration. If light on surfaces can follow
    these, accurately enough and at less cost than rendering, the verifier's state gets
    it as `predictor`. If the camera moves, but the light is not used, the state gets
    the reason as `predictor_refusal`.

    Args:
        verifier: verifier of the trials, whose sample count is known.
        at: (d,) the configuration.
        coordinates: (k,) indices of the coordinates that vary.
        n_images: about how many trials there are.
    """
    problem = verifier.problem
    if not _can_light_follow(problem, coordinates):
        return
    state = verifier.run_state
    refusal = _find_light_refusal(problem.renderer, state.spp, n_images)
    state.predictor_refusal = refusal
    if refusal is not None:
        return
    title = "finding the light on surfaces"
    hint = "`specialise=false` leaves it out"
    verifier.progress_stages.begin("transport", title, N_LIGHTS, hint=hint)
    light = SurfaceLight(problem, 0, light_u=at, moving_coordinates=coordinates)
    # `prepare` compares predicted images with traced ones, and may refuse.
    light.prepare(verifier.progress_stages.progress.advance)
    state.predictor_refusal = light.accuracy_refusal
    is_accurate = light.accuracy_refusal is None
    state.predictor = light if is_accurate else None


def _can_light_follow(problem: Problem, coordinates: Tensor) -> bool:
    """Return whether the camera moves, and light on surfaces can follow what varies.

    Args:
        problem: problem of the trials.
        coordinates: (k,) indices of the coordinates that vary.
    """
    varying = set(coordinates.tolist())
    # the parameters that have any of these coordinates
    parameter_names = [
        group.name
        for group in problem.space.groups
        if not varying.isdisjoint(range(group.begin, group.begin + group.size))
    ]
    changed_inputs = find_changed_inputs(problem.renderer, parameter_names)
    moves_camera = bool(changed_inputs & CAMERA_INPUTS)
    # light on surfaces cannot follow a change of any other input
    can_follow = changed_inputs <= FREE_INPUTS
    return moves_camera and can_follow


def _find_light_refusal(renderer: Renderer, spp: int, n_images: int) -> Refusal | None:
    """Return why light on surfaces is not tried; None if it is.

    Args:
        renderer: renderer of the images.
        spp: samples per pixel of the images.
        n_images: number of images under one light.
    """
    refusal = find_scene_refusal(renderer)
    if refusal is not None:
        return refusal
    min_images = find_break_even(renderer, spp)
    if n_images >= min_images:
        return None
    reason = f"light on surfaces pays from {min_images} pictures on"
    # The cause is named after an attack, in which each image is a step.
    return Refusal(reason, RefusalCause.TOO_FEW_STEPS)
