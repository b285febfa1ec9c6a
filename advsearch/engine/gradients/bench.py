"""Compute gradients of a loss by different estimators on one renderer."""

from __future__ import annotations

import base64
import statistics
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.scene.gradients import GradientPlan
from advsearch.scene.renderer import Renderer

Loss = Callable[[Tensor], Tensor]
"""From an image (H, W, 3) sRGB to a number, by differentiable torch operations."""

# Periodic coordinates are moved from their start by this fraction of a full turn.
PERIODIC_OFFSET = 0.0317
# A larger group of coordinates is a texture or another image.
MAX_SMALL_GROUP = 64


def find_interior_point(renderer: Renderer, fraction: float = 0.12) -> Tensor:
    """Return a point (d,) near the start at which gradients are measured.

    At a bound the objective has a kink, and a central difference can't be taken. So the
    point is inside the bounds.

    - Discrete choices stay at their start.
    - Periodic coordinates are turned a little, as starts are often symmetric.
    - Other coordinates of small groups keep a distance from their bounds.
    - Groups of more than `MAX_SMALL_GROUP` coordinates stay at their start. But if all
      of their coordinates start at a bound, as those of a projector's black image, they
      are moved to the center of their range.

    Args:
        renderer: renderer with the start and the groups.
        fraction: smallest distance from the bounds, as a fraction of the range.
    """
    u = renderer.start.clone()
    for group in renderer.plan.groups:
        coordinates = group.coordinates
        has_derivative = bool(group.valid)  # a discrete choice has no valid estimator
        is_large = group.size > MAX_SMALL_GROUP
        if has_derivative and not is_large and not group.periodic:
            u[coordinates] = u[coordinates].clamp(fraction, 1.0 - fraction)
        if has_derivative and is_large and _is_at_bounds(u[coordinates]):
            u[coordinates] = 0.5
        if group.periodic:
            u[coordinates] = (u[coordinates] + PERIODIC_OFFSET).remainder(1.0)
    return u


def _is_at_bounds(values: Tensor) -> bool:
    """Return whether all coordinates (n,) are 0 or 1."""
    return bool(((values == 0.0) | (values == 1.0)).all())


def restrict_plan(
    plan: GradientPlan, names: Collection[str], estimator: str | None = None
) -> GradientPlan:
    """Return the plan with only the named groups differentiated.

    `estimator` is that of all of these; None for the one that the plan has for each.
    """
    groups = []
    for group in plan.groups:
        group_estimator = "none"
        if group.name in names:
            group_estimator = estimator or group.estimator
        groups.append(replace(group, estimator=group_estimator))
    return replace(plan, groups=tuple(groups))


StoreMeasurement = Callable[[str, Callable[[], Any]], Any]
"""From the name of a measurement, and the function that measures, to its JSON value.

The value may have been stored by an earlier run.
"""


@dataclass(frozen=True, eq=False)
class Bench:
    """Computes gradients of a loss of the image at one configuration.

    Attributes:
        renderer: renders the image.
        loss: loss of the image.
        u: (d,) configuration.
        seed: root seed of the noise.
        spp: samples per pixel.
        store: called for each measurement, which it may store.
        tick: called with the samples of each gradient that is computed.
    """

    renderer: Renderer
    loss: Loss
    u: Tensor
    seed: int
    spp: int
    store: StoreMeasurement = lambda name, measure: measure()
    tick: Callable[[int], object] = lambda samples: None

    def compute_gradient(self, plan: GradientPlan, seed: int) -> Tensor:
        """Return one gradient (d,) by a plan, under the noise of a seed."""
        plan_before = self.renderer.plan
        self.renderer.plan = plan
        try:
            _, gradient = self.renderer.gradient(self.loss, self.u, seed, self.spp)
            return gradient
        finally:
            self.renderer.plan = plan_before

    def compute_gradients(
        self, plan: GradientPlan, stream: str, repeats: int, label: str | None = None
    ) -> tuple[Tensor, float]:
        """Return several gradients by a plan, and the median seconds of one.

        Args:
            plan: how derivatives are computed.
            stream: stream of seeds; each gradient has the seed of its index.
            repeats: how many gradients.
            label: name under which each is stored; None to store none.

        Returns:
            Gradients (repeats, d), zero where the plan has no derivative, and seconds.
        """
        slices = _list_slices(plan)
        gradients = torch.zeros(repeats, len(self.u))
        seconds = []
        for index in range(repeats):
            measurement = self._load_measurement(plan, stream, index, label)
            _copy_derivatives(measurement["numbers"], slices, gradients[index])
            seconds.append(measurement["seconds"])
            # For gradients that are not stored, the caller reports the progress.
            if label is not None:
                self.tick(self.spp)
        return gradients, statistics.median(seconds)

    def _load_measurement(
        self, plan: GradientPlan, stream: str, index: int, label: str | None
    ) -> dict[str, Any]:
        """Return a gradient as `_measure_gradient` does, or from the store by a label."""
        measure = partial(self._measure_gradient, plan, stream, index)
        if label is None:
            return measure()
        measurement: dict[str, Any] = self.store(f"{label} gradient {index}", measure)
        return measurement

    def _measure_gradient(
        self, plan: GradientPlan, stream: str, index: int
    ) -> dict[str, Any]:
        """Return a gradient as JSON: its seconds, and its numbers as base64 of float32.

        Only the coordinates for which the plan has an estimator are written, group by
        group.
        """
        started = time.perf_counter()
        noise_seed = seeds.derive_seed(self.seed, stream, index)
        gradient = self.compute_gradient(plan, noise_seed)
        slices = _list_slices(plan)
        derivatives = torch.cat([gradient[coordinates] for coordinates in slices])
        float32_bytes = derivatives.to(torch.float32).numpy().tobytes()
        numbers = base64.b64encode(float32_bytes).decode("ascii")
        return {"seconds": time.perf_counter() - started, "numbers": numbers}


def _list_slices(plan: GradientPlan) -> list[slice]:
    """Return the coordinates of each group with an estimator."""
    return [group.coordinates for group in plan.groups if group.estimator != "none"]


def _copy_derivatives(numbers: str, slices: Sequence[slice], gradient: Tensor) -> None:
    """Copy the derivatives of `Bench._measure_gradient` into a gradient (d,).

    Args:
        numbers: derivatives of all groups, one group after the other, as float32 in
            base64.
        slices: coordinates of each group.
        gradient: gradient that is changed.
    """
    sizes = [coordinates.stop - coordinates.start for coordinates in slices]
    # `frombuffer` needs writable memory
    buffer = bytearray(base64.b64decode(numbers))
    derivatives = torch.frombuffer(buffer, dtype=torch.float32).split(sizes)
    for coordinates, values in zip(slices, derivatives, strict=True):
        gradient[coordinates] = values
