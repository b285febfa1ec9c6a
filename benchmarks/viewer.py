"""How quick the pages of runs are: python benchmarks/viewer.py [--rows 1000000] [--keep-pictures all] [--attack].

The rows are made up; with `--keep-pictures all` each has a small picture (links to a few files). What is timed is
reading them from the store when the sweep ends, and in Chromium (through Playwright, both of which `make test` sees
to): the first paint of the page from `advsearch dashboard`, the map, and each interaction until the page is painted
again. Seconds; medians of five for interactions.

With `--list` it is the list of so many runs: processor time of a first request, of a second, and their ratio.

With `--attack` it is the page of a real attack of 40 steps on a texture at 224 pixels: how large it is,
how long it takes to be made, and until the object that can be turned is drawn.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import statistics
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from advsearch.options import Value
from advsearch.questions.sweep.page import write_sweep_page
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.runs.directory import COLUMNS, RunDirectory
from advsearch.runs.store import Row
from advsearch.viewer import thumbnails
from advsearch.viewer.server import Dashboard

if TYPE_CHECKING:
    from playwright.sync_api import Page

REPEATS = 5
STEPS, SIDE = 40, 224
"""Steps of the attack, and pixels a side of its pictures."""
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
BATCH = 10_000
PAINTED = """(change) => new Promise((done) => {
  const begun = performance.now();
  change();
  requestAnimationFrame(() => setTimeout(() => done(performance.now() - begun)));
})"""
CHANGES = {
    "another parameter across": "() => choose('parameter-2', across = across === 'across' ? 'up' : 'across')",
    "another value on a slider": "() => slide('parameter-0-value', value = 1 - value)",
    "a cell": "() => document.querySelectorAll('[data-cell]')[place = (place + 7) % 40].click()",
    "wrong predictions only": "() => pick('Show', shown = shown === 'wrong' ? 'all' : 'wrong')",
    "maps side by side": "() => pick('Side by side', by = by === '' ? 'object' : '')",
}
HELPERS = """() => {
  Object.assign(window, {across: 'across', value: 0, place: 0, shown: 'all', by: ''});
  const set = (element, value, kind) => { element.value = value; element.dispatchEvent(new Event(kind)); };
  window.choose = (id, value) => set(document.getElementById(id), value, 'change');
  window.slide = (id, value) => set(document.getElementById(id), value, 'input');
  window.pick = (label, value) => set(document.querySelector(`select[aria-label="${label}"]`), value, 'change');
}"""


def row(step: int, chance: random.Random) -> Row:
    """A made-up row: 24 yaws, 8 elevations, 4 environments, 2 objects, and two numbers drawn by chance."""
    yaw, elevation = 15.0 * (step % 24), 5.0 + 8.0 * (step // 24 % 8)
    environment, thing = "abcd"[step // 192 % 4], "xy"[step // 768 % 2]
    wrong = chance.random() < 0.1 + 0.6 * (elevation > 50 and environment == "b")
    values: dict[str, Value] = {
        "environment": {"value": environment, "unit": ""},
        "object": {"value": thing, "unit": ""},
        "pose.yaw": {"value": yaw, "unit": "degrees"},
        "camera.elevation": {"value": elevation, "unit": "degrees"},
        "light.power": {"value": chance.uniform(0.5, 2.0), "unit": "1"},
        "pose.x": {"value": chance.uniform(-0.2, 0.2), "unit": "object sizes"},
    }
    label = "cup" if wrong else "mug"
    margin = chance.gauss(-2.0 if wrong else 3.0, 1.0)
    return Row("sweep", step, correct=not wrong, margin=margin, label=label, probability=0.9, values=values)


def keep(run: Path, numbers: range) -> None:
    """Keep one picture under many numbers: by links, which a file system takes some ten thousand of."""
    picture = thumbnails.thumbnail([[[random.random() for _ in range(3)] for _ in range(64)] for _ in range(64)])
    for number in numbers:
        path = thumbnails.path_of(run, number)
        if number == numbers.start or number % thumbnails.A_FOLDER == 0:
            path.parent.mkdir(parents=True, exist_ok=True)
        if number == numbers.start:
            path.write_bytes(picture)
        else:
            os.link(thumbnails.path_of(run, numbers.start), path)


def make(folder: Path, count: int, pictures: Literal["all", "none"]) -> dict[str, float]:
    """Make the run of a sweep that has ended, and say what that took."""
    config = SweepConfig(object="mug", run=str(folder), grid={"pose.yaw": [0, 15]}, keep_pictures=pictures)
    chance, right = random.Random(0), 0
    with RunDirectory.create_for(config) as run:
        for begin in range(0, count, BATCH):
            numbers = range(begin, min(begin + BATCH, count))
            if pictures == "all":
                keep(folder, numbers)
            rows = [row(step, chance) for step in numbers]
            right += sum(bool(one.correct) for one in rows)
            run.record(*rows)
        share = right / count
        summary = SweepSummary.of(
            {
                "run": str(folder), "environment": "a,b,c,d", "controls": [], "ending": "finished", "seed": 0,
                "seconds": {"total": 1.0}, "command_line": "", "object": "x,y", "model": "made up",
                "task": "classification", "image_formation": None, "planned": count, "configurations": count,
                "correct": right, "accuracy": share, "interval": (share - 0.001, share + 0.001), "not_finite": 0,
                "answers": {}, "axes": [], "cells": None, "worst": None, "grid": {}, "samples": 1, "sampler": None,
                "spp": 16, "renders": {"sweep": count}, "renders_per_second": None, "warnings": [],
            }
        )  # fmt: skip
        begun = time.perf_counter()
        run.write_summary(summary)
        write_sweep_page(run.path, summary)
        return {"columns when it ends [s]": time.perf_counter() - begun}


def timed(page: Page, address: str) -> dict[str, float]:
    """Open the page and interact."""
    begun = time.perf_counter()
    page.goto(address, wait_until="commit")
    page.wait_for_selector("[data-cell]", timeout=120_000)
    answer = {"map [s]": time.perf_counter() - begun}
    answer["first paint [s]"] = (
        page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime") / 1e3
    )
    page.evaluate(HELPERS)
    page.evaluate("() => choose('parameter-0', 'one value')")
    for name, change in CHANGES.items():
        seconds = [page.evaluate(f"() => ({PAINTED})({change})") / 1e3 for _ in range(REPEATS)]
        answer[f"{name} [s]"] = statistics.median(seconds)
    return answer


def of_attack(folder: Path) -> dict[str, float]:
    """Attack, make its page again, and open it."""
    from playwright.sync_api import sync_playwright

    import advsearch
    from advsearch.questions.attack.summary import attack_of
    from advsearch.viewer.pages import write_page

    scene = advsearch.load_scene("teapot")
    advsearch.attack(scene, controls=["texture"], steps=STEPS, resolution=SIDE, run=folder)
    seconds = []
    for _ in range(REPEATS):
        begun = time.perf_counter()
        report = write_page(folder, attack_of(folder))
        seconds.append(time.perf_counter() - begun)
    found = {"page made [s]": statistics.median(seconds), "page [MB]": report.stat().st_size / 1e6}
    with sync_playwright() as playwright:
        drawing = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=drawing)
        page, begun = browser.new_page(bypass_csp=True), time.perf_counter()
        page.goto(report.as_uri(), wait_until="commit")
        page.wait_for_selector("#object canvas")
        found["object drawn [s]"] = time.perf_counter() - begun
        browser.close()
    return found


def of_sweep(folder: Path, rows: int, pictures: Literal["all", "none"]) -> dict[str, float]:
    """Make a sweep, open it from the server, and interact."""
    from playwright.sync_api import sync_playwright

    found = make(folder, rows, pictures)
    found["columns [MB]"] = (folder / COLUMNS).stat().st_size / 1e6
    server = Dashboard([folder])
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(bypass_csp=True)
        found |= timed(page, f"{server.address}runs/{folder.name}/")
        browser.close()
    server.shutdown()
    return found


def of_list(folder: Path, count: int) -> dict[str, float]:
    """Make the runs, and ask for their list twice."""
    home = folder / "runs"
    make(home / "0", 8, "none")
    for number in range(1, count):
        shutil.copytree(home / "0", home / str(number))
    os.chdir(folder)
    server, seconds = Dashboard(()), []
    for _ in range(2):
        begun = time.process_time()
        server.list_page()
        seconds.append(time.process_time() - begun)
    server.server_close()
    return {"first list [s]": seconds[0], "second list [s]": seconds[1], "ratio": seconds[0] / seconds[1]}


def main() -> int:
    """Make the run, open it, and print what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=1_000_000, help="rows of the sweep")
    parser.add_argument("--keep-pictures", choices=["all", "none"], default="none", help="of the sweep")
    parser.add_argument("--attack", action="store_true", help="the page of an attack in place of a sweep's")
    parser.add_argument("--list", type=int, metavar="COUNT", help="the list of so many runs in place of a page")
    parser.add_argument("--json", action="store_true", help="print JSON")
    args = parser.parse_args()
    if CHROMIUM is None and not args.list:
        print("there is no Chromium here: apt-get install chromium", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        if args.list:
            found = of_list(Path(folder), args.list)
        else:
            found = of_attack(run) if args.attack else of_sweep(run, args.rows, args.keep_pictures)
    if args.json:
        print(json.dumps(found if args.attack or args.list else {"rows": args.rows, **found}, indent=2))
        return 0
    for name, value in found.items():
        print(f"{name:32} {value:8.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
