"""Objects from mesh files: ``--object path.obj`` and the other endings of
`advsearch.files.MESHES`.

A file is a list of parts: one piece of geometry with one surface each, in the file's
own coordinates. The formats have readers of our own: those that there are drop without
a word what they do not know.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image
from scipy.spatial import ConvexHull, QhullError

from advsearch.errors import InputError
from advsearch.pictures import without_pillows_limit
from advsearch.scene.assets import (
    FACINGS,
    LARGEST,
    SMALLEST,
    Doubles,
    FileAxis,
    Floats,
    Material,
    Mesh,
    ObjectAsset,
    grouped,
    normalised,
)
from advsearch.scene.importing import gltf, gltf_parts
from advsearch.scene.importing.files import Notes, safe_name, shown
from advsearch.scene.importing.geometry import (
    Soup,
    assemble,
    compute_turn,
    extent_of,
    join,
    repaired,
)
from advsearch.scene.importing.gltf_entries import Header
from advsearch.scene.importing.parts import ImportedPart, ImportedSurface, visible
from advsearch.scene.importing.readers import (
    GLTF,
    get_reader,
    list_suffixes,
    read_mesh_bytes,
)
from advsearch.scene.importing.texture import by_material, textured


def read_parts(path: Path, data: bytes) -> tuple[list[ImportedPart], list[str]]:
    """Return the parts of a mesh file that have faces (at least one), always in the
    same order, and the warnings. Its ending names the format, and files that it refers
    to are looked up beside it. Raises FileFormatError: it is damaged, not a mesh,
    refers to missing geometry, or has no faces.
    """
    with warnings.catch_warnings(), np.errstate(all="ignore"), without_pillows_limit():
        warnings.simplefilter("ignore")
        notes = Notes(path)
        return get_reader(path.suffix.lower())(path, data, notes), list(notes)


MOST_WARNINGS = 20  # warnings about one file


def import_object(
    path: str | PathLike[str],
    *,
    up: Literal["y", "z"] | None = None,
    facing: str | None = None,
) -> ObjectAsset:
    """Read an object from a mesh file, one of `advsearch.files.MESHES`, with the files
    beside it that it refers to; `up` is the axis that points up in it, None for what
    the format or else the shape says; `facing`, one of `FACINGS`, the one along which
    its front faces, None for what the format says (`find_front`).

    What becomes of materials, units and axes is in docs/scenes.md ("Your own object").
    The geometry is repaired:

    - All of it is joined, with the transforms of the file's scene graph, turned z up
      with its front towards +x, scaled to a largest extent of 1 and set on z = 0.
    - Faces without area are removed, the winding is made consistent, closed shells that
    are inside out are turned over.
    - Normals are the file's; where it has none, or they contradict the faces, they are
      computed: smooth, with creases where faces meet at more than 40 degrees; flat in
      glTF.
    - UVs are the file's, moved into [0, 1] where that takes little. Where it has none,
      where they repeat a texture or are squashed, and where there are several
      materials, xatlas makes new ones and the pictures are baked into maps.

    What is left out or changed is named in the warnings. The same file gives the same
    bytes every time. Raises FileFormatError: the file is missing, of another kind,
    damaged, or holds no faces; the message names it. Raises InputError: `up` is
    neither, `facing` none of them or along the same axis, or the geometry has NaN,
    infinite, or coincident vertices only.
    """
    if up not in (None, "y", "z"):
        raise InputError(f"up axis: expected 'y' or 'z', got {up!r}")
    file = Path(path)
    data = read_mesh_bytes(file, "object", list_suffixes())
    parts, notes = read_parts(file, data)
    header = gltf.read_header(file, data) if file.suffix.lower() in GLTF else None
    notes += [] if header is None else gltf_parts.beside(header, file.name)
    if facing is None:
        front = find_front(file, header, up)
    else:
        front = FileAxis(check_facing(facing, up if header is None else up or "y"))
    return object_of(parts, notes, file, safe_name(file), up, front)


def check_facing(facing: str, up: str | None) -> str:
    """Return an axis of `FACINGS`, of which a sign of plus may be left out. Raises
    InputError: it is none, or the axis that points up.
    """
    axis = facing if facing.startswith(("+", "-")) else f"+{facing}"
    if axis not in FACINGS:
        raise InputError(
            "facing: expected an axis of the file, one of "
            f"{', '.join(FACINGS)}, got {facing!r}"
        )
    if axis[1] == up:
        raise InputError(
            f"facing: {facing} is along the axis that points up, {up}; "
            "give another one, or another `up`"
        )
    return axis


OUR_FRONT = "+x"
"""What is taken for the front where a format has no rule: the axis along which bundled
objects face.
"""
# the axis that points up where the front is along another one that might
UP_OF_FRONT = {"y": "z", "z": "y"}
BLEND = ".blend"
USD = (".usd", ".usda", ".usdc", ".usdz")
VRM_0 = "VRM"  # extensions of glTF
VRM_1 = "VRMC_vrm"


def find_front(path: Path, header: Header | None, up: str | None = None) -> FileAxis:
    """Return the axis along which the front of what is in a file faces, by the rule of
    its format; `header` is that of a glTF file, or of what was converted to glTF.

    The front of a glTF asset faces +Z (Khronos, glTF 2.0, section 3.4), which is -Y in
    Blender. VRM 1.0 says the same, VRM 0.x says -Z. OBJ, PLY, STL and OpenUSD have no
    rule, nor has a glTF file that is said to be z up.
    """
    suffix = path.suffix.lower()
    if header is None or suffix in USD or up == "z":
        axis = OUR_FRONT
        rule = "a format without a rule, as bundled objects face"
    elif VRM_0 in header.extensionsUsed and VRM_1 not in header.extensionsUsed:
        axis = "-z"
        rule = "as VRM 0 says"
    elif suffix == BLEND:
        axis = "+z"
        rule = "-y in Blender, as its front view shows"
    else:
        axis = "+z"
        rule = "as glTF says"
    other = f"-{axis[1]}" if axis[0] == "+" else f"+{axis[1]}"
    return FileAxis(
        axis,
        f"{path.name}: its front is taken to face {axis} of the file ({rule}); if it "
        "faces another way, give that, "
        f"such as `facing={other}`",
    )


def object_of(
    parts: list[ImportedPart],
    notes: list[str],
    file: Path,
    name: str,
    up: str | None,
    front: FileAxis,
) -> ObjectAsset:
    """Return the object of that name which some parts of a file, at least one, make up;
    `notes` are warnings about them so far, `up` as in `import_object`, and `front` the
    axis of its front. Raises InputError: the geometry has NaN, infinite, or coincident
    vertices only.
    """
    seen = visible(parts)
    more = Notes(file)
    gltf_file = file.suffix.lower() in GLTF
    clear = ", ".join(
        dict.fromkeys(
            shown(part.surface.name or "a part") for part in parts if part not in seen
        )
    )
    if clear:
        more.say(
            f"all light passes through {clear} (opacity 0): left out; give it an "
            "opacity to see it"
        )
    parts = seen
    known = up or ("y" if gltf_file else UP_OF_FRONT.get(front.axis[1]))
    if known is None:
        as_stored = join(parts, str(file), np.eye(3))
        axis = guess_up(as_stored.points[np.unique(as_stored.faces)], file.name)
    else:
        axis = FileAxis(known)
    turn = compute_turn(axis.axis, front.axis)
    soup = join(parts, str(file), turn)
    surfaces = [part.surface for part in parts]
    soup, maps = textured(repaired(soup, str(file), more), surfaces, more)
    opacity = (
        np.ascontiguousarray(maps.color[:, :, 3]) if maps.color.shape[2] == 4 else None
    )
    if opacity is not None and not opacity.any():
        opacity = None
        more.say("it is transparent all over; it is shown opaque")
    area = np.bincount(
        soup.part,
        weights=np.linalg.norm(soup.face_vectors(), axis=1),
        minlength=len(surfaces),
    )
    looks = [Material().with_values(vars(surface), "") for surface in surfaces]
    values = np.array([[look.roughness, look.metallic] for look in looks])
    roughness, metallic = map(float, values[area > 0][0])
    if not (values[area > 0] == values[area > 0][0]).all():
        roughness, metallic = map(
            float, (values * area[:, None]).sum(axis=0) / area.sum()
        )
        means = f"{roughness:.2g} and {metallic:.2g}"
        more.say(
            "the roughness and metallic of its materials are replaced by their "
            f"means ({means})"
        )
    warnings = [*notes, *more]
    if (rest := len(warnings) - MOST_WARNINGS) > 0:
        warnings = [
            *warnings[:MOST_WARNINGS],
            f"{file.name}: {rest:,} more warnings are left out",
        ]
    extent = extent_of(parts) * float(
        np.ptp(soup.points[soup.faces].reshape(-1, 3), axis=0).max()
    )
    return ObjectAsset(
        name=name,
        mesh=_mesh(soup, surfaces, file, parts, turn),
        base_color=np.ascontiguousarray(maps.color[:, :, :3]),
        material=Material(roughness=roughness, metallic=metallic),
        source=str(file),
        warnings=tuple(warnings),
        up=axis,
        front=front,
        opacity=opacity,
        normal_map=maps.normals,
        emission=_let_out(maps.emission, opacity),
        metres=extent if gltf_file and SMALLEST <= extent <= LARGEST else None,
        extent=extent,
    )


def _mesh(
    soup: Soup,
    surfaces: list[ImportedSurface],
    file: Path,
    parts: list[ImportedPart],
    upright: Doubles,
) -> Mesh:
    names, number = by_material(soup, surfaces)
    materials = {
        name: faces
        for name, faces in zip(names, grouped(number), strict=False)
        if name and len(faces)
    }
    try:
        mesh, stored = assemble(soup)
        standing = replace(normalised(mesh), materials=materials)
    except InputError as error:  # which knows of no file
        raise InputError(f"{file}: {error}") from None
    if stored is None:
        return standing
    # torch takes seconds, and most have no joints
    from advsearch.scene.rigged import SkeletonRig

    moving = [part.movable for part in parts if part.movable is not None]
    size = extent_of(parts) * float(
        np.ptp(mesh.vertices.astype(np.float64), axis=0).max()
    )
    return replace(standing, rig=SkeletonRig(moving, stored, upright / size))


def _let_out(emission: Floats | None, opacity: Floats | None) -> Floats | None:
    if emission is None or opacity is None:
        return emission
    (rows, columns) = emission.shape[:2]
    (height, width) = opacity.shape
    width, height = max((columns, rows), (width, height))
    share = np.asarray(
        Image.fromarray(opacity).resize((width, height), Image.Resampling.BILINEAR)
    )[:, :, None]
    enlarged = emission[np.arange(height) * rows // height][
        :, np.arange(width) * columns // width
    ]
    radiance = np.asarray(enlarged * share, np.float32)
    return radiance if radiance.any() else None


TOUCHING = 0.02
"""Height, as a share of the largest extent, up to which a vertex touches the ground:
feet and scans are uneven.
"""
# the shares of two axes differ by more than this factor, or the shape does not tell
# which one is up
CLEAR = 1.1


def guess_up(points: Doubles, name: str) -> FileAxis:
    """Return the axis that points up, y or z, by the shape of vertices (P, 3) alone; z
    where that does not tell.

    What stands on a table touches it with a large part of what it covers, seen from
    above: the foot of a vase, the four wheels of a car. Lying on its side it touches
    with less. Of 39 meshes of several authors and the bundled objects, each written
    with y and with z up, it takes the right axis for all that can stand in only one
    way.
    """
    shares = {"y": touching_share(points[:, [2, 0, 1]]), "z": touching_share(points)}
    axis, other = ("y", "z") if shares["y"] > CLEAR * shares["z"] else ("z", "y")
    why = "its shape does not tell, as it rests as well either way"
    if shares[axis] > CLEAR * shares[other]:
        on, otherwise = (f"{100 * shares[way]:.0f} %" for way in (axis, other))
        why = (
            f"it then rests on {on} of what it covers, seen from above, and on "
            f"{otherwise} otherwise"
        )
    return FileAxis(
        axis,
        f"{name}: {axis} is taken for up, because {why}; if it lies "
        f"on its side, give `up={other}`",
    )


def touching_share(points: Doubles) -> float:
    """Return which share, in [0, 1], of what an object covers from above (along its
    third axis) touches the ground: areas of convex hulls.
    """
    height = points[:, 2] - points[:, 2].min()
    touching = height <= TOUCHING * np.ptp(points, axis=0).max()
    covered = _hull_area(points[:, :2])
    return _hull_area(points[touching, :2]) / covered if covered > 0.0 else 0.0


def _hull_area(points: Doubles) -> float:
    if len(points) < 3:
        return 0.0
    try:
        return float(ConvexHull(points).volume)  # in the plane this is the area
    except QhullError:
        return 0.0
