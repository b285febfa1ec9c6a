"""Pictures that a matrix of light transport predicts, where surfaces, textures and light are at their ends."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from advsearch.questions.stability.case import CaseGroup, Check, Outcome, holds
from advsearch.questions.stability.cases_materials import behind_glass
from advsearch.questions.stability.scene import small
from advsearch.scene import library
from advsearch.scene.assets import EnvironmentAsset, ObjectAsset
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.lights import BasisRenderer
from advsearch.scene.transport.matrix import LinearRenderer

GROUP = CaseGroup("transport")
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
    value, slope = linear.gradient(lambda picture: picture.square().mean(), u, 0, 1)
    finite = bool(torch.isfinite(change).all() and torch.isfinite(slope).all()) and linear.non_finite == 0
    size = float((after - before).square().mean().sqrt())
    error = float((change - (after - before)).square().mean().sqrt()) / size if size else float(change.abs().max())
    checks = [
        Check("error of the predicted change, as a share of it", error, most=off),
        holds("the derivative is there where the picture changes", bool(slope.any()) == (size > 0.0)),
    ]
    measured = {"entries": float(linear.entries), "rms change": size, "mean of squares": float(value)}
    return Outcome(tuple(checks), finite, error, measured=measured)


def mug(texels: np.ndarray | None = None) -> ObjectAsset:
    """The mug, with another texture where one is given, (h, w, 3)."""
    own = library.load_object("mug")
    return own if texels is None else replace(own, name="painted", base_color=texels.astype(np.float32))


def texture_of(side: int) -> Outcome:
    """A texture of side x side texels."""
    return predicted(small("mug", {"texture": {"resolution": side}}))


GROUP.case("predicted-4-texels", "Changes of a texture of 4 texels are predicted.", _LINEAR, "texture", cheap=False)(
    partial(texture_of, 2)
)
GROUP.case(
    "predicted-4096-texels", "Changes of a texture of 4,096 texels are predicted.", _LINEAR, "texture", cheap=False
)(partial(texture_of, 64))


@GROUP.case("predicted-epsilon-1", "Changes to white and black are predicted.", _LINEAR, "texture", cheap=False)
def epsilon_1() -> Outcome:
    """Every texel becomes white or black."""
    return predicted(small("mug", {"texture": {"resolution": 8, "epsilon": 1.0}}), epsilon=1.0, off=0.3)


@GROUP.case(
    "predicted-black-and-white",
    "Changes of a texture that is exactly 0 and 1 are predicted.",
    _LINEAR,
    "texture",
    cheap=False,
)
def black_and_white() -> Outcome:
    """A checked texture of texels that are exactly 0 and 1; it changes inwards alone."""
    checks = np.indices((8, 8)).sum(axis=0) % 2
    return predicted(small(mug(np.repeat(checks[:, :, None], 3, axis=2)), {"texture": {"resolution": 8}}), 0.2, off=0.3)


@GROUP.case("predicted-mirror", "Changes of a mirror's tint are predicted.", _LINEAR, "texture", cheap=False)
def mirror() -> Outcome:
    """A metal of roughness 0: its base colour is the tint of what it reflects, and much of that is the mug itself."""
    settings = {"material.roughness": 0.0, "material.metallic": 1.0}
    return predicted(small("mug", {"texture": {"resolution": 8}}, settings=settings), off=0.35)


@GROUP.case(
    "predicted-behind-glass",
    "Changes of a texture behind clear glass are predicted texel by texel.",
    _LINEAR,
    "texture",
)
def glass() -> Outcome:
    """The object behind a ball of clear glass."""
    return predicted(behind_glass({"texture": {"resolution": 32}}))


@GROUP.case("predicted-out-of-sight", "A texture that nobody sees changes nothing.", _NOTHING, "texture")
def out_of_sight() -> Outcome:
    """The object 10,000 sizes away."""
    return predicted(small("mug", {"texture": {"resolution": 8}}, settings={"pose.x": 1e4}))


@GROUP.case("predicted-without-light", "A texture that no light reaches changes nothing.", _NOTHING, "texture")
def without_light() -> Outcome:
    """A black environment."""
    night = EnvironmentAsset("night", np.zeros((16, 32, 3), np.float32))
    return predicted(small("mug", {"texture": {"resolution": 8}}, environment=night))


@GROUP.case("predicted-light-out", "A lamp that goes out is predicted, to darkness.", _LIGHT, "light")
def light_out() -> Outcome:
    """Basis pictures made while the only lamp shines, used where it does not; and likewise beside an environment."""
    night = EnvironmentAsset("night", np.zeros((16, 32, 3), np.float32))
    alone = small("mug", {"light": {"power": [0.0, 12.0]}}, environment=night)
    beside = small("mug", {"light": {"power": [0.0, 12.0]}})
    lit, out = torch.ones(1), torch.zeros(1)
    basis, dark = BasisRenderer(beside, lit, seed=1), BasisRenderer(alone, lit, seed=1)
    with torch.no_grad():
        before, after = (beside(one, seed=5, spp=TRACED) for one in (lit, out))
        change, black = basis(out) - basis(lit), dark(out)
    _, slope = dark.gradient(lambda picture: picture.square().mean(), out, 0, 1)
    error = float((change - (after - before)).norm() / (after - before).norm())
    finite = bool(torch.isfinite(change).all() and torch.isfinite(black).all() and torch.isfinite(slope).all())
    checks = [
        Check("error of the predicted change, as a share of it", error, most=OFF),
        holds("without any light the picture is black", bool((black == 0.0).all())),
    ]
    return Outcome(tuple(checks), finite, error, measured={"lights": float(basis.lights)})
