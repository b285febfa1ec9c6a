"""Pictures that a matrix of light transport, or light on surfaces, predicts, where scenes are at their ends."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from advsearch.engine.acceptance import ACCEPTED, Deviation, levels_off, view_of
from advsearch.engine.gradients import smooth_loss
from advsearch.questions.stability.light import BRIGHT, behind_glass, grey_map
from advsearch.questions.stability.scene import REFERENCE_SPP, CaseGroup, Check, ControlSettings, Outcome, holds, small
from advsearch.scene import library
from advsearch.scene.assets import EnvironmentAsset, ObjectAsset
from advsearch.scene.renderer import Renderer
from advsearch.scene.surface.renderer import SurfaceRenderer, why_not
from advsearch.scene.transport.lights import BasisRenderer
from advsearch.scene.transport.matrix import LinearRenderer

TRANSPORT = CaseGroup("transport")
TRACED = 256
"""Samples a pixel of the traced pictures, whose noise is the same before and after a change."""
OFF = 0.15
"""Root mean square error of a predicted change, as a share of the change: noise of the matrix, and light that meets the
texture twice."""
_LINEAR = "searches compare the prediction with traced pictures and make the matrix anew"
_LIGHT = "lights that are dark are rendered alone all the same; a search that is off renders"
_NOTHING = "a matrix without entries predicts the picture as it is"


def changed(renderer: Renderer, epsilon: float) -> Tensor:
    """The start with each number larger or smaller by epsilon, by chance."""
    signs = torch.randint(0, 2, renderer.start.shape, generator=torch.Generator().manual_seed(3)) * 2.0 - 1.0
    return (renderer.start + epsilon * signs).clamp(0.0, 1.0)


def predicted(renderer: Renderer, epsilon: float = 0.1, off: float = OFF) -> Outcome:
    """Compare the predicted change of a picture with the traced one, and the derivative with that of differences."""
    linear = LinearRenderer(renderer, renderer.start, seed=1)
    u = changed(renderer, epsilon)
    with torch.no_grad():
        before, after = (renderer(one, seed=5, spp=TRACED) for one in (renderer.start, u))
        change = linear(u) - linear(renderer.start)
    value, slope = linear.renderer.gradient(lambda picture: picture.square().mean(), u, 0, 1)
    finite = bool(torch.isfinite(change).all() and torch.isfinite(slope).all()) and linear.non_finite == 0
    size = float((after - before).square().mean().sqrt())
    error = float((change - (after - before)).square().mean().sqrt()) / size if size else float(change.abs().max())
    checks = [
        Check("error of the predicted change, as a share of it", error, most=off),
        holds("the derivative is there where the picture changes", bool(slope.any()) == (size > 0.0)),
    ]
    measured = {"entries": float(linear.entries), "rms change": size, "mean of squares": float(value)}
    return Outcome(*checks, finite=finite, relative_error=error, measured=measured)


def mug(texels: np.ndarray | None = None) -> ObjectAsset:
    """The mug, with another texture where one is given, (h, w, 3)."""
    own = library.load_object("mug")
    return own if texels is None else replace(own, name="painted", base_color=texels.astype(np.float32))


def texture_of(side: int) -> Outcome:
    """A texture of side x side texels."""
    return predicted(small("mug", {"texture": {"resolution": side}}))


TRANSPORT.case(
    "predicted-4-texels", _LINEAR, "texture", holds="Changes of a texture of 4 texels are predicted.", cheap=False
)(partial(texture_of, 2))
TRANSPORT.case(
    "predicted-4096-texels",
    _LINEAR,
    "texture",
    holds="Changes of a texture of 4,096 texels are predicted.",
    cheap=False,
)(partial(texture_of, 64))


@TRANSPORT.case("predicted-epsilon-1", _LINEAR, "texture", cheap=False)
def epsilon_1() -> Outcome:
    """Changes to white and black are predicted."""
    return predicted(small("mug", {"texture": {"resolution": 8, "epsilon": 1.0}}), epsilon=1.0, off=0.3)


@TRANSPORT.case("predicted-black-and-white", _LINEAR, "texture", cheap=False)
def black_and_white() -> Outcome:
    """Changes of a texture that is exactly 0 and 1 are predicted."""
    checks = np.indices((8, 8)).sum(axis=0) % 2
    return predicted(small(mug(np.repeat(checks[:, :, None], 3, axis=2)), {"texture": {"resolution": 8}}), 0.2, off=0.3)


@TRANSPORT.case("predicted-mirror", _LINEAR, "texture", cheap=False)
def mirror() -> Outcome:
    """Changes of a mirror's tint are predicted."""
    settings = {"material.roughness": 0.0, "material.metallic": 1.0}
    return predicted(small("mug", {"texture": {"resolution": 8}}, settings=settings), off=0.35)


@TRANSPORT.case("predicted-behind-glass", _LINEAR, "texture")
def glass() -> Outcome:
    """Changes of a texture behind clear glass are predicted texel by texel."""
    return predicted(behind_glass({"texture": {"resolution": 32}}))


@TRANSPORT.case("predicted-out-of-sight", _NOTHING, "texture")
def out_of_sight() -> Outcome:
    """A texture that nobody sees changes nothing."""
    return predicted(small("mug", {"texture": {"resolution": 8}}, settings={"pose.x": 1e4}))


@TRANSPORT.case("predicted-without-light", _NOTHING, "texture")
def without_light() -> Outcome:
    """A texture that no light reaches changes nothing."""
    night = EnvironmentAsset("night", np.zeros((16, 32, 3), np.float32))
    return predicted(small("mug", {"texture": {"resolution": 8}}, environment=night))


@TRANSPORT.case("predicted-light-out", _LIGHT, "light")
def light_out() -> Outcome:
    """A lamp that goes out is predicted, to darkness."""
    night = EnvironmentAsset("night", np.zeros((16, 32, 3), np.float32))
    alone = small("mug", {"light": {"power": [0.0, 12.0]}}, environment=night)
    beside = small("mug", {"light": {"power": [0.0, 12.0]}})
    lit, out = torch.ones(1), torch.zeros(1)
    basis, dark = BasisRenderer(beside, lit, seed=1), BasisRenderer(alone, lit, seed=1)
    with torch.no_grad():
        before, after = (beside(one, seed=5, spp=TRACED) for one in (lit, out))
        change, black = basis(out) - basis(lit), dark(out)
    _, slope = dark.renderer.gradient(lambda picture: picture.square().mean(), out, 0, 1)
    error = float((change - (after - before)).norm() / (after - before).norm())
    finite = bool(torch.isfinite(change).all() and torch.isfinite(black).all() and torch.isfinite(slope).all())
    checks = [
        Check("error of the predicted change, as a share of it", error, most=OFF),
        holds("without any light the picture is black", bool((black == 0.0).all())),
    ]
    return Outcome(*checks, finite=finite, relative_error=error, measured={"lights": float(basis.lights)})


SURFACE_LIGHT = CaseGroup("surface light")
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
_NO_ENTRIES = "a view that does not meet the texture has a matrix without entries"


def lit(renderer: Renderer) -> SurfaceRenderer:
    """The light on the surfaces of a scene at its start."""
    return SurfaceRenderer(renderer, renderer.start, seed=1)


def lit_picture(renderer: Renderer, levels: float = LEVELS, slope: float = SLOPE) -> Outcome:
    """Compare a predicted picture with a traced one, and its derivative by the texture with traced differences."""
    light, u = lit(renderer), renderer.start
    with torch.no_grad():
        picture = light(u)
    (off,) = levels_off(renderer, [picture], u, 3, TRACED)
    found, wanted = lit_derivatives(renderer, light, u)
    finite = bool(torch.isfinite(picture).all()) and np.isfinite(found) and light.non_finite == 0
    error = abs(found / wanted - 1.0) if wanted else abs(found)
    checks = (
        holds("the picture is in [0, 1]", bool((picture >= 0.0).all() and (picture <= 1.0).all())),
        Check("levels of 255 off", off, most=levels),
        Check("error of the derivative by the texture", error, most=slope),
    )
    return Outcome(
        *checks,
        finite=bool(finite),
        relative_error=error,
        measured={"entries": float(light.entries), "derivative": wanted},
    )


def lit_derivatives(renderer: Renderer, light: SurfaceRenderer, u: Tensor, step: float = 0.04) -> tuple[float, float]:
    """The derivative of a smooth linear loss of the raw picture as texels go inwards that raise it so, predicted and by
    traced one-sided differences of second order: a texel at a bound has no other side."""
    linear = renderer.like(transfer="linear")
    light.traced = linear
    loss = smooth_loss(linear.formation.resolution)
    slope = light.renderer.gradient(loss, u, 0, 1)[1]
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
    return lit_picture(small(mug(texels), controls), slope=slope)


SURFACE_LIGHT.case(
    "lit-grazing-view",
    _MEASURED,
    "texture, camera",
    holds="Looking along the ground, picture and derivative are right.",
)(partial(seen, {"texture": {"resolution": 8}, "camera": {"elevation": [-10.0, 10.0]}}))
SURFACE_LIGHT.case(
    "lit-camera-inside", _MEASURED, "texture, camera", holds="From inside the mug, picture and derivative are right."
)(partial(seen, {"texture": {"resolution": 8}, "camera": {"distance": [0.05, 0.2]}}, slope=INSIDE))
SURFACE_LIGHT.case("lit-4-texels", _MEASURED, "texture, camera", holds="A texture of 4 texels is predicted.")(
    partial(seen, {"texture": {"resolution": 2}, "camera": {}})
)
SURFACE_LIGHT.case(
    "lit-black-and-white", _MEASURED, "texture, camera", holds="Texels that are exactly 0 and 1 are predicted."
)(partial(seen, PAINTED, np.repeat(np.indices((8, 8)).sum(axis=0)[:, :, None] % 2, 3, axis=2)))


@SURFACE_LIGHT.case("lit-unseen-texels", "the matrix of a view has entries for what it meets alone", "texture, camera")
def lit_unseen() -> Outcome:
    """Texels that the view does not meet have a derivative of exactly 0, and no change of them is predicted."""
    renderer = small("mug", PAINTED)
    light, u = lit(renderer), renderer.start
    slope = light.renderer.gradient(lambda picture: picture.square().mean(), u, 0, 1)[1]
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
    return Outcome(*checks, finite=bool(torch.isfinite(slope).all()), measured={"rms": rms})


@SURFACE_LIGHT.case("lit-map-half-black", _MEASURED, "texture, camera")
def half_black() -> Outcome:
    """Half of the map is black, the other white."""
    radiance = grey_map(0.0).radiance.copy()
    radiance[:, :16] = 1.0
    return lit_picture(small("mug", PAINTED, environment=EnvironmentAsset("half", radiance)), 1.5 * LEVELS)


@SURFACE_LIGHT.case("lit-map-white", _MEASURED, "texture, camera")
def white_map() -> Outcome:
    """The map is white everywhere."""
    return lit_picture(small("mug", PAINTED, environment=grey_map(1.0)))


@SURFACE_LIGHT.case("lit-map-black", "no light has nothing to add", "texture")
def black_map() -> Outcome:
    """The picture is black, the derivative 0."""
    renderer = small("mug", PAINTED, environment=grey_map(0.0))
    light = lit(renderer)
    value, slope = light.renderer.gradient(lambda picture: picture.sum(), renderer.start, 0, 1)
    checks = (
        Check("sum of the picture", float(value), 0.0, 1e-6),
        Check("largest derivative", float((slope * textured(renderer)).abs().max()), 0.0, 0.0),
    )
    return Outcome(*checks, finite=bool(torch.isfinite(slope).all()))


@SURFACE_LIGHT.case("lit-sun", "rays of their own towards what is hot, spread over its texels", "texture, camera")
def sun() -> Outcome:
    """A sun of one texel, 300,000 times as bright as the sky, casts the shadow that is traced."""
    return lit_picture(small("mug", PAINTED, environment=grey_map(0.3, BRIGHT)), 1.5 * LEVELS)


@SURFACE_LIGHT.case("lit-out-of-sight", _NO_ENTRIES, "texture, camera")
def lit_out_of_sight() -> Outcome:
    """A texture out of sight changes nothing."""
    renderer = small("mug", PAINTED, settings={"pose.x": 1e4})
    light = lit(renderer)
    with torch.no_grad():
        (off,) = levels_off(renderer, [light(renderer.start)], renderer.start, 3, TRACED)
    slope = light.renderer.gradient(lambda picture: picture.sum(), renderer.start, 0, 1)[1] * textured(renderer)
    checks = (
        Check("levels of 255 off", off, most=LEVELS),
        Check("largest derivative", float(slope.abs().max()), 0.0, 0.0),
    )
    return Outcome(*checks, finite=bool(torch.isfinite(slope).all()))


@SURFACE_LIGHT.case("lit-mirror", _MEASURED, "camera", cheap=False)
def lit_mirror() -> Outcome:
    """A mirror is too far off, and the comparison says so."""
    taken = []
    for given in ({"material.roughness": 0.0, "material.metallic": 1.0}, {}):
        renderer = small("mug", PAINTED, settings=given, denoise="oidn")
        with torch.no_grad():
            picture = lit(renderer)(renderer.start)
        view = view_of(renderer, picture, renderer.start, 3, 8, lambda *at: 0.0)
        taken.append(Deviation.of([view]).share / ACCEPTED)
    checks = (
        Check("of a mirror, levels off as a share of what is accepted", taken[0], least=1.5),
        Check("of the mug as it is", taken[1], most=1.0),
    )
    return Outcome(*checks, ending="refused")


@SURFACE_LIGHT.case("lit-behind-glass", _REFUSED, "camera")
def lit_glass() -> Outcome:
    """An object behind clear glass is refused in words."""
    reason = why_not(behind_glass(PAINTED), ["camera"])
    without = why_not(small("mug", PAINTED, denoise="oidn"), ["camera"])
    checks = (
        holds("it says that there is more in the scene", reason is not None and "more in the scene" in reason),
        holds("without the glass it is not refused", without is None),
    )
    return Outcome(*checks, ending="refused")
