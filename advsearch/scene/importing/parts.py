"""Mesh files as a list of parts: one piece of geometry with one surface each, in the file's own coordinates.

trimesh does the parsing. What it invents where a file is silent (a grey texture, a default colour, normals made on
demand) is told apart from what the file says here and in `surfaces`.
"""

from __future__ import annotations

import contextlib
import io
import logging
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.importing import gltf, gltf_notes
from advsearch.scene.importing.checks import check_faces, checked
from advsearch.scene.importing.files import damaged, shown, text_of
from advsearch.scene.importing.gltf_entries import Header
from advsearch.scene.importing.images import without_pillows_limit
from advsearch.scene.importing.pictures import Pictures
from advsearch.scene.importing.references import GLOW, Named, References
from advsearch.scene.importing.surfaces import UNNAMED, ImportedSurface, SurfaceReader

Array = npt.NDArray[np.float64]

GLTF = (".glb", ".gltf", ".blend")
"""Endings of glTF files, which have conventions of their own: y up, linear colours; and of what is read as glTF."""


@dataclass(frozen=True, eq=False)
class ImportedPart:
    """One piece of a mesh file, with the transform of its place in the file applied.

    Attributes:
        vertices: (V, 3) float64 positions in the file's axes and units; may hold NaN.
        faces: (F, 3) int64 vertex indices, F > 0.
        normals: (V, 3) float64 of the file, not necessarily unit length or finite; None when the file gives none.
        uvs: (V, 2) float64 of the file, v = 0 at the bottom row; None when the file gives none.
        colors: (F, 3, 3) float64 display-referred sRGB of each corner, which multiply the base colour in linear light;
            None when the file gives none.
        surface: the part's material.
        node: number of its node in a glTF file; -1 in others.
    """

    vertices: Array
    faces: npt.NDArray[np.int64]
    normals: Array | None
    uvs: Array | None
    colors: Array | None
    surface: ImportedSurface
    node: int = -1


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep trimesh's log messages, some with tracebacks, and numpy's warnings about damaged files to ourselves."""
    logger, handler = logging.getLogger("trimesh"), logging.NullHandler()
    propagate, logger.propagate = logger.propagate, False
    logger.addHandler(handler)  # without any, Python would print them
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"), without_pillows_limit():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagate


@_silent()
def read_parts(path: Path, data: bytes) -> tuple[list[ImportedPart], list[str]]:
    """Parse a mesh file.

    Args:
        path: the file; its ending names the format, and files that it refers to are looked up beside it.
        data: its content.

    Returns:
        The parts that have faces (at least one), always in the same order, and the warnings.

    Raises:
        FileFormatError: the file is damaged, not a mesh, refers to missing geometry, or has no faces.
    """
    import trimesh  # takes half a second, and bundled objects do without

    references = References(path)
    header = gltf.read_header(path, data) if path.suffix.lower() in GLTF else None
    readable = checked(path, data) if header is None else gltf.rewritten(path, data, header)
    found = _parse(path, readable, references)
    meshes = [one for one in found if isinstance(one[0], trimesh.Trimesh) and len(one[0].faces)]
    if any(np.shape(mesh.vertices)[1:] != (3,) for mesh, _, _ in meshes):
        raise damaged(path, "vertices with 3 coordinates", "another number")
    if any(mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices) for mesh, _, _ in meshes):
        raise damaged(path, "faces of its own vertices", "a face that refers to a vertex that is not there")
    check_faces(path, sum(len(mesh.faces) for mesh, _, _ in meshes))
    if not meshes:
        got = "points or lines only" if found else "none"
        raise FileFormatError(f"{path}: expected a mesh with faces, got {got}; export triangles")
    notes = _file_notes(path, data, header, references)
    if len(meshes) < len(found):
        notes.append(f"{path.name}: {len(found) - len(meshes)} parts without faces (points, lines) are left out")
    named = _named_textures(path, data, header, references)
    materials = len(references.materials) if header is None else len(header.materials)
    pictures = Pictures(materials, references.get, references.refused)
    reader = SurfaceReader(path.name, named, pictures, header)
    parts, edges = [], set[str]()
    for mesh, matrix, node in meshes:
        part = _part(mesh, reader.surface(mesh.visual), linear=path.suffix.lower() in GLTF)
        if _has_face_uvs(path, data):  # trimesh has shuffled the vertices, but not what belongs to them
            part = replace(part, normals=None, colors=None)
        parts.append(replace(_placed(part, matrix), node=node))
        if header is not None and _leaves_its_textures(mesh, part, header):
            edges.add(path.name + gltf_notes.EDGES)
    return parts, [*notes, *edges, *reader.notes]


BEYOND = 0.01
"""How far texture coordinates may lie outside of a texture before it matters how that goes on."""


def _leaves_its_textures(mesh: Any, part: ImportedPart, header: Header) -> bool:
    """Whether a part looks its textures up beyond their edges, where these are not to repeat."""
    entry = gltf.entry_of(header, getattr(getattr(mesh.visual, "material", None), "name", None))
    if part.uvs is None or entry is None or gltf_notes.repeats(header, entry):
        return False
    used = part.uvs[part.faces]
    return not (used.min() >= -BEYOND and used.max() <= 1.0 + BEYOND)


def _parse(path: Path, data: bytes, references: References) -> list[tuple[Any, Array, int]]:
    """Run trimesh's parser; return what it found with transforms (4, 4) and nodes, always in the same order."""
    import trimesh

    kind = path.suffix.lower().lstrip(".").replace("blend", "glb")
    options: dict[str, bool] = {"process": False}
    if kind == "ply":  # with fix_texture, vertices are shuffled and their normals are not
        options["fix_texture"] = _has_face_uvs(path, data)
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=references, **options)
        found = []
        for node in scene.graph.nodes_geometry:
            matrix, name = scene.graph.get(node)
            number = re.match(rf"{gltf.NODE}(\d+)", str(node))
            found.append((str(name), np.asarray(matrix, dtype=np.float64), int(number[1]) if number else -1))
        found.sort(key=lambda item: (item[0], item[1].tobytes(), item[2]))  # the names of nodes can be random
        return [(scene.geometry[name], matrix, number) for name, matrix, number in found]
    except MemoryError:
        raise
    except Exception as error:
        if references.refused:
            name, reason = next(iter(references.refused.items()))
            message = f"{path}: needs {shown(name)}, which {reason}; put that file beside it"
        else:
            words = "".join(c if c.isprintable() else " " for c in str(error)).split()
            reason = " ".join(words)[:120] or type(error).__name__
            message = f"{path}: is not readable {kind.upper()} ({reason}); it is damaged or cut short, export it again"
        raise FileFormatError(message) from error


def _has_face_uvs(path: Path, data: bytes) -> bool:
    """Tell whether a PLY file keeps texture coordinates with its faces, not with its vertices."""
    return path.suffix.lower() == ".ply" and b"texcoord" in data.split(b"end_header")[0]


def _file_notes(path: Path, data: bytes, header: Header | None, references: References) -> list[str]:
    """Return the warnings about material files, and about features of the file that are not carried over."""
    notes = []
    for name, reason in references.refused.items():
        if name.lower().endswith(".mtl"):
            notes.append(
                f"{path.name} names the material file {shown(name)}, which {reason}; neutral grey is used instead"
            )
    if path.suffix.lower() == ".obj" and references.materials:
        used = set(re.findall(r"^\s*usemtl\s+(.*?)\s*$", text_of(data), re.MULTILINE))
        for name in sorted(used - references.materials):
            notes.append(
                f"{path.name} uses the material {shown(name)}, which its .mtl file lacks; neutral grey is used instead"
            )
    notes += [path.name + what for what in gltf_notes.left_out(header)] if header else []
    for what, count in gltf.unread(header).items() if header else ():
        if count:
            verb = "is" if what == GLOW else "are"
            notes.append(f"{path.name}: {what} of {count} material{'s' if count > 1 else ''} {verb} left out")
    return notes


def _named_textures(path: Path, data: bytes, header: Header | None, references: References) -> Named:
    """Return, for each material that names a base colour texture, the file that names it and the texture's name."""
    if path.suffix.lower() == ".ply":
        found = re.search(r"^comment TextureFile\s+(.*?)\s*$", text_of(data.split(b"end_header")[0]), re.MULTILINE)
        return {UNNAMED: (path.name, found[1])} if found else {}
    if header is None:
        return references.named
    images = {
        f"{gltf.MATERIAL}{index}": gltf.image_name(header, material.base_color)
        for index, material in enumerate(header.materials)
    }
    return {name: (path.name, image) for name, image in images.items() if image}


def _part(mesh: Any, surface: ImportedSurface, *, linear: bool) -> ImportedPart:
    """Return what the file says about a parsed mesh; `linear` tells how its vertex colours are encoded."""
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    normals = mesh._cache.cache.get("vertex_normals")  # the public property would make normals up
    uvs = getattr(mesh.visual, "uv", None)
    plain = surface.color is None and surface.texture is None
    colors = _corner_colors(mesh, faces, plain=plain, linear=linear)
    if plain and colors is not None:  # they are the base colour then, and not its factor
        surface = replace(surface, color=np.ones(3, np.float32))
    return ImportedPart(
        vertices=vertices,
        faces=faces,
        normals=None if normals is None else np.asarray(normals, dtype=np.float64),
        uvs=np.asarray(uvs, dtype=np.float64) if uvs is not None and uvs.shape == (len(vertices), 2) else None,
        colors=colors,
        surface=surface,
    )


def _placed(part: ImportedPart, matrix: Array) -> ImportedPart:
    """Return a part moved to its place in the file by an affine transform (4, 4)."""
    if np.array_equal(matrix, np.eye(4)):
        return part
    turn, normals = matrix[:3, :3], part.normals
    with np.errstate(all="ignore"):
        vertices = part.vertices @ turn.T + matrix[:3, 3]
        if normals is not None:  # a normal turns with the cofactors of the matrix
            normals = normals @ np.cross(turn[[1, 2, 0]], turn[[2, 0, 1]]).T
    if not np.linalg.det(turn) < 0.0:
        return replace(part, vertices=vertices, normals=normals)
    colors = None if part.colors is None else part.colors[:, ::-1]  # a mirror turns faces over, and cofactors normals
    return replace(
        part,
        vertices=vertices,
        faces=part.faces[:, ::-1],
        normals=None if normals is None else -normals,
        colors=colors,
    )


def _corner_colors(mesh: Any, faces: npt.NDArray[np.int64], *, plain: bool, linear: bool) -> Array | None:
    """Return the colours that the file gives to vertices or faces.

    Args:
        mesh: as trimesh parsed it.
        faces: (F, 3) its faces.
        plain: whether it has no material; beside one, only the colours of glTF count.
        linear: whether the colours are linear, as in glTF, or display-referred.

    Returns:
        (F, 3, 3) float64 display-referred, or None.
    """
    visual, at = mesh.visual, faces
    if visual.kind == "vertex":
        given = visual.vertex_colors
    elif visual.kind == "face":
        given, at = visual.face_colors, np.repeat(np.arange(len(faces))[:, None], 3, axis=1)
    elif visual.kind == "texture" and "color" in visual.vertex_attributes:
        given = visual.vertex_attributes["color"]
    else:
        given = mesh.vertex_attributes.get("color") if plain else None
    if np.ndim(given) != 2 or len(given) <= int(at.max()) or given.shape[1] < 3:
        return None
    scale = 1.0 if given.dtype.kind == "f" else float(np.iinfo(given.dtype).max)
    colors = np.clip(np.nan_to_num(given[:, :3].astype(np.float32) / np.float32(scale)), 0.0, 1.0)
    return np.asarray((linear_to_srgb(colors) if linear else colors)[at], dtype=np.float64)
