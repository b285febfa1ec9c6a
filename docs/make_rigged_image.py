"""Writes a small rigged glTF, a desk lamp with a bendable neck, and renders
`docs/images/rigged.webp` from it.

    python docs/make_rigged_image.py [--file lamp.glb] [--size 200]

The neck is skinned to four joints; the shade is rigid and hangs on the last of them.
The clip "Nod" bends the neck.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

import advsearch
from advsearch.scene.color import round_to_8_bit
from advsearch.scene.glb import GlbBuffer

PICTURE = Path(__file__).resolve().parent / "images" / "rigged.webp"
JOINTS = 4
BONE = 0.09
ROUND = 32
"""Of the neck, the length of each, metres, and corners of what is round."""
POSES: tuple[Mapping[str, Any], ...] = (
    {"clip": "Nod", "time": 0.0},
    {"clip": "Nod", "time": 0.35},
    {"clip": "Nod", "time": 1.0},
    {"neck-1.y": -35, "neck-3.y": 80, "shade.x": 30},
)


def lathe(profile: Sequence[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of what a profile (radius, height) makes about the
    vertical, y up.
    """
    radius, height = np.array(profile).T
    angle = np.arange(ROUND) / ROUND * 2 * np.pi
    points = np.stack(
        [
            np.outer(radius, np.sin(angle)),
            np.repeat(height[:, None], ROUND, axis=1),
            np.outer(radius, np.cos(angle)),
        ],
        axis=2,
    )
    number = np.arange(points.size // 3).reshape(len(profile), ROUND)
    low = number[:-1]
    high = number[1:]
    low_next = np.roll(number[:-1], -1, 1)
    high_next = np.roll(number[1:], -1, 1)
    faces = np.stack([low, low_next, high, low_next, high_next, high], axis=2)
    return points.reshape(-1, 3).astype(np.float32), faces.reshape(-1).astype(np.uint32)


def write_lamp(path: Path) -> None:
    """Write the lamp as .glb."""
    made = GlbBuffer()
    top = JOINTS * BONE
    meshes = []
    neck = [(0.008, height) for height in np.linspace(0.0, top, 8 * JOINTS + 1)]
    base = [(0.0, 0.0), (0.09, 0.0), (0.09, 0.012), (0.02, 0.022), (0.0, 0.022)]
    shade = [
        (0.02, 0.0),
        (0.022, 0.03),
        (0.075, 0.11),
        (0.073, 0.11),
        (0.02, 0.03),
        (0.0, 0.0),
    ]
    for number, profile in enumerate((base, neck, shade)):
        points, faces = lathe(profile)
        corners = {"POSITION": made.add_accessor(points, "VEC3", bounds=True)}
        if profile is neck:
            # a joint's share falls to none over the length of a bone
            at = points[:, 1] / BONE
            shares = np.clip(
                1.0 - np.abs(at[:, None] - np.arange(JOINTS) - 0.5), 0.0, 1.0
            )
            shares[:, 0][at < 0.5], shares[:, -1][at > JOINTS - 0.5] = 1.0, 1.0
            shares /= shares.sum(axis=1, keepdims=True)
            corners["JOINTS_0"] = made.add_accessor(
                np.tile(np.arange(JOINTS, dtype=np.uint16), (len(points), 1)), "VEC4"
            )
            corners["WEIGHTS_0"] = made.add_accessor(shares.astype(np.float32), "VEC4")
        meshes.append({
            "primitives": [{"attributes": corners, "indices": made.add_accessor(faces, "SCALAR"), "material": number}]
        })  # fmt: skip
    inverse = np.tile(np.eye(4, dtype=np.float32), (JOINTS, 1, 1))
    inverse[:, 3, 1] = -BONE * np.arange(JOINTS)  # columns come first
    times = np.array([0.0, 0.5, 1.2], np.float32)
    # of each joint, at each time
    half = np.radians([[0.0, 5.0, 0.0], [16.0, 14.0, 20.0], [-10.0, 26.0, 30.0]])
    nodes: list[dict[str, Any]] = [
        {"name": "lamp", "children": [1, 2, 3]},
        {"mesh": 0},
        {"mesh": 1, "skin": 0},
    ]
    nodes += [
        {
            "name": f"neck-{k}",
            "translation": [0.0, BONE if k else 0.0, 0.0],
            "children": [4 + k],
        }
        for k in range(4)
    ]
    nodes.append({"name": "shade", "mesh": 2, "translation": [0.0, BONE, 0.0]})
    samplers = []
    for joint in range(3):
        turn = np.zeros((3, 4), np.float32)
        # towards +z, the front
        turn[:, 0], turn[:, 3] = np.sin(half[joint]), np.cos(half[joint])
        output = made.add_accessor(turn, "VEC4")
        samplers.append(
            {
                "input": made.add_accessor(times, "SCALAR", bounds=False),
                "output": output,
            }
        )
    colors = ([0.05, 0.05, 0.06, 1.0], [0.5, 0.5, 0.52, 1.0], [0.55, 0.08, 0.05, 1.0])
    path.write_bytes(made.to_bytes({
        "asset": {"version": "2.0", "generator": "docs/make_rigged_image.py"},
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": nodes, "meshes": meshes,
        "skins": [{"joints": [3, 4, 5, 6], "inverseBindMatrices": made.add_accessor(inverse.reshape(-1, 16), "MAT4")}],
        "materials": [
            {"name": name, "pbrMetallicRoughness": {"baseColorFactor": color, "metallicFactor": metal}}
            for name, color, metal in zip(("base", "neck", "shade"), colors, (0.0, 0.6, 0.0), strict=True)
        ],
        "animations": [{
            "name": "Nod",
            "samplers": samplers,
            "channels": [{"sampler": k, "target": {"node": 4 + k, "path": "rotation"}} for k in range(3)],
        }],
    }))  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Write the file and the picture; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--file", type=Path, help="keep the lamp here, and render nothing"
    )
    parser.add_argument(
        "--size",
        type=int,
        default=200,
        help="side of one picture, pixels (default 200)",
    )
    args = parser.parse_args(argv)
    if args.file is not None:
        write_lamp(args.file)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lamp.glb"
        pictures = []
        write_lamp(path)
        view = {
            "camera.azimuth": -70.0,
            "camera.elevation": 14.0,
            "camera.distance": 1.15,
        }
        scene = advsearch.load_scene(str(path), "day-room", settings=view)
        for pose in POSES:
            render = scene.renderer(
                {"camera": {"roll": [-1, 1]}, "body": dict(pose)}, resolution=args.size
            )
            with torch.no_grad():
                pictures.append(round_to_8_bit(render(render.start, 0, 128)))
    levels = (torch.cat(pictures, dim=1) * 255.0).round().byte().numpy()
    Image.fromarray(levels).save(PICTURE, quality=84, method=6)
    print(
        f"written: {PICTURE.name}, {PICTURE.stat().st_size // 1024} KiB",
        file=sys.stderr,
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
