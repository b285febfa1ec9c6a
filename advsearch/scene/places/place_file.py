"""The YAML file of a place: which of its meshes is ground, what shines, what is solid,
and the light it stands in.

    mesh: street.glb
    ground: [road, pavement]
    lane_width: 3.5
    lamps: {street-lamps: [12354, 10437, 7774.5]}
    lights:
      day: {map: day.hdr, lux: 75000}
      rain: {map: grey.hdr, lux: 9000, variant: wet}

Lengths are metres, with the object at the origin, x ahead of it, y to its left and z
up. The mesh has its own axes, as glTF says: y up, and z ahead of the object. All that
has one material is one mesh, named by the material. A variant is one of
KHR_materials_variants.
"""

from __future__ import annotations

import os
from dataclasses import replace
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import ValidationError

from advsearch.errors import FileFormatError, UnknownNameError
from advsearch.scene.assets import Float32Array
from advsearch.scene.footprint import Footprint, Solid
from advsearch.scene.importing.files import format_name, make_safe_name
from advsearch.scene.parts import MeshPart, Place
from advsearch.scene.places.place_meshes import read_place_meshes
from advsearch.scene.places.schema import PlaceFile
from advsearch.trust.named_files import OUTSIDE, is_inside
from advsearch.trust.stored_files import (
    parse_text,
    read_existing_text,
    track_opened_files,
)
from advsearch.trust.yaml_text import MAX_YAML_BYTES, parse_yaml

SUFFIXES = (".yaml", ".yml")
DEFAULT_LUMINANCE = 1000.0  # cd/m2 of a radiance of 1 where the light has no unit

T = TypeVar("T")


def is_place_file(spec: object) -> bool:
    """Return whether a spec is the file of a place: ``a.yaml``, ``a.yaml#night``."""
    return isinstance(spec, (str, Path)) and split_light(str(spec))[0].lower().endswith(
        SUFFIXES
    )


def split_light(spec: str) -> tuple[str, str | None]:
    """Return the file and the light of ``place.yaml#night``.

    The light is None where none is named, or where this is no place file.
    """
    file, mark, light = spec.rpartition("#")
    # A file may have a # in its own name.
    if mark and file.lower().endswith(SUFFIXES) and not os.path.exists(spec):
        return file, light
    return spec, None


def read_place_file(path: Path) -> PlaceFile:
    """Read the YAML file of a place.

    Raises FileFormatError: it is missing, is no YAML, or has other entries or values.
    The message has the first of these, such as "lights.day.lux".
    """
    content = parse_text(
        path,
        read_existing_text(path, "the YAML file of a place", MAX_YAML_BYTES),
        "YAML",
        parse_yaml,
    )
    if not isinstance(content, dict):
        got = "an empty file" if content is None else type(content).__name__
        raise FileFormatError(
            f"{path}: expected entries such as 'mesh: street.glb', got {got}"
        )
    try:
        return PlaceFile.model_validate(content)
    except ValidationError as error:
        raise _make_invalid_entry_error(path, error) from None


def _make_invalid_entry_error(path: Path, error: ValidationError) -> FileFormatError:
    """Return the error for the first wrong entry of the file of a place."""
    first_error = error.errors(include_url=False, include_input=False)[0]
    where = format_name(".".join(map(str, first_error["loc"])), quoted=False)
    problem = first_error["msg"].removeprefix("Value error, ")[:200]
    return FileFormatError(
        f"{path}: {where or 'the file'}: {problem}; docs/scenes.md has an example"
    )


def resolve_sibling_path(path: Path, name: str) -> Path:
    """Return the path of a file that a place's file names, such as its mesh.

    Raises FileFormatError: it leads out of the folder of the place's file, `path`.
    """
    sibling = path.parent / name
    if "\0" in name or not is_inside(sibling, path.parent):
        raise FileFormatError(
            f"{path}: {name[:200]!r} {OUTSIDE}; put it beside the file"
        )
    return sibling


def read_place(path: Path, file: PlaceFile, variant: str | None) -> Place:
    """Read the meshes of a place.

    Args:
        path: the YAML file of the place.
        file: its content.
        variant: name of a variant of the materials, such as "wet"; None for none.

    Raises:
        FileFormatError: the mesh file is missing, damaged or over a limit.
        InputError: its geometry cannot be used.
        UnknownNameError: it has no such variant, or no mesh of a name that the YAML
            file has.
    """
    parts, notes = read_place_meshes(resolve_sibling_path(path, file.mesh), variant)
    _check_mesh_names(path, file, [part.name for part in parts])
    solids = tuple(
        Solid(entry.name, outline)
        for entry in file.solids
        for outline in entry.list_footprints()
    )
    parts = [replace(part, is_ground=part.name in file.ground) for part in parts]
    # A scene stores solids at its meshes, although they belong to the full place. Each
    # has to be in the scene once, so that the first mesh gets all of them. There is
    # one: the file has at least one mesh as ground.
    parts[0] = replace(parts[0], solids=solids)
    directory = Path(os.path.abspath(path)).parent
    return Place(make_safe_name(directory), file, tuple(parts), tuple(notes))


def _check_mesh_names(path: Path, file: PlaceFile, names: list[str]) -> None:
    """Raise UnknownNameError if a place's file states a mesh that is not in `names`."""
    for stated_names in (file.ground, file.lamps):
        for name in stated_names:
            if name not in names:
                raise UnknownNameError(
                    f"mesh of {file.mesh}:", name, names, f"It is named in {path}."
                )


@lru_cache(maxsize=8)
def load_bundled_place(name: str, variant: str | None = None) -> Place:
    """Return a bundled place. Raises FileFormatError: the installation is damaged."""
    with resources.as_file(
        resources.files("advsearch.bundled") / "data" / "places" / name
    ) as directory:
        path = directory / "place.yaml"
        with track_opened_files(path):
            return read_place(path, read_place_file(path), variant)


@lru_cache(maxsize=4)
def make_place_parts(
    place: Place, metres: float, candelas: float | None, *, is_dark: bool
) -> tuple[MeshPart, ...]:
    """Return the meshes of a place in the units of a scene.

    Lengths become object sizes, and emission is divided by `candelas`, so that it is in
    the unit of the environment's radiance. Meshes that are lamps emit only if it is
    dark, and then the luminance that the place's file states.

    Args:
        place: the place, whose lengths are in metres and whose emission is in cd/m2.
        metres: size of the scene's object, which is the unit of its lengths.
        candelas: luminance of a radiance of 1, cd/m2. None if the light has no unit:
            then the lamps stay off, and other emission is divided by
            `DEFAULT_LUMINANCE`.
        is_dark: whether the lamps are on.
    """
    radiance_unit = np.float32(candelas or DEFAULT_LUMINANCE)
    are_lamps_on = is_dark and candelas is not None
    scene_parts: list[MeshPart] = []
    for part in place.parts:
        emission = _find_emission(place, part, are_lamps_on)
        if emission is not None:
            emission = emission / radiance_unit
        scene_parts.append(_make_scene_part(place, part, metres, emission))
    return tuple(scene_parts)


def _make_scene_part(
    owner: Place, part: MeshPart, metres: float, emission: Float32Array | None
) -> MeshPart:
    """Return a mesh of a place with an emission, and lengths in units of some metres."""
    vertices = part.mesh.vertices / np.float32(metres)
    return replace(
        part,
        place=owner,
        mesh=replace(part.mesh, vertices=vertices),
        solids=_scale_solids(part.solids, metres),
        emission=emission,
    )


def _find_emission(
    owner: Place, part: MeshPart, are_lamps_on: bool
) -> Float32Array | None:
    """Return the luminance (H, W, 3) that a mesh of a place emits, in cd/m2, or None."""
    if part.name not in owner.file.lamps:
        return part.emission
    if not are_lamps_on:
        return None
    # one texel of the color that the file states
    return np.array([[owner.file.lamps[part.name]]], np.float32)


def _scale_solids(solids: tuple[Solid, ...], metres: float) -> tuple[Solid, ...]:
    """Return solids with lengths in units of a number of metres."""
    return tuple(
        Solid(name, Footprint(outline / metres, low / metres, high / metres))
        for name, (outline, low, high) in solids
    )
