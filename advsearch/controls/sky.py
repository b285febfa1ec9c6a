"""The `sky` control: a clear sky with a sun replaces the environment.

The map is a differentiable function in torch: the dome of Hosek and Wilkie (2012, An
Analytic Model for Full Spectral Sky-Dome Radiance, equation 8) and their sun of 2013
(Adding a Solar Radiance Function to the Hosek Skylight Model), with the coefficients of
Mitsuba's `sunsky` plugin. Unlike in that plugin, the sun is wider (`SUN_RADIUS`), so that
texels of a map can show it; negative radiance is set to 0; the lower half is a diffuse
ground; and the derivative by the sun's position is defined. By default each map is
metered,

    radiance = map(azimuth, elevation, turbidity) M / m(azimuth, elevation, turbidity),

where m is the irradiance of the map on a surface that faces the sun. With `exposure:
fixed` the divisor is that of the start.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache, lru_cache, partial

import numpy as np
import torch
from torch import Tensor

from advsearch.extend import (
    Choice,
    Control,
    Parameter,
    SceneDescription,
    Values,
    assets,
    color,
    mitsuba_data,
)

MAP_ROWS = 256  # size of the map; even, so that half of the rows are above the horizon
MAP_COLUMNS = 512
# radius of the sun in the map, radians; half of its light comes from within 0.7 degrees
SUN_RADIUS = math.radians(1.5)
# radius of the real sun, radians, to which the coefficients refer
REAL_SUN_RADIUS = math.radians(0.5358 / 2.0)
SUN_UNIT_FACTOR = 467.069280386
"""Factor from the unit of the sun's coefficients to that of the sky's, as in Mitsuba's
plugin.
"""
SUN_PIECES = 45  # number of intervals of elevation, each with its own polynomials
TURBIDITIES = (1.0, 10.0)  # range of the coefficients
EPSILON = 1e-12


@cache
def load_sky_tables(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Return the tables of the sky's and the sun's model, see `read_sunsky_tables`.

    They are the shape of the dome's radiance, its mean level, and the sun's radiance.
    They are read once per process and device.
    """
    radiance, level, sun = mitsuba_data.read_sunsky_tables()
    return radiance.to(device), level.to(device), sun.to(device)


def compute_direction(azimuth: Tensor, elevation: Tensor) -> Tensor:
    """Return the unit vector (3,) towards an azimuth and an elevation, () in degrees.

    z is up; azimuth 0 is +x.
    """
    phi = torch.deg2rad(azimuth)
    theta = torch.deg2rad(elevation)
    return torch.stack(
        [
            torch.cos(theta) * torch.cos(phi),
            torch.cos(theta) * torch.sin(phi),
            torch.sin(theta),
        ]
    )


def _at_turbidity(table: Tensor, turbidity: Tensor) -> Tensor:
    """Interpolate a table (10, ...) between the integer turbidities 1 to 10.

    It is a cubic Hermite spline, so that the derivative is continuous. The slope at an
    integer turbidity is that between its neighbors (Catmull and Rom 1974), one-sided at
    1 and 10. The authors of the table interpolate linearly, but then the derivative
    jumps at integers, and the default turbidity is the integer 3.

    Args:
        table: row k belongs to the turbidity k + 1.
        turbidity: () turbidity, from 1 to 10.
    """
    last = len(table) - 1
    # Index of the row below the turbidity. For 10 it is that of 9, as there must be a row
    # above it.
    below = min(last - 1, max(0, int(turbidity.detach()) - 1))
    t = turbidity - 1.0 - below  # from 0 at the row below to 1 at the next
    lower = table[below]
    upper = table[below + 1]
    lower_slope = _compute_slope_at_row(table, below)
    upper_slope = _compute_slope_at_row(table, below + 1)
    # The curve is the straight line between both rows, whose slope is `rise`, plus a cubic
    # that is 0 at both. The cubic has the slope (lower_slope - rise) at t = 0, and
    # (upper_slope - rise) at t = 1.
    rise = upper - lower
    line = torch.lerp(lower, upper, t)
    return line + t * (1.0 - t) * (
        (1.0 - t) * (lower_slope - rise) - t * (upper_slope - rise)
    )


def _compute_slope_at_row(table: Tensor, index: int) -> Tensor:
    """Return the slope of a table (10, ...) between the neighbors of a row."""
    before = max(0, index - 1)
    after = min(len(table) - 1, index + 1)
    return (table[after] - table[before]) / (after - before)


def compute_sun_irradiance(elevation: Tensor, turbidity: Tensor) -> Tensor:
    """Return the sun's irradiance (3,) on a surface that faces it.

    Its unit is that of the sky's radiance times steradian.

    The sun's radiance at a point of its disk is a polynomial in two variables. One is
    cos(psi), where psi is the angle between the normal of the sun's surface and the line
    of sight, with the powers 0 to 5: the disk darkens towards its edge. The other is the
    elevation, with the powers 0 to 3. Elevations are divided into `SUN_PIECES` pieces,
    evenly in their cube root. Each piece has its own coefficients, and its elevations
    are counted from its lower bound.

    Args:
        elevation: () elevation of the sun, degrees.
        turbidity: () turbidity, from 1 to 10.
    """
    radians = torch.deg2rad(elevation)
    fraction = float(radians.detach()) / (math.pi / 2.0)
    piece = min(SUN_PIECES - 1, int(SUN_PIECES * max(0.0, fraction) ** (1.0 / 3.0)))
    lower_bound = (math.pi / 2.0) * (piece / SUN_PIECES) ** 3
    above = radians - lower_bound
    _, _, sun_table = load_sky_tables(radians.device)
    # of this piece: (channel, power of the elevation, power of cos(psi))
    coefficients = _at_turbidity(sun_table, turbidity)[piece]
    mean_radiance = _compute_mean_radiance(coefficients, above)
    solid_angle = 2.0 * math.pi * (1.0 - math.cos(REAL_SUN_RADIUS))
    return (mean_radiance * solid_angle * SUN_UNIT_FACTOR).clamp_min(0.0)


def _compute_mean_radiance(coefficients: Tensor, above: Tensor) -> Tensor:
    """Return the mean radiance (3,) of the sun's disk.

    Args:
        coefficients: (3, 4, 6) by channel, power of the elevation and power of cos(psi).
        above: () elevation from the lower bound of its piece, radians.
    """
    elevation_powers = torch.stack([above**power for power in range(4)])
    # Means of the powers of cos(psi) over the disk: at the distance r from its center,
    # cos(psi) is sqrt(1 - r^2), and the mean of (1 - r^2)^(p / 2) is 2 / (p + 2).
    limb_means = torch.tensor(
        [2.0 / (power + 2.0) for power in range(6)], device=above.device
    )
    # c channels, k powers of the elevation, j powers of cos(psi)
    return torch.einsum("ckj,k,j->c", coefficients, elevation_powers, limb_means)


class Sky:
    """Computes sky maps over a ground, after Hosek and Wilkie.

    Maps are on the device of the ground's reflectance.

    Attributes:
        ground: (3,) linear reflectance of the ground, in [0, 1].
        directions: (H, W, 3) unit vectors towards the texels above the horizon.
        cosines: (H, W, 1) cosines of their angles from the zenith.
        solid_angles: (H, W, 1) solid angles of the texels.
    """

    def __init__(self, ground: Tensor) -> None:
        """Compute the directions and solid angles of the texels above the horizon.

        Args:
            ground: (3,) linear reflectance of the ground, in [0, 1].
        """
        self.ground = ground
        elevations, azimuths = _make_texel_angles(ground.device)
        directions = compute_direction(azimuths, elevations)  # (3, H, W)
        self.directions = directions.permute(1, 2, 0).contiguous()
        self.cosines = self.directions[..., 2:3].clamp_min(0.0)
        # Texels get narrower towards the pole, where row 0 has no solid angle at all.
        height = math.pi / (MAP_ROWS - 1)  # radians
        width_at_horizon = 2.0 * math.pi / MAP_COLUMNS
        relative_width = torch.cos(torch.deg2rad(elevations))[..., None]
        self.solid_angles = relative_width * (height * width_at_horizon)

    def compute_dome(self, sun: Tensor, elevation: Tensor, turbidity: Tensor) -> Tensor:
        """Return the radiance of the sky above the horizon, without the sun's disk.

        Args:
            sun: unit vector (3,) towards the sun.
            elevation: () elevation of the sun in degrees, over 0.
            turbidity: () turbidity in `TURBIDITIES`.

        Returns:
            (H, W, 3) by equation 8 of Hosek and Wilkie 2012. The letters are its
            coefficients; `level` is the mean radiance.
        """
        coefficient_table, level_table, _ = load_sky_tables(sun.device)
        # (3,) each, for the channels. The tables have I before H.
        a, b, c, d, e, f, g, i, h = self._interpolate(
            coefficient_table, elevation, turbidity
        ).unbind(-1)
        level = self._interpolate(level_table, elevation, turbidity)
        # `cosine` and `angle` are those between a direction and the sun, `self.cosines`
        # those between a direction and the zenith. 0.01 avoids a division by 0 at the
        # horizon.
        cosine = (self.directions @ sun)[..., None]
        angle = compute_angles(self.directions, sun)[..., None]
        horizon = 1.0 + a * torch.exp(b / (self.cosines + 0.01))
        glow = _compute_glow(h, cosine)
        peak = d * torch.exp(e * angle)
        zenith = i * self.cosines.sqrt()
        around_sun = c + peak + f * cosine**2 + g * glow + zenith
        return (horizon * around_sun * level).clamp_min(0.0)

    def _interpolate(
        self, table: Tensor, elevation: Tensor, turbidity: Tensor
    ) -> Tensor:
        """Interpolate a table in turbidity, elevation and ground albedo.

        It is a quintic Bezier curve in the cube root of the elevation, and linear in
        the albedo.

        Args:
            table: (10, 2, 6, 3, ...); axes are turbidity, albedo (0 or 1), control
                point and channel.
            elevation: () elevation of the sun, degrees.
            turbidity: () turbidity, from 1 to 10.

        Returns:
            (3, ...).
        """
        # position on the curve; over 0, as the cube root has no derivative at 0
        x = (elevation / 90.0).clamp(1e-6, 1.0).pow(1.0 / 3.0)
        weights = torch.stack(
            [math.comb(5, k) * x**k * (1.0 - x) ** (5 - k) for k in range(6)]
        )
        control_points = _at_turbidity(table, turbidity)
        # a albedos (0 and 1), k control points, c channels
        curves = torch.einsum("k,akc...->ac...", weights, control_points)
        # the reflectance of the ground; (3, 1, ...) to be broadcast
        albedo = self.ground.reshape(3, *[1] * (curves.ndim - 2))
        return torch.lerp(curves[0], curves[1], albedo)

    def compute_disk(self, sun: Tensor) -> Tensor:
        """Return the sun's shape on the texels above the horizon, (H, W, 1).

        Its integral over solid angle is 1. It is (1 - r^2)^2, where r is the distance
        from the sun's center in radii, and 0 outside. It is smooth at the edge: a texel
        whose radiance changes when the sun moves has some radiance already. An adjoint
        that samples texels by their radiance needs that, as it never samples a texel
        without radiance.
        """
        # Between unit vectors, the distance is practically the angle for a small disk.
        squared_distance = (self.directions - sun).square().sum(-1, keepdim=True)
        squared_radii = squared_distance / SUN_RADIUS**2
        bump = (1.0 - squared_radii).clamp_min(0.0).square()
        return bump / (bump * self.solid_angles).sum().clamp_min(EPSILON)

    def __call__(
        self, azimuth: Tensor, elevation: Tensor, turbidity: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the map of a sky, and the irradiance towards its sun.

        Args:
            azimuth: () azimuth of the sun, degrees.
            elevation: () elevation of the sun, over 0 and at most 90 degrees.
            turbidity: () turbidity in `TURBIDITIES`.

        Returns:
            Linear radiance (ROWS, COLUMNS, 3); and the irradiance () on a surface that
            faces the sun, as the mean of the channels.
        """
        sun = compute_direction(azimuth, elevation)
        dome = self.compute_dome(sun, elevation, turbidity)
        # The disk has an integral of 1, so that this is its radiance.
        disk = self.compute_disk(sun) * compute_sun_irradiance(elevation, turbidity)
        upper = dome + disk
        # (H, W, 3) irradiance by each texel on a surface that faces the texel
        texel_irradiance = upper * self.solid_angles
        radiance = torch.cat([upper, self._compute_lower_half(texel_irradiance)])
        # The same for a surface that faces the sun, instead of the ground.
        cosines_to_sun = (self.directions @ sun).clamp_min(0.0)[..., None]
        irradiance = (texel_irradiance * cosines_to_sun).sum() / 3.0  # mean of channels
        return radiance, irradiance

    def _compute_lower_half(self, texel_irradiance: Tensor) -> Tensor:
        """Return the radiance of the ground, the lower half of the map.

        Args:
            texel_irradiance: (H, W, 3) irradiance by each texel of the upper half on a
                surface that faces the texel.
        """
        ground_irradiance = (texel_irradiance * self.cosines).sum((0, 1))
        # The ground is diffuse: its radiance is the same in all directions.
        ground_radiance = self.ground * ground_irradiance / math.pi
        n_lower_rows = MAP_ROWS - MAP_ROWS // 2
        return ground_radiance.expand(n_lower_rows, MAP_COLUMNS, 3)


def _make_texel_angles(device: torch.device) -> tuple[Tensor, Tensor]:
    """Return elevations and azimuths (H, W) of the texels above the horizon, degrees.

    Row 0 of the map is straight up, and its last row straight down. Only the upper half
    is above the horizon. Azimuths begin at 90 degrees and decrease from column to
    column; they are those of the texels' centers.
    """
    n_upper_rows = MAP_ROWS // 2
    row = torch.arange(n_upper_rows, device=device)
    elevation = 90.0 - 180.0 * row / (MAP_ROWS - 1)
    column = torch.arange(MAP_COLUMNS, device=device)
    azimuth = 90.0 - 360.0 * (column + 0.5) / MAP_COLUMNS
    elevations, azimuths = torch.meshgrid(elevation, azimuth, indexing="ij")
    # `meshgrid` returns a view that repeats one row; the sum is a dense tensor.
    dense_azimuths = elevations * 0.0 + azimuths
    return elevations, dense_azimuths


def _compute_glow(h: Tensor, cosine: Tensor) -> Tensor:
    """Return the glow (H, W, 3) around the sun, by its shape `h` (3,).

    `cosine` (H, W, 1) is that of the angle between a direction and the sun.
    """
    # The numerator comes first: the order fixes how derivatives are rounded.
    numerator = 1.0 + cosine**2
    return numerator / (1.0 + h**2 - 2.0 * h * cosine).clamp_min(1e-6).pow(1.5)


def compute_angles(directions: Tensor, reference: Tensor) -> Tensor:
    """Return the angle (...) in radians between unit vectors (..., 3) and (3,).

    Differentiable at 0 and 180 degrees, as `EPSILON` keeps the square roots over 0.
    """
    # |a - b| / 2 is the sine of half the angle between a and b, |a + b| / 2 its cosine.
    half_sine = ((directions - reference).square().sum(-1) / 4.0 + EPSILON).sqrt()
    half_cosine = ((directions + reference).square().sum(-1) / 4.0 + EPSILON).sqrt()
    return 2.0 * torch.atan2(half_sine, half_cosine)


METERED_IRRADIANCE = 0.9 * math.pi / 0.8
"""`M`: irradiance on a surface that faces the sun, in each metered sky."""
_by_differences = partial(Parameter.number, ("differences",))


class SkyControl(Control):
    """A clear sky instead of the environment: position of the sun, and turbidity."""

    kind = "sky"
    photograph_refusal = "the photograph was taken in one light, and shows its own sky"
    parameters = (
        _by_differences(
            "azimuth",
            "degrees",
            -3600.0,
            3600.0,
            90.0,
            "Direction of the sun about the vertical; 0 is +x.",
            (0.0, 360.0),
            periodic=True,
        ),
        _by_differences(
            "elevation",
            "degrees",
            2.0,
            90.0,
            45.0,
            "Height of the sun above the horizon.",
            (5.0, 85.0),
        ),
        Parameter.number(
            Parameter.LIT,
            "turbidity",
            "1",
            *TURBIDITIES,
            3.0,
            "Haziness of the air: 2 is very clear, 3 clear, 6 warm and moist, 10 hazy.",
            (2.0, 8.0),
        ),
    )
    choices = (
        Choice(
            "exposure",
            "metered",
            "metered (for each sky, as by a camera with automatic exposure) or fixed "
            "(at that of the start).",
            options=("metered", "fixed"),
        ),
    )

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene with the sky at the control's start as its environment."""
        # To know the sky at the start, a copy is bound to the scene before its sky is set.
        bound = self.bind(scene)
        radiance = (
            bound.compute_radiance(bound.compute_values(bound.start))
            .numpy()
            .astype(np.float32)
        )
        sky = assets.EnvironmentAsset("sky", radiance, source="Hosek and Wilkie's sky")
        # The map is as it should be: it is neither rotated nor exposed by the scene.
        return replace(scene, environment=sky).with_values(
            environment__rotation=0.0, environment__exposure=0.0
        )

    def bind_parameters(self) -> None:
        """Fit the parameters, and compute the irradiance towards the sun at the start."""
        super().bind_parameters()
        start = self.compute_values(self.start)
        sky = make_sky(self.scene.ground_color, torch.device("cpu"))
        azimuth = torch.tensor(0.0)  # has no effect on the irradiance
        _, self._start_irradiance = sky(azimuth, start["elevation"], start["turbidity"])

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        return {"environment.data": self.compute_radiance(values)}

    def compute_radiance(self, values: Values) -> Tensor:
        """Return the map (H, W, 3) of linear radiance, differentiable in the values.

        The map is scaled as a camera would expose it: so that the irradiance towards the
        sun is `METERED_IRRADIANCE`. With the choice `exposure=fixed` the scale is that
        of the sky at the start.
        """
        azimuth = values["azimuth"]
        sky = make_sky(self.scene.ground_color, azimuth.device)
        # the map, and the irradiance () on a surface that faces the sun
        radiance, irradiance = sky(azimuth, values["elevation"], values["turbidity"])
        if self.choice_values["exposure"] == "fixed":
            irradiance = self._start_irradiance.to(radiance.device)
        return radiance * (METERED_IRRADIANCE / irradiance)


@lru_cache(maxsize=4)
def make_sky(ground: tuple[float, ...], device: torch.device) -> Sky:
    """Return the sky over a ground of an sRGB color, that of the ground plane."""
    return Sky(color.srgb_to_linear(torch.tensor(ground)).to(device))
