"""Draws error against run time for every control: `docs/images/precision/NAME.svg` and `docs/precision-diagrams.md`.

    python docs/make_precision_images.py [NAME ...] [--seconds 45] [--resolution 64]

NAME is a control, or `picture` for the diagrams of the picture, the margin and the policies. Without names all are
drawn, and the page is written anew; with names only their figures and their entries in `diagrams.json` are.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from advsearch.controls import CONTROLS

DOCS = Path(__file__).resolve().parent
FOLDER, PAGE = DOCS / "images" / "precision", DOCS / "precision-diagrams.md"
FACTS = FOLDER / "diagrams.json"
PICTURE = "picture"
GOALS = (0.2, 0.5)
"""Relative errors of a gradient that the page says how to reach."""
BESIDE = {PICTURE: ("texture", "image", 4)}
"""Control, quantities and multiple of the time of what is no control."""
FEW = ("--samplers", "independent,multijitter")
"""Of the picture: what leaves time for the rest."""


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, draw and write; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="controls, or picture (default: all)")
    parser.add_argument("--seconds", type=int, default=45, help="time for one control (default 45)")
    parser.add_argument("--resolution", type=int, default=64, help="side of the pictures (default 64)")
    args = parser.parse_args(argv)
    FOLDER.mkdir(parents=True, exist_ok=True)
    facts: dict[str, Any] = json.loads(FACTS.read_text("utf-8")) if FACTS.exists() else {}
    for name in args.names or [PICTURE, *CONTROLS.own]:
        facts[name] = measured(name, args.seconds, args.resolution)
        print(f"measured: {name}", file=sys.stderr, flush=True)
        FACTS.write_text(json.dumps(facts, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    PAGE.write_text(page(facts), encoding="utf-8")
    return 0


def measured(name: str, seconds: int, resolution: int) -> dict[str, Any]:
    """Run `advsearch precision`, keep its figure, and return what the page says of it."""
    control, quantities, times = BESIDE.get(name, (name, "gradient", 1))
    command = [sys.executable, "-m", "advsearch", "precision", "--object", "mug", "--control", control]
    command += ["--quantities", quantities, "--seconds", str(times * seconds), "--resolution", str(resolution)]
    command += ["--error", str(GOALS[0]), "--json", "--quiet", *(FEW if name == PICTURE else ())]
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run([*command, "--run", f"{folder}/out"], capture_output=True, text=True, check=False)
        if done.returncode:
            return {"refused": done.stderr.strip().splitlines()[-1]}
        shutil.copy(Path(folder) / "out" / "images" / "precision.svg", FOLDER / f"{name}.svg")
    report = json.loads(done.stdout)
    kept = ("control", "estimator", "spp", "error", "cosine", "seconds")
    points = [
        {**{key: point.get(key) for key in kept}, "known": point["status"] == "ok"}
        for point in report["points"]
        if point["quantity"] == "gradient"
    ]
    return {"machine": report["machine"], "seconds": times * seconds, "resolution": resolution, "points": points}


def page(facts: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the page."""
    shown = sorted(name for name in facts if name in CONTROLS.own)
    some = next(facts[name] for name in shown if "machine" in facts[name])
    machine, side = some["machine"], some["resolution"]
    usual = statistics.mode(facts[name]["seconds"] for name in shown if "seconds" in facts[name])
    said = (
        "How long does a gradient take? The table has the fastest measured setting with at most that error. Scene: the "
        f"bundled mug in the studio, {side} x {side} pixels. Loss: smooth and linear in the raw picture. "
        f"{usual} seconds of measuring for each control, on {machine['cpu']}, {machine['cores']} cores, by "
        "`python docs/make_precision_images.py`. [Error against run time](precision.md) explains the diagrams."
    )
    lines = [
        "# Error against run time, control by control",
        "",
        "<!-- made by docs/make_precision_images.py; don't edit -->",
        "",
        *textwrap.wrap(said, 118),
        "",
        "| control | seconds for 20 % error | seconds for 50 % error | smallest error measured |",
        "| --- | --- | --- | --- |",
    ]
    for name in shown:
        fact = facts[name]
        if "refused" in fact:
            lines.append(f"| {name} | has no derivative | | |")
            continue
        known = [point for point in fact["points"] if point["known"]]
        cells = [_cheapest(known, goal) for goal in GOALS]
        best = min(known, key=lambda point: float(point["error"]), default=None)
        cells.append("none known" if best is None else f"{100 * best['error']:.3g} %: {_setting(best)}")
        longer = "" if fact["seconds"] == usual else f" ({fact['seconds']} s)"
        link = f"[{name}](#{name})" if (FOLDER / f"{name}.svg").exists() else name
        lines.append(f"| {link}{longer} | {' | '.join(cells)} |")
    lines += ["", "## The picture and the margin", "", f"![diagrams](images/precision/{PICTURE}.svg)"]
    for name in shown:
        if (FOLDER / f"{name}.svg").exists():
            lines += ["", f"## {name}", "", f"![error against seconds: {name}](images/precision/{name}.svg)"]
    return "\n".join(lines) + "\n"


def _cheapest(points: Sequence[Mapping[str, Any]], goal: float) -> str:
    """The fastest known point with at most this error; of several parts of a control, each on its own."""
    parts = dict.fromkeys(point["control"] for point in points)
    said = []
    for part in parts:
        good = [point for point in points if point["control"] == part and point["error"] <= goal]
        best = min(good, key=lambda point: float(point["seconds"]), default=None)
        where = f"{part.partition('.')[2]}: " if len(parts) > 1 else ""
        said.append(where + ("not reached" if best is None else f"{best['seconds']:.2g}: {_setting(best)}"))
    return "; ".join(said) or "not reached"


def _setting(point: Mapping[str, Any]) -> str:
    return f"{point['estimator']}, {point['spp']} samples"


if __name__ == "__main__":
    sys.exit(main())
