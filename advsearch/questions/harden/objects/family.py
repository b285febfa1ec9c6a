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
"""Steps of the search for the largest scale of the charts."""
GUTTER = 2
"""Texels around each chart, on every side."""
DECIMALS = 6
"""Decimals of rounded coordinates: machines differ in the last bits of a sine."""


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

    The highest rectangle comes first. A rectangle goes on the lowest shelf that has room
    for it, or opens a new shelf on top of the others. This is not always the best
    packing, but the same on every machine.

    Args:
        sizes: (width, height) of each rectangle, width >= height, in object units.
        scale: texels per unit.
        side: side of the square in texels.

    Returns:
        The rectangles in the order of `sizes`, with gutters, in texels.
    """
    texel_sizes = [
        (_to_texels(width, scale), _to_texels(height, scale)) for width, height in sizes
    ]
    rectangles: dict[int, AtlasRectangle] = {}
    shelves: list[_Shelf] = []
    for index in _sort_highest_first(texel_sizes):
        width, height = texel_sizes[index]
        shelf = _find_shelf(shelves, width, height, side)
        if shelf is None:
            return None
        rectangles[index] = AtlasRectangle(
            x=shelf.filled, y=shelf.bottom, width=width, height=height, is_rotated=False
        )
        shelf.filled += width
    return [rectangles[index] for index in range(len(sizes))]


def _sort_highest_first(sizes: Sequence[tuple[int, int]]) -> list[int]:
    """Return the indices of rectangles (width, height) by decreasing height, then width.

    Equal rectangles stay in their order.
    """
    return sorted(
        range(len(sizes)), key=lambda index: (-sizes[index][1], -sizes[index][0], index)
    )


def _find_shelf(
    shelves: list[_Shelf], width: int, height: int, side: int
) -> _Shelf | None:
    """Return the lowest shelf with room for a rectangle; None if there is no room at all.

    If no shelf has room, a new one is added on top of the others.

    Args:
        shelves: shelves from bottom to top, each at least `height` high.
        width, height: size of the rectangle, in texels.
        side: side of the square, in texels.
    """
    if width > side:
        return None
    fitting_shelves = [shelf for shelf in shelves if shelf.filled + width <= side]
    if fitting_shelves:
        return fitting_shelves[0]
    top = shelves[-1].bottom + shelves[-1].height if shelves else 0
    if top + height > side:
        return None
    shelves.append(_Shelf(bottom=top, height=height, filled=0))
    return shelves[-1]


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
    # Machines differ in the last bits: with rounded sizes all get the same packing.
    exact_sizes = [
        (round(width, DECIMALS), round(height, DECIMALS)) for width, height in sizes
    ]
    lying_sizes = [(max(size), min(size)) for size in exact_sizes]
    best = _pack_at_largest_scale(lying_sizes, side)
    if best is None:
        raise ValueError(
            f"{len(sizes)} charts do not fit an atlas of {side} texels; "
            "use fewer patches"
        )
    return [
        replace(rectangle, is_rotated=height > width)
        for rectangle, (width, height) in zip(best, exact_sizes, strict=True)
    ]


def _pack_at_largest_scale(
    sizes: Sequence[tuple[float, float]], side: int
) -> list[AtlasRectangle] | None:
    """Find the largest scale by bisection; None if not even the gutters fit.

    Args:
        sizes: (width, height) of each chart, width >= height, in object units.
        side: side of the atlas in texels.
    """
    lower_scale = 0.0  # at this scale, charts are only their gutters
    # At this scale the widest chart is as wide as the square: no larger one can fit.
    upper_scale = side / max(width for width, _ in sizes)
    best = _shelves(sizes, lower_scale, side)
    for _ in range(N_BISECTIONS):
        scale = (lower_scale + upper_scale) / 2
        rectangles = _shelves(sizes, scale, side)
        if rectangles is None:
            upper_scale = scale
        else:
            lower_scale = scale
            best = rectangles
    return best


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
        area = np.s_[
            rectangle.y : rectangle.y + rectangle.height,
            rectangle.x : rectangle.x + rectangle.width,
        ]
        image[area] = _paint_chart(patch, rectangle, paints[patch.tag])
        is_used[area] = True
    # The rest gets the mean color. It is rounded, since machines differ in the last
    # bits.
    image[~is_used] = np.round(image[is_used].mean(axis=0), 2)
    return _round_to_levels(image[::-1])


def _paint_chart(patch: Patch, rectangle: AtlasRectangle, paint: Paint) -> Array:
    """Return the colors (height, width, 3) of the chart of a patch, row 0 at the bottom.

    Args:
        patch: patch of the object.
        rectangle: where its chart is in the atlas.
        paint: paint of the patch.
    """
    u, v = _chart_coordinates(rectangle)
    color = paint(Texels(patch.compute_rest_points(u, v), u, v, patch.size))
    return color.reshape(rectangle.height, rectangle.width, 3)


def _round_to_levels(image: Array) -> npt.NDArray[np.float32]:
    """Round an image to multiples of 1/255."""
    # Rounded to 4 decimals first: else a level near a half might be rounded up on one
    # machine and down on another.
    stable_levels = np.round(image * 255.0, 4)
    # The conversion to integers truncates. With 1/2 added it rounds.
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
    """Join patches into a mesh with a largest extent of 1 that stands on z = 0.

    It is centered in x and y. Every value is rounded to `DECIMALS` decimals, so that
    all machines make the same file.

    Args:
        patches: patches of the object.
        rectangles: where the chart of each patch is in the atlas.
        side: side of the atlas, in texels.
    """
    all_uvs = [
        _atlas_coordinates(patch, rectangle, side)
        for patch, rectangle in zip(patches, rectangles, strict=True)
    ]
    faces = _join_faces(patches)
    uvs = np.concatenate(all_uvs)
    normals = np.concatenate([patch.normals for patch in patches])
    vertices = np.concatenate([patch.vertices for patch in patches])
    # the point below the center, at the lowest height, and the largest extent
    origin, extent = assets.find_footing(vertices)
    return _make_compact_mesh((vertices - origin) / extent, faces, normals, uvs)


def _make_compact_mesh(
    vertices: Array, faces: assets.IntArray, normals: Array, uvs: Array
) -> assets.Mesh:
    """Return a mesh of rounded values without the vertices that no triangle has.

    There are such vertices at poles.

    Args:
        vertices: positions (V, 3).
        faces: vertex indices (F, 3).
        normals: (V, 3).
        uvs: texture coordinates (V, 2).
    """
    # The new index of a vertex is its position in the ascending array `used`.
    used = np.unique(faces)
    renumbered_faces = np.searchsorted(used, faces).astype(np.uint32)
    return assets.Mesh(
        _round_exactly(vertices[used]),
        renumbered_faces,
        _round_exactly(normals[used]),
        _round_exactly(np.clip(uvs[used], 0.0, 1.0)),
    )


def _join_faces(patches: Sequence[Patch]) -> assets.IntArray:
    """Return the faces (F, 3) of all patches, with vertices numbered over all of them."""
    # index of the first vertex of each patch in the mesh
    first_vertex = np.cumsum([0] + [len(patch.vertices) for patch in patches[:-1]])
    all_faces = [
        patch.faces + first for patch, first in zip(patches, first_vertex, strict=True)
    ]
    return np.concatenate(all_faces)


def _atlas_coordinates(patch: Patch, rectangle: AtlasRectangle, side: int) -> Array:
    """Return the texture coordinates (V, 2) of a patch's vertices in the atlas."""
    chart_uvs = patch.uvs
    if rectangle.is_rotated:  # by 90 degrees; the rectangle has the rotated size
        chart_uvs = np.stack([1.0 - patch.uvs[:, 1], patch.uvs[:, 0]], axis=1)
    inner_size = np.array([rectangle.width - 2 * GUTTER, rectangle.height - 2 * GUTTER])
    corner = np.array([rectangle.x, rectangle.y])
    return np.asarray((corner + GUTTER + chart_uvs * inner_size) / side)


def _round_exactly(values: Array) -> npt.NDArray[np.float32]:
    """Round values to `DECIMALS` decimals, with 0 instead of -0."""
    rounded = np.round(values, DECIMALS)
    return (rounded + 0.0).astype(np.float32)  # -0.0 + 0.0 is 0.0


# ---- families
# ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Instance:
    """A member of a family before its texture is baked.

    Attributes:
        patches: patches of the surface.
        paints: a paint for every tag of the patches.
        material: parameters of the surface other than its color.
        texel_density: texels per length by tag, relative to the rest of the object:
            lower for parts that are hardly visible.
        materials_by_tag: materials by tag, if the object has several; then its tags are
            the names of materials.
        rig: moves the vertices of all patches, in the order of the patches; None if the
            object has no pose.
        drives: whether it moves as a vehicle does, see `ObjectAsset.drives`.
    """

    patches: Sequence[Patch]
    paints: Mapping[str, Paint]
    material: assets.Material
    texel_density: Mapping[str, float] = field(default_factory=dict)
    materials_by_tag: Mapping[str, assets.Material] = field(default_factory=dict)
    rig: assets.MeshRig | None = None
    drives: bool = False


@dataclass(frozen=True)
class ObjectFamily:
    """A class of objects whose members differ in proportions, texture and material.

    Attributes:
        name: name of the class, usable on the command line.
        make_instance: function that builds an instance from a `ParameterSampler`.
        unit_in_metres: length of the unit in which instances are built, in metres.
        atlas_size: width of the texture.
    """

    name: str
    make_instance: Callable[[ParameterSampler], Instance]
    unit_in_metres: float
    atlas_size: int = DEFAULT_ATLAS_SIZE

    @property
    def label(self) -> str:
        """Label of the class: the name with spaces instead of hyphens."""
        return self.name.replace("-", " ")

    def generate(self, rng: np.random.Generator | None) -> assets.ObjectAsset:
        """Return the canonical instance, or a random one, as an asset.

        The mesh has a largest extent of 1 and stands on z = 0. The same state of the
        generator gives the same asset.

        Args:
            rng: random generator that all parameters are sampled from; None for the
                canonical instance.
        """
        instance = self._make_sorted_instance(rng)
        rectangles = pack_charts(_scale_charts(instance), self.atlas_size)
        mesh = join_patches(instance.patches, rectangles, self.atlas_size)
        surface: dict[str, object] | None = None
        if instance.materials_by_tag:
            mesh, surface = _attach_materials(mesh, instance)
        base_color = paint_atlas(
            instance.patches, rectangles, instance.paints, self.atlas_size
        )
        return assets.ObjectAsset(
            name=self.name,
            mesh=mesh,
            base_color=base_color,
            material=instance.material,
            label=self.label,
            source=workbench.library.BUNDLED_OBJECT,
            surface=surface,
            finishes=instance.materials_by_tag,
            size_in_metres=self._measure_size(instance),
            drives=instance.drives,
        )

    def _make_sorted_instance(self, rng: np.random.Generator | None) -> Instance:
        """Build the canonical instance (None) or a random one.

        If it has several materials, its patches are sorted by them.
        """
        instance = self.make_instance(ParameterSampler(rng))
        return _sort_by_material(instance) if instance.materials_by_tag else instance

    def _measure_size(self, instance: Instance) -> float:
        """Return the largest extent of an instance in metres."""
        vertices = np.concatenate([patch.vertices for patch in instance.patches])
        extent = np.ptp(vertices, axis=0).max()
        return round(float(extent) * self.unit_in_metres, 4)


def _attach_materials(
    mesh: assets.Mesh, instance: Instance
) -> tuple[assets.Mesh, dict[str, object]]:
    """Return the mesh of an instance with its materials and its rig, and its surface.

    Args:
        mesh: mesh of the patches of the instance.
        instance: instance with several materials, whose patches are sorted by material.
    """
    materials = _faces_by_material(instance.patches)
    mesh = replace(mesh, materials=materials, rig=instance.rig)
    surface = workbench.library.make_finished_surface(
        mesh, instance.materials_by_tag, instance.material
    )
    return mesh, surface


def _scale_charts(instance: Instance) -> list[tuple[float, float]]:
    """Return the size of each chart, scaled by the texel density of its patch."""
    sizes = []
    for patch in instance.patches:
        density = instance.texel_density.get(patch.tag, 1.0)
        width, height = patch.size
        sizes.append((width * density, height * density))
    return sizes


def _sort_by_material(instance: Instance) -> Instance:
    """Return an instance that has `materials_by_tag` with its patches sorted by material.

    The tag of a patch is the name of its material. Materials come in the order in which
    they are used first.
    """
    tags = list(dict.fromkeys(patch.tag for patch in instance.patches))
    patches = sorted(instance.patches, key=lambda patch: tags.index(patch.tag))
    return replace(instance, patches=patches)


def _faces_by_material(patches: Sequence[Patch]) -> dict[str, assets.IntArray]:
    """Return the indices of each material's faces in the joined mesh, by its name.

    The tag of a patch is the name of its material.
    """
    tags = [patch.tag for patch in patches]
    face_counts = [len(patch.faces) for patch in patches]
    tag_of_face = np.repeat(tags, face_counts)
    return {tag: np.nonzero(tag_of_face == tag)[0] for tag in dict.fromkeys(tags)}


def make_family(
    unit_in_metres: float, texels: int = DEFAULT_ATLAS_SIZE
) -> Callable[[Callable[[ParameterSampler], Instance]], ObjectFamily]:
    """Turn a function that makes instances into a family with the function's name.

    Args:
        unit_in_metres: length in metres of the unit in which instances are built.
        texels: width of their texture.
    """
    return lambda make: ObjectFamily(
        make.__name__.replace("_", "-"), make, unit_in_metres, texels
    )


def sample_material(
    sampler: ParameterSampler,
    roughness: float,
    clearcoat: float = 0.0,
    spread: float = 0.2,
) -> assets.Material:
    """Sample a material: its roughness, sometimes its clearcoat, and rarely a metal.

    Args:
        sampler: samples the values; the canonical instance has those that are passed.
        roughness: canonical roughness.
        clearcoat: canonical clearcoat, which most other instances have, too.
        spread: maximum difference from the canonical roughness.
    """
    sampled_roughness = sampler(
        roughness, low=roughness - spread, high=roughness + spread
    )
    # Few objects have another clearcoat, and very few are partly of metal, as among
    # real objects of this kind.
    if sampler.sample_bool(0.3):
        clearcoat = sampler(clearcoat, low=0.0, high=1.0)
    is_metallic = sampler.sample_bool(0.06)
    values = {
        # at least 0.12, as the reflections of a mirror would be noisy
        "roughness": min(max(sampled_roughness, 0.12), 0.95),
        "metallic": sampler(0.0, low=0.3, high=0.8) if is_metallic else 0.0,
        "specular": sampler(0.5, low=0.3, high=0.7),
        "clearcoat": clearcoat,
    }
    return assets.Material(**{name: round(value, 4) for name, value in values.items()})
