"""Pictures that light on surfaces predicts, where views, textures and light are at their ends, and where it refuses."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from torch import Tensor

from advsearch.engine.gradients import smooth_loss
from advsearch.engine.surface_light import CHECK_SPP, levels_off
from advsearch.engine.transport import BOUND
from advsearch.questions.stability.case import CaseGroup, Check, Outcome, holds
from advsearch.questions.stability.cases_materials import behind_glass
from advsearch.questions.stability.cases_radiometric import BRIGHT, grey_map
from advsearch.questions.stability.cases_transport import TRACED, mug
from advsearch.questions.stability.scene import REFERENCE_SPP, ControlSettings, small
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.renderer import Renderer
from advsearch.scene.surface.renderer import SurfaceRenderer, why_not

GROUP = CaseGroup("surface light")
LEVELS = 4.0
"""Levels of 255 by which a predicted picture may be off, root mean square. Most of that are edges: four rays a
pixel see them, and the pictures are 24 pixels wide."""
SLOPE = 0.15
"""Relative error of a predicted derivative: light that meets the texture twice is left out of it."""
INSIDE = 0.4
"""The same from inside of the mug, where much of the light has met the texture before."""
PAINTED: ControlSettings = {"texture": {"resolution": 8}, "camera": {}}
_MEASURED = "searches compare predicted pictures with traced ones, and trace where they are too far off"
_REFUSED = "refused before anything is predicted"
_NOTHING = "a view that does not meet the texture has a matrix without entries"


def lit(renderer: Renderer) -> SurfaceRenderer:
    """The light on the surfaces of a scene at its start."""
    return SurfaceRenderer(renderer, renderer.start, seed=1)


def predicted(renderer: Renderer, levels: float = LEVELS, slope: float = SLOPE) -> Outcome:
    """Compare a predicted picture with a traced one, and its derivative by the texture with traced differences."""
    light, u = lit(renderer), renderer.start
    with torch.no_grad():
        picture = light(u)
    (off,) = levels_off(renderer, [picture], u, 3, TRACED)
    found, wanted = derivatives(renderer, light, u)
    finite = bool(torch.isfinite(picture).all()) and np.isfinite(found) and light.non_finite == 0
    error = abs(found / wanted - 1.0) if wanted else abs(found)
    checks = (
        holds("the picture is in [0, 1]", bool((picture >= 0.0).all() and (picture <= 1.0).all())),
        Check("levels of 255 off", off, most=levels),
        Check("error of the derivative by the texture", error, most=slope),
    )
    return Outcome(checks, bool(finite), error, measured={"entries": float(light.entries), "derivative": wanted})


def derivatives(renderer: Renderer, light: SurfaceRenderer, u: Tensor, step: float = 0.04) -> tuple[float, float]:
    """The derivative of a smooth linear loss of the raw picture as texels go inwards that raise it so, predicted and by
    traced one-sided differences of second order: a texel at a bound has no other side."""
    linear = renderer.like(transfer="linear")
    light.formation = linear.formation
    loss = smooth_loss(linear.formation.resolution)
    slope = light.gradient(loss, u, 0, 1)[1]
    inwards = torch.where(u > 0.5, -1.0, 1.0) * (slope * (0.5 - u) > 0.0) * textured(renderer)
    with torch.no_grad():
        near, middle, far = (float(loss(linear(u + k * step * inwards, 5, 4 * REFERENCE_SPP))) for k in range(3))
    return float(slope @ inwards), (4.0 * middle - 3.0 * near - far) / (2.0 * step)


def textured(renderer: Renderer) -> Tensor:
    """(d,) 1 for the numbers of the texture, 0 for others."""
    found = torch.zeros(len(renderer.start))
    for group in renderer.space.groups:
        found[group.coordinates] = float(group.control == "texture")
    return found


def seen(controls: ControlSettings, texels: np.ndarray | None = None, slope: float = SLOPE) -> Outcome:
    """The mug from some camera, with another texture where one is given."""
    return predicted(small(mug(texels), controls), slope=slope)


GROUP.case(
    "lit-grazing-view", "Looking along the ground, picture and derivative are right.", _MEASURED, "texture, camera"
)(partial(seen, {"texture": {"resolution": 8}, "camera": {"elevation": [-10.0, 10.0]}}))
GROUP.case(
    "lit-camera-inside",
    "From inside the mug, picture and derivative are right.",
    _MEASURED,
    "texture, camera",
)(partial(seen, {"texture": {"resolution": 8}, "camera": {"distance": [0.05, 0.2]}}, slope=INSIDE))
GROUP.case("lit-4-texels", "A texture of 4 texels is predicted.", _MEASURED, "texture, camera")(
    partial(seen, {"texture": {"resolution": 2}, "camera": {}})
)
GROUP.case("lit-black-and-white", "Texels that are exactly 0 and 1 are predicted.", _MEASURED, "texture, camera")(
    partial(seen, PAINTED, np.repeat(np.indices((8, 8)).sum(axis=0)[:, :, None] % 2, 3, axis=2))
)


@GROUP.case(
    "lit-unseen-texels",
    "Texels that the view does not meet have a derivative of exactly 0, and no change of them is predicted.",
    "the matrix of a view has entries for what it meets alone",
    "texture, camera",
)
def unseen() -> Outcome:
    """Texels on the far side become black; a traced picture changes by what they reflect and no more."""
    renderer = small("mug", PAINTED)
    light, u = lit(renderer), renderer.start
    slope = light.gradient(lambda picture: picture.square().mean(), u, 0, 1)[1]
    hidden = textured(renderer) * (slope == 0.0)
    other = u * (1.0 - hidden)
    with torch.no_grad():
        apart = float((light(other) - light(u)).abs().max())
        moved = renderer(other, 5, TRACED) - renderer(u, 5, TRACED)
    rms = 255.0 * float(moved.square().mean().sqrt())
    checks = (
        Check("numbers of texels that are not seen", float(hidden.sum()), 1.0, float(textured(renderer).sum()) - 1.0),
        Check("largest predicted change where they become black", apart, 0.0, 0.0),
        Check("levels by which a traced picture changes", rms, most=LEVELS),
    )
    return Outcome(checks, bool(torch.isfinite(slope).all()), measured={"rms": rms})


@GROUP.case("lit-map-half-black", "Half of the map is black, the other white.", _MEASURED, "texture, camera")
def half_black() -> Outcome:
    """Light from one side alone: shadows have no light of their own."""
    radiance = grey_map(0.0).radiance.copy()
    radiance[:, :16] = 1.0
    return predicted(small("mug", PAINTED, environment=EnvironmentAsset("half", radiance)), 1.5 * LEVELS)


@GROUP.case("lit-map-white", "The map is white everywhere.", _MEASURED, "texture, camera")
def white_map() -> Outcome:
    """No direction differs from another."""
    return predicted(small("mug", PAINTED, environment=grey_map(1.0)))


@GROUP.case("lit-map-black", "The picture is black, the derivative 0.", "no light has nothing to add", "texture")
def black_map() -> Outcome:
    """Nothing shines."""
    renderer = small("mug", PAINTED, environment=grey_map(0.0))
    light = lit(renderer)
    value, slope = light.gradient(lambda picture: picture.sum(), renderer.start, 0, 1)
    checks = (
        Check("sum of the picture", float(value), 0.0, 1e-6),
        Check("largest derivative", float((slope * textured(renderer)).abs().max()), 0.0, 0.0),
    )
    return Outcome(checks, bool(torch.isfinite(slope).all()))


@GROUP.case(
    "lit-sun",
    "A sun of one texel, 300,000 times as bright as the sky, casts the shadow that is traced.",
    "rays of their own towards what is hot, spread over its texels",
    "texture, camera",
)
def sun() -> Outcome:
    """The picture would be off by 7 levels if the sun were a point."""
    return predicted(small("mug", PAINTED, environment=grey_map(0.3, BRIGHT)), 1.5 * LEVELS)


@GROUP.case("lit-out-of-sight", "A texture out of sight changes nothing.", _NOTHING, "texture, camera")
def out_of_sight() -> Outcome:
    """The object 10,000 sizes away."""
    renderer = small("mug", PAINTED, settings={"pose.x": 1e4})
    light = lit(renderer)
    with torch.no_grad():
        (off,) = levels_off(renderer, [light(renderer.start)], renderer.start, 3, TRACED)
    slope = light.gradient(lambda picture: picture.sum(), renderer.start, 0, 1)[1] * textured(renderer)
    checks = (
        Check("levels of 255 off", off, most=LEVELS),
        Check("largest derivative", float(slope.abs().max()), 0.0, 0.0),
    )
    return Outcome(checks, bool(torch.isfinite(slope).all()))


@GROUP.case("lit-mirror", "A mirror is too far off, and the comparison says so.", _MEASURED, "camera", cheap=False)
def mirror() -> Outcome:
    """A metal of roughness 0 is taken for a diffuse surface of its colour; one that is not a mirror is accepted."""
    taken = []
    for given in ({"material.roughness": 0.0, "material.metallic": 1.0}, {}):
        renderer = small("mug", PAINTED, settings=given, denoise="oidn")
        with torch.no_grad():
            pictures = lit(renderer)(renderer.start), renderer(renderer.start, 7, 8)
        off, rendered = levels_off(renderer, pictures, renderer.start, 3, CHECK_SPP)
        taken.append(off / max(BOUND, rendered))
    checks = (
        Check("of a mirror, levels off as a share of what is accepted", taken[0], least=1.5),
        Check("of the mug as it is", taken[1], most=1.0),
    )
    return Outcome(checks, ending="refused")


@GROUP.case("lit-behind-glass", "An object behind clear glass is refused in words.", _REFUSED, "camera")
def glass() -> Outcome:
    """Nothing in the method follows light through a surface."""
    reason = why_not(behind_glass(PAINTED), ["camera"])
    without = why_not(small("mug", PAINTED, denoise="oidn"), ["camera"])
    checks = (
        holds("it says that there is more in the scene", reason is not None and "more in the scene" in reason),
        holds("without the glass it is not refused", without is None),
    )
    return Outcome(checks, ending="refused")
