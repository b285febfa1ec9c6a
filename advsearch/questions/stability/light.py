"""Light that is very strong, absent or impossible, pictures and surfaces at the ends of their range."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import OpenEXR
import torch
from torch import Tensor

from advsearch.attacks import PGD, Adam, Auto, Policy, search
from advsearch.attacks.evaluation import Query
from advsearch.engine.gradients import smooth_loss
from advsearch.errors import InputError
from advsearch.questions.stability.scene import (
    ERROR,
    REFERENCE_SPP,
    SPP,
    CaseGroup,
    Check,
    ControlSettings,
    Evaluator,
    Outcome,
    examine_gradient,
    holds,
    search_domain,
    small,
)
from advsearch.scene import library
from advsearch.scene.assets import EnvironmentAsset, Floats
from advsearch.scene.description import describe
from advsearch.scene.environments import import_environment
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.mitsuba_backend.parts import Translation, translation
from advsearch.scene.parts import ScenePart
from advsearch.scene.renderer import Renderer

BRIGHT = 1e5
PLATEAU_STEPS = 40
"""Evaluations in which a search has to be off a plateau."""
POLICIES: tuple[Policy[Any], ...] = (PGD(), Adam(), Auto())

RADIOMETRIC = CaseGroup("radiometric")
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


@RADIOMETRIC.case("hdri-texel-100000", _SCENE, "environment, texture", cheap=False)
def bright_texel() -> Outcome:
    """Pictures and gradients are finite, raw and denoised, and gradients are right."""
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


@RADIOMETRIC.case("black-environment", _FLAT, "texture")
def black_environment() -> Outcome:
    """The picture is black, the gradient zero, and the search ends as stalled."""
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


@RADIOMETRIC.case("lamp-in-the-dark", "the lamp's power is in multiples of the environment's metered light", "light")
def lamp_in_the_dark() -> Outcome:
    """A lamp lights a scene that has no other light."""
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
        return Outcome(holds("refused in a sentence that counts the texels", said), ending="refused")
    return Outcome(holds("refused", False), ending="rendered all the same")


for word, value in (("negative", -1.0), ("infinite", np.inf), ("nan", np.nan)):
    for as_file in (True, False):
        RADIOMETRIC.case(
            f"{word}-texel-{'file' if as_file else 'array'}",
            _REFUSED if as_file else _ASSET,
            "environment",
            holds="The map is refused before anything is rendered.",
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
        RADIOMETRIC.case(
            f"{control}-exposure-{'up' if stops > 0.0 else 'down'}",
            _SCENE,
            f"{control}, texture",
            holds="Picture and gradient are finite; the gradient of the linear picture is right.",
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
        Check("gradient at the start", slope, 0.0, 0.0),
        *checks,
        ending=", ".join(endings),
        measured={"evaluations without a gradient": float(flat)},
    )


RADIOMETRIC.case(
    "saturated-plateau",
    _FLAT,
    "camera",
    holds=f"From a white picture without a gradient every policy gets away within {PLATEAU_STEPS} evaluations.",
)(partial(plateau, -10.0, 10.0))
RADIOMETRIC.case(
    "saturated-plateau-narrow-way-out", _FLAT, "camera", holds="The same where the way out is a tenth of the range."
)(partial(plateau, 1.0, 10.0))


MATERIALS = CaseGroup("materials")
_MOVED = "values are rendered inside the range in which the adjoint is right (metallic at most 0.999)"


@dataclass(frozen=True, eq=False)
class GlassBall(ScenePart):
    """A ball of clear glass; nothing of it varies.

    Attributes:
        name: of the part.
        place: (3,) of its middle.
        radius: in object sizes.
    """

    place: tuple[float, float, float]
    radius: float


@translation.register
def _glass(part: GlassBall) -> Translation:
    surface = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    ball = {"type": "sphere", "center": list(part.place), "radius": part.radius, "bsdf": surface}
    return Translation({part.name: ball})


def behind_glass(controls: ControlSettings) -> Renderer:
    """The mug behind a ball of clear glass, which covers part of it."""
    camera = camera_to_world(describe("mug"))
    x, y, z = (float(one) for one in camera[:3, 3] * 0.6 + np.array([0.0, 0.0, 0.2]))
    return small("mug", controls, parts=[GlassBall("glass", (x, y, z), 0.3)])


def extreme_surface(searched: dict[str, list[float]], **values: float) -> Outcome:
    """A surface with some numbers at the ends of their range, and the derivative by some of them there."""
    settings = {f"material.{name}": value for name, value in values.items()}
    return examine_gradient(small("mug", {"material": searched}, settings=settings)).findings()


MATERIALS.case(
    "roughness-0",
    "Mitsuba's lobe is never narrower than a roughness of 0.03, so the derivative is finite",
    "material",
    holds="Finite, and the gradient by the roughness is right, at the polished end.",
)(partial(extreme_surface, {"roughness": [0.0, 1.0]}, roughness=0.0))
MATERIALS.case(
    "roughness-1",
    _SCENE,
    "material",
    holds="Finite, and the gradient by the roughness is right, at the matt end.",
    cheap=False,
)(partial(extreme_surface, {"roughness": [0.0, 1.0]}, roughness=1.0, metallic=1.0))
MATERIALS.case(
    "metallic-1",
    _MOVED,
    "material",
    holds="Finite, and the gradient has the right sign and size at a metallic of exactly 1.",
    cheap=False,
)(partial(extreme_surface, {"metallic": [0.0, 1.0]}, metallic=1.0))
MATERIALS.case(
    "perfect-mirror",
    _MOVED,
    "material",
    holds="A metal of roughness 0 is finite, and both gradients are right.",
    cheap=False,
)(partial(extreme_surface, {"roughness": [0.0, 1.0], "metallic": [0.0, 1.0]}, roughness=0.0, metallic=1.0))


@MATERIALS.case("clear-glass", _SCENE, "texture, environment", cheap=False)
def clear_glass() -> Outcome:
    """A texel behind clear glass has the right gradient, and nothing is NaN."""
    controls: ControlSettings = {"texture": {"resolution": 8}, "environment": {"exposure": [-1.0, 1.0]}}
    glass = behind_glass(controls)
    without = small("mug", controls)
    with torch.no_grad():
        moved = float((glass(glass.start, 0, 8) - without(without.start, 0, 8)).abs().mean())
    return examine_gradient(glass).findings(Check("mean change of the picture by the glass", moved, least=0.01))


@MATERIALS.case("texels-0-and-1", "the straight piece of the sRGB curve at 0; projection onto the bounds", "texture")
def texels_at_the_ends() -> Outcome:
    """Texels at the ends of the range have a gradient, and the search moves them inwards only."""
    checks = np.indices((8, 8)).sum(axis=0) % 2
    texels = np.repeat(checks[:, :, None], 3, axis=2).astype(np.float32)
    mug = replace(library.load_object("mug"), name="checked", base_color=texels)
    renderer = small(mug, {"texture": {"resolution": 8, "epsilon": 0.2}})
    seen = examine_gradient(renderer, compare=False)
    best = seen.result.best_u
    error = _inward_error(renderer)
    return seen.findings(
        Check("gradient error along a direction that points inwards", error, most=ERROR),
        Check("smallest texel of the answer", float(best.min()), least=0.0),
        Check("largest texel of the answer", float(best.max()), most=1.0),
        Check("texels that the search moved", float((best != renderer.start).sum()), least=1.0),
        holds("the start has both 0 and 1", set(renderer.start.tolist()) == {0.0, 1.0}),
        relative_error=error,
    )


def _inward_error(renderer: Renderer, repeats: int = 8, step: float = 0.04) -> float:
    """Compare the gradient with one-sided differences of second order, since there is no other side at a bound."""
    renderer.formation = replace(renderer.formation, transfer="linear")
    loss, u = smooth_loss(renderer.formation.resolution), renderer.start
    slope = renderer.gradient(loss, u, 0, SPP)[1]
    inwards = torch.where(u > 0.5, -1.0, 1.0) * (slope * (0.5 - u) > 0.0)
    found, wanted = [], []
    for seed in range(repeats):
        found.append(float(renderer.gradient(loss, u, seed, REFERENCE_SPP)[1] @ inwards))
        with torch.no_grad():
            here, near, far = (float(loss(renderer(u + k * step * inwards, seed, REFERENCE_SPP))) for k in range(3))
        wanted.append((4.0 * near - 3.0 * here - far) / (2.0 * step))
    return abs(fmean(found) / fmean(wanted) - 1.0)
