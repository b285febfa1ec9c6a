"""The lens control: dots where and what they are asked to be, nothing at the start, derivatives that are right."""

import math

import pytest
import torch
from torch import Tensor

from advsearch.controls.lens import LensControl, draw_dots
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.description import SceneDescription

pytestmark = pytest.mark.island("advsearch.controls.lens")

NAMES = ("x", "y", "radius", "red", "green", "blue", "opacity", "falloff")


def values(**given: float | list[float]) -> dict[str, Tensor]:
    """One grey dot in the middle unless told otherwise."""
    one = {"x": 0.5, "y": 0.5, "radius": 0.2, "red": 0.5, "green": 0.5, "blue": 0.5, "opacity": 1.0, **given}
    dots = {name: torch.tensor(value).reshape(-1) for name, value in one.items() if name != "falloff"}
    return {**dots, "falloff": torch.tensor(given.get("falloff", 1.0))}


def random_picture(height: int, width: int) -> Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("dots", [1, 4, 64])
def test_the_start_is_the_picture_as_it_is_and_opacity_has_a_slope_there(scene: SceneDescription, dots: int) -> None:
    bound = LensControl(dots=dots).bind(scene)
    image = 0.7 + 0.3 * random_picture(24, 32)
    u = bound.start.clone().requires_grad_()
    seen = bound.apply_to_image(u, image)
    assert float((seen - image).detach().abs().max()) < 1e-5
    seen.sum().backward()
    assert u.grad is not None and len(u) == 7 * dots
    assert bool((u.grad[6 * dots :].abs() > 1e-3).all()), "every dot can be faded in"


def test_a_dot_mixes_light_by_the_published_profile() -> None:
    image = torch.full((101, 101, 3), 0.8)
    seen = draw_dots(image, values(red=1.0, green=0.25, blue=0.0, opacity=0.6, radius=20.0 / 101.0, falloff=1.5))
    color, light = srgb_to_linear(torch.tensor([1.0, 0.25, 0.0])), srgb_to_linear(image[0, 0])
    for pixels in (0, 10, 20, 30):
        cover = 0.6 * math.exp(-(((pixels / 20.0) ** 2) ** 1.5))
        torch.testing.assert_close(
            seen[50, 50 + pixels], linear_to_srgb(light + cover * (color - light)), atol=1e-4, rtol=0
        )


def test_the_derivatives_are_those_of_differences() -> None:
    image = 0.2 + 0.6 * random_picture(5, 7).double()
    inside = [[0.3, 0.6], [0.45, 0.7], [0.2, 0.35], [0.3, 0.8], [0.2, 0.6], [0.7, 0.4], [0.4, 0.7], 1.7]
    tensors = [torch.tensor(one, dtype=torch.float64, requires_grad=True) for one in inside]

    def seen(picture: Tensor, *numbers: Tensor) -> Tensor:
        return draw_dots(picture, dict(zip(NAMES, numbers, strict=True)))

    assert torch.autograd.gradcheck(seen, (image.requires_grad_(), *tensors), eps=1e-6, atol=1e-5)
