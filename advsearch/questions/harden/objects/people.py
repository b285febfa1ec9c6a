"""The family of people: bodies of every phenotype in a shirt, trousers and shoes.

The bodies are those of `advsearch.scene.people`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from advsearch.extend import assets, workbench
from advsearch.questions.harden.objects.family import Instance, make_family
from advsearch.questions.harden.objects.shapes import Array, ChartToPoints, Patch
from advsearch.questions.harden.objects.textures import (
    Paint,
    ParameterSampler,
    Texels,
    blend_colors,
    compute_soft_step,
    compute_value_noise,
    painter,
    parse_hex_color,
)

FINISHES = {
    "shirt": assets.Material(roughness=0.85, specular=0.2),
    "trousers": assets.Material(roughness=0.9, specular=0.2),
    "skin": assets.Material(roughness=0.5, specular=0.35),
    "hair": assets.Material(roughness=0.55, specular=0.3),
    "shoes": assets.Material(roughness=0.4),
    "eyes": assets.Material(roughness=0.1),
}


FACE_X = 0.1
"""x of the reference body before which the front of the head is, in metres."""


def _interpolate_chart(charts: Array, points: Array) -> ChartToPoints:
    """Return the function from chart coordinates (N,), (N,) to points of a body (N, 3).

    Outside the triangles of the chart it is the nearest point.

    Args:
        charts: (V, 2) chart coordinates of the vertices.
        points: (V, 3) their points.
    """
    linear = LinearNDInterpolator(charts, points)
    nearest = NearestNDInterpolator(charts, points)

    def interpolate(u: Array, v: Array) -> Array:
        points_inside: Array = linear(u, v)
        return np.where(np.isnan(points_inside), nearest(u, v), points_inside)

    return interpolate


def _patches(person: Any) -> list[Patch]:
    """Return the patches of a body, one for each chart of its texture.

    Normals are smooth across the seams of charts. All bodies are painted alike: what is
    painted on a patch depends on the corresponding points of the reference body.

    Args:
        person: person of `workbench.library.make_person`.
    """
    data = person.data
    vertices = person.standing_points.numpy().astype(np.float64)
    reference = _reference_vertices(data)
    charts = data["charts"].astype(np.float64)
    faces_of_chart = _divide_faces(data)
    normals = _smooth_normals(vertices, data, faces_of_chart)
    first_vertex = _find_first_indices(data["points"])
    patches = []
    for number, tag in enumerate(data["tags"]):
        in_chart = slice(first_vertex[number], first_vertex[number + 1])
        width, height = data["sizes"][number][:2]
        # The paint of a texel depends on its point of the reference body.
        rest_points = _interpolate_chart(charts[in_chart], reference[in_chart])
        patches.append(
            Patch(
                tag=str(tag),
                vertices=vertices[in_chart],
                normals=normals[in_chart],
                uvs=charts[in_chart],
                faces=faces_of_chart[number],
                size=(float(width), float(height)),
                compute_rest_points=rest_points,
            )
        )
    return patches


def _find_first_indices(counts: Any) -> assets.IntArray:
    """Return where each chart begins in an array that has one after another.

    The last of the values (N + 1,) is where all end.

    Args:
        counts: (N,) number of entries of each chart.
    """
    return np.cumsum([0, *counts])


def _divide_faces(data: Any) -> list[assets.IntArray]:
    """Return the faces (F, 3) of each chart, with indices of vertices in the chart."""
    faces = data["faces"].astype(np.int64)
    first_face = _find_first_indices(data["triangles"])
    return [faces[start:end] for start, end in pairwise(first_face)]


def _reference_vertices(data: Any) -> Array:
    """Return the vertices (V, 3) of the reference body, in metres, standing on z = 0.

    It has a fixed phenotype, and stands as MakeHuman's body does. A body is the mean of
    all bodies plus a sum over a basis, whose weights ("shares") depend on the phenotype.

    Args:
        data: the arrays of the file of bodies.
    """
    point_of_vertex = data["index"].astype(np.int64)
    mean = data["mean"][point_of_vertex] * 1e-4  # stored in tenths of millimetres
    # The table of weights has an axis for each property of the phenotype. The reference
    # has the index 1 of each.
    basis_weights = data["shares"][1, 1, 1, 1]
    basis = data["basis"][:, point_of_vertex]
    # r: index of the basis; p: vertex; c: coordinate
    vertices = mean + np.einsum("r,rpc->pc", basis_weights, basis)
    vertices[:, 2] -= vertices[:, 2].min()
    return np.asarray(vertices)


def _smooth_normals(
    vertices: Array, data: Any, faces_of_chart: Sequence[assets.IntArray]
) -> Array:
    """Return normals (V, 3) that are smooth across the seams of charts.

    Vertices of several charts that are the same point of the body have the same normal:
    the mean of the normals of all faces around it, weighted by area. A face's area
    vector is its normal times twice its area, so the sum of area vectors has the
    direction of this mean.

    Args:
        vertices: (V, 3), chart after chart.
        data: the arrays of the file of bodies.
        faces_of_chart: (F, 3) indices of vertices within the chart, of each chart.
    """
    # indices of vertices within all charts instead of one
    first_vertex = _find_first_indices(data["points"])
    all_faces = np.concatenate(
        [faces + first_vertex[chart] for chart, faces in enumerate(faces_of_chart)]
    )
    area_vectors = assets.compute_area_vectors(vertices[all_faces])
    # A point of the body at a seam has a vertex in each of its charts.
    point_of_vertex = data["index"].astype(np.int64)
    n_points = int(point_of_vertex.max()) + 1
    normal_sum = _sum_by_point(area_vectors, point_of_vertex[all_faces], n_points)
    normals: Array = normal_sum[point_of_vertex]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return normals


def _sum_by_point(
    area_vectors: Array, points_of_faces: assets.IntArray, n_points: int
) -> Array:
    """Return the sum (P, 3) of the area vectors of the faces around each point.

    Args:
        area_vectors: (F, 3).
        points_of_faces: indices of the three points of each face (F, 3).
        n_points: number P of points.
    """
    normal_sum = np.zeros((n_points, 3))
    np.add.at(
        normal_sum, points_of_faces.reshape(-1), np.repeat(area_vectors, 3, axis=0)
    )
    return normal_sum


@painter
def _woven(t: Texels, color: Array, depth: float) -> Array:
    """Paint cloth: fine threads, and folds as faint clouds that are longer than wide.

    `depth` is about by how much they change the color, as a fraction.
    """
    folds = compute_value_noise(t.xyz * np.array([9.0, 9.0, 4.0])) - 0.5
    threads = compute_value_noise(t.xyz * 180.0) - 0.5
    brightness = 1.0 + depth * (1.2 * folds + 0.6 * threads)
    return np.clip(color * brightness[:, None], 0.0, 1.0)


@painter
def _jeans(t: Texels, color: Array) -> Array:
    """Paint woven cloth with seams down the legs and a hem at both ankles."""
    x, _, z = t.xyz.T
    # The seams, on the inner and outer side of both legs, are where x is 0.005.
    has_seam = (z < 0.88) & (z > 0.08)
    far = 9.0  # a distance in metres that stands for no seam
    seam_distance = np.where(has_seam, np.abs(x - 0.005), far)
    hem_distance = np.abs(z - 0.085)
    line = compute_soft_step(
        0.004 - np.minimum(seam_distance, hem_distance), 0.0, soft=0.003
    )
    return blend_colors(_woven(color, depth=0.25)(t), 0.6 * color, 0.8 * line)


@painter
def _face(t: Texels, color: Array, hair: Array) -> Array:
    """Paint skin with lips, cheeks and eyebrows at the front of the head.

    Positions are those of the reference body, in metres: z is the height, and the face
    looks along +x. They were measured on that body. Lips and cheeks multiply the skin's
    color by a factor for each channel; eyebrows have the color of the hair.

    Args:
        t: points to paint.
        color: color of the skin (3,).
        hair: color of the hair (3,).
    """
    mottling = 1.0 + 0.1 * (compute_value_noise(t.xyz * 14.0) - 0.5)
    skin = np.clip(color * mottling[:, None], 0.0, 1.0)
    lip_color = color * np.array([0.86, 0.62, 0.6])
    lips = compute_soft_step(_inside_lips(t), 0.0, soft=0.25)
    skin = blend_colors(skin, lip_color, 0.75 * lips)
    cheek_color = color * np.array([1.0, 0.84, 0.8])
    cheeks = compute_soft_step(_inside_cheeks(t), 0.0, soft=0.6)
    skin = blend_colors(skin, cheek_color, 0.5 * cheeks)
    brows = compute_soft_step(_inside_brows(t), 0.0, soft=0.0015)
    return blend_colors(skin, hair, 0.8 * brows)


def _inside_lips(t: Texels) -> Array:
    """Return how far points (N,) lie inside the lips, as a fraction.

    It is -1 at the back of the head, for lips as for cheeks.
    """
    x, y, z = t.xyz.T
    ellipse_radius = np.hypot(y / 0.025, (z - 1.563) / 0.011)
    return np.where(x > FACE_X, 1.0 - ellipse_radius, -1.0)


def _inside_cheeks(t: Texels) -> Array:
    """Return how far points (N,) lie inside the cheeks, as a fraction."""
    x, y, z = t.xyz.T
    ellipse_radius = np.hypot((np.abs(y) - 0.042) / 0.022, (z - 1.605) / 0.02)
    return np.where(x > FACE_X, 1.0 - ellipse_radius, -1.0)


def _inside_brows(t: Texels) -> Array:
    """Return how far points (N,) lie inside the eyebrows, in metres; -1 elsewhere."""
    x, y, z = t.xyz.T
    abs_y = np.abs(y)
    brow_height = 1.659 - 14.0 * (abs_y - 0.034) ** 2  # an arch over each eye
    is_above_eye = (x > FACE_X) & (np.abs(abs_y - 0.034) < 0.021)
    return np.where(is_above_eye, 0.0038 - np.abs(z - brow_height), -1.0)


@painter
def _strands(t: Texels, color: Array) -> Array:
    """Paint hair of a color, a little lighter than that, in vertical strands."""
    strands = compute_value_noise(t.xyz * np.array([60.0, 160.0, 40.0])) - 0.5
    return np.clip(color * (1.0 + 0.7 * strands)[:, None] + 0.02, 0.0, 1.0)


@painter
def _leather(t: Texels, color: Array) -> Array:
    """Paint shoes of a color with light soles, which are 1.2 cm high."""
    sole = compute_soft_step(0.012 - t.xyz[:, 2], 0.0, soft=0.004)
    return blend_colors(color, parse_hex_color("cfcac0"), sole)


@painter
def _irises(t: Texels, color: Array) -> Array:
    """Paint eyes that look ahead: white, iris and pupil.

    `color` (3,) is that of the iris. Positions are those of the reference body, in
    metres.
    """
    x, y, z = t.xyz.T
    middle_z = float(0.5 * (z.min() + z.max()))  # height of the eyes' middle
    # distance from the nearest pupil; all that is not at the front is white
    is_front = x > 0.128
    pupil_distance = np.where(is_front, np.hypot(np.abs(y) - 0.031, z - middle_z), 1.0)
    iris = compute_soft_step(0.0065 - pupil_distance, 0.0, soft=0.001)
    pupil = compute_soft_step(0.003 - pupil_distance, 0.0, soft=0.001)
    eye = blend_colors(parse_hex_color("e6e2dc"), color, iris)
    return blend_colors(eye, parse_hex_color("101010"), pupil)


@make_family(unit_in_metres=1.0, texels=512)
def person(sampler: ParameterSampler) -> Instance:
    """Make a person of random phenotype, pose and clothes."""
    body = workbench.library.make_person(_sample_phenotype(sampler))
    return Instance(
        _patches(body),
        _person_paints(sampler),
        material=FINISHES["shirt"],
        texel_density={"skin": 0.8, "shoes": 0.8, "shirt": 1.15},
        materials_by_tag=FINISHES,
        rig=body,
    )


def _sample_phenotype(sampler: ParameterSampler) -> dict[str, float]:
    """Sample the properties of a body, and its stride."""
    is_woman = sampler.sample_bool(0.5)
    height_reduction = 0.08 if is_woman else 0.0  # metres
    return {
        "gender": 0.0 if is_woman else 1.0,
        "height": sampler(1.7, low=1.52, high=1.9) - height_reduction,
        "weight": sampler(0.5, low=0.25, high=0.8),
        "age": sampler(35.0, low=16.0, high=75.0),
        "stride": sampler(0.0, low=0.0, high=1.2),
        "walk": sampler(0.0, low=0.0, high=360.0),  # phase of the stride, in degrees
    }


SKINS = ("d9a98a", "e8c3a8", "c68863", "8d5a3a", "5c3a28", "f0cfb4")
HAIRS = ("2e2019", "120d0a", "5a3a20", "8a6a3c", "9a948c")
SHIRTS = ("5b86b8", "c8c4ba", "b04038", "3f6b4a", "d0a83e", "2f3338")
TROUSERS = ("31374a", "4a4640", "1f2226", "6b6152", "5a6270")
SHOES = ("4a3324", "1d1d1f", "8a8680", "5b2f24")
IRISES = ("4a3424", "5a7a94", "5f6f4a")


def _person_paints(sampler: ParameterSampler) -> dict[str, Paint]:
    """Sample the paints of a person's skin, hair, eyes and clothes, by their tags."""
    skin = parse_hex_color(sampler.sample_choice(*SKINS))
    hair = parse_hex_color(sampler.sample_choice(*HAIRS))
    shirt = sampler.sample_color(*SHIRTS)
    trousers = sampler.sample_color(*TROUSERS, p_random=0.15)
    shoes = sampler.sample_color(*SHOES, p_random=0.15)
    irises = parse_hex_color(sampler.sample_choice(*IRISES))
    return {
        "shirt": _woven(shirt, depth=0.16),
        "trousers": _jeans(trousers),
        "skin": _face(skin, hair),
        "hair": _strands(hair),
        "shoes": _leather(shoes),
        "eyes": _irises(irises),
    }
