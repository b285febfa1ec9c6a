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
from advsearch.scene.mitsuba_backend.variant import mitsuba_and_drjit, one_at_a_time

Doubles = npt.NDArray[np.float64]

ANGLES = 32
"""Entries of a table over the cosine of the angle of view."""
LOBE_SAMPLES = 4096
TABLES = ("diffuse", "gloss", "up", "along", "core", "tail")
"""The tables of `Lobes`, in their order."""


@dataclass(frozen=True, eq=False)
class Lobes:
    """What a surface does to light, by the cosine of the angle of view (`ANGLES` entries, the first at grazing).

    Attributes:
        diffuse: (k,) share of even light that it reflects for a base colour of one, without the gloss.
        gloss: (k,) share of even light that it reflects whatever the base colour.
        up, along: (k,) of the gloss's mean direction: its parts along the normal, and away from the viewer.
        core, tail: (k,) root mean square angle about that direction, radians, of the half of the gloss that is nearest
            to it and of the other half: a lobe has longer tails than a normal distribution.
    """

    diffuse: Floats
    gloss: Floats
    up: Floats
    along: Floats
    core: Floats
    tail: Floats

    @classmethod
    def matt(cls) -> Lobes:
        """Those of a diffuse surface."""
        one, none = np.ones(ANGLES, dtype=np.float32), np.zeros(ANGLES, dtype=np.float32)
        return cls(one, none, one, none, none, none)

    @property
    def mean_shares(self) -> tuple[float, float]:
        """Both shares under even light from everywhere, over all angles of view."""
        weight = (np.arange(ANGLES) + 0.5) * 2.0 / ANGLES**2
        return float((weight * self.diffuse).sum()), float((weight * self.gloss).sum())


def measured(
    scene: MitsubaScene, inputs: Mapping[str, Tensor], grid: TexelGrid, place: Floats, normal: Floats
) -> Lobes:
    """Measure the BSDF of a shape, by sampling it, at one of its texels: a (3,) place and the unit normal there."""
    mi, dr = mitsuba_and_drjit()

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
            found += [dr.mean(value), back, sampled.wo.x, sampled.wo.z]
    lit, dark = (_rows(one.numpy()) / _rows(even.z.numpy() / math.pi) for one in found[:2])
    weight, x, z = (_rows(one.numpy()) for one in found[2:])
    share = weight.mean(axis=1)
    mean = np.stack([(weight * x).mean(axis=1), (weight * z).mean(axis=1)])
    length = np.linalg.norm(mean, axis=0)
    mirrored = share < 1e-6
    along = np.where(mirrored, -np.sqrt(1.0 - middle**2), mean[0] / np.maximum(length, 1e-12))
    up = np.where(mirrored, middle, mean[1] / np.maximum(length, 1e-12))
    core, tail = _spreads(weight, 2.0 * np.maximum(0.0, 1.0 - x * along[:, None] - z * up[:, None]))
    diffuse = np.maximum(lit.mean(axis=1) - dark.mean(axis=1), 0.0) / 0.5
    return Lobes(*(part.astype(np.float32) for part in (diffuse, share, up, -along, core, tail)))


def _spreads(weight: Doubles, apart: Doubles) -> tuple[Doubles, Doubles]:
    """Root mean squares (k,) of the nearer and of the farther half of weighted samples (k, n), by squares of angles."""
    order = np.argsort(apart, axis=1)
    weight, apart = (np.take_along_axis(one, order, axis=1) for one in (weight, apart))
    total = weight.sum(axis=1, keepdims=True)
    near = np.clip(0.5 * total - (weight.cumsum(axis=1) - weight), 0.0, weight)
    half = np.maximum(0.5 * total[:, 0], 1e-12)
    return np.sqrt((near * apart).sum(axis=1) / half), np.sqrt(((weight - near) * apart).sum(axis=1) / half)


def _rows(values: npt.NDArray[Any]) -> Doubles:
    """Of each angle its samples."""
    return np.asarray(values, dtype=np.float64).reshape(ANGLES, LOBE_SAMPLES)
