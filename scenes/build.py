"""Writes advsearch/bundled/data from the generators, or checks that it is what they make.

``python scenes/build.py`` rewrites every file; ``--check`` writes nothing, names the files that differ and exits 3.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np

from advsearch.bundled.objects import OBJECTS, ObjectFamily
from advsearch.scene.assets import Mesh
from scenes.environments import ENVIRONMENTS, EnvironmentFamily
from scenes.files import exr, ply, png

FOLDER = "advsearch/bundled/data"
DATA = Path(__file__).resolve().parents[1] / FOLDER


def object_files(family: ObjectFamily) -> dict[str, bytes]:
    """Return the files of a family's canonical instance, by path below the data folder."""
    asset = family.generate(None)
    facts = {
        "schema": 1,
        "name": asset.name,
        "label": asset.label,
        "material": asdict(asset.material),
        # the family's file has moved to advsearch/bundled/objects; what is shipped keeps its bytes
        "source": f"scenes/objects/{family.make.__module__.rpartition('.')[2]}.py"
        if asset.mesh.rig is None
        else "scenes/person.py, of MakeHuman's data (CC0 1.0)",
        "triangles": len(asset.mesh.faces),
        "metres": asset.metres,
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
    """Return the materials of a mesh's faces, one after the other: the name and how many faces have it in a row."""
    names = np.empty(len(mesh.faces), dtype=object)
    for name, faces in mesh.materials.items():
        names[faces] = name
    return [(str(name), len(list(run))) for name, run in itertools.groupby(names)]


def environment_files(family: EnvironmentFamily) -> dict[str, bytes]:
    """Return an environment's file, by path below the data folder; none where it has the map of another one."""
    return {} if family.map else {f"environments/{family.name}.exr": exr(family.make().radiance)}


def everything() -> Iterator[tuple[str, bytes]]:
    """Yield every file of the data folder: relative path, content."""
    for thing in OBJECTS.values():
        yield from object_files(thing).items()
    for light in ENVIRONMENTS.values():
        yield from environment_files(light).items()
    facts = {
        name: {"split": family.split, "source": family.script}
        | ({"ground": family.ground} if family.ground else {})
        | ({"map": family.map} if family.map else {})
        | ({"candelas": family.make().candelas} if family.lux else {})
        for name, family in ENVIRONMENTS.items()
    }
    yield "environments/environments.json", (json.dumps({"schema": 1, "environments": facts}, indent=1) + "\n").encode()


def differing() -> list[str]:
    """Return the files that are missing, left over, or not byte for byte what the generators make."""
    made = dict(everything())
    there = {p.relative_to(DATA).as_posix() for p in DATA.rglob("*") if p.is_file()} if DATA.is_dir() else set()
    there.discard("objects/person/body.npz")  # `scenes/person.py` makes it, of data that another package carries
    return sorted(
        name
        for name in made.keys() | there
        if name not in made or name not in there or (DATA / name).read_bytes() != made[name]
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    parser = argparse.ArgumentParser(prog="python scenes/build.py", description="Rebuild the bundled scenes.")
    parser.add_argument(
        "--check", action="store_true", help="write nothing; exit 3 if a file is not what would be written"
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
