"""The bundled scene library: reads what the scripts in `scenes/` have built; makes nothing itself.

The files travel inside the package (`advsearch.bundled`, its `data` folder) and are read through `importlib.resources`.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping
from dataclasses import replace
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from advsearch.errors import FileFormatError, UnknownNameError
from advsearch.files import MESHES, either
from advsearch.scene.assets import EnvironmentAsset, Floats, Material, Mesh, ObjectAsset
from advsearch.scene.parts import BASE_COLOR
from advsearch.scene.raster import rasterised

SIDE = 256
"""Texels along the maps of roughness, metal and clear coat."""


def finished(mesh: Mesh, finishes: Mapping[str, Material], main: Material) -> dict[str, object]:
    """Return a principled surface, in Mitsuba's words, as `ObjectAsset.surface` has it: some materials of the mesh as
    `finishes` say, and all other faces like `main`, whose `specular` holds for all."""
    faces = np.tile([main.roughness, main.metallic, main.clearcoat], (len(mesh.faces), 1))
    for name, one in finishes.items():
        faces[mesh.materials[name]] = one.roughness, one.metallic, one.clearcoat
    maps = faces[rasterised(mesh, SIDE).face].astype(np.float32)
    surface: dict[str, object] = {
        "type": "principled",
        "base_color": {"type": BASE_COLOR, "filter_type": "bilinear"},
        "specular": main.specular,
        "clearcoat_gloss": 1.0,
    }
    for channel, name in enumerate(("roughness", "metallic", "clearcoat")):
        picture = maps[:, :, channel : channel + 1]
        surface[name] = {"type": "bitmap", "bitmap": picture, "raw": True, "filter_type": "nearest"}
    return {"type": "twosided", "bsdf": surface}


if TYPE_CHECKING:
    from importlib.abc import Traversable

BUNDLED_OBJECT = "bundled object"
"""Source of an object that is bundled, or another member of its family."""
BUNDLED_ENVIRONMENT = "bundled environment"
"""Source of an environment that is bundled."""
_PLY = (
    rb"ply\nformat binary_little_endian 1\.0\nelement vertex (\d+)\n"
    + b"".join(rb"property float %s\n" % name.encode() for name in ("x", "y", "z", "nx", "ny", "nz", "s", "t"))
    + rb"element face (\d+)\nproperty list uchar uint vertex_indices\n"
)
"""The header of a bundled mesh."""
MAP_HINT = "A path to an .hdr or .exr file works too."
OBJECT_HINT = f"A path to a file that ends in {either(MESHES)} works too."


def _data() -> Traversable:
    return resources.files("advsearch.bundled") / "data"


def list_objects() -> tuple[str, ...]:
    """Return the names of the bundled objects, sorted."""
    return tuple(sorted(p.name for p in (_data() / "objects").iterdir() if (p / "mesh.ply").is_file()))


def list_environments(split: str | None = None) -> tuple[str, ...]:
    """Return the names of the bundled environments, sorted: of the half "train" or "heldout", of "street" or of other
    places ("place"); None for all."""
    facts = _environments().items()
    return tuple(sorted(name for name, fact in facts if split is None or fact["split"] == split))


def _environments() -> dict[str, dict[str, Any]]:
    """What is known of each bundled environment, by name."""
    text = (_data() / "environments" / "environments.json").read_text("utf-8")
    facts: dict[str, dict[str, Any]] = json.loads(text)["environments"]
    return facts


def load_object(name: str) -> ObjectAsset:
    """Return a bundled object, its largest extent 1, standing on z = 0.

    Raises:
        UnknownNameError: there is no such object.
        FileFormatError: the installation is damaged.
    """
    import imageio.v3 as iio  # most scenes need no such file

    known = list_objects()
    if name not in known:
        raise UnknownNameError("object", name, known, OBJECT_HINT)
    folder = _data() / "objects" / name
    try:
        facts = json.loads((folder / "object.json").read_text("utf-8"))
        runs = facts.get("faces", ())  # how many faces in a row have which material
        names = np.repeat([name for name, _ in runs], [count for _, count in runs])
        materials = {str(name): np.nonzero(names == name)[0] for name in dict.fromkeys(names)}
        mesh = replace(_mesh((folder / "mesh.ply").read_bytes()), materials=materials)
        if (folder / "body.npz").is_file():
            from advsearch.scene.people import Person, body_data  # torch takes seconds, and most have no body

            mesh = replace(mesh, rig=Person(body_data()))
        levels = np.asarray(iio.imread((folder / "base_color.png").read_bytes(), extension=".png"))[..., :3]
        material = Material(**facts["material"])
        finishes = {finish: Material(**numbers) for finish, numbers in facts.get("finishes", {}).items()}
        return ObjectAsset(
            name=name,
            mesh=mesh,
            base_color=levels.astype(np.float32) / np.float32(255.0),
            material=material,
            label=facts["label"],
            source=BUNDLED_OBJECT,
            surface=finished(mesh, finishes, material) if finishes else None,
            finishes=finishes,
            metres=facts["metres"],
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileFormatError(f"bundled object {name!r} cannot be read ({error}); reinstall advsearch") from error


def load_environment(name: str) -> EnvironmentAsset:
    """Return a bundled environment.

    Raises:
        UnknownNameError: there is no such environment.
        FileFormatError: the installation is damaged.
    """
    known = list_environments()
    if name not in known:
        raise UnknownNameError("environment", name, known, MAP_HINT)
    facts = _environments()[name]
    try:
        import OpenEXR  # most scenes need no such file

        content = (_data() / "environments" / f"{facts.get('map', name)}.exr").read_bytes()
        with OpenEXR.File(io.BytesIO(content)) as file:
            radiance: Floats = np.ascontiguousarray(file.channels()["RGB"].pixels[..., :3], dtype=np.float32)
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise FileFormatError(f"bundled environment {name!r} cannot be read ({error}); reinstall advsearch") from error
    return EnvironmentAsset(
        name, radiance, source=BUNDLED_ENVIRONMENT, ground=facts.get("ground"), candelas=facts.get("candelas")
    )


def _mesh(content: bytes) -> Mesh:
    """Decode a binary PLY as `scenes/files.py` writes it: vertices, normals and texture coordinates, then triangles.

    Raises:
        ValueError: it is another PLY.
    """
    header, _, body = content.partition(b"end_header\n")
    counts = re.fullmatch(_PLY, header)
    if counts is None:
        raise ValueError("mesh.ply has another header than the scripts in scenes/ write")
    vertices = np.frombuffer(body, "<f4", 8 * int(counts[1])).reshape(-1, 8).astype(np.float32)
    corners = np.dtype([("count", "u1"), ("vertices", "<u4", 3)])
    faces = np.frombuffer(body, corners, int(counts[2]), offset=4 * vertices.size)
    return Mesh(
        vertices=np.ascontiguousarray(vertices[:, :3]),
        faces=faces["vertices"].astype(np.uint32),
        normals=np.ascontiguousarray(vertices[:, 3:6]),
        uvs=np.ascontiguousarray(vertices[:, 6:]),
    )
