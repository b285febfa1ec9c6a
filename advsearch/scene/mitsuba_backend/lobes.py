"""What a surface does to light, as tables over the angle of view, measured by sampling its BSDF."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.texel_rays import Floats, TexelGrid, passed
from advsearch.scene.mitsuba_backend.variant import mitsuba, one_at_a_time

ANGLES = 32
"""Entries of a table over the cosine of the angle of view."""
LOBE_SAMPLES = 4096
TABLES = ("diffuse", "gloss", "up", "along", "spread")
"""The tables of `Lobes`, in their order."""


@dataclass(frozen=True, eq=False)
class Lobes:
    """What a surface does to light, by the cosine of the angle of view (`ANGLES` entries, the first at grazing).

    Attributes:
        diffuse: (k,) share of even light that it reflects for a base colour of one, without the gloss.
        gloss: (k,) share of even light that it reflects whatever the base colour.
        up, along: (k,) of the gloss's mean direction: its parts along the normal, and away from the viewer.
        spread: (k,) root mean square angle about that direction, radians.
    """

    diffuse: Floats
    gloss: Floats
    up: Floats
    along: Floats
    spread: Floats

    @classmethod
    def matt(cls) -> Lobes:
        """Those of a diffuse surface."""
        one, none = np.ones(ANGLES, dtype=np.float32), np.zeros(ANGLES, dtype=np.float32)
        return cls(one, none, one, none, none)

    @property
    def mean_shares(self) -> tuple[float, float]:
        """Both shares under even light from everywhere, over all angles of view."""
        weight = (np.arange(ANGLES) + 0.5) * 2.0 / ANGLES**2
        return float((weight * self.diffuse).sum()), float((weight * self.gloss).sum())


def measured(
    scene: MitsubaScene, inputs: Mapping[str, Tensor], grid: TexelGrid, place: Floats, normal: Floats
) -> Lobes:
    """Measure the BSDF of a shape, by sampling it, at one of its texels: a (3,) place and the unit normal there."""
    mi = mitsuba()
    import drjit as dr

    key = f"{grid.name}.base_color"
    with one_at_a_time:
        middle = (np.arange(ANGLES) + 0.5) / ANGLES
        cosine = dr.repeat(mi.Float(middle.astype(np.float32)), LOBE_SAMPLES)
        towards = mi.Vector3f(dr.sqrt(1.0 - cosine * cosine), 0.0, cosine)
        noise = mi.load_dict({"type": "independent"})
        noise.seed(0, ANGLES * LOBE_SAMPLES)
        one, two = noise.next_1d(), noise.next_2d()
        even = mi.warp.square_to_cosine_hemisphere(two)
        found = []
        for level in (0.5, 0.0):
            changed = {key: torch.full_like(scene.base(key), level)} if key in scene.names else {}
            held = scene.held({**inputs, **changed})
            start = mi.Point3f([float(x) for x in place + 1e-3 * normal])
            ray = mi.Ray3f(start, mi.Vector3f([float(-x) for x in normal]))
            hit = held.ray_intersect(dr.gather(mi.Ray3f, ray, dr.zeros(mi.UInt32, ANGLES * LOBE_SAMPLES)))
            bsdf = hit.bsdf()
            hit.wi = towards
            opaque = dr.maximum(1.0 - passed(hit, True), 1e-3)  # of cut-outs, what stops light
            value = bsdf.eval(mi.BSDFContext(), hit, even) / opaque
            if level:
                found.append(dr.mean(value))
                continue
            sampled, weight = bsdf.sample(mi.BSDFContext(), hit, one, two)
            back = dr.select((sampled.pdf > 0.0) & (sampled.wo.z > 0.0), dr.mean(weight) / opaque, 0.0)
            back = dr.select(dr.isfinite(back), back, 0.0)
            found += [dr.mean(value), back, back * sampled.wo.x, back * sampled.wo.z]
    density = (even.z / math.pi).numpy()
    lit, dark, share, x, z = (
        _means(one) for one in (found[0].numpy() / density, found[1].numpy() / density, *found[2:])
    )
    length = np.sqrt(x * x + z * z)
    kept = np.maximum(share, 1e-12)
    spread = np.sqrt(np.maximum(0.0, 2.0 * (1.0 - length / kept)))
    mirrored = share < 1e-6
    up = np.where(mirrored, middle, z / np.maximum(length, 1e-12))
    along = np.where(mirrored, -np.sqrt(1.0 - middle**2), x / np.maximum(length, 1e-12))
    parts = (np.maximum(lit - dark, 0.0) / 0.5, share, up, -along, np.where(mirrored, 0.0, spread))
    return Lobes(*(part.astype(np.float32) for part in parts))


def _means(values: Any) -> npt.NDArray[np.float64]:
    array = values if isinstance(values, np.ndarray) else values.numpy()
    return np.asarray(array.reshape(ANGLES, LOBE_SAMPLES).mean(axis=1), dtype=np.float64)
