"""Rows of small sweeps and searches, kept and compared bit for bit, so that a change of form is seen to change nothing.

    python benchmarks/golden.py keep FOLDER [--only texture]      before a change
    python benchmarks/golden.py compare FOLDER [--only texture]   after it

Every control is swept and attacked, every policy and objective searches, and each question about a space is asked once,
on the bundled mug at 48 x 48 pixels with 2 samples, deterministic. The exported rows and the numbers of each summary
are compared; only seconds, dates and paths are left out. The exit status is 3 if anything differs. Rows are of one
processor and one libLLVM: another machine's need not equal them.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import json
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from advsearch.attacks.objectives import OBJECTIVES
from advsearch.attacks.policies import POLICIES
from advsearch.cli.main import main as advsearch

SMALL = ("--object", "mug", "--resolution", "48", "--spp", "2", "--seed", "5", "--deterministic", "--quiet")
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
PLACES = ("run", "path", "folder", "resume", "version", "versions", "machine", "command", "argv", "repeat")
"""Keys that are about where a run lies and what it ran on."""


def commands() -> dict[str, list[str]]:
    """Return every command by its name here."""
    few = ["--steps", "3", "--trials", "6"]
    found = {}
    for control, grid in SWEPT.items():
        name = FORMS.get(control, control)
        axes = ["--control", name, "--samples", "4"] if control in FORMS else ["--grid", grid]
        found[f"sweep-{control}"] = ["sweep", *axes, "--trials", "6"]
        found[f"attack-{control}"] = ["attack", "--control", name, *few]
    for policy in POLICIES:
        controls = "pose.yaw" if policy == "grid" else "pose,camera"
        found[f"policy-{policy}"] = ["attack", "--control", controls, "--policy", policy, *few]
    for objective in OBJECTIVES:
        found[f"objective-{objective}"] = ["attack", "--control", "pose", "--objective", objective, *few]
    texture = FORMS["texture"]
    return {
        **found,
        "mixture": ["attack", "--control", f"pose,light,{texture}", *few],
        "over": ["attack", "--control", texture, "--over", "camera,light", *few],
        "average": ["attack", "--control", "pose", "--average", "4", *few],
        "target": ["attack", "--control", texture, "--target", "bowl", *few],
        "minimise": ["attack", "--control", "pose", "--minimise", *few],
        "smallest": ["attack", "--control", texture, "--smallest", *few],
        "gap": ["gap", "--control", "pose,camera", "--average", "4", *few],
        "region": ["region", "--control", "pose", "--samples", "8"],
    }


def answers(command: Sequence[str], folder: Path) -> dict[str, Any]:
    """Run one command in this process; returns its rows and the numbers of its answer."""
    run = folder / "run"
    shared = [word.replace("--spp", "--verify-spp") for word in SMALL] if command[0] == "region" else SMALL
    said = written([*command, *shared, "--run", str(run), "--json"])
    found: dict[str, Any] = {"answer": timeless(json.loads(said)) if said.strip() else None}
    if command[0] in ("attack", "sweep"):
        found["rows"] = [timeless(row) for row in csv.DictReader(io.StringIO(written(["export", str(run)])))]
    return found


def written(words: Sequence[str]) -> str:
    """Return what a command writes on standard output.

    Raises:
        SystemExit: it ended with another status than 0 and 3.
    """
    stream = io.TextIOWrapper(io.BytesIO(), "utf-8")
    with contextlib.redirect_stdout(stream):
        status = advsearch(list(words))
    if status not in (0, 3):
        raise SystemExit(f"advsearch {' '.join(words)}: ended with status {status}")
    stream.flush()
    stream.seek(0)
    return stream.read()


def timeless(value: Any) -> Any:
    """Return a value without what two equal runs may differ in: times and places."""
    if isinstance(value, Mapping):
        return {key: timeless(one) for key, one in value.items() if not passing(str(key))}
    if isinstance(value, (list, tuple)):
        return [timeless(one) for one in value]
    if isinstance(value, str) and "/" in value:
        return "a path"
    return value


def passing(key: str) -> bool:
    """Whether a key is about time or place."""
    return key in PLACES or any(word in key.split(".")[-1].split("_") or key.endswith("seconds") for word in TIMES)


def differences(kept: Any, found: Any, place: str = "") -> Iterator[str]:
    """Yield where two answers differ, with both values."""
    if isinstance(kept, dict) and isinstance(found, dict):
        for key in sorted({*kept, *found}):
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
            found = json.loads(json.dumps(answers(commands()[name], Path(folder))))
        file = args.folder / f"{name}.json"
        if args.do == "keep":
            file.write_text(json.dumps(found, indent=1), "utf-8")
            print(f"{name:24s} kept, {len(found.get('rows', ()))} rows", flush=True)
            continue
        where = list(differences(json.loads(file.read_text("utf-8")), found)) if file.exists() else ["not kept before"]
        bad += bool(where)
        print(f"{name:24s} {'equal' if not where else f'{len(where)} differences'}", flush=True)
        for line in where[:5]:
            print(f"    {line}")
    print(f"{len(names)} commands" + (f", {bad} differ" if args.do == "compare" else ""))
    return 3 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
