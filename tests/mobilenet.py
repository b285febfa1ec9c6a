"""MobileNetV2 (Sandler et al. 2018) with the names that torchvision gives to its weights, for pictures in [0, 1]."""

import torch
from torch import Tensor, nn

STAGES = ((1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2), (6, 320, 1, 1))
"""Expansion, channels, blocks and first stride of each stage."""


class MobileNetV2(nn.Module):
    """Logits (N, 1000) of pictures (N, 3, H, W) in [0, 1], which are normalised as ImageNet's are."""

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1), persistent=False)
        layers: list[nn.Module] = [_convolved(3, 32, side=3, stride=2)]
        width = 32
        for expansion, channels, blocks, stride in STAGES:
            for number in range(blocks):
                layers.append(_Block(width, channels, stride if number == 0 else 1, expansion))
                width = channels
        self.features = nn.Sequential(*layers, _convolved(width, 1280))
        self.classifier = nn.Sequential(nn.Dropout(0.2), nn.Linear(1280, 1000))

    def forward(self, images: Tensor) -> Tensor:
        found: Tensor = self.classifier(self.features((images - self.mean) / self.std).mean(dim=(2, 3)))
        return found


class _Block(nn.Module):
    """Widen, filter each channel, narrow; added to what came in where the sizes are the same."""

    def __init__(self, width: int, channels: int, stride: int, expansion: int) -> None:
        super().__init__()
        inner = width * expansion
        widened = [_convolved(width, inner)] if expansion > 1 else []
        filtered = _convolved(inner, inner, side=3, stride=stride, groups=inner)
        self.conv = nn.Sequential(
            *widened, filtered, nn.Conv2d(inner, channels, 1, bias=False), nn.BatchNorm2d(channels)
        )
        self.added = stride == 1 and width == channels

    def forward(self, images: Tensor) -> Tensor:
        found: Tensor = self.conv(images)
        return images + found if self.added else found


def _convolved(width: int, channels: int, side: int = 1, stride: int = 1, groups: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(width, channels, side, stride, side // 2, groups=groups, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(channels), nn.ReLU6())
