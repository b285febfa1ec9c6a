"""Writes scenes/photographs, a small data set in BOP's form for tests of `twins`.

    python scenes/photographs.py

Two objects, a cup and a box, are rendered in the loft with few samples and noise of a
sensor: these renders stand for photographs. Masks are drawn from the projected
triangles, so that they do not depend on the renderer. photographs.csv names the same
photographs as a list.
"""

from __future__ import annotations

import csv
import io
import json
import math
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from advsearch.questions.twins import rendering
from advsearch.questions.twins.listing import PhotographedObject, Pinhole

Float64Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FOLDER = Path(__file__).resolve().parent / "photographs"
HEIGHT, WIDTH = 96, 128  # pixels
# fx, fy, cx, cy; pixel centers are whole numbers
INTRINSICS = (150.0, 165.0, 61.0, 50.0)
N_FRAMES = 12
NOISE = 0.02  # standard deviation, sRGB
DIM = 0.45  # of the light of every third photograph
ENVIRONMENT = "loft"
WINDOW = rendering.PhotoWindow(0, 0, WIDTH, HEIGHT)
Mesh = tuple[Float64Array, IntArray, IntArray]  # vertices in mm, faces, 8-bit colors


def make_cup() -> Mesh:
    """Return a cup with bands, 80 mm high: a closed surface of revolution."""
    profile = np.loadtxt(
        "0 0; 30 0; 34 25; 36 50; 40 80; 36 80; 32 50; 28 8; 0 8".split(";")
    )
    n_columns = 24
    angle = 2.0 * math.pi * np.arange(n_columns) / n_columns
    radius, height = profile.T
    vertices = np.stack(
        [
            np.outer(radius, np.cos(angle)),
            np.outer(radius, np.sin(angle)),
            np.repeat(height[:, None], n_columns, axis=1),
        ],
        axis=-1,
    ).reshape(-1, 3)
    faces = []
    for row in range(len(profile) - 1):
        for column in range(n_columns):
            corner = row * n_columns + column
            beside = row * n_columns + (column + 1) % n_columns
            faces.append([corner, beside, beside + n_columns])
            faces.append([corner, beside + n_columns, corner + n_columns])
    band = np.isin(np.arange(len(profile)), (2, 3))
    colors = np.where(band[:, None], [210, 190, 40], [190, 40, 40])
    return vertices, np.array(faces), np.repeat(colors, n_columns, axis=0)


def make_box() -> Mesh:
    """Return a box of 90 x 60 x 70 mm with a lighter front."""
    corners = np.array(
        [[x, y, z] for x in (-45, 45) for y in (-30, 30) for z in (0, 70)], np.float64
    )
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (1, 5, 7, 3)]
    sides.append((0, 2, 6, 4))
    vertices = corners[[corner for side in sides for corner in side]]
    faces = [
        [4 * side + corner for corner in triangle]
        for side in range(6)
        for triangle in ((0, 1, 2), (0, 2, 3))
    ]
    colors = np.tile([[30, 60, 170]], (24, 1))
    colors[4:8] = [90, 140, 220]
    return vertices, np.array(faces), colors


def write_ply(path: Path, mesh: Mesh) -> None:
    vertices, faces, colors = mesh
    lines = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    for position, color in zip(vertices, colors, strict=True):
        x, y, z = position
        lines.append(f"{x:.3f} {y:.3f} {z:.3f} {color[0]} {color[1]} {color[2]}")
    lines += [f"3 {face[0]} {face[1]} {face[2]}" for face in faces]
    path.write_text("\n".join(lines) + "\n", "utf-8")


def make_pose(azimuth: float, elevation: float, distance: float) -> Float64Array:
    """Return the pose (4, 4), mm, of an object that a camera looks at.

    The camera's axes are x right, y down, z forwards; angles are in degrees.
    """
    azimuth, elevation = map(math.radians, (azimuth, elevation))
    outwards = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(-outwards, right), -outwards])
    pose[:3, 3] = [0.0, 0.0, distance] - pose[:3, :3] @ np.array([0.0, 0.0, 35.0])
    return pose


def draw_mask(mesh: Mesh, pose: Float64Array) -> Image.Image:
    """Draw the silhouette of a mesh: all projected triangles."""
    vertices, faces, _ = mesh
    points = vertices @ pose[:3, :3].T + pose[:3, 3]
    fx, fy, cx, cy = INTRINSICS
    positions = np.stack(
        [fx * points[:, 0] / points[:, 2] + cx, fy * points[:, 1] / points[:, 2] + cy],
        axis=1,
    )
    scale = 8
    image = Image.new("L", (scale * WIDTH, scale * HEIGHT))
    draw = ImageDraw.Draw(image)
    for triangle in scale * (positions[faces] + 0.5):
        draw.polygon([tuple(corner) for corner in triangle.tolist()], fill=255)
    return image.resize((WIDTH, HEIGHT), Image.Resampling.BOX).point(
        lambda level: 255 * (level > 127)
    )


def main() -> int:
    scene = FOLDER / "test" / "000001"
    for folder in (FOLDER / "models", scene / "rgb", scene / "mask"):
        folder.mkdir(parents=True, exist_ok=True)
    meshes = {1: make_cup(), 2: make_box()}
    renderers = {}
    for number, mesh in meshes.items():
        path = FOLDER / "models" / f"obj_{number:06d}.ply"
        write_ply(path, mesh)
        renderers[number] = rendering.SurroundedRenderer(
            rendering.load_object(path, "mm"),
            "mm",
            ENVIRONMENT,
            rendering.choose_film([WINDOW], INTRINSICS[0] / INTRINSICS[1]),
            spp=64,
            seed=7,
        )
    generator = np.random.default_rng(1)
    truths = {}
    cameras = {}
    rows = []
    fx, fy, cx, cy = INTRINSICS
    matrix = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    for frame in range(N_FRAMES):
        number = 1 + frame % 2
        pose = make_pose(
            float(generator.uniform(0.0, 360.0)),
            float(generator.uniform(10.0, 50.0)),
            float(generator.uniform(250.0, 420.0)),
        )
        pose[:2, 3] += generator.uniform(-25.0, 25.0, 2)
        mesh_file = FOLDER / "models" / f"obj_{number:06d}.ply"
        item = PhotographedObject(
            Path(), "", "", mesh_file, "mm", pose, Pinhole(fx, fy, cx + 0.5, cy + 0.5)
        )
        rendered = renderers[number].render(item, WINDOW, frame)
        is_dim = frame % 3 == 2
        image = rendering.resize(rendered, (HEIGHT, WIDTH)).numpy()
        image = image * (DIM if is_dim else 1.0)
        image = image + NOISE * generator.standard_normal(image.shape)
        levels = np.round(255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)
        name = f"{frame:06d}"
        Image.fromarray(levels).save(scene / "rgb" / f"{name}.jpg", quality=85)
        draw_mask(meshes[number], pose).save(scene / "mask" / f"{name}_000000.png")
        rounded = np.round(pose, 6)
        truths[str(frame)] = [
            {
                "cam_R_m2c": rounded[:3, :3].ravel().tolist(),
                "cam_t_m2c": rounded[:3, 3].tolist(),
                "obj_id": number,
            }
        ]
        cameras[str(frame)] = {"cam_K": matrix}
        rows.append(
            {
                "photograph": f"test/000001/rgb/{name}.jpg",
                "object": f"models/obj_{number:06d}.ply",
                "unit": "mm",
                "label": ("cup", "box")[number - 1],
                "condition": "dim" if is_dim else "bright",
                "K": " ".join(f"{value:g}" for value in matrix),
                "pose": " ".join(f"{value:.6f}" for value in rounded[:3].ravel()),
            }
        )
    (scene / "scene_gt.json").write_text(json.dumps(truths) + "\n", "utf-8")
    (scene / "scene_camera.json").write_text(json.dumps(cameras) + "\n", "utf-8")
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    (FOLDER / "photographs.csv").write_text(text.getvalue(), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
