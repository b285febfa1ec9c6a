"""Draws docs/images/cameras.webp: the bundled mug through each kind of camera, 300 x
300 pixels each.

python docs/make_camera_images.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import advsearch

OUT = Path(__file__).resolve().parent / "images" / "cameras.webp"
SIDE = 300
CAPTION = 26
BARREL = """%YAML:1.0
---
image_width: 640
image_height: 640
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 420., 0., 319.5, 0., 420., 319.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.3, 0.08, 0., 0., 0. ]
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_model: equidistant
  distortion_coeffs: [0.02, -0.005, 0.001, -0.0002]
  intrinsics: [190.0, 190.0, 319.5, 319.5]
  resolution: [640, 640]
"""
FOLDING = "1 SIMPLE_RADIAL 640 640 420 320 320 -0.3\n"


def main() -> None:
    """Render the views and put them side by side."""
    panels: list[tuple[str, str | None, str]] = [
        ("pinhole, 74.6 degrees", None, ""),
        ("OpenCV: k1 = -0.3, k2 = 0.08", "calib.yaml", BARREL),
        ("Kalibr: equidistant", "camchain.yaml", KALIBR),
        ("fisheye", "fisheye", ""),
        ("equirectangular", "equirectangular", ""),
        ("COLMAP: k1 = -0.3, folds", "cameras.txt", FOLDING),
    ]
    sheet = Image.new("RGB", (3 * SIDE + 20, 2 * (SIDE + CAPTION) + 10), "white")
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(15)
    with tempfile.TemporaryDirectory() as folder:
        for number, (caption, camera, text) in enumerate(panels):
            if text:
                camera = str(Path(folder) / str(camera))
                Path(camera).write_text(text, encoding="utf-8")
            settings = {
                "camera.distance": 1.3,
                **({} if camera else {"camera.fov": 74.6}),
            }
            scene = advsearch.load_scene(
                "mug", "kitchen", settings=settings, camera=camera
            )
            rendered = advsearch.render(scene, resolution=SIDE, spp=32, progress=False)
            print(caption, *rendered.warnings, sep="\n  ")
            picture = Image.fromarray(
                (rendered.views[0].picture.numpy() * 255.0).round().astype(np.uint8)
            )
            left = (number % 3) * (SIDE + 10)
            top = (number // 3) * (SIDE + CAPTION + 10)
            sheet.paste(picture, (left, top))
            draw.text(
                (left + SIDE / 2, top + SIDE + CAPTION / 2),
                caption,
                fill="black",
                font=font,
                anchor="mm",
            )
    sheet.save(OUT, optimize=True)


if __name__ == "__main__":
    main()
