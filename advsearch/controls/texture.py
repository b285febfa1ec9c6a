"""The `texture` control: the base-color map of a mesh, in a ball around the original.

It has three forms:

    texels     u = texel values, display-referred sRGB in [0, 1];   ||u - original||_p <= epsilon
    palette    u = k colors in a ball around those of the original
               texel = original + sum_i w_i(texel) (u_i - c_i)
    waves      u = (a + 1) / 2 per wave and channel
               texel = original + r tanh(sum_mn s_mn a_mn cos_m(x) cos_n(y))

The reflectance is linear(texel). Bounded changes of a texture are from REVAMP and from
Athalye et al. (2018, arXiv 1707.07397, section 3). The L2 norm is the Euclidean norm of
all texel values: with a radius of `r * sqrt(3 h w)`, their root mean square can reach r.
The palette follows Chang et al. (2015, "Palette-based Photo Recoloring", sections 3.2
and 3.4), in sRGB and normalized. The waves are the low-frequency search of Guo et al.
(2019, arXiv 1809.08758, section 3).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch.controls.base import (
    MAX_EPSILON,
    NO_INPUTS,
    Choice,
    Control,
    Parameter,
    Value,
    describe_color_change,
)
from advsearch.controls.support.images import resize_to_square
from advsearch.controls.support.norms import (
    DEFAULT_EPSILON,
    NORMS,
    compute_default_radius,
)
from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.assets import BoolArray, Float32Array, Float64Array
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.description import OBJECT, SceneDescription
from advsearch.scene.gradients import Budget, Group
from advsearch.scene.parts import MeshPart
from advsearch.scene.raster import find_exclusive_texels, rasterize_charts

# limits of the default resolution, which is the side of the object's own texture
RESOLUTIONS = (256, 512)
FORMS = ("texels", "palette", "waves")
MAX_WAVES = 64
MAX_PALETTE = 64
LLOYD_STEPS = 30
# smallest fraction of the texels of materials that no other material may use
MIN_EXCLUSIVE_FRACTION = 0.5
WAVE_REACH = 3.0
"""Argument of the tanh for the constant wave at its largest amplitude. tanh(3) is 0.995,
so that this wave alone can reach the ball's radius.
"""


class TextureControl(Control):
    """The base-colour map of the object or another mesh, in a ball around the original.

    Attributes:
        form: one of `FORMS`, the meaning of the coordinates.
        _mesh_name: name of the mesh that is painted.
        _materials: names of the materials that are painted; "" for all of the mesh.
        _original: (h, w, 3) sRGB, the original texture at the search's resolution.
        _painted_mask: (h, w) mask of the texels that are painted; None for all.
        _painter: map from u to these texels.
        _unchanged_texels: (n, 3) painted texels at the start, with which `describe`
            compares others.
    """

    kind = "texture"
    targets_mesh = True
    parameters = (
        Parameter(
            "texels",
            (None, None, 3),
            "sRGB",
            0.0,
            1.0,
            "the object's own texture",
            "Display-referred texel values.",
            search=(0.0, 1.0),
            estimators=("adjoint",),
        ),
        Parameter(
            "palette",
            (None, 3),
            "sRGB",
            0.0,
            1.0,
            "the texture's own colours",
            "Colours that the texture is repainted with (form palette).",
            search=(0.0, 1.0),
            estimators=("adjoint", "differences"),
        ),
        Parameter(
            "amplitudes",
            (None, None, 3),
            "1",
            -1.0,
            1.0,
            0.0,
            "Amplitude of each wave in each colour channel (form waves).",
            search=(-1.0, 1.0),
            estimators=("adjoint",),
        ),
    )
    choices = (
        Choice(
            "epsilon",
            DEFAULT_EPSILON,
            "Radius of the ball around the original texture, display-referred.",
            "epsilon",
            max_value=MAX_EPSILON,
        ),
        Choice(
            "norm",
            "linf",
            "Norm of the ball: linf (per texel value) or l2 "
            "(Euclidean, over all texel values).",
            "norm",
            options=NORMS,
        ),
        Choice(
            "resolution",
            None,
            "Side of the searched texture in texels; by default "
            "the object's own, 256 to 512.",
            "texture_resolution",
            integer_bounds=(2, 4096),
        ),
        Choice(
            "form",
            "texels",
            "What is searched: texels, palette (a few colours) or "
            "waves (smooth patterns).",
        ),
        Choice(
            "colors",
            6,
            "Number of colours of the palette.",
            integer_bounds=(1, MAX_PALETTE),
        ),
        Choice(
            "waves",
            8,
            "Number of waves along each side of the texture.",
            integer_bounds=(1, MAX_WAVES),
        ),
        Choice(
            "materials",
            None,
            "Materials of the mesh's file that are painted, by "
            "name; by default all of it.",
        ),
    )

    def check_choices(self) -> None:
        """Check the form and the names of materials.

        `materials` becomes a list without duplicates, as one name may be given as text.

        Raises:
            InputError: the form is not possible, or `materials` are no names.
        """
        self.form = self.select_form(FORMS)
        names = self.choice_values["materials"]
        if names is None:
            return
        if isinstance(names, str):
            names = [names]
        self._check_are_names(names)
        self.choice_values["materials"] = list(dict.fromkeys(names))

    def _check_are_names(self, names: object) -> None:
        """Raise InputError if the choice `materials` is no list of names."""
        is_list_of_names = (
            isinstance(names, Sequence)
            and len(names) > 0
            and all(isinstance(name, str) for name in names)
        )
        if not is_list_of_names:
            raise InputError(
                f"{self.name}.materials: expected names of materials, got "
                f"{names!r}; put quotes around a "
                "name that reads as a number"
            )

    def get_mesh(self, scene: SceneDescription) -> MeshPart:
        """Return the mesh that the control paints.

        The name after the colon, as in "texture:chair", is that of a mesh; or if there is
        no such mesh, that of a material of the object.

        Raises:
            UnknownNameError: it is neither.
        """
        # none if there is a mesh of that name
        if self._find_named_materials(scene):
            return scene.meshes[OBJECT]
        try:
            return super().get_mesh(scene)
        except UnknownNameError:
            materials = scene.object.mesh.materials
            hint = f"It stands in `controls` {self.name}."
            kind = "mesh of the scene"
            if materials:
                kind += " or material of the object"
            known = [*scene.meshes, *materials]
            raise UnknownNameError(kind, self.mesh_name, known, hint) from None

    def _find_named_materials(self, scene: SceneDescription) -> list[str]:
        """Return the materials of the object that the control is named after.

        "texture:paint" means the material "paint", by its own name or as the command
        line writes it. The list is empty if there is none, or if a mesh has that name.
        """
        # imported here, as it takes time and most runs do not need it
        from advsearch.scene.importing.files import sanitize_name

        name_after_colon = self.mesh_name  # of a mesh or a material
        if name_after_colon in scene.meshes:
            return []
        return [
            material
            for material in scene.object.mesh.materials
            if name_after_colon in (material, sanitize_name(material))
        ]

    def list_materials(self, scene: SceneDescription) -> list[str] | None:
        """Return the materials that it paints in a scene; None for all of the mesh."""
        return self._find_named_materials(scene) or self.choice_values["materials"]

    def bind_parameters(self) -> None:
        """Find the texels that are painted, and make the painter of the control's form.

        Raises:
            InputError, UnknownNameError: materials cannot be painted, or are unknown.
        """
        part = self.get_mesh(self.scene)
        names = self.list_materials(self.scene)  # None for all of them
        self._original = self._resample_original(part, names)
        shape = (self._original.shape[0], self._original.shape[1])
        self._painted_mask = None
        mask = torch.ones(shape, dtype=torch.bool)  # all texels
        if names is not None:
            mask = torch.from_numpy(self._find_painted_texels(part, names, shape))
            self._painted_mask = mask
        self._mesh_name = part.name
        self._materials = ", ".join(names or ())  # as results describe them
        self._painter = self._make_painter(part, mask)
        # What the painter returns without a change. Rounding makes it differ a little from
        # `_original`, which would count as a change.
        self._unchanged_texels = self._painter.paint_texels(self._painter.start)
        self.start = self._painter.start
        self.groups = (self._painter.group,)

    def _resample_original(
        self, part: MeshPart, materials: Sequence[str] | None
    ) -> Tensor:
        """Return the original texture (h, w, 3) sRGB at the resolution of the search.

        It is resized to a square, whose side the user sets. By default that is the
        longer side of the texture, within the limits `RESOLUTIONS`. But if only some
        materials are painted, a texture that is at least as large as the lower limit is
        not resized by default, so that the other materials stay exactly the same.

        Args:
            part: mesh with the texture.
            materials: materials that are painted; None for the full texture.
        """
        original = torch.from_numpy(part.base_color.copy())
        longer_side = max(original.shape[:2])
        resolution = self.choice_values["resolution"]
        min_side, max_side = RESOLUTIONS
        paints_some_materials = materials is not None
        is_small = longer_side < min_side
        if not resolution and paints_some_materials and not is_small:
            return original
        default = min(max(longer_side, min_side), max_side)
        return resize_to_square(original, int(resolution or default))

    def _make_painter(self, part: MeshPart, mask: Tensor) -> Painter:
        """Return what paints the texels: a palette, waves, or each texel by itself.

        Args:
            part: the mesh; the areas of its texels weight the colors of a palette.
            mask: (h, w) bool, texels that are painted.
        """
        texels = self._original[mask]
        if self.form == "palette":
            return self._make_palette(part, mask)
        if self.form == "waves":
            return self._make_waves(texels, mask)
        norm = self.choice_values["norm"]
        budget = Budget(norm, self._compute_radius(norm, texels.numel()))
        group = Group("texels", texels.numel(), ("adjoint",), budget)
        # The coordinates are the texel values themselves.
        return Painter(texels.reshape(-1), group, to_texels)

    def _make_waves(self, texels: Tensor, mask: Tensor) -> Painter:
        """Return what adds waves to the texels.

        Args:
            texels: (n, 3) sRGB, the texels that are painted.
            mask: (h, w) bool, texels that are painted.
        """
        norm = self.choice_values["norm"]
        max_change = self._compute_radius(norm, texels.numel())
        if norm == "l2":
            # Waves limit each change. If n changes are at most radius / sqrt(n),
            # their norm is at most the radius.
            max_change = max_change / math.sqrt(texels.numel())
        n_waves = int(self.choice_values["waves"])
        return make_wave_painter(texels, mask, n_waves, max_change)

    def _make_palette(self, part: MeshPart, mask: Tensor) -> Painter:
        """Return the painter that changes a few colors; see `_make_painter`."""
        norm = self.choice_values["norm"]
        weight = _compute_texel_areas(part, mask)
        n_colors = int(self.choice_values["colors"])
        centers = compute_palette(self._original, weight, n_colors)
        budget = Budget(norm, self._compute_radius(norm, centers.numel()))
        return make_palette_painter(self._original[mask], centers, budget)

    def _compute_radius(self, norm: str, count: int) -> float:
        """Return how far `count` values may go from the original, in a norm."""
        epsilon = self._settings.get("epsilon")
        if epsilon is None:
            return compute_default_radius(norm, count)
        return float(epsilon)

    def _find_painted_texels(
        self, part: MeshPart, names: Sequence[str], shape: tuple[int, int]
    ) -> BoolArray:
        """Return a mask (h, w) of the texels that only the painted materials use.

        Texels that other materials use as well are not painted.

        Args:
            part: mesh with the materials.
            names: names of the materials to paint.
            shape: height and width of the texture.

        Raises:
            InputError: the mesh has no materials, or too many of the texels are shared.
            UnknownNameError: it has no such material.
        """
        known = part.mesh.materials
        self._check_materials_exist(part, names)
        faces = np.concatenate([known[name] for name in names])
        mask, fraction = find_exclusive_texels(part.mesh, faces, shape)
        if fraction < MIN_EXCLUSIVE_FRACTION:
            raise self._make_shared_error(names, fraction)
        return mask

    def _check_materials_exist(self, part: MeshPart, names: Sequence[str]) -> None:
        """Raise an error if a mesh has no materials, or none of a name."""
        known = part.mesh.materials
        owner = "the object" if part.name == OBJECT else part.name
        if not known:
            raise InputError(
                f"{self.name}.materials: {owner} has no materials with "
                "names; leave materials out"
            )
        for name in names:
            if name not in known:
                raise UnknownNameError(f"material of {owner}", name, known)

    def _make_shared_error(self, names: Sequence[str], fraction: float) -> InputError:
        """Return the error for materials with too few texels of their own.

        `fraction` of their texels are used by no other material.
        """
        shared = f"{100 * (1 - fraction):.0f}"
        remedy = ""
        # Texels of a low resolution may lie in several materials. Without the setting,
        # the texture has its full resolution.
        if self.choice_values["resolution"]:
            remedy = "take a higher resolution, "
        return InputError(
            f"{self.name}.materials: other materials use {shared} % of the texels "
            "of "
            f"{', '.join(names)} too, so that it cannot be painted separately; "
            "assign different texels to each material in "
            f"the file, {remedy}or leave materials out"
        )

    def inputs(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Tensor]:
        return {
            f"{self._mesh_name}.base_color": srgb_to_linear(self._compute_texture(u))
        }

    def _compute_texture(self, u: Tensor) -> Tensor:
        """Return the full texture (h, w, 3) at a slice of u.

        Texels that are not painted have their original color.
        """
        painted = self._painter.paint_texels(u)
        original = self._original.to(u.device)
        if self._painted_mask is None:
            return painted.reshape(original.shape)
        indices = self._painted_mask.to(u.device).nonzero(as_tuple=True)
        return original.index_put(indices, painted)

    def describe(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Value]:
        """Return how much the texels change, and which materials are painted."""
        texels = self._painter.paint_texels(u.detach())
        change = texels - self._unchanged_texels.to(u.device)
        described: dict[str, Value] = {}
        if self._materials:
            described[f"{self.name}.materials"] = {
                "value": self._materials,
                "unit": "name",
            }
        return described | describe_color_change(self.name, change)

    def get_printable_colors(self, u: Tensor) -> Tensor | None:
        texels = self._compute_texture(u)
        if self._painted_mask is None:
            return texels
        return torch.cat([texels, self._painted_mask.to(texels)[..., None]], dim=-1)

    def get_artifact_images(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Tensor]:
        return {
            self.name: self._compute_texture(u.detach()),
            f"{self.name}-original": self._original,
        }


class Painter(NamedTuple):
    """A map from coordinates u to the n texels that are painted, row by row."""

    start: Tensor  # (d,) float32, the coordinates of the original texture
    group: Group  # the group of these coordinates
    # Function from coordinates (d,) in [0, 1] to texels (n, 3), display-referred sRGB in
    # [0, 1]. It is differentiable, and can be pickled for worker processes.
    paint_texels: Callable[[Tensor], Tensor]


def _compute_texel_areas(part: MeshPart, mask: Tensor) -> Float32Array:
    """Return the area (h, w) that each texel of a mask covers on the surface.

    Without any area, each texel of the mask counts 1.
    """
    is_painted = mask.numpy()
    charts = rasterize_charts(part.mesh, (mask.shape[0], mask.shape[1]))
    areas = np.where(is_painted, charts.compute_areas(), 0.0).astype(np.float32)
    return areas if areas.any() else is_painted.astype(np.float32)


def to_texels(u: Tensor) -> Tensor:
    """Return coordinates (3 n,) as texels (n, 3)."""
    return u.reshape(-1, 3)


def make_palette_painter(original: Tensor, centers: Tensor, budget: Budget) -> Painter:
    """Return a painter that changes a few colors, and all texels that resemble them.

    A texel changes by a weighted mean of the changes of all palette colors. Colors that
    are near to its own have the largest weights.

    Args:
        original: (n, 3) sRGB, the texels.
        centers: (k, 3) sRGB, the palette of the original texture.
        budget: norm ball around the palette.
    """
    squared_distance = (original[..., None, :] - centers).square().sum(dim=-1)  # (n, k)
    # Weights are Gaussians of the distance between colors, which sum to 1. Their standard
    # deviation is half the mean distance from a palette color to the nearest other one.
    # With a single color any value will do, since the only weight is 1.
    std = 1.0
    if len(centers) > 1:
        # Colors are in [0, 1], so that 10 is more than any distance. It is added to the
        # distance of each color from itself, which is then never the smallest.
        large_diagonal = torch.diag(torch.full((len(centers),), 10.0))
        distances = torch.cdist(centers, centers) + large_diagonal
        std = max(0.5 * float(distances.min(dim=1).values.mean()), 1e-3)
    weights = torch.softmax(-squared_distance / (2.0 * std**2), dim=-1)
    group = Group("palette", centers.numel(), ("adjoint", "differences"), budget)
    paint_texels = partial(_paint_palette, original, weights, centers)
    return Painter(centers.reshape(-1), group, paint_texels)


def _paint_palette(
    original: Tensor, weights: Tensor, centers: Tensor, u: Tensor
) -> Tensor:
    """Return the texels (n, 3) for a changed palette.

    Each texel changes by the changes of the palette's colors, times its weights.

    Args:
        original: (n, 3) texels with the original palette.
        weights: (n, k) weight of each color for each texel.
        centers: (k, 3) original palette.
        u: (3 k,) coordinates, which are the colors of the changed palette.
    """
    palette = u.reshape(-1, 3)
    change = weights.to(u.device) @ (palette - centers.to(u.device))
    return (original.to(u.device) + change).clamp(0.0, 1.0)


def make_wave_painter(
    original: Tensor, mask: Tensor, count: int, radius: float
) -> Painter:
    """Return a painter that adds cosine waves to a texture.

    The change is a sum of products of a wave down and a wave to the right, limited by a
    tanh. A coordinate of u is the amplitude of one product in one channel. 0.5 means
    the amplitude 0; the amplitude at the bounds decreases with the frequency.

    Args:
        original: (n, 3) sRGB, the texels that are painted.
        mask: (h, w) bool, the texels that are painted.
        count: number of waves along each side; wave m (from 0) has m half periods.
        radius: largest change of a texel value.
    """
    height, width = mask.shape
    down = _make_cosine_waves(height, count)
    right = _make_cosine_waves(width, count)
    # of each product, in half periods
    wave_index = torch.arange(count).float()
    frequency = torch.hypot(wave_index[:, None], wave_index[None, :])
    max_amplitude = (WAVE_REACH / (1.0 + frequency))[..., None]  # (count, count, 1)
    start = torch.full((count * count * 3,), 0.5)
    group = Group("amplitudes", len(start), ("adjoint",))
    waves = (down, right, max_amplitude)
    paint_texels = partial(_paint_waves, original, mask, radius, waves)
    return Painter(start, group, paint_texels)


def _make_cosine_waves(side: int, count: int) -> Tensor:
    """Return cosine waves (side, count) along a side; wave m has m half periods."""
    wave_index = torch.arange(count)
    return torch.cos(math.pi * (torch.arange(side) + 0.5)[:, None] * wave_index / side)


def _paint_waves(
    original: Tensor,
    mask: Tensor,
    radius: float,
    waves: tuple[Tensor, Tensor, Tensor],
    u: Tensor,
) -> Tensor:
    """Return the texels (n, 3) with waves added.

    Args:
        original: (n, 3) sRGB, the painted texels without waves, row by row.
        mask: (h, w) bool, texels that are painted.
        radius: largest change of a texel value.
        waves: the waves down (h, k) and to the right (w, k), and the largest amplitude
            (k, k, 1) of each product.
        u: (3 k^2,) amplitudes, as coordinates in [0, 1].
    """
    down, right, max_amplitude = (wave.to(u.device) for wave in waves)
    n_down, n_right, _ = max_amplitude.shape
    # (k, k, 3): of wave m down times wave n to the right, in channel c
    amplitudes = (2.0 * u - 1.0).reshape(n_down, n_right, 3) * max_amplitude
    wave_sum = torch.einsum("hm,wn,mnc->hwc", down, right, amplitudes)
    change = radius * torch.tanh(wave_sum[mask.to(u.device)])
    return (original.to(u.device) + change).clamp(0.0, 1.0)


def compute_palette(image: Tensor, weight: Float32Array, count: int) -> Tensor:
    """Return the colors of an image by weighted k-means, heaviest first.

    Lloyd's algorithm runs on the image's colors, reduced to 5 bits a channel. It starts
    from k-means++ (Arthur and Vassilvitskii 2007) without randomness: the first center
    is the heaviest color, each next one the color with the largest weight times squared
    distance from the nearest center.

    Args:
        image: (h, w, 3) sRGB in [0, 1].
        weight: (h, w) how much each texel counts, e.g. its area on the surface.
        count: number of colors, at least 1.

    Returns:
        (k, 3) float32 with k <= count: fewer if the image has fewer colors.
    """
    # The mass of a color is the square root of its weight.
    points, mass = _quantise_colors(image, weight)
    centers = points[_choose_first_centers(points, mass, count)]
    for _ in range(LLOYD_STEPS):
        nearest = ((points[:, None] - centers) ** 2).sum(axis=-1).argmin(axis=1)
        center_mass = np.bincount(nearest, weights=mass, minlength=len(centers))
        sums = _sum_colors(nearest, points, mass, len(centers))
        means = sums / np.maximum(center_mass[:, None], 1e-12)
        # a center without colors stays where it is
        centers = np.where(center_mass[:, None] > 0.0, means, centers)
    # by the masses of the last step, before the centers moved once more
    order = np.argsort(-center_mass, kind="stable")
    return torch.from_numpy(centers[order].clip(0.0, 1.0).astype(np.float32))


def _sum_colors(
    group_of_color: npt.NDArray[np.intp],
    colors: Float64Array,
    weights: Float64Array,
    n_groups: int,
) -> Float64Array:
    """Return the weighted sum (n_groups, 3) of the colors in each group.

    Args:
        group_of_color: (N,) index of the group of each color.
        colors: (N, 3) colors.
        weights: (N,) their weights.
        n_groups: number of groups.
    """
    sums = [
        np.bincount(group_of_color, weights * colors[:, channel], n_groups)
        for channel in range(3)
    ]
    return np.stack(sums, axis=1)


def _quantise_colors(
    image: Tensor, weight: Float32Array
) -> tuple[Float64Array, Float64Array]:
    """Return the different colors (N, 3) of an image, and their mass (N,).

    Colors that are equal after rounding to 5 bits a channel are averaged, by their
    weights. The mass of such a mean is the square root of their total weight. (If it
    were the weight itself, a large surface would get all centers of the palette.)
    Colors without weight are left out.

    Args:
        image: (h, w, 3) sRGB in [0, 1].
        weight: (h, w) weight of each texel, such as its area.
    """
    colors = image.reshape(-1, 3).double().numpy()
    weights = weight.reshape(-1).astype(np.float64)
    levels = (colors * 31.0).round().astype(np.int64)
    cells, cell_index = np.unique(levels, axis=0, return_inverse=True)
    cell_index = cell_index.reshape(-1)
    cell_weight = np.bincount(cell_index, weights=weights, minlength=len(cells))
    sums = _sum_colors(cell_index, colors, weights, len(cells))
    has_weight = cell_weight > 0.0
    points = sums[has_weight] / cell_weight[has_weight, None]
    return points, np.sqrt(cell_weight[has_weight])


def _choose_first_centers(
    points: Float64Array, mass: Float64Array, count: int
) -> list[int]:
    """Choose the points from which k-means starts; return their indices.

    The first is the heaviest. Each next one has the largest mass times squared distance
    from the nearest chosen one. There are fewer than `count` if no other color is left.

    Args:
        points: (N, 3) colors.
        mass: (N,) weight of each color.
        count: largest number of points.
    """
    chosen = [int(mass.argmax())]
    while len(chosen) < min(count, len(points)):
        # (N,) from each point to the nearest chosen one
        squared_distance = (
            ((points[:, None] - points[chosen]) ** 2).sum(axis=-1).min(axis=1)
        )
        if not squared_distance.max() > 0.0:
            break
        chosen.append(int((mass * squared_distance).argmax()))
    return chosen
