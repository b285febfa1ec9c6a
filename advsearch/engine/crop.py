"""Searches that render only the window of the image in which something can change.

What is searched may show in a small part of the image. A search then renders the
smallest window around it for which this holds: outside, whole images at both ends of
the budget differ from that of the start by less than `MAX_LEVELS` on average. The rest
is pasted from a whole image, which is rendered again every `COMPARISON_INTERVAL`
evaluations: that also measures what was missed. Where this is too much twice in a row,
the rest of the search renders whole images. The ranking and all trials do so anyway.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn import functional

from advsearch import seeds
from advsearch.attacks import Evaluation
from advsearch.attacks.evaluation import Query
from advsearch.engine.acceptance import (
    ACCEPTED_FRACTION,
    MAX_BIAS_FRACTION,
    MAX_MARGIN_BIAS,
    Deviation,
)
from advsearch.engine.problem import Problem
from advsearch.engine.transport import PredictedSearch
from advsearch.scene.assembly import IMAGE_INPUTS
from advsearch.scene.predictor import NOISE, Refusal, RefusalCause
from advsearch.scene.renderer import Crop, Renderer
from advsearch.scene.surface.renderer import find_changed_inputs
from advsearch.scene.transport.lights import HAZE, find_light_inputs
from advsearch.scene.transport.matrix import ProgressCallback
from advsearch.scene.window import Window

MIN_STEPS = 16
"""Evaluations of a search from which on a crop pays: it takes three whole images."""
MAX_AREA = 0.4  # largest window that pays, as a fraction of the image
MAX_LEVELS = 0.1
"""Difference outside of the window that is allowed, in levels of 255.

It is the root mean square of the means over squares of `SQUARE` pixels.
"""
SQUARE = 8
MARGINS = (8, 16, 24, 32, 48, 64, 96, 128)  # pixels around the box, smallest first
COMPARISON_INTERVAL = 20  # evaluations from one whole image to the next
MOVING_SUFFIXES = (".vertices", ".normals")


def find_crop_refusal(problem: Problem) -> Refusal | None:
    """Return why a search renders whole images; None if a crop may be enough.

    What it misses outside is measured only then.
    """
    renderer = problem.renderer
    if renderer.composition_reason:
        return Refusal(renderer.composition_reason)
    if problem.conditions is not None:
        return Refusal("the surroundings of each picture are others")
    if problem.steps < MIN_STEPS:
        return Refusal(
            f"a crop pays from {MIN_STEPS} evaluations on", RefusalCause.TOO_FEW_STEPS
        )
    if renderer.scene.is_volumetric:
        return HAZE
    if renderer.scene.definition[0].camera_model is not None:
        return Refusal("the camera has a lens of its own")
    if renderer.formation.denoiser != "oidn":
        return NOISE
    return _find_searched_refusal(problem)


def _find_searched_refusal(problem: Problem) -> Refusal | None:
    """Return why what is searched shows in more than a part of the image."""
    light_inputs = find_light_inputs(problem.renderer)
    names = _find_searched_inputs(problem)
    if not names:
        return Refusal("nothing that is searched needs a render")
    shapes = problem.renderer.surfaces(problem.renderer.start).names
    for name in sorted(names):
        part = name.partition(".")[0]
        if name in light_inputs:
            return Refusal(f"{part} is light, which shows everywhere")
        if name.endswith(MOVING_SUFFIXES):
            return Refusal(f"{part} moves")
        if part not in shapes:
            return Refusal(f"{part} shows in more than a part of the picture")
    return None


def _find_searched_inputs(problem: Problem) -> frozenset[str]:
    """Return the scene inputs that are searched."""
    names = [control.name for control in problem.searched_space.controls]
    return find_changed_inputs(problem.renderer, names) - IMAGE_INPUTS


@dataclass(frozen=True, eq=False)
class WholeImage:
    """A whole image, rendered twice with independent noise.

    Attributes:
        u: (d,) its configuration.
        halves: both, linear radiance (H, W, 3 or 4) with noise.
        radiance: their mean (H, W, 3 or 4), denoised.
    """

    u: Tensor
    halves: Sequence[Tensor]
    radiance: Tensor


@dataclass
class CroppedSearch(PredictedSearch):
    """The window of a run's searches, and what is around it.

    Attributes:
        window: that is rendered; None before it is chosen, or if there is none.
        refusal: why there is none.
    """

    method: ClassVar[str] = "crop"
    title: ClassVar[str] = "finding the part of the picture that can change"
    what_it_renders: ClassVar[str] = "renders that part alone"

    window: Window | None = None
    refusal: Refusal | None = None
    # the latest whole image of each kind of search, and the renderer with that around
    _current: dict[str, tuple[WholeImage, Renderer]] = field(default_factory=dict)

    @property
    def n_samples(self) -> int:
        return 3 * self._half_spp * 2

    @property
    def _half_spp(self) -> int:
        """Samples per pixel of each half of a whole image."""
        return max(1, self.problem.spp // 2)

    @property
    def accuracy_refusal(self) -> Refusal | None:
        return self.refusal

    def measure_size(self) -> tuple[int, int]:
        height, width = self.problem.renderer.formation.resolution
        return 0, 3 * 4 * 3 * height * width * len(self._current)

    def count_predicted(self, kind: str, evaluations: int) -> int:
        return 0  # they are rendered

    def prepare(self, tick: ProgressCallback = lambda samples: None) -> None:
        """Choose the window: render whole images at the start and at both ends."""
        domain = self.problem.domain
        with self.count_time(), torch.no_grad():
            box = self._find_box()
            if isinstance(box, Refusal):
                self.refusal = box
                return
            corners = torch.zeros_like(domain.start), torch.ones_like(domain.start)
            whole_images = []
            for u in (domain.start, *map(domain.project, corners)):
                whole_images.append(self._render_whole(u))
                tick(2 * self._half_spp)
            self._choose_window(box, whole_images)
        if self.window is not None:
            self._use("start", whole_images[0])

    def _find_box(self) -> Window | Refusal:
        """Return the box of all that is searched, at the start."""
        renderer = self.problem.renderer
        surfaces = renderer.surfaces(self.problem.domain.start)
        mask = torch.zeros(renderer.formation.resolution, dtype=torch.bool)
        for name in _find_searched_inputs(self.problem):
            mask |= surfaces.visible_mask(name.partition(".")[0])
        box = Window.from_mask(mask)
        if box is None:
            return Refusal("nothing of what is searched is in the picture")
        if box.area > MAX_AREA * mask.numel():
            return Refusal("what is searched fills the picture")
        return box

    def _choose_window(self, box: Window, images: Sequence[WholeImage]) -> None:
        """Choose the smallest window around a box outside of which images differ
        little.
        """
        start, *others = images
        resolution = self.problem.renderer.formation.resolution
        for margin in MARGINS:
            window = box.grow(margin, resolution)
            if window.area > MAX_AREA * resolution[0] * resolution[1]:
                break
            deviation = self._measure(window, start, others)
            if deviation.is_accepted:
                self.window = window
                self.deviations.append(deviation)
                return
        window = box.grow(MARGINS[0], resolution)
        deviation = self._measure(window, start, others)
        self.refusal = Refusal(
            f"the rest of the picture changes with what is searched: "
            f"{_describe(deviation)}"
        )

    def _render_whole(self, u: Tensor) -> WholeImage:
        """Render a whole image of u (d,), with the same noise for each u."""
        problem = self.problem
        inputs = problem.renderer.scene.assembly(problem.space.inputs(u))
        seed = seeds.stream(problem.seed, "crop")
        with problem.renderer.scene.limit_depth(problem.search_depth):
            halves, radiance = problem.renderer.trace_halves(
                inputs, seed, self._half_spp
            )
        self.n_traced += 1
        return WholeImage(u, halves, radiance)

    def _measure(
        self, window: Window, before: WholeImage, others: Sequence[WholeImage]
    ) -> Deviation:
        """Measure by how much images differ outside of a window, the mean over several.

        Args:
            window: the pixels that are rendered.
            before: the image whose surroundings are pasted.
            others: the images that are compared with it.
        """
        squares = []
        biases = []
        changes = []
        for image in others:
            squares.append(self._measure_square(window, before, image))
            bias, change = self._measure_margin(window, before, image)
            biases.append(bias)
            changes.append(change)
        count = len(others)
        limit = max(MAX_MARGIN_BIAS, MAX_BIAS_FRACTION * sum(changes) / count)
        return Deviation(
            levels=math.sqrt(max(0.0, sum(squares) / count)),
            logits=sum(biases) / count,
            allowed_levels=MAX_LEVELS,
            n_traced=count,
            allowed_margin_bias=limit,
        )

    def _measure_square(
        self, window: Window, before: WholeImage, after: WholeImage
    ) -> float:
        """Return the mean squared difference outside of a window, in squared levels.

        Images of one seed have nearly the same noise. The product of the differences
        of two seeds is the square without what noise is left.
        """
        renderer = self.problem.renderer
        outside = window.is_outside(renderer.formation.resolution).float()
        slope = self._compute_slope(before)
        sums = [
            _sum_squares(255.0 * slope * (new - old)[..., :3] * outside[..., None])
            for old, new in zip(before.halves, after.halves, strict=True)
        ]
        n_pixels = _sum_squares(outside[..., None])
        products = sums[0] * sums[1] / n_pixels.clamp_min(1.0)
        return float(products.sum() / (3.0 * n_pixels.sum().clamp_min(1.0)))

    def _compute_slope(self, image: WholeImage) -> Tensor:
        """Return the derivative of the displayed image by its radiance, (H, W, 3)."""
        radiance = image.radiance.clone()
        inputs = self._compute_inputs(image.u)
        renderer = self.problem.renderer
        with torch.enable_grad():
            radiance.requires_grad_()
            linear = renderer.finish_image(radiance, inputs, image.u, display=False)
            displayed = renderer.formation.display(linear)
            (slope,) = torch.autograd.grad(displayed.sum(), radiance)
        return slope[..., :3]

    def _compute_inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Return the scene inputs of u (d,)."""
        problem = self.problem
        return problem.renderer.scene.assembly(problem.space.inputs(u))

    def _measure_margin(
        self, window: Window, before: WholeImage, after: WholeImage
    ) -> tuple[float, float]:
        """Return how much larger the margin is with the surroundings of another image,
        and by how much it has moved from that image.
        """
        pixels = window.select(after.radiance)
        pasted = window.paste(pixels, before.radiance)
        margin = self._compute_margin(after.radiance, after.u)
        bias = self._compute_margin(pasted, after.u) - margin
        return bias, abs(margin - self._compute_margin(before.radiance, before.u))

    def _compute_margin(self, radiance: Tensor, u: Tensor) -> float:
        """Return the model's margin on the image of radiance (H, W, 3 or 4)."""
        inputs = self._compute_inputs(u)
        image = self.problem.renderer.finish_image(radiance, inputs, u)
        return self.problem.judge(image, u).margin

    def _use(self, kind: str, image: WholeImage) -> Renderer:
        """Paste the surroundings of an image in a kind of search from now on."""
        assert self.window is not None
        crop = Crop(self.window, image.radiance)
        renderer = self.problem.renderer.copy_with(crop=crop)
        self._current[kind] = image, renderer
        return renderer

    def replay(self, query: Query) -> None:
        self._update(query)

    def evaluate(self, query: Query) -> Evaluation:
        renderer = self._update(query)
        if renderer is None:
            return self.problem.evaluate(query)
        return self.problem.evaluate_full(query, query.u, query.seed, renderer)[0]

    def _update(self, query: Query) -> Renderer | None:
        """Return the renderer of a query; None where whole images are rendered.

        Where that is due, a whole image is rendered, measured and used.
        """
        kind = query.kind
        number = query.number
        first_whole = self.first_traced.get(kind, self.steps)
        if query.phase != "search" or number >= first_whole:
            return None
        if "start" not in self._current:
            self.prepare()
        image, renderer = self._current.setdefault(kind, self._current["start"])
        if number == 0 or number % COMPARISON_INTERVAL or not kind.startswith("search"):
            return renderer
        assert self.window is not None
        was_accepted = self.deviations[-1].is_accepted
        with self.count_time(), torch.no_grad():
            whole = self._render_whole(query.u)
            deviation = self._measure(self.window, image, [whole])
        self.deviations.append(deviation)
        if not deviation.is_accepted and not was_accepted:
            self.trace_from(kind, number, f" of the {kind}")
            return None
        self.n_renewals = (self.n_renewals or 0) + 1
        return self._use(kind, whole)


def _sum_squares(image: Tensor) -> Tensor:
    """Return the sums over squares of `SQUARE` pixels of an image (H, W, c)."""
    sums: Tensor = functional.avg_pool2d(
        image.movedim(-1, 0)[None], SQUARE, ceil_mode=True, divisor_override=1
    )
    return sums


def _describe(deviation: Deviation) -> str:
    """Return how far a deviation is over its limits, for a sentence."""
    if deviation.levels_fraction > ACCEPTED_FRACTION:
        return (
            f"by {deviation.levels:.2f} levels of 255, where "
            f"{ACCEPTED_FRACTION * deviation.allowed_levels:.2f} would do"
        )
    return (
        f"by {deviation.logits:+.2f} in the margin, where "
        f"{deviation.allowed_margin_bias:.2f} would do"
    )
