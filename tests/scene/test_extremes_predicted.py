"""Pictures that light on surfaces predicts, where scenes are at their ends."""

from typing import Any

import numpy as np
import pytest
import torch

from advsearch.engine.acceptance import compute_level_errors
from advsearch.engine.gradients import make_smooth_loss
from advsearch.predictors.surface_light.renderer import SurfaceRenderer
from advsearch.questions.stability.result import CaseOutcome, check_condition, check_range
from advsearch.questions.stability.scene import (
    REFERENCE_SPP,
    ControlSettings,
    ObjectSource,
    make_checkered_mug,
    make_gray_environment,
    make_renderer,
    measure_inward_slope,
)
from advsearch.questions.stability.scenes import FLASH
from advsearch.scene.assets import EnvironmentAsset

pytestmark = pytest.mark.island("advsearch.questions.stability", "advsearch.predictors.surface_light")

TRACED = 256
"""Samples a pixel of the traced pictures."""
NIGHT = make_gray_environment(0.0)


def right(outcome: CaseOutcome) -> None:
    """Everything is finite, and every check holds."""
    assert outcome.finite and [str(number) for number in outcome.checks if not number.ok] == []


AWAY = {"pose.x": 1e4}


LEVELS = 4.0
"""Levels of 255 by which a predicted picture may be off, root mean square. Most of that are edges: four rays a
pixel see them, and the pictures are 24 pixels wide."""
PAINTED: ControlSettings = {"texture": {"resolution": 8}, "camera": {}}


def lit(
    controls: ControlSettings = PAINTED,
    thing: ObjectSource = "mug",
    *,
    levels: float = LEVELS,
    slope: float | None = 0.15,
    **scene: object,
) -> CaseOutcome:
    """Compare a picture by light on surfaces with a traced one, and its derivative by the texture with differences.

    Args:
        levels: by which the picture may be off.
        slope: relative error that the derivative may have, since light that meets the texture twice is left out of it;
            None where the picture does not depend on the texture, and it has to be 0.
    """
    renderer = make_renderer(controls, thing, **scene)  # type: ignore[arg-type]
    light, u = SurfaceRenderer(renderer, renderer.start, seed=1), renderer.start
    with torch.no_grad():
        picture = light(u)
    (off,) = compute_level_errors(renderer, [picture], u, 3, TRACED)
    textured = torch.zeros(len(u))
    for group in renderer.space.groups:
        textured[group.coordinates] = float(group.control == "texture")
    light.path_renderer = renderer.copy_with(transfer="linear")
    gradient = light.renderer.gradient(make_smooth_loss(renderer.formation.resolution), u, 0, 1)[1] * textured
    given, wanted = measure_inward_slope(renderer, gradient, textured, 1, 4 * REFERENCE_SPP)
    error = abs(given / wanted - 1.0) if wanted else abs(given)
    seen = (
        check_range("largest derivative by a texel", float(gradient.abs().max()), 0.0, 0.0)
        if slope is None
        else check_range("error of the derivative by the texture", error, max_value=slope)
    )
    hidden = textured * (gradient == 0.0)
    light.path_renderer = renderer
    with torch.no_grad():
        unseen = float((light(u * (1.0 - hidden)) - picture).abs().max())
    checks = [
        check_condition("the picture is in [0, 1]", bool((picture >= 0.0).all() and (picture <= 1.0).all())),
        check_range("levels of 255 off", off, max_value=levels),
        seen,
        check_range("largest change where texels without a derivative become black", unseen, 0.0, 0.0),
    ]
    finite = bool(torch.isfinite(picture).all() and torch.isfinite(gradient).all()) and light.n_non_finite == 0
    measured = {"entries": float(light.n_entries), "derivative": wanted, "hidden numbers": float(hidden.sum())}
    return CaseOutcome(checks, finite, error, measurements=measured)


HALF = np.repeat(np.repeat(np.array([1.0, 0.0], np.float32), 16)[None, :, None], 3, axis=2).repeat(16, axis=0)
INSIDE = {"texture": {"resolution": 8}, "camera": {"distance": [0.05, 0.2]}}
GRAZING = {"texture": {"resolution": 8}, "camera": {"elevation": [-10.0, 10.0]}}
LIT: dict[str, dict[str, Any]] = {
    "looking along the ground": {"controls": GRAZING},
    "from inside the mug, where much light has met the texture before": {"controls": INSIDE, "slope": 0.4},
    "texels that are exactly 0 and 1": {"thing": make_checkered_mug},
    "a map that is half black and half white": {"environment": EnvironmentAsset("half", HALF), "levels": 1.5 * LEVELS},
    "a map that is black": {"environment": NIGHT, "slope": None, "levels": 1e-6},
    "a sun of one texel, 300,000 times as bright as the sky": {"environment": FLASH, "levels": 1.5 * LEVELS},
    "out of sight": {"settings": AWAY, "slope": None},
}


@pytest.mark.medium
@pytest.mark.parametrize("name", LIT)
def test_pictures_and_derivatives_by_light_on_surfaces_are_right(name: str) -> None:
    right(lit(**LIT[name]))
