"""Mesh files as a list of parts: one piece of geometry with one surface each, in the file's own coordinates.

trimesh parses glTF. What it invents where a file is silent (a grey texture, a default colour, normals made on demand)
is told apart from what the file says here and in `surfaces`. The other formats have readers of our own (`READERS`):
those that there are drop without a word what they do not know.
"""

from __future__ import annotations

import contextlib
import io
import logging
import re
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.scene.importing import gltf, gltf_notes
from advsearch.scene.importing.checks import check_faces
from advsearch.scene.importing.files import damaged, shown
from advsearch.scene.importing.gltf_entries import Header
from advsearch.scene.importing.images import without_pillows_limit
from advsearch.scene.importing.imported_part import ImportedPart, placed
from advsearch.scene.importing.pictures import Pictures
from advsearch.scene.importing.ply import read_ply
from advsearch.scene.importing.references import GLOW, References
from advsearch.scene.importing.stl import read_stl
from advsearch.scene.importing.surfaces import ImportedSurface, Named, SurfaceReader
from advsearch.scene.importing.wavefront import read_obj

Array = npt.NDArray[np.float64]

GLTF = (".glb", ".gltf", ".blend")
"""Endings of glTF files, which have conventions of their own: y up, linear colours; and of what is read as glTF."""


READERS = {".obj": read_obj, ".ply": read_ply, ".stl": read_stl}
"""Readers of the other formats, by their endings."""


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
    if path.suffix.lower() in READERS:
        return READERS[path.suffix.lower()](path, data)
    import trimesh  # takes half a second, and bundled objects do without

    references = References(path)
    header = gltf.read_header(path, data)
    found = _parse(path, gltf.rewritten(path, data, header), references)
    meshes = [one for one in found if isinstance(one[0], trimesh.Trimesh) and len(one[0].faces)]
    if any(np.shape(mesh.vertices)[1:] != (3,) for mesh, _, _ in meshes):
        raise damaged(path, "vertices with 3 coordinates", "another number")
    if any(mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices) for mesh, _, _ in meshes):
        raise damaged(path, "faces of its own vertices", "a face that refers to a vertex that is not there")
    check_faces(path, sum(len(mesh.faces) for mesh, _, _ in meshes))
    if not meshes:
        got = "points or lines only" if found else "none"
        raise FileFormatError(f"{path}: expected a mesh with faces, got {got}; export triangles")
    notes = _file_notes(path, header)
    if len(meshes) < len(found):
        notes.append(f"{path.name}: {len(found) - len(meshes)} parts without faces (points, lines) are left out")
    pictures = Pictures(len(header.materials), references.get, references.refused)
    reader = SurfaceReader(path.name, _named_textures(path, header), pictures, header)
    parts, edges = [], set[str]()
    for mesh, matrix, node in meshes:
        part = placed(_part(mesh, reader.surface(mesh.visual)), matrix)
        parts.append(replace(part, node=node))
        if _leaves_its_textures(mesh, part, header):
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
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=references, process=False)
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


def _file_notes(path: Path, header: Header) -> list[str]:
    """Return the warnings about features of the file that are not carried over."""
    notes = [path.name + what for what in gltf_notes.left_out(header)]
    for what, count in gltf.unread(header).items():
        if count:
            verb = "is" if what == GLOW else "are"
            notes.append(f"{path.name}: {what} of {count} material{'s' if count > 1 else ''} {verb} left out")
    return notes


def _named_textures(path: Path, header: Header) -> Named:
    """Return, for each material that names a base colour texture, the file that names it and the texture's name."""
    images = {
        f"{gltf.MATERIAL}{index}": gltf.image_name(header, material.base_color)
        for index, material in enumerate(header.materials)
    }
    return {name: (path.name, image) for name, image in images.items() if image}


def _part(mesh: Any, surface: ImportedSurface) -> ImportedPart:
    """Return what the file says about a parsed mesh."""
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    normals = mesh._cache.cache.get("vertex_normals")  # the public property would make normals up
    uvs = getattr(mesh.visual, "uv", None)
    plain = surface.color is None and surface.texture is None
    colors = _corner_colors(mesh, faces, plain=plain)
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


def _corner_colors(mesh: Any, faces: npt.NDArray[np.int64], *, plain: bool) -> Array | None:
    """Return the colours that the file gives to vertices or faces.

    Args:
        mesh: as trimesh parsed it.
        faces: (F, 3) its faces.
        plain: whether it has no material; beside one, only the colours of glTF count.

    Returns:
        (F, 3, 3) float64 linear, or None.
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
    return np.asarray(colors[at], dtype=np.float64)
