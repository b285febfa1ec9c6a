"""A small detector of the bundled objects, trained here in a minute, and hardened against its own paint.

    python benchmarks/harden_detector.py                 # trains it, hardens it, prints before and after
    python benchmarks/harden_detector.py --run NAME --control texture --epsilon 0.1 --scenes 48 --measured 48

It is trained on pictures of four objects from all sides in the training's rooms, and measured on other instances of
these in rooms that no training saw. The network is made by ``benchmarks.harden_detector:make``.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).parent.parent))

import advsearch
from advsearch import seeds
from advsearch.models.reference import trainable
from advsearch.questions.harden.detectors import DetectorCourse, Example
from advsearch.questions.harden.result import HardenConfig
from advsearch.questions.harden.scenes import TRAINING, SceneWork, splits_of
from advsearch.tasks import make_task

SIDE, STRIDE = 64, 8
LABELS = ("mug", "bottle", "book", "teapot")
TASK = {"name": "detection", "unit": "pixels", "boxes": "xyxy"}


class Tiny(nn.Module):
    """One box and a score of each class for each of 8 x 8 places (as in FCOS, Tian et al. 2019, without its pyramid);
    in training the focal loss of scores and the L1 loss of boxes, of the places in the middle of each true box."""

    def __init__(self) -> None:
        super().__init__()
        self.args = {"imgsz": SIDE}  # read as the size of its input
        widths = (3, 24, 48, 64)
        layers: list[nn.Module] = []
        for inputs, outputs in itertools.pairwise(widths):
            layers += [nn.Conv2d(inputs, outputs, 3, stride=2, padding=1), nn.GroupNorm(4, outputs), nn.SiLU()]
        layers += [nn.Conv2d(widths[-1], 64, 3, padding=1), nn.GroupNorm(4, 64), nn.SiLU()]
        layers += [nn.Conv2d(64, 64, 3, padding=2, dilation=2), nn.GroupNorm(4, 64), nn.SiLU()]
        self.features, self.head = nn.Sequential(*layers), nn.Conv2d(64, len(LABELS) + 4, 1)
        assert self.head.bias is not None
        nn.init.constant_(self.head.bias[: len(LABELS)], -3.0)

    def forward(self, x: Tensor, targets: Sequence[Mapping[str, Tensor]] | None = None) -> Any:
        """Return boxes (N, 64, 4) in pixels and scores (N, 64, 4), or losses where there are targets."""
        found = self.head(self.features((x - 0.45) / 0.25)).flatten(2).transpose(1, 2)
        scores, sides = found[..., : len(LABELS)], F.softplus(found[..., len(LABELS) :]) * STRIDE
        across = (torch.arange(x.shape[3] // STRIDE, dtype=x.dtype) + 0.5) * STRIDE
        down = (torch.arange(x.shape[2] // STRIDE, dtype=x.dtype) + 0.5) * STRIDE
        places = torch.cartesian_prod(down, across).flip(1)
        boxes = torch.cat([places - sides[..., :2], places + sides[..., 2:]], dim=-1)
        if targets is None:
            return boxes, scores.sigmoid()
        wanted, losses = torch.zeros_like(scores), list[Tensor]()
        for number, one in enumerate(targets):
            for box, label in zip(one["boxes"], one["labels"], strict=True):
                middle, half = (box[:2] + box[2:]) / 2, ((box[2:] - box[:2]) / 4).clamp_min(STRIDE / 2)
                inside = ((places - middle).abs() <= half).all(dim=1)
                wanted[number, inside, label] = 1.0
                losses.append(F.l1_loss(boxes[number, inside], box.expand(int(inside.sum()), 4)) / STRIDE)
        surprise = F.binary_cross_entropy_with_logits(scores, wanted, reduction="none")
        focal = surprise * (wanted - scores.sigmoid()).square()
        return {
            "scores": focal.sum() / wanted.sum().clamp_min(1.0),
            "boxes": torch.stack([*losses, x.sum() * 0]).mean(),
        }


def make() -> advsearch.Model:
    """The detector without its training; `@weights.safetensors` behind the name brings that."""
    return advsearch.load_model(Tiny(), task=TASK, labels=LABELS, input_size=SIDE, name="tiny detector")


def trained(folder: Path, scenes: int, views: int, epochs: int) -> str:
    """Train it on plain pictures, and return what `--model` takes."""
    torch.manual_seed(0)
    config = HardenConfig(
        object=",".join(LABELS), model="benchmarks.harden_detector:Tiny", task=TASK, labels=",".join(LABELS), seed=100,
        controls={"texture": {}}, resolution=SIDE, measured=1, threads=1, epochs=epochs, rate=3e-3,
    )  # fmt: skip
    model = advsearch.load_model(Tiny(), task=make_task(TASK), labels=LABELS, input_size=SIDE, name="tiny")
    work = SceneWork(config, model, splits_of(config, model))
    pictures: list[Example] = []
    for number in range(scenes):
        problem, seed = work.problem(work.splits[TRAINING], number, ("texture",))
        pictures += [Example.of(problem, seeds.stream(seed, "plain", view)) for view in range(views)]
    student = trainable(model, logits=False)
    DetectorCourse(work, student).round(0, pictures)
    right = sum(one.right(student.model) for one in pictures)
    print(f"trained on {len(pictures)} pictures, right in {right} of them", flush=True)
    folder.mkdir(parents=True, exist_ok=True)
    save_file({name: one.contiguous() for name, one in student.net.state_dict().items()}, folder / "tiny.safetensors")
    name = f"benchmarks.harden_detector:Tiny@{folder / 'tiny.safetensors'}"
    print(f"--model {name}", flush=True)
    return name


def main() -> None:
    """Train it, harden it, print what came out."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--run", default="harden-detector")
    parser.add_argument("--control", default="texture")
    parser.add_argument("--model", help="as it was printed by a run before, which is not trained again then")
    parser.add_argument("--epsilon", type=float, default=0.05)
    numbers = {"plain": 60, "views": 8, "epochs": 40, "rounds": 3, "scenes": 24, "measured": 16, "steps": 12}
    for name, value in numbers.items():
        parser.add_argument(f"--{name}", type=int, default=value)
    args = parser.parse_args()
    folder = Path("build") / "tiny-detector"
    model = args.model or trained(folder, args.plain, args.views, args.epochs)
    advsearch.allow_code(model.partition("@")[0])
    result = advsearch.harden(
        model, task=TASK, labels=",".join(LABELS), object=",".join(LABELS), controls={args.control: {}},
        epsilon=args.epsilon, resolution=SIDE, rounds=args.rounds, scenes=args.scenes, epochs=20, rate=1e-3,
        steps=args.steps, measured=args.measured, verify_spp=8, spp=4, run=args.run, overwrite=True, clean_loss=0.05,
        threads=1,
    )  # fmt: skip
    for number, one in enumerate(result.rounds):
        kept = ", kept" if one.kept else ""
        print(f"round {number}: {one.lessons} pictures, plain {one.clean:.2f}, worst {one.robust:.2f}{kept}")
    stronger = result.table[0]
    for what, share in (
        ("robust before", result.before), ("robust after", result.after),
        ("against a stronger search before", stronger.stronger_before), ("and after", stronger.stronger),
        ("plain right before", result.clean_before), ("plain right after", result.clean_after),
    ):  # fmt: skip
        assert share is not None
        print(
            f"{what}: {share.right} of {share.count}, 95 % interval {share.interval[0]:.2f} to {share.interval[1]:.2f}"
        )
    print(
        f"{result.gained} scenes got better, {result.lost} worse, p = {result.p:.3g}; {result.seconds['total']:.0f} s"
    )


if __name__ == "__main__":
    main()
