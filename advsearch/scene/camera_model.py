"""Camera models: projection of points to the image, and rays of image coordinates.

    Brown-Conrady:   (x, y) = (X, Y) / Z,  r^2 = x^2 + y^2
                     x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6)
                            / (1 + k4 r^2 + k5 r^4 + k6 r^6)
                          + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4
                     y' likewise
    fisheye:         (x', y') = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6
                                       + k4 theta^8) (X, Y) / |(X, Y)|
    both:            column = fx x' + skew y' + cx,    row = fy y' + cy
    equirectangular: longitude over the width, latitude over the height

These are the models of OpenCV's `projectPoints` and `fisheye::projectPoints`, after
Brown 1971 (Close-range camera calibration) and Kannala and Brandt 2006 (A generic
camera model and calibration method for conventional, wide-angle, and fish-eye lenses,
equation 6). theta is the angle to the axis.

Points are in the camera's coordinates: x to the right, y down, z ahead. Image
coordinates are fractions of the image's width and height, measured from the top left
corner. Focal lengths are such fractions, too, so that a model does not depend on the
number of pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.polynomial import Polynomial
from torch import Tensor

from advsearch.errors import InputError

BROWN_CONRADY = "brown-conrady"
FISHEYE = "fisheye"
EQUIRECTANGULAR = "equirectangular"
LINEAR_PARAMETERS = ("fx", "fy", "cx", "cy", "skew")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4")
NUMBER_NAMES = (
    *LINEAR_PARAMETERS,
    *COEFFICIENTS,
)  # names of the numbers of a model, in order
COEFFICIENTS_OF_KIND: Mapping[str, tuple[str, ...]] = {
    BROWN_CONRADY: COEFFICIENTS,
    FISHEYE: COEFFICIENTS[:4],
    EQUIRECTANGULAR: (),
}
"""The coefficients that each kind of model has."""
# Limit of the steps of an inversion of radii; nearly all converge in five.
MAX_STEPS = 60
# Limit of the steps of an inversion in two dimensions, where bisection is not possible
# when Newton's method fails.
MAX_STEPS_2D = 20
TOLERANCE = 1e-10  # distance, in focal lengths, under which an inversion has converged
# Tangent of the largest half angle of view into which an object is framed.
MAX_TANGENT = math.tan(math.radians(80.0))
MAX_RAY_TANGENT = 1e6  # limit of the tangents of rays
BORDER_POINTS = 512  # points on a line from the axis to a border of the image
VectorFunction = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class CameraModel:
    """Intrinsics and distortion of a camera."""

    kind: str  # `BROWN_CONRADY`, `FISHEYE` or `EQUIRECTANGULAR`
    # (17,) in the order of `NUMBER_NAMES`: fx, cx and skew in image widths, fy and cy
    # in image heights, the coefficients.
    intrinsics: tuple[float, ...]
    # The file or the bundled model that the user named; "" if the camera is a pinhole
    # whose focal length `camera.fov` sets.
    name: str = ""
    # (height, width) in pixels for which it was calibrated; None for any size.
    calibrated_shape: tuple[int, int] | None = None
    max_angle_degrees: float = (
        180.0  # largest visible angle to the optical axis, degrees
    )
    reading_notes: tuple[str, ...] = ()  # sentences about entries that were not read

    @property
    def intrinsic_by_name(self) -> dict[str, float]:
        """The numbers by name: `LINEAR_PARAMETERS` and `COEFFICIENTS`."""
        return dict(zip(NUMBER_NAMES, self.intrinsics, strict=True))

    def with_intrinsics(self, numbers: Tensor) -> CameraModel:
        """Return the model with other numbers (17,), in the order of `NUMBER_NAMES`."""
        return replace(self, intrinsics=tuple(numbers.double().tolist()))

    def check_no_fov(self, setting_names: Iterable[str]) -> None:
        """Raise InputError if settings of a scene contain a field of view.

        The camera has its own focal lengths.
        """
        if "camera.fov" in setting_names:
            raise InputError(
                f"`camera={self.name}` and `set` camera.fov contradict each other: the "
                "camera has focal lengths of its own; leave one of the two out"
            )

    # ---- Projection and rays ----

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project points (N, 3), to the right, down and ahead, to the image.

        Returns:
            Coordinates (N, 2) float64 in image widths and heights, (0, 0) at the top
            left; they may be outside of the image. And (N,) bool, which points are
            visible: those behind a lens, or beyond the angle at which it folds, are
            not.
        """
        x, y, z = points.double().unbind(dim=-1)
        if self.kind == EQUIRECTANGULAR:
            return _project_to_panorama(x, y, z), ~torch.isnan(x)
        if self.kind == FISHEYE:
            distorted, is_visible = self._project_fisheye(x, y, z)
        else:
            distorted, is_visible = self._project_perspective(x, y, z)
        (fx, fy, cx, cy, skew) = self.intrinsics[: len(LINEAR_PARAMETERS)]
        (x, y) = distorted.unbind(dim=-1)
        column = fx * x + skew * y + cx
        row = fy * y + cy
        return torch.stack([column, row], dim=-1), is_visible

    def _project_fisheye(
        self, x: Tensor, y: Tensor, z: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return distorted points (N, 2) in focal lengths, and which are visible."""
        distance = torch.hypot(x, y)
        angle = torch.atan2(distance, z)
        # 1e-300: on the axis the distance is 0, and so are x and y whatever the scale
        scale = self._distort_radius(angle) / distance.clamp_min(1e-300)
        distorted = torch.stack([x * scale, y * scale], dim=-1)
        return distorted, angle <= self._max_visible

    def _project_perspective(
        self, x: Tensor, y: Tensor, z: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return distorted points (N, 2) in focal lengths, and which are visible."""
        # A point behind the lens is not visible; a depth of 1 keeps it finite.
        depth = torch.where(z > 0.0, z, torch.ones_like(z))
        undistorted = torch.stack([x / depth, y / depth], dim=-1)
        radius = undistorted.norm(dim=-1)
        is_visible = (z > 0.0) & (radius <= self._max_visible)
        return self._distort(undistorted), is_visible

    def compute_rays(self, image_points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rays of image coordinates (N, 2).

        The distortion is inverted by iteration. If that does not converge to a
        direction within the angle at which the lens folds, the coordinates are outside
        of the view.

        Returns:
            Directions (N, 3) float64, unit vectors for a fisheye and a panorama, else
            with z = 1; and a margin (N,) float64, positive inside the view, which
            changes its sign along the edge of it.
        """
        u, v = image_points.double().unbind(dim=-1)
        if self.kind == EQUIRECTANGULAR:
            return _compute_panorama_directions(u, v), torch.ones_like(u)
        distorted = self._to_distorted(u, v)
        if self.kind == FISHEYE:
            return self._compute_fisheye_rays(distorted)
        return self._compute_perspective_rays(distorted)

    def _compute_fisheye_rays(self, distorted: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rays of a fisheye for distorted points.

        Args:
            distorted: (N, 2) points in focal lengths from the optical axis.

        Returns:
            Unit directions (N, 3), and a margin (N,) that is positive inside the view.
        """
        radius = distorted.norm(dim=-1)
        # 0 for the center, which has no direction
        radial_direction = distorted / radius.clamp_min(1e-300)[..., None]
        # Angles are solved up to the fold, not only up to the edge of the view. So
        # points just outside the view have a direction, too, and a margin a little
        # below 0.
        max_solved_angle = min(self.fold_angle_radians, math.pi)
        angle, converged = self._invert_radial(radius, max_solved_angle)
        directions = torch.cat(
            [radial_direction * angle.sin()[..., None], angle.cos()[..., None]], dim=-1
        )
        max_radius = self._compute_edge_radius()
        return directions, _clip_margin(max_radius - radius, converged)

    def _compute_perspective_rays(self, distorted: Tensor) -> tuple[Tensor, Tensor]:
        """Return directions with z = 1 and margins of distorted points.

        First the radial distortion is inverted. If the lens also has decentering, that
        solution is the start of an inversion in two dimensions.

        Args:
            distorted: (N, 2) points in focal lengths from the optical axis.

        Returns:
            Directions (N, 3), and a margin (N,) that is positive inside the view.
        """
        radius = distorted.norm(dim=-1)
        # 0 for the center, which has no direction
        radial_direction = distorted / radius.clamp_min(1e-300)[..., None]
        max_visible = min(self._max_visible, MAX_RAY_TANGENT)
        undistorted_radius, converged = self._invert_radial(radius, max_visible)
        undistorted = radial_direction * undistorted_radius[..., None]
        # p1 and the numbers after it do not depend on the radius alone
        has_decentering = any(self.intrinsics[NUMBER_NAMES.index("p1") :])
        if has_decentering:
            undistorted, converged = self._invert_distortion(
                undistorted, distorted, max_visible
            )
            # `_compute_edge_radius` is without decentering, and so must be the radius
            # that is compared with it.
            radius = (distorted - self._compute_decentering(undistorted)).norm(dim=-1)
        directions = torch.cat(
            [undistorted, torch.ones_like(undistorted[..., :1])], dim=-1
        )
        max_radius = self._compute_edge_radius()
        return directions, _clip_margin(max_radius - radius, converged)

    def _compute_edge_radius(self) -> float:
        """Return the distorted radius, in focal lengths, of the edge of the view."""
        max_visible = min(self._max_visible, MAX_RAY_TANGENT)
        return float(
            self._distort_radius(torch.tensor([max_visible], dtype=torch.float64))
        )

    def _to_distorted(self, u: Tensor, v: Tensor) -> Tensor:
        """Return distorted points (N, 2) at image coordinates (N,): invert
        `LINEAR_PARAMETERS`.
        """
        fx, fy, cx, cy, skew = self.intrinsics[: len(LINEAR_PARAMETERS)]
        y = (v - cy) / fy
        return torch.stack([(u - cx - skew * y) / fx, y], dim=-1)

    def make_ray_table(self, image_points: Tensor) -> Tensor:
        """Return rays of image coordinates (N, 2) in the axes of Mitsuba's cameras.

        The result is (N, 4) float32: directions to the left, up and ahead, and the
        margin of `compute_rays`, positive inside the view.
        """
        directions, margin = self.compute_rays(image_points)
        return torch.cat(
            [directions * torch.tensor([-1.0, -1.0, 1.0]), margin[:, None]], dim=-1
        ).float()

    def _invert_radial(self, target: Tensor, max_value: float) -> tuple[Tensor, Tensor]:
        """Find the radii in [0, max_value] that `_distort_radius` maps to a target.

        The distortion has to grow within these bounds. The method is Newton's, guarded
        by bisection. Two bounds enclose each solution, and every step narrows them. A
        step that would leave the bounds goes to their middle instead.

        Args:
            target: (N,) distorted radii.
            max_value: upper bound of the solutions.

        Returns:
            The solutions (N,), and which of them have converged.
        """

        lower = torch.zeros_like(target)
        upper = torch.full_like(target, self._find_upper_bound(target, max_value))
        radius = torch.minimum(target, upper)
        for _ in range(MAX_STEPS):
            # one derivative (N,), since the values have one column
            values, (slope,) = _evaluate_with_jacobian(self._distort_to_column, radius)
            residual = values[..., 0] - target
            is_solved = (residual.abs() <= TOLERANCE) | (upper - lower <= TOLERANCE)
            if bool(is_solved.all()):
                break
            upper = torch.where(residual > 0.0, radius, upper)
            lower = torch.where(residual > 0.0, lower, radius)
            newton_radius = radius - residual / slope
            is_within = (newton_radius > lower) & (newton_radius < upper)
            radius = torch.where(is_within, newton_radius, (lower + upper) / 2.0)
        residual = (self._distort_radius(radius) - target).abs()
        # A solution may also have been accepted because its bounds were close to each
        # other. Its residual may be larger, hence the factor of 1e3. The tolerance is
        # absolute for small targets and relative for large ones.
        return radius, residual <= 1e3 * TOLERANCE * (1.0 + target)

    def _distort_to_column(self, radii: Tensor) -> Tensor:
        """Return distorted radii as (N, 1), for `_evaluate_with_jacobian`."""
        return self._distort_radius(radii)[..., None]

    def _find_upper_bound(self, target: Tensor, max_value: float) -> float:
        """Return a common upper bound of the solutions of `_invert_radial`.

        It is doubled, starting from 1, until it suffices or is `max_value`. `max_value`
        alone would be a bound, too, but may be far away and need more bisections.
        """
        bound = min(1.0, max_value)
        while bound < max_value:
            # the largest target that has a solution up to the bound
            reached_target = self._distort_radius(
                torch.tensor(bound, dtype=torch.float64)
            )
            # False if either is NaN, so that the loop ends.
            must_grow = float(reached_target) < float(target.max())
            if not must_grow:
                break
            bound = min(2.0 * bound, max_value)
        return bound

    def _invert_distortion(
        self, undistorted: Tensor, distorted: Tensor, max_radius: float
    ) -> tuple[Tensor, Tensor]:
        """Find the points that `_distort` maps to `distorted`, by Newton's method.

        A step that leaves the circle of `max_radius` is cut at the circle, and one that
        is not finite is not taken.

        Args:
            undistorted: (N, 2) points at which the iteration starts.
            distorted: (N, 2) distorted points.
            max_radius: largest radius of a solution; finite.

        Returns:
            The solutions (N, 2); and which of them have converged, (N,). Solutions
            beyond the fold of the lens, or outside of the circle, do not count.
        """
        converged = torch.zeros_like(undistorted[..., 0], dtype=torch.bool)
        for _ in range(MAX_STEPS_2D):
            values, jacobian_rows = _evaluate_with_jacobian(self._distort, undistorted)
            residual = values - distorted
            step, determinant = _solve_two_by_two(jacobian_rows, residual)
            # The lens folds where the determinant of the distortion's derivative is 0.
            # Beyond the fold, two points have the same image. Such solutions are
            # rejected.
            is_inside = (determinant > 0.0) & (undistorted.norm(dim=-1) < max_radius)
            converged = is_inside & (
                residual.norm(dim=-1) <= TOLERANCE * (1.0 + distorted.norm(dim=-1))
            )
            if bool(converged.all()):
                break
            updated = _step_within(undistorted, step, max_radius)
            undistorted = torch.where(converged[..., None], undistorted, updated)
        return undistorted, converged

    # ---- Distortion ----

    @cached_property
    def _polynomials(self) -> tuple[Polynomial, Polynomial]:
        """Numerator and denominator of radial(r) / r, as polynomials in r^2."""
        k = self.intrinsics[len(LINEAR_PARAMETERS) :]
        if self.kind == FISHEYE:
            return Polynomial([1.0, *k[:4]]), Polynomial([1.0])
        return Polynomial([1.0, *k[:3]]).trim(), Polynomial([1.0, *k[3:6]]).trim()

    @cached_property
    def fold_angle_radians(self) -> float:
        """Angle to the axis, radians, at which the radial distortion turns back.

        Beyond it the image point moves back towards the center, so that two directions
        have the same image point. It is infinite if that never happens.
        """
        # The lens folds at the smallest positive root of the derivative, or at a pole of
        # the distortion, a root of its denominator.
        numerator, denominator = self._polynomials
        slope_numerator = _differentiate_radial(numerator, denominator)
        roots = np.concatenate([slope_numerator.roots(), denominator.roots()])
        is_real = np.abs(roots.imag) <= 1e-9 * np.abs(roots)
        positive_roots = roots.real[is_real & (roots.real > 0.0)]
        if not positive_roots.size:
            return math.inf
        radius = math.sqrt(float(positive_roots.min()))
        # r is the angle of a fisheye, and the tangent of the angle of another lens.
        return radius if self.kind == FISHEYE else math.atan(radius)

    @cached_property
    def _max_visible(self) -> float:
        """The largest visible angle of a fisheye, or tangent of another lens."""
        if self.kind == FISHEYE:
            return min(
                self.fold_angle_radians, math.radians(self.max_angle_degrees), math.pi
            )
        if self.fold_angle_radians < math.pi / 2.0:
            # just before the fold, where the slope is not zero yet
            return math.tan(self.fold_angle_radians) * (1.0 - 1e-9)
        return math.inf

    def _compute_radial_scale(self, square: Tensor) -> Tensor:
        """Return radial(r) / r at r^2, of any shape."""
        numerator, denominator = self._polynomials
        value = _evaluate_polynomial(numerator, square)
        if len(denominator) == 1:
            return value
        return value / _evaluate_polynomial(denominator, square)

    def _distort_radius(self, radius: Tensor) -> Tensor:
        """Return the radial distortion of radii, or of angles of a fisheye."""
        return radius * self._compute_radial_scale(radius * radius)

    def _distort(self, undistorted: Tensor) -> Tensor:
        """Distort points (N, 2), which are in focal lengths from the optical axis."""
        scale = self._compute_radial_scale(undistorted.square().sum(dim=-1))
        return undistorted * scale[..., None] + self._compute_decentering(undistorted)

    def _compute_decentering(self, undistorted: Tensor) -> Tensor:
        """Return the shifts (N, 2) of undistorted points that are not radial.

        They are the tangential distortion (p1 and p2: the lens stands off the axis) and
        that of a thin prism (s1 to s4), in focal lengths. The formulas are at the top
        of this module.
        """
        # the last six of `NUMBER_NAMES`
        p1, p2, s1, s2, s3, s4 = self.intrinsics[NUMBER_NAMES.index("p1") :]
        x, y = undistorted.unbind(dim=-1)
        square = x * x + y * y
        x_shift = (
            2.0 * p1 * x * y + p2 * (square + 2.0 * x * x) + square * (s1 + s2 * square)
        )
        y_shift = (
            p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y + square * (s3 + s4 * square)
        )
        return torch.stack([x_shift, y_shift], dim=-1)

    # ---- Derived properties ----

    @cached_property
    def inner_half_tangents(self) -> tuple[float, float]:
        """Half width and half height, as tangents, of a rectangle inside the image.

        The rectangle is centered on the optical axis. It reaches the image's edges, and
        is then shrunk in steps of 2 % until all of its border is in the image: a lens
        bends the border, so that the corners may be outside. If no step suffices, 2 %
        of the size remain.
        """
        edges = self._compute_edge_tangents()
        border = _make_rectangle_border(edges)
        for fraction in torch.linspace(1.0, 0.02, 50).tolist():  # 1, 0.98, ..., 0.02
            points = torch.cat(
                [fraction * border, torch.ones_like(border[:, :1])], dim=-1
            )
            if self._is_all_visible(points):
                break
        # If no step has all of the border in the image, this is the last fraction.
        return fraction * edges[0], fraction * edges[1]

    def _is_all_visible(self, points: Tensor) -> bool:
        """Return whether all points (N, 3) are in the image."""
        coordinates, is_visible = self.project(points)
        # a point on the image's border may be outside by rounding
        is_in_image = (coordinates >= -1e-6) & (coordinates <= 1.0 + 1e-6)
        return bool((is_visible & is_in_image.all(dim=-1)).all())

    def _compute_edge_tangents(self) -> list[float]:
        """Return the tangents at which the image ends along x and along y.

        A tangent is that of the angle to the axis. It is measured to the nearer one of
        both edges, and is at most `MAX_TANGENT`.
        """
        center, _ = self.project(torch.tensor([[0.0, 0.0, 1.0]]))
        edge_tangents = []
        for axis in (0, 1):
            border_tangents = [
                self._compute_border_tangent(center, axis, border)
                for border in (0.0, 1.0)
            ]
            # at least 1e-3, also where the axis is outside of the image
            edge_tangents.append(max(1e-3, min(MAX_TANGENT, *border_tangents)))
        return edge_tangents

    def _compute_border_tangent(
        self, center: Tensor, axis: int, border: float
    ) -> float:
        """Return the largest tangent of the rays between the axis and an image border.

        The rays are those of points on a line parallel to an axis of the image.

        Args:
            center: (1, 2) image coordinates of the axis.
            axis: 0 for a line along x, 1 along y.
            border: image coordinate of the border, 0 or 1.
        """
        line_points = center.repeat(BORDER_POINTS, 1)
        line_points[:, axis] = torch.linspace(
            float(center[0, axis]), border, BORDER_POINTS, dtype=torch.float64
        )
        directions, margin = self.compute_rays(line_points)
        # A z of 0.1 is at about 84 degrees from the axis: rays farther out do not
        # count, since their tangents would be huge.
        min_z = 0.1
        is_visible = (margin > 0.0) & (directions[:, 2] > min_z)
        tangents = directions[:, axis].abs() / directions[:, 2].clamp_min(min_z)
        return float(
            torch.where(is_visible, tangents, torch.zeros_like(tangents)).max()
        )

    @cached_property
    def black_fraction(self) -> float:
        """Fraction of the image in which nothing is visible."""
        centers = (torch.arange(64, dtype=torch.float64) + 0.5) / 64
        grid = torch.stack(torch.meshgrid(centers, centers, indexing="xy"), dim=-1)
        _, margin = self.compute_rays(grid.reshape(-1, 2))
        return float((margin <= 0.0).double().mean())

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user, as sentences.

        They report entries of the file that were not read, and the fraction of the
        image that the lens leaves black.
        """
        if self.black_fraction == 0.0:
            return self.reading_notes
        return (*self.reading_notes, self._describe_black_part())

    def _describe_black_part(self) -> str:
        """Return a sentence about the part of the image that the lens leaves black."""
        name = self.name or "the lens"
        black_part = f"{100.0 * self.black_fraction:.2g} % of the picture"
        if self.fold_angle_radians < math.radians(self.max_angle_degrees):
            return (
                f"{name}: the lens folds at {math.degrees(self.fold_angle_radians):.1f} "
                f"degrees from its axis, and {black_part}, which only directions "
                "beyond that would fill, is black."
            )
        return f"{name}: {black_part} lies outside the lens's circle and is black."

    def describe_scaling(self, resolution: tuple[int, int]) -> tuple[str, ...]:
        """Return a note if an image has another size than the camera's pictures.

        If their shapes differ by more than half a percent, the note has the stretch
        too.

        Args:
            resolution: height and width of the image in pixels.
        """
        if self.calibrated_shape is None or self.calibrated_shape == resolution:
            return ()
        (model_height, model_width) = self.calibrated_shape
        (height, width) = resolution
        # scale along y over scale along x
        stretch = model_width * height / (model_height * width)
        stretch_text = ""
        if abs(stretch - 1.0) > 0.005:
            stretch_text = (
                f", which makes things {stretch:.3g} times as high for their width"
            )
        return (
            f"{self.name} is for {model_width} x {model_height} pixels (width x "
            f"height): its focal lengths and its principal point are scaled to {width} "
            f"x {height}{stretch_text}.",
        )


def _differentiate_radial(numerator: Polynomial, denominator: Polynomial) -> Polynomial:
    """Return the numerator of the derivative of a radial distortion.

    The distortion is radial(r) = r n(s) / d(s) with s = r^2. The numerator of its
    derivative by r, as a polynomial in s, is (n + 2 s n') d - 2 s n d'.

    Args:
        numerator: n.
        denominator: d.
    """
    doubled_s = Polynomial([0.0, 2.0])  # 2 s
    slope: Polynomial = (
        numerator + doubled_s * numerator.deriv()
    ) * denominator - doubled_s * (numerator * denominator.deriv())
    return slope


def _step_within(points: Tensor, step: Tensor, max_radius: float) -> Tensor:
    """Return points (N, 2) minus steps, cut at a circle around 0.

    A step that is not finite is not taken.
    """
    updated = points - step
    radius = updated.norm(dim=-1, keepdim=True)
    # 1 inside the circle, and less outside, so that points move onto the circle
    shrinking = max_radius / radius.clamp_min(max_radius)
    return torch.where(torch.isfinite(radius), updated * shrinking, points)


def _make_rectangle_border(half_sides: list[float]) -> Tensor:
    """Return points (N, 2) on the border of a rectangle around 0, 17 on each side."""
    grid = torch.linspace(-1.0, 1.0, 17, dtype=torch.float64)
    ones = torch.ones_like(grid)
    x = torch.cat([grid, grid, ones, -ones])
    y = torch.cat([ones, -ones, grid, grid])
    border = torch.stack([x, y], dim=-1)
    return border * torch.tensor(half_sides, dtype=torch.float64)


def make_pinhole(fov: float, aspect: float) -> CameraModel:
    """Return the model of a camera without distortion.

    Args:
        fov: field of view of the larger side, degrees.
        aspect: width divided by height.
    """
    # As a fraction of the larger side. Half of that side is at half the angle from the
    # axis.
    focal = 0.5 / math.tan(math.radians(fov) / 2.0)
    # as fractions of width and height, of which the smaller one has the larger fraction
    fx = focal * max(1.0, 1.0 / aspect)
    fy = focal * max(1.0, aspect)
    cx = cy = 0.5
    skew = 0.0
    no_distortion = [0.0] * len(COEFFICIENTS)
    return CameraModel(BROWN_CONRADY, (fx, fy, cx, cy, skew, *no_distortion))


def make_bundled_models(aspect: float = 1.0) -> Mapping[str, CameraModel]:
    """Return the models that need no file, by name, for an aspect ratio (w / h).

    The fisheye has a circle of 180 degrees that fills the smaller side; the panorama
    has all directions.
    """
    # As a fraction of the smaller side. A fisheye has the radius focal * angle, so that
    # an angle of pi / 2 reaches half of that side.
    focal = 1.0 / math.pi
    # as fractions of width and height, of which the larger one has the smaller fraction
    focal_x = focal * min(1.0, 1.0 / aspect)
    focal_y = focal * min(1.0, aspect)
    no_distortion = [0.0] * len(COEFFICIENTS)
    # In the order of `NUMBER_NAMES`: fx, fy, cx, cy, skew and the coefficients. The
    # projection of a panorama does not depend on its numbers.
    fisheye_numbers = (focal_x, focal_y, 0.5, 0.5, 0.0, *no_distortion)
    panorama_numbers = (1.0, 1.0, 0.5, 0.5, 0.0, *no_distortion)
    fisheye = CameraModel(
        kind=FISHEYE, intrinsics=fisheye_numbers, name=FISHEYE, max_angle_degrees=90.0
    )
    panorama = CameraModel(
        kind=EQUIRECTANGULAR, intrinsics=panorama_numbers, name=EQUIRECTANGULAR
    )
    return {FISHEYE: fisheye, EQUIRECTANGULAR: panorama}


def _solve_two_by_two(rows: Sequence[Tensor], right: Tensor) -> tuple[Tensor, Tensor]:
    """Solve N linear systems of two equations by Cramer's rule.

    Args:
        rows: the first and the second row of the matrices, each (N, 2).
        right: (N, 2) right-hand sides.

    Returns:
        The solutions (N, 2), large where a matrix is nearly singular; and the
        determinants (N,).
    """
    (a, b), (c, d) = (row.unbind(dim=-1) for row in rows)
    determinant = a * d - b * c
    safe_determinant = torch.where(
        determinant.abs() > 1e-12,
        determinant,
        torch.full_like(determinant, 1e-12),
    )
    x, y = right.unbind(dim=-1)
    numerator = torch.stack([d * x - b * y, a * y - c * x], dim=-1)
    return numerator / safe_determinant[..., None], determinant


def _project_to_panorama(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Return image coordinates (N, 2) of points in an equirectangular image.

    Coordinates (N,) are to the right, down and ahead; the middle of the image is ahead.
    """
    longitude = torch.atan2(x, z)
    latitude = torch.atan2(y, torch.hypot(x, z))
    column = 0.5 + longitude / (2.0 * torch.pi)
    row = 0.5 + latitude / torch.pi
    return torch.stack([column, row], dim=-1)


def _compute_panorama_directions(u: Tensor, v: Tensor) -> Tensor:
    """Return unit vectors (N, 3) at image coordinates of an equirectangular image.

    Coordinates (N,) are fractions of its width and height; the middle is straight
    ahead. Vectors are to the right, down and ahead.
    """
    longitude = (u - 0.5) * (2.0 * torch.pi)
    latitude = (v - 0.5) * torch.pi
    level = latitude.cos()
    return torch.stack(
        [level * longitude.sin(), latitude.sin(), level * longitude.cos()], -1
    )


def _evaluate_polynomial(polynomial: Polynomial, x: Tensor) -> Tensor:
    """Evaluate a polynomial by Horner's method."""
    value = torch.full_like(x, float(polynomial.coef[-1]))
    for coefficient in polynomial.coef[-2::-1]:
        value = value * x + float(coefficient)
    return value


def _evaluate_with_jacobian(
    function: VectorFunction, at: Tensor
) -> tuple[Tensor, list[Tensor]]:
    """Evaluate a function that maps each of N points separately, and differentiate it.

    No value depends on another point. So the gradient of the sum over all points
    contains the derivative of each.

    Args:
        function: function from points to values (N, k).
        at: the points, (N, ...).

    Returns:
        The values (N, k); and for each of the k columns its derivative by the points,
        of the shape of `at`.
    """
    with torch.enable_grad():
        points = at.detach().requires_grad_()
        values = function(points)
        slopes = [
            torch.autograd.grad(component.sum(), points, retain_graph=True)[0]
            for component in values.unbind(dim=-1)
        ]
    return values.detach(), slopes


def _clip_margin(margin: Tensor, converged: Tensor) -> Tensor:
    """Return margins (N,) in [-1, 1], below zero for points without a ray.

    Args:
        margin: (N,) focal lengths from each point to the edge of the view, positive
            inside the view.
        converged: (N,) whether the inversion of the distortion has found a ray. If not,
            a positive margin is replaced by a tiny negative one. A negative margin
            stays as it is, so that margins pass continuously through zero at the edge.
    """
    is_valid = converged | (margin <= 0.0)
    just_outside = torch.full_like(margin, -1e-6)
    return torch.where(is_valid, margin, just_outside).clamp(-1.0, 1.0)
