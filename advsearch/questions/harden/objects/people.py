"""The family of people: bodies of every phenotype in a shirt, trousers and shoes.

The bodies are those of `advsearch.scene.people`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from advsearch.extend import assets, workbench
from advsearch.questions.harden.objects.family import Instance, family
from advsearch.questions.harden.objects.shapes import Array, ChartToPoints, Patch
from advsearch.questions.harden.objects.textures import (
    ParameterSampler,
    Texels,
    mix,
    noise,
    painter,
    parse_hex_color,
    step,
)

FINISHES = {
    "shirt": assets.Material(roughness=0.85, specular=0.2),
    "trousers": assets.Material(roughness=0.9, specular=0.2),
    "skin": assets.Material(roughness=0.5, specular=0.35),
    "hair": assets.Material(roughness=0.55, specular=0.3),
    "shoes": assets.Material(roughness=0.4),
    "eyes": assets.Material(roughness=0.1),
}


def _rest(charts: Array, points: Array) -> ChartToPoints:
    """Return the function from chart coordinates (N,), (N,) to points of a body (N, 3).

    It interpolates the points (V, 3) at chart coordinates (V, 2) of one chart. They are
    of the reference body, which stands as MakeHuman's does, so that all bodies are
    painted alike. Outside the triangles it is the nearest point.
    """
    linear = LinearNDInterpolator(charts, points)
    nearest = NearestNDInterpolator(charts, points)

    def interpolate(u: Array, v: Array) -> Array:
        points_inside: Array = linear(u, v)
        return np.where(np.isnan(points_inside), nearest(u, v), points_inside)

    return interpolate


def _patches(person: Any) -> list[Patch]:
    """Return the patches of a body, one for each chart of its texture.

    Normals are smooth across the seams of charts. What is painted on a patch depends on
    the corresponding points of the reference body.

    Args:
        person: person of `workbench.library.make_person`.
    """
    data = person.data
    vertices = person.standing_points.numpy().astype(np.float64)
    index = data["index"].astype(np.int64)
    # the reference body: the mean, stored in tenths of millimetres, plus what the
    # shares of one fixed phenotype add
    reference = data["mean"][index] * 1e-4 + np.einsum(
        "r,rpc->pc", data["shares"][1, 1, 1, 1], data["basis"][:, index]
    )
    reference[:, 2] -= reference[:, 2].min()
    charts = data["charts"].astype(np.float64)
    # where the vertices and the faces of each chart begin
    first_vertex = np.cumsum([0, *data["points"]])
    first_face = np.cumsum([0, *data["triangles"]])
    faces = data["faces"].astype(np.int64)
    normals = _smooth_normals(
        vertices=vertices,
        index=index,
        faces=faces,
        first_vertex=first_vertex,
        first_face=first_face,
    )
    patches = []
    for number, tag in enumerate(data["tags"]):
        chart_vertices = slice(first_vertex[number], first_vertex[number + 1])
        chart_faces = faces[first_face[number] : first_face[number + 1]]
        patches.append(
            Patch(
                tag=str(tag),
                vertices=vertices[chart_vertices],
                normals=normals[chart_vertices],
                uvs=charts[chart_vertices],
                faces=chart_faces,
                size=_chart_size(data["sizes"][number]),
                rest=_rest(charts[chart_vertices], reference[chart_vertices]),
            )
        )
    return patches


def _chart_size(size: Array) -> tuple[float, float]:
    """Return the width and the height of a chart."""
    return float(size[0]), float(size[1])


def _smooth_normals(
    vertices: Array,
    index: assets.IntArray,
    faces: assets.IntArray,
    first_vertex: assets.IntArray,
    first_face: assets.IntArray,
) -> Array:
    """Return normals (V, 3) that are smooth across the seams of charts.

    Vertices of several charts that are the same point of the body share one normal: the
        mean of the normals of all faces around it, weighted by area.

    Args:
        vertices: (V, 3), chart after chart.
        index: (V,) number of the body's point that each vertex is.
        faces: (F, 3), chart after chart; numbers of vertices within the chart.
        first_vertex, first_face: where the vertices and faces of each chart begin, and
            where all end.
    """
    all_faces = np.concatenate(
        [
            faces[a:b] + start
            for a, b, start in zip(
                first_face, first_face[1:], first_vertex, strict=False
            )
        ]
    )
    normal_sum = np.zeros((int(index.max()) + 1, 3))
    np.add.at(
        normal_sum,
        index[all_faces].reshape(-1),
        np.repeat(assets.compute_area_vectors(vertices[all_faces]), 3, axis=0),
    )
    normals = normal_sum[index]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return normals


@painter
def _woven(t: Texels, color: Array, depth: float) -> Array:
    """Paint cloth: fine threads, and folds as faint clouds that are longer than wide.

    `depth` is about by how much they change the color, as a fraction.
    """
    folds = noise(t.xyz * np.array([9.0, 9.0, 4.0])) - 0.5
    thread = noise(t.xyz * 180.0) - 0.5
    return np.clip(
        color * (1.0 + depth * (1.2 * folds + 0.6 * thread))[:, None], 0.0, 1.0
    )


@painter
def _jeans(t: Texels, color: Array) -> Array:
    """Paint woven cloth with seams down the legs and a hem at both ankles."""
    x, _, z = t.xyz.T
    # distance to the seam, which is in the plane x = 0.005; far away above and below it
    seam = np.where((z < 0.88) & (z > 0.08), np.minimum(np.abs(x - 0.005), 9.0), 9.0)
    hem = np.abs(z - 0.085)
    return mix(
        _woven(color, depth=0.25)(t),
        0.6 * color,
        0.8 * step(0.004 - np.minimum(seam, hem), 0.0, soft=0.003),
    )


@painter
def _face(t: Texels, color: Array, hair: Array) -> Array:
    """Paint skin with lips, cheeks and eyebrows at the front of the head.

    Their places are those of the reference body, in metres. Shades of lips and cheeks
    are multiples of the skin's color (3,); eyebrows have the color of the hair (3,).
    """
    x, y, z = t.xyz.T
    abs_y = np.abs(y)
    is_front = x > 0.1
    skin = np.clip(color * (1.0 + 0.1 * (noise(t.xyz * 14.0) - 0.5))[:, None], 0.0, 1.0)
    lips = np.where(is_front, 1.0 - np.hypot(y / 0.025, (z - 1.563) / 0.011), -1.0)
    skin = mix(
        skin, color * np.array([0.86, 0.62, 0.6]), 0.75 * step(lips, 0.0, soft=0.25)
    )
    cheeks = np.where(
        is_front, 1.0 - np.hypot((abs_y - 0.042) / 0.022, (z - 1.605) / 0.02), -1.0
    )
    skin = mix(
        skin, color * np.array([1.0, 0.84, 0.8]), 0.5 * step(cheeks, 0.0, soft=0.6)
    )
    arch = 1.659 - 14.0 * (abs_y - 0.034) ** 2
    brow = np.where(
        is_front & (np.abs(abs_y - 0.034) < 0.021), 0.0038 - np.abs(z - arch), -1.0
    )
    return mix(skin, hair, 0.8 * step(brow, 0.0, soft=0.0015))


@painter
def _strands(t: Texels, color: Array) -> Array:
    strand = noise(t.xyz * np.array([60.0, 160.0, 40.0])) - 0.5
    return np.clip(color * (1.0 + 0.7 * strand)[:, None] + 0.02, 0.0, 1.0)


@painter
def _leather(t: Texels, color: Array) -> Array:
    return mix(
        color, parse_hex_color("cfcac0"), step(0.012 - t.xyz[:, 2], 0.0, soft=0.004)
    )


@painter
def _irises(t: Texels, color: Array) -> Array:
    """Paint eyes that look ahead: white, iris and pupil.

    `color` (3,) is that of the iris. Places are those of the reference body, in metres.
    """
    x, y, z = t.xyz.T
    # from the nearest pupil; all that is not at the front is white
    pupil_distance = np.where(
        x > 0.128,
        np.hypot(np.abs(y) - 0.031, z - float(0.5 * (z.min() + z.max()))),
        1.0,
    )
    iris = mix(
        parse_hex_color("e6e2dc"), color, step(0.0065 - pupil_distance, 0.0, soft=0.001)
    )
    return mix(
        iris, parse_hex_color("101010"), step(0.003 - pupil_distance, 0.0, soft=0.001)
    )


@family(metres=1.0, texels=512)
def person(sampler: ParameterSampler) -> Instance:
    """Make a person of random phenotype, pose and clothes."""
    is_woman = sampler.chance(0.5)
    gender = 0.0 if is_woman else 1.0
    height_reduction = 0.08 if is_woman else 0.0  # metres
    phenotype = {
        "gender": gender,
        "height": sampler(1.7, low=1.52, high=1.9) - height_reduction,
        "weight": sampler(0.5, low=0.25, high=0.8),
        "age": sampler(35.0, low=16.0, high=75.0),
        "stride": sampler(0.0, low=0.0, high=1.2),
        "walk": sampler(0.0, low=0.0, high=360.0),
    }
    body = workbench.library.make_person(phenotype)
    skin = parse_hex_color(
        sampler.pick("d9a98a", "e8c3a8", "c68863", "8d5a3a", "5c3a28", "f0cfb4")
    )
    hair = parse_hex_color(
        sampler.pick("2e2019", "120d0a", "5a3a20", "8a6a3c", "9a948c")
    )
    paints = {
        "shirt": _woven(
            sampler.sample_color(
                "5b86b8", "c8c4ba", "b04038", "3f6b4a", "d0a83e", "2f3338"
            ),
            depth=0.16,
        ),
        "trousers": _jeans(
            sampler.sample_color(
                "31374a", "4a4640", "1f2226", "6b6152", "5a6270", p_random=0.15
            )
        ),
        "skin": _face(skin, hair),
        "hair": _strands(hair),
        "shoes": _leather(
            sampler.sample_color("4a3324", "1d1d1f", "8a8680", "5b2f24", p_random=0.15)
        ),
        "eyes": _irises(parse_hex_color(sampler.pick("4a3424", "5a7a94", "5f6f4a"))),
    }
    texel_density = {"skin": 0.8, "shoes": 0.8, "shirt": 1.15}
    return Instance(
        _patches(body),
        paints,
        material=FINISHES["shirt"],
        texel_density=texel_density,
        finishes=FINISHES,
        rig=body,
    )
