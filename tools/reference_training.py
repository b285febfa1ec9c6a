"""Training of the reference network, and its files: AdamW, cosine schedule, moving
average of the weights. Seeded.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from reference_calibration import Images, as_floats
from safetensors import torch as safetensors
from torch import Tensor, nn

from advsearch.errors import InputError, ModelError
from advsearch.files import JsonValue
from advsearch.models.reference import (
    INPUT_SIZE,
    METADATA,
    WEIGHTS,
    ReferenceNet,
    build,
)
from advsearch.questions.harden.networks import Augmentation

WARM_UP = 0.05
WEIGHT_DECAY = 0.05
LARGEST_GRADIENT_NORM = 2.0
LABEL_SMOOTHING = 0.02
"""Part of the target that is spread over all classes; more would cap the confidence."""


@dataclass(frozen=True)
class TrainingState:
    """Where a training is: told to the callback after every step."""

    step: int
    steps: int
    loss: float
    seconds_left: float


def train(
    images: Images,
    labels: Sequence[int] | Tensor,
    *,
    classes: int,
    epochs: int,
    batch_size: int = 64,
    lr: float = 1e-3,
    seed: int = 0,
    augmentation: Augmentation | None = None,
    average_decay: float = 0.998,
    bfloat16: bool = True,
    progress: Callable[[TrainingState], None] | None = None,
) -> dict[str, Tensor]:
    """Train a reference network from nothing and return its weights, a state dict of
    `ReferenceNet`.

    The learning rate rises linearly over the first 5 % of the steps and falls to 0
    along a cosine. The returned weights are an exponential moving average. All
    randomness (first weights, order, augmentation, dropout) comes from `seed`; torch's
    global random state is as before afterwards. The same call on the same machine, with
    the same torch and number of threads, gives the same weights bit for bit; elsewhere,
    weights of the same quality.

    Args:
        images: (N, H, W, 3), uint8, display-referred; a tensor, an array or a memory
            map.
        labels: N class indices.
        classes: number of classes.
        epochs: passes over the images.
        batch_size: images a step; a remainder smaller than that is left out of its
            epoch.
        lr: the highest learning rate.
        seed: at least 0.
        augmentation: default `Augmentation()`.
        average_decay: weight of the past in the moving average, per step; less in the
            first steps.
        bfloat16: run convolutions in bfloat16, weights stay in float32. About 1.5 times
            faster on processors with it.
        progress: called after every step.

    Raises:
        InputError: arguments that do not fit each other or are out of range.
    """
    truth = torch.as_tensor(labels).long()
    _check(images, truth, classes, epochs, batch_size, lr)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = build(classes)
        average = _Average(net, average_decay)
        generator = torch.Generator().manual_seed(seed + 1)
        loop = _Loop(
            net,
            average,
            images,
            truth,
            generator,
            augmentation or Augmentation(),
            lr,
            bfloat16,
        )
        for _ in range(epochs):
            loop.epoch(epochs, batch_size, progress or (lambda _: None))
    return {
        key: value.detach().clone() for key, value in average.net.state_dict().items()
    }


class _Average:
    """An exponential moving average of weights and statistics."""

    def __init__(self, net: ReferenceNet, decay: float) -> None:
        self.net = build(net.head.out_features)
        self.net.load_state_dict(net.state_dict())
        self.net.eval().requires_grad_(False)
        self._decay = decay
        self._updates = 0

    def update(self, net: ReferenceNet) -> None:
        self._updates += 1
        decay = min(self._decay, (1 + self._updates) / (10 + self._updates))
        new = net.state_dict()
        for key, old in self.net.state_dict().items():
            if old.is_floating_point():
                old.lerp_(new[key].detach(), 1.0 - decay)
            else:
                old.copy_(new[key])


@dataclass
class _Loop:
    """The state of one training."""

    net: ReferenceNet
    average: _Average
    images: Images
    labels: Tensor
    generator: torch.Generator
    augmentation: Augmentation
    lr: float
    bfloat16: bool
    started: float = field(default_factory=time.perf_counter)
    step: int = 0

    def __post_init__(self) -> None:
        # Normalisation and biases are not decayed.
        decayed = [p for p in self.net.parameters() if p.dim() > 1]
        others = [p for p in self.net.parameters() if p.dim() <= 1]
        groups = [
            {"params": decayed, "weight_decay": WEIGHT_DECAY},
            {"params": others, "weight_decay": 0.0},
        ]
        self.optimiser = torch.optim.AdamW(groups, lr=self.lr)

    def epoch(
        self, epochs: int, batch_size: int, progress: Callable[[TrainingState], None]
    ) -> None:
        """Run one epoch of so many."""
        per_epoch = len(self.labels) // batch_size
        steps = per_epoch * epochs
        order = torch.randperm(len(self.labels), generator=self.generator).numpy()
        for batch in range(per_epoch):
            # Ascending indices: a memory map is then read forwards.
            chosen = np.sort(order[batch * batch_size : (batch + 1) * batch_size])
            self._set_rate(schedule(self.step, steps))
            loss = self._train_on(chosen)
            self.step += 1
            elapsed = time.perf_counter() - self.started
            left = elapsed / self.step * (steps - self.step)
            progress(TrainingState(self.step, steps, loss, left))

    def _set_rate(self, factor: float) -> None:
        for group in self.optimiser.param_groups:
            group["lr"] = self.lr * factor

    def _train_on(self, indices: np.ndarray[tuple[int], np.dtype[np.int64]]) -> float:
        """Take one step; return the loss."""
        self.net.train()
        x = self.augmentation(
            as_floats(self.images, indices).permute(0, 3, 1, 2), self.generator
        )
        labels = self.labels[torch.from_numpy(indices)]
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.bfloat16):
            logits = self.net(x).float()
        loss = F.cross_entropy(logits, labels, label_smoothing=LABEL_SMOOTHING)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.net.parameters(), LARGEST_GRADIENT_NORM)
        self.optimiser.step()
        self.average.update(self.net)
        return float(loss.detach())


def schedule(step: int, steps: int) -> float:
    """Return the learning rate's factor at a step from 0 to steps - 1: linear warm-up,
    then half a cosine down to 0.
    """
    warm = max(1, round(WARM_UP * steps))
    if step < warm:
        return (step + 1) / warm
    return 0.5 * (1.0 + math.cos(math.pi * (step - warm + 1) / max(1, steps - warm)))


def _check(
    images: Images,
    labels: Tensor,
    classes: int,
    epochs: int,
    batch_size: int,
    lr: float,
) -> None:
    if (
        str(images.dtype).removeprefix("torch.") != "uint8"
        or len(images.shape) != 4
        or images.shape[3] != 3
    ):
        raise InputError(
            "images: expected 8-bit images (N, H, W, 3), got "
            f"{images.dtype} {tuple(images.shape)}"
        )
    if labels.shape != (len(images),):
        raise InputError(
            f"labels: expected one for each of {len(images)} images, got "
            f"{tuple(labels.shape)}"
        )
    if not 2 <= batch_size <= len(images):
        raise InputError(
            f"batch_size: expected 2 to {len(images)} (the number of "
            f"images), got {batch_size}"
        )
    if int(labels.min()) < 0 or int(labels.max()) >= classes:
        raise InputError(
            f"labels: expected class indices from 0 to {classes - 1}, got "
            f"up to {int(labels.max())}"
        )
    if epochs < 1:
        raise InputError(f"epochs: expected at least 1, got {epochs}")
    if not (math.isfinite(lr) and lr > 0):
        raise InputError(f"lr: expected a finite number greater than 0, got {lr}")


# ---- what is stored
# ---------------------------------------------------------------------------


def with_temperature(
    state: Mapping[str, Tensor], temperature: float
) -> dict[str, Tensor]:
    """Return the state dict whose logits are those of `state` divided by the
    temperature (greater than 0).
    """
    if not (math.isfinite(temperature) and temperature > 0):
        raise ModelError(
            f"temperature: expected a finite number greater than 0, got {temperature}"
        )
    scaled = ("head.weight", "head.bias")
    return {
        key: value / temperature if key in scaled else value
        for key, value in state.items()
    }


def save(
    folder: Path,
    state: Mapping[str, Tensor],
    labels: Sequence[str],
    figures: Mapping[str, JsonValue] | None = None,
) -> tuple[Path, Path]:
    """Write ``reference.safetensors`` and ``reference.json`` to a folder and return the
    two paths.

    Args:
        folder: made if it is not there; that of the package is
            `reference.data_folder()`.
        state: the state dict of a `ReferenceNet` for ``len(labels)`` classes.
        labels: the label names in index order.
        figures: what is known of it (accuracy, calibration, seed, ...), kept in the
            record as it is.
    """
    net = build(len(labels))
    net.load_state_dict(dict(state))
    folder.mkdir(parents=True, exist_ok=True)
    weights = folder / WEIGHTS
    record = folder / METADATA
    tensors = {key: value.contiguous() for key, value in net.state_dict().items()}
    weights.write_bytes(safetensors.save(tensors))
    content = {
        "schema": 1,
        "labels": list(labels),
        "input_size": list(INPUT_SIZE),
        "figures": dict(figures or {}),
    }
    record.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return weights, record
