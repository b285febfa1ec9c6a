"""Losses of one's own: what one that sees the texture costs, a paper's beside `printable`, and gradients of a pose.

    python benchmarks/own_loss.py [time] [paper] [gradients] [--seeds 10] [--turns 7]

- `time`: a whole attack on the bundled mug's texture with an objective that asks for the texture (margin loss less
  total variation) over one with the margin loss alone, as CPU time, in turns in one process; median ratio (asked for:
  1.05);
- `paper`: the loss of Sharif et al. 2016 as docs/own-loss.md has it, the terms of `printable` from `advsearch.losses`,
  `printable` itself, and the margin loss alone: verified margin, and how rough and how far from ink each texture is;
- `gradients`: a search over poses along gradients with secants of the loss, with those over a pixel alone, and with
  differences of the picture, at equal renders: verified margins over ten seeds, 64 x 64 pixels.
"""

from __future__ import annotations

import argparse
import re
import statistics
import time
from pathlib import Path
from typing import Any
from unittest import mock

from advsearch import threads

threads.configure()

import torch  # noqa: E402
from torch import Tensor  # noqa: E402

import advsearch  # noqa: E402
from advsearch import losses  # noqa: E402
from advsearch.engine.judging import off_print, variation  # noqa: E402
from advsearch.scene import gradients as plan  # noqa: E402

ASKED = 1.05
PAGE = Path(__file__).resolve().parents[1] / "docs" / "own-loss.md"
WEIGHT = 10.0


def alone(logits: Tensor, images: Tensor, labels: Tensor) -> Tensor:
    """The margin loss."""
    return losses.margin(logits, labels)


def smooth(logits: Tensor, images: Tensor, labels: Tensor, texture: Tensor) -> Tensor:
    """The margin loss less total variation."""
    return losses.margin(logits, labels) - WEIGHT * losses.total_variation(texture)


def ours(logits: Tensor, images: Tensor, labels: Tensor, texture: Tensor) -> Tensor:
    """What `printable` maximises."""
    return smooth(logits, images, labels, texture) - WEIGHT * losses.non_printability(texture)


def times(scene: advsearch.Scene, model: advsearch.Model, turns: int) -> None:
    """Print the ratio of whole attacks."""
    spent: dict[Any, list[float]] = {alone: [], smooth: []}
    for turn in range(turns + 1):
        for objective in list(spent)[:: 1 if turn % 2 else -1]:
            begun = time.process_time()
            advsearch.attack(scene, model, controls="texture", objective=objective, baseline=False, seed=turn)
            spent[objective].append(time.process_time() - begun)
    ratios = [more / less for more, less in zip(spent[smooth][1:], spent[alone][1:], strict=True)]
    low, middle, high = statistics.quantiles(ratios, n=4)
    print(f"an attack that sees the texture over one without: {middle:.3f} ({low:.3f}-{high:.3f}), asked for {ASKED}")


def of_the_page() -> dict[str, Any]:
    """What the block of the page with the paper's loss defines."""
    names: dict[str, Any] = {"torch": torch, "losses": losses}
    (block,) = re.findall(r"^```python\n((?:(?!```).)*?def sharif.*?)^```$", PAGE.read_text("utf-8"), re.M | re.S)
    exec(compile(block.partition("\n\nresult = ")[0], str(PAGE), "exec"), names)
    return names


def paper(scene: advsearch.Scene, model: advsearch.Model) -> None:
    """Print what each loss finds."""
    page = of_the_page()
    wanted: dict[str, dict[str, Any]] = {
        "the margin loss alone": {"objective": "margin"},
        "printable": {"printable": True},
        "the same terms of one's own": {"objective": ours},
        "Sharif et al. 2016": {"objective": page["sharif"]},
    }
    print(f"{'':28s} margin  successes  variation  off the 125  off its ink  product of distances")
    for name, settings in wanted.items():
        found = advsearch.attack(scene, model, controls="texture", baseline=False, **settings)
        verified, texture = found.summary.verified, found.artifacts["texture"]
        assert verified is not None
        product = float(page["off_ink"](texture[None]))
        print(
            f"{name:28s} {verified.margin:6.2f}  {verified.successes:4d} of {verified.trials}  "
            f"{float(variation(texture)):9.4f}  {float(off_print(texture)):11.4f}  "
            f"{float(off_print(texture, page['ink'])):11.4f}  {product:.2e}"
        )


def gradients(scene: advsearch.Scene, model: advsearch.Model, seeds: int) -> None:
    """Print what each estimator finds."""
    settings: dict[str, Any] = {
        "controls": "pose", "policy": "adam", "steps": 104, "resolution": 64, "trials": 6, "verify_spp": 16,
        "measure": "no", "baseline": False,
    }  # fmt: skip
    ways = {
        "secants of the loss": ("secant", plan.SEARCH_STEP),
        "over a pixel": ("secant", 0.0),
        "differences of the picture": ("differences", plan.SEARCH_STEP),
    }
    margins: dict[str, list[float]] = {name: [] for name in ways}
    for seed in range(seeds):
        for name, (estimator, step) in ways.items():
            with mock.patch.object(plan, "SEARCH_STEP", step):
                verified = advsearch.attack(scene, model, estimators=estimator, seed=seed, **settings).summary.verified
            margins[name].append(verified.margin if verified is not None else float("nan"))
        print(f"seed {seed}:", *(f"{one[-1]:7.2f}" for one in margins.values()), flush=True)
    first = next(iter(margins.values()))
    for name, found in margins.items():
        wins = sum(one > mine for one, mine in zip(found, first, strict=True))
        below = sum(one < 0.0 for one in found)
        print(
            f"{name:28s} median margin {statistics.median(found):6.2f}, below 0 with {below} of {seeds} seeds; "
            f"secants find more with {wins}"
        )


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("parts", nargs="*", choices=["time", "paper", "gradients", []])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--turns", type=int, default=7)
    args = parser.parse_args()
    parts = args.parts or ["time", "paper", "gradients"]
    scene, model = advsearch.load_scene("mug"), advsearch.load_model("reference")
    if "time" in parts:
        times(scene, model, args.turns)
    if "paper" in parts:
        paper(scene, model)
    if "gradients" in parts:
        gradients(scene, model, args.seeds)


if __name__ == "__main__":
    main()
