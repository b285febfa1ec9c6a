"""The sensor control: nothing at the start, each step what it says, derivatives that are right."""

import math

import pytest
import torch
from torch import Tensor

from advsearch.controls.sensor import SensorControl, apply_aberration, apply_mosaic, apply_sensor
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.description import SceneDescription

pytestmark = pytest.mark.island("advsearch.controls.sensor")

NAMES = ("vignetting", "aberration", "shot", "read", "mosaic", "red", "blue", "compression")


def values(**given: float) -> dict[str, Tensor]:
    return {name: torch.tensor(given.get(name, 0.0)) for name in NAMES}


def random_picture(height: int, width: int) -> Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(1))


def test_the_start_is_the_picture_as_it_is(scene: SceneDescription) -> None:
    bound = SensorControl().bind(scene)
    image = random_picture(24, 32)
    assert float((bound.apply_to_image(bound.start, image) - image).abs().max()) < 2e-5


@pytest.mark.parametrize(("shot", "read"), [(0.1, 0.0), (0.0, 0.05), (0.1, 0.05)])
@pytest.mark.parametrize("light", [0.1, 0.5])
def test_noise_has_a_variance_that_is_affine_in_the_light(shot: float, read: float, light: float) -> None:
    image = linear_to_srgb(torch.full((200, 200, 3), light))
    noise = srgb_to_linear(apply_sensor(image, values(shot=shot, read=read))) - light
    expected = math.sqrt(shot**2 * light + read**2)
    assert float(noise.std()) == pytest.approx(expected, rel=0.05)
    assert abs(float(noise.mean())) < 0.05 * expected


def test_a_mosaic_keeps_what_is_smooth_and_the_pixels_that_it_has() -> None:
    ramp = torch.linspace(0.0, 1.0, 33)[None, :, None].expand(17, 33, 3)
    torch.testing.assert_close(apply_mosaic(ramp)[1:-1, 1:-1], ramp[1:-1, 1:-1])
    picture = random_picture(16, 16)
    seen = apply_mosaic(picture)
    assert torch.equal(seen[0::2, 0::2, 0], picture[0::2, 0::2, 0])
    assert torch.equal(seen[1::2, 0::2, 1], picture[1::2, 0::2, 1])
    assert torch.equal(seen[1::2, 1::2, 2], picture[1::2, 1::2, 2])
    torch.testing.assert_close(seen[2, 3, 0], picture[2, 2:5:2, 0].mean())  # red between two reds
    torch.testing.assert_close(seen[3, 3, 0], picture[2:5:2, 2:5:2, 0].mean())  # red at blue: four corners


def test_red_is_larger_and_blue_smaller() -> None:
    dot = torch.zeros(101, 101, 3)
    dot[50, 90] = 1.0
    columns = torch.arange(101.0)
    red, green, blue = (apply_aberration(dot, torch.tensor(0.02))[50].T * columns).sum(dim=1) / apply_aberration(
        dot, torch.tensor(0.02)
    )[50].T.sum(dim=1)
    assert float(green) == pytest.approx(90.0)
    assert float(red) == pytest.approx(50.0 + 40.0 * 1.02, abs=0.1)
    assert float(blue) == pytest.approx(50.0 + 40.0 * 0.98, abs=0.1)


def test_light_falls_with_the_fourth_power_of_the_cosine_of_the_angle() -> None:
    """Of a pinhole of 60 x 40 pixels, 35 away from the sensor."""
    down, across = (torch.arange(side) + 0.5 - side / 2 for side in (40, 60))
    cosine = 35.0 / torch.sqrt(35.0**2 + down[:, None] ** 2 + across[None, :] ** 2)
    missing = 1.0 - (35.0 / math.sqrt(35.0**2 + 20.0**2 + 30.0**2)) ** 4
    seen = srgb_to_linear(apply_sensor(linear_to_srgb(torch.full((40, 60, 3), 0.8)), values(vignetting=missing)))
    torch.testing.assert_close(seen, 0.8 * (cosine**4)[..., None].expand(40, 60, 3), atol=1e-4, rtol=0)


def test_white_balance_is_in_stops() -> None:
    image = linear_to_srgb(torch.full((4, 4, 3), 0.2))
    seen = srgb_to_linear(apply_sensor(image, values(red=1.0, blue=-1.0)))[0, 0]
    torch.testing.assert_close(seen, torch.tensor([0.4, 0.2, 0.1]), atol=1e-3, rtol=0)


def test_compression_is_a_jpeg_file_and_its_derivative_that_of_the_picture() -> None:
    image = random_picture(16, 16).requires_grad_()
    mild, strong = (apply_sensor(image, values(compression=c)) for c in (5.0, 90.0))
    assert 1e-3 < float((mild - image).detach().abs().mean()) < float((strong - image).detach().abs().mean())
    strong.sum().backward()
    assert image.grad is not None and float((image.grad - 1.0).abs().median()) < 1e-3


@pytest.mark.medium
def test_the_derivatives_are_those_of_differences() -> None:
    image = 0.3 + 0.4 * random_picture(6, 8).double()
    inside = [0.4, 0.003, 0.05, 0.02, 0.6, 0.2, -0.3]
    tensors = [torch.tensor(one, dtype=torch.float64, requires_grad=True) for one in inside]

    def seen(picture: Tensor, *numbers: Tensor) -> Tensor:
        return apply_sensor(picture, {**dict(zip(NAMES, numbers, strict=False)), "compression": torch.tensor(0.0)})

    assert torch.autograd.gradcheck(seen, (image.requires_grad_(), *tensors), eps=1e-7, atol=1e-4)
