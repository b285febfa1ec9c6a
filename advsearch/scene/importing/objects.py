"""Objects from mesh files: ``--object path.obj`` and others of
`advsearch.files.MESHES`.

A file is read as a list of parts. Each part has one surface and its geometry in the
file's coordinates. The readers are our own, since existing ones silently drop entries
that they do not support.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from PIL import Image
from scipy.spatial import ConvexHull, QhullError

from advsearch.errors import InputError
from advsearch.pictures import without_pillows_limit
from advsearch.scene.assets import (
    FRONT_AXES,
    MAX_METRES,
    MIN_METRES,
    FileAxis,
    Float32Array,
    Float64Array,
    IntArray,
    Material,
    Mesh,
    ObjectAsset,
    find_footing,
    group_indices,
    make_pose,
    normalise_mesh,
)
from advsearch.scene.importing import gltf, gltf_parts
from advsearch.scene.importing.files import Notes, format_name, make_safe_name
from advsearch.scene.importing.geometry import (
    TriangleSoup,
    compute_extent,
    compute_rotation,
    find_used,
    join_parts,
    list_used_vertices,
    make_mesh_from_soup,
    repair_soup,
)
from advsearch.scene.importing.gltf_entries import Header
from advsearch.scene.importing.parts import (
    ImportedPart,
    ImportedSurface,
    select_visible_parts,
)
from advsearch.scene.importing.readers import (
    GLTF_SUFFIXES,
    get_reader,
    list_suffixes,
    read_mesh_bytes,
)
from advsearch.scene.importing.texture import apply_textures, index_materials

if TYPE_CHECKING:
    from advsearch.scene.rigged import SkeletonRig


def read_parts(path: Path, data: bytes) -> tuple[list[ImportedPart], list[str]]:
    """Read a mesh file with the reader of its suffix.

    Files that it refers to are looked up beside it.

    Args:
        path: the file.
        data: its content.

    Returns:
        The parts that have faces, at least one, in a fixed order; and the warnings.

    Raises:
        FileFormatError: the file is corrupt, is no mesh, refers to missing geometry, or
            has no faces.
    """
    notes = Notes(path)
    # Readers limit images themselves, also above Pillow's limit of pixels.
    with warnings.catch_warnings(), np.errstate(all="ignore"), without_pillows_limit():
        warnings.simplefilter("ignore")
        reader = get_reader(path.suffix.lower())
        parts = reader(path, data, notes)
        return parts, list(notes)


MAX_WARNINGS = 20  # warnings about one file


def import_object(
    path: str | PathLike[str],
    *,
    up: Literal["y", "z"] | None = None,
    facing: str | None = None,
) -> ObjectAsset:
    """Read an object from a mesh file and the files beside it that it refers to.

    The handling of materials, units and axes is in docs/scenes.md ("Your own object").
    The geometry is repaired:

    - All of it is joined, with the transforms of the file's scene graph, turned z up
      with its front towards +x, scaled to a largest extent of 1 and set on z = 0.
    - Faces without area are removed, the winding is made consistent, closed shells that
      are inside out are turned over.
    - Normals are the file's; if it has none, or they contradict the faces, they are
      computed: smooth, with creases where faces meet at more than 40 degrees; flat in
      glTF.
    - UVs are the file's, moved into [0, 1] if they fit. If there are none, if they
      repeat a texture or are squashed, or if there are several materials, xatlas makes
      new ones and the images are baked into maps.

    The warnings name all data that is left out or changed. The same file always gives
    the same bytes.

    Args:
        path: a file of one of the kinds of `advsearch.files.MESHES`.
        up: the axis of the file that points up; None for the axis of its format, or
            else the one that its shape suggests.
        facing: the axis of the file, one of `FRONT_AXES`, along which the object's
            front faces; None for the axis of its format (`find_front_axis`).

    Raises:
        FileFormatError: the file is missing, of another kind, corrupt, or has no faces;
            the message names it.
        InputError: `up` or `facing` is not valid, both are along the same axis, or the
            geometry has NaN, infinite, or only coincident vertices.
    """
    if up not in (None, "y", "z"):
        raise InputError(f"up axis: expected 'y' or 'z', got {up!r}")
    file = Path(path)
    data = read_mesh_bytes(file, "object", list_suffixes())
    parts, notes = read_parts(file, data)
    header = None
    if file.suffix.lower() in GLTF_SUFFIXES:
        header = gltf.read_header(file, data)
        notes += gltf_parts.describe_left_out(header, file.name)
    front = _find_front(file, header, up, facing)
    return make_object(
        parts, notes, file=file, name=make_safe_name(file), up=up, front=front
    )


def _find_front(
    file: Path, header: Header | None, up: str | None, facing: str | None
) -> FileAxis:
    """Return the axis along which the front faces: the user's, or that of the format.

    Args:
        file: the file.
        header: header of a glTF file, None for others.
        up: the axis that the user named as up, or None.
        facing: the axis that the user named as the front, or None.

    Raises:
        InputError: `facing` is not valid, or along the axis that points up.
    """
    if facing is None:
        return find_front_axis(file, header, up)
    format_up = up if header is None else up or "y"
    return FileAxis(parse_facing_axis(facing, format_up))


def parse_facing_axis(facing: str, up: str | None) -> str:
    """Return an axis of `FRONT_AXES`, completing a plus sign that was left out.

    Raises:
        InputError: it is no such axis, or the axis that points up.
    """
    axis = facing if facing.startswith(("+", "-")) else f"+{facing}"
    if axis not in FRONT_AXES:
        raise InputError(
            "facing: expected an axis of the file, one of "
            f"{', '.join(FRONT_AXES)}, got {facing!r}"
        )
    if axis[1] == up:  # the letter behind the sign
        raise InputError(
            f"facing: {facing} is along the axis that points up, {up}; "
            "choose another one, or another `up`"
        )
    return axis


DEFAULT_FRONT = "+x"
"""The front in formats that define none: the axis along which bundled objects face."""
# Up is y or z. If the front is along one of them, up is the other.
UP_OF_FRONT = {"y": "z", "z": "y"}
BLEND_SUFFIX = ".blend"
USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
VRM_0 = "VRM"  # extensions of glTF
VRM_1 = "VRMC_vrm"


def find_front_axis(
    path: Path, header: Header | None, up: str | None = None
) -> FileAxis:
    """Return the axis along which the front of an object faces, as its format defines.

    The front of a glTF asset faces +Z (Khronos, glTF 2.0, section 3.4), which is -Y in
    Blender. VRM 1.0 has the same rule, VRM 0.x has -Z. OBJ, PLY, STL and OpenUSD have
    no rule. The rule does not hold for a glTF file that the user declares to be z up.

    Args:
        path: the file.
        header: header of a glTF file, or of a file that was converted to glTF.
        up: the axis that points up, if the user named it.
    """
    axis, rule = _find_front_rule(path, header, up)
    opposite = f"-{axis[1]}" if axis[0] == "+" else f"+{axis[1]}"
    return FileAxis(
        axis,
        f"{path.name}: its front is assumed to face {axis} of the file ({rule}); if it "
        f"faces another axis, set `facing`, such as `facing={opposite}`",
    )


def _find_front_rule(
    path: Path, header: Header | None, up: str | None
) -> tuple[str, str]:
    """Return the axis of the front, and the rule that says so; see `find_front_axis`."""
    suffix = path.suffix.lower()
    if header is None or suffix in USD_SUFFIXES or up == "z":
        return DEFAULT_FRONT, "a format without a rule, as bundled objects face"
    if VRM_0 in header.extensionsUsed and VRM_1 not in header.extensionsUsed:
        return "-z", "as VRM 0 defines"
    if suffix == BLEND_SUFFIX:
        return "+z", "-y in Blender, as its front view shows"
    return "+z", "as glTF defines"


def make_object(
    parts: list[ImportedPart],
    notes: list[str],
    file: Path,
    name: str,
    up: str | None,
    front: FileAxis,
) -> ObjectAsset:
    """Return the object that parts of a file make up.

    It is joined, rotated, repaired and textured as described in `import_object`. Its
    size in meters is known only if the format has units, and the extent is plausible.

    Args:
        parts: at least one.
        notes: warnings about them so far.
        file: the file that they are from.
        name: name of the object.
        up: the axis of the file that points up, "y" or "z"; None for the axis of the
            format, or else the one that its shape suggests.
        front: the axis of the file along which its front faces.

    Raises:
        InputError: the geometry has NaN, infinite, or only coincident vertices.
    """
    object_notes = Notes(file)
    parts = _select_visible_parts(parts, object_notes)
    up_axis = _find_up(parts, file, up, front)
    rotation = compute_rotation(up_axis.axis, front.axis)
    surfaces = [part.surface for part in parts]
    soup = repair_soup(join_parts(parts, str(file), rotation), str(file), object_notes)
    soup, maps = apply_textures(soup, surfaces, object_notes)
    opacity = _find_opacity(maps.color, object_notes)
    material = _compute_mean_material(soup, surfaces, object_notes)
    extent = _compute_repaired_extent(parts, soup)
    return ObjectAsset(
        name=name,
        mesh=_make_mesh(soup, surfaces, file, parts, rotation),
        base_color=np.ascontiguousarray(maps.color[:, :, :3]),
        material=material,
        source=str(file),
        warnings=_limit_warnings([*notes, *object_notes], file),
        up=up_axis,
        front=front,
        opacity=opacity,
        normal_map=maps.normals,
        emission=_compute_emitted(maps.emission, opacity),
        size_in_metres=_find_size_in_metres(file, extent),
        extent=extent,
        file_to_mesh=_compute_file_to_mesh(parts, soup, rotation),
    )


def _compute_repaired_extent(parts: list[ImportedPart], soup: TriangleSoup) -> float:
    """Return the largest extent of a repaired object, in the file's unit.

    The soup's extent is 1, or less if the repair has removed faces.
    """
    corners = soup.points[soup.faces].reshape(-1, 3)
    return compute_extent(parts) * float(np.ptp(corners, axis=0).max())


def _find_size_in_metres(file: Path, extent: float) -> float | None:
    """Return the extent if it is plausible as one in meters, the unit of glTF; or None."""
    is_gltf = file.suffix.lower() in GLTF_SUFFIXES
    has_unit = is_gltf and MIN_METRES <= extent <= MAX_METRES
    return extent if has_unit else None


def _select_visible_parts(
    parts: list[ImportedPart], notes: Notes
) -> list[ImportedPart]:
    """Return the parts that are not fully transparent, and note the others."""
    visible_parts = select_visible_parts(parts)
    # Parts have no `==`, so that `in` compares them by identity.
    transparent = [part for part in parts if part not in visible_parts]
    names = dict.fromkeys(
        format_name(part.surface.name or "a part") for part in transparent
    )
    if names:
        notes.warn(
            f"all light passes through {', '.join(names)} (opacity 0): left out; give "
            "it an opacity to see it"
        )
    return visible_parts


def _find_up(
    parts: list[ImportedPart], file: Path, up: str | None, front: FileAxis
) -> FileAxis:
    """Return the axis that points up: the user's, the format's, or a guess.

    Up is y or z. If the front faces along one of these, up is the other one. Otherwise
    the axis is guessed from the shape.

    Args:
        parts: the parts of the file.
        file: the file.
        up: the axis that the user named, or None.
        front: the axis along which the front faces.
    """
    if up:
        return FileAxis(up)
    if file.suffix.lower() in GLTF_SUFFIXES:
        return FileAxis("y")
    front_letter = front.axis[1]  # "y" of "-y"
    if front_letter in UP_OF_FRONT:
        return FileAxis(UP_OF_FRONT[front_letter])
    as_stored = join_parts(parts, str(file), np.eye(3))
    used_points = find_used(as_stored.faces, len(as_stored.points))
    return guess_up(as_stored.points[used_points], file.name)


def _find_opacity(color: Float32Array, notes: Notes) -> Float32Array | None:
    """Return the opacity (H, W) in a map of colors (H, W, 3 or 4); None if opaque.

    An object that is transparent everywhere would be invisible. It becomes opaque,
    with a note.
    """
    if color.shape[2] < 4:
        return None
    opacity = np.ascontiguousarray(color[:, :, 3])
    if not opacity.any():
        notes.warn("it is fully transparent everywhere; it is rendered opaque")
        return None
    return opacity


def _compute_mean_material(
    soup: TriangleSoup, surfaces: list[ImportedSurface], notes: Notes
) -> Material:
    """Return the roughness and metallic of all surfaces, averaged by area.

    The renderer has one roughness and one metallic for an object. If the surfaces
    differ, there is a note that means are used. Surfaces without faces are left out.

    Args:
        soup: the object.
        surfaces: the surface of each of its parts.
        notes: notes about the file.
    """
    visible_area = _compute_surface_areas(soup, len(surfaces))
    values = _list_finishes(surfaces)
    visible_values = values[visible_area > 0]
    roughness, metallic = map(float, visible_values[0])
    if not (visible_values == visible_values[0]).all():
        means = (values * visible_area[:, None]).sum(axis=0) / visible_area.sum()
        roughness, metallic = map(float, means)
        notes.warn(
            "the roughness and metallic of its materials are replaced by their "
            f"means ({roughness:.2g} and {metallic:.2g})"
        )
    return Material(roughness=roughness, metallic=metallic)


def _compute_surface_areas(soup: TriangleSoup, n_surfaces: int) -> Float64Array:
    """Return twice the area (S,) of the faces of each surface."""
    face_areas = np.linalg.norm(soup.compute_area_vectors(), axis=1)
    return np.asarray(
        np.bincount(soup.part_of_face, weights=face_areas, minlength=n_surfaces)
    )


def _list_finishes(surfaces: list[ImportedSurface]) -> Float64Array:
    """Return the roughness and metallic (S, 2) of surfaces.

    What a surface does not state has the value of the default material.
    """
    materials = [
        Material().with_values(vars(surface), prefix="") for surface in surfaces
    ]
    return np.array([[material.roughness, material.metallic] for material in materials])


def _limit_warnings(warnings: list[str], file: Path) -> tuple[str, ...]:
    """Return the first `MAX_WARNINGS` warnings, and one that counts the rest."""
    n_more = len(warnings) - MAX_WARNINGS
    if n_more <= 0:
        return tuple(warnings)
    last_warning = f"{file.name}: {n_more:,} more warnings are left out"
    return (*warnings[:MAX_WARNINGS], last_warning)


def _make_mesh(
    soup: TriangleSoup,
    surfaces: list[ImportedSurface],
    file: Path,
    parts: list[ImportedPart],
    turn: Float64Array,
) -> Mesh:
    """Return the normalised mesh with its materials, and a rig if something moves it.

    Its largest extent becomes 1. A rig is there if the file has joints or morph
    targets.

    Args:
        soup: the repaired object.
        surfaces: the surface of each of its parts.
        file: the file, for messages.
        parts: the parts of the file.
        turn: rotation (3, 3) from the file's axes to ours.
    """
    materials = _group_faces_by_material(soup, surfaces)
    try:
        mesh, stored_vertices = make_mesh_from_soup(soup)
        normalised_mesh = replace(normalise_mesh(mesh), materials=materials)
    except InputError as error:  # it does not name the file
        raise InputError(f"{file}: {error}") from None
    # None if nothing in the file moves.
    if stored_vertices is None:
        return normalised_mesh
    rig = _make_rig(mesh, parts, stored_vertices, turn)
    return replace(normalised_mesh, rig=rig)


def _group_faces_by_material(
    soup: TriangleSoup, surfaces: list[ImportedSurface]
) -> dict[str, IntArray]:
    """Return the faces of each material with a name, by that name."""
    material_names, material_of_face = index_materials(soup, surfaces)
    # There is a group for each material up to the last one with faces.
    groups = zip(material_names, group_indices(material_of_face), strict=False)
    return {name: faces for name, faces in groups if name and len(faces)}


def _make_rig(
    mesh: Mesh,
    parts: list[ImportedPart],
    stored_vertices: IntArray,
    turn: Float64Array,
) -> SkeletonRig:
    """Return the rig that moves a mesh.

    Args:
        mesh: the repaired mesh, before it was normalized.
        parts: the parts of the file.
        stored_vertices: (V,) the stored vertex of each vertex of the mesh.
        turn: rotation (3, 3) from the file's axes to ours.
    """
    # Vertices were scaled twice: by the extent of the parts when they were joined, and
    # by that of the repaired mesh when it was normalised.
    soup_extent = compute_extent(parts)
    mesh_extent = float(np.ptp(mesh.vertices.astype(np.float64), axis=0).max())
    # Imported here, since torch takes seconds, and most objects have no joints.
    from advsearch.scene.rigged import SkeletonRig

    movable_parts = [part.movable for part in parts if part.movable is not None]
    return SkeletonRig(
        movable_parts, stored_vertices, turn / (soup_extent * mesh_extent)
    )


def _compute_file_to_mesh(
    parts: list[ImportedPart], soup: TriangleSoup, turn: Float64Array
) -> Float64Array:
    """Return the map (4, 4) from the file's coordinates to the normalised mesh's.

    `join_parts` maps a vertex v to p = turn (v - lowest corner) / extent, and
    `normalise_mesh` maps p to (p - origin) / size. This is the composition of both.

    Args:
        parts: the parts of the file.
        soup: the repaired object.
        turn: rotation (3, 3) from the file's axes to ours.
    """
    used_points = list_used_vertices(parts)
    lowest_corner = np.min([points.min(axis=0) for points in used_points], axis=0)
    origin, size = find_footing(soup.points[find_used(soup.faces, len(soup.points))])
    linear = turn / (compute_extent(parts) * size)
    return make_pose(linear, -linear @ lowest_corner - origin / size)


def _compute_emitted(
    emission: Float32Array | None, opacity: Float32Array | None
) -> Float32Array | None:
    """Return the radiance (H, W, 3) that leaves a surface: emission times opacity.

    Both maps get the size of the wider one (of the higher one, if they are equally
    wide): the opacity is interpolated, and texels of the emission are repeated.

    Args:
        emission: (h, w, 3) linear radiance, or None.
        opacity: (h', w') opacity in [0, 1]; None returns the emission as it is.

    Returns:
        The radiance; None if the surface emits no light.
    """
    if emission is None or opacity is None:
        return emission
    emission_size = (emission.shape[1], emission.shape[0])
    opacity_size = (opacity.shape[1], opacity.shape[0])
    size = max(emission_size, opacity_size)  # compares widths first
    image = Image.fromarray(opacity).resize(size, Image.Resampling.BILINEAR)
    resized_opacity = np.asarray(image)[:, :, None]
    radiance = np.asarray(
        _enlarge_by_repeating(emission, size) * resized_opacity, np.float32
    )
    return radiance if radiance.any() else None


def _enlarge_by_repeating(image: Float32Array, size: tuple[int, int]) -> Float32Array:
    """Return an image (h, w, C) resized to a width and height, without interpolation."""
    width, height = size
    rows, columns = image.shape[:2]
    source_rows = np.arange(height) * rows // height
    source_columns = np.arange(width) * columns // width
    resized: Float32Array = image[source_rows][:, source_columns]
    return resized


TOUCHING_HEIGHT = 0.02
"""Height, as a fraction of the largest extent, up to which a vertex is regarded as
touching the ground. It is not 0, since feet and scans are uneven.
"""
# Ratio of the touching fractions of two axes above which the shape decides which axis
# is up.
MIN_UP_RATIO = 1.1


def guess_up(points: Float64Array, name: str) -> FileAxis:
    """Guess which axis of a mesh points up, y or z, from its shape alone.

    An object that stands upright touches the ground with a large fraction of its
    footprint, seen from above: the foot of a vase, the four wheels of a car. An object
    that lies on its side touches it with a smaller fraction. Tested on 39 meshes of
    several authors and the bundled objects, each with y and with z up, this finds the
    right axis for all that have only one stable upright pose.

    Args:
        points: vertices (P, 3).
        name: name of the file, for the note.

    Returns:
        The axis, and a note with the reason. It is z if the shape does not decide.
    """
    fractions = {
        # with the axes in the order z, x, y: then y is the third axis, up
        "y": compute_touching_fraction(points[:, [2, 0, 1]]),
        "z": compute_touching_fraction(points),
    }
    axis = "z"
    other_axis = "y"
    if fractions["y"] > MIN_UP_RATIO * fractions["z"]:
        axis = "y"
        other_axis = "z"
    reason = _explain_up(fractions[axis], fractions[other_axis])
    return FileAxis(
        axis,
        f"{name}: {axis} is assumed to be up, because {reason}; if it lies on its "
        f"side, set `up={other_axis}`",
    )


def _explain_up(fraction: float, other_fraction: float) -> str:
    """Return why an axis is up, from the touching fractions with it and the other up."""
    if fraction > MIN_UP_RATIO * other_fraction:
        return (
            f"it then rests on {100 * fraction:.0f} % of what it covers, seen "
            f"from above, and on {100 * other_fraction:.0f} % otherwise"
        )
    return "its shape fits y and z equally well"


def compute_touching_fraction(points: Float64Array) -> float:
    """Return the fraction of an object's footprint that touches the ground, in [0, 1].

    Up is the third axis of its points (P, 3). Areas are those of convex hulls, seen
    from above. Points touch the ground if they are within `TOUCHING_HEIGHT` of the
    lowest one.
    """
    height = points[:, 2] - points[:, 2].min()
    is_touching = height <= TOUCHING_HEIGHT * np.ptp(points, axis=0).max()
    covered_area = _compute_hull_area(points[:, :2])
    if covered_area <= 0.0:
        return 0.0
    return _compute_hull_area(points[is_touching, :2]) / covered_area


def _compute_hull_area(points: Float64Array) -> float:
    """Return the area of the convex hull of points (P, 2); 0 if they are on a line."""
    if len(points) < 3:
        return 0.0
    try:
        return float(ConvexHull(points).volume)  # in the plane this is the area
    except QhullError:
        return 0.0
