"""What a family of objects is, and how one of its instances is put together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from advsearch.scene.assets import Material, MeshRig, ObjectAsset
from advsearch.scene.library import BUNDLED_OBJECT, finished

from .atlas import SIZE, joined, pack, painted
from .draw import Draw
from .shapes import Patch
from .textures import Paint


@dataclass(frozen=True)
class Instance:
    """One member of a family before its texture is baked.

    Attributes:
        patches: the surface.
        paints: a paint for every tag of the patches.
        material: the other surface parameters.
        detail: texels along an edge relative to the rest of the object, by tag, for parts that are hardly seen.
        finishes: of an object of several materials, what each tag is like; its tags are then names of materials.
        rig: what moves the vertices of all patches, in the order of the patches.
    """

    patches: Sequence[Patch]
    paints: Mapping[str, Paint]
    material: Material
    detail: Mapping[str, float] = field(default_factory=dict)
    finishes: Mapping[str, Material] = field(default_factory=dict)
    rig: MeshRig | None = None


@dataclass(frozen=True)
class ObjectFamily:
    """A class of objects whose members differ in proportions, texture and material.

    Attributes:
        name: the class, usable on the command line.
        make: builds an instance from a `Draw`.
        metres: of the unit in which it is made.
        texels: along each side of its texture.
    """

    name: str
    make: Callable[[Draw], Instance]
    metres: float
    texels: int = SIZE

    @property
    def label(self) -> str:
        """The class in words: the name with spaces for hyphens."""
        return self.name.replace("-", " ")

    def generate(self, rng: np.random.Generator | None) -> ObjectAsset:
        """Return the canonical instance (None), or one with drawn proportions, texture and material.

        The mesh has largest extent 1 and rests on z = 0. The same state of the generator gives the same asset.
        """
        instance = self.make(Draw(rng))
        if instance.finishes:  # the faces of a material in one row
            tags = list(dict.fromkeys(patch.tag for patch in instance.patches))
            instance = replace(instance, patches=sorted(instance.patches, key=lambda patch: tags.index(patch.tag)))
        patches, details = instance.patches, [instance.detail.get(patch.tag, 1.0) for patch in instance.patches]
        sizes = [(patch.size[0] * share, patch.size[1] * share) for patch, share in zip(patches, details, strict=True)]
        charts = pack(sizes, self.texels)
        mesh = joined(patches, charts, self.texels)
        if instance.finishes:
            tags_of = np.repeat([patch.tag for patch in patches], [len(patch.faces) for patch in patches])
            materials = {str(tag): np.nonzero(tags_of == tag)[0] for tag in dict.fromkeys(tags_of)}
            mesh = replace(mesh, materials=materials, rig=instance.rig)
        extent = np.ptp(np.concatenate([patch.vertices for patch in patches]), axis=0).max()
        return ObjectAsset(
            name=self.name,
            mesh=mesh,
            base_color=painted(patches, charts, instance.paints, self.texels),
            material=instance.material,
            label=self.label,
            source=BUNDLED_OBJECT,
            surface=finished(mesh, instance.finishes, instance.material) if instance.finishes else None,
            finishes=instance.finishes,
            metres=round(float(extent) * self.metres, 4),
        )


def family(metres: float, texels: int = SIZE) -> Callable[[Callable[[Draw], Instance]], ObjectFamily]:
    """Make a family of the function below, with its name; see `ObjectFamily`."""
    return lambda make: ObjectFamily(make.__name__.replace("_", "-"), make, metres, texels)


def finish(
    draw: Draw, roughness: float, clearcoat: float = 0.0, metallic: float = 0.0, spread: float = 0.2
) -> Material:
    """Return a material near the given one: roughness within `spread`, and now and then another coat."""
    rough = min(max(draw(roughness, roughness - spread, roughness + spread), 0.12), 0.95)
    coat = draw(clearcoat, 0.0, 1.0) if draw.chance(0.3) else clearcoat
    metal = draw(metallic, 0.3, 0.8) if draw.chance(0.06) else metallic
    return Material(
        roughness=round(rough, 4),
        metallic=round(metal, 4),
        specular=round(draw(0.5, 0.3, 0.7), 4),
        clearcoat=round(coat, 4),
    )
