"""What a family of objects is, and how one of its instances is put together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from advsearch.extend import assets, workbench
from advsearch.questions.harden.objects.shapes import Array, Patch
from advsearch.questions.harden.objects.textures import Draw, Paint, Texels

# ---------------------------------------------------------------------------------------------------------------------
# From patches and paints to one mesh with one texture: packs the charts, paints them,
# joins the pieces.
#
# Charts get rectangles of one square atlas at one common scale, so that texels are
# equally large all over the object, with `GUTTER` texels of their own colour around
# them, so that filtering and halving the resolution do not bleed.

SIZE = 256  # texels along the atlas, where a family says nothing else
GUTTER = 2  # texels around each chart, on every side
# coordinates are rounded to this: machines differ in the last bits of a sine
DECIMALS = 6


@dataclass(frozen=True)
class AtlasPlace:
    """Where a chart lies: left, bottom, width and height in texels (gutters included);
    turned by 90 degrees or not.
    """

    x: int
    y: int
    width: int
    height: int
    turned: bool


def _shelves(
    sizes: Sequence[tuple[float, float]], scale: float, side: int
) -> list[AtlasPlace] | None:
    """Pack rectangles (w, h), w >= h, on shelves of a square, tallest first; None where
    they do not fit.
    """
    cells = [
        (int(np.ceil(w * scale)) + 2 * GUTTER, int(np.ceil(h * scale)) + 2 * GUTTER)
        for w, h in sizes
    ]
    order = sorted(range(len(cells)), key=lambda i: (-cells[i][1], -cells[i][0], i))
    places: dict[int, AtlasPlace] = {}
    shelves: list[list[int]] = []  # bottom, height, filled width
    top = 0
    for i in order:
        width, height = cells[i]
        if width > side:
            return None
        shelf = next((s for s in shelves if s[2] + width <= side), None)
        if shelf is None:
            if top + height > side:
                return None
            shelf = [top, height, 0]
            shelves.append(shelf)
            top += height
        places[i] = AtlasPlace(shelf[2], shelf[0], width, height, False)
        shelf[2] += width
    return [places[i] for i in range(len(cells))]


def pack(sizes: Sequence[tuple[float, float]], side: int = SIZE) -> list[AtlasPlace]:
    """Return a place for every chart of size (width, height), at the largest common
    scale that was found to fit.
    """
    exact = [(round(w, DECIMALS), round(h, DECIMALS)) for w, h in sizes]
    wide = [(max(s), min(s)) for s in exact]
    low = 0.0
    high = side / max(w for w, _ in wide)
    best = _shelves(wide, low, side)
    for _ in range(12):
        middle = (low + high) / 2
        places = _shelves(wide, middle, side)
        if places is None:
            high = middle
        else:
            low = middle
            best = places
    if best is None:
        raise ValueError(
            f"{len(sizes)} charts do not fit an atlas of {side} texels; "
            "use fewer patches"
        )
    return [
        replace(place, turned=h > w) for place, (w, h) in zip(best, exact, strict=True)
    ]


def painted(
    patches: Sequence[Patch],
    places: Sequence[AtlasPlace],
    paints: Mapping[str, Paint],
    side: int = SIZE,
) -> npt.NDArray[np.float32]:
    """Return the (side, side, 3) texture, display-referred sRGB, multiples of 1/255,
    row 0 at the top.
    """
    image = np.zeros((side, side, 3))
    used = np.zeros((side, side), dtype=bool)
    for patch, place in zip(patches, places, strict=True):
        # of every texel, row by row from the bottom, clamped in the gutter
        a, b = (
            np.clip((np.arange(n) + 0.5 - GUTTER) / (n - 2 * GUTTER), 0.0, 1.0)
            for n in (place.width, place.height)
        )
        a = np.tile(a, place.height)
        b = np.repeat(b, place.width)
        u, v = (b, 1.0 - a) if place.turned else (a, b)
        color = paints[patch.tag](Texels(patch.rest(u, v), u, v, patch.size))
        area = np.s_[place.y : place.y + place.height, place.x : place.x + place.width]
        image[area] = color.reshape(place.height, place.width, 3)
        used[area] = True
    image[~used] = np.round(image[used].mean(axis=0), 2)
    levels = np.clip(np.round(image[::-1] * 255.0, 4) + 0.5, 0.5, 255.5).astype(
        np.uint8
    )
    return np.asarray(levels.astype(np.float32) / np.float32(255.0))


def joined(
    patches: Sequence[Patch], places: Sequence[AtlasPlace], side: int = SIZE
) -> assets.Mesh:
    """Return one mesh, largest extent 1, standing on z = 0 and centred, every number
    rounded to `DECIMALS`.
    """
    starts = np.cumsum([0] + [len(p.vertices) for p in patches[:-1]])
    vertices = np.concatenate([p.vertices for p in patches])
    origin, extent = assets.footing(vertices)
    vertices = (vertices - origin) / extent
    normals = np.concatenate([p.normals for p in patches])
    uvs = []
    for patch, place in zip(patches, places, strict=True):
        local = (
            np.stack([1.0 - patch.uvs[:, 1], patch.uvs[:, 0]], axis=1)
            if place.turned
            else patch.uvs
        )
        inner = np.array([place.width - 2 * GUTTER, place.height - 2 * GUTTER])
        uvs.append((np.array([place.x, place.y]) + GUTTER + local * inner) / side)
    faces = np.concatenate(
        [p.faces + start for p, start in zip(patches, starts, strict=True)]
    )
    used = np.unique(faces)  # poles leave vertices behind that no triangle needs
    renumbered = np.searchsorted(used, faces).astype(np.uint32)
    corners = np.clip(np.concatenate(uvs)[used], 0.0, 1.0)
    return assets.Mesh(
        _exact(vertices[used]), renumbered, _exact(normals[used]), _exact(corners)
    )


def _exact(values: Array) -> npt.NDArray[np.float32]:
    """Round to `DECIMALS`, without negative zeros."""
    return (np.round(values, DECIMALS) + 0.0).astype(np.float32)


@dataclass(frozen=True)
class Instance:
    """One member of a family before its texture is baked."""

    patches: Sequence[Patch]  # the surface
    paints: Mapping[str, Paint]  # a paint for every tag of the patches
    material: assets.Material  # the other surface parameters
    # texels along an edge relative to the rest of the object, by tag, for parts that
    # are hardly seen
    detail: Mapping[str, float] = field(default_factory=dict)
    # of an object of several materials, what each tag is like; its tags are then names
    # of materials
    finishes: Mapping[str, assets.Material] = field(default_factory=dict)
    # what moves the vertices of all patches, in the order of the patches
    rig: assets.MeshRig | None = None
    drives: bool = False  # as `ObjectAsset.drives`


@dataclass(frozen=True)
class ObjectFamily:
    """A class of objects whose members differ in proportions, texture and material."""

    name: str  # the class, usable on the command line
    make: Callable[[Draw], Instance]  # builds an instance from a `Draw`
    metres: float  # of the unit in which it is made
    texels: int = SIZE  # along each side of its texture

    @property
    def label(self) -> str:
        """The class in words: the name with spaces for hyphens."""
        return self.name.replace("-", " ")

    def generate(self, rng: np.random.Generator | None) -> assets.ObjectAsset:
        """Return the canonical instance (None), or one with drawn proportions, texture
        and material.

        The mesh has largest extent 1 and rests on z = 0. The same state of the
        generator gives the same asset.
        """
        instance = self.make(Draw(rng))
        if instance.finishes:  # the faces of a material in one row
            tags = list(dict.fromkeys(patch.tag for patch in instance.patches))
            instance = replace(
                instance,
                patches=sorted(
                    instance.patches, key=lambda patch: tags.index(patch.tag)
                ),
            )
        patches = instance.patches
        details = [instance.detail.get(patch.tag, 1.0) for patch in instance.patches]
        sizes = [
            (patch.size[0] * share, patch.size[1] * share)
            for patch, share in zip(patches, details, strict=True)
        ]
        charts = pack(sizes, self.texels)
        mesh = joined(patches, charts, self.texels)
        if instance.finishes:
            tags_of = np.repeat(
                [patch.tag for patch in patches],
                [len(patch.faces) for patch in patches],
            )
            materials = {
                str(tag): np.nonzero(tags_of == tag)[0]
                for tag in dict.fromkeys(tags_of)
            }
            mesh = replace(mesh, materials=materials, rig=instance.rig)
        extent = np.ptp(
            np.concatenate([patch.vertices for patch in patches]), axis=0
        ).max()
        surface = None
        if instance.finishes:
            surface = workbench.library.finished(
                mesh, instance.finishes, instance.material
            )
        return assets.ObjectAsset(
            name=self.name, mesh=mesh, base_color=painted(patches, charts, instance.paints, self.texels),
            material=instance.material, label=self.label, source=workbench.library.BUNDLED_OBJECT,
            surface=surface,
            finishes=instance.finishes, metres=round(float(extent) * self.metres, 4), drives=instance.drives,
        )  # fmt: skip


def family(
    metres: float, texels: int = SIZE
) -> Callable[[Callable[[Draw], Instance]], ObjectFamily]:
    """Make a family of the function below, with its name; see `ObjectFamily`."""
    return lambda make: ObjectFamily(
        make.__name__.replace("_", "-"), make, metres, texels
    )


def finish(
    draw: Draw, roughness: float, clearcoat: float = 0.0, spread: float = 0.2
) -> assets.Material:
    """Return a material near the given one: roughness within `spread`, and now and then
    another coat.
    """
    rough = min(
        max(draw(roughness, roughness - spread, roughness + spread), 0.12), 0.95
    )
    coat = draw(clearcoat, 0.0, 1.0) if draw.chance(0.3) else clearcoat
    metal = draw(0.0, 0.3, 0.8) if draw.chance(0.06) else 0.0
    numbers = {
        "roughness": rough,
        "metallic": metal,
        "specular": draw(0.5, 0.3, 0.7),
        "clearcoat": coat,
    }
    return assets.Material(**{name: round(value, 4) for name, value in numbers.items()})
