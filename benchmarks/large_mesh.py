"""What a mesh of a million triangles takes: processor time and memory to read it, and to render a first picture.

    python benchmarks/large_mesh.py [--triangles 1000000] [--formats glb obj ply]

The mesh is a ball with bumps; .glb and .obj have texture coordinates, for .ply they are made. Each file is read by a
process of its own.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from advsearch import threads

threads.configure()

import numpy as np  # noqa: E402
import trimesh  # noqa: E402

from advsearch import load_scene  # noqa: E402

SIZE = 128
"""Side of the picture in pixels."""


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print a row for each format; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--triangles", type=int, default=1_000_000)
    parser.add_argument("--formats", nargs="+", default=["glb", "obj", "ply"])
    parser.add_argument("--file", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.file is not None:
        print(json.dumps(measured(args.file)))
        return 0
    print("| format | triangles | CPU seconds to read | with a picture | memory, MB |")
    print("| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        for kind in args.formats:
            file = Path(folder) / f"ball.{kind}"
            ball(args.triangles, mapped=kind != "ply").export(file)
            command = [sys.executable, __file__, "--file", str(file)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            triangles, *numbers = json.loads(done.stdout)
            print(f"| .{kind} | {triangles:,.0f} | {' | '.join(f'{number:.0f}' for number in numbers)} |", flush=True)
    return 0


def ball(triangles: int, *, mapped: bool) -> trimesh.Trimesh:
    """Return a ball with bumps of about so many triangles, with texture coordinates or without."""
    rows = max(2, round((triangles / 4) ** 0.5))
    down, round_ = np.linspace(0.0, np.pi, rows + 1)[:, None], np.linspace(0.0, 2.0 * np.pi, 2 * rows + 1)
    radius = 1.0 + 0.1 * np.sin(9.0 * round_) * np.sin(7.0 * down)
    directions = [np.sin(down) * np.cos(round_), np.sin(down) * np.sin(round_), np.cos(down) * np.ones_like(round_)]
    first = (np.arange(rows)[:, None] * (2 * rows + 1) + np.arange(2 * rows)).reshape(-1)
    below = first + 2 * rows + 1
    faces = np.concatenate([np.stack([first, below, first + 1], 1), np.stack([first + 1, below, below + 1], 1)])
    mesh = trimesh.Trimesh(np.stack([radius * one for one in directions], 2).reshape(-1, 3), faces, process=False)
    if mapped:
        uvs = np.stack(np.broadcast_arrays(round_ / (2.0 * np.pi), 1.0 - down / np.pi), 2).reshape(-1, 2)
        mesh.visual = trimesh.visual.TextureVisuals(uv=uvs)
    return mesh


def measured(file: Path) -> list[float]:
    """Return the triangles of a file, processor seconds to read it and with a picture, and the most memory in MB."""
    start = time.process_time()
    scene = load_scene(file)
    read = time.process_time() - start
    render = scene.renderer("pose", resolution=SIZE, denoise="none")
    render(render.start, seed=0, spp=4)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return [float(len(scene.description.object.mesh.faces)), read, time.process_time() - start, memory]


if __name__ == "__main__":
    sys.exit(main())
