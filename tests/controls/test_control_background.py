"""The background control: the colour that was asked for, behind the object and nowhere else."""

import colorsys
import itertools

import pytest
import torch

import advsearch
from advsearch.controls.background import BackgroundControl, hsv_to_rgb
from advsearch.scene.description import SceneDescription

pytestmark = pytest.mark.island("advsearch.controls.background")


def test_the_colours_are_those_of_the_standard_library() -> None:
    for hue, saturation, value in itertools.product(
        (0.0, 35.0, 60.0, 200.0, 299.0, 360.0), (0.0, 0.4, 1.0), (0.0, 0.7)
    ):
        expected = torch.tensor(colorsys.hsv_to_rgb(hue / 360.0 % 1.0, saturation, value))
        got = hsv_to_rgb(torch.tensor(hue), torch.tensor(saturation), torch.tensor(value))
        torch.testing.assert_close(got, expected, atol=1e-5, rtol=0)


def test_the_derivatives_are_those_of_differences() -> None:
    for hue in (20.0, 100.0, 170.0, 230.0, 280.0, 350.0):
        point = [torch.tensor(one, dtype=torch.float64, requires_grad=True) for one in (hue, 0.6, 0.7)]
        assert torch.autograd.gradcheck(hsv_to_rgb, tuple(point), eps=1e-6, atol=1e-8)


def test_it_asks_for_a_backdrop_and_takes_the_ground_away_unless_told_to_keep_it(scene: SceneDescription) -> None:
    prepared = BackgroundControl().prepare(scene)
    assert prepared.backdrop and prepared.get_number("ground.size") == 0.0
    kept = BackgroundControl(ground="keep").prepare(scene)
    assert kept.backdrop and kept.get_number("ground.size") == scene.get_number("ground.size") > 0.0
    assert kept.values == scene.values and kept.parts == scene.parts


def test_the_picture_has_that_colour_behind_the_object_and_its_slope() -> None:
    render = advsearch.load_scene("mug").renderer([BackgroundControl()], resolution=32)
    u = torch.tensor([0.3, 0.7, 0.6], requires_grad=True)
    image = render(u, seed=0, spp=4)
    color = hsv_to_rgb(torch.tensor(0.3 * 360.0), torch.tensor(0.7), torch.tensor(0.6))
    torch.testing.assert_close(image[0, 0], color, atol=1e-4, rtol=0)
    assert float((image[16, 14] - color).detach().abs().max()) > 0.1, "the mug is in front of it"
    weights = torch.linspace(0.0, 1.0, 32 * 32 * 3).reshape(32, 32, 3)
    (slope,) = torch.autograd.grad((image * weights).sum(), u)
    for index in range(3):
        step = torch.zeros(3)
        step[index] = 0.01
        with torch.no_grad():
            change = render(u + step, seed=0, spp=4) - render(u - step, seed=0, spp=4)
        assert float(slope[index]) == pytest.approx(float((change * weights).sum() / 0.02), rel=0.02, abs=0.05)
