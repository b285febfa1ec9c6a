"""Draws docs/images/objects.webp and docs/images/environments.webp: all objects and
environments, to be looked at.

Those of the street are drawn by docs/make_street_image.py.

Run as ``python scenes/contact_sheet.py [--out docs/images] [--size 256] [--spp 64]``.
It needs `mitsuba-oidn` and takes some minutes.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch.questions.harden.objects import HOUSEHOLD, OBJECTS
from advsearch.scene.assets import EnvironmentAsset, ObjectAsset
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.parts import make_mesh_part
from scenes.environments import ENVIRONMENTS

Floats = npt.NDArray[np.float32]
VARIANTS = 3


def picture(
    asset: ObjectAsset,
    light: EnvironmentAsset,
    size: int,
    spp: int,
    azimuth: float = 40.0,
    elevation: float = 25.0,
    zoom: float = 1.0,
) -> Floats:
    """Render an object on a brown ground plane; (size, size, 3) display-referred sRGB.
    Angles in degrees.
    """
    import torch

    from advsearch.scene.mitsuba_backend.denoise import denoise
    from advsearch.scene.mitsuba_backend.meshes import (
        make_mitsuba_mesh,
        make_principled,
    )
    from advsearch.scene.mitsuba_backend.variant import import_mitsuba

    mi = import_mitsuba()
    transform = mi.ScalarTransform4f
    low = asset.mesh.vertices.min(axis=0)
    high = asset.mesh.vertices.max(axis=0)
    middle = (low + high) / 2
    radius = 0.5 * float(np.linalg.norm(high - low)) / zoom
    a = np.radians(azimuth)
    e = np.radians(elevation)
    away = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    whole = make_mesh_part(asset.name, asset, np.eye(4), asset.material)
    fov = 35.0
    eye = middle + away * radius * 1.02 / np.sin(np.radians(fov / 2))
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "aov",
                "aovs": "albedo:albedo,normal:sh_normal",
                "image": {"type": "path", "max_depth": 6},
            },
            "sensor": {
                "type": "perspective",
                "fov": fov,
                "to_world": transform().look_at(
                    origin=eye.tolist(), target=middle.tolist(), up=[0, 0, 1]
                ),
                "film": {
                    "type": "hdrfilm",
                    "width": size,
                    "height": size,
                    "rfilter": {"type": "box"},
                },
            },
            "light": {
                "type": "envmap",
                "bitmap": mi.Bitmap(light.radiance),
                "to_world": transform().rotate([1, 0, 0], 90),
            },
            "ground": {
                "type": "rectangle",
                "to_world": transform().scale([1.5, 1.5, 1]),
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {"type": "rgb", "value": [0.2, 0.13, 0.08]},
                },
            },
            "object": make_mitsuba_mesh(
                asset.name, asset.mesh, np.eye(4), make_principled(whole)
            ),
        }
    )
    layers = torch.from_numpy(
        np.array(mi.render(scene, spp=spp, seed=1), dtype=np.float32)
    )
    radiance = denoise(
        layers[..., :3], layers[..., -6:-3].clamp(0.0, 1.0), layers[..., -3:]
    )
    return linear_to_srgb(radiance.numpy())


def _save(path: Path, image: Floats) -> None:
    from PIL import Image

    Image.fromarray((image * 255 + 0.5).astype(np.uint8)).save(
        path, quality=85, method=6
    )
    print(f"{path}: {path.stat().st_size // 1024} KiB")


def objects(size: int, spp: int, names: list[str]) -> Floats:
    """One cell per class: the canonical instance above, three drawn ones below, seven
    classes in a row.
    """
    light = ENVIRONMENTS["studio"].make()
    cells = []
    for name in names:
        family = OBJECTS[name]
        big = picture(family.generate(None), light, size, spp)
        small = [
            picture(family.generate(np.random.default_rng(seed)), light, size // 2, spp)
            for seed in range(2 * VARIANTS)
        ]
        rows = [
            np.concatenate(small[i : i + 2], axis=1) for i in range(0, 2 * VARIANTS, 2)
        ]
        cells.append(np.concatenate([big, *rows], axis=0))
    width = min(7, len(cells))
    cells += [np.ones_like(cells[0])] * (-len(cells) % width)
    return np.concatenate(
        [
            np.concatenate(cells[i : i + width], axis=1)
            for i in range(0, len(cells), width)
        ],
        axis=0,
    )


def environments(size: int, spp: int) -> Floats:
    """For every environment that goes with household objects its map and the mug under
    it, two in a row.
    """
    from PIL import Image

    mug = OBJECTS["mug"].generate(None)
    cells = []
    for family in (one for one in ENVIRONMENTS.values() if one.ground is None):
        light = family.make()
        chart = linear_to_srgb(light.radiance)
        wide = Image.fromarray((chart * 255 + 0.5).astype(np.uint8)).resize(
            (2 * size, size), Image.Resampling.BICUBIC
        )
        cells.append(
            np.concatenate(
                [
                    np.asarray(wide, dtype=np.float32) / 255,
                    picture(mug, light, size, spp),
                ],
                axis=1,
            )
        )
    cells += [np.ones_like(cells[0])] * (-len(cells) % 2)
    return np.concatenate(
        [np.concatenate(cells[i : i + 2], axis=1) for i in range(0, len(cells), 2)],
        axis=0,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0] if __doc__ else ""
    )
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    parser.add_argument(
        "--size", type=int, default=256, help="pixels across one picture"
    )
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel")
    parser.add_argument(
        "--only", nargs="*", default=list(HOUSEHOLD), help="names of objects"
    )
    parser.add_argument("--no-environments", action="store_true")
    parser.add_argument("--no-objects", action="store_true")
    args = parser.parse_args()
    os.makedirs(args.out, exist_ok=True)
    if not args.no_objects:
        _save(args.out / "objects.webp", objects(args.size, args.spp, args.only))
    if not args.no_environments:
        _save(args.out / "environments.webp", environments(args.size, args.spp))


if __name__ == "__main__":
    main()
