"""The `texture` control: the base-colour map of the object or of another mesh, inside a
ball around the original.

    texels     u = texel values, display-referred sRGB in [0, 1];   ||u - original||_p <= epsilon
    palette    u = k colours in a ball around those of the original;   texel = original + sum_i w_i(texel) (u_i - c_i)
    waves      u = (a + 1) / 2 per wave and channel;   texel = original + r tanh(sum_mn s_mn a_mn cos_m(x) cos_n(y))

and reflectance = linear(texel). A bounded change of texture is REVAMP's and Athalye et
al.'s (2018, arXiv 1707.07397, section 3). L2 is the plain Euclidean norm over all texel
values: `r * sqrt(3 h w)` lets their root-mean-square reach r. The palette follows Chang
et al. (2015, "Palette-based Photo Recoloring", sections 3.2 and 3.4), in sRGB and
normalised; the waves are the low-frequency search of Guo et al. (2019, arXiv
1809.08758, section 3).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from advsearch.controls.base import (
    LARGEST_EPSILON,
    NOTHING,
    Choice,
    Control,
    Parameter,
    Value,
    changed,
)
from advsearch.controls.support.images import resampled
from advsearch.controls.support.norms import DEFAULT_EPSILON, NORMS, radius
from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.assets import Bools, Floats
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.description import OBJECT, SceneDescription
from advsearch.scene.gradients import Budget, Group
from advsearch.scene.parts import MeshPart
from advsearch.scene.raster import rasterised, texels_of_faces

# smallest and largest side that is taken from the object's own texture when none is
# asked for
RESOLUTIONS = (256, 512)
FORMS = ("texels", "palette", "waves")
LARGEST_WAVES = 64
LARGEST_PALETTE = 64
LLOYD_STEPS = 30
# share of the texels of materials that must be theirs alone for them to be painted
LEAST_ALONE = 0.5
WAVE_REACH = 3.0
"""Argument of the tanh that the slowest wave alone reaches at its largest amplitude:
0.995 of the ball's radius.
"""


class TextureControl(Control):
    """The base-colour map of the object or another mesh, inside a ball around the
    original.
    """

    kind = "texture"
    of_a_mesh = True
    parameters = (
        Parameter("texels", (None, None, 3), "sRGB", 0.0, 1.0, "the object's own texture",
                  "Display-referred texel values.", search=(0.0, 1.0), estimators=("adjoint",)),
        Parameter("palette", (None, 3), "sRGB", 0.0, 1.0, "the texture's own colours",
                  "Colours that the texture is repainted with (form palette).", search=(0.0, 1.0),
                  estimators=("adjoint", "differences")),
        Parameter("amplitudes", (None, None, 3), "1", -1.0, 1.0, 0.0,
                  "Strength of each wave in each colour channel (form waves).", search=(-1.0, 1.0),
                  estimators=("adjoint",)),
    )  # fmt: skip
    choices = (
        Choice("epsilon", DEFAULT_EPSILON, "Radius of the ball around the original "
                                           "texture, display-referred.",
               "epsilon", most=LARGEST_EPSILON),
        Choice("norm", "linf", "Norm of the ball: linf (per texel value) or l2 "
                               "(Euclidean, over all texel values).",
               "norm", options=NORMS),
        Choice("resolution", None, "Side of the searched texture in texels; by default "
                                   "the object's own, 256 to 512.",
               "texture_resolution", whole=(2, 4096)),
        Choice("form", "texels", "What is searched: texels, palette (a few colours) or "
                                 "waves (smooth patterns)."),
        Choice("colors", 6, "Number of colours of the palette.", whole=(1, LARGEST_PALETTE)),
        Choice("waves", 8, "Number of waves along each side of the texture.", whole=(1, LARGEST_WAVES)),
        Choice("materials", None, "Materials of the mesh's file that are painted, by "
                                  "name; by default all of it."),
    )  # fmt: skip

    def check_choices(self) -> None:
        self.form = self.chosen_form(FORMS)
        names = self.chosen["materials"]
        if names is not None:
            names = [names] if isinstance(names, str) else names
            if not (
                isinstance(names, Sequence)
                and names
                and all(isinstance(one, str) for one in names)
            ):
                raise InputError(
                    f"{self.name}.materials: expected names of materials, got "
                    f"{names!r}; put quotes around a "
                    "name that reads as a number"
                )
            self.chosen["materials"] = list(dict.fromkeys(names))

    def mesh_in(self, scene: SceneDescription) -> MeshPart:
        if self._named_material(scene):
            return scene.meshes[OBJECT]
        try:
            return super().mesh_in(scene)
        except UnknownNameError:
            materials = scene.object.mesh.materials
            hint = f"It stands in `controls` {self.name}."
            kind = "mesh of the scene" + (
                " or material of the object" if materials else ""
            )
            raise UnknownNameError(
                kind, self.mesh, [*scene.meshes, *materials], hint
            ) from None

    def _named_material(self, scene: SceneDescription) -> list[str]:
        """The materials of the object that its name means, as in `texture:paint`, where
        no mesh is called so.
        """
        # takes time, and most do without
        from advsearch.scene.importing.files import clean

        if self.mesh in scene.meshes:
            return []
        return [
            one for one in scene.object.mesh.materials if self.mesh in (one, clean(one))
        ]

    def materials_in(self, scene: SceneDescription) -> list[str] | None:
        """Return the materials that it paints in a scene; None for all of the mesh."""
        return self._named_material(scene) or self.chosen["materials"]

    def fit(self) -> None:
        part = self.mesh_in(self.scene)
        names = self.materials_in(self.scene)
        original = torch.from_numpy(part.base_color.copy())
        longer = max(original.shape[:2])
        side = self.chosen["resolution"]
        if side or names is None or longer < RESOLUTIONS[0]:
            original = resampled(
                original, int(side or min(max(longer, RESOLUTIONS[0]), RESOLUTIONS[1]))
            )
        shape = original.shape[0], original.shape[1]
        where = (
            None
            if names is None
            else torch.from_numpy(self._texels_of(part, names, shape))
        )
        mask = torch.ones(shape, dtype=torch.bool) if where is None else where
        texels = original[mask]
        norm = self.chosen["norm"]
        epsilon = self._given.get("epsilon")
        if self.form == "palette":
            area = np.where(
                mask.numpy(), rasterised(part.mesh, shape).areas(), 0.0
            ).astype(np.float32)
            weight = area if area.any() else mask.numpy().astype(np.float32)
            centres = palette(original, weight, int(self.chosen["colors"]))
            painter = recoloured(
                texels, centres, Budget(norm, radius(norm, epsilon, centres.numel()))
            )
        elif self.form == "waves":
            flat = radius(norm, epsilon, texels.numel()) / (
                math.sqrt(texels.numel()) if norm == "l2" else 1.0
            )
            painter = waved(texels, mask, int(self.chosen["waves"]), flat)
        else:  # each texel value on its own
            budget = Budget(norm, radius(norm, epsilon, texels.numel()))
            group = Group("texels", texels.numel(), ("adjoint",), budget)
            painter = Painter(texels.reshape(-1), group, as_texels)
        self._on, self._original, self._materials, self._where = (
            part.name,
            original,
            ", ".join(names or ()),
            where,
        )
        self._painter, self._unchanged = painter, painter.texels(painter.start)
        self.start = painter.start
        self.groups = (painter.group,)

    def _texels_of(
        self, part: MeshPart, names: Sequence[str], shape: tuple[int, int]
    ) -> Bools:
        """Which texels (h, w) only lookups on some materials read."""
        known = part.mesh.materials
        whose = "the object" if part.name == OBJECT else part.name
        if not known:
            raise InputError(
                f"{self.name}.materials: {whose} has no materials with "
                "names; leave materials out"
            )
        for name in names:
            if name not in known:
                raise UnknownNameError(f"material of {whose}", name, known)
        where, share = texels_of_faces(
            part.mesh, np.concatenate([known[name] for name in names]), shape
        )
        if share < LEAST_ALONE:
            raise InputError(
                f"{self.name}.materials: other materials read {100 * (1 - share):.0f} "
                "% of the texels of "
                f"{', '.join(names)} too, so that it cannot be painted alone; give "
                "each material texels of its own in "
                f"the file, {'take a higher resolution, ' if self.chosen['resolution'] else ''}or leave materials out"
            )
        return where

    def inputs(
        self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING
    ) -> dict[str, Tensor]:
        return {f"{self._on}.base_color": srgb_to_linear(self._texels(u))}

    def _texels(self, u: Tensor) -> Tensor:
        """All texels (h, w, 3) of a slice of u."""
        painted = self._painter.texels(u)
        original = self._original.to(u.device)
        if self._where is None:
            return painted.reshape(original.shape)
        return original.index_put(
            self._where.to(u.device).nonzero(as_tuple=True), painted
        )

    def describe(
        self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING
    ) -> dict[str, Value]:
        change = self._painter.texels(u.detach()) - self._unchanged.to(u.device)
        named: dict[str, Value] = {
            f"{self.name}.materials": {"value": self._materials, "unit": "name"}
        }
        return (named if self._materials else {}) | changed(self.name, change)

    def printed(self, u: Tensor) -> Tensor | None:
        texels = self._texels(u)
        return (
            texels
            if self._where is None
            else torch.cat([texels, self._where.to(texels)[..., None]], dim=-1)
        )

    def artifacts(
        self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING
    ) -> dict[str, Tensor]:
        return {
            self.name: self._texels(u.detach()),
            f"{self.name}-original": self._original,
        }


class Painter(NamedTuple):
    """One form of the control: a map from its slice of u to the n texels that it
    paints, row by row.
    """

    start: Tensor  # (d,) float32, the slice that gives the original
    group: Group  # the slice as a group
    # (d,) in [0, 1] to (n, 3) display-referred sRGB in [0, 1]; differentiable, and can
    # be pickled for workers
    texels: Callable[[Tensor], Tensor]


def as_texels(u: Tensor) -> Tensor:
    """Return the texels (n, 3) that coordinates (3 n,) are."""
    return u.reshape(-1, 3)


def recoloured(original: Tensor, centres: Tensor, budget: Budget) -> Painter:
    """Return a few colours, from which each texel of the original (n, 3) sRGB takes its
    change by how much it resembles them: within a ball around the original's palette,
    the centres (k, 3).
    """
    squared = (original[..., None, :] - centres).square().sum(dim=-1)
    # over which a colour's influence falls off: half the mean distance to the nearest
    # other one
    spread = 1.0
    if len(centres) > 1:
        apart = torch.cdist(centres, centres) + torch.diag(
            torch.full((len(centres),), 10.0)
        )
        spread = max(0.5 * float(apart.min(dim=1).values.mean()), 1e-3)
    weights = torch.softmax(-squared / (2.0 * spread**2), dim=-1)
    texels = partial(_paint_palette, original, weights, centres)
    return Painter(
        centres.reshape(-1),
        Group("palette", centres.numel(), ("adjoint", "differences"), budget),
        texels,
    )


def _paint_palette(
    original: Tensor, weights: Tensor, centres: Tensor, u: Tensor
) -> Tensor:
    change = weights.to(u.device) @ (u.reshape(-1, 3) - centres.to(u.device))
    return (original.to(u.device) + change).clamp(0.0, 1.0)


def waved(original: Tensor, where: Tensor, count: int, radius: float) -> Painter:
    """Return cosine waves along both sides of the texture, added up and held inside a
    radius by a tanh.

    Args:
        original: (n, 3) sRGB.
        where: (h, w) bool, the texels that are painted.
        count: number of waves along each side; wave m has m half periods, and the
            amplitude that a coordinate at the end of its range gives falls as 1 / (1 +
            the wave's frequency).
        radius: largest change of a texel value.
    """
    number = torch.arange(count)
    down, across = (
        torch.cos(math.pi * (torch.arange(side) + 0.5)[:, None] * number / side)
        for side in where.shape
    )
    reach = (
        WAVE_REACH
        / (1.0 + torch.hypot(number[:, None].float(), number[None, :].float()))
    )[..., None]
    start = torch.full((count * count * 3,), 0.5)
    texels = partial(_paint_waves, original, where, radius, (down, across, reach))
    return Painter(start, Group("amplitudes", len(start), ("adjoint",)), texels)


def _paint_waves(
    original: Tensor,
    where: Tensor,
    radius: float,
    waves: tuple[Tensor, Tensor, Tensor],
    u: Tensor,
) -> Tensor:
    down, across, reach = (part.to(u.device) for part in waves)
    amplitudes = (2.0 * u - 1.0).reshape(*reach.shape[:2], 3) * reach
    summed = torch.einsum("hm,wn,mnc->hwc", down, across, amplitudes)[
        where.to(u.device)
    ]
    return (original.to(u.device) + radius * torch.tanh(summed)).clamp(0.0, 1.0)


def palette(image: Tensor, weight: Floats, count: int) -> Tensor:
    """Return the colours of an image by weighted k-means, heaviest first; fewer if it
    has fewer.

    Lloyd's algorithm on the image's 5-bit colours from a start without chance: the
    heaviest colour, then each time the one with the largest weight times squared
    distance from those chosen (k-means++ of Arthur and Vassilvitskii 2007 with its draw
    replaced by the most likely outcome).

    Args:
        image: (h, w, 3) sRGB in [0, 1].
        weight: (h, w) how much each texel counts, e.g. its area on the surface.
        count: number of colours, at least 1.
    """
    colors = image.reshape(-1, 3).double().numpy()
    weights = weight.reshape(-1).astype(np.float64)
    keys, index = np.unique(
        (colors * 31.0).round().astype(np.int64), axis=0, return_inverse=True
    )
    mass = np.bincount(index.reshape(-1), weights=weights, minlength=len(keys))
    sums = [
        np.bincount(
            index.reshape(-1), weights=weights * colors[:, c], minlength=len(keys)
        )
        for c in range(3)
    ]
    points = np.stack(sums, axis=1)[mass > 0.0] / mass[mass > 0.0, None]
    # or else the shades of the largest surface take all centres
    mass = np.sqrt(mass[mass > 0.0])
    chosen = [int(mass.argmax())]
    while len(chosen) < min(count, len(points)):
        squared = ((points[:, None] - points[chosen]) ** 2).sum(axis=-1).min(axis=1)
        if not squared.max() > 0.0:
            break
        chosen.append(int((mass * squared).argmax()))
    centres = points[chosen]
    for _ in range(LLOYD_STEPS):
        nearest = ((points[:, None] - centres) ** 2).sum(axis=-1).argmin(axis=1)
        share = np.bincount(nearest, weights=mass, minlength=len(centres))
        means = np.stack(
            [np.bincount(nearest, mass * points[:, c], len(centres)) for c in range(3)],
            axis=1,
        )
        centres = np.where(
            share[:, None] > 0.0, means / np.maximum(share[:, None], 1e-12), centres
        )
    order = np.argsort(-share, kind="stable")
    return torch.from_numpy(centres[order].clip(0.0, 1.0).astype(np.float32))
