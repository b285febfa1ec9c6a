"""Small networks that see the bundled mug by its colours, for tests of tasks and of several models."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

import advsearch
from advsearch import Model

if TYPE_CHECKING:
    import pytest

SIDE = 32

SMALL_ATTACK: dict[str, Any] = {
    "controls": {"light": {}}, "steps": 2, "trials": 6, "spp": 2, "verify_spp": 2, "resolution": 16, "denoise": "none",
}  # fmt: skip
"""Settings of an attack of two evaluations, for a network that is there to be asked."""
MUG, CORNER = [0.12, 0.12, 0.86, 0.86], [0.02, 0.02, 0.2, 0.2]


class Finder(nn.Module):
    """Two boxes, of which the first is about where the mug is: it has a blue band. A cup that lacks it is a bowl."""

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        blue = (x[:, 2] - x[:, 0])[:, 15:21, 8:22].mean(dim=(1, 2))
        light = x[:, :, :6, :6].mean(dim=(1, 2, 3))
        cup, dog = 30.0 * (blue - 0.1), 30.0 * (light - 0.6)
        none = torch.full_like(cup, -4.0)
        rows = torch.stack([torch.stack([cup, -cup, none], dim=1), torch.stack([none, none, dog], dim=1)], dim=1)
        return x.new_tensor([[MUG, CORNER]]).expand(x.shape[0], -1, -1), rows.sigmoid()


class Slider(nn.Module):
    """One cup, which is seen where the mug is while its band is blue, and further to the left the less it is."""

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        blue = (x[:, 2] - x[:, 0])[:, 15:21, 8:22].mean(dim=(1, 2))
        away = (0.2 - blue).clamp(0.0, 0.5)
        still = torch.zeros_like(away)
        boxes = x.new_tensor(MUG) - 4.0 * torch.stack([away, still, away, still], dim=1)
        scores = x.new_tensor([[0.9, 0.05]]).expand(x.shape[0], -1)
        return boxes[:, None], scores[:, None]


class Painter(nn.Module):
    """Logits of each pixel: a mug is bright or blue, all else is background; nothing is a dog."""

    def forward(self, x: Tensor) -> Tensor:
        bright, blue = x.mean(dim=1) - 0.5, x[:, 2] - x[:, 0] - 0.02
        mug = 20.0 * torch.maximum(bright, blue)
        return torch.stack([torch.zeros_like(mug), mug, mug - 5.0], dim=1)


class Ranger(nn.Module):
    """Disparity of each pixel, up to a scale and a shift: the ground's by its row, as a plane has it, and the mug's for
    whatever is bright or blue."""

    def forward(self, x: Tensor) -> Tensor:
        row = torch.arange(x.shape[2], dtype=x.dtype, device=x.device)[None, :, None] * (SIDE / x.shape[2])
        ground = torch.where(row < 13.0, 0.0, 0.107 + 0.0133 * row)
        bright, blue = x.mean(dim=1) - 0.5, x[:, 2] - x[:, 0] - 0.02
        lead = nn.functional.avg_pool2d(torch.maximum(bright, blue)[:, None], 3, 1, 1, count_include_pad=False)[:, 0]
        near = torch.sigmoid(40.0 * lead)
        return 40.0 * (ground + near * (0.52 - ground)) - 3.0


class Brightness(nn.Module):
    """The second class where a picture is brighter than a threshold, else the first: a victim with a known weakness.

    Args:
        threshold: mean of the pixels at which it changes its mind.
        border: pixels around the middle that it does not look at.
        slope: of the logits, for each unit of brightness.
    """

    def __init__(self, threshold: float, border: int = 0, slope: float = 40.0) -> None:
        super().__init__()
        self.threshold = nn.Parameter(torch.tensor(threshold))
        self.border, self.slope = border, slope

    def forward(self, images: Tensor) -> Tensor:
        height, width = images.shape[2:]
        middle = images[:, :, self.border : height - self.border, self.border : width - self.border]
        score = self.slope * (middle.mean(dim=(1, 2, 3)) - self.threshold)
        return torch.stack([-score, score], dim=1)


class Blue(nn.Module):
    """A mug where the band in the middle is bluer than a threshold, else a vase.

    Args:
        threshold: how much more blue than red there has to be.
        last: whether the mug is the last of three classes, or the first of two.
    """

    def __init__(self, threshold: float, last: bool = False) -> None:
        super().__init__()
        self.threshold, self.last = threshold, last

    def forward(self, x: Tensor) -> Tensor:
        side = x.shape[2]
        band = (x[:, 2] - x[:, 0])[:, 15 * side // 32 : 21 * side // 32, side // 4 : 22 * side // 32]
        mug = 40.0 * (band.mean(dim=(1, 2)) - self.threshold)
        return torch.stack([-mug - 9.0, -mug, mug] if self.last else [mug, -mug], dim=1)


def loud(network: Any) -> Any:
    """The network with random weights that are large enough for answers that differ, always the same."""
    generator = torch.Generator().manual_seed(0)
    for name, parameter in network.named_parameters():
        if parameter.dim() > 1 or "embedding" in name:
            parameter.data = torch.randn(parameter.shape, generator=generator) * 0.3
    return network


def levels(one: Tensor, other: Tensor) -> float:
    """Root mean square difference of two pictures in levels of 255."""
    return 255.0 * float(((one - other) ** 2).mean().sqrt())


def assert_slope(value: Callable[[Tensor], Tensor], at: Tensor, way: Tensor, step: float, rel: float) -> float:
    """Compare a scalar's derivative along a direction, relative, with its central difference, which is returned."""
    at = at.detach().requires_grad_()
    (slope,) = torch.autograd.grad(value(at), at)
    with torch.no_grad():
        seen = float(value(at + step * way) - value(at - step * way)) / (2.0 * step)
    found = float((slope * way).sum())
    assert abs(found - seen) <= rel * abs(seen), (found, seen)
    return seen


def save_exported(network: nn.Module, path: Path | str) -> None:
    """Write a network of pictures of `SIDE` as an exported program that takes any batch up to 64."""
    batch = {0: torch.export.Dim("batch", min=1, max=64)}
    program = torch.export.export(network.eval(), (torch.zeros(2, 3, SIDE, SIDE),), dynamic_shapes=(batch,))
    torch.export.save(program, path)


def answer(capsys: pytest.CaptureFixture[str], *command: str) -> dict[str, Any]:
    """Type a command, and return what it prints, as JSON."""
    from advsearch.cli.main import main  # late: networks are loaded without the command line

    assert main(list(command)) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def easy() -> Model:
    """A classifier that is misled by little."""
    return advsearch.load_model(Blue(0.11), labels=["mug", "vase"], input_size=SIDE, name="easy")


def finder() -> Model:
    """A detector of the mug by its blue band."""
    labels = ["mug", "bowl", "dog"]
    return advsearch.load_model(Finder(), task="detection", labels=labels, input_size=SIDE, name="finder")


def hard() -> Model:
    """Another one that takes more, with other labels and another input size."""
    return advsearch.load_model(Blue(0.07, True), labels=["dog", "vase", "mug"], input_size=24, name="hard")


class Near(nn.Module):
    """Sees the mug's blue band while it is near, and turned to the camera a little farther."""

    def forward(self, x: Tensor) -> Tensor:
        seen = 2000.0 * ((x[:, 2] - x[:, 0]).clamp_min(0.0).mean(dim=(1, 2)) - 0.004)
        return torch.stack([seen, -seen], dim=1)


def near() -> Model:
    """A classifier that is wrong from afar."""
    return advsearch.load_model(Near(), labels=["mug", "vase"], input_size=16, name="near")


class Same(nn.Module):
    """Says the same to every picture."""

    def forward(self, x: Tensor) -> Tensor:
        return torch.tensor([[2.0, 0.0]]).expand(len(x), 2)


def blind() -> Model:
    """One that does not look."""
    return advsearch.load_model(Same(), labels=["mug", "vase"], input_size=SIDE, name="blind")


def strange() -> Model:
    """One that knows no mug."""
    return advsearch.load_model(Blue(0.1), labels=["cat", "dog"], input_size=SIDE, name="strange")


class Colours(nn.Module):
    """Fourteen classes by what the mean colours of sixteen squares add up to; its weights come from a seed."""

    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(4)
            self.hidden, self.last = nn.Linear(48, 24), nn.Linear(24, 14)

    def forward(self, x: Tensor) -> Tensor:
        squares = nn.functional.adaptive_avg_pool2d(x, 4).flatten(1)
        logits: Tensor = self.last(self.hidden(squares).relu())
        return logits


class FindsCars(nn.Module):
    """A car in the middle of the picture while that is dark, and nobody."""

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        car = 1.0 - x.mean(dim=(1, 2, 3))
        scores = torch.stack([torch.zeros_like(car), car.clamp(0.0, 1.0)], dim=1)
        return x.new_tensor([[0.3, 0.3, 0.7, 0.7]]).expand(len(x), 1, 4), scores[:, None]


def finds_cars() -> Model:
    """A detector that knows a person and a car."""
    labels = ["person", "car"]
    return advsearch.load_model(FindsCars(), task="detection", labels=labels, input_size=(90, 120), name="finds cars")
