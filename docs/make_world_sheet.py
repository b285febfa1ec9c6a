"""Renders `docs/images/world.webp`: cars near and far in four kinds of light, an own
car, others beside it, a person; and `docs/images/places.webp`: a crossing, a car park
and a room.

python docs/make_world_sheet.py [--size 300] [--spp 64] [--texture shirt.png] [--folder
FOLDER] [--sheet places]

All pictures of the avenue have an absolute exposure. From 60 and 100 m an inset has the
car as large as from 10 m. The shirt is searched by a short attack, unless `--texture`
names one that an attack has found. `--folder` keeps each picture by itself, and takes
those that are there.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image, ImageOps

import advsearch
from advsearch.scene.color import linear_to_srgb, round_to_8_bit

IMAGES = Path(__file__).resolve().parent / "images"
COLUMNS = 4
WIDE = 60.0
"""Pictures beside each other, and the field of view of a dashcam."""
LIGHTS: dict[str, tuple[str, dict[str, Any]]] = {
    "day": ("avenue", {"camera.ev": 14.0}),
    "wet": ("avenue-wet", {"camera.ev": 11.5}),
    "dusk": ("avenue-dusk", {"camera.ev": 4.5}),
    "night": (
        "avenue-night",
        {"camera.ev": 3.0, "object.lamps": "low", "camera.lamps": "low"},
    ),
}
"""Environment and settings."""
POSES: dict[str, dict[str, float]] = {
    "stands": {},
    "walks": {"stride": 1.0, "walk": 40.0},
    "waves": {
        "left_shoulder_out": 130.0,
        "left_elbow": 40.0,
        "right_shoulder": 20.0,
        "right_elbow": 60.0,
    },
}


LAID = "bottle@0.15,-0.25; vase@-0.2,0.3; book@0.1,0.45,heading=30"
PLACES = (
    ("crossing", "car", "crossing", 188.0, 9.0, 14.0, "person@6.4,2,heading=-90"),
    ("crossing-night", "car", "crossing-night", 205.0, 9.0, 18.0, None),
    (
        "car-park",
        "car",
        "car-park",
        35.0,
        14.0,
        15.0,
        "car@0,2.5; car@11,-2.5,heading=180; person@4.5,3.6,heading=200",
    ),
    (
        "car-park-dusk",
        "car",
        "car-park-dusk",
        310.0,
        12.0,
        20.0,
        "car@0,2.5; car@-5,-5,heading=180",
    ),
    ("room", "mug", "room", 40.0, 14.0, 1.3, LAID),
    ("room-window", "mug", "room", 235.0, 12.0, 1.2, LAID),
    ("room-evening", "mug", "room-evening", 20.0, 18.0, 1.2, LAID),
    ("room-near", "mug", "room", 65.0, 25.0, 0.35, LAID),
)
"""Other places: a name, object, environment, azimuth and elevation of the camera, its
distance, and things beside.
"""
EV = {"crossing": 14.0, "crossing-night": 3.5, "car-park": 14.0, "car-park-dusk": 4.5}


class Asked(NamedTuple):
    """A picture by its name: the scene, and the controls that are fixed."""

    name: str
    scene: dict[str, Any]
    controls: dict[str, dict[str, float]]


def asked(own_car: Path, shirt: Any) -> Iterator[Asked]:
    """Yield the pictures of the sheet, row by row."""
    for light, (environment, given) in LIGHTS.items():
        for metres in (10.0, 30.0, 60.0, 100.0):
            behind = {"camera.distance": metres, "camera.fov": WIDE, **given}
            scene = {
                "object": "car",
                "environment": environment,
                "settings": behind,
                "camera": "dashcam",
            }
            yield Asked(f"{light}-{metres:.0f}", scene, {})
    for light, turn in (("day", 32.0), ("night", 28.0)):
        environment, given = LIGHTS[light]
        view = {
            "camera.distance": 9.0,
            "camera.azimuth": turn,
            "camera.elevation": 9.0,
            **given,
            "camera.lamps": "off",
        }
        yield Asked(
            f"own-{light}",
            {
                "object": own_car,
                "up": "z",
                "size": 5.1,
                "environment": environment,
                "settings": view,
            },
            {},
        )
    for light, lamps in (("day", "off"), ("night", "low")):
        environment, given = LIGHTS[light]
        view = {
            "camera.distance": 17.0,
            "camera.azimuth": 14.0,
            "camera.elevation": 6.0,
            **given,
            "camera.lamps": "off",
        }
        things = f"car@-8,3.5,heading=180,lamps={lamps}; person@3,-2.8,heading=-20"
        yield Asked(
            f"two-{light}",
            {
                "object": "car",
                "environment": environment,
                "settings": view,
                "things": things,
            },
            {},
        )
    wet = {
        **LIGHTS["night"][1],
        "ground.kind": "wet-avenue",
        "camera.distance": 15.0,
        "camera.azimuth": 14.0,
    }
    wet |= {"camera.elevation": 7.0, "camera.lamps": "off"}
    yield Asked(
        "wet-night",
        {
            "object": "car",
            "environment": "avenue-night",
            "settings": wet,
            "things": "car@-8,3.5,heading=180,lamps=low",
        },
        {},
    )
    for light in ("wet", "night"):
        environment, given = LIGHTS[light]
        view = {
            "camera.distance": 12.0,
            "camera.fov": WIDE,
            **given,
            "camera.drops": 70.0,
            "ground.kind": "wet-avenue",
        }
        yield Asked(
            f"rain-{light}",
            {
                "object": "car",
                "environment": environment,
                "settings": view,
                "camera": "dashcam",
            },
            {},
        )
    snow = {
        "environment": "avenue-snow",
        "settings": {"camera.distance": 10.0, "camera.fov": WIDE, "camera.ev": 12.0},
    }
    yield Asked("snow-ahead", {"object": "car", "camera": "dashcam", **snow}, {})
    view = {
        "camera.distance": 17.0,
        "camera.azimuth": 14.0,
        "camera.elevation": 9.0,
        "camera.ev": 12.0,
    }
    things = "car@-8,3.5,heading=180,lamps=low; person@3,-2.8,heading=-20"
    yield Asked(
        "snow-two", {"object": "car", **snow, "settings": view, "things": things}, {}
    )
    for name, pose in POSES.items():
        view = {
            "camera.distance": 3.4,
            "camera.azimuth": 20.0,
            "camera.elevation": 6.0,
            "camera.ev": 14.0,
        }
        scene = {
            "object": "person",
            "environment": "avenue",
            "settings": view,
            "texture": shirt,
        }
        yield Asked(f"person-{name}", scene, {"body": pose or {"stride": 0.0}})


def places() -> Iterator[Asked]:
    """Yield the pictures of the other places."""
    for name, thing, environment, azimuth, elevation, metres, things in PLACES:
        view = {
            "camera.distance": metres,
            "camera.azimuth": azimuth,
            "camera.elevation": elevation,
        }
        view |= {"camera.ev": EV[environment]} if environment in EV else {}
        yield Asked(
            name,
            {
                "object": thing,
                "environment": environment,
                "settings": view,
                "things": things,
            },
            {},
        )


def write_van(path: Path) -> None:
    """Write a delivery van as OBJ, in centimetres, with a material for each of paint,
    glass and tyres.
    """
    side = [
        (-255, 28),
        (-255, 205),
        (60, 212),
        (120, 195),
        (196, 112),
        (246, 92),
        (255, 62),
        (255, 28),
    ]
    vertices: list[tuple[float, float, float]] = []
    faces: list[str] = []

    def polygon(material: str, corners: Sequence[tuple[float, float, float]]) -> None:
        first = len(vertices) + 1
        vertices.extend(corners)
        faces.extend(
            [
                f"usemtl {material}",
                "f " + " ".join(str(first + n) for n in range(len(corners))),
            ]
        )

    for y, turned in ((95.0, side[::-1]), (-95.0, side)):
        polygon("paint", [(x, y, z) for x, z in turned])
    for (x0, z0), (x1, z1) in zip(side, [*side[1:], side[0]], strict=True):
        polygon("paint", [(x0, -95, z0), (x0, 95, z0), (x1, 95, z1), (x1, -95, z1)])
    polygon(
        "glass",
        [
            (128.6, -82, 188.6),
            (128.6, 82, 188.6),
            (191.6, 82, 119.8),
            (191.6, -82, 119.8),
        ],
    )
    polygon(
        "glass", [(-256, 70, 130), (-256, 70, 185), (-256, -70, 185), (-256, -70, 130)]
    )
    for y in (96.0, -96.0):
        window = [
            (30.0, y, 125.0),
            (30.0, y, 185.0),
            (112.0, y, 185.0),
            (168.0, y, 125.0),
        ]
        polygon("glass", window if y > 0.0 else window[::-1])
        for x in (160.0, -150.0):
            ring = [
                (x + 33.0 * np.cos(a), y * 1.01, 33.0 + 33.0 * np.sin(a))
                for a in np.linspace(0, 2 * np.pi, 25)[1:]
            ]
            polygon("tyre", ring[::-1] if y > 0.0 else ring)
            inner = [(cx, y * 0.75, cz) for cx, _, cz in ring]
            for n in range(len(ring)):
                tread = [ring[n - 1], ring[n], inner[n], inner[n - 1]]
                polygon("tyre", tread if y > 0.0 else tread[::-1])
    colors = {
        "paint": "0.86 0.72 0.2",
        "glass": "0.04 0.05 0.06",
        "tyre": "0.03 0.03 0.03",
    }
    rough = {"paint": 0.35, "glass": 0.05, "tyre": 0.9}
    path.with_suffix(".mtl").write_text(
        "".join(f"newmtl {n}\nKd {c}\nPr {rough[n]}\nPm 0\n" for n, c in colors.items())
    )
    lines = [
        f"mtllib {path.with_suffix('.mtl').name}",
        *(f"v {x:g} {y:g} {z:g}" for x, y, z in vertices),
        *faces,
    ]
    path.write_text("\n".join(lines) + "\n")


def searched_shirt(steps: int = 20) -> Any:
    """Return the person's texture, sRGB, after a short search for a shirt that the
    reference model takes for a book.
    """
    model = advsearch.load_model("reference")
    book = model.labels.index("book")
    scene = advsearch.load_scene(
        "person", "street", settings={"camera.azimuth": 20.0, "camera.elevation": 6.0}
    )
    render = scene.renderer(
        {"texture:shirt": {"epsilon": 0.6, "resolution": 32}}, resolution=96
    )
    u = render.start.clone()
    for step in range(steps):
        at = u.clone().requires_grad_()
        model(render(at, step, 8)).reshape(-1).log_softmax(0)[book].neg().backward()
        assert at.grad is not None
        u = (u - 0.08 * at.grad.sign()).clamp(0.0, 1.0)
    with torch.no_grad():
        return linear_to_srgb(render.space.inputs(u)["object.base_color"]).clamp(
            0.0, 1.0
        )


def rendered(one: Asked, size: int, spp: int) -> Image.Image:
    """Render a picture."""
    scene = dict(one.scene)
    loaded = advsearch.load_scene(
        scene.pop("object"), scene.pop("environment"), **scene
    )
    # a space needs something that varies; its start is the scene as it is
    still = {"camera": {"roll": [-1.0, 1.0]}}
    render = loaded.renderer({**still, **one.controls}, resolution=size)
    with torch.no_grad():
        levels = round_to_8_bit(render(render.start, 0, spp)) * 255.0
    picture = Image.fromarray(levels.round().byte().numpy())
    view = one.scene["settings"]
    # as large as from 10 m, from where it is
    if view.get("camera.fov") == WIDE and view["camera.distance"] > 50.0:
        narrow = view | {"camera.fov": 10.0 * WIDE / view["camera.distance"]}
        inset = rendered(
            one._replace(scene=one.scene | {"settings": narrow}),
            round(size * 0.36),
            spp,
        )
        picture.paste(
            ImageOps.expand(inset, max(1, size // 200), "white"),
            (0, size - inset.height),
        )
    return picture


def main(argv: Sequence[str] | None = None) -> int:
    """Render and write; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--size",
        type=int,
        default=300,
        help="side of one picture, pixels (default 300)",
    )
    parser.add_argument(
        "--spp", type=int, default=64, help="samples per pixel (default 64)"
    )
    parser.add_argument(
        "--texture", type=Path, help="of the person; by default a shirt is searched"
    )
    parser.add_argument(
        "--folder",
        type=Path,
        help="pictures go there by their names; those that are there are taken",
    )
    parser.add_argument(
        "--sheet",
        choices=("world", "places"),
        default="world",
        help="which sheet (default world)",
    )
    parser.add_argument(
        "--only", default="", help="pictures whose names contain this, and no sheet"
    )
    args = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        own = Path(folder) / "van.obj"
        write_van(own)
        every = asked(own, args.texture) if args.sheet == "world" else places()
        wanted = [one for one in every if args.only in one.name]
        pictures = []
        shirt = args.texture
        for one in wanted:
            kept = None if args.folder is None else args.folder / f"{one.name}.png"
            if kept is not None and kept.is_file():
                pictures.append(Image.open(kept).resize((args.size, args.size)))
                continue
            if "texture" in one.scene:
                shirt = searched_shirt() if shirt is None else shirt
                one = one._replace(scene={**one.scene, "texture": shirt})
            pictures.append(rendered(one, args.size, args.spp))
            print(one.name, file=sys.stderr, flush=True)
            if kept is not None:
                kept.parent.mkdir(parents=True, exist_ok=True)
                pictures[-1].save(kept)
    if not args.only:
        sheet = Image.new(
            "RGB", (COLUMNS * args.size, -(-len(pictures) // COLUMNS) * args.size)
        )
        for number, picture in enumerate(pictures):
            sheet.paste(
                picture, (number % COLUMNS * args.size, number // COLUMNS * args.size)
            )
        path = IMAGES / f"{args.sheet}.webp"
        sheet.save(path, quality=84, method=6)
        print(
            f"written: {path.name}, {path.stat().st_size // 1024} KiB", file=sys.stderr
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
