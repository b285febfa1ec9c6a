"""Writes advsearch/bundled/data from the generators, or checks that it is what they
make.

``python scenes/build.py`` rewrites every file; ``--check`` writes nothing, names the
files that differ and exits 3. Processors round differently: numbers may differ by what
`GEOMETRY`, `NORMALS`, `LEVELS`, `RADIANCE` and `FACTS` say.
"""

from __future__ import annotations

import argparse
import io
import itertools
import json
import math
import struct
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import numpy.typing as npt
import yaml
from PIL import Image

from advsearch.questions.harden.objects import OBJECTS, ObjectFamily
from advsearch.scene.assets import Mesh
from advsearch.scene.importing.hdr import read_exr
from scenes.environments import ENVIRONMENTS, EnvironmentFamily
from scenes.files import exr, ply, png
from scenes.places import PLACES, place_files

Floats = npt.NDArray[np.float32]

FOLDER = "advsearch/bundled/data"
DATA = Path(__file__).resolve().parents[1] / FOLDER

# of the mesh's largest coordinate; vertices of the person are rounded to 1e-6 when they
# are made
GEOMETRY = 1e-5
# those of small triangles turn by so much where a vertex is moved by 1e-6
NORMALS = 1e-3
LEVELS = 1  # of 255, in a texture
RADIANCE = 2e-3  # as a share: two steps of a half
FACTS = 1e-6  # as a share, of numbers in JSON


def object_files(family: ObjectFamily) -> dict[str, bytes]:
    """Return the files of a family's canonical instance, by path below the data
    folder.
    """
    asset = family.generate(None)
    facts = {
        "schema": 1,
        "name": asset.name,
        "label": asset.label,
        "material": asdict(asset.material),
        # the family's file has moved to advsearch/questions/harden/objects; what is
        # shipped keeps its bytes
        "source": f"scenes/objects/{family.make_instance.__module__.rpartition('.')[2]}.py"
        if asset.mesh.rig is None
        else "scenes/person.py, of MakeHuman's data (CC0 1.0)",
        "triangles": len(asset.mesh.faces),
        "metres": asset.size_in_metres,
    }
    if asset.drives:
        facts["drives"] = True
    if asset.finishes:
        facts["finishes"] = {name: asdict(one) for name, one in asset.finishes.items()}
        facts["faces"] = _runs(asset.mesh)
    folder = f"objects/{family.name}"
    return {
        f"{folder}/mesh.ply": ply(asset.mesh),
        f"{folder}/base_color.png": png(asset.base_color),
        f"{folder}/object.json": (json.dumps(facts, indent=1) + "\n").encode(),
    }


def _runs(mesh: Mesh) -> list[tuple[str, int]]:
    """Return the materials of a mesh's faces, one after the other: the name and how
    many faces have it in a row.
    """
    names = np.empty(len(mesh.faces), dtype=object)
    for name, faces in mesh.materials.items():
        names[faces] = name
    return [(str(name), len(list(run))) for name, run in itertools.groupby(names)]


def environment_files(family: EnvironmentFamily) -> dict[str, bytes]:
    """Return an environment's file, by path below the data folder; none where it has
    the map of another one.
    """
    return (
        {}
        if family.map
        else {f"environments/{family.name}.exr": exr(family.make().radiance)}
    )


def everything() -> Iterator[tuple[str, bytes]]:
    """Yield every file of the data folder: relative path, content."""
    for thing in OBJECTS.values():
        yield from object_files(thing).items()
    for light in ENVIRONMENTS.values():
        yield from environment_files(light).items()
    for name, make in PLACES.items():
        yield from place_files(name, make()).items()
    facts = {
        name: {"split": family.split, "source": family.script}
        | ({"ground": family.ground} if family.ground else {})
        | ({"map": family.map} if family.map else {})
        | ({"candelas": family.make().candelas} if family.lux else {})
        for name, family in ENVIRONMENTS.items()
    }
    yield (
        "environments/environments.json",
        (json.dumps({"schema": 1, "environments": facts}, indent=1) + "\n").encode(),
    )


def is_close(name: str, stored: bytes, made: bytes) -> bool:
    """Return whether a stored file is what was made, but for rounding; `name` says what
    it is.
    """
    if stored == made:
        return True
    compare = {
        ".ply": _is_close_mesh,
        ".png": _is_close_image,
        ".exr": _is_close_map,
        ".json": _is_close_facts,
        ".glb": _is_close_glb,
        ".yaml": _is_close_yaml,
    }
    try:
        return Path(name).suffix in compare and compare[Path(name).suffix](stored, made)
    except (
        ValueError,
        OSError,
        RuntimeError,
        KeyError,
        struct.error,
        yaml.YAMLError,
    ):  # a damaged file
        return False


def is_close_vertices(stored: Floats, made: Floats) -> bool:
    """Return whether vertices (V, 8), position, normal and texture coordinates each,
    differ by rounding only.
    """
    if stored.shape != made.shape:
        return False
    difference = np.abs(stored - made)
    largest = float(np.abs(made[:, :3]).max())
    return bool(
        difference[:, :3].max() <= GEOMETRY * largest
        and difference[:, 3:6].max() <= NORMALS
        and difference[:, 6:].max() <= GEOMETRY
    )


def _is_close_mesh(stored: bytes, made: bytes) -> bool:
    end = b"end_header\n"
    header, _, rest = made.partition(end)
    stored_header, _, stored_rest = stored.partition(end)
    count = int(header.partition(b"element vertex ")[2].split(maxsplit=1)[0])
    size = count * 8 * 4
    if stored_header != header or stored_rest[size:] != rest[size:]:
        return False
    tables = [
        np.frombuffer(data[:size], "<f4").reshape(count, 8)
        for data in (stored_rest, rest)
    ]
    return is_close_vertices(*tables)


def _is_close_image(stored: bytes, made: bytes) -> bool:
    first, second = (
        np.asarray(Image.open(io.BytesIO(data), formats=["PNG"])).astype(int)
        for data in (stored, made)
    )
    return first.shape == second.shape and int(np.abs(first - second).max()) <= LEVELS


def _is_close_map(stored: bytes, made: bytes) -> bool:
    first, second = (
        np.stack(read_exr(Path("map.exr"), data)[0]).astype(np.float64)
        for data in (stored, made)
    )
    return first.shape == second.shape and np.allclose(
        first, second, rtol=RADIANCE, atol=1e-6
    )


def _is_close_facts(stored: bytes, made: bytes) -> bool:
    return _is_close_value(json.loads(stored), json.loads(made))


def _is_close_yaml(stored: bytes, made: bytes) -> bool:
    return _is_close_value(yaml.safe_load(stored), yaml.safe_load(made))


def _is_close_glb(stored: bytes, made: bytes) -> bool:
    (first_header, first_parts) = _read_glb(stored)
    (second_header, second_parts) = _read_glb(made)
    if not _is_close_value(first_header, second_header) or len(first_parts) != len(
        second_parts
    ):
        return False
    return all(map(_is_close_part, first_parts, second_parts))


def _is_close_part(stored: bytes | Floats, made: bytes | Floats) -> bool:
    if isinstance(stored, bytes) or isinstance(made, bytes):
        is_picture = isinstance(stored, bytes) and isinstance(made, bytes)
        return is_picture and (stored == made or _is_close_image(stored, made))  # type: ignore[arg-type]
    if stored.shape != made.shape:
        return False
    return float(np.abs(stored - made).max()) <= GEOMETRY * max(
        1.0, float(np.abs(made).max())
    )


def _read_glb(data: bytes) -> tuple[dict[str, object], list[bytes | Floats]]:
    """Return the header of a binary glTF file without what depends on lengths, its
    pictures and its numbers.
    """
    (length,) = struct.unpack_from("<12xI", data)
    header = json.loads(data[20 : 20 + length])
    body = data[28 + length :]
    views = [
        body[view["byteOffset"] :][: view["byteLength"]]
        for view in header.pop("bufferViews")
    ]
    parts: list[bytes | Floats] = [
        views[image["bufferView"]] for image in header.pop("images", [])
    ]
    kinds = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
    for accessor in header["accessors"]:
        parts.append(
            np.frombuffer(
                views[accessor.pop("bufferView")], kinds[accessor["componentType"]]
            )
        )
        for bound in ("min", "max"):
            accessor.pop(bound, None)
    header.pop("buffers")
    return header, parts


def _is_close_value(stored: object, made: object) -> bool:
    if isinstance(stored, dict) and isinstance(made, dict):
        return stored.keys() == made.keys() and all(
            _is_close_value(stored[key], made[key]) for key in made
        )
    if isinstance(stored, list) and isinstance(made, list):
        return len(stored) == len(made) and all(map(_is_close_value, stored, made))
    if isinstance(stored, float) and isinstance(made, float):
        return math.isclose(stored, made, rel_tol=FACTS)
    return type(stored) is type(made) and stored == made


def differing() -> list[str]:
    """Return the files that are missing, left over, or not what the generators make,
    but for rounding.
    """
    made = dict(everything())
    there = (
        {p.relative_to(DATA).as_posix() for p in DATA.rglob("*") if p.is_file()}
        if DATA.is_dir()
        else set()
    )
    # `scenes/person.py` makes it, of data that another package carries
    there.discard("objects/person/body.npz")
    return sorted(
        name
        for name in made.keys() | there
        if name not in made
        or name not in there
        or not is_close(name, (DATA / name).read_bytes(), made[name])
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    parser = argparse.ArgumentParser(
        prog="python scenes/build.py", description="Rebuild the bundled scenes."
    )
    parser.add_argument(
        "--check",
        action="store_true",
        help="write nothing; exit 3 if a file is not what would be written",
    )
    if parser.parse_args(arguments).check:
        wrong = differing()
        for name in wrong:
            print(f"differs: {FOLDER}/{name}", file=sys.stderr)
        return 3 if wrong else 0
    total = 0
    for name, content in everything():
        path = DATA / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        total += len(content)
    print(f"{DATA}: {total / 2**20:.2f} MiB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
