"""The corruption control: the published strengths, nothing at severity 0, derivatives that are right, no surprises."""

import io
import math

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import stats
from torch import Tensor

from advsearch.controls import corruption
from advsearch.controls.corruption import CORRUPTION_NAMES, STEPPED_CORRUPTIONS, apply_corruption, filters
from advsearch.controls.corruption.filters import sample_poisson

every_corruption = pytest.mark.parametrize("which", CORRUPTION_NAMES)
DRAWN = ("shot_noise", "impulse_noise")
"""Their derivative is one of the average over draws."""


pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.island("advsearch.controls.corruption")]


def scenery(height: int = 48, width: int = 64) -> Tensor:
    """A smooth, colourful picture away from 0 and 1."""
    rows, columns = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    waves = [0.5 + 0.25 * torch.sin(9.0 * rows + 2.0 * k) * torch.cos(7.0 * columns - k) for k in range(3)]
    return torch.stack(waves, dim=-1)


def number(value: float) -> Tensor:
    return torch.tensor(value)


def distance(one: Tensor, other: Tensor) -> float:
    return float((one - other).pow(2).mean().sqrt())


@every_corruption
def test_severity_0_is_the_picture_and_5_is_far_from_it(which: str) -> None:
    image = scenery()
    assert float((apply_corruption(image, which, number(0.0)) - image).abs().max()) < 1e-5
    distances = [distance(apply_corruption(image, which, number(severity)), image) for severity in (0.4, 1.0, 5.0)]
    assert distances[2] > 0.003 and (which == "pixelate" or distances[1] > 0.0)
    if which not in STEPPED_CORRUPTIONS:
        assert distances[0] < distances[1]
    if which not in ("elastic", "frost", *STEPPED_CORRUPTIONS):
        assert distances[1] < distances[2]


@pytest.mark.medium
@every_corruption
def test_extreme_pictures_give_finite_pictures_and_derivatives(which: str) -> None:
    pictures = [torch.full((17, 24, 3), grey) for grey in (0.0, 0.5, 1.0)]
    pictures.append((torch.rand(8, 9, 3, generator=torch.Generator().manual_seed(0)) > 0.5).float())
    for picture in pictures:
        for severity in (0.0, 0.5, 1.0, 2.5, 5.0):
            image, at = picture.clone().requires_grad_(), torch.tensor(severity, requires_grad=True)
            seen = apply_corruption(image, which, at)
            seen.sum().backward()
            assert (
                seen.shape == picture.shape and float(seen.detach().min()) >= 0.0 and float(seen.detach().max()) <= 1.0
            )
            assert image.grad is not None and at.grad is not None
            assert bool(torch.isfinite(image.grad).all()) and math.isfinite(float(at.grad))


@pytest.mark.parametrize("which", [name for name in CORRUPTION_NAMES if name not in (*DRAWN, *STEPPED_CORRUPTIONS)])
def test_the_derivatives_are_those_of_differences(which: str) -> None:
    image = scenery()
    image[5, 7] = 0.95  # one brightest pixel, which fog takes as its measure
    rows = torch.linspace(0.0, 1.0, image.shape[0])[:, None, None]
    weights = torch.cos(5.0 * rows + scenery().flip(1) * 8.0)
    direction = 0.0005 * torch.sin(11.0 * rows + image.flip(1) * 6.0)

    def change(by_picture: Tensor, by_severity: float) -> Tensor:
        ahead = apply_corruption(image + by_picture, which, number(severity + by_severity))
        return (ahead - apply_corruption(image - by_picture, which, number(severity - by_severity))) * weights / 2.0

    for severity in (0.5, 1.7, 3.4):
        at, picture = torch.tensor(severity, requires_grad=True), image.clone().requires_grad_()
        (apply_corruption(picture, which, at) * weights).sum().backward()
        assert at.grad is not None and picture.grad is not None
        moved = change(torch.zeros(()), 0.004) / 0.004
        assert float(at.grad) == pytest.approx(
            float(moved.sum()), rel=0.04, abs=0.004 + 0.02 * float(moved.abs().sum())
        )
        moved = change(direction, 0.0)
        slope = float((picture.grad * direction).sum())
        assert slope == pytest.approx(float(moved.sum()), rel=0.04, abs=0.004 + 0.02 * float(moved.abs().sum()))


@pytest.mark.parametrize("whole", [1, 2, 3, 4, 5])
def test_the_noises_are_as_strong_as_published(whole: int) -> None:
    image, severity = torch.full((224, 224, 3), 0.5), number(float(whole))
    level = severity
    (sigma,) = filters.GAUSSIAN[whole - 1]
    raw = filters.gaussian_noise(image, level, 0)
    assert float(raw.std()) == pytest.approx(sigma, rel=0.02) and float(raw.mean()) == pytest.approx(0.5, abs=0.005)
    (photons,) = filters.SHOT[whole - 1]
    raw = filters.shot_noise(image, level, 0)
    assert float(raw.std()) == pytest.approx(math.sqrt(0.5 / photons), rel=0.02)
    assert float(((raw * photons) - (raw * photons).round()).abs().max()) < 1e-3, "whole photons"
    (lost,) = filters.IMPULSE[whole - 1]
    seen = apply_corruption(image, "impulse_noise", severity)
    assert float((seen != 0.5).float().mean()) == pytest.approx(lost, rel=0.05)
    assert float((seen == 1.0).float().mean()) == pytest.approx(lost / 2.0, rel=0.1)


def test_a_point_out_of_focus_is_a_disc() -> None:
    point = torch.zeros(224, 224, 3)
    point[100, 100] = 1.0
    seen = apply_corruption(point, "defocus_blur", number(5.0))[..., 0] * math.pi * 10.0**2
    for inside in (seen[100, 100], seen[100, 109], seen[109, 100]):
        assert float(inside) == pytest.approx(1.0, abs=0.05)
    assert float(seen[100, 111].abs()) < 1e-3 and float(seen[108, 108].abs()) < 1e-3


def test_contrast_brightness_and_saturation_do_as_published() -> None:
    image = scenery()
    flat = corruption.contrast(image, number(2.0), 0)
    torch.testing.assert_close(flat.std(dim=(0, 1)), 0.3 * image.std(dim=(0, 1)))
    bright = corruption.brightness(image, number(1.0), 0)
    torch.testing.assert_close(bright.amax(-1), (image.amax(-1) + 0.1).clamp(max=1.0))
    black = apply_corruption(torch.zeros(4, 4, 3), "brightness", number(3.0))
    torch.testing.assert_close(black, torch.full((4, 4, 3), 0.3))
    grey = corruption.saturate(image, number(2.0), 0)
    spread = (image.amax(-1) - image.amin(-1)).mean()
    assert float((grey.amax(-1) - grey.amin(-1)).mean() / spread) == pytest.approx(0.1, rel=0.05)
    torch.testing.assert_close(grey.amax(-1), image.amax(-1))


def test_jpeg_is_what_a_file_would_be_and_passes_derivatives_through() -> None:
    image = ((scenery() * 255.0).round() / 255.0).requires_grad_()
    seen = apply_corruption(image, "jpeg", number(4.0))
    file = io.BytesIO()
    Image.fromarray((image.detach() * 255.0).round().to(torch.uint8).numpy()).save(file, "JPEG", quality=10)
    expected = torch.from_numpy(np.asarray(Image.open(file)).astype(np.float32) / 255.0)
    torch.testing.assert_close(seen.detach(), expected, atol=1e-6, rtol=0)
    seen.sum().backward()
    assert image.grad is not None and torch.equal(image.grad, torch.ones_like(image))


@pytest.mark.parametrize("which", STEPPED_CORRUPTIONS)
def test_stepped_corruptions_round_the_severity_and_slope_between_the_steps(which: str) -> None:
    image = scenery(96, 96)
    at = torch.tensor(2.3, requires_grad=True)
    seen = apply_corruption(image, which, at)
    assert torch.equal(seen.detach(), apply_corruption(image, which, number(2.0)))
    assert not torch.equal(seen.detach(), apply_corruption(image, which, number(2.5)))
    seen.sum().backward()
    step = apply_corruption(image, which, number(3.0)) - apply_corruption(image, which, number(2.0))
    assert at.grad is not None and float(at.grad) == pytest.approx(float(step.sum()), abs=0.05)


def test_poisson_numbers_are_those_of_the_distribution() -> None:
    generator = torch.Generator().manual_seed(3)
    mean, share = torch.rand(500, generator=generator) * 60.0, torch.rand(500, generator=generator)
    expected = stats.poisson.ppf(share.double().numpy(), mean.double().numpy())
    assert np.array_equal(sample_poisson(mean, share).numpy(), expected.astype(np.float32))
    assert float(sample_poisson(torch.zeros(9), torch.linspace(0.0, 0.9999, 9)).max()) == 0.0


def test_impulse_noise_has_the_slope_of_its_average() -> None:
    image, weights = scenery(), scenery().flip(0) - 0.5
    at = torch.tensor(3.5, requires_grad=True)
    (apply_corruption(image, "impulse_noise", at) * weights).sum().backward()
    gain = filters.IMPULSE[3][0] - filters.IMPULSE[2][0]
    assert at.grad is not None
    assert float(at.grad) == pytest.approx(float((gain * (0.5 - image) * weights).sum()), abs=4.0)
