"""The bundled scene library: reads what the scripts in `scenes/` have built; makes
nothing itself.

The files travel inside the package (`advsearch.bundled`, its `data` folder) and are
read through `importlib.resources`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from advsearch.errors import FileFormatError, InputError, UnknownNameError
from advsearch.files import MESHES, join_alternatives
from advsearch.scene.assets import (
    BoolArray,
    EnvironmentAsset,
    Float32Array,
    Float64Array,
    IntArray,
    Material,
    Mesh,
    ObjectAsset,
)
from advsearch.scene.importing.files import Notes, make_safe_name, read_bytes
from advsearch.scene.importing.hdr import Plane, decode_rgbe, read_exr, read_radiance
from advsearch.scene.importing.pictures import average_area, average_in_bands
from advsearch.scene.importing.ply import read_elements
from advsearch.scene.parts import BASE_COLOR
from advsearch.scene.raster import rasterize_charts

MATERIAL_MAP_SIDE = 256  # texels along the maps of roughness, metal and clear coat


def make_finished_surface(
    mesh: Mesh, finishes: Mapping[str, Material], main: Material
) -> dict[str, object]:
    """Return Mitsuba's description of a principled surface with several finishes.

    Roughness, metallic and clear coat become textures. Their texels are not
    interpolated, so that the border between two materials stays sharp.

    Args:
        mesh: mesh whose faces have materials by name.
        finishes: numbers of some materials, by name.
        main: numbers of all other faces. Its `specular` holds for all faces.

    Returns:
        A dictionary as `ObjectAsset.surface` has it.
    """
    face_values = _tabulate_finishes(mesh, finishes, main)
    face_of_texel = rasterize_charts(mesh, MATERIAL_MAP_SIDE).face_index
    texel_values = face_values[face_of_texel].astype(np.float32)
    surface: dict[str, object] = {
        "type": "principled",
        "base_color": {"type": BASE_COLOR, "filter_type": "bilinear"},
        "specular": main.specular,
        "clearcoat_gloss": 1.0,
    }
    # in the order of the face values
    for channel, name in enumerate(("roughness", "metallic", "clearcoat")):
        texel_channel = texel_values[:, :, channel : channel + 1]
        surface[name] = _make_sharp_bitmap(texel_channel)
    return {"type": "twosided", "bsdf": surface}


def _tabulate_finishes(
    mesh: Mesh, finishes: Mapping[str, Material], main: Material
) -> Float64Array:
    """Return roughness, metallic and clear coat (F, 3) of each face of a mesh.

    The arguments are those of `make_finished_surface`.
    """
    face_values = np.tile(
        [main.roughness, main.metallic, main.clearcoat], (len(mesh.faces), 1)
    )
    for name, finish in finishes.items():
        face_indices = mesh.materials[name]
        face_values[face_indices] = (
            finish.roughness,
            finish.metallic,
            finish.clearcoat,
        )
    return face_values


def _make_sharp_bitmap(texels: Float32Array) -> dict[str, object]:
    """Return Mitsuba's texture of texels (h, w, 1) that are not interpolated."""
    return {
        "type": "bitmap",
        "bitmap": texels,
        "raw": True,
        "filter_type": "nearest",
    }


if TYPE_CHECKING:
    from importlib.abc import Traversable

    from advsearch.scene.people import Person

# source of an object that is bundled, or another member of its family
BUNDLED_OBJECT = "bundled object"
BUNDLED_ENVIRONMENT = "bundled environment"  # source of an environment that is bundled
MAP_HINT = "A path to an .hdr or .exr file, or to the .yaml file of a place, works too."
OBJECT_HINT = f"A path to a file that ends in {join_alternatives(MESHES)} works too."


def _get_data_directory() -> Traversable:
    """Return the directory of the bundled data."""
    return resources.files("advsearch.bundled") / "data"


def list_objects() -> tuple[str, ...]:
    """Return the sorted names of bundled objects."""
    return tuple(
        sorted(
            p.name
            for p in (_get_data_directory() / "objects").iterdir()
            if (p / "mesh.ply").is_file()
        )
    )


def list_environments(split: str | None = None) -> tuple[str, ...]:
    """Return the sorted names of bundled environments.

    `split` selects those of "train", "heldout", "street" or "place".
    """
    facts_by_name = _read_environment_facts()
    return tuple(
        sorted(
            name
            for name, fact in facts_by_name.items()
            if split is None or fact["split"] == split
        )
    )


def _read_environment_facts() -> dict[str, dict[str, Any]]:
    """Return what the scripts have stored about each bundled environment, by name."""
    text = (_get_data_directory() / "environments" / "environments.json").read_text(
        "utf-8"
    )
    facts: dict[str, dict[str, Any]] = json.loads(text)["environments"]
    return facts


def load_object(name: str) -> ObjectAsset:
    """Return a bundled object, its largest extent 1, standing on z = 0.

    Args:
        name: its name, such as "mug".

    Raises:
        FileFormatError: the installation is damaged.
        UnknownNameError: there is no such object.
    """
    known_names = list_objects()
    if name not in known_names:
        raise UnknownNameError("object", name, known_names, OBJECT_HINT)
    directory = _get_data_directory() / "objects" / name
    try:
        return _read_object(name, directory)
    except (OSError, ValueError, KeyError, TypeError, FileFormatError) as error:
        raise FileFormatError(
            f"bundled object {name!r} cannot be read ({error}); reinstall advsearch"
        ) from error


def _read_object(name: str, directory: Traversable) -> ObjectAsset:
    """Return a bundled object from the directory of its files."""
    facts = json.loads((directory / "object.json").read_text("utf-8"))
    mesh = _read_mesh(name, directory, facts.get("faces", ()))
    base_color = _read_base_color(directory)
    material = Material(**facts["material"])
    finish_values = facts.get("finishes", {})
    finishes = {name: Material(**values) for name, values in finish_values.items()}
    surface = make_finished_surface(mesh, finishes, material) if finishes else None
    return ObjectAsset(
        name=name,
        mesh=mesh,
        base_color=base_color,
        material=material,
        label=facts["label"],
        source=BUNDLED_OBJECT,
        surface=surface,
        finishes=finishes,
        size_in_metres=facts["metres"],
        drives=facts.get("drives", False),
    )


def _read_base_color(directory: Traversable) -> Float32Array:
    """Return the base color (H, W, 3) of a bundled object, in [0, 1]."""
    import imageio.v3 as iio  # most scenes need no such file

    content = (directory / "base_color.png").read_bytes()
    levels = np.asarray(iio.imread(content, extension=".png"))[..., :3]
    base_color: Float32Array = levels.astype(np.float32) / np.float32(255.0)
    return base_color


def _read_mesh(
    name: str, directory: Traversable, material_runs: Sequence[tuple[str, int]]
) -> Mesh:
    """Read the mesh of a bundled object, with the rig of a body if it has one.

    Args:
        name: name of the object, for messages.
        directory: directory of its files.
        material_runs: in the order of the faces, a material's name and how many
            successive faces have it. It is empty if the mesh has no named materials.
    """
    elements, _ = read_elements((directory / "mesh.ply").read_bytes(), Notes(name))
    columns = elements["vertex"].scalars
    faces = elements["face"].lists["vertex_indices"].values
    positions, normals, uvs = (
        np.stack([columns[axis] for axis in axes], axis=1).astype(np.float32)
        for axes in (("x", "y", "z"), ("nx", "ny", "nz"), ("s", "t"))
    )
    has_body = (directory / "body.npz").is_file()
    return Mesh(
        positions,
        faces.reshape(-1, 3).astype(np.uint32),
        normals,
        uvs,
        materials=_group_faces(material_runs),
        rig=make_person() if has_body else None,
    )


def _group_faces(material_runs: Sequence[tuple[str, int]]) -> dict[str, IntArray]:
    """Return the indices of the faces of each material, by its name.

    The argument is that of `_read_mesh`.
    """
    # (F,) name of each face's material
    material_of_face = np.repeat(
        [material for material, _ in material_runs],
        [count for _, count in material_runs],
    )
    return {
        str(material): np.nonzero(material_of_face == material)[0]
        for material in dict.fromkeys(material_of_face)
    }


def make_person(defaults: Mapping[str, float] = MappingProxyType({})) -> Person:
    """Return the bundled body, with other defaults such as ``{"height": 1.8}``.

    See the control `body`.
    """
    # torch takes seconds, and most objects have no body
    from advsearch.scene.people import Person, load_body

    return Person(load_body(), defaults)


def load_environment(name: str) -> EnvironmentAsset:
    """Return a bundled environment.

    Several environments may share one map, with different grounds.

    Args:
        name: name of the environment.

    Raises:
        FileFormatError: the installation is damaged.
        UnknownNameError: there is no such environment.
    """
    known_names = list_environments()
    if name not in known_names:
        raise UnknownNameError("environment", name, known_names, MAP_HINT)
    facts = _read_environment_facts()[name]
    radiance = _read_map(name, facts.get("map", name))
    ground = facts.get("ground")
    candelas = facts.get("candelas")  # luminance of a radiance of 1, cd/m2
    return EnvironmentAsset(
        name, radiance, source=BUNDLED_ENVIRONMENT, ground=ground, candelas=candelas
    )


def _read_map(name: str, map_name: str) -> Float32Array:
    """Return the map (H, W, 3) of a bundled environment, which others may share.

    Raises FileFormatError: the installation is damaged.
    """
    try:
        content = _get_map_file(map_name).read_bytes()
        planes, _notes = read_exr(Path(name), content)  # red, green and blue
        radiance: Float32Array = np.stack(planes, axis=2).astype(np.float32)
    except (OSError, FileFormatError) as error:
        raise FileFormatError(
            f"bundled environment {name!r} cannot be read ({error}); "
            "reinstall advsearch"
        ) from error
    return radiance


def _get_map_file(map_name: str) -> Traversable:
    """Return the file of a bundled map."""
    return _get_data_directory() / "environments" / f"{map_name}.exr"


# ---- Environments from pictures: ``--environment path.hdr|.exr``, equirectangular maps
# in linear radiance -----------

ENVIRONMENT_SUFFIXES = (".hdr", ".exr")  # the pictures that can be imported
# rows and columns of the largest environment kept; larger ones are averaged down
MAX_MAP_SIZE = (512, 1024)
# rows and columns that a smaller one is brought up to by repeating its texels;
# renderers need a few
MIN_MAP_SIZE = (4, 8)


@dataclass(frozen=True, eq=False)
class LightImage:
    """An image in linear radiance.

    Attributes:
        size: rows and columns.
        read_rows: returns the rows from its first argument to before its second, (n, W,
            3) float32.
        notes: clauses about what is left out.
    """

    size: tuple[int, int]
    read_rows: Callable[[int, int], Float32Array]
    notes: tuple[str, ...]


def read_light(path: Path, label: str = "environment") -> LightImage:
    """Read an ``.hdr`` or ``.exr`` image of any height and width.

    Its rows become floats only when they are read, so that a large image takes less
    memory.

    Args:
        path: the file.
        label: what the image is, for messages.

    Raises:
        FileFormatError: the file is missing, of another kind, damaged, or lacks
            channels.
        InputError: values are negative, NaN or infinite.
    """
    data = read_bytes(path, label, ENVIRONMENT_SUFFIXES)
    if path.suffix.lower() == ".hdr":
        # RGBE pixels, and the factor from their numbers to radiance
        pixels, scale, notes = read_radiance(path, data)
        return LightImage(
            size=pixels.shape[:2],
            read_rows=lambda top, end: decode_rgbe(pixels[top:end]) * scale,
            notes=tuple(notes),
        )
    planes, notes = read_exr(path, data)
    _check_planes(path, planes)

    def read_rows(top: int, end: int) -> Float32Array:
        """Return rows (n, W, 3) of the three planes."""
        return np.stack([plane[top:end] for plane in planes], axis=2).astype(np.float32)

    return LightImage(size=planes[0].shape, read_rows=read_rows, notes=tuple(notes))


# values that a map may not have: a name, a test of a plane's texels, and a remedy
_BAD_RADIANCES: tuple[tuple[str, Callable[[Plane], BoolArray], str], ...] = (
    ("NaN", np.isnan, "paint them over"),
    (
        "infinite",
        np.isinf,
        "clamp them, or save the map in 32-bit floats if half floats overflowed",
    ),
    ("negative", lambda plane: plane < 0.0, "clamp them to 0"),
)


def _check_planes(path: Path, planes: Sequence[Plane]) -> None:
    """Check the radiance of an ``.exr`` image.

    The format of ``.hdr`` files cannot represent such values. Negative infinity is
    reported as infinite, since that is tested first.

    Raises InputError: a texel is NaN, infinite or negative in one of its three planes.
    """
    for kind, is_bad, remedy in _BAD_RADIANCES:
        bad_texels = is_bad(planes[0]) | is_bad(planes[1]) | is_bad(planes[2])
        if bad_texels.any():
            raise InputError(
                f"{path}: expected finite radiance of at least 0, got "
                f"{_describe_bad_texels(planes, bad_texels, kind)}; {remedy}"
            )


def _describe_bad_texels(planes: Sequence[Plane], is_bad: BoolArray, kind: str) -> str:
    """Return how many texels (H, W) of three planes are bad, and the first of them.

    `kind` is what they are, such as "NaN".
    """
    row, column = np.unravel_index(int(is_bad.argmax()), is_bad.shape)
    value = ", ".join(f"{float(plane[row, column]):.4g}" for plane in planes)
    return (
        f"{int(is_bad.sum())} of {is_bad.size} texels"
        f" {kind} (the first in row {row}, column {column}: {value})"
    )


def import_environment(path: str | PathLike[str]) -> EnvironmentAsset:
    """Read an equirectangular environment map from an ``.hdr`` or ``.exr`` file.

    It is a Radiance ``.hdr`` (RGBE), or an ``.exr`` with channels R, G and B, or Y
    alone (grey), in half or float; see `advsearch.scene.importing.hdr`.

    Maps larger than `MAX_MAP_SIZE` are averaged down, each texel weighted by the solid
    angle that it covers, so that the light from each direction stays the same in the
    mean. Row 0 is up; columns stay in the file's order.

    Raises:
        FileFormatError: the file is missing, of another kind, damaged, or lacks
            channels.
        InputError: values are negative, NaN or infinite; the message counts them and
            gives the first position.
    """
    file = Path(path)
    light_image = read_light(file)
    notes = [f"{file.name}: {note}" for note in light_image.notes]
    notes += _describe_stretch(file.name, light_image.size)
    radiance = _resize_map(light_image.read_rows, light_image.size)
    if not radiance.any():
        notes.append(
            f"{file.name}: the environment is black everywhere; it lights nothing"
        )
    return EnvironmentAsset(
        make_safe_name(file),
        radiance,
        source=str(file),
        warnings=tuple(notes),
        photographed=True,
    )


def _describe_stretch(name: str, size: tuple[int, int]) -> list[str]:
    """Return a note if a map of a height and a width is not twice as wide as high."""
    height, width = size
    # one percent: a map of odd size may miss it by a row
    if abs(width / (2 * height) - 1.0) <= 0.01:
        return []
    return [
        f"{name}: expected a map twice as wide as high, got {width} "
        f"x {height}; it appears stretched"
    ]


def _resize_map(
    read_rows: Callable[[int, int], Float32Array], size: tuple[int, int]
) -> Float32Array:
    """Bring a map to a size from `MIN_MAP_SIZE` to `MAX_MAP_SIZE`.

    A larger map is averaged down, both sides by the same factor. The texels of a
    smaller one are repeated.

    Args:
        read_rows: returns the rows (n, W, 3) from a first row to an end.
        size: height and width of the map.
    """
    texels = _shrink_map(read_rows, size)
    # how often a texel is repeated along each side; 1 for a map that is large enough
    row_repeats = math.ceil(MIN_MAP_SIZE[0] / texels.shape[0])
    column_repeats = math.ceil(MIN_MAP_SIZE[1] / texels.shape[1])
    return np.asarray(
        texels.repeat(row_repeats, axis=0).repeat(column_repeats, axis=1),
        dtype=np.float32,
    )


def _shrink_map(
    read_rows: Callable[[int, int], Float32Array], size: tuple[int, int]
) -> Float32Array:
    """Return a map, averaged down to `MAX_MAP_SIZE` if it is larger.

    The arguments are those of `_resize_map`.
    """
    height, width = size
    shrink = min(1.0, MAX_MAP_SIZE[0] / height, MAX_MAP_SIZE[1] / width)
    if shrink == 1.0:
        return read_rows(0, height)
    target_shape = max(1, round(height * shrink)), max(1, round(width * shrink))
    return _average_map(read_rows, size, target_shape)


def _average_map(
    read_rows: Callable[[int, int], Float32Array],
    size: tuple[int, int],
    target_shape: tuple[int, int],
) -> Float32Array:
    """Average a map down to a shape, weighted by the solid angles of its texels.

    The solid angle is proportional to the sine of the angle between a texel's row and
    straight up. The weighted texels are averaged, and divided by the averaged weights.

    Args:
        read_rows: returns the rows (n, W, 3) from a first row to an end.
        size: height and width of the map.
        target_shape: height and width of the result.
    """
    row_weights = _compute_row_weights(size[0])[:, None, None]
    weighted_mean = average_in_bands(
        lambda top, end: read_rows(top, end) * row_weights[top:end], size, target_shape
    )
    mean_weight = average_area(row_weights, height=target_shape[0], width=1)
    return np.asarray(weighted_mean / mean_weight)


def _compute_row_weights(height: int) -> Float32Array:
    """Return weights (height,) of a map's rows, the sines of their angles to +z."""
    step = np.float32(np.pi / height)
    polar = (np.arange(height, dtype=np.float32) + np.float32(0.5)) * step
    return np.asarray(np.sin(polar))
