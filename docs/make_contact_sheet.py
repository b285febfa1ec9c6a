<<<<<<< HEAD
"""Render every object of a folder in every environment of a folder, on one sheet: a row each, a column each.

    python docs/make_contact_sheet.py OBJECTS ENVIRONMENTS SHEET.webp

Objects are mesh files, environments .hdr or .exr files; the scenes are those of `advsearch render`, with nothing set.
What it is for: to see that objects of other people stand upright, in the frame and well lit.
=======
"""Make a contact sheet: every object of a folder in every environment of it, to be looked at.

    python docs/make_contact_sheet.py FOLDER sheet.png

FOLDER holds `objects/` and `environments/`, files as `--object` and `--environment` take them. Nothing is fetched.
>>>>>>> 88bcf55 (Real meshes: a table of eleven awkward ones stands upright, in frame and lit; docs/make_contact_sheet.py shows a folder's objects in its environments)
"""

from __future__ import annotations

import argparse
<<<<<<< HEAD
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import advsearch
from advsearch.runs.images import to_8bit

OBJECTS = (".obj", ".ply", ".glb", ".gltf", ".stl")
ENVIRONMENTS = (".hdr", ".exr")


def files(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """Return the files of a folder with these suffixes, sorted.

    Raises:
        SystemExit: there is none.
    """
    found = sorted(file for file in folder.iterdir() if file.suffix.lower() in suffixes)
    if not found:
        raise SystemExit(f"{folder}: expected files ending in {', '.join(suffixes)}, found none")
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
    environments, rows = files(given.environments, ENVIRONMENTS), []
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
=======
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import advsearch
from advsearch.scene.environments import SUFFIXES as MAPS
from advsearch.scene.importing.objects import SUFFIXES as MESHES

MARGIN = 14
"""Pixels above each row and column for names."""
LETTER = 7
"""Pixels across of a letter, at most."""


def pictures(folder: Path, side: int, spp: int) -> Image.Image:
    """Return the sheet: a row for each object, a column for each environment.

    Args:
        folder: with `objects/` and `environments/`.
        side: of each picture, pixels.
        spp: samples a pixel.
    """
    objects = sorted(one for one in (folder / "objects").iterdir() if one.suffix.lower() in MESHES)
    maps = sorted(one for one in (folder / "environments").iterdir() if one.suffix.lower() in MAPS)
    sheet = Image.new("RGB", (side * len(maps), (side + MARGIN) * len(objects) + MARGIN), "white")
    pen = ImageDraw.Draw(sheet)
    for column, environment in enumerate(maps):
        pen.text((column * side + 2, 1), environment.stem[: side // LETTER], fill="black")
    for row, file in enumerate(objects):
        top = MARGIN + row * (side + MARGIN)
        pen.text((2, top + 1), file.name, fill="black")
        for column, environment in enumerate(maps):
            scene = advsearch.load_scene(file, environment)
            renderer = scene.renderer("pose", resolution=side)
            picture = renderer(renderer.start, seed=0, spp=spp).numpy()
            sheet.paste(Image.fromarray(np.uint8(picture * 255.0 + 0.5)), (column * side, top + MARGIN))
    return sheet


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--side", type=int, default=160)
    parser.add_argument("--spp", type=int, default=64)
    args = parser.parse_args()
    pictures(args.folder, args.side, args.spp).save(args.out)
>>>>>>> 88bcf55 (Real meshes: a table of eleven awkward ones stands upright, in frame and lit; docs/make_contact_sheet.py shows a folder's objects in its environments)
