"""A drive past two cars and a person, exported as COCO, read by pycocotools and trained on for one epoch.

    python benchmarks/train_on_export.py [--out FOLDER]

The reader is a torch Dataset on top of pycocotools. Where torchvision is there, `torchvision.datasets.CocoDetection`
reads the same folder too (the pinned torch has none). Exits with 3 where the loss does not fall, a box is not that of
its mask, or a thing is missing.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from pycocotools.coco import COCO  # type: ignore[import-untyped]
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

sys.path.insert(0, str(Path(__file__).parent.parent))

import advsearch
from advsearch.cli.main import main as command

THINGS = "car@-1.5,3.5,heading=170,name=oncoming; person@3,-1.2"
HIGH, WIDE, STRIDE = 96, 128, 8
MODEL = "benchmarks.train_on_export:blank"


class Blank(nn.Module):
    """Finds nothing: the drive is swept for its pictures."""

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return x.new_zeros((len(x), 1, 4)), x.new_zeros((len(x), 1, 2))


def blank() -> advsearch.Model:
    """A detector that knows a person and a car, and finds neither."""
    return advsearch.load_model(Blank(), task="detection", labels=["person", "car"], input_size=(HIGH, WIDE))


class Exported(Dataset[Any]):
    """Pictures (3, H, W) in [0, 1], and a map (1 + classes, H / 8, W / 8): in which places a thing has its middle, by
    class, and at how many pixels something is to be seen."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.coco = folder, COCO(str(folder / "annotations.json"))
        self.images, self.classes = sorted(self.coco.getImgIds()), sorted(self.coco.getCatIds())

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, place: int) -> tuple[Tensor, Tensor]:
        (image,) = self.coco.loadImgs(self.images[place])
        with Image.open(self.folder / "images" / image["file_name"]) as picture:
            pixels = torch.from_numpy(np.array(picture.convert("RGB"))).permute(2, 0, 1) / 255.0
        target = torch.zeros(1 + len(self.classes), HIGH // STRIDE, WIDE // STRIDE)
        for one in self.coco.loadAnns(self.coco.getAnnIds(image["id"])):
            mask = torch.from_numpy(self.coco.annToMask(one)).float()
            target[0] = torch.maximum(target[0], F.avg_pool2d(mask[None], STRIDE)[0])
            x, y, width, height = one["bbox"]
            row, column = int((y + height / 2) // STRIDE), int((x + width / 2) // STRIDE)
            target[1 + self.classes.index(one["category_id"]), row, column] = 1.0
        return pixels, target


def make(out: Path) -> None:
    """Sweep the drive, and export all of it."""
    frames = [(second, 16.0 - second, -5.0 + 0.5 * second, 2.0) for second in range(13)]
    (out / "way.csv").write_text("\n".join(["time,x,y,z", *(",".join(map(str, one)) for one in frames)]))
    advsearch.sweep(
        "car", MODEL, environment="avenue,avenue-wet", things=THINGS, path=str(out / "way.csv"), fps=2, label="car",
        task={"name": "detection", "unit": "fractions"}, spp=8, resolution=(HIGH, WIDE), trials=0, run=out / "drive",
        keep_pictures="none",
    )  # fmt: skip
    words = ["export", str(out / "drive"), "--format", "coco", "--all", "--out", str(out / "coco"), "--code", MODEL]
    if command(words):
        raise SystemExit("the drive was not exported")


def faults_of(coco: COCO) -> list[str]:
    """What is wrong with the annotations: things that never come, and boxes that are not those of their masks."""
    found = []
    anns = coco.loadAnns(coco.getAnnIds())
    if {one["name"] for one in anns} != {"object", "oncoming", "person"}:
        found.append(f"the things are {sorted({one['name'] for one in anns})}")
    for one in anns:
        rows, columns = np.nonzero(coco.annToMask(one))
        box = [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]
        if box != one["bbox"] or len(rows) != one["area"]:
            found.append(f"annotation {one['id']} has the box {one['bbox']}, its mask {box}")
    return found


def loss_of(network: nn.Module, pixels: Tensor, target: Tensor) -> Tensor:
    """The cross-entropy of both maps; places with a thing weigh more, as they are few."""
    weight = 1.0 + 20.0 * (target > 0.0).float()
    return F.binary_cross_entropy_with_logits(network(pixels), target, weight)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="where drive and pictures are kept (default: nowhere)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = args.out or Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        if not (out / "coco").is_dir():
            make(out)
        data = Exported(out / "coco")
        faults = faults_of(data.coco)
        torch.manual_seed(0)
        channels = [3, 16, 32, 48]
        blocks = [nn.Sequential(nn.Conv2d(a, b, 3, stride=2, padding=1), nn.GroupNorm(4, b), nn.SiLU())
                  for a, b in itertools.pairwise(channels)]  # fmt: skip
        network = nn.Sequential(*blocks, nn.Conv2d(channels[-1], 1 + len(data.classes), 3, padding=1))
        whole = [torch.stack(one) for one in zip(*(data[k] for k in range(len(data))), strict=True)]

        def overall() -> float:
            with torch.no_grad():
                return float(loss_of(network, whole[0], whole[1]))

        before, steps = overall(), torch.optim.Adam(network.parameters(), 3e-3)
        for pixels, target in DataLoader(data, batch_size=4, shuffle=True):
            steps.zero_grad()
            loss_of(network, pixels, target).backward()
            steps.step()
        after = overall()
    print(
        f"{len(data)} pictures, {len(data.coco.anns)} things; loss {before:.3f} before the epoch, {after:.3f} after it"
    )
    print("\n".join(faults) or "every box is that of its mask; two cars and a person are there")
    sys.exit(3 if faults or after >= before else 0)


if __name__ == "__main__":
    main()
