"""Results of small runs, kept and compared bit for bit, so that a change of form is
seen to change nothing.

    python benchmarks/golden.py keep FOLDER [--only texture]      before a change
    python benchmarks/golden.py compare FOLDER [--only texture]   after it

Every control is swept and attacked, every policy and objective searches, and every
question is asked, on the bundled mug at 48 x 48 pixels with 2 samples, deterministic.
Longer runs are predicted in every way there is: by a matrix, by a bank of them and by
light on surfaces. Imported files, a camera file, drives and other tasks are there too.
Exported rows, the numbers of each summary and digests of pictures are compared; only
seconds, dates and paths are left out. The exit status is 3 if anything differs. Rows
are of one processor and one libLLVM: another machine's need not equal them.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import hashlib
import io
import json
import os
import struct
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import torch
from torch import Tensor, nn

from advsearch import Model, load_model
from advsearch.attacks.objectives import OBJECTIVES
from advsearch.attacks.policies import POLICIES
from advsearch.cli.main import main as advsearch

SMALL = (
    "--object",
    "mug",
    "--resolution",
    "48",
    "--spp",
    "2",
    "--seed",
    "5",
    "--deterministic",
    "--quiet",
)
SWEPT = {
    "pose": "pose.yaw=-40,70",
    "camera": "camera.azimuth=20,110",
    "texture": "texture.resolution=4",
    "material": "material.roughness=0.2,0.8",
    "light": "light.power=2,9",
    "environment": "environment.rotation=40,200",
    "sky": "sky.elevation=10,60",
    "geometry": "geometry.epsilon=0.05",
    "patch": "patch.size=0.3",
    "occlusion": "occlusion.coverage=0.2,0.4",
    "contents": "contents.level=0.4,0.9",
    "background": "background.hue=40,200",
    "haze": "haze.density=0.1,0.4",
    "lens": "lens.dots=2",
    "sensor": "sensor.mosaic=0,1",
    "corruption": "corruption.severity=2,4",
}
"""One small grid of each control, or, for a control without numbers, its settings."""
FORMS = {
    "texture": "texture={resolution: 4, epsilon: 0.4}",
    "geometry": "geometry={modes: 4, epsilon: 0.1}",
    "patch": "patch={resolution: 4, size: 0.3}",
    "lens": "lens={dots: 2}",
}
"""Controls that are attacked in a small form."""
TIMES = ("second", "time", "date", "start", "started", "created", "rate", "per_second")
"""Words of columns and keys that are about time."""
PLACES = (
    "run",
    "path",
    "folder",
    "resume",
    "version",
    "versions",
    "machine",
    "command",
    "command_line",
    "repeat",
)
"""Keys that are about where a run lies and what it ran on."""


PREDICTED = "predicted-"
"""Names of commands that have to predict pictures: one that renders them all is
refused.
"""


def commands() -> dict[str, list[list[str]]]:
    """Return every command by its name here, after those whose runs it reads: `run-0`
    is the run of the first one.

    Paths are relative to a folder with the files of `make_files`.
    """
    few = ["--steps", "3", "--trials", "6"]
    found = {}
    for control, grid in SWEPT.items():
        name = FORMS.get(control, control)
        axes = (
            ["--control", name, "--samples", "4"]
            if control in FORMS
            else ["--grid", grid]
        )
        found[f"sweep-{control}"] = [["sweep", *axes, "--trials", "6"]]
        found[f"attack-{control}"] = [["attack", "--control", name, *few]]
    for policy in POLICIES:
        controls = "pose.yaw" if policy == "grid" else "pose,camera"
        found[f"policy-{policy}"] = [
            ["attack", "--control", controls, "--policy", policy, *few]
        ]
    for objective in OBJECTIVES:
        found[f"objective-{objective}"] = [
            ["attack", "--control", "pose", "--objective", objective, *few]
        ]
    texture = FORMS["texture"]
    single = {
        "mixture": ["attack", "--control", f"pose,light,{texture}", *few],
        "over": ["attack", "--control", texture, "--over", "camera,light", *few],
        "average": ["attack", "--control", "pose", "--average", "4", *few],
        "target": ["attack", "--control", texture, "--target", "bowl", *few],
        "minimise": ["attack", "--control", "pose", "--minimise", *few],
        "smallest": ["attack", "--control", texture, "--smallest", *few],
        "study": [
            "attack",
            "--object",
            "mug,bowl",
            "--control",
            "pose",
            "--average",
            "4",
            *few,
        ],
        "region": ["region", "--control", "pose", "--samples", "8"],
    }
    return (
        {name: [command] for name, command in single.items()}
        | found
        | predictions()
        | worlds()
        | questions()
    )


def predictions() -> dict[str, list[list[str]]]:
    """Return searches and sweeps that are long enough to be predicted, and large enough
    that it pays.
    """
    texture = FORMS["texture"]
    few = ["--trials", "6", "--verify-spp", "4", "--measure", "no"]
    wide = ["--epsilon", "0.3", "--steps", "40", "--trials", "20", "--measure", "no"]
    large = ["--resolution", "96", "--spp", "8"]
    found = {
        "matrix": ["attack", "--control", texture, "--steps", "20", *few],
        "light": [
            "attack",
            "--control",
            "light.power",
            "--steps",
            "40",
            "--policy",
            "random",
            *few,
        ],
        "bank": ["attack", "--control", texture, "--over", "light", *wide],
        "over-camera": ["attack", "--control", texture, "--over", "camera", *wide],
        "sweep-light": [
            "sweep",
            "--control",
            "light.power",
            "--samples",
            "100",
            "--trials",
            "0",
            "--spp",
            "32",
        ],
        "sweep-camera": [
            "sweep",
            "--control",
            "camera",
            "--samples",
            "150",
            "--trials",
            "0",
            *large,
        ],
        "camera": [
            "attack",
            "--control",
            "camera",
            "--steps",
            "40",
            "--policy",
            "random",
            *few,
            *large,
        ],
    }
    return {f"{PREDICTED}{name}": [command] for name, command in found.items()}


def worlds() -> dict[str, list[list[str]]]:
    """Return runs with objects, cameras, paths and tasks of other kinds."""
    picture = ["--out", "picture.png", "--set", "camera.azimuth=30"]
    few = ["--steps", "3", "--trials", "6"]
    found = {
        f"object-{ending}": ["render", "--object", f"box.{ending}", *picture]
        for ending in ("obj", "ply", "glb")
    }
    found["camera-file"] = ["render", "--camera", "camera.yaml", *picture]
    found["drive"] = [
        "sweep",
        "--path",
        "approach",
        "--fps",
        "1",
        "--grid",
        "pose.yaw=0,90",
    ]
    found["over-path"] = [
        "attack",
        "--control",
        FORMS["texture"],
        "--over",
        "path",
        "--path",
        "approach",
        *few,
    ]
    for task, model in (
        ("detection", "Finder"),
        ("depth={kind: relative disparity}", "Ranger"),
    ):
        name = task.partition("=")[0]
        asked = ["--task", task, "--model", f"golden:{model.lower()}"]
        found[name] = ["attack", "--control", "light", *asked, *few]
        found[f"sweep-{name}"] = ["sweep", "--grid", "light.power=2,9", *asked]
    return {name: [command] for name, command in found.items()}


def questions() -> dict[str, list[list[str]]]:
    """Return the questions that read runs, or take settings of other kinds; not
    `precision`, whose times decide.
    """
    small = ["attack", "--control", "pose", "--steps", "3", "--trials", "6"]
    swept = ["sweep", "--control", "pose,light", "--samples", "120", "--trials", "0"]
    few = [
        "--rounds",
        "1",
        "--scenes",
        "1",
        "--views",
        "1",
        "--epochs",
        "1",
        "--measured",
        "2",
    ]
    return {
        "check": [["check", "--control", "light.power"]],
        "compare": [
            [
                "compare",
                "reference",
                "golden:colours",
                "--control",
                "pose",
                "--samples",
                "24",
            ]
        ],
        "explain": [
            swept,
            ["explain", "run-0", "--confirm", "0", "--pairs", "2", "--clusters", "8"],
        ],
        "replay": [
            small,
            [
                "replay",
                "run-0",
                "--trials",
                "6",
                "--ways",
                "samples,resolution,depth,curve,jpeg,sensor",
            ],
        ],
        "evidence": [small, swept, ["report", "run-0", "run-1", "--evidence"]],
        "test": [["test", "suite.yaml"]],
        "recipe": [["recipe", "liquid", "--quick"]],
        "harden": [
            [
                "harden",
                "--object",
                "ball,book",
                "--control",
                "texture",
                "--epsilon",
                "0.03",
                *few,
            ]
        ],
    }


def finder() -> Model:
    """A detector of the mug's blue band."""

    class Finder(nn.Module):
        def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
            blue = (x[:, 2] - x[:, 0])[:, 15:21, 8:22].mean(dim=(1, 2))
            box = x.new_tensor([[[0.12, 0.12, 0.86, 0.86]]]).expand(x.shape[0], -1, -1)
            scores = torch.stack(
                [30.0 * (blue - 0.1), 30.0 * (0.1 - blue)], dim=1
            ).sigmoid()
            return box, scores[:, None]

    return load_model(
        Finder(), task="detection", labels=["mug", "bowl"], input_size=32, name="finder"
    )


def ranger() -> Model:
    """Disparity: what is bright is near."""

    class Ranger(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return 5.0 * x.mean(dim=1) + 0.1

    return load_model(Ranger(), task="depth", input_size=32, name="ranger")


def colours() -> Model:
    """A classifier by mean colours whose weights come from a seed."""

    class Colours(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(4)
                self.last = nn.Linear(48, 14)

        def forward(self, x: Tensor) -> Tensor:
            found: Tensor = self.last(
                nn.functional.adaptive_avg_pool2d(x, 4).flatten(1)
            )
            return found

    return load_model(
        Colours(),
        labels=list(load_model("reference").labels),
        input_size=32,
        name="colours",
    )


def make_files(folder: Path) -> None:
    """Write a textured wedge as .obj, .ply and .glb, a camera with distortion, and a
    suite of claims.
    """
    points = np.array(
        [
            [0, 0, 0],
            [1, 0, 0],
            [1, 0.6, 0],
            [0, 0.6, 0],
            [0.2, 0.1, 0.8],
            [0.8, 0.1, 0.5],
        ],
        dtype=np.float32,
    )
    faces = np.array(
        [
            [0, 2, 1],
            [0, 3, 2],
            [0, 1, 5],
            [0, 5, 4],
            [1, 2, 5],
            [2, 3, 4],
            [2, 4, 5],
            [3, 0, 4],
        ]
    )
    uv = points[:, :2] * np.float32(0.9) + np.float32(0.05)
    picture = np.random.default_rng(1).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    imageio.imwrite(folder / "skin.png", picture)
    (folder / "box.mtl").write_text("newmtl skin\nmap_Kd skin.png\n", "utf-8")
    lines = [
        "mtllib box.mtl",
        *(f"v {x:g} {y:g} {z:g}" for x, y, z in points),
        *(f"vt {u:g} {v:g}" for u, v in uv),
    ]
    lines += [
        "usemtl skin",
        *(
            "f " + " ".join(f"{corner + 1}/{corner + 1}" for corner in face)
            for face in faces
        ),
    ]
    (folder / "box.obj").write_text("\n".join(lines) + "\n", "utf-8")
    head = [
        f"element vertex {len(points)}",
        *(f"property float {name}" for name in "xyzst"),
    ]
    head += [
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    rows = [
        " ".join(f"{value:g}" for value in row)
        for row in np.concatenate([points, uv], axis=1)
    ]
    rows += ["3 " + " ".join(map(str, face)) for face in faces]
    (folder / "box.ply").write_text(
        "\n".join(["ply", "format ascii 1.0", *head, *rows]) + "\n", "utf-8"
    )
    (folder / "box.glb").write_bytes(
        glb(points, uv, faces.astype(np.uint32), (folder / "skin.png").read_bytes())
    )
    matrix = {"rows": 3, "cols": 3, "data": [60, 0, 31, 0, 60, 25, 0, 0, 1]}
    distortion = {"rows": 1, "cols": 5, "data": [-0.3, 0.1, 0.001, 0, 0]}
    camera = {"image_width": 64, "image_height": 48, "camera_matrix": matrix}
    camera |= {"distortion_model": "plumb_bob", "distortion_coefficients": distortion}
    (folder / "camera.yaml").write_text(json.dumps(camera), "utf-8")
    around = {"controls": {"camera": {"azimuth": [0, 360]}}}
    search = {
        "controls": "pose",
        "policy": "random",
        "steps": 4,
        "trials": 6,
        "measure": "no",
    }
    claims = {
        "seen": {"claim": "right", "at_least": 0.5, "pictures": 24, "settings": around},
        "held": {"claim": "not_broken", "settings": search},
    }
    settings = {"object": "mug", "resolution": 48, "verify_spp": 2}
    (folder / "suite.yaml").write_text(
        json.dumps({"title": "Small", "settings": settings, "claims": claims}), "utf-8"
    )


def glb(points: np.ndarray, uv: np.ndarray, faces: np.ndarray, picture: bytes) -> bytes:
    """Return a binary glTF with one textured mesh."""
    chunks = [
        points.tobytes(),
        uv.tobytes(),
        faces.tobytes(),
        picture + b"\0" * (-len(picture) % 4),
    ]
    begins = np.cumsum([0, *map(len, chunks)])
    views = [
        {"buffer": 0, "byteOffset": int(at), "byteLength": len(one)}
        for at, one in zip(begins, chunks, strict=False)
    ]
    accessors: list[dict[str, Any]] = [
        {"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3",
         "min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()},
        {"bufferView": 1, "componentType": 5126, "count": len(uv), "type": "VEC2"},
        {"bufferView": 2, "componentType": 5125, "count": faces.size, "type": "SCALAR"},
    ]  # fmt: skip
    views[3]["byteLength"] = len(picture)
    mesh = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
    head = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [mesh]}], "accessors": accessors, "bufferViews": views,
        "buffers": [{"byteLength": int(begins[-1])}], "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "textures": [{"source": 0}], "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
    }  # fmt: skip
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(chunks)
    parts = (
        struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(body), b"BIN\0")
        + body
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts


PLAIN = ("--seed", "5", "--threads", "1", "--quiet")
SHARED: Mapping[str, Sequence[str]] = {
    "region": [word.replace("--spp", "--verify-spp") for word in SMALL],
    "check": [word for word in SMALL if word != "--deterministic"],
    "explain": PLAIN,
    "test": (*PLAIN[:2], "--deterministic", "--quiet"),
    "replay": PLAIN[2:],
    "report": (),
    "recipe": ("--resolution", "32", *PLAIN[:2], "--deterministic", "--quiet"),
    "harden": (
        "--model",
        "golden:colours",
        "--resolution",
        "32",
        "--texture-resolution",
        "8",
        *PLAIN,
    ),
}
"""What stands behind a command, where that is not `SMALL`."""


def answers(name: str, folder: Path) -> list[dict[str, Any]]:
    """Run a command, and those before it, in this process; returns their rows and the
    numbers of their results.
    """
    make_files(folder)
    here = Path.cwd()
    os.chdir(folder)
    try:
        found = [
            answer(command, f"run-{number}")
            for number, command in enumerate(commands()[name])
        ]
    finally:
        os.chdir(here)
    if name.startswith(PREDICTED) and not any(
        (*counted(found, "products"), *counted(found, "predicted"))
    ):
        raise SystemExit(f"{name}: expected predicted pictures, got none")
    return [timeless(one) for one in found]


def answer(command: Sequence[str], run: str) -> dict[str, Any]:
    """Run one command; returns its rows, the numbers of its result and the digest of
    its picture, where it has them.
    """
    shared = SHARED.get(command[0], SMALL)
    twice = shared[:2] == SMALL[:2] and "--object" in command
    where = {"render": (), "report": ("--out", run)}.get(
        command[0], ("--run", str(Path.cwd() / run))
    )
    said = written(
        [command[0], *(shared[2:] if twice else shared), *command[1:], *where, "--json"]
    )
    found: dict[str, Any] = {"answer": json.loads(said) if said.strip() else None}
    if command[0] in ("attack", "sweep"):
        # the rows of a study are those of its parts
        parts = sorted(Path(run, "parts").glob("*")) or [Path(run)]
        exported = [written(["export", str(part)]) for part in parts]
        found["rows"] = [
            row for text in exported for row in csv.DictReader(io.StringIO(text))
        ]
    if command[0] == "render":
        found["digest"] = hashlib.sha256(
            imageio.imread("picture.png").tobytes()
        ).hexdigest()
    return found


def counted(value: Any, key: str) -> Iterator[int]:
    """Yield the numbers under a key, wherever they are."""
    if isinstance(value, Mapping):
        for name, one in value.items():
            yield from (
                [int(one)]
                if name == key and isinstance(one, int | float)
                else counted(one, key)
            )
    elif isinstance(value, (list, tuple)):
        for one in value:
            yield from counted(one, key)


def written(words: Sequence[str]) -> str:
    """Return what a command writes on standard output.

    Raises:
        SystemExit: it failed.
    """
    stream = io.TextIOWrapper(io.BytesIO(), "utf-8")
    with contextlib.redirect_stdout(stream):
        status = advsearch(list(words))
    stream.flush()
    stream.seek(0)
    said = stream.read()
    # a suite that is undecided ends with 2, and answers
    if status not in (0, 3) and not (status == 2 and said):
        raise SystemExit(f"advsearch {' '.join(words)}: ended with status {status}")
    return said


def timeless(value: Any) -> Any:
    """Return a value without what two equal runs may differ in: times and places."""
    if isinstance(value, Mapping):
        return {
            key: timeless(one) for key, one in value.items() if not passing(str(key))
        }
    if isinstance(value, (list, tuple)):
        return [timeless(one) for one in value]
    if isinstance(value, str) and "/" in value:
        return "a path"
    return value


def passing(key: str) -> bool:
    """Whether a key is about time or place."""
    return key in PLACES or any(
        word in key.lower().split(".")[-1].split("_") or key.endswith("seconds")
        for word in TIMES
    )


def differences(kept: Any, found: Any, place: str = "") -> Iterator[str]:
    """Yield where two results differ, with both values."""
    if isinstance(kept, dict) and isinstance(found, dict):
        for key in sorted(key for key in {*kept, *found} if not passing(key)):
            inside = f"{place}.{key}" if place else key
            if key not in kept or key not in found:
                if kept.get(key, found.get(key)) in (None, ""):
                    continue  # an empty cell of a new column
                yield f"{inside}: only {'before' if key in kept else 'now'}"
            else:
                yield from differences(kept[key], found[key], inside)
    elif isinstance(kept, list) and isinstance(found, list) and len(kept) == len(found):
        for index, pair in enumerate(zip(kept, found, strict=True)):
            yield from differences(*pair, f"{place}[{index}]")
    elif kept != found and not (kept is None and found is None):
        yield f"{place}: {str(kept)[:60]} -> {str(found)[:60]}"


def main(argv: Sequence[str] | None = None) -> int:
    """Keep or compare; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("do", choices=("keep", "compare"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="commands whose name contains this")
    args = parser.parse_args(argv)
    args.folder.mkdir(parents=True, exist_ok=True)
    names = [name for name in commands() if args.only in name]
    bad = 0
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            found = json.loads(json.dumps(answers(name, Path(folder))))
        file = args.folder / f"{name}.json"
        if args.do == "keep":
            file.write_text(json.dumps(found, indent=1), "utf-8")
            print(
                f"{name:24s} kept, {sum(len(one.get('rows', ())) for one in found)} "
                "rows",
                flush=True,
            )
            continue
        where = (
            list(differences(json.loads(file.read_text("utf-8")), found))
            if file.exists()
            else ["not kept before"]
        )
        bad += bool(where)
        print(
            f"{name:24s} {'equal' if not where else f'{len(where)} differences'}",
            flush=True,
        )
        for line in where[:5]:
            print(f"    {line}")
    print(
        f"{len(names)} commands" + (f", {bad} differ" if args.do == "compare" else "")
    )
    return 3 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
