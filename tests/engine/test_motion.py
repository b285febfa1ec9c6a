"""An open shutter and rows that are read one after the other, against stills that are rendered one by one."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from advsearch import seeds
from advsearch.controls import compose_space
from advsearch.controls.path import PathControl
from advsearch.engine.loading import make_controls, make_renderer
from advsearch.scene.description import load_description
from advsearch.scene.formation import Moment, divide_exposure
from advsearch.scene.renderer import Renderer

pytestmark = pytest.mark.island("advsearch.controls.path")

SIDE, SECONDS = 48, 2.0
LEVELS = 2.0 / 255.0
DRIVE: dict[str, Any] = {"path": "orbit", "seconds": SECONDS, "time": 0.9}
"""Once around in two seconds: a shutter of 0.05 s is nine degrees."""


def renderer(controls: list[Any], denoise: str = "none") -> Renderer:
    scene = load_description("mug")
    return make_renderer(scene, compose_space(controls, scene), SIDE, denoise, 0)


@pytest.fixture(scope="module")
def stills() -> Callable[[float, int, int], Tensor]:
    """Linear radiance (H, W, 3) of one moment by its time, samples and seed, from a path without an exposure."""
    still = renderer([PathControl(**{**DRIVE, "time": [0.8, 1.0]})])
    return lambda time, spp, seed: still.radiance(torch.tensor([(time - 0.8) / 0.2]), seed, spp)


def levels(radiance: Tensor, like: Renderer) -> Tensor:
    return like.formation.map_to_display(radiance)


@pytest.mark.parametrize("count", [1, 5, 16])
@pytest.mark.parametrize(
    ("shutter", "rolling"), [(0.1, 0.0), (0.0, 0.1), (0.03, 0.1), (0.1, 0.03), (0.0, -0.1), (0.03, -0.1)]
)
def test_every_row_is_exposed_around_its_own_time_and_as_long(shutter: float, rolling: float, count: int) -> None:
    offsets, rows, samples = divide_exposure(shutter, rolling, 20, count)
    torch.testing.assert_close(rows.sum(dim=0), torch.ones(20))
    assert (rows >= 0.0).all() and 0.0 < samples <= 1.0 and float(offsets.sum()) == pytest.approx(0.0, abs=1e-12)
    middle = (offsets[:, None] * rows).sum(dim=0)
    wanted = rolling * ((torch.arange(20) + 0.5) / 20 - 0.5)
    half = (shutter + abs(rolling)) / count / 2.0
    assert float((middle - wanted).abs().max()) <= half + 1e-7
    within = (offsets[:, None] - wanted).abs() <= shutter / 2.0 + half + 1e-7
    assert not rows[~within].any()


@pytest.mark.medium
def test_motion_blur_is_the_mean_of_64_stills(stills: Callable[[float, int, int], Tensor]) -> None:
    """With the same noise: every value, within two levels."""
    blurred = renderer([PathControl(**DRIVE, shutter=0.15)])
    assert len(blurred.moments) == 64  # half a pixel from one to the next
    times = 0.9 + 0.15 * ((torch.arange(64) + 0.5) / 64 - 0.5)
    each = [stills(float(time), 2, seeds.derive_seed(1, "moment", k)) for k, time in enumerate(times)]
    mean = levels(torch.stack(each).mean(dim=0), blurred)
    assert float((blurred(blurred.start, 1, 128) - mean).abs().max()) < LEVELS
    assert float((levels(stills(0.9, 64, 5), blurred) - mean).abs().max()) > 20 * LEVELS


@pytest.mark.medium
def test_rows_that_are_read_one_after_the_other_are_those_of_as_many_stills(
    stills: Callable[[float, int, int], Tensor],
) -> None:
    """With the same noise, where each row has a moment of its own."""
    rolled = renderer([PathControl(**DRIVE, rolling=0.1)])
    times = [0.9 + 0.1 * ((row + 0.5) / SIDE - 0.5) for row in range(SIDE)]
    rows = torch.stack([stills(time, 4, seeds.derive_seed(1, "moment", row))[row] for row, time in enumerate(times)])
    own = compose_space([PathControl(**DRIVE, rolling=0.1)], load_description("mug"))
    offsets, shares, samples = divide_exposure(0.0, 0.1, SIDE, SIDE)
    rolled.moments = tuple(
        Moment(own.advance_time(float(at)), one, samples) for at, one in zip(offsets, shares, strict=True)
    )
    off = (rolled(rolled.start, 1, 4) - levels(rows, rolled)).abs()
    assert float(off.max()) < LEVELS
    assert float((levels(stills(0.9, 64, 5), rolled) - levels(rows, rolled)).abs().max()) > 20 * LEVELS


@pytest.mark.medium
def test_a_derivative_of_a_texture_is_that_of_the_mean() -> None:
    moving = renderer([PathControl(**DRIVE, shutter=0.05), *make_controls({"texture": {}})])
    weight = torch.rand(SIDE, SIDE, 3, generator=torch.Generator().manual_seed(0)).double()
    u = moving.start.clamp(0.1, 0.9).requires_grad_()
    (gradient,) = torch.autograd.grad((weight * moving.radiance(u, 1, 64)).sum(), u)
    with torch.no_grad():
        above, below = ((weight * moving.radiance(u + step, 1, 64)).sum() for step in (0.02, -0.02))
    assert float(0.04 * gradient.double().sum()) == pytest.approx(float(above - below), rel=0.02)
