"""Measure how far verdicts on renders hold for photographs, on data that you have.

    python benchmarks/twins.py DATA --model MODEL --labels LABELS --out FOLDER
    python benchmarks/twins.py DATA --train BACKBONE.pt2 --folds 5 --out FOLDER
    python benchmarks/twins.py DATA --train BACKBONE.pt2 --transfer obj_000005 --out FOLDER

DATA is a folder in BOP's form, or a list. With --train a linear layer is fitted on what
a backbone (an exported program: images in, numbers out) says of the crops of other
frames. Frames are cut into blocks of neighbours, and each block is judged by a
classifier that was fitted on the others. No data is in this repository.

With --transfer, a classifier is fitted on the first third of the frames. The texture of
an object is attacked in the first of the other photographs, in a bundled room, and over
all photographs of the first third at once. Each result is then tried in all the others.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
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
EPSILON = 0.3  # of a texture, sRGB
STEPS = 20
RESOLUTION = 128  # of renders, which are enlarged to `SIZE`


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


# ---- transfer


def run_transfer(options: argparse.Namespace) -> list[str]:
    """Attack a texture in a photograph, a room and many photographs; try it in others.

    Returns:
        The lines of a table: in how many of the other photographs each attack holds.
    """
    objects = read_photographs(options.data).objects
    training_frames = cut_frames(objects, 3)[0]
    head = fit_on_frames(options.train, objects, training_frames)
    names = sorted({item.object for item in objects})
    model = advsearch.load_model(head, labels=names, input_size=SIZE, name="fitted")
    folders = write_folders(objects, options.transfer, training_frames, options.out)
    mesh = next(item.mesh for item in objects if item.object == options.transfer)
    first = min(folders["others"].glob("*.png"))
    searches: dict[str, dict[str, Any]] = {
        f"photograph {first.stem}": {"backdrop": first},
        options.environment: {"environment": options.environment},
        "photographs of the first third": {
            "backdrop": folders["searched"],
            "over": "backdrop",
        },
    }
    lines = ["searched in | ends with | clean right | holds in | interval"]
    for number, (name, where) in enumerate(searches.items()):
        attack = advsearch.attack(
            str(mesh),
            model,
            controls={"texture": {"epsilon": EPSILON}},
            label=options.transfer,
            unit="mm",
            steps=STEPS,
            resolution=RESOLUTION,
            spp=options.spp,
            verify_spp=options.spp,
            baseline=False,
            measure="no",
            run=str(options.out / f"attack-{number}"),
            overwrite=True,
            **where,
        )
        cells = [name, attack.summary.ending]
        if attack.found:
            cells += try_in_others(attack, folders["others"])
        lines.append(" | ".join(cells))
        print(lines[-1], flush=True)
    return lines


def fit_on_frames(
    backbone_file: Path, objects: Sequence[PhotographedObject], frames: Sequence[str]
) -> Head:
    """Fit a linear layer on the crops of all objects in some frames."""
    names = sorted({item.object for item in objects})
    backbone = Features(torch.export.load(backbone_file))
    features = []
    labels = []
    chosen = [item for item in objects if item.frame in frames]
    for item, images in list_crops(chosen, np.random.default_rng(0)):
        with torch.no_grad():
            features.append(backbone(images.permute(0, 3, 1, 2).contiguous()))
        labels += [names.index(item.object)] * len(images)
    return fit_head(backbone, torch.cat(features), torch.tensor(labels), len(names))


def try_in_others(attack: Any, folder: Path) -> list[str]:
    """Return the cells of a table about the photographs that an attack did not use."""
    replayed = advsearch.replay(
        attack, backdrop=folder, trials=6, run=f"{attack.run}-replay", overwrite=True
    )
    transfer = replayed.transfer
    if transfer is None:
        return []
    cells = [f"{transfer.clean_right} of {transfer.photographs}"]
    if transfer.rate is not None and transfer.rate.interval is not None:
        low, high = transfer.rate.interval
        cells.append(f"{transfer.holding} of {transfer.clean_right}")
        cells.append(f"{low:.2f} to {high:.2f}")
    return cells


def write_folders(
    objects: Sequence[PhotographedObject],
    name: str,
    training_frames: Sequence[str],
    out: Path,
) -> dict[str, Path]:
    """Write the photographs of an object as folders, each with its camera file.

    Args:
        objects: in photographs.
        name: of the object.
        training_frames: whose photographs go to the folder "searched"; the rest to
            "others".
        out: where the folders are written.
    """
    folders = {key: out / key for key in ("searched", "others")}
    for folder in folders.values():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    for item in objects:
        is_hidden = item.visible is not None and item.visible < MIN_VISIBLE
        if item.object != name or is_hidden:
            continue
        photograph = rendering.load_photograph(item.photograph)
        height, width = photograph.full_size
        positions = rendering.project_object(
            item, rendering.load_object(item.mesh, item.unit)
        )
        window = rendering.choose_window(
            positions, (height, width), SIZE, CLASSIFIER_MARGIN
        )
        if window is None:
            continue
        key = "searched" if item.frame in training_frames else "others"
        camera = item.camera
        file = folders[key] / item.photograph.name
        shutil.copyfile(item.photograph, file)
        # pixel centers are whole numbers in OpenCV's form
        matrix = [
            [camera.fx, 0.0, camera.cx - 0.5],
            [0.0, camera.fy, camera.cy - 0.5],
            [0.0, 0.0, 1.0],
        ]
        entries = {
            "image_width": width,
            "image_height": height,
            "camera_matrix": matrix,
            "object_to_camera": item.pose.tolist(),
            "part": list(window),
            # its shadow is in the photograph, which shows the object itself
            "set": {"ground.size": 0.0},
        }
        file.with_suffix(".json").write_text(json.dumps(entries), "utf-8")
    return folders


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
    return [" | ".join(row) for row in (part.column_heads, *part.rows)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--train", type=Path)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--transfer", metavar="OBJECT")
    parser.add_argument("--model", default="reference")
    parser.add_argument("--labels")
    parser.add_argument("--environment", default="room")
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--frames", help="of the command, such as 0:600; default: all")
    options = parser.parse_args()
    if options.transfer:
        lines = run_transfer(options)
    elif options.train:
        lines = run_folds(options)
    else:
        lines = run_twins(options, model=options.model, labels=options.labels)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
