"""Families of objects, and how the mesh and the texture of an instance are made."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from advsearch.extend import assets, workbench
from advsearch.questions.harden.objects.shapes import Array, Patch
from advsearch.questions.harden.objects.textures import Paint, ParameterSampler, Texels

# ---- the atlas
# ----------------------------------------------------------------------------------
# Charts get rectangles of a square atlas at a common scale, so that texels are equally
# large all over the object. `GUTTER` texels of their own color around them prevent
# bleeding when the texture is filtered or its resolution is halved.

DEFAULT_ATLAS_SIZE = 256
"""Default width of the atlas in texels."""
N_BISECTIONS = 12
"""Steps by which the largest scale of the charts is found."""
GUTTER = 2
"""Texels around each chart, on every side."""
DECIMALS = 6
"""Coordinates are rounded to these: machines differ in the last bits of a sine."""


@dataclass(frozen=True)
class AtlasRectangle:
    """Rectangle of a chart in the atlas.

    Attributes:
        x, y: left and bottom in texels.
        width, height: width and height in texels, gutters included.
        is_rotated: whether the chart is rotated by 90 degrees.
    """

    x: int
    y: int
    width: int
    height: int
    is_rotated: bool


@dataclass
class _Shelf:
    """A row of rectangles: its bottom, its height, and the width that is filled."""

    bottom: int
    height: int
    filled: int


def _shelves(
    sizes: Sequence[tuple[float, float]], scale: float, side: int
) -> list[AtlasRectangle] | None:
    """Pack rectangles on shelves of a square; None if they do not fit.

    The highest comes first. A rectangle goes on the lowest shelf that has room for it,
    or opens a new shelf on top of the others.

    The first shelf that has room is taken, which is not always the best packing, but
    gives the same result on every machine.

    Args:
        sizes: (width, height) of each, width >= height, in object units.
        scale: texels per unit.
        side: side of the square in texels.

    Returns:
        The rectangles in the order of `sizes`, with gutters, in texels.
    """
    texel_sizes = [
        (_to_texels(width, scale), _to_texels(height, scale)) for width, height in sizes
    ]
    # by falling height, then width; equal ones stay in their order
    highest_first = sorted(
        range(len(sizes)),
        key=lambda index: (-texel_sizes[index][1], -texel_sizes[index][0], index),
    )
    rectangles: dict[int, AtlasRectangle] = {}
    shelves: list[_Shelf] = []
    top = 0
    for index in highest_first:
        width, height = texel_sizes[index]
        if width > side:
            return None
        # Every shelf is high enough, as the highest rectangles come first.
        fitting = [shelf for shelf in shelves if shelf.filled + width <= side]
        if fitting:
            shelf = fitting[0]
        elif top + height <= side:
            shelf = _Shelf(bottom=top, height=height, filled=0)
            shelves.append(shelf)
            top += height
        else:
            return None
        rectangles[index] = AtlasRectangle(
            x=shelf.filled, y=shelf.bottom, width=width, height=height, is_rotated=False
        )
        shelf.filled += width
    return [rectangles[index] for index in range(len(sizes))]


def _to_texels(length: float, scale: float) -> int:
    """Return a length in texels, rounded up, with a gutter at both ends."""
    return int(np.ceil(length * scale)) + 2 * GUTTER


def pack_charts(
    sizes: Sequence[tuple[float, float]], side: int = DEFAULT_ATLAS_SIZE
) -> list[AtlasRectangle]:
    """Pack charts of size (width, height) into a square at the largest scale that fits.

    They have a common scale, which is found by bisection. A chart that is higher than
    wide is rotated by 90 degrees (`is_rotated`), as shelves waste less room on wide
    charts.

    Args:
        sizes: (width, height) of each chart, in object units.
        side: side of the atlas in texels.

    Raises:
        ValueError: there are too many charts for their gutters alone.
    """
    # rounded, so that machines that differ in the last bits pack alike
    exact_sizes = [
        (round(width, DECIMALS), round(height, DECIMALS)) for width, height in sizes
    ]
    lying_sizes = [(max(size), min(size)) for size in exact_sizes]
    lower_scale = 0.0  # nothing but gutters
    # At this scale the widest chart is as wide as the square: no larger one can fit.
    upper_scale = side / max(width for width, _ in lying_sizes)
    best = _shelves(lying_sizes, lower_scale, side)
    for _ in range(N_BISECTIONS):
        scale = (lower_scale + upper_scale) / 2
        rectangles = _shelves(lying_sizes, scale, side)
        if rectangles is None:
            upper_scale = scale
        else:
            lower_scale = scale
            best = rectangles
    if best is None:
        raise ValueError(
            f"{len(sizes)} charts do not fit an atlas of {side} texels; "
            "use fewer patches"
        )
    return [
        replace(rectangle, is_rotated=height > width)
        for rectangle, (width, height) in zip(best, exact_sizes, strict=True)
    ]


def paint_atlas(
    patches: Sequence[Patch],
    rectangles: Sequence[AtlasRectangle],
    paints: Mapping[str, Paint],
    side: int = DEFAULT_ATLAS_SIZE,
) -> npt.NDArray[np.float32]:
    """Paint the texture (side, side, 3) of an object, row 0 at the top.

    It is display-referred sRGB; values are multiples of 1/255.

    Args:
        patches: patches of the object.
        rectangles: where the chart of each patch is.
        paints: paints by the tags of patches.
        side: side of the texture, in texels.
    """
    image = np.zeros((side, side, 3))
    is_used = np.zeros((side, side), dtype=bool)
    for patch, rectangle in zip(patches, rectangles, strict=True):
        u, v = _chart_coordinates(rectangle)
        color = paints[patch.tag](Texels(patch.rest(u, v), u, v, patch.size))
        area = np.s_[
            rectangle.y : rectangle.y + rectangle.height,
            rectangle.x : rectangle.x + rectangle.width,
        ]
        image[area] = color.reshape(rectangle.height, rectangle.width, 3)
        is_used[area] = True
    # one color everywhere else, and rounded as machines differ in the last bits
    image[~is_used] = np.round(image[is_used].mean(axis=0), 2)
    top_down = image[::-1]
    # rounded to 4 decimals first, so that all machines round halves to the same level
    stable_levels = np.round(top_down * 255.0, 4)
    # The conversion to integers cuts: with 1/2 added it rounds.
    levels = np.clip(stable_levels + 0.5, 0.5, 255.5).astype(np.uint8)
    return np.asarray(levels.astype(np.float32) / np.float32(255.0))


def _chart_coordinates(rectangle: AtlasRectangle) -> tuple[Array, Array]:
    """Return u and v (N,) of the texels in a rectangle, row by row from the bottom."""
    along_x = np.tile(_texel_centers(rectangle.width), rectangle.height)
    along_y = np.repeat(_texel_centers(rectangle.height), rectangle.width)
    if rectangle.is_rotated:
        return along_y, 1.0 - along_x
    return along_x, along_y


def _texel_centers(count: int) -> Array:
    """Return chart coordinates (count,) of the texels along one edge of its rectangle.

    The chart goes from 0 to 1 within the gutters; in these, coordinates stay at 0 and
    1.
    """
    return np.clip((np.arange(count) + 0.5 - GUTTER) / (count - 2 * GUTTER), 0.0, 1.0)


def join_patches(
    patches: Sequence[Patch],
    rectangles: Sequence[AtlasRectangle],
    side: int = DEFAULT_ATLAS_SIZE,
) -> assets.Mesh:
    """Join patches into a mesh of largest extent 1, centered and standing on z = 0.

    Every value is rounded to `DECIMALS` decimals, so that all machines make the same
    file.

    Args:
        patches: patches of the object.
        rectangles: where the chart of each patch is in the atlas.
        side: side of the atlas, in texels.
    """
    first_vertex = np.cumsum([0] + [len(patch.vertices) for patch in patches[:-1]])
    all_faces = [
        patch.faces + first for patch, first in zip(patches, first_vertex, strict=True)
    ]
    all_uvs = [
        _atlas_coordinates(patch, rectangle, side)
        for patch, rectangle in zip(patches, rectangles, strict=True)
    ]
    faces = np.concatenate(all_faces)
    uvs = np.concatenate(all_uvs)
    normals = np.concatenate([patch.normals for patch in patches])
    vertices = np.concatenate([patch.vertices for patch in patches])
    origin, extent = assets.find_footing(vertices)
    vertices = (vertices - origin) / extent
    # Some vertices at poles belong to no triangle. They are removed, and the indices of
    # the others are renumbered without gaps.
    # No triangle uses some vertices at poles.
    used = np.unique(faces)
    renumbered_faces = np.searchsorted(used, faces).astype(np.uint32)
    return assets.Mesh(
        _exact(vertices[used]),
        renumbered_faces,
        _exact(normals[used]),
        _exact(np.clip(uvs[used], 0.0, 1.0)),
    )


def _atlas_coordinates(patch: Patch, rectangle: AtlasRectangle, side: int) -> Array:
    """Return the texture coordinates (V, 2) of a patch's vertices in the atlas."""
    chart_uvs = patch.uvs
    if rectangle.is_rotated:
        chart_uvs = np.stack([1.0 - patch.uvs[:, 1], patch.uvs[:, 0]], axis=1)
    inner_size = np.array([rectangle.width - 2 * GUTTER, rectangle.height - 2 * GUTTER])
    corner = np.array([rectangle.x, rectangle.y])
    return np.asarray((corner + GUTTER + chart_uvs * inner_size) / side)


def _exact(values: Array) -> npt.NDArray[np.float32]:
    """Round to `DECIMALS`, without negative zeros."""
    return (np.round(values, DECIMALS) + 0.0).astype(np.float32)


# ---- families
# ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Instance:
    """A member of a family before its texture is baked.

    Attributes:
        patches: the surface.
        paints: a paint for every tag of the patches.
        material: the other surface parameters.
        texel_density: texels per length by tag, relative to the rest of the object:
            less for parts that are hardly visible.
        finishes: materials by tag, of an object of several materials; its tags are then
            names of materials.
        rig: moves the vertices of all patches, in the order of the patches.
        drives: as `ObjectAsset.drives`.
    """

    patches: Sequence[Patch]
    paints: Mapping[str, Paint]
    material: assets.Material
    texel_density: Mapping[str, float] = field(default_factory=dict)
    finishes: Mapping[str, assets.Material] = field(default_factory=dict)
    rig: assets.MeshRig | None = None
    drives: bool = False


@dataclass(frozen=True)
class ObjectFamily:
    """A class of objects whose members differ in proportions, texture and material.

    Attributes:
        name: name of the class, usable on the command line.
        make: builds an instance from a `ParameterSampler`.
        size_in_metres: length of the unit in which it is built.
        texels: width of its texture.
    """

    name: str
    make: Callable[[ParameterSampler], Instance]
    size_in_metres: float
    texels: int = DEFAULT_ATLAS_SIZE

    @property
    def label(self) -> str:
        """The class in words: the name with spaces for hyphens."""
        return self.name.replace("-", " ")

    def generate(self, rng: np.random.Generator | None) -> assets.ObjectAsset:
        """Return the canonical instance (None), or a random one.

        The mesh has largest extent 1 and rests on z = 0. The same state of the
        generator gives the same asset.

        Args:
            rng: random generator that all parameters are sampled from; None for the
                canonical instance.
        """
        instance = self.make(ParameterSampler(rng))
        if instance.finishes:
            instance = _sort_by_material(instance)
        patches = instance.patches
        rectangles = pack_charts(_scale_charts(instance), self.texels)
        mesh = join_patches(patches, rectangles, self.texels)
        surface = None
        if instance.finishes:
            materials = _faces_by_material(patches)
            mesh = replace(mesh, materials=materials, rig=instance.rig)
            surface = workbench.library.make_finished_surface(
                mesh, instance.finishes, instance.material
            )
        vertices = np.concatenate([patch.vertices for patch in patches])
        extent = np.ptp(vertices, axis=0).max()
        return assets.ObjectAsset(
            name=self.name,
            mesh=mesh,
            base_color=paint_atlas(patches, rectangles, instance.paints, self.texels),
            material=instance.material,
            label=self.label,
            source=workbench.library.BUNDLED_OBJECT,
            # `size_in_metres` is the length of one unit of the patches.
            surface=surface,
            finishes=instance.finishes,
            size_in_metres=round(float(extent) * self.size_in_metres, 4),
            drives=instance.drives,
        )


def _scale_charts(instance: Instance) -> list[tuple[float, float]]:
    """Return the size of each chart, scaled by the texel density of its patch."""
    sizes = []
    for patch in instance.patches:
        density = instance.texel_density.get(patch.tag, 1.0)
        width, height = patch.size
        sizes.append((width * density, height * density))
    return sizes


def _sort_by_material(instance: Instance) -> Instance:
    """Return the instance with its patches sorted by material.

    Materials come in the order in which they are used first.
    """
    tags = list(dict.fromkeys(patch.tag for patch in instance.patches))
    patches = sorted(instance.patches, key=lambda patch: tags.index(patch.tag))
    return replace(instance, patches=patches)


def _faces_by_material(patches: Sequence[Patch]) -> dict[str, assets.IntArray]:
    """Return the indices of the faces of each tag in the joined mesh."""
    tag_of_face = np.repeat(
        [patch.tag for patch in patches], [len(patch.faces) for patch in patches]
    )
    return {
        str(tag): np.nonzero(tag_of_face == tag)[0]
        for tag in dict.fromkeys(tag_of_face)
    }


def family(
    metres: float, texels: int = DEFAULT_ATLAS_SIZE
) -> Callable[[Callable[[ParameterSampler], Instance]], ObjectFamily]:
    """Decorate a function that makes instances into a family of the function's name.

    Args:
        metres: length of the unit of its instances.
        texels: width of their texture.
    """
    return lambda make: ObjectFamily(
        make.__name__.replace("_", "-"), make, metres, texels
    )


def sample_material(
    sampler: ParameterSampler,
    roughness: float,
    clearcoat: float = 0.0,
    spread: float = 0.2,
) -> assets.Material:
    """Sample a material: its roughness, seldom its clearcoat, and rarely a metal.

    Args:
        sampler: samples it; the canonical instance has the values that are passed.
        roughness: canonical value.
        clearcoat: canonical value, which most others have, too.
        spread: how far the roughness may be from its canonical value.
    """
    sampled_roughness = sampler(
        roughness, low=roughness - spread, high=roughness + spread
    )
    # Few objects have another clearcoat, and very few are partly of metal, as among
    # real objects of this kind.
    if sampler.chance(0.3):
        clearcoat = sampler(clearcoat, low=0.0, high=1.0)
    metallic = 0.0
    if sampler.chance(0.06):
        metallic = sampler(0.0, low=0.3, high=0.8)
    values = {
        # neither a mirror, whose reflections are noisy, nor completely dull
        "roughness": min(max(sampled_roughness, 0.12), 0.95),
        "metallic": metallic,
        "specular": sampler(0.5, low=0.3, high=0.7),
        "clearcoat": clearcoat,
    }
    return assets.Material(**{name: round(value, 4) for name, value in values.items()})
