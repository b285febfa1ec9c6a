"""The `patch` control: a printed square that is stuck onto the object.

Its pixels, position, size and rotation can be searched. In Brown et al. (2017,
"Adversarial Patch", arXiv 1712.09665, section 2) a patch is pasted into images. Here it
lies on the surface, under the scene's light, and bends with it. It is part of the base
color, so that no outline moves and the adjoint is right.

    base color = (1 - m) base color + m linear(pixels at (a, b))
    m = soft square in (a, b), on the front of the surface

A ray from outside towards the center of the object hits the surface at the center of the
patch. (a, b) are coordinates in the tangent plane there, unrolled along the direction in
which the surface bends (exact for cylinders and spheres; Schmidt et al. 2006,
"Interactive Decal Compositing with Discrete Exponential Maps"). Only texels that are
connected with the center and face the same side are painted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from scipy import spatial
from torch import Tensor

from advsearch.extend import (
    Choice,
    Fixed,
    InputError,
    OneOf,
    Parameter,
    PictureControl,
    Range,
    SceneDescription,
    Values,
    assets,
    color,
    geometry,
    images,
)

BASE_COLOR = "object.base_color"
NORMS = ("box", "linf", "l2")
# smallest and largest side of the base-color map that is painted, in texels
MAP_SIDES = (512, 1024)
PAINT_RADIUS = 0.75
"""Radius around the patch's center within which texels are painted, in sides of the
patch. Its corners are at 0.7071.
"""
# A patch fades out where the surface turns away: its opacity is 0 where the cosine of the
# angle between the normals of texel and patch is the first, and 1 where it is the second.
FACING_COSINES = (0.1, 0.3)
EDGE_TEXELS = 2.0  # width of the soft edge in texels


class PatchControl(PictureControl):
    """A printed square on the object: its pixels, position, size and rotation.

    Numbers that are not set are fixed. Pixels are searched, unless they are set to a gray
    or an image file.

    Attributes:
        _painter: paints the patch into the object's base color; set by `bind_parameters`.
    """

    kind = "patch"
    image_parameter = "pixels"
    parameters = (
        Parameter(
            "pixels",
            (None, None, 3),
            "sRGB",
            0.0,
            1.0,
            "the object's own texture underneath",
            "Display-referred colours of the patch; a narrower range can stand for a "
            "printer's gamut.",
            search=(0.0, 1.0),
            estimators=("adjoint",),
        ),
        Parameter.number(
            ("differences",),
            "azimuth",
            "degrees",
            0.0,
            360.0,
            "towards the camera",
            "Side of the object that the patch is on.",
            periodic=True,
        ),
        Parameter.number(
            ("differences",),
            "height",
            "1",
            0.0,
            1.0,
            "towards the camera",
            "Height on the object, from the centre of the underside (0) over the "
            "sides (0.5) to the centre of the top (1).",
        ),
        Parameter.number(
            Parameter.LIT,
            "size",
            "object sizes",
            0.05,
            0.6,
            0.3,
            "Side of the patch.",
            log=True,
        ),
        Parameter.number(
            Parameter.LIT,
            "rotation",
            "degrees",
            -180.0,
            180.0,
            0.0,
            "Rotation of the patch on the surface, counter-clockwise; upright at 0.",
            periodic=True,
        ),
    )
    choices = (
        Choice(
            "resolution", 32, "Side of the patch in pixels.", integer_bounds=(2, 512)
        ),
        Choice(
            "norm",
            "box",
            "Limit of the pixels: box (none), or the norm of a ball around the texture "
            "underneath, linf (the default with an epsilon) or l2.",
            "norm",
            "pixels",
            options=NORMS,
        ),
        Choice(
            "epsilon",
            None,
            "Radius of that ball, display-referred; by default 0.1 for each pixel value.",
            "epsilon",
            "pixels",
            max_value=PictureControl.MAX_EPSILON,
        ),
        Choice(
            "picture",
            None,
            "A picture file to use as the patch; pixels are not searched then.",
            fixes="pixels",
        ),
    )

    refines = frozenset({BASE_COLOR})
    on_top = True

    def __init__(self, name: str | None = None, **settings: object) -> None:
        """Read the settings, and check that those of the pixels fit each other.

        Args:
            name: name of the control; by default its kind.
            **settings: values of its parameters and choices.

        Raises:
            InputError: pixels are neither a range nor one number; pixels and a picture
                are both set; or a norm ball is set for pixels that are not searched.
        """
        super().__init__(name, **settings)
        self._check_pixels()
        if not self.is_image_searched:
            self._check_has_no_ball()

    def _check_has_no_ball(self) -> None:
        """Raise InputError if a norm ball is set for pixels that are not searched."""
        fixing_setting = (
            "pixels" if self.choice_values["picture"] is None else "picture"
        )
        for ball_setting in ("epsilon", "norm"):
            # None and the norm "box" mean that there is no ball.
            if self.choice_values[ball_setting] not in (None, "box"):
                raise InputError(
                    f"{self.name}.{ball_setting}: limits searched pixels, and the "
                    "pixels are fixed; leave it out, "
                    f"or leave out {self.name}.{fixing_setting}"
                )

    def _check_pixels(self) -> None:
        """Check that the pixels are a range or one number, and that no picture is set.

        Raises:
            InputError: they are something else, or a picture is set as well.
        """
        pixels = self.specs.get("pixels")
        if pixels is None:
            return
        if self.choice_values["picture"] is not None:
            raise InputError(
                f"{self.name}.pixels: expected none together with "
                f"{self.name}.picture; leave one of them out"
            )
        # distributions are subclasses of Range
        is_plain_range = type(pixels) is Range
        if not isinstance(pixels, Fixed) and not is_plain_range:
            raise InputError(
                f"{self.name}.pixels: expected [low, high] or one number, got "
                f"{_describe_pixels(pixels)}"
            )

    def check_choices(self) -> None:
        """Set the norm linf for an epsilon without a norm, and reject one with box.

        Raises:
            InputError: `epsilon` is set together with the norm "box".
        """
        epsilon = self.choice_values["epsilon"]
        if "norm" not in self._settings and epsilon is not None:
            self.choice_values["norm"] = "linf"
        if self.choice_values["norm"] == "box" and epsilon is not None:
            raise InputError(
                f"{self.name}.epsilon: expected none with norm box, got {epsilon:g}; "
                "set norm to linf or l2"
            )

    # ---- in a scene

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        if parameter.name not in ("azimuth", "height"):
            return super().resolve_parameter(parameter)
        azimuth, height = find_side_towards_camera(self.scene)
        default = azimuth if parameter.name == "azimuth" else height
        return replace(parameter, default=default)

    def bind_parameters(self) -> None:
        """Prepare the painter, and let searched pixels start as the texture underneath.

        Raises:
            InputError: nothing is searched.
        """
        super().bind_parameters()
        self._check_has_groups()
        side = self.image_shape[0]
        pixels = self.parameter_slots[0]  # the slots have the order of `parameters`
        picture = self.read_picture()
        self._picture = (
            None if picture is None else images.resize_to_square(picture, side)
        )
        self._painter = PatchPainter(self.scene, self._compute_start_numbers(), side)
        if isinstance(pixels.parameter_spec, Range):
            self._start_as_underneath(pixels.parameter, pixels.parameter_spec)

    def _compute_start_numbers(self) -> dict[str, float]:
        """Return the values at the start, without the pixels.

        The painter needs these values, which `compute_values` returns, and the start of
        the pixels needs the painter. So the pixels are set last.
        """
        return {
            name: float(value)
            for name, value in self.compute_values(self.start).items()
            if name != "pixels"
        }

    def _check_has_groups(self) -> None:
        """Raise InputError if nothing is searched."""
        if not self.groups:
            raise InputError(
                f"`controls` {self.name}: the pixels are fixed, so there is nothing to "
                "search; set a range for another parameter, "
                f"such as {self.name}={{azimuth: [0, 360]}}"
            )

    def _start_as_underneath(self, parameter: Parameter, pixel_range: Range) -> None:
        """Let searched pixels start as the texture underneath the patch.

        Colors outside of the range are clipped to it. If there are any, the start is
        recorded as an adjusted default, in words: "the nearest from 0.2 to 0.8".

        Args:
            parameter: parameter of the pixels.
            pixel_range: range of their values.
        """
        low = pixel_range.low
        high = pixel_range.high
        # (side, side, 3), as fractions of the range
        underneath = (self._painter.sample_underneath() - low) / (high - low)
        start = underneath.clamp(0.0, 1.0)
        # Pixels are the first parameter, so that their coordinates come first.
        n_coordinates = start.numel()
        self.start[:n_coordinates] = start.reshape(-1)
        is_clipped = not torch.allclose(start, underneath, atol=1e-5)
        if is_clipped:
            self.record_adjusted_default(
                parameter,
                scene_value="the texture underneath",
                used_value=f"the nearest {pixel_range}",
            )

    def must_start_at_clean_value(
        self, parameter: Parameter, spec: Fixed | Range | OneOf
    ) -> bool:
        # Searched pixels start as the texture underneath: then the patch is invisible,
        # wherever it is.
        return not self.is_image_searched and parameter.name != "pixels"

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the object's base color with the patch painted into it."""
        return {
            BASE_COLOR: self._painter.paint(
                earlier_inputs.get(BASE_COLOR), values["pixels"], values
            )
        }

    def get_printable_colors(self, u: Tensor) -> Tensor | None:
        return self.compute_values(u)["pixels"] if self.is_image_searched else None

    def make_artifact_images(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the patch enlarged for printing, and its pixels."""
        pixels = values["pixels"]
        print_scale = math.ceil(images.MIN_PRINT_SIDE / len(pixels))
        return {
            self.name: images.enlarge(pixels, print_scale),
            f"{self.name}-pixels": pixels,
        }


# ---- on the surface


def find_side_towards_camera(scene: SceneDescription) -> tuple[float, float]:
    """Return the azimuth and the height of a patch on the side that faces the camera.

    The inverse, from azimuth and height to a direction, is `_outward_direction`.

    Returns:
        Azimuth in degrees, and height from 0 to 1, as the parameters of the control.
    """
    center, radius, half_height = _measure_mesh(scene.object.mesh)
    object_to_world = geometry.compute_object_to_world(scene)
    camera_in_world = np.append(geometry.camera_to_world(scene)[:3, 3], 1.0)
    camera_in_object = np.linalg.solve(object_to_world, camera_in_world)[:3]
    x, y, z = camera_in_object - center
    # A limit above 0, so that the height of a camera straight above is 1.
    level_distance = max(math.hypot(x, y), 1e-12)
    # Latitude of the direction after the ellipsoid around the object is scaled to a unit
    # sphere: level distances are divided by the radius, z by the half height.
    latitude = math.atan2(z * radius, level_distance * half_height)
    azimuth = math.degrees(math.atan2(y, x)) % 360.0
    return azimuth, 0.5 + latitude / math.pi


def _compute_edge_opacity(on_patch: Tensor, size: Tensor, spacing: float) -> Tensor:
    """Return the opacity (N,) of a patch by the distance from its edge.

    It rises from 0 to 1 over `EDGE_TEXELS` texels and is 0.5 on the edge.

    Args:
        on_patch: (N, 2) positions, in sides of the patch from its center.
        size: () side of the patch, object sizes.
        spacing: distance of neighbouring texels, object sizes.
    """
    edge_width = EDGE_TEXELS * spacing
    edge_position = (0.5 - on_patch.abs().amax(dim=1)) * size / edge_width + 0.5
    return _smooth_step(edge_position)


def _sample_pixels(pixels: Tensor, positions: Tensor) -> Tensor:
    """Interpolate the pixels of a patch; return linear colors (N, 3).

    Args:
        pixels: (n, n, 3) sRGB.
        positions: (N, 2) to the right and upwards of the center, where 1 is the side of
            the patch. Positions beyond the edge get the color of the edge.
    """
    # grid_sample wants (1, 1, N, 2) in [-1, 1], to the right and downwards
    grid = (positions * positions.new_tensor([2.0, -2.0]))[None, None]
    linear = images.to_planes(color.srgb_to_linear(pixels))
    sampled = F.grid_sample(
        linear, grid, mode="bilinear", padding_mode="border", align_corners=False
    )
    return sampled[0, :, 0].T


def _measure_mesh(mesh: assets.Mesh) -> tuple[assets.Float64Array, float, float]:
    """Return the center (3,) of a mesh, its largest half-width and its half-height.

    Both sizes are positive, even for a flat mesh.
    """
    low = mesh.vertices.min(axis=0).astype(np.float64)
    high = mesh.vertices.max(axis=0).astype(np.float64)
    half_size = np.maximum((high - low) / 2.0, 1e-6)
    return (low + high) / 2.0, float(half_size[:2].max()), float(half_size[2])


def _describe_pixels(spec: Range | OneOf) -> str:
    """Return a phrase about pixels that are set to neither a range nor one number."""
    if isinstance(spec, OneOf):
        return f"a list of {len(spec.values)}"
    return "a distribution"


def _check_texture_does_not_repeat(mesh: assets.Mesh) -> None:
    """Raise InputError if a patch would repeat on an object, as its texture does."""
    if mesh.repeats:
        raise InputError(
            "`controls` patch: the object's texture repeats on its surface, and a "
            "patch that is painted into it would repeat too; "
            "leave patch out, or search the full texture"
        )


def _blend_texels(
    base: Tensor, indices: Tensor, patch_colors: Tensor, opacity: Tensor
) -> Tensor:
    """Return a base color (n, n, 3) with colors blended into some texels.

    Args:
        base: (n, n, 3) colors below.
        indices: (N,) indices of the texels, row by row.
        patch_colors: (N, 3) colors that are blended in.
        opacity: (N, 1) their opacity.
    """
    base_colors = base.reshape(-1, 3)
    colors_below = base_colors.index_select(0, indices)
    blended = colors_below + opacity * (patch_colors - colors_below)
    # the base color with the blended texels in place of those below
    return base_colors.index_copy(0, indices, blended).reshape(base.shape)


@dataclass(frozen=True, eq=False)
class NearbyTexels:
    """The N texels near the center of a patch, which it may cover.

    Attributes:
        indices: (N,) indices of the texels in the map, row by row.
        coordinates: (N, 2) coordinates on the unrolled surface, to the right and upwards
            of the patch's center before it is rotated, in object sizes.
        opacity: (N,) opacity of the patch, 1 where the surface faces the same side as
            the patch and 0 where it turns away.
        spacing: distance between neighbouring texels on the surface, object sizes.
    """

    indices: Tensor
    coordinates: Tensor
    opacity: Tensor
    spacing: float


class PatchPainter:
    """Paints a patch into the object's base-color map.

    Arrays of texels have one row for each of the T texels that lie on a face of the mesh.
    Their positions and normals are in object coordinates.

    Attributes:
        _center_and_sizes: center (3,), largest half-width and half-height of the mesh.
        _start_values: azimuth, height, size and rotation of the patch at the start.
        _side: side of the patch, pixels.
        _surface: the mesh, for ray casting and for connected regions.
        _object_color: (n, n, 3) the object's own base color, linear.
        _texels: (T,) indices of the texels in the map, row by row.
        _faces: (T,) face of each texel.
        _positions: (T, 3) positions of texels on the surface.
        _normals: (T, 3) normals of the surface there.
        _areas: (T,) areas of texels on the surface.
        _find_texels: `_find_nearby_texels`, cached by azimuth, height and size.
    """

    def __init__(
        self, scene: SceneDescription, start_values: Mapping[str, float], side: int
    ) -> None:
        """Prepare the object's base-color map, and the surface point of each texel.

        Args:
            scene: scene with the object.
            start_values: azimuth, height, size and rotation of the patch at the start.
            side: number of pixels along a side of the patch.

        Raises:
            InputError: the object's texture repeats.
        """
        mesh = scene.object.mesh
        _check_texture_does_not_repeat(mesh)
        self._center_and_sizes = _measure_mesh(mesh)
        self._start_values = start_values
        self._side = side
        self._surface = images.MeshSurface(mesh)
        srgb_color = torch.from_numpy(scene.object.base_color.copy())
        object_color = color.srgb_to_linear(srgb_color)
        # (n, n) faces, positions, normals and areas of the map's texels
        charts = _rasterise_finely(
            mesh,
            texture_side=max(object_color.shape[:2]),
            pixel_size=start_values["size"] / side,
        )
        map_side = len(charts.face_index)
        self._object_color = _resize_to_square(object_color, map_side)
        self._store_texels(charts)
        # The patch often stays in the same position for many images.
        self._find_texels = lru_cache(maxsize=4)(self._find_nearby_texels)

    def _store_texels(self, charts: images.Charts) -> None:
        """Store index, face, position, normal and area of each texel on a face.

        Row i of each array is texel `_texels[i]` of the flattened map, on the face
        `_faces[i]` of the mesh.
        """
        is_on_face = charts.is_readable
        self._texels = np.flatnonzero(is_on_face)
        self._faces = charts.face_index[is_on_face]
        self._positions = charts.compute_positions()[is_on_face].astype(np.float64)
        self._normals = charts.compute_normals()[is_on_face].astype(np.float64)
        self._areas = charts.compute_areas()[is_on_face].astype(np.float64)

    def paint(
        self, base: Tensor | None, pixels: Tensor, numbers: Mapping[str, Tensor]
    ) -> Tensor:
        """Return the base color (n, n, 3), linear, with the patch on it.

        The result is differentiable in the colors, the size and the rotation, but not
        in the position of the patch.

        Args:
            base: (h, w, 3) linear base color by earlier controls; None for the
                object's own.
            pixels: (n, n, 3) sRGB pixels of the patch.
            numbers: azimuth, height, size and rotation of the patch, () each.
        """
        device = pixels.device
        base = self._prepare_base(base, device)
        size = numbers["size"]
        texels = self._find_texels(
            float(numbers["azimuth"].detach()),
            float(numbers["height"].detach()),
            float(size.detach()),
        )
        coordinates = texels.coordinates.to(device)
        # (N, 2) in sides of the patch: it reaches from -0.5 to 0.5
        on_patch = _rotate(coordinates, numbers["rotation"]) / size
        edge_opacity = _compute_edge_opacity(on_patch, size, texels.spacing)
        opacity = (texels.opacity.to(device) * edge_opacity)[:, None]
        patch_colors = _sample_pixels(pixels, on_patch)
        return _blend_texels(base, texels.indices.to(device), patch_colors, opacity)

    def _prepare_base(self, base: Tensor | None, device: torch.device) -> Tensor:
        """Return a base color (h, w, 3), or the object's own, with the map's size."""
        if base is None:
            return self._object_color.to(device)
        return _resize_to_square(base, len(self._object_color))

    def sample_underneath(self) -> Tensor:
        """Return the pixels of a patch that shows the object's own texture beneath it.

        They are the mean colors of the texels in each pixel, at the patch's starting
        position, size and rotation.

        Returns:
            (n, n, 3) sRGB; a pixel that no texel lies in has the nearest texel's color.
            All pixels are gray if no texel lies under the patch.
        """
        start = self._start_values
        side = self._side
        texels = self._find_texels(start["azimuth"], start["height"], start["size"])
        rotation = torch.tensor(start["rotation"])
        # (N, 2) in sides of the patch: it reaches from -0.5 to 0.5
        on_patch = _rotate(texels.coordinates, rotation) / start["size"]
        is_covered = (on_patch.abs().amax(dim=1) < 0.5) & (texels.opacity > 0.0)
        if not bool(is_covered.any()):
            return torch.full((side, side, 3), 0.5)
        covered_colors = self._object_color.reshape(-1, 3)[texels.indices[is_covered]]
        # Column and row in [0, 1]: the second coordinate points up, but rows go down.
        positions = on_patch[is_covered] * torch.tensor([1.0, -1.0]) + 0.5
        colors = _average_in_pixels(covered_colors, positions, side)
        return color.linear_to_srgb(colors).reshape(side, side, 3)

    def _find_nearby_texels(
        self, azimuth: float, height: float, size: float
    ) -> NearbyTexels:
        """Find the texels that a patch of a size may cover at an azimuth and a height.

        The patch's center is the first hit of a ray from outside towards the center of
        the object. Its normal is the mean normal of the surface around that point.

        Args:
            azimuth: degrees around the object.
            height: height from 0 (middle of the underside) to 1 (middle of the top).
            size: side of the patch, object sizes.
        """
        _, radius, half_height = self._center_and_sizes
        outwards = _outward_direction(azimuth, height, radius, half_height)
        face, point = self._find_patch_center(outwards)
        sign = self._find_side(face, outwards)
        mean_normal = self._compute_mean_normal(face, point)
        # rows right, up and outwards of the patch
        frame = _make_frame(sign * mean_normal, _upward_direction(azimuth, outwards))
        rows = self._select_texels(face, point, mean_normal, PAINT_RADIUS * size)
        coordinates, cosine = unroll_surface(
            self._positions[rows] - point, sign * self._normals[rows], frame
        )
        return NearbyTexels(
            indices=torch.from_numpy(self._texels[rows]),
            coordinates=torch.from_numpy(coordinates.astype(np.float32)),
            opacity=_fade_in(cosine),
            spacing=self._measure_texel_spacing(rows),
        )

    def _find_patch_center(
        self, outwards: assets.Float64Array
    ) -> tuple[int, assets.Float64Array]:
        """Return the face that a ray towards the object's center meets, and the point (3,).

        Args:
            outwards: (3,) unit direction from the center, from which the ray comes.
        """
        center, radius, half_height = self._center_and_sizes
        # far enough away to be outside of the object
        ray_origin = center + 4.0 * (radius + half_height) * outwards
        return self._surface.find_hit(ray_origin, -outwards)

    def _find_side(self, face: int, outwards: assets.Float64Array) -> float:
        """Return 1 for a patch on the front of a face, and -1 for one on its back.

        If the ray from a direction (3,) hits the back of a face, the patch is on the
        back of the surface, and normals are flipped.
        """
        is_front = float(self._surface.normals[face] @ outwards) >= 0.0
        return 1.0 if is_front else -1.0

    def _compute_mean_normal(
        self, face: int, point: assets.Float64Array
    ) -> assets.Float64Array:
        """Return the mean normal (3,) of the surface around a point of a face.

        Weights decrease smoothly to 0 at half the side that the patch has at the start.
        This radius stays the same if a search changes the side. If no texel is near,
        the normal of the face is returned.

        Args:
            face: index of the face.
            point: (3,) point of the face.
        """
        face_normal = self._surface.normals[face]
        radius = 0.5 * self._start_values["size"]
        # a mask of the mesh's faces, and of the texels on them (T,)
        is_face_near = self._surface.find_region(face, point, face_normal, radius)
        is_near = is_face_near[self._faces]
        squared_distance = ((self._positions[is_near] - point) ** 2).sum(axis=1)
        weight = np.maximum(1.0 - squared_distance / radius**2, 0.0) ** 2
        area_weight = weight * self._areas[is_near]
        total = (self._normals[is_near] * area_weight[:, None]).sum(axis=0)
        length = float(np.linalg.norm(total))
        return np.asarray(face_normal if length <= 1e-12 else total / length)

    def _select_texels(
        self,
        face: int,
        point: assets.Float64Array,
        normal: assets.Float64Array,
        radius: float,
    ) -> assets.IntArray:
        """Return the rows (N,) of texels within a radius of a point of a face.

        The texels are connected to the point over the surface, and their faces face the
        direction of the normal.

        Args:
            face: index of the face.
            point: (3,) point of the face.
            normal: (3,) normal of the patch, as the mesh has it.
            radius: largest distance from the point, object sizes.
        """
        # a mask of all faces of the mesh
        is_face_near = self._surface.find_region(face, point, normal, radius)
        # rows of the texels on these faces
        is_texel_on_these = is_face_near[self._faces]
        connected = np.flatnonzero(is_texel_on_these)
        offsets = self._positions[connected] - point
        is_close = (offsets**2).sum(axis=1) <= radius**2
        return np.asarray(connected[is_close])

    def _measure_texel_spacing(self, rows: assets.IntArray) -> float:
        """Return the median distance of neighboring texels on the surface.

        It is in object sizes. Texels without an area do not count. If none has an area,
        the distance is that in a map which spans one object size.

        Args:
            rows: (N,) rows of the texels in the painter's arrays.
        """
        areas = self._areas[rows]
        has_area = areas > 0.0
        if not has_area.any():
            map_side = len(self._object_color)
            return 1.0 / map_side
        return math.sqrt(float(np.median(areas[has_area])))


def _outward_direction(
    azimuth: float, height: float, radius: float, half_height: float
) -> assets.Float64Array:
    """Return the unit vector (3,) from the center of an object to a patch on it.

    Azimuth and height are coordinates of an ellipsoid around the object: a unit sphere
    with these coordinates is stretched to the ellipsoid.

    Args:
        azimuth: degrees around the vertical.
        height: latitude on the sphere: 0 at the lower pole, 0.5 at the equator, 1 at the
            upper pole.
        radius: level radius of the ellipsoid, object sizes.
        half_height: half the height of the ellipsoid, object sizes.
    """
    angle = math.radians(azimuth)
    latitude = (height - 0.5) * math.pi
    x = math.cos(latitude) * radius * math.cos(angle)
    y = math.cos(latitude) * radius * math.sin(angle)
    z = math.sin(latitude) * half_height
    outwards = np.array([x, y, z])
    outwards /= np.linalg.norm(outwards)
    return outwards


def _upward_direction(
    azimuth: float, outwards: assets.Float64Array
) -> assets.Float64Array:
    """Return the most upward unit vector (3,) at a right angle to a direction.

    Args:
        azimuth: azimuth of the direction, degrees. It is needed because it can't be
            computed from a vertical direction.
        outwards: (3,) the direction, a unit vector.
    """
    # The direction is (cos(latitude) cos(azimuth), cos(latitude) sin(azimuth),
    # sin(latitude)); the result is its derivative by the latitude.
    angle = math.radians(azimuth)
    level = math.hypot(outwards[0], outwards[1])
    return np.array(
        [-outwards[2] * math.cos(angle), -outwards[2] * math.sin(angle), level]
    )


def _fade_in(cosine: assets.Float64Array) -> Tensor:
    """Return the opacity (N,) of a patch on texels, by the direction that they face.

    It is 1 for texels with the normal of the patch, and 0 for those that face away.

    Args:
        cosine: (N,) cosine of the angle between the normals of texel and patch.
    """
    transparent_cosine, opaque_cosine = FACING_COSINES
    fraction = (cosine - transparent_cosine) / (opaque_cosine - transparent_cosine)
    return _smooth_step(torch.from_numpy(fraction.astype(np.float32)))


def _make_frame(
    normal: assets.Float64Array, upwards: assets.Float64Array
) -> assets.Float64Array:
    """Return a right-handed frame (3, 3), whose rows are right, up and the normal.

    Up is `upwards` without its component along the normal. If both are parallel, the
    axis that is most nearly perpendicular to the normal replaces `upwards`.
    """
    up = upwards - float(upwards @ normal) * normal
    if float(np.linalg.norm(up)) < 1e-6:
        up = np.eye(3)[int(np.abs(normal).argmin())]
        up = up - float(up @ normal) * normal
    up = up / np.linalg.norm(up)
    return np.stack([np.cross(up, normal), up, normal])


def unroll_surface(
    offsets: assets.Float64Array,
    normals: assets.Float64Array,
    frame: assets.Float64Array,
) -> tuple[assets.Float64Array, assets.Float64Array]:
    """Unroll a surface around a point, as one unrolls a label from a bottle.

    The surface is treated as a cylinder of radius R. If the normal has turned by the
    angle phi, a point is R sin(phi) away in the tangent plane at the center, but R phi
    away along the surface. So the component in the direction of turning is stretched by
    phi / sin(phi).

    Args:
        offsets: (N, 3) offsets of the points from the center.
        normals: (N, 3) unit normals at the points.
        frame: (3, 3) rows right, up and normal at the center.

    Returns:
        Coordinates (N, 2) to the right and upwards, and cosines (N,) with the normal of
        the frame.
    """
    in_plane = offsets @ frame[:2].T  # (N, 2)
    tilt = normals @ frame[:2].T  # (N, 2)
    cosine = normals @ frame[2]
    sine = np.linalg.norm(tilt, axis=1)
    turn_direction = tilt / np.maximum(sine, 1e-9)[:, None]
    stretch = _compute_stretch(sine, cosine)
    along_turn = (in_plane * turn_direction).sum(axis=1)
    # by how much the stretch changes the component along the turn
    extension = ((stretch - 1.0) * along_turn)[:, None] * turn_direction
    return in_plane + extension, cosine


def _compute_stretch(
    sine: assets.Float64Array, cosine: assets.Float64Array
) -> assets.Float64Array:
    """Return phi / sin(phi) (N,) by sine and cosine of phi, and 1 on a flat surface.

    The cosine is limited, so that phi stays below 90 degrees. Texels beyond are not
    painted (`FACING_COSINES`).
    """
    phi = np.arctan2(sine, np.maximum(cosine, 0.1))
    return np.where(sine > 1e-4, phi / np.maximum(np.sin(phi), 1e-9), 1.0)


def _average_in_pixels(colors: Tensor, positions: Tensor, side: int) -> Tensor:
    """Average colors over the pixels of a square image in which they lie.

    Args:
        colors: (N, 3).
        positions: (N, 2) column and row of each color, in [0, 1].
        side: number of pixels along a side.

    Returns:
        (side * side, 3), row by row; a pixel without any color has the nearest one.
    """
    column, row = (positions * side).long().clamp(0, side - 1).T
    index = row * side + column
    sums = torch.zeros(side * side, 3).index_add(0, index, colors)
    counts = torch.zeros(side * side).index_add(0, index, torch.ones(len(index)))
    means = sums / counts.clamp_min(1.0)[:, None]
    line = torch.arange(side) + 0.5
    grid = torch.meshgrid(line, line, indexing="ij")
    # (row, column) of each pixel's center, so positions need the same order
    centers = torch.stack(grid, dim=-1).reshape(-1, 2)
    tree = spatial.cKDTree(positions.flip(1).numpy())
    _, nearest = tree.query(centers.numpy() / side)
    has_color = counts[:, None] > 0.0
    return torch.where(has_color, means, colors[torch.from_numpy(nearest)])


def _rotate(coordinates: Tensor, degrees: Tensor) -> Tensor:
    """Return coordinates (N, 2) in the axes of a patch.

    The patch is turned counter-clockwise by `degrees` (), so that coordinates turn
    clockwise.
    """
    angle = torch.deg2rad(degrees)
    cosine = torch.cos(angle)
    sine = torch.sin(angle)
    x, y = coordinates.T
    return torch.stack([x * cosine + y * sine, y * cosine - x * sine], dim=1)


def _rasterise_finely(
    mesh: assets.Mesh, texture_side: int, pixel_size: float
) -> images.Charts:
    """Rasterise a mesh into a map whose texels are smaller than pixels of the patch.

    The side of the map is that of the texture, but at least the smaller one of
    `MAP_SIDES`. It is doubled as often as needed, up to the larger one of `MAP_SIDES`.

    Args:
        mesh: mesh of the object.
        texture_side: longer side of its own texture, texels.
        pixel_size: side of a pixel, object sizes.
    """
    min_side, max_side = MAP_SIDES
    first_side = max(min_side, texture_side)
    charts = images.rasterize_charts(mesh, first_side)
    areas = charts.compute_areas()
    # side of a median texel of the first map, in object sizes
    spacing = math.sqrt(float(np.median(areas[areas > 0.0])))
    map_side = first_side
    while 2 * map_side <= max_side and spacing * first_side / map_side > pixel_size:
        map_side *= 2
    return charts if map_side == first_side else images.rasterize_charts(mesh, map_side)


def _smooth_step(value: Tensor) -> Tensor:
    """Return the smooth step `3 t^2 - 2 t^3` from 0 at 0 to 1 at 1."""
    clipped = value.clamp(0.0, 1.0)
    return clipped.square() * (3.0 - 2.0 * clipped)


def _resize_to_square(base: Tensor, side: int) -> Tensor:
    """Resize a base color (h, w, 3) to (side, side, 3); differentiable."""
    return images.resized(base, side, side, antialias=max(base.shape[:2]) > side)
