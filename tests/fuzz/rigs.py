"""Rigs of cameras: plain lists, Kalibr's camchains, nerfstudio's frames and COLMAP's images, damaged or hostile."""

import json
from collections.abc import Callable

from fuzz.case import Case, Maker, Random
from fuzz.mutations import NUMBERS, as_json, confused, damaged

LIST = b"cameras:\n  - {name: left}\n  - {name: right, place: [0.6, 0, 0], turn: [-2, 0, 0], fov: 60}\n"
CAMERA = (
    b"  camera_model: pinhole\n  intrinsics: [30, 30, 16, 16]\n  resolution: [32, 32]\n  distortion_model: radtan\n"
)
CAMERA += b"  distortion_coeffs: [0.1, 0, 0, 0]\n"
STEP = b"  T_cn_cnm1: [[1, 0, 0, -0.6], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
CHAIN = b"cam0:\n" + CAMERA + b"cam1:\n" + CAMERA + STEP
POSE = [[1, 0, 0, 0.6], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
LENS = {"camera_model": "OPENCV", "fl_x": 30.0, "w": 32, "h": 32}
FRAMES = {**LENS, "frames": [{"file_path": f"{k}.png", "transform_matrix": POSE} for k in range(3)]}
CAMERAS = b"1 PINHOLE 32 32 30 30 16 16\n"
IMAGES = b"1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 -0.6 0 0 1 b.png\n1.5 2.5 7\n"


def rig(random: Random) -> Case:
    """One of them."""
    written = json.dumps(FRAMES).encode()
    kinds: dict[str, tuple[str, Callable[[], bytes]]] = {
        "list: damaged": ("rig.yaml", lambda: damaged(random, LIST)[1]),
        "list: an odd number": ("rig.yaml", lambda: LIST.replace(b"0.6", random.choice(NUMBERS))),
        "list: ten thousand": ("rig.yaml", lambda: b"cameras: [" + b"{}," * 10_000 + b"]"),
        "chain: damaged": ("rig.yaml", lambda: damaged(random, CHAIN)[1]),
        "chain: an odd number": ("rig.yaml", lambda: CHAIN.replace(b"-0.6", random.choice(NUMBERS))),
        "frames: damaged": ("transforms.json", lambda: damaged(random, written)[1]),
        "frames: confused": ("transforms.json", lambda: as_json(confused(random, FRAMES))),
        "frames: a million": (
            "transforms.json", lambda: json.dumps({**LENS, "frames": []}).encode()[:-2] + b"{}," * 1_000_000 + b"{}]}"
        ),
        "frames: nested": ("transforms.json", lambda: b'{"frames": ' + b"[" * 50_000 + b"]" * 50_000 + b"}"),
        "images: damaged": ("images.txt", lambda: damaged(random, IMAGES)[1]),
        "images: an odd number": ("images.txt", lambda: IMAGES.replace(b"-0.6", random.choice(NUMBERS))),
        "images: a line of 30 MB": ("images.txt", lambda: IMAGES.replace(b"7", b"7 " * 15_000_000)),
        "images: a million": (
            "images.txt", lambda: b"".join(b"%d 1 0 0 0 0 0 0 1 a\n\n" % k for k in range(1_000_000))
        ),
    }  # fmt: skip
    what = random.choice(sorted(kinds))
    name, made = kinds[what]
    files = {name: made(), "cameras.txt": damaged(random, CAMERAS)[1] if random.random() < 0.3 else CAMERAS}
    links: dict[str, str] = {}
    pipes: tuple[str, ...] = ()
    if name == "images.txt" and random.random() < 0.2:
        del files["cameras.txt"]
        links, pipes = ({"cameras.txt": "/dev/zero"}, ()) if random.random() < 0.5 else ({}, ("cameras.txt",))
    return Case(f"rig {what}", "rig", name, files, links=links, pipes=pipes)


MAKERS: tuple[Maker, ...] = (rig, rig)
