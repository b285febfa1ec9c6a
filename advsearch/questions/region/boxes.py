"""Grow boxes around a point while a property stays the same, and sample them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from advsearch.extend import InputError, seeds, statistics

LEVELS = 6  # number of fractions by which faces move, each half of the previous one
ATTEMPTS = 4  # maximum number of final checks
PROBES = 8  # random points in the slab that a face would add to the box
USUAL_PROBED = 100  # usual number of images for each parameter while a box grows
MAX_PROBED = 400
"""Maximum number of images for each parameter while a box grows. It is more than twice
what regions that are boxes, balls, half-spaces or noise have needed.
"""
MIN_STEP = 1e-3  # a face does not move by less
# A face that excludes a point is moved to this fraction of the distance from the center
# to the point.
PULLED_IN = 0.98

IsSame = Callable[[Tensor, int], bool]
"""(u, number) -> whether the prediction at u is that of the center. The number is that
of the evaluation, from 0, and decides its seed.
"""


@dataclass(frozen=True, eq=False)
class GrownBox:
    """A box inside the unit box in which the prediction stays the same.

    Attributes:
        center: the point that it grew around (d,).
        low, high: its corners (d,).
        n_same: how many of the final samples had the center's prediction.
        samples: number of the final samples.
        renders: number of all images.
    """

    center: Tensor
    low: Tensor
    high: Tensor
    n_same: int
    samples: int
    renders: int

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the fraction of the box with the center's prediction.

        The last box is the best of up to `ATTEMPTS`, so the confidence is corrected for
        as many checks (Bonferroni).
        """
        return statistics.intervals.clopper_pearson(
            self.n_same, self.samples, 1.0 - 0.05 / ATTEMPTS
        )

    @property
    def volume(self) -> float:
        """The fraction of the unit box that the box takes up."""
        return float((self.high - self.low).prod())


def grow_box(
    is_same: IsSame,
    center: Tensor,
    *,
    seed: int,
    samples: int = 200,
    on_check: Callable[[], None] = lambda: None,
) -> GrownBox:
    """Grow a box around a point, then check it with fresh samples.

    Each face in turn tries to move outwards by a fraction of its distance to the bound.
    The slab that it would add is probed at random points. If all of them have the
    center's prediction, the face moves. The fraction is 1/2 at first, and is halved
    when no face can move any more. Growing ends after `MAX_PROBED` images for each
    parameter at the latest.

    Then the box is checked by samples. An exception is a sample with another prediction
    than the center. For each exception that is still inside, one face moves inwards to
    exclude it: the face that cuts off the smallest part of the box. Then the box is
    checked again with new samples. After `ATTEMPTS` checks, the last one is reported
    even if it has exceptions. The samples of a check are independent of the box, so
    that a confidence interval from them is valid.

    Args:
        is_same: function that returns whether a point (d,) has the prediction of the
            center.
        center: center in [0, 1] (d,).
        seed: seed of the random points.
        samples: number of samples of each check.
        on_check: called at the beginning of each check.

    Raises:
        InputError: there are no samples, or the center lies outside the unit box.
    """
    _check_growing(center, samples)
    box = GrowingBox(is_same, center, seed)
    box.grow()
    n_exceptions = box.shrink(samples, on_check)
    return GrownBox(
        center=center,
        low=box.low,
        high=box.high,
        n_same=samples - n_exceptions,
        samples=samples,
        renders=box.n_evaluated,
    )


def _check_growing(center: Tensor, samples: int) -> None:
    """Raise an error without samples, or with a center (d,) outside the unit box."""
    if samples < 1:
        raise InputError(f"samples: expected at least 1, got {samples}")
    is_inside = bool(((center >= 0.0) & (center <= 1.0)).all())
    if not is_inside:
        raise InputError(
            "the centre of a region has to lie inside the ranges of its parameters"
        )


class GrowingBox:
    """A box around a point whose faces move.

    Attributes:
        low, high: its corners (d,).
        n_evaluated: points that were evaluated.
    """

    def __init__(self, is_same: IsSame, center: Tensor, seed: int) -> None:
        """Start with a box that is only the center.

        Args:
            is_same: function that returns whether a point has the center's prediction.
            center: center in [0, 1] (d,).
            seed: seed of the random points.
        """
        self._is_same = is_same
        self._center = center
        self._seed = seed
        self._n_draws = 0
        self.low = center.clone()
        self.high = center.clone()
        self.n_evaluated = 0

    def grow(self) -> None:
        """Move faces out while the slabs that they add have the center's prediction."""
        n_faces = 2 * len(self._center)
        # A round of all faces begins only if it fits into the limit of images.
        max_before_round = MAX_PROBED * len(self._center) - n_faces * PROBES
        fraction = 0.5
        for _ in range(LEVELS):
            has_moved = True
            while has_moved and self.n_evaluated <= max_before_round:
                # A list, and not `any` of a generator: that would stop at the first.
                moves = [self._push(face, fraction) for face in range(n_faces)]
                has_moved = any(moves)
            fraction /= 2.0

    def shrink(self, samples: int, on_check: Callable[[], None]) -> int:
        """Exclude points with another prediction, until a check finds none.

        Args:
            samples: number of samples of each check; there are at most `ATTEMPTS`.
            on_check: called at the beginning of each check.

        Returns:
            The number of exceptions in the last check.
        """
        n_exceptions = 0
        for attempt in range(ATTEMPTS):
            on_check()
            exceptions = self.sample_exceptions(samples)
            n_exceptions = len(exceptions)
            is_last = attempt == ATTEMPTS - 1
            if n_exceptions == 0 or is_last:
                break
            for point in exceptions:
                self.exclude(point)
        return n_exceptions

    def sample_exceptions(self, count: int) -> Tensor:
        """Sample points of the box; return those (n, d) with another prediction."""
        points = self._sample(self.low, self.high, count)
        return points[[not self._evaluate(point) for point in points]]

    def exclude(self, point: Tensor) -> None:
        """Move a face inwards, so that a point is outside and the center stays inside.

        Of all faces that could do so, the one that cuts off the least of the box moves.
        A point that is outside already changes nothing.

        Args:
            point: (d,) a point with another prediction than the center.
        """
        is_inside = bool(((point >= self.low) & (point <= self.high)).all())
        if not is_inside:
            return
        axis = self._find_axis_to_cut(point)
        is_upper = bool(point[axis] > self._center[axis])
        # From the center, the fraction `PULLED_IN` (below 1) of the way to the point: so
        # the point is a little outside.
        new_bound = torch.lerp(self._center[axis], point[axis], PULLED_IN)
        self._move_face(axis, is_upper, new_bound)

    def _find_axis_to_cut(self, point: Tensor) -> int:
        """Return the axis along which a point (d,) is excluded by the smallest cut."""
        width = (self.high - self.low).clamp_min(1e-12)  # not divided by 0
        # For each axis (d,), the fraction of the box that is cut off if the face on the
        # point's side of the center moves to the point.
        lost_fraction = torch.where(
            point > self._center,
            (self.high - point) / width,
            (point - self.low) / width,
        )
        # No face can exclude the point along an axis where it is at the center, which
        # stays inside.
        lost_fraction = torch.where(point == self._center, torch.inf, lost_fraction)
        return int(lost_fraction.argmin())

    def _move_face(self, axis: int, is_upper: bool, bound: Tensor) -> None:
        """Move the upper or the lower face of an axis to a bound, a number."""
        corner = self.high if is_upper else self.low
        corner[axis] = bound

    def _push(self, face: int, fraction: float) -> bool:
        """Move a face outwards if the slab that this adds has the center's prediction.

        The step is a fraction of the distance to the bound, or all of it if little is
        left. The slab is probed at random points. If one has another prediction, or the
        step is less than `MIN_STEP`, the face stays.

        Args:
            face: index of the face: 2 * axis, and 1 more for the upper face.
            fraction: fraction of the distance between the face and its bound, which is
                0 for a lower face and 1 for an upper one.

        Returns:
            Whether the face moved.
        """
        axis, is_upper = divmod(face, 2)
        distance = float(1.0 - self.high[axis]) if is_upper else float(self.low[axis])
        step = _choose_step(distance, fraction)
        if step is None:
            return False
        outer = self.high[axis] + step if is_upper else self.low[axis] - step
        probes = self._sample_slab(axis, bool(is_upper), outer)
        if not all(self._evaluate(point) for point in probes):
            return False
        # Rounding may lead a little outside of [0, 1].
        self._move_face(axis, bool(is_upper), outer.clamp(0.0, 1.0))
        return True

    def _sample_slab(self, axis: int, is_upper: bool, outer: Tensor) -> Tensor:
        """Return points (n, d) of the slab between a face and where it would move.

        Args:
            axis: axis of the face.
            is_upper: whether the face is the upper one.
            outer: the coordinate that the face would move to.
        """
        slab_low = self.low.clone()
        slab_high = self.high.clone()
        if is_upper:
            slab_low[axis] = self.high[axis]
            slab_high[axis] = outer
        else:
            slab_low[axis] = outer
            slab_high[axis] = self.low[axis]
        probes = self._sample(slab_low, slab_high, PROBES)
        # One point is on the outer face, which random points never reach.
        probes[0, axis] = outer
        return probes

    def _evaluate(self, u: Tensor) -> bool:
        """Return whether a point has the center's prediction, and count it."""
        number = self.n_evaluated
        self.n_evaluated += 1
        return self._is_same(u, number)

    def _sample(self, low: Tensor, high: Tensor, count: int) -> Tensor:
        """Return points (count, d) uniform in a box; each call has new random numbers."""
        generator = torch.Generator().manual_seed(
            seeds.derive_seed(self._seed, "region", self._n_draws)
        )
        self._n_draws += 1
        unit_points = torch.rand(count, len(self._center), generator=generator)
        return torch.lerp(low, high, unit_points)


def _choose_step(distance: float, fraction: float) -> float | None:
    """Return how far a face tries to move; None if it is at its bound or too near.

    Args:
        distance: distance from the face to the bound.
        fraction: fraction of this distance that the face tries to move.
    """
    if distance <= 0.0:
        return None
    # Close to the bound the face moves there at once. By a fraction of the distance it
    # would never reach the bound.
    is_close = distance < 4.0 * MIN_STEP
    if is_close:
        return distance
    step = fraction * distance
    return step if step >= MIN_STEP else None
