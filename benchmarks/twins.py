"""Measure how far verdicts on renders hold for photographs, on data that you have.

    python benchmarks/twins.py DATA --model MODEL --labels LABELS --out FOLDER
    python benchmarks/twins.py DATA --train BACKBONE.pt2 --folds 5 --out FOLDER

DATA is a folder in BOP's form, or a list. With --train a linear layer is fitted on what
a backbone (an exported program: images in, numbers out) says of the crops of other
frames. Frames are cut into blocks of neighbours, and each block is judged by a
classifier that was fitted on the others. No data is in this repository.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

import advsearch
from advsearch.questions.twins import rendering, twins
from advsearch.questions.twins.listing import PhotographedObject, read_photographs
from advsearch.questions.twins.result import (
    CLASSIFIER_MARGIN,
    make_agreement_part,
)

SIZE = (224, 224)
N_COPIES = 3  # of each crop, shifted, scaled and lit at random
N_CELLS = 3  # along each side of the grid that features are averaged over
RIDGE = 1.0
SHARPNESS = 5.0  # logits of a unit of the fitted targets, which are -1 and 1
MIN_VISIBLE = 0.1


class Features(nn.Module):
    """The last residual sum of an exported network, averaged over a grid of cells."""

    def __init__(self, program: torch.export.ExportedProgram) -> None:
        super().__init__()
        module: Any = program.module()
        sums = [
            node
            for node in module.graph.nodes
            if "add" in node.name and node.meta["val"].ndim == 4
        ]
        graph = torch.fx.Graph()
        copied: dict[torch.fx.Node, torch.fx.Node] = {}
        for node in module.graph.nodes:
            copied[node] = graph.node_copy(node, copied.__getitem__)
            if node is sums[-1]:
                break
        graph.output(copied[sums[-1]])
        self.network = torch.fx.GraphModule(module, graph).requires_grad_(False)

    def forward(self, images: Tensor) -> Tensor:
        return F.adaptive_avg_pool2d(self.network(images), N_CELLS).flatten(1)


class Head(nn.Module):
    """A linear layer on standardised features of a network."""

    def __init__(self, backbone: Features, mean: Tensor, weight: Tensor) -> None:
        super().__init__()
        self.backbone = backbone
        self.mean = nn.Buffer(mean)
        self.weight = nn.Buffer(weight)

    def forward(self, images: Tensor) -> Tensor:
        return self.classify(self.backbone(images))

    def classify(self, features: Tensor) -> Tensor:
        """Return logits (N, classes) of features (N, n)."""
        return SHARPNESS * ((features - self.mean) @ self.weight)


def fit_head(
    backbone: Features, features: Tensor, labels: Tensor, n_classes: int
) -> Head:
    """Fit a linear layer on features (N, n) with labels (N,) by ridge regression."""
    inputs = features.double()
    mean = inputs.mean(dim=0)
    scale = (inputs.std(dim=0) + 1e-3) * math.sqrt(inputs.shape[1])
    scaled = (inputs - mean) / scale
    targets = 2.0 * F.one_hot(labels, n_classes).double() - 1.0
    kernel = scaled @ scaled.T + RIDGE * torch.eye(len(scaled))
    weight = scaled.T @ torch.linalg.solve(kernel, targets) / scale[:, None]
    return Head(backbone, mean.float(), weight.float())


def list_crops(
    objects: Sequence[PhotographedObject], generator: np.random.Generator
) -> Iterator[tuple[PhotographedObject, Tensor]]:
    """Yield each object with its crop and changed copies of it, (N_COPIES, H, W, 3)."""
    for item in objects:
        if item.visible is not None and item.visible < MIN_VISIBLE:
            continue
        photograph = rendering.load_photograph(item.photograph)
        positions = rendering.project_object(
            item, rendering.load_object(item.mesh, item.unit)
        )
        images = []
        for copy in range(N_COPIES):
            margin = CLASSIFIER_MARGIN
            moved = positions
            gain = 1.0
            if copy:
                extent = float(np.ptp(positions, axis=0).max())
                margin = float(generator.uniform(0.1, 0.5))
                moved = positions + 0.08 * extent * generator.standard_normal(2)
                gain = float(generator.uniform(0.6, 1.4))
            window = rendering.choose_window(moved, photograph.full_size, SIZE, margin)
            if window is None:
                break
            crop = rendering.resize(rendering.cut_photograph(photograph, window), SIZE)
            images.append((crop * gain).clamp(0.0, 1.0))
        if images:
            yield item, torch.stack(images)


def cut_frames(objects: Sequence[PhotographedObject], n_folds: int) -> list[list[str]]:
    """Cut frames, in the order of the files, into blocks of neighbours."""
    frames = list(dict.fromkeys(item.frame for item in objects))
    return [list(block) for block in np.array_split(np.array(frames), n_folds)]


def run_folds(options: argparse.Namespace) -> list[str]:
    """Judge each block of frames by a classifier that was fitted on the others."""
    objects = read_photographs(options.data).objects
    names = sorted({item.object for item in objects})
    backbone = Features(torch.export.load(options.train))
    blocks = []
    frames = []
    labels = []
    for item, images in list_crops(objects, np.random.default_rng(0)):
        with torch.no_grad():
            blocks.append(backbone(images.permute(0, 3, 1, 2).contiguous()))
        frames += [item.frame] * len(images)
        labels += [names.index(item.object)] * len(images)
    features = torch.cat(blocks)
    targets = torch.tensor(labels)
    model_of_frame: dict[str, advsearch.Model] = {}
    for number, block in enumerate(cut_frames(objects, options.folds)):
        is_other = torch.tensor([frame not in block for frame in frames])
        head = fit_head(backbone, features[is_other], targets[is_other], len(names))
        accuracy = head.classify(features[~is_other]).argmax(1) == targets[~is_other]
        print(f"fold {number}: right in {float(accuracy.float().mean()):.3f} of crops")
        model = advsearch.load_model(
            head, labels=names, input_size=SIZE, name="fitted on other frames"
        )
        model_of_frame |= dict.fromkeys(block, model)
    return run_twins(options, network=model_of_frame)


def run_twins(options: argparse.Namespace, **model: Any) -> list[str]:
    """Run the command, and return the lines of its table."""
    result = twins(
        options.data,
        **model,
        environment=options.environment,
        spp=options.spp,
        frames=options.frames,
        run=str(options.out),
        overwrite=True,
    )
    part = make_agreement_part(result.table)
    return [" | ".join(row) for row in (part.heads, *part.rows)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--train", type=Path)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--model", default="reference")
    parser.add_argument("--labels")
    parser.add_argument("--environment", default="room")
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--frames", help="of the command, such as 0:600; default: all")
    options = parser.parse_args()
    if options.train:
        lines = run_folds(options)
    else:
        lines = run_twins(options, model=options.model, labels=options.labels)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
