"""The family of people: bodies of every phenotype in a shirt, trousers and shoes
(`advsearch.scene.people`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from advsearch.extend import assets, workbench
from advsearch.questions.harden.objects.family import Instance, family
from advsearch.questions.harden.objects.shapes import Array, Patch, Rest
from advsearch.questions.harden.objects.textures import (
    Draw,
    Texels,
    hexed,
    mix,
    noise,
    painter,
    step,
)

FINISHES = {
    "shirt": assets.Material(roughness=0.85, specular=0.2), "trousers": assets.Material(roughness=0.9, specular=0.2),
    "skin": assets.Material(roughness=0.5, specular=0.35), "hair": assets.Material(roughness=0.55, specular=0.3),
    "shoes": assets.Material(roughness=0.4), "eyes": assets.Material(roughness=0.1),
}  # fmt: skip


def _rest(charts: Array, points: Array) -> Rest:
    """From chart coordinates to places on a body that stands as MakeHuman's does,
    whatever this one is like.
    """
    inside = LinearNDInterpolator(charts, points)
    beside = NearestNDInterpolator(charts, points)

    def places(u: Array, v: Array) -> Array:
        at: Array = inside(u, v)
        return np.where(np.isnan(at), beside(u, v), at)

    return places


def _patches(person: Any) -> list[Patch]:
    data = person.data
    vertices = person.standing.numpy().astype(np.float64)
    index = data["index"].astype(np.int64)
    reference = data["mean"][index] * 1e-4 + np.einsum(
        "r,rpc->pc", data["shares"][1, 1, 1, 1], data["basis"][:, index]
    )
    reference[:, 2] -= reference[:, 2].min()
    charts = data["charts"].astype(np.float64)
    starts = np.cumsum([0, *data["points"]])
    ends = np.cumsum([0, *data["triangles"]])
    faces = data["faces"].astype(np.int64)
    whole = np.concatenate(
        [
            faces[a:b] + start
            for a, b, start in zip(ends, ends[1:], starts, strict=False)
        ]
    )
    summed = np.zeros((int(index.max()) + 1, 3))  # smooth across the seams of charts
    np.add.at(
        summed,
        index[whole].reshape(-1),
        np.repeat(assets.face_vectors(vertices[whole]), 3, axis=0),
    )
    normals = summed[index]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    patches = []
    for number, tag in enumerate(data["tags"]):
        mine = slice(starts[number], starts[number + 1])
        own = faces[ends[number] : ends[number + 1]]
        width, height = map(float, data["sizes"][number])
        rest = _rest(charts[mine], reference[mine])
        patches.append(
            Patch(
                str(tag),
                vertices[mine],
                normals[mine],
                charts[mine],
                own,
                (width, height),
                rest,
            )
        )
    return patches


@painter
def _woven(t: Texels, color: Array, depth: float) -> Array:
    """Cloth: fine threads, and folds as faint clouds that are longer than wide."""
    folds = noise(t.xyz * np.array([9.0, 9.0, 4.0])) - 0.5
    thread = noise(t.xyz * 180.0) - 0.5
    return np.clip(
        color * (1.0 + depth * (1.2 * folds + 0.6 * thread))[:, None], 0.0, 1.0
    )


@painter
def _jeans(t: Texels, color: Array) -> Array:
    x, _, z = t.xyz.T
    seam = np.where((z < 0.88) & (z > 0.08), np.minimum(np.abs(x - 0.005), 9.0), 9.0)
    hem = np.abs(z - 0.085)
    return mix(
        _woven(color, 0.25)(t),
        0.6 * color,
        0.8 * step(0.004 - np.minimum(seam, hem), 0.0, 0.003),
    )


@painter
def _face(t: Texels, color: Array, hair: Array) -> Array:
    x, y, z = t.xyz.T
    aside = np.abs(y)
    ahead = x > 0.1
    skin = np.clip(color * (1.0 + 0.1 * (noise(t.xyz * 14.0) - 0.5))[:, None], 0.0, 1.0)
    lips = np.where(ahead, 1.0 - np.hypot(y / 0.025, (z - 1.563) / 0.011), -1.0)
    skin = mix(skin, color * np.array([0.86, 0.62, 0.6]), 0.75 * step(lips, 0.0, 0.25))
    cheeks = np.where(
        ahead, 1.0 - np.hypot((aside - 0.042) / 0.022, (z - 1.605) / 0.02), -1.0
    )
    skin = mix(skin, color * np.array([1.0, 0.84, 0.8]), 0.5 * step(cheeks, 0.0, 0.6))
    arch = 1.659 - 14.0 * (aside - 0.034) ** 2
    brow = np.where(
        ahead & (np.abs(aside - 0.034) < 0.021), 0.0038 - np.abs(z - arch), -1.0
    )
    return mix(skin, hair, 0.8 * step(brow, 0.0, 0.0015))


@painter
def _strands(t: Texels, color: Array) -> Array:
    strand = noise(t.xyz * np.array([60.0, 160.0, 40.0])) - 0.5
    return np.clip(color * (1.0 + 0.7 * strand)[:, None] + 0.02, 0.0, 1.0)


@painter
def _leather(t: Texels, color: Array) -> Array:
    return mix(color, hexed("cfcac0"), step(0.012 - t.xyz[:, 2], 0.0, 0.004))


@painter
def _irises(t: Texels, color: Array) -> Array:
    """Eyes that look ahead: white, iris and pupil."""
    x, y, z = t.xyz.T
    out = np.where(
        x > 0.128,
        np.hypot(np.abs(y) - 0.031, z - float(0.5 * (z.min() + z.max()))),
        1.0,
    )
    iris = mix(hexed("e6e2dc"), color, step(0.0065 - out, 0.0, 0.001))
    return mix(iris, hexed("101010"), step(0.003 - out, 0.0, 0.001))


@family(metres=1.0, texels=512)
def person(draw: Draw) -> Instance:
    woman = draw.chance(0.5)
    about = {
        "gender": 0.0 if woman else 1.0, "height": draw(1.7, 1.52, 1.9) - (0.08 if woman else 0.0),
        "weight": draw(0.5, 0.25, 0.8), "age": draw(35.0, 16.0, 75.0), "stride": draw(0.0, 0.0, 1.2),
        "walk": draw(0.0, 0.0, 360.0),
    }  # fmt: skip
    body = workbench.library.make_person(about)
    skin = hexed(draw.pick("d9a98a", "e8c3a8", "c68863", "8d5a3a", "5c3a28", "f0cfb4"))
    hair = hexed(draw.pick("2e2019", "120d0a", "5a3a20", "8a6a3c", "9a948c"))
    paints = {
        "shirt": _woven(
            draw.colour("5b86b8", "c8c4ba", "b04038", "3f6b4a", "d0a83e", "2f3338"),
            0.16,
        ),
        "trousers": _jeans(
            draw.colour("31374a", "4a4640", "1f2226", "6b6152", "5a6270", wild=0.15)
        ),
        "skin": _face(skin, hair),
        "hair": _strands(hair),
        "shoes": _leather(
            draw.colour("4a3324", "1d1d1f", "8a8680", "5b2f24", wild=0.15)
        ),
        "eyes": _irises(hexed(draw.pick("4a3424", "5a7a94", "5f6f4a"))),
    }
    detail = {"skin": 0.8, "shoes": 0.8, "shirt": 1.15}
    return Instance(
        _patches(body), paints, FINISHES["shirt"], detail, FINISHES, rig=body
    )
