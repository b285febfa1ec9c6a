"""The domain of a search: a start, norm budgets around it, and bounds, all in the unit
box. Also sequences of points by number, for sweeps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advsearch.errors import InputError
from advsearch.seeds import derive_seed

Norm = Literal["linf", "l2", "box"]
NORMS: tuple[str, ...] = get_args(Norm)

TOLERANCE = 2e-6
"""Largest distance outside its budget at which a configuration still counts as inside,
because it may be rounding of float32. It is absolute in u, and relative to the radius.
`Block.rounding_error` is allowed in addition, as rounding adds up in an l2 norm.
"""


@dataclass(frozen=True)
class Block:
    """One contiguous slice of u, which holds a parameter, and how far it may go.

    Attributes:
        size: number of elements, at least 1.
        norm: "linf" or "l2" for a ball around the start, cut by the bounds; "box" for
            the bounds alone.
        epsilon: radius of the ball in units of u, over 0 and finite; None for "box".
            For "l2" it is the norm of the whole block, not a norm per element, so a
            sensible value grows with the square root of the size.
        low: lower bound of each element, at least 0.
        high: upper bound of each element, over `low` and at most 1.
        periodic: whether `low` and `high` mean the same value, as for an angle. Then
            projecting wraps around. Only for "box".
        name: name of the parameter, e.g. "pose.yaw".
        n_options: number of options of a discrete choice; 0 for numbers. An element u
            means option floor(u * options). A choice has size 1, norm "box" and the
            bounds [0, 1], and no gradient.
        unit_step_length: length of one unit step in a "box", over 0; None for half the
            diagonal of the bounds.

    Raises:
        InputError: a value is outside these limits.
    """

    size: int
    norm: Norm = "box"
    epsilon: float | None = None
    low: float = 0.0
    high: float = 1.0
    periodic: bool = False
    name: str = ""
    n_options: int = 0
    unit_step_length: float | None = None

    def __post_init__(self) -> None:
        """Check that every attribute is within its limits."""
        self._check_size_and_norm()
        self._check_interval()
        self._check_epsilon()
        self._check_box_options()
        self._check_n_options()

    @property
    def _name_suffix(self) -> str:
        """What names the block in messages: " of 'pose.yaw'", say, or nothing."""
        return f" of {self.name!r}" if self.name else ""

    def _check_size_and_norm(self) -> None:
        """Raise InputError if the block is empty or its norm unknown."""
        if self.size < 1:
            raise InputError(
                f"block{self._name_suffix}: expected a size of at least 1, got "
                f"{self.size}"
            )
        if self.norm not in NORMS:
            raise InputError(
                f"`norm`{self._name_suffix}: expected one of {', '.join(NORMS)}, got "
                f"{self.norm!r}"
            )

    def _check_interval(self) -> None:
        """Raise InputError if the bounds are not an interval within [0, 1]."""
        if not 0.0 <= self.low < self.high <= 1.0:
            raise InputError(
                f"bounds{self._name_suffix}: expected 0 <= low < high <= 1, got "
                f"[{self.low}, {self.high}]"
            )

    def _check_epsilon(self) -> None:
        """Raise InputError if a box has an epsilon, or a ball has none in its limits."""
        is_box = self.norm == "box"
        if is_box and self.epsilon is not None:
            raise InputError(
                f"`epsilon`{self._name_suffix}: has bounds and no norm budget; leave "
                "`epsilon` out"
            )
        has_budget = self.epsilon is not None and 0.0 < self.epsilon < math.inf
        if not is_box and not has_budget:
            raise InputError(
                f"`epsilon`{self._name_suffix}: expected a finite number over 0 (the "
                f"{self.norm} radius, in units where the parameter's whole range is "
                f"1), got {self.epsilon}; try `epsilon=0.1`"
            )

    def _check_box_options(self) -> None:
        """Raise InputError if a ball has what only a box may have.

        That is to be periodic, or a `unit_step_length`, which messages call its reach.
        """
        is_box = self.norm == "box"
        if self.periodic and not is_box:
            raise InputError(
                f"block{self._name_suffix}: a periodic block cannot have a norm "
                "budget; use norm 'box'"
            )
        reach = self.unit_step_length
        if reach is not None and (not is_box or not reach > 0.0):
            raise InputError(
                f"block{self._name_suffix}: expected a reach over 0 and norm 'box', "
                f"got {reach} and {self.norm!r}"
            )

    def _check_n_options(self) -> None:
        """Raise InputError if a discrete choice is not one number of the full range."""
        has_full_range = self.low == 0.0 and self.high == 1.0 and not self.periodic
        is_plain_number = self.size == 1 and self.norm == "box" and has_full_range
        is_choice = self.n_options != 0  # 0 options mean numbers
        if is_choice and (self.n_options < 0 or not is_plain_number):
            raise InputError(
                f"block{self._name_suffix}: expected a discrete choice to have at "
                "least one option, size 1, norm 'box' and bounds [0, 1], got "
                f"{self}"
            )

    @property
    def radius(self) -> float:
        """The length of one unit step, in the block's own norm (Euclidean in a box).

        In a ball it is epsilon, but not more than the diameter of the bounds in that
        norm. In a box it is the reach, by default half the diagonal.
        """
        width = self.high - self.low
        diagonal = width * math.sqrt(self.size)
        if self.norm == "box":
            return (
                0.5 * diagonal
                if self.unit_step_length is None
                else self.unit_step_length
            )
        diameter = width if self.norm == "linf" else diagonal
        assert self.epsilon is not None  # every ball has one
        return min(float(self.epsilon), diameter)

    @property
    def rounding_error(self) -> float:
        """The largest amount that rounding of u to float32 may add to the l2 norm.

        An element in [0, 1] is rounded by at most half the spacing of float32 at 1. In
        the worst case all elements are rounded by that much in the same direction, as
        in a texture of one color. The l2 norm of these errors is sqrt(size) times one.
        """
        error_per_element = 0.5 * torch.finfo(torch.float32).eps
        return error_per_element * math.sqrt(self.size)


@dataclass(frozen=True, eq=False)
class Domain:
    """The set of configurations that a search may propose: the product of its blocks.

    Attributes:
        start: (d,) float32, the clean configuration, inside the bounds of every block.
            It is copied.
        blocks: consecutive slices of u, whose sizes add up to d.
        gradient_cost: number of renders that a full gradient costs, besides the render
            of the configuration itself: 0 for an adjoint, two for each number with
            central differences.
        partial_gradients: whether a search can request a "free" gradient: only those
            elements that cost no render.
        is_noise_free: whether evaluations have no noise, so that equal configurations
            have equal objectives and gradients. This is so if a matrix predicts the
            images (docs/transport.md).
        draws_conditions: whether evaluations have no noise of their own, but each one
            draws new conditions from a bank (docs/transport.md).
        restart_point: (d,) where a policy should begin instead of at the start, for
            policies that begin several times. Norm balls stay around the start.
        lower_bounds: (d,) float32 lower bounds, of the intersection of the block's
            bounds and its l-infinity ball.
        upper_bounds: (d,) float32 upper bounds of the same.

    Raises:
        InputError: sizes do not add up, a cost is under 0, the start is not finite or
            outside the bounds, or `restart_point` lies outside.
    """

    start: Tensor
    blocks: tuple[Block, ...]
    gradient_cost: int = 0
    partial_gradients: bool = False
    is_noise_free: bool = False
    draws_conditions: bool = False
    restart_point: Tensor | None = None
    lower_bounds: Tensor = field(init=False, repr=False)
    upper_bounds: Tensor = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Copy the start, compute the bounds of each element, and check all of them."""
        self._copy_start()
        if self.gradient_cost < 0:
            raise InputError(
                f"gradient_cost: expected at least 0, got {self.gradient_cost}"
            )
        self._compute_bounds()
        if self.restart_point is not None and not self.contains(self.restart_point):
            raise InputError(
                "restart_point: expected a configuration of the domain; project it"
            )

    def _copy_start(self) -> None:
        """Replace the start by a float32 copy, and the blocks by a tuple.

        Raises:
            InputError: the start has not as many elements as the blocks, or is not
                finite.
        """
        start = self.start.detach().to(torch.float32, copy=True)
        n_elements = sum(block.size for block in self.blocks)
        _check_elements(start, n_elements)
        # the dataclass is frozen
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "blocks", tuple(self.blocks))

    def _compute_bounds(self) -> None:
        """Compute `lower_bounds` and `upper_bounds`, the bounds (d,) of u's elements.

        An l-infinity ball around the start is a box too, so they are the bounds of its
        intersection with the block's own bounds. An l2 ball does not change them.

        Raises:
            InputError: the start lies outside the bounds of its block.
        """
        start = self.start
        lower = torch.empty_like(start)
        upper = torch.empty_like(start)
        for block, part in self.list_block_slices():
            lower[part] = block.low
            upper[part] = block.high
            _check_start_of_block(block, start[part], lower[part], upper[part])
            if block.norm == "linf" and block.epsilon is not None:
                # A slice is a view, so this changes `lower` and `upper` in place.
                lower[part].clamp_(min=start[part] - block.epsilon)
                upper[part].clamp_(max=start[part] + block.epsilon)
        # the dataclass is frozen
        object.__setattr__(self, "lower_bounds", lower)
        object.__setattr__(self, "upper_bounds", upper)

    @property
    def initial_point(self) -> Tensor:
        """(d,) where a policy should begin: `restart_point`, or else the start."""
        return self.start if self.restart_point is None else self.restart_point

    @property
    def dim(self) -> int:
        """Number of elements of u."""
        return self.start.numel()

    def check_dim(self, max_dim: int, policy: str, advice: str) -> None:
        """Check that a policy can search so many numbers.

        Args:
            max_dim: largest number of elements of u that the policy can search.
            policy: name of the policy, for the message.
            advice: end of the message, such as "use pgd or auto".

        Raises:
            InputError: u has more elements.
        """
        if self.dim > max_dim:
            raise InputError(
                f"policy '{policy}': expected at most {max_dim} numbers, got "
                f"{self.dim}; {advice}"
            )

    @property
    def element_names(self) -> list[str]:
        """The name of each element of u.

        It is that of the block ("pose.yaw"). If the block has several elements, their
        index is added ("camera.target.0").
        """
        names = []
        for block in self.blocks:
            if block.size == 1:
                names.append(block.name)
            else:
                names += [f"{block.name}.{number}" for number in range(block.size)]
        return names

    @property
    def option_counts(self) -> Tensor:
        """(d,) int64, number of options of each element of u; 0 if it is a number."""
        sizes = torch.tensor([block.size for block in self.blocks], dtype=torch.long)
        return torch.tensor(
            [block.n_options for block in self.blocks], dtype=torch.long
        ).repeat_interleave(sizes)

    def find_block(self, index: int) -> Block:
        """Return the block that an element of u belongs to."""
        return next(
            block for block, part in self.list_block_slices() if index < part.stop
        )

    def list_block_slices(self) -> list[tuple[Block, slice]]:
        """Return every block with its slice of u."""
        boundaries = [0, *accumulate(block.size for block in self.blocks)]
        return [
            (block, slice(begin, end))
            for block, (begin, end) in zip(
                self.blocks, pairwise(boundaries), strict=True
            )
        ]

    def project(self, u: Tensor) -> Tensor:
        """Return the configuration (d,) of the domain that is nearest to u (d,).

        The distance is Euclidean, in each block by itself; periodic blocks wrap around
        instead. Both tensors are float32 and finite. If u is inside the domain, the
        result is equal to it, bit for bit.

        An l-infinity ball cut by bounds is itself a box, so clipping is exact. An l2
        ball cut by bounds needs more (`project_l2_box`).
        """
        u = u.detach()
        projected = torch.clamp(u, self.lower_bounds, self.upper_bounds)
        for block, part in self.list_block_slices():
            if block.norm == "l2" and block.epsilon is not None:
                projected[part] = project_l2_box(
                    u[part], self.start[part], block.epsilon, block.low, block.high
                )
            elif block.periodic:
                projected[part] = _wrap_around(block, u[part], projected[part])
        return projected

    def violation(self, u: Tensor) -> float:
        """Return how far u (d,) lies outside of the domain.

        It is 0 inside, and infinity if u has NaN or infinite elements. Otherwise it is
        the largest distance of an element past its bound, or the largest excess of an
        l2 norm. The excess is the norm minus the radius and minus what rounding may add
        to a norm; it is relative to the radius if that is over 1.
        """
        # It is infinite for an infinite element. `torch.maximum` and `amax` return NaN
        # if an element is NaN; so does `max` below, if its first argument is NaN.
        excess = float(
            torch.maximum(self.lower_bounds - u, u - self.upper_bounds).amax()
        )
        for block, part in self.list_block_slices():
            if block.norm == "l2" and block.epsilon is not None:
                squares = (u[part] - self.start[part]).square_()
                norm = math.sqrt(float(squares.sum(dtype=torch.float64)))
                norm_excess = norm - block.epsilon - block.rounding_error
                excess = max(excess, norm_excess / max(1.0, block.epsilon))
        return math.inf if math.isnan(excess) else max(0.0, excess)

    def contains(self, u: Tensor, tolerance: float = TOLERANCE) -> bool:
        """Return whether u is a configuration of the domain, but for rounding."""
        return u.shape == self.start.shape and self.violation(u) <= tolerance

    def sample(
        self, generator: torch.Generator, n: int = 1, *, extreme: bool = False
    ) -> Tensor:
        """Draw configurations (n, d) float32 at random within the budget.

        - "linf" and "box": uniform in the box, or its intersection with the ball. A
          discrete choice gets the center of a random option.
        - "l2": uniform in the ball, then projected onto the bounds; not uniform where
          the bounds cut the ball.

        Args:
            generator: source of randomness; it advances.
            n: number of configurations.
            extreme: whether to sample norm balls where a model fails most often: an
                l-infinity ball at random corners, an l2 ball at its surface in a
                direction of random signs. A "box" is sampled as before: the corners of
                a range of poses, say, are no worse than its middle.
        """
        samples = []
        for _ in range(n):
            u = torch.empty_like(self.start)
            for block, part in self.list_block_slices():
                u[part] = self._sample_block(block, part, generator, extreme=extreme)
            samples.append(self.project(u))
        return torch.stack(samples)

    def _sample_block(
        self, block: Block, part: slice, generator: torch.Generator, *, extreme: bool
    ) -> Tensor:
        """Return a random value (size,) of a block, not yet projected.

        Args:
            block: the block.
            part: slice of u that it has.
            generator: source of randomness; it advances.
            extreme: whether a norm ball is sampled at its corners or surface.
        """
        uniform = torch.rand(block.size, generator=generator)
        if block.norm != "l2" or block.epsilon is None:
            fraction = _choose_fraction(block, uniform, extreme=extreme)
            return torch.lerp(
                self.lower_bounds[part], self.upper_bounds[part], fraction
            )
        if extreme:
            # The projection brings it to the surface.
            return self.start[part] + _make_far_change(uniform, block.epsilon)
        # one uniform number decides the distance from the center
        return self.start[part] + _sample_ball(
            block.size, block.epsilon, float(uniform[0]), generator
        )

    def compute_steepest_step(self, u: Tensor, gradient: Tensor) -> Tensor:
        """Return the unit step (d,) from u that increases a linear objective most.

        In each block, its length is the radius of the block, in the block's norm. To
        make a step, add a multiple of it to u and project.

        - "linf": radius * sign(gradient);
        - "l2": radius * gradient / ||gradient||;
        - "box": the same as "l2", but elements of u at a bound that the gradient would
          push past it get no step, so that they do not use up its length (as in
          projected-gradient methods for bounds);
        - a discrete choice, and a block whose gradient is zero: a step of zero.

        Args:
            u: (d,) float32, configuration of the domain.
            gradient: (d,) float32, gradient of the objective at u, finite.
        """
        step = torch.empty_like(gradient)
        for block, part in self.list_block_slices():
            slope = gradient[part]
            if block.n_options:
                step[part] = 0.0
            elif block.norm == "linf":
                torch.sign(slope, out=step[part])
                step[part] *= block.radius
            else:
                step[part] = _compute_euclidean_step(block, u[part], slope)
        return step


def _check_elements(start: Tensor, n_elements: int) -> None:
    """Raise InputError if a start has another number of elements, or is not finite."""
    if start.ndim != 1 or start.numel() != n_elements:
        raise InputError(
            f"start: expected shape ({n_elements},), the sum of the "
            f"blocks, got {tuple(start.shape)}"
        )
    if not bool(torch.isfinite(start).all()):
        raise InputError(
            "start: found NaN or infinite values; a start must be a configuration"
        )


def _check_start_of_block(
    block: Block, start: Tensor, lower: Tensor, upper: Tensor
) -> None:
    """Raise InputError if a block's start lies outside of its bounds, each (size,)."""
    is_inside = (start >= lower) & (start <= upper)
    if not bool(is_inside.all()):
        low = float(start.min())
        high = float(start.max())
        raise InputError(
            f"start{block._name_suffix}: expected values in "
            f"[{block.low}, {block.high}], got {low:.6g} to {high:.6g}"
        )


def _wrap_around(block: Block, u: Tensor, clipped: Tensor) -> Tensor:
    """Return the value (size,) of a periodic block, wrapped around at its bounds.

    Args:
        block: the block.
        u: (size,) value to wrap.
        clipped: (size,) the same value, clipped to the bounds.
    """
    wrapped = block.low + torch.remainder(u - block.low, block.high - block.low)
    # rounding of the sum may leave the bounds
    wrapped.clamp_(block.low, block.high)
    # Elements that clipping has not changed are inside and are not wrapped.
    return torch.where(u == clipped, clipped, wrapped)


def _choose_fraction(block: Block, uniform: Tensor, *, extreme: bool) -> Tensor:
    """Return random fractions (size,) of the way from the lower to the upper bound.

    Args:
        block: block that is a box, or an l-infinity ball.
        uniform: (size,) uniform random numbers in [0, 1).
        extreme: whether a ball is sampled at its corners.
    """
    if block.n_options:
        return option_center(uniform, block.n_options)
    if extreme and block.norm != "box":
        return uniform.round()  # 0 or 1: a corner
    return uniform


def _make_far_change(uniform: Tensor, radius: float) -> Tensor:
    """Return a vector (size,) of random signs that leads out of an l2 ball around 0.

    It is longer than the radius and than the diagonal of the unit box.

    Args:
        uniform: (size,) uniform random numbers in [0, 1), which give the signs.
        radius: radius of the ball.
    """
    signs = uniform.round() * 2.0 - 1.0
    far_distance = 2.0 * max(radius, math.sqrt(uniform.numel()))
    return signs * far_distance


def _compute_euclidean_step(block: Block, u: Tensor, slope: Tensor) -> Tensor:
    """Return the step (size,) of the length `block.radius` along a gradient.

    Args:
        block: block with the norm "l2" or "box".
        u: (size,) value of the block. In a box, elements at a bound that the gradient
            would push past it get no step.
        slope: (size,) gradient of the objective, finite.
    """
    if block.norm == "box" and not block.periodic:
        points_out_above = (u >= block.high) & (slope > 0)
        points_out_below = (u <= block.low) & (slope < 0)
        slope = slope.masked_fill(points_out_above | points_out_below, 0.0)
    # Divide by the largest element first, so that squares do not overflow. Then
    # the norm is at least 1, unless the slope is zero.
    slope = slope / slope.abs().amax().clamp_min(torch.finfo(slope.dtype).tiny)
    norm = max(float(torch.linalg.vector_norm(slope)), 1.0)
    return slope * (block.radius / norm)


def _sample_ball(
    size: int, radius: float, uniform: float, generator: torch.Generator
) -> Tensor:
    """Draw a point (size,), uniform in an l2 ball around 0 (Muller 1959).

    The direction is that of a normal vector. The distance from 0 is radius *
    uniform**(1 / size), because the volume grows with distance**size.

    Args:
        size: number of dimensions.
        radius: radius of the ball.
        uniform: a uniform random number in [0, 1), which decides the distance.
        generator: source of randomness for the direction; it advances.
    """
    direction = torch.randn(size, generator=generator)
    distance = radius * math.pow(uniform, 1.0 / size)
    norm = float(torch.linalg.vector_norm(direction))
    return direction.mul_(distance / max(norm, 1e-30))


def option_center(u: Tensor, options: Tensor | int) -> Tensor:
    """Return the center of u's option; option i of n is [i / n, (i + 1) / n)."""
    return (torch.floor(u * options).clamp_(max=options - 1) + 0.5) / options


# Number of elements that are processed at once. They fit into the cache of a core, and
# torch uses a single thread for so few.
CHUNK = 32768
# A norm that exceeds the radius by at most this fraction counts as inside, so that
# projecting twice changes nothing.
ROUNDING_SLACK = 1e-6

_MAX_ITERATIONS = 100


def project_l2_box(
    u: Tensor, center: Tensor, radius: float, low: float = 0.0, high: float = 1.0
) -> Tensor:
    """Project a point onto the intersection of an l2 ball and a box.

    The result is the nearest point, argmin_p ||p - u|| subject to ||p - center|| <=
    radius and low <= p <= high. Clipping and then rescaling does not give this point,
    and is far from it where the box cuts off much of the ball.

    The optimality conditions give p(t) = clip(center + t (u - center), low, high) with
    one multiplier t in (0, 1]. If p(1) lies in the ball, t is 1. Otherwise t solves
    ||p(t) - center|| = radius. With s = t^2 the squared norm is

        g(s) = sum_i min(s v_i^2, room_i^2),   v = u - center,

    where room_i is the distance from the center to the bound in the direction of v_i.
    g is concave, increasing and piecewise linear. So Newton's method from the left
    never overshoots, and reaches the exact root after finitely many steps, two to six
    in practice (Cominetti, Mascarenhas, Silva 2014, "A Newton's method for the
    continuous quadratic knapsack problem").

    Args:
        u: (d,) float32, finite, the point to project.
        center: (d,) float32, center of the ball, inside the bounds.
        radius: radius of the ball, over 0.
        low, high: bounds of every element.

    Returns:
        (d,), rounded towards the center, so that rounding never puts it outside of the
        ball. A point inside is returned bit for bit; projecting a result again changes
        at most the last bits.
    """
    # v_i^2 and room_i^2. `rooms` has the squared distance from the center to the clipped
    # u_i. If u_i is within the bounds, this is v_i^2 and not room_i^2. But then the
    # minimum in g is s v_i^2 with either, as s is at most 1.
    squares = _square_distances(u, center)
    rooms = _square_distances(u.clamp(low, high), center)
    # p(1), u clipped to the box, is the solution if it lies in the ball
    max_distance = radius * (1.0 + ROUNDING_SLACK)
    if rooms.total <= max_distance**2:
        return u.clamp(low, high)
    # Without the box this would be the solution. The box makes g smaller, so that the
    # solution is at least as large: Newton's method begins on its left.
    initial_s = radius**2 / squares.total
    s = _solve_multiplier(squares.chunks, rooms.chunks, radius, initial_s)
    return _move_towards(center, u, math.sqrt(s), low, high)


class _Squares(NamedTuple):
    """The squares of a vector's elements, in chunks of `CHUNK`, and their sum."""

    chunks: list[Tensor]
    total: float


def _square_distances(u: Tensor, center: Tensor) -> _Squares:
    """Return the squared distances of the elements of two vectors (d,)."""
    chunks = []
    total = 0.0
    chunk_pairs = zip(torch.split(u, CHUNK), torch.split(center, CHUNK), strict=True)
    for u_chunk, center_chunk in chunk_pairs:
        chunk = (u_chunk - center_chunk).square_()
        chunks.append(chunk)
        total += float(chunk.sum(dtype=torch.float64))
    return _Squares(chunks, total)


def _solve_multiplier(
    squares: Sequence[Tensor], rooms: Sequence[Tensor], radius: float, s: float
) -> float:
    """Return s with g(s) = sum_i min(s v_i^2, room_i^2) = radius^2, by Newton's method.

    v_i^2 is the squared distance of element i from the center of a ball, and room_i^2
    the largest that its bounds allow (derivation in `project_l2_box`). g is piecewise
    linear, so that the method ends at the exact root once it is on the right piece.

    Args:
        squares: v_i^2 in chunks.
        rooms: room_i^2 in chunks.
        radius: radius of the ball.
        s: where Newton's method begins, not above the solution.
    """
    for _ in range(_MAX_ITERATIONS):
        value, slope = _compute_squared_length(squares, rooms, s)
        # Newton's step; where nothing grows any more, it stays
        next_s = s + (radius**2 - value) / slope if slope > 0.0 else s
        if next_s <= s * (1.0 + 1e-7):  # steps only go up, so this one is rounding
            break
        s = next_s
    return s


def _compute_squared_length(
    squares: Sequence[Tensor], rooms: Sequence[Tensor], s: float
) -> tuple[float, float]:
    """Return g(s) = sum_i min(s v_i^2, room_i^2), and its derivative by s.

    The arguments are those of `_solve_multiplier`.
    """
    value = 0.0
    slope = 0.0
    for square, room in zip(squares, rooms, strict=True):
        scaled = square * s
        # elements that have reached their bound grow no further with s
        still_grows = (scaled < room).to(square.dtype)
        slope += float(torch.dot(square, still_grows))
        value += float(torch.minimum(scaled, room).sum(dtype=torch.float64))
    return value, slope


def _move_towards(
    center: Tensor, u: Tensor, t: float, low: float, high: float
) -> Tensor:
    """Return clip(center + t (u - center), low, high), rounded towards the center.

    An element that float32 rounded away from the center is moved back by one unit in
    the last place, so that the distance from the center is never too large.

    Args:
        center: (d,) center of the ball, inside the bounds.
        u: (d,) the point outside.
        t: fraction of the distance from the center to u.
        low, high: bounds of every element.
    """
    moved = torch.empty_like(u)
    chunks = zip(
        torch.split(moved, CHUNK),
        torch.split(u, CHUNK),
        torch.split(center, CHUNK),
        strict=True,
    )
    for out, u_chunk, center_chunk in chunks:
        # `out` is a part of `moved`, so this writes the result there
        _move_chunk_towards(center_chunk, u_chunk, t, out)
        out.clamp_(low, high)
    return moved


def _move_chunk_towards(center: Tensor, u: Tensor, t: float, out: Tensor) -> None:
    """Write center + t (u - center), rounded towards the center, to `out`; each (k,)."""
    torch.lerp(center, u, t, out=out)
    distance = (out - center).abs()
    max_distance = ((u - center) * t).abs()
    is_too_far = distance > max_distance
    rounded_inwards = torch.nextafter(out, center)
    torch.where(is_too_far, rounded_inwards, out, out=out)


@dataclass(frozen=True, eq=False)
class Distribution:
    """A normal distribution with independent elements, projected onto the domain.

    Attributes:
        mean: (d,) float32, inside the domain.
        deviation: (d,) float32, standard deviation of each element, at least 0.
    """

    mean: Tensor
    deviation: Tensor

    def sample(self, generator: torch.Generator, n: int, domain: Domain) -> Tensor:
        """Return (n, d) float32 configurations P(mean + deviation * z), z standard
        normal, P the projection.
        """
        noise = torch.randn(n, domain.dim, generator=generator)
        return torch.stack(
            [domain.project(self.mean + self.deviation * z) for z in noise]
        )


def compute_half_widths(domain: Domain) -> Tensor:
    """Return how far each element of u may change if its block changes as a whole.

    All elements of the block change by the same amount, which is:

    - "box": half the width of the bounds; if the block has a reach, at most reach /
      sqrt(size);
    - "linf": half the width of the intersection of bounds and ball;
    - "l2": epsilon / sqrt(size), at most half the width of the bounds.

    Returns:
        (d,) float32, over 0.
    """
    half_widths = (domain.upper_bounds - domain.lower_bounds) / 2.0
    for block, part in domain.list_block_slices():
        if block.norm == "l2" or block.unit_step_length is not None:
            # The norm of (x, x, ..., x) is x sqrt(size). The radius is the epsilon of a
            # ball, or the reach of a box.
            largest_change = block.radius / math.sqrt(block.size)
            half_widths[part] = min(largest_change, (block.high - block.low) / 2.0)
    # With an epsilon below the resolution of float32, the width is 0.
    return half_widths.clamp_(min=torch.finfo(torch.float32).tiny)


def find_periodic(domain: Domain) -> Tensor:
    """Return which elements are periodic, so that u wraps at the bounds, (d,) bool."""
    sizes = torch.tensor([block.size for block in domain.blocks], dtype=torch.long)
    return torch.tensor(
        [block.periodic for block in domain.blocks], dtype=torch.bool
    ).repeat_interleave(sizes)


# ---- points by index
# Points that can be reached in any order by their number: draws from the unit cube, and
# products of axes.
#
# Draw number n is the same point in whatever order draws are requested:
#
# - "sobol": scrambled Sobol points (Owen 1998; Joe and Kuo 2008). They are divided into
#   nets of 65,536 points, each scrambled with its own seed, so that a point is reached
#   by skipping few others.
# - "random": independent uniform points, in blocks with their own seeds.
#
# A product is never built. Its last axis runs fastest, as the digits of a number do:
#
#     index = (...(digit_0 * size_1 + digit_1) * size_2 + ...) * size_k + digit_k

Sampler = Literal["sobol", "random"]
SAMPLERS: tuple[str, ...] = get_args(Sampler)

POINTS_PER_NET = 1 << 16  # of a scrambled Sobol sequence; a power of two
# largest number of dimensions of a Sobol point: Joe and Kuo give directions for this
# many
MAX_DIMENSIONS = 21201
# Largest number of values in a block of points, unless a single point has more.
MAX_BLOCK_VALUES = 1 << 18
SEEDS_PER_BLOCK = 1024  # number of seeds that are generated at once

Float64Array = NDArray[np.float64]


class SampleSequence:
    """Points of [0, 1)^dimensions by number.

    Points are sampled in blocks. Each block lies in a single Sobol net, because both
    sizes are powers of two. The latest block is cached, and so is SciPy's generator of
    its net, which is called the engine there.

    Attributes:
        dimensions: number of values of a point.
        _rows: number of points of a block, a power of two, at most `POINTS_PER_NET`.
        _block: (rows, dimensions) the latest block.
        _block_index: its index; -1 before the first.
        _engine: generator of the points of the Sobol net with the index `_net`.
        _n_sampled: number of points of the net that it has generated or skipped so far.
    """

    def __init__(
        self, dimensions: int, sampler: str, seed: int, name: str = "draws"
    ) -> None:
        """Prepare a sequence of points, of which none is computed yet.

        Args:
            dimensions: number of values of a point; may be 0.
            sampler: one of `SAMPLERS`.
            seed: seed of the points.
            name: name of the stream of random numbers; other names have other points.

        Raises:
            InputError: an unknown sampler, or too many dimensions for it.
        """
        _check_sampler(sampler, dimensions)
        self.dimensions = dimensions
        self._sampler = sampler
        self._seed = seed
        self._name = name
        self._rows = _count_rows_of_block(dimensions)
        self._block_index = -1  # none is loaded yet
        self._block = np.empty((0, dimensions))
        self._engine: Any = None
        self._net = -1  # there is no engine of a net yet
        self._n_sampled = 0

    def points(self, first: int, count: int) -> Float64Array:
        """Return the points with the numbers from `first` on.

        Args:
            first: number of the first point, at least 0.
            count: number of points.

        Returns:
            (count, dimensions) float64 in [0, 1).
        """
        if not self.dimensions or count < 1:
            return np.empty((max(0, count), self.dimensions))
        chunks = []
        end = first + count
        while first < end:  # from one block at a time
            block_index, first_row = divmod(first, self._rows)
            n_rows = min(self._rows - first_row, end - first)
            self._load_block(block_index)
            chunks.append(self._block[first_row : first_row + n_rows])
            first += n_rows
        return chunks[0] if len(chunks) == 1 else np.concatenate(chunks)

    def _load_block(self, block_index: int) -> None:
        """Sample a block of points, unless it is the latest."""
        if block_index == self._block_index:
            return
        if self._sampler == "sobol":
            self._block = self._sample_sobol(block_index)
        else:
            seed = derive_seed(self._seed, self._name, block_index)
            rng = np.random.default_rng(seed)
            self._block = rng.random((self._rows, self.dimensions))
        self._block_index = block_index

    def _sample_sobol(self, block_index: int) -> Float64Array:
        """Return a block of points of a scrambled Sobol net, (rows, dimensions).

        Points of the net before the block are skipped.
        """
        # A block never crosses the end of a net.
        first_point = block_index * self._rows
        net_index, first_row = divmod(first_point, POINTS_PER_NET)
        self._load_engine(net_index, first_row)
        if first_row > self._n_sampled:
            self._engine.fast_forward(first_row - self._n_sampled)
        self._n_sampled = first_row + self._rows
        return np.asarray(self._engine.random(self._rows))

    def _load_engine(self, net_index: int, first_row: int) -> None:
        """Get an engine of a Sobol net that has not gone past a row of the net.

        SciPy's engine generates the points of a net in order. It continues if it has
        not reached this row yet; otherwise a new one begins.
        """
        # imported here, as it takes a quarter of a second and few runs need it
        from scipy.stats import qmc

        is_behind = first_row < self._n_sampled  # the engine only goes forward
        if net_index != self._net or self._engine is None or is_behind:
            seed = derive_seed(self._seed, self._name, net_index)
            self._engine = qmc.Sobol(self.dimensions, scramble=True, seed=seed)
            self._net = net_index
            self._n_sampled = 0


def _check_sampler(sampler: str, dimensions: int) -> None:
    """Raise InputError if a sampler is unknown, or cannot draw so many numbers."""
    if sampler not in SAMPLERS:
        raise InputError(
            f"sampler: expected one of {', '.join(SAMPLERS)}, got {sampler!r}"
        )
    if sampler == "sobol" and dimensions > MAX_DIMENSIONS:
        raise InputError(
            f"`sampler` sobol: expected at most {MAX_DIMENSIONS} numbers to draw, "
            f"got {dimensions}; use `sampler=random`"
        )


def _count_rows_of_block(dimensions: int) -> int:
    """Return the number of points of a block, one for each row.

    A block has at most `MAX_BLOCK_VALUES` values, and no more points than a net.
    """
    max_rows_of_values = MAX_BLOCK_VALUES // max(1, dimensions)
    max_rows = max(1, min(POINTS_PER_NET, max_rows_of_values))
    # rounded down to a power of two, so that a net is divided into full blocks
    return 1 << (max_rows.bit_length() - 1)


class SeedSequence:
    """The seeds of a stream, by number.

    Seeds are generated in blocks of `SEEDS_PER_BLOCK`, which is much faster than to
    call `advsearch.seeds.derive_seed` for each of them. The latest block is cached.
    """

    def __init__(self, root: int, name: str) -> None:
        self._root = root
        self._name = name
        self._block_index = -1
        self._block: NDArray[Any] = np.empty(0, dtype=np.uint32)

    def __call__(self, index: int) -> int:
        """Return seed number `index`, in [0, 2**32)."""
        block_index, position = divmod(index, SEEDS_PER_BLOCK)
        if block_index != self._block_index:
            sequence = np.random.SeedSequence(
                derive_seed(self._root, self._name, block_index)
            )
            self._block_index = block_index
            self._block = sequence.generate_state(SEEDS_PER_BLOCK, dtype=np.uint32)
        return int(self._block[position])


@dataclass(frozen=True)
class ProductIndex:
    """The product of axes: numbers its points from 0, the last axis running fastest.

    Attributes:
        sizes: number of values of each axis, at least 1. Without an axis there is one
            point.
        count: number of points.
    """

    sizes: tuple[int, ...]
    count: int = field(init=False)

    def __post_init__(self) -> None:
        if any(size < 1 for size in self.sizes):
            raise InputError(
                f"axes: expected at least one value on each, got sizes {self.sizes}"
            )
        object.__setattr__(self, "count", math.prod(self.sizes))

    def digits(self, index: int) -> tuple[int, ...]:
        """Return the index of a point on every axis."""
        if not 0 <= index < self.count:
            raise IndexError(
                f"expected a point from 0 to {self.count - 1}, got {index}"
            )
        digits = []
        for size in reversed(self.sizes):
            index, digit = divmod(index, size)
            digits.append(digit)
        return tuple(reversed(digits))

    def index(self, digits: Sequence[int]) -> int:
        """Return the number of the point with these indices on the axes."""
        number = 0
        for size, digit in zip(self.sizes, digits, strict=True):
            number = number * size + digit
        return number


def split_into_batches(first: int, count: int, size: int) -> Iterator[range]:
    """Yield the numbers from `first` up to `count`, exclusive, in batches.

    Batches begin at multiples of `size`, so that a resumed run has the same batches as
    one that began at 0. The first batch and the last may be shorter.
    """
    while first < count:
        last = min(count, (first // size + 1) * size)
        yield range(first, last)
        first = last
