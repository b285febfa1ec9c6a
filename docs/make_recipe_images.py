"""Carries out the recipes, and keeps what they say and their figures for
docs/recipe-results.md.

    python docs/make_recipe_images.py OUT [--data FOLDER] [--only NAME,NAME] [--until HH:MM]
        [--anew]

Runs are kept in the folder OUT: what is done there is not done again. On bundled
objects they are quick ones. With
--data they are on a folder of meshes, environments and ImageNet classifiers of one's own, at the recipe's own counts.
`python docs/make_figures.py` puts what was kept into the page.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from PIL import Image

import advsearch
from advsearch.questions.recipe import recipe
from advsearch.questions.recipe.carry_out import RECIPE_NOTE
from advsearch.questions.recipe.description import read_recipe
from advsearch.questions.recipe.result import (
    RecipeConfig,
    RecipeResult,
    omit_repeated_sentences,
)
from advsearch.runs.directory import CONFIG
from advsearch.runs.store import NAME as STORE
from advsearch.runs.store import Store
from advsearch.runs.summary import NAME, read_result

DOCS = Path(__file__).resolve().parent
IMAGES = DOCS / "images" / "recipes"
KEPT = IMAGES / "results.json"

SHOWN = {
    "backgrounds": (1, 2),
    "texture-shape": (1, 3, 4),
    "orientation-scale": (1, 2, 3),
    "scaling": (1,),
    "liquid": (1, 2),
    "viewpoints": (1,),
    "pose-space": (1, 5),
    "common-corruptions": (1,),
    "physical": (1,),
    "parts": (1,),
    "realism": (1, 2),
}
"""The figures of each recipe that the page shows, from 1."""

LABELS = {
    "mug": "coffee mug,cup",
    "teapot": "teapot,coffeepot",
    "banana": "banana",
    "bowl": "mixing bowl,soup bowl",
}

ONE_OBJECT = ("liquid", "common-corruptions", "physical", "parts", "viewpoints")
ALL_OBJECTS = ("orientation-scale", "backgrounds")
"""Recipes on the mug alone, and on all four objects; others are on the mug and the
teapot.
"""

MOBILENET_V2 = "mobilenet_v2_imagenet.pt2"
EDGETPU = "mobilenet_edgetpu_075_imagenet_224.pt2"
MODELS = {"common-corruptions": (MOBILENET_V2, EDGETPU), "physical": (EDGETPU,)}
"""What sees the real data; in other recipes it is MobileNetV2 alone."""


def main() -> int:
    """Carry out what is asked for and keep it; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="the folder of the runs")
    parser.add_argument(
        "--data", type=Path, help="a folder with objects/, environments/ and models/"
    )
    parser.add_argument("--only", default=",".join(SHOWN), help="names of recipes")
    parser.add_argument(
        "--until", default="99:99", help="the time of day after which none is begun"
    )
    parser.add_argument(
        "--anew",
        action="store_true",
        help="make the figures of runs that are done anew, as they are now",
    )
    args = parser.parse_args()
    for name in args.only.split(","):
        if time.strftime("%H:%M") >= args.until:
            print(name, "was not begun", file=sys.stderr)
            continue
        run = args.out / (f"data-{name}" if args.data else f"q-{name}")
        if args.anew:
            renew(name, run)
        begun = (run / CONFIG).is_file()
        cpu = time.process_time()
        result = real(name, args.data, run) if args.data else bundled(name, run)
        if result.is_unfinished:
            print(name, "was interrupted, and is not kept", file=sys.stderr)
            return 1
        keep(
            name,
            result,
            "data" if args.data else "",
            None if begun else time.process_time() - cpu,
        )
        print(name, result.seconds["total"], file=sys.stderr)
    return 0


def keep(name: str, result: RecipeResult, suffix: str, cpu: float | None) -> None:
    """Keep what there is to tell of a run beside what is kept of others.

    Args:
        name: of the recipe.
        result: of the run.
        suffix: ``data``, or empty for bundled objects.
        cpu: seconds of processors; None for a run that was begun before, which keeps what
            was told of it.
    """
    IMAGES.mkdir(parents=True, exist_ok=True)
    kept: dict[str, dict[str, Any]] = (
        json.loads(KEPT.read_text("utf-8")) if KEPT.exists() else {}
    )
    before = kept.setdefault(name, {}).get(suffix or "bundled", {})
    new = told(name, result, suffix)
    same = before.get("renders") == new["renders"]
    new["cpu_seconds"] = (
        round(cpu) if cpu is not None else before.get("cpu_seconds") if same else None
    )
    kept[name][suffix or "bundled"] = new
    KEPT.write_text(
        json.dumps(kept, indent=1, ensure_ascii=False, sort_keys=True) + "\n",
        encoding="utf-8",
    )


def bundled(name: str, run: Path) -> RecipeResult:
    """Return what a recipe says of bundled objects, quickly."""
    return done(run) or gone_on(run) or advsearch.recipe(name, quick=True, run=run)


def real(name: str, data: Path, run: Path) -> RecipeResult:
    """Return what a recipe says of data of one's own."""
    several = name == "backgrounds"
    objects = list(LABELS)[
        : 1 if name in ONE_OBJECT else None if name in ALL_OBJECTS else 2
    ]
    environments = sorted(str(one) for one in (data / "environments").glob("*.hdr"))
    return (
        done(run)
        or gone_on(run)
        or advsearch.recipe(
            name,
            object=[str(data / "objects" / f"{one}.obj") for one in objects],
            environment=environments if several else environments[-1],
            model=[
                str(data / "models" / one) for one in MODELS.get(name, (MOBILENET_V2,))
            ],
            labels=data / "models" / "imagenet_labels.json",
            label={one: LABELS[one] for one in objects},
            run=run,
        )
    )


def done(run: Path) -> RecipeResult | None:
    """Return the result of a run that is done already."""
    result = read_result(run) if (run / NAME).is_file() else None
    return (
        result
        if isinstance(result, RecipeResult) and not result.is_unfinished
        else None
    )


def gone_on(run: Path) -> RecipeResult | None:
    """Return the result of a run that was begun, once it is done."""
    return (
        recipe.run(RecipeConfig.from_yaml(run / CONFIG), resumed_directory=run)
        if (run / CONFIG).is_file()
        else None
    )


def renew(name: str, run: Path) -> None:
    """Make the figures of a run that is done anew, those that its recipe has now;
    nothing is rendered.
    """
    if done(run):
        with Store(run / STORE) as store:
            kept = {
                **(store.read_json_note(RECIPE_NOTE) or {}),
                "figures": read_recipe(name).figures,
            }
            store.write_note(RECIPE_NOTE, json.dumps(kept))
        gone_on(run)


def told(name: str, result: RecipeResult, suffix: str) -> dict[str, Any]:
    """Copy the figures that are shown, and return what there is to tell."""
    figures = []
    texts = omit_repeated_sentences(result.figures)
    for number in SHOWN[name]:
        image = IMAGES / "-".join(filter(None, [name, suffix, f"{number}.png"]))
        image.parent.mkdir(parents=True, exist_ok=True)
        with Image.open(
            Path(str(result.run)) / "images" / f"figure-{number}.png"
        ) as figure:
            figure.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(
                image, optimize=True
            )
        made = result.figures[number - 1]
        figures.append(
            {"title": made.title, "text": texts[number - 1], "image": image.name}
        )
    return {
        "title": result.title,
        "objects": [Path(one).name for one in result.objects],
        "environments": [Path(one).name for one in result.environment.split(",")],
        "models": [Path(one).name for one in result.model.split(",")],
        "renders": sum(one.renders for one in result.parts),
        "seconds": round(result.seconds["total"]),
        "figures": figures,
    }


if __name__ == "__main__":
    sys.exit(main())
