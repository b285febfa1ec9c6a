"""The family of people: bodies of every phenotype in a shirt, trousers and shoes.

The bodies are those of `advsearch.scene.people`.
"""

from __future__ import annotations

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
    faces = data["faces"].astype(np.int64)
    # Vertices and faces come chart by chart; the data has their counts. These are the
    # indices of the first ones of each chart.
    first_vertex = np.cumsum([0, *data["points"]])
    first_face = np.cumsum([0, *data["triangles"]])
    # A point of the body at a seam has a vertex in each of its charts.
    point_of_vertex = data["index"].astype(np.int64)
    normals = _smooth_normals(
        vertices, point_of_vertex, faces, first_vertex, first_face
    )
    patches = []
    for number, tag in enumerate(data["tags"]):
        in_chart = slice(first_vertex[number], first_vertex[number + 1])
        patches.append(
            Patch(
                tag=str(tag),
                vertices=vertices[in_chart],
                normals=normals[in_chart],
                uvs=charts[in_chart],
                faces=faces[first_face[number] : first_face[number + 1]],
                size=(float(data["sizes"][number][0]), float(data["sizes"][number][1])),
                # The paint of a texel depends on its point of the reference body.
                compute_rest_points=_interpolate_chart(
                    charts[in_chart], reference[in_chart]
                ),
            )
        )
    return patches


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
    vertices: Array,
    point_of_vertex: assets.IntArray,
    faces: assets.IntArray,
    first_vertex: assets.IntArray,
    first_face: assets.IntArray,
) -> Array:
    """Return normals (V, 3) that are smooth across the seams of charts.

    Vertices of several charts that are the same point of the body have the same normal:
    the mean of the normals of all faces around it, weighted by area. A face's area
    vector is its normal times twice its area, so the sum of area vectors has the
    direction of this mean.

    Args:
        vertices: (V, 3), chart after chart.
        point_of_vertex: (V,) index of the body's point that each vertex is.
        faces: (F, 3), chart after chart; indices of vertices within the chart.
        first_vertex, first_face: where the vertices and faces of each chart begin, and
            where all end.
    """
    # indices of vertices within all charts instead of one
    n_charts = len(first_face) - 1
    faces_of_chart = [
        faces[first_face[chart] : first_face[chart + 1]] + first_vertex[chart]
        for chart in range(n_charts)
    ]
    all_faces = np.concatenate(faces_of_chart)
    # The area vector of a face is added to the sum of each of its three points.
    area_vectors = assets.compute_area_vectors(vertices[all_faces])
    points_of_faces = point_of_vertex[all_faces]  # (F, 3)
    n_points = int(point_of_vertex.max()) + 1
    normal_sum = np.zeros((n_points, 3))
    np.add.at(
        normal_sum, points_of_faces.reshape(-1), np.repeat(area_vectors, 3, axis=0)
    )
    normals = normal_sum[point_of_vertex]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return normals


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
    x, y, z = t.xyz.T
    abs_y = np.abs(y)
    is_front = x > 0.1
    mottling = 1.0 + 0.1 * (compute_value_noise(t.xyz * 14.0) - 0.5)
    skin = np.clip(color * mottling[:, None], 0.0, 1.0)

    # how far inside an ellipse, as a fraction; -1 at the back of the head
    in_lips = np.where(is_front, 1.0 - np.hypot(y / 0.025, (z - 1.563) / 0.011), -1.0)
    lip_color = color * np.array([0.86, 0.62, 0.6])
    skin = blend_colors(
        skin, lip_color, 0.75 * compute_soft_step(in_lips, 0.0, soft=0.25)
    )

    in_cheeks = np.where(
        is_front, 1.0 - np.hypot((abs_y - 0.042) / 0.022, (z - 1.605) / 0.02), -1.0
    )
    cheek_color = color * np.array([1.0, 0.84, 0.8])
    skin = blend_colors(
        skin, cheek_color, 0.5 * compute_soft_step(in_cheeks, 0.0, soft=0.6)
    )

    brow_height = 1.659 - 14.0 * (abs_y - 0.034) ** 2  # an arch over each eye
    is_above_eye = is_front & (np.abs(abs_y - 0.034) < 0.021)
    # how far inside a brow, in metres
    in_brow = np.where(is_above_eye, 0.0038 - np.abs(z - brow_height), -1.0)
    return blend_colors(skin, hair, 0.8 * compute_soft_step(in_brow, 0.0, soft=0.0015))


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
    is_woman = sampler.sample_bool(0.5)
    height_reduction = 0.08 if is_woman else 0.0  # metres
    phenotype = {
        "gender": 0.0 if is_woman else 1.0,
        "height": sampler(1.7, low=1.52, high=1.9) - height_reduction,
        "weight": sampler(0.5, low=0.25, high=0.8),
        "age": sampler(35.0, low=16.0, high=75.0),
        "stride": sampler(0.0, low=0.0, high=1.2),
        "walk": sampler(0.0, low=0.0, high=360.0),  # phase of the stride, in degrees
    }
    body = workbench.library.make_person(phenotype)
    return Instance(
        _patches(body),
        _person_paints(sampler),
        material=FINISHES["shirt"],
        texel_density={"skin": 0.8, "shoes": 0.8, "shirt": 1.15},
        materials_by_tag=FINISHES,
        rig=body,
    )


def _person_paints(sampler: ParameterSampler) -> dict[str, Paint]:
    """Sample the paints of a person's skin, hair, eyes and clothes, by their tags."""
    skin = parse_hex_color(
        sampler.sample_choice(
            "d9a98a", "e8c3a8", "c68863", "8d5a3a", "5c3a28", "f0cfb4"
        )
    )
    hair = parse_hex_color(
        sampler.sample_choice("2e2019", "120d0a", "5a3a20", "8a6a3c", "9a948c")
    )
    shirt = sampler.sample_color(
        "5b86b8", "c8c4ba", "b04038", "3f6b4a", "d0a83e", "2f3338"
    )
    trousers = sampler.sample_color(
        "31374a", "4a4640", "1f2226", "6b6152", "5a6270", p_random=0.15
    )
    shoes = sampler.sample_color("4a3324", "1d1d1f", "8a8680", "5b2f24", p_random=0.15)
    irises = parse_hex_color(sampler.sample_choice("4a3424", "5a7a94", "5f6f4a"))
    return {
        "shirt": _woven(shirt, depth=0.16),
        "trousers": _jeans(trousers),
        "skin": _face(skin, hair),
        "hair": _strands(hair),
        "shoes": _leather(shoes),
        "eyes": _irises(irises),
    }
