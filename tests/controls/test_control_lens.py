"""The lens control: dots where and what they are asked to be, nothing at the start, derivatives that are right."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from advsearch.controls.lens import LensControl, draw_dots, spread_positions
from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.description import SceneDescription, load_description

NAMES = ("x", "y", "radius", "red", "green", "blue", "opacity", "falloff")


@pytest.fixture(scope="module")
def scene() -> SceneDescription:
    return load_description("mug")


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


def test_the_dots_start_apart_and_the_first_in_the_middle() -> None:
    assert torch.equal(spread_positions(1), torch.full((2, 1), 0.5))
    for count in (4, 16, 64):
        places = spread_positions(count).T
        assert float(places.min()) >= 0.1 and float(places.max()) <= 0.9
        gaps = torch.cdist(places, places) + 9.0 * torch.eye(count)
        assert float(gaps.min()) > 0.35 / math.sqrt(count)


def test_a_dot_mixes_light_by_the_published_profile() -> None:
    image = torch.full((101, 101, 3), 0.8)
    seen = draw_dots(image, values(red=1.0, green=0.25, blue=0.0, opacity=0.6, radius=20.0 / 101.0, falloff=1.5))
    color, light = srgb_to_linear(torch.tensor([1.0, 0.25, 0.0])), srgb_to_linear(image[0, 0])
    for pixels in (0, 10, 20, 30):
        cover = 0.6 * math.exp(-(((pixels / 20.0) ** 2) ** 1.5))
        torch.testing.assert_close(
            seen[50, 50 + pixels], linear_to_srgb(light + cover * (color - light)), atol=1e-4, rtol=0
        )


def test_a_dot_is_round_in_a_picture_that_is_not_square() -> None:
    seen = draw_dots(torch.ones(60, 120, 3), values(red=0.0, green=0.0, blue=0.0, radius=0.25))[..., 0]
    torch.testing.assert_close(seen[29, 59 + 16], seen[29 + 16, 59], atol=1e-5, rtol=0)
    assert float(seen[29, 59]) < 0.1 and float(seen[29, 0]) > 0.99


def test_later_dots_lie_over_earlier_ones() -> None:
    two = values(x=[0.5, 0.5], y=[0.5, 0.5], radius=[0.4, 0.4], red=[1.0, 0.0], green=[0.0, 1.0], blue=[0.0, 0.0])
    two["opacity"] = torch.tensor([1.0, 1.0])
    middle = draw_dots(torch.full((33, 33, 3), 0.5), two)[16, 16]
    torch.testing.assert_close(middle, torch.tensor([0.0, 1.0, 0.0]), atol=2e-2, rtol=0)


def test_the_derivatives_are_those_of_differences() -> None:
    image = 0.2 + 0.6 * random_picture(5, 7).double()
    inside = [[0.3, 0.6], [0.45, 0.7], [0.2, 0.35], [0.3, 0.8], [0.2, 0.6], [0.7, 0.4], [0.4, 0.7], 1.7]
    tensors = [torch.tensor(one, dtype=torch.float64, requires_grad=True) for one in inside]

    def seen(picture: Tensor, *numbers: Tensor) -> Tensor:
        return draw_dots(picture, dict(zip(NAMES, numbers, strict=True)))

    assert torch.autograd.gradcheck(seen, (image.requires_grad_(), *tensors), eps=1e-6, atol=1e-5)


@pytest.mark.parametrize("share", [0.0, 1.0])
@pytest.mark.parametrize("grey", [0.0, 0.5, 1.0])
def test_extreme_values_give_finite_pictures_and_derivatives(
    scene: SceneDescription, share: float, grey: float
) -> None:
    control = LensControl(radius=[0.01, 1.0], opacity=[0, 1], falloff=[1, 8], x=[0, 1], y=[0, 1], red=[0, 1])
    bound = control.bind(scene)
    u = torch.full_like(bound.start, share).requires_grad_()
    image = torch.full((16, 24, 3), grey, requires_grad=True)
    seen = bound.apply_to_image(u, image)
    seen.sum().backward()
    assert float(seen.detach().min()) >= 0.0 and float(seen.detach().max()) <= 1.0
    assert u.grad is not None and image.grad is not None
    assert bool(torch.isfinite(u.grad).all()) and bool(torch.isfinite(image.grad).all())


def test_dots_that_may_only_change_their_opacity_stay_spread(scene: SceneDescription) -> None:
    bound = LensControl(opacity=[0.0, 1.0]).bind(scene)
    assert len(bound.start) == 4
    seen = bound.apply_to_image(torch.tensor([0.0, 0.9, 0.0, 0.9]), torch.ones(60, 60, 3))[..., 0]
    changed = [bool(seen[int(60 * y), int(60 * x)] < 0.9) for x, y in spread_positions(4).T.tolist()]
    assert changed == [False, True, False, True]


def test_the_places_of_the_dots_keep_to_a_range_that_is_given(scene: SceneDescription) -> None:
    bound = LensControl(x=[0.0, 0.5], y=[0.2, 0.4], opacity=[0, 1], dots=8).bind(scene)
    places = torch.stack([bound.values(bound.start)["x"], bound.values(bound.start)["y"]], dim=1)
    assert float(places[:, 0].max()) <= 0.5 and float(places[:, 1].min()) >= 0.2
    assert len({tuple(place) for place in places.tolist()}) == 8


def test_what_comes_out(scene: SceneDescription) -> None:
    bound = LensControl(dots=2).bind(scene)
    said = bound.describe(bound.start)
    assert said["lens.radius.1"] == {"value": pytest.approx(0.12), "unit": "picture sizes"} and len(said) == 14
    for shade in (0.0, 1.0):
        u = bound.start.clone()
        u[6:] = torch.tensor([shade] * 6 + [1.0, 1.0])
        sticker = bound.get_artifact_images(u)["lens"]
        assert (
            sticker.shape == (256, 256, 3)
            and float((sticker - bound.get_artifact_images(bound.start)["lens"]).abs().max()) > 0.1
        )


@pytest.mark.parametrize("dots", [0, 65, 2.5, True, "four", math.nan, math.inf])
def test_a_number_of_dots_that_is_none_is_refused(dots: object) -> None:
    with pytest.raises(InputError, match=r"lens.dots: expected a whole number from 1 to 64, got"):
        LensControl(dots=dots)


def test_other_bad_settings_are_refused() -> None:
    with pytest.raises(InputError, match=r"lens.radius: expected a number from 0.01 to 1 \(picture sizes\), got 0"):
        LensControl(radius=0.0)
    with pytest.raises(UnknownNameError, match=r"unknown setting of control lens 'dot'. Did you mean 'dots'"):
        LensControl(dot=3)
