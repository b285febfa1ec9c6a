"""Light that is very strong, absent or impossible, and pictures at the ends of their range."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import torch
from torch import Tensor

from advsearch.attacks import PGD, Adam, Auto, Policy, search
from advsearch.attacks.evaluation import Query
from advsearch.errors import InputError
from advsearch.questions.stability.case import CaseGroup, Check, Outcome, holds
from advsearch.questions.stability.scene import ControlSettings, Evaluator, examine_gradient, search_domain, small
from advsearch.scene.assets import EnvironmentAsset, Floats
from advsearch.scene.environments import import_environment

BRIGHT = 1e5
PLATEAU_STEPS = 40
"""Evaluations in which a search has to be off a plateau."""
POLICIES: tuple[Policy[Any], ...] = (PGD(), Adam(), Auto())

GROUP = CaseGroup("radiometric")
_SCENE = "counted and set to zero where they arise (Renderer.non_finite); none is expected"
_FLAT = "a zero gradient gives a random step; the fifth in a row ends the search as 'stalled'"
_REFUSED = "import_environment counts the texels that are not light and refuses the map"
_ASSET = "an environment with such a texel is refused, wherever it comes from"


def _radiance(value: float, texel: float | None = None) -> Floats:
    """A grey map (16, 32, 3), one texel of it different."""
    radiance = np.full((16, 32, 3), value, np.float32)
    if texel is not None:
        radiance[4, 10] = texel
    return radiance


def grey_map(value: float, texel: float | None = None) -> EnvironmentAsset:
    """Return a grey map (16, 32, 3), one texel of it different."""
    return EnvironmentAsset("made", _radiance(value, texel))


@GROUP.case(
    "hdri-texel-100000",
    "Pictures and gradients are finite, raw and denoised, and gradients are right.",
    _SCENE,
    "environment, texture",
    cheap=False,
)
def bright_texel() -> Outcome:
    """A sky of 0.3 with one texel of 100,000, raw and denoised."""
    flash = grey_map(0.3, BRIGHT)
    seen = examine_gradient(
        small("mug", {"environment": {"exposure": [-1.0, 1.0]}, "texture": {"resolution": 16}}, environment=flash)
    )
    turned = small("mug", {"environment": {"rotation": [0.0, 360.0]}}, environment=flash, denoise="oidn")
    denoised = examine_gradient(turned, torch.tensor([0.31]), compare=False)
    return seen.findings(
        holds("the denoised picture and its gradient are finite", denoised.finite),
        Check("largest gradient by the rotation", denoised.gradient, least=1e-12),
    )


@GROUP.case(
    "black-environment", "The picture is black, the gradient zero, and the search ends as stalled.", _FLAT, "texture"
)
def black_environment() -> Outcome:
    """Nothing shines: the picture is black, no texel matters, and the search has to say that it is stuck."""
    seen = examine_gradient(
        small("mug", {"texture": {"resolution": 8}}, environment=grey_map(0.0)),
        compare=False,
        evaluations=PLATEAU_STEPS,
    )
    return seen.findings(
        Check("mean of the picture", seen.mean, 0.0, 0.0),
        Check("largest gradient", seen.gradient, 0.0, 0.0),
        holds("the ending is 'stalled'", seen.result.ending.value == "stalled"),
    )


@GROUP.case(
    "lamp-in-the-dark",
    "A lamp lights a scene that has no other light.",
    "the lamp's power is in multiples of the environment's metered light",
    "light",
)
def lamp_in_the_dark() -> Outcome:
    """A black environment and a lamp: the lamp has to be able to light the scene."""
    controls = {"light": {"type": "point", "power": [0.0, 20.0], "x": 1.0, "y": 1.0, "z": 2.0}}
    seen = examine_gradient(small("mug", controls, environment=grey_map(0.0)), torch.tensor([0.5]))
    return seen.findings(Check("mean of the picture", seen.mean, least=0.01))


def refused_texel(value: float, *, as_file: bool) -> Outcome:
    """A texel that is no light, in a file or in an array, has to be refused in a sentence."""
    radiance = _radiance(0.3, value)
    try:
        if as_file:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "bad.exr"
                with OpenEXR.File({}, {"RGB": radiance}) as picture:
                    picture.write(str(path))
                import_environment(path)
        else:
            rendered = small("mug", {"texture": {"resolution": 8}}, environment=EnvironmentAsset("made", radiance))
            with torch.no_grad():
                rendered(rendered.start, seed=0, spp=1)
    except InputError as error:
        said = "texels" in str(error) and "\n" not in str(error)
        return Outcome((holds("refused in a sentence that counts the texels", said),), ending="refused")
    return Outcome((holds("refused", False),), ending="rendered all the same")


for word, value in (("negative", -1.0), ("infinite", np.inf), ("nan", np.nan)):
    for as_file in (True, False):
        GROUP.case(
            f"{word}-texel-{'file' if as_file else 'array'}",
            "The map is refused before anything is rendered.",
            _REFUSED if as_file else _ASSET,
            "environment",
        )(partial(refused_texel, value, as_file=as_file))


def extreme_exposure(control: str, stops: float) -> Outcome:
    """A picture ten stops over or under."""
    low, high = sorted((stops, stops - np.sign(stops)))
    share = 1.0 if stops > 0.0 else 0.0
    controls: ControlSettings = {control: {"exposure": [low, high]}, "texture": {"resolution": 8}}
    renderer = small("mug", controls)
    u = renderer.start.clone()
    u[0] = share
    return examine_gradient(renderer, u).findings()


for control in ("camera", "environment"):
    for stops in (10.0, -10.0):
        GROUP.case(
            f"{control}-exposure-{'up' if stops > 0.0 else 'down'}",
            "Picture and gradient are finite; the gradient of the linear picture is right.",
            _SCENE,
            f"{control}, texture",
            cheap=control == "camera",
        )(partial(extreme_exposure, control, stops))


def plateau(low: float, high: float) -> Outcome:
    """Start where the picture is white and nothing has a gradient; the way out is an exposure further down.

    Args:
        low, high: stops that are searched. Up to about 4 something in the picture is not white.
    """
    renderer = small("mug", {"camera": {"exposure": [low, high]}})
    start = torch.ones_like(renderer.start)

    def darkness(image: Tensor) -> Tensor:
        return 0.9 - image.mean()

    checks, endings, flat = [], [], 0
    for policy in POLICIES:
        evaluate = Evaluator(renderer, darkness, 2)
        found = search(
            partial(map, evaluate), search_domain(renderer, start), policy, steps=PLATEAU_STEPS, seed=0, candidates=0
        )
        flat += sum(record.gradient_norm == 0.0 for record in found.history)
        checks.append(Check(f"{policy.name} finds a picture that is not white", float(found.best_objective > 0), 1, 1))
        endings.append(f"{policy.name}: {found.ending.value}")
    first = Evaluator(renderer, darkness, 2)(Query(start, 0, gradient=True))
    assert first.gradient is not None
    slope = float(first.gradient.abs().max())
    return Outcome(
        (Check("gradient at the start", slope, 0.0, 0.0), *checks),
        ending=", ".join(endings),
        measured={"evaluations without a gradient": float(flat)},
    )


GROUP.case(
    "saturated-plateau",
    f"From a white picture without a gradient every policy gets away within {PLATEAU_STEPS} evaluations.",
    _FLAT,
    "camera",
)(partial(plateau, -10.0, 10.0))
GROUP.case("saturated-plateau-narrow-way-out", "The same where the way out is a tenth of the range.", _FLAT, "camera")(
    partial(plateau, 1.0, 10.0)
)
