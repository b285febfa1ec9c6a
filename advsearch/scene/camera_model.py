"""A camera's model: where in the picture a point is seen, and along which ray a place
in the picture looks.

    Brown-Conrady:   (x, y) = (X, Y) / Z,  r^2 = x^2 + y^2
                     x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6
                     r^6)
                          + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4,                 y' likewise
    fisheye:         (x', y') = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) (X, Y) / |(X, Y)|
    both:            column = fx x' + skew y' + cx,    row = fy y' + cy
    equirectangular: longitude over the width, latitude over the height

These are the models of OpenCV's `projectPoints` and `fisheye::projectPoints`, after
Brown 1971 (Close-range camera calibration) and Kannala and Brandt 2006 (A generic
camera model and calibration method for conventional, wide-angle, and fish-eye lenses,
equation 6). theta is the angle to the axis.

Points are in the camera's coordinates: x to the right, y down, z ahead. Places in the
picture are shares of its width and height from the top left corner, and so are the
focal lengths: a picture of another size is the same one, scaled.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
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
LINEAR = ("fx", "fy", "cx", "cy", "skew")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4")
NUMBERS = (*LINEAR, *COEFFICIENTS)  # what the numbers of a model are, in their order
OF_KIND: Mapping[str, tuple[str, ...]] = {
    BROWN_CONRADY: COEFFICIENTS,
    FISHEYE: COEFFICIENTS[:4],
    EQUIRECTANGULAR: (),
}
"""The coefficients that each kind of model has."""
# steps after which an inversion has converged or never does; nearly all take five
STEPS = 60
TOLERANCE = 1e-10  # distance, in focal lengths, under which an inversion has converged
WIDEST = math.tan(math.radians(80.0))  # tangent of the widest half angle that is framed
FAR = 1e6  # tangents are not looked for beyond this one
Field = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class CameraModel:
    """Intrinsics and distortion of a camera."""

    kind: str  # `BROWN_CONRADY`, `FISHEYE` or `EQUIRECTANGULAR`
    # (17,) in the order of `NUMBERS`: fx, cx and skew in picture widths, fy and cy in
    # picture heights, the coefficients
    numbers: tuple[float, ...]
    # how it was asked for: a file, or a bundled one; empty where `camera.fov` says its
    # focal length
    name: str = ""
    # (height, width) in pixels that it was calibrated for; None for any
    size: tuple[int, int] | None = None
    reach: float = 180.0  # largest angle to the axis that it sees, degrees
    told: tuple[str, ...] = ()  # sentences about how its file was read

    @property
    def values(self) -> dict[str, float]:
        return dict(zip(NUMBERS, self.numbers, strict=True))

    def with_numbers(self, numbers: Tensor) -> CameraModel:
        return replace(self, numbers=tuple(numbers.double().tolist()))

    def check_given(self, given: Iterable[str]) -> None:
        """Refuse, by an InputError, a field of view among given settings: it has focal
        lengths of its own.
        """
        if "camera.fov" in given:
            raise InputError(
                f"`camera={self.name}` and `set` camera.fov contradict each other: the "
                "camera has focal lengths of its "
                "own; leave one of the two out"
            )

    # ---- both ways
    # --------------------------------------------------------------------------------------------------

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return where points (N, 3) are seen, (N, 2) in picture widths and heights,
        and which are, (N,) bool. One may be seen outside of the picture. What is behind
        a lens, or beyond the angle at which it folds, is not.
        """
        x, y, z = points.double().unbind(dim=-1)
        if self.kind == EQUIRECTANGULAR:
            longitude = torch.atan2(x, z)
            latitude = torch.atan2(y, torch.hypot(x, z))
            return torch.stack(
                [0.5 + longitude / (2.0 * torch.pi), 0.5 + latitude / torch.pi], dim=-1
            ), x == x
        if self.kind == FISHEYE:
            aside = torch.hypot(x, y)
            angle = torch.atan2(aside, z)
            scale = self._radial(angle) / aside.clamp_min(1e-300)
            seen = angle <= self._last
            bent = torch.stack([x * scale, y * scale], dim=-1)
        else:
            depth = torch.where(z > 0.0, z, torch.ones_like(z))
            flat = torch.stack([x / depth, y / depth], dim=-1)
            radius = flat.norm(dim=-1)
            seen = (z > 0.0) & (radius <= self._last)
            bent = self._bent(flat)
        (fx, fy, cx, cy, skew) = self.numbers[: len(LINEAR)]
        (x, y) = bent.unbind(dim=-1)
        return torch.stack([fx * x + skew * y + cx, fy * y + cy], dim=-1), seen

    def rays(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Return the directions (N, 3) float64 in which places (N, 2) in the picture
        look, of a fisheye and a panorama unit vectors, else with z = 1; and how far
        inside the view they are, (N,) float64, over 0 where something is seen: it
        changes its sign along the edge of that. Found by Newton's method, kept within
        bounds by halving, and checked: a place whose inversion has not converged to the
        branch that the axis lies on is outside.
        """
        u, v = places.double().unbind(dim=-1)
        if self.kind == EQUIRECTANGULAR:
            longitude = (u - 0.5) * (2.0 * torch.pi)
            latitude = (v - 0.5) * torch.pi
            level = latitude.cos()
            directions = torch.stack(
                [level * longitude.sin(), latitude.sin(), level * longitude.cos()], -1
            )
            return directions, torch.ones_like(u)
        fx, fy, cx, cy, skew = self.numbers[: len(LINEAR)]
        y = (v - cy) / fy
        bent = torch.stack([(u - cx - skew * y) / fx, y], dim=-1)
        radius = bent.norm(dim=-1)
        axis = bent / radius.clamp_min(1e-300)[..., None]
        high = min(self._last, FAR)
        most = float(self._radial(torch.tensor([high], dtype=torch.float64)))
        if self.kind == FISHEYE:
            # past its circle too, for its edge
            angle, converged = self._inverted(radius, min(self.fold, math.pi))
            directions = torch.cat(
                [axis * angle.sin()[..., None], angle.cos()[..., None]], dim=-1
            )
            return directions, _inside(most - radius, converged)
        start, converged = self._inverted(radius, high)
        flat = axis * start[..., None]
        if any(self.numbers[NUMBERS.index("p1") :]):
            flat, converged = self._newton(flat, bent, high)
            radius = (bent - self._decentred(flat)).norm(dim=-1)
        directions = torch.cat([flat, torch.ones_like(flat[..., :1])], dim=-1)
        return directions, _inside(most - radius, converged)

    def table(self, places: Tensor) -> Tensor:
        """Return what `rays` says of places (N, 2), for the axes of Mitsuba's cameras:
        (N, 4) float32, to the left, up and ahead, and over 0 where something is seen.
        """
        directions, inside = self.rays(places)
        return torch.cat(
            [directions * torch.tensor([-1.0, -1.0, 1.0]), inside[:, None]], dim=-1
        ).float()

    def _inverted(self, wanted: Tensor, high: float) -> tuple[Tensor, Tensor]:
        """Solve radial(found) = wanted within [0, high], where it grows; and which of
        them are solved.
        """
        bound = min(1.0, high)
        while bound < high and float(
            self._radial(torch.tensor(bound, dtype=torch.float64))
        ) < float(wanted.max()):
            bound = min(2.0 * bound, high)
        low = torch.zeros_like(wanted)
        most = torch.full_like(wanted, bound)
        radius = torch.minimum(wanted, most)
        for _ in range(STEPS):
            there, (slope,) = _with_slopes(
                lambda at: self._radial(at)[..., None], radius
            )
            error = there[..., 0] - wanted
            if bool(((error.abs() <= TOLERANCE) | (most - low <= TOLERANCE)).all()):
                break
            most = torch.where(error > 0.0, radius, most)
            low = torch.where(error > 0.0, low, radius)
            step = radius - error / slope
            radius = torch.where((step > low) & (step < most), step, (low + most) / 2.0)
        error = (self._radial(radius) - wanted).abs()
        return radius, error <= 1e3 * TOLERANCE * (1.0 + wanted)

    def _newton(self, flat: Tensor, bent: Tensor, high: float) -> tuple[Tensor, Tensor]:
        """Solve bent(found) = bent in two dimensions from (N, 2); and which are solved,
        before the lens folds.
        """
        converged = torch.zeros_like(flat[..., 0], dtype=torch.bool)
        for _ in range(STEPS // 3):
            there, rows = _with_slopes(self._bent, flat)
            error, ((a, b), (c, d)) = there - bent, (row.unbind(dim=-1) for row in rows)
            determinant = a * d - b * c
            inside = (determinant > 0.0) & (flat.norm(dim=-1) < high)
            converged = inside & (
                error.norm(dim=-1) <= TOLERANCE * (1.0 + bent.norm(dim=-1))
            )
            if bool(converged.all()):
                break
            safe = torch.where(
                determinant.abs() > 1e-12,
                determinant,
                torch.full_like(determinant, 1e-12),
            )
            x, y = error.unbind(dim=-1)
            moved = (
                flat
                - torch.stack([d * x - b * y, a * y - c * x], dim=-1) / safe[..., None]
            )
            radius = moved.norm(dim=-1, keepdim=True)
            moved = torch.where(
                torch.isfinite(radius), moved * (high / radius.clamp_min(high)), flat
            )
            flat = torch.where(converged[..., None], flat, moved)
        return flat, converged

    # ---- distortion
    # -------------------------------------------------------------------------------------------------

    @cached_property
    def _polynomials(self) -> tuple[Polynomial, Polynomial]:
        """Numerator and denominator of radial(r) / r in r^2."""
        k = self.numbers[len(LINEAR) :]
        if self.kind == FISHEYE:
            return Polynomial([1.0, *k[:4]]), Polynomial([1.0])
        return Polynomial([1.0, *k[:3]]).trim(), Polynomial([1.0, *k[3:6]]).trim()

    @cached_property
    def fold(self) -> float:
        """Angle to the axis, radians, at which the radial distortion turns back;
        infinite if it never does. Beyond it two directions are seen in one place, so
        that no picture tells them apart.
        """
        over, under = self._polynomials
        square = Polynomial([0.0, 2.0])
        slope = (over + square * over.deriv()) * under - square * (over * under.deriv())
        roots = np.concatenate([slope.roots(), under.roots()])
        turns = roots.real[
            (np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0.0)
        ]
        if not turns.size:
            return math.inf
        last = math.sqrt(float(turns.min()))
        return last if self.kind == FISHEYE else math.atan(last)

    @cached_property
    def _last(self) -> float:
        """The last angle that a fisheye sees, or the last tangent that another lens
        does.
        """
        if self.kind == FISHEYE:
            return min(self.fold, math.radians(self.reach), math.pi)
        return (
            math.tan(self.fold) * (1.0 - 1e-9)
            if self.fold < math.pi / 2.0
            else math.inf
        )

    def _scale(self, square: Tensor) -> Tensor:
        """radial(r) / r at r^2."""
        over, under = self._polynomials
        top = _evaluated(over, square)
        return top if len(under) == 1 else top / _evaluated(under, square)

    def _radial(self, radius: Tensor) -> Tensor:
        return radius * self._scale(radius * radius)

    def _bent(self, flat: Tensor) -> Tensor:
        return flat * self._scale(flat.square().sum(dim=-1))[
            ..., None
        ] + self._decentred(flat)

    def _decentred(self, flat: Tensor) -> Tensor:
        """The part of the distortion that is not radial: of a lens off its centre, and
        of a thin prism.
        """
        (p1, p2, s1, s2, s3, s4) = self.numbers[NUMBERS.index("p1") :]
        (x, y) = flat.unbind(dim=-1)
        square = x * x + y * y
        aside = (
            2.0 * p1 * x * y + p2 * (square + 2.0 * x * x) + square * (s1 + s2 * square)
        )
        below = (
            p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y + square * (s3 + s4 * square)
        )
        return torch.stack([aside, below], dim=-1)

    # ---- what follows from it
    # ---------------------------------------------------------------------------------------

    @cached_property
    def tangents(self) -> tuple[float, float]:
        """Half the sides of a rectangle around the axis, as tangents, that is in the
        picture as a whole.
        """
        # at first where the picture ends to the nearer side, along its row and its
        # column through the axis
        middle, _ = self.project(torch.tensor([[0.0, 0.0, 1.0]]))
        edges = []
        for axis in (0, 1):
            line = middle.repeat(512, 1)
            tangents = []
            for border in (0.0, 1.0):
                line[:, axis] = torch.linspace(
                    float(middle[0, axis]), border, 512, dtype=torch.float64
                )
                directions, inside = self.rays(line)
                seen = (inside > 0.0) & (directions[:, 2] > 0.1)
                aside = directions[:, axis].abs() / directions[:, 2].clamp_min(0.1)
                tangents.append(
                    float(torch.where(seen, aside, torch.zeros_like(aside)).max())
                )
            edges.append(max(1e-3, min(WIDEST, *tangents)))
        along = torch.linspace(-1.0, 1.0, 17, dtype=torch.float64)
        end = torch.ones_like(along)
        rim = torch.stack(
            [
                torch.cat([along, along, end, -end]),
                torch.cat([end, -end, along, along]),
            ],
            dim=-1,
        )
        rim = rim * torch.tensor(edges, dtype=torch.float64)
        for share in torch.linspace(1.0, 0.02, 50).tolist():
            points = torch.cat([share * rim, torch.ones_like(rim[:, :1])], dim=-1)
            places, seen = self.project(points)
            if bool(
                (
                    seen
                    & (places >= -1e-6).all(dim=-1)
                    & (places <= 1.0 + 1e-6).all(dim=-1)
                ).all()
            ):
                break
        return share * edges[0], share * edges[1]

    @cached_property
    def black(self) -> float:
        """Share of the picture in which nothing is seen."""
        step = (torch.arange(64, dtype=torch.float64) + 0.5) / 64
        places = torch.stack(torch.meshgrid(step, step, indexing="xy"), dim=-1).reshape(
            -1, 2
        )
        return float((self.rays(places)[1] <= 0.0).double().mean())

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know of it, in sentences."""
        if self.black == 0.0:
            return self.told
        name = self.name or "the lens"
        share = f"{100.0 * self.black:.2g} % of the picture"
        black = f"{name}: {share} lies outside the lens's circle and is black."
        if self.fold < math.radians(self.reach):
            folds = (
                f"{name}: the lens folds at {math.degrees(self.fold):.1f} degrees "
                "from its axis"
            )
            black = (
                f"{folds}, and {share}, which only directions beyond that would "
                "fill, is black."
            )
        return (*self.told, black)

    def scaling(self, resolution: tuple[int, int]) -> tuple[str, ...]:
        """Return what is to be said of a picture of another size (height, width) than
        the model is for.
        """
        if self.size is None or self.size == resolution:
            return ()
        (tall, wide) = self.size
        (height, width) = resolution
        shape = wide * height / (tall * width)
        squeezed = (
            f", which makes things {shape:.3g} times as high for their width"
            if abs(shape - 1.0) > 0.005
            else ""
        )
        return (
            f"{self.name} is for {wide} x {tall} pixels (width x height): its focal "
            "lengths and its principal point "
            f"are scaled to {width} x {height}{squeezed}.",
        )


def pinhole(fov: float, aspect: float) -> CameraModel:
    """Return the model of a camera without distortion, by field of view (degrees,
    larger side) and aspect.
    """
    focal = 0.5 / math.tan(math.radians(fov) / 2.0)
    linear = (focal * max(1.0, 1.0 / aspect), focal * max(1.0, aspect), 0.5, 0.5, 0.0)
    return CameraModel(BROWN_CONRADY, (*linear, *[0.0] * len(COEFFICIENTS)))


def bundled(aspect: float = 1.0) -> Mapping[str, CameraModel]:
    """Return the models that need no file, by name, for a picture of a shape."""
    half = 1.0 / math.pi
    none = [0.0] * len(COEFFICIENTS)
    ideal = (
        half * min(1.0, 1.0 / aspect),
        half * min(1.0, aspect),
        0.5,
        0.5,
        0.0,
        *none,
    )
    panorama = CameraModel(
        EQUIRECTANGULAR, (1.0, 1.0, 0.5, 0.5, 0.0, *none), EQUIRECTANGULAR
    )
    return {
        FISHEYE: CameraModel(FISHEYE, ideal, FISHEYE, reach=90.0),
        EQUIRECTANGULAR: panorama,
    }


def _evaluated(of: Polynomial, at: Tensor) -> Tensor:
    value = torch.full_like(at, float(of.coef[-1]))
    for coefficient in of.coef[-2::-1]:
        value = value * at + float(coefficient)
    return value


def _with_slopes(function: Field, at: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Values (N, k) of a function of each of N places alone, and the derivatives of
    each of the k by the place.
    """
    with torch.enable_grad():
        places = at.detach().requires_grad_()
        values = function(places)
        slopes = [
            torch.autograd.grad(each.sum(), places, retain_graph=True)[0]
            for each in values.unbind(dim=-1)
        ]
    return values.detach(), slopes


def _inside(margin: Tensor, converged: Tensor) -> Tensor:
    """The margin, at most 1, below zero where an inversion has not converged."""
    return torch.where(
        converged | (margin <= 0.0), margin, torch.full_like(margin, -1e-6)
    ).clamp(-1.0, 1.0)
