"""Groups of the images of a sweep, each of which one predictor serves."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from advsearch.attacks.domain import ProductIndex


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
