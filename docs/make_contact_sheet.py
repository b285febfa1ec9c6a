"""Render every object of a folder in every environment of a folder, on one sheet: a row
each, a column each.

    python docs/make_contact_sheet.py OBJECTS ENVIRONMENTS SHEET.webp

Objects are mesh files, environments .hdr or .exr files; the scenes are those of
`advsearch render`, with nothing set. What it is for: to see that objects of other
people stand upright, in the frame and well lit.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import advsearch
from advsearch.runs.files import to_8bit

OBJECTS = (".obj", ".ply", ".glb", ".gltf", ".stl")
ENVIRONMENTS = (".hdr", ".exr")


def files(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """Return the files of a folder with these suffixes, sorted.

    Raises:
        SystemExit: there is none.
    """
    found = sorted(file for file in folder.iterdir() if file.suffix.lower() in suffixes)
    if not found:
        raise SystemExit(
            f"{folder}: expected files ending in {', '.join(suffixes)}, found none"
        )
    return found


def main(argv: Sequence[str] | None = None) -> None:
    """Write the sheet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("objects", type=Path)
    parser.add_argument("environments", type=Path)
    parser.add_argument("sheet", type=Path, help="a .webp, .jpg or .png file")
    parser.add_argument("--resolution", type=int, default=192)
    parser.add_argument("--spp", type=int, default=32)
    given = parser.parse_args(argv)
    environments = files(given.environments, ENVIRONMENTS)
    rows = []
    for mesh in files(given.objects, OBJECTS):
        row = []
        for environment in environments:
            scene = advsearch.load_scene(mesh, environment)
            render = scene.renderer({"camera": {}}, resolution=given.resolution)
            with torch.no_grad():
                row.append(to_8bit(render(render.start, 0, given.spp)))
            print(f"{mesh.name} in {environment.name}", flush=True)
        rows.append(np.concatenate(row, axis=1))
    Image.fromarray(np.concatenate(rows, axis=0)).save(given.sheet, quality=82)


if __name__ == "__main__":
    main()
