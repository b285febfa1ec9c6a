"""Predict images of a scene in which only its lights change, by a basis image for each.

Light of different lamps adds up, channel by channel, so that

    radiance = sum over lights of weight x basis image

    weight: three color channels, from the configuration

where a basis image is rendered once with one light alone, and denoised once. An
environment whose power, exposure and tint change is one light. Where spherical
harmonics are added to it, each of them is another one, next to the map itself: the
weights are those with which the basis maps come nearest to the map, by least squares
over solid angle. They need not meet it, since it is cut off at zero.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.scene.assembly import ON_PICTURE
from advsearch.scene.geometry import real_harmonics
from advsearch.scene.gradients import Group
from advsearch.scene.parts import PATTERN, PluginPart
from advsearch.scene.predictor import (
    BETWEEN,
    NOISE,
    Predictor,
    Refusal,
    RefusalCause,
    differs,
)
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.matrix import (
    SPP,
    Inputs,
    LinearRenderer,
    Tick,
    linear_inputs,
    passes,
    untold,
)

ENVIRONMENT = "environment.padded"
# ends of names of inputs that are the light of a lamp, (3,)
LAMPS = (".intensity", ".radiance")
# largest relative difference between a map and a multiple of another one: float32
# through a tone curve and back
SAME = 1e-3
PROBED = 64  # largest number of options of a discrete choice that are compared
TINY = 1e-30
FEW = 4  # step in rows and columns of a map for a first comparison


def light_inputs(renderer: Renderer) -> frozenset[str]:
    """Return the names of a scene's inputs that are light."""
    return frozenset(
        name
        for name in renderer.scene.names
        if name == ENVIRONMENT or name.endswith(LAMPS)
    )


def fixed_lights(renderer: Renderer) -> bool:
    """Return whether a light of the scene is no input: one of a Mitsuba scene."""
    return any(
        isinstance(part, PluginPart) and part.shines
        for part in renderer.scene.made[0].parts
    )


# ---- what changes


@dataclass(frozen=True)
class Lighting:
    """Which groups of a space change only light, exposure or the finished image."""

    # by `control.parameter`, the inputs changed; none if it changes the finished image
    groups: Mapping[str, frozenset[str]]
    harmonic: frozenset[str]  # groups that add spherical harmonics to the environment
    # of the others that change a map, their coordinates and the values where it is
    # brightest: a basis map must not be black in a channel
    bright: Sequence[tuple[slice, Tensor]] = ()

    @property
    def moved(self) -> frozenset[str]:
        """The scene's inputs that change."""
        return frozenset[str]().union(*self.groups.values()) - ON_PICTURE


def lighting(renderer: Renderer) -> Lighting:
    """Find the groups of coordinates that change nothing but light and finished images.

    The inputs of configurations are compared, so that it holds for whatever sets them.
    A light that is no input would be in every basis image: if there is one, only groups
    that change the finished image are returned.
    """
    middle = 0.5 * renderer.start + 0.25
    groups = {}
    harmonic = set()
    bright = []
    with torch.no_grad():
        base_inputs = renderer.scene.assembly(renderer.space.inputs(middle))
        for group in renderer.space.groups:
            effect = _measure_effect(renderer, group, middle, base_inputs)
            if effect is None:
                continue
            if not effect.changed <= ON_PICTURE and fixed_lights(renderer):
                continue
            groups[group.name] = effect.changed
            if effect.is_harmonic:
                harmonic.add(group.name)
            elif ENVIRONMENT in effect.changed:
                brightest = effect.brightest[group.coordinates]
                bright.append((group.coordinates, brightest))
    return Lighting(groups, frozenset(harmonic), tuple(bright))


class _Effect(NamedTuple):
    """What a group of coordinates changes, if that is light or the finished image."""

    changed: frozenset[str]  # inputs
    is_harmonic: bool  # it adds spherical harmonics to the environment
    brightest: Tensor  # (d,) configuration with the brightest environment


def _measure_effect(
    renderer: Renderer, group: Group, middle: Tensor, base_inputs: Inputs
) -> _Effect | None:
    """Return what a group changes; None if that is more than light.

    `base_inputs` are those of the configuration `middle`, with which others are
    compared.
    """
    changed: set[str] = set()
    is_harmonic = False
    max_power = -1.0
    brightest = middle
    for configuration in _sample_configurations(group, middle):
        inputs = renderer.scene.assembly(renderer.space.inputs(configuration))
        for name in base_inputs.keys() | inputs.keys():
            change = _find_change(
                name, base_inputs.get(name), inputs.get(name), group.size
            )
            if change is _Change.OTHER:
                return None
            if change is not _Change.NONE:
                changed.add(name)
            if name == ENVIRONMENT and change is _Change.HARMONICS:
                is_harmonic = True
        if ENVIRONMENT in inputs:
            power = float(inputs[ENVIRONMENT].sum())
            if power > max_power:
                max_power = power
                brightest = configuration
    return _Effect(frozenset(changed), is_harmonic, brightest)


def _sample_configurations(group: Group, middle: Tensor) -> Iterator[Tensor]:
    """Yield configurations in which a group has several values, and others `middle`'s."""
    fractions = list(BETWEEN)
    if group.options:
        step = -(-group.options // PROBED)
        options = range(0, group.options, step)
        fractions = [(option + 0.5) / group.options for option in options]
    values = [torch.full((group.size,), fraction) for fraction in fractions]
    if group.size > 1:
        generator = torch.Generator().manual_seed(0)
        values.append(torch.rand(group.size, generator=generator))
    for group_values in values:
        configuration = middle.clone()
        configuration[group.coordinates] = group_values
        yield configuration


class _Change(Enum):
    """How an input changes."""

    NONE = "not at all"
    POWER = "in power and color"
    HARMONICS = "by spherical harmonics"
    OTHER = "in more than light"


def _find_change(
    name: str, before: Tensor | None, after: Tensor | None, n_coordinates: int
) -> _Change:
    """Return how a group of coordinates changes an input."""
    if before is None or after is None:
        return _Change.OTHER
    if not differs(before, after):
        return _Change.NONE
    if name in ON_PICTURE or name.endswith(LAMPS):
        return _Change.POWER
    if name != ENVIRONMENT or before.shape != after.shape:
        return _Change.OTHER
    if _is_explained(before[None], after):
        return _Change.POWER
    if n_coordinates == 1:  # one number adds no harmonics of a choice
        return _Change.OTHER
    basis = torch.cat([before[None], _harmonic_maps(before)])
    # rejects most other changes in a tenth of the time
    if not _is_explained(basis[:, ::FEW, ::FEW], after[::FEW, ::FEW]):
        return _Change.OTHER
    return _Change.HARMONICS if _is_explained(basis, after) else _Change.OTHER


def _is_explained(basis: Tensor, target: Tensor) -> bool:
    """Return whether a map is a sum of basis maps, where it and the first are lit."""
    is_lit = ((basis[0] > 0.0) & (target > 0.0)).to(torch.float32)
    span = Span(basis * is_lit)
    residual = target * is_lit - span.map(span.weights(target * is_lit))
    return float(residual.norm()) <= SAME * float(target.norm())


def _harmonic_maps(like: Tensor) -> Tensor:
    """Return spherical harmonics of degrees 0 to 2 as maps (9, H, W, 3).

    Each is lifted to at least zero by a multiple of the first. Size and mean are those
    of the map `like`.
    """
    basis = real_harmonics(like.shape[0], like.shape[1] - 2)
    padded = torch.cat([basis[:, -1:], basis, basis[:, :1]], dim=1).permute(2, 0, 1)
    lifted = padded - padded.amin(dim=(1, 2), keepdim=True).clamp_max(0.0)
    scaled = lifted * float(like.mean().clamp_min(1e-12))
    return scaled[..., None].expand(-1, -1, -1, 3).contiguous()


@dataclass(frozen=True, eq=False)
class Span:
    """Basis maps of an environment, and how a map is composed of them."""

    maps: Tensor  # (k, H, W, 3), all at least zero

    def weights(self, lit: Tensor) -> Tensor:
        """Return the weights (k, 3) with which the maps come nearest to a map.

        That is (H, W, 3); the weights are differentiable.
        """
        flat = lit.permute(2, 0, 1).reshape(3, -1, 1)
        # It is a multiple of the only map, and the brightest texel of each channel has
        # the factor.
        if len(self.maps) == 1:
            texel, brightness = self._brightest
            return (flat[..., 0].gather(1, texel) / brightness.clamp_min(TINY)).T
        weights: Tensor = (self._inverse @ flat)[..., 0].T
        return weights

    def map(self, weights: Tensor) -> Tensor:
        """Return the map (H, W, 3) with given weights (k, 3)."""
        return torch.einsum("khwc,kc->hwc", self.maps, weights)

    @cached_property
    def _brightest(self) -> tuple[Tensor, Tensor]:
        """The brightest texel of the first map in each channel (3, 1), and its value."""
        flat = self.maps[0].reshape(-1, 3)
        return flat.argmax(dim=0)[:, None], flat.amax(dim=0)[:, None]

    @cached_property
    def _inverse(self) -> Tensor:
        """(3, k, H W): the pseudo-inverse of each channel, weighted by solid angle."""
        count, height, width, _ = self.maps.shape
        polar = (torch.arange(height) + 0.5) * torch.pi / height
        sine = torch.sin(polar)[:, None].expand(height, width).reshape(-1)
        columns = self.maps.permute(3, 0, 1, 2).reshape(3, count, -1).double()
        weighted = columns * sine
        gram = weighted @ columns.transpose(1, 2)
        inverse: Tensor = torch.linalg.pinv(gram) @ weighted
        return inverse.float()


# ---- images


class Lights:
    """The lights of a scene of which some change, each separately.

    Args:
        renderer: of the scene.
        lighting: what changes.
        inputs: scene inputs whose map is the environment's first basis map.

    Attributes:
        alone: the inputs of each light, in which all others are dark.
    """

    def __init__(self, renderer: Renderer, lighting: Lighting, inputs: Inputs) -> None:
        patterns = {name for name in renderer.scene.names if name.endswith(PATTERN)}
        names = light_inputs(renderer) | patterns
        values = {
            name: inputs[name] if name in inputs else renderer.scene.base(name)
            for name in sorted(names)
        }
        dark = {name: torch.zeros_like(value) for name, value in values.items()}
        moved = lighting.moved
        # light that does not change
        still = {
            name: value
            for name, value in values.items()
            if name in patterns or (name not in moved and bool((value > 0.0).any()))
        }
        self._lamps = sorted(moved & names - {ENVIRONMENT})
        changes_environment = ENVIRONMENT in moved
        self._still = bool(still) or not (self._lamps or changes_environment)
        self.alone: list[Inputs] = [{**dark, **still}] if self._still else []
        self.alone += [{**dark, name: torch.ones(3)} for name in self._lamps]
        self._span: Span | None = None
        if changes_environment:
            maps = _basis_maps(renderer, lighting, values[ENVIRONMENT])
            self._span = Span(maps)
            self.alone += [{**dark, ENVIRONMENT: basis} for basis in maps]

    def weights(self, inputs: Inputs) -> Tensor:
        """Return the weight (lights, 3) of each light in scene inputs; differentiable."""
        weights = [torch.ones(1, 3)] if self._still else []
        weights += [inputs[name].reshape(1, 3) for name in self._lamps]
        if self._span is not None:
            weights.append(self._span.weights(inputs[ENVIRONMENT]))
        return torch.cat(weights)


def _basis_maps(renderer: Renderer, lighting: Lighting, first: Tensor) -> Tensor:
    """Return the environment's basis maps (k, H, W, 3), of which one is given."""
    if not lighting.harmonic:
        return first[None]
    start_inputs = renderer.scene.assembly(renderer.space.inputs(renderer.start))
    start = start_inputs[ENVIRONMENT]
    # harmonics are added where the environment is not cut off at zero
    is_added = first > 0.0
    if start.shape == first.shape:
        is_added = is_added | (start <= 0.0)
    harmonics = _harmonic_maps(first) * is_added.to(torch.float32)
    return torch.cat([first[None], harmonics])


class BasisRenderer(Predictor):
    """Compose images of one basis image for each light.

    Where base colors are searched too, each light has matrices of its own, so that
    radiance is bilinear in both: to first order in the base colors, under any light.

    Args:
        traced, seed, tick: as for `LinearRenderer`.
        u: (d,) configuration; what does not change is as it is there.
        moving: what changes; None finds it.
    """

    def __init__(
        self,
        traced: Renderer,
        u: Tensor,
        seed: int,
        tick: Tick = untold,
        *,
        moving: Lighting | None = None,
    ) -> None:
        super().__init__(traced)
        with torch.no_grad():
            moving = moving or lighting(traced)
            # with as much light of the environment as there can be
            brightest = u.detach().clone()
            for coordinates, values in moving.bright:
                brightest[coordinates] = values
            inputs = traced.scene.assembly(traced.space.inputs(brightest))
            self._lights = Lights(traced, moving, inputs)
            set_inputs = traced.scene.assembly(traced.space.inputs(u)).keys()
            linear = set_inputs & linear_inputs(traced)
            # projectors are in the first light alone
            base_colors = {name for name in linear if not name.endswith(PATTERN)}
            self._renderers: list[LinearRenderer] = []
            for index, light_inputs in enumerate(self._lights.alone):
                noise_seed = seeds.stream(seed, "light", index)
                self._renderers.append(
                    LinearRenderer(
                        traced,
                        u,
                        noise_seed,
                        tick,
                        names=base_colors if index else linear,
                        light=light_inputs,
                    )
                )
        self.non_finite = sum(renderer.non_finite for renderer in self._renderers)

    @property
    def lights(self) -> int:
        return len(self._renderers)

    @property
    def entries(self) -> int:
        return sum(renderer.entries for renderer in self._renderers)

    @property
    def bytes(self) -> int:
        return sum(renderer.bytes for renderer in self._renderers)

    def radiance(self, inputs: Inputs) -> Tensor:
        images = [renderer.radiance(inputs) for renderer in self._renderers]
        weights = self._lights.weights(inputs)
        basis = torch.stack(images)[..., :3]
        radiance = torch.einsum("lc,lhwc->hwc", weights, basis)
        return torch.cat([radiance, images[0][..., 3:]], dim=-1)


HAZE = Refusal("there is haze", RefusalCause.HAZE)


def why_not(renderer: Renderer, varying: Collection[str] = ()) -> Refusal | None:
    """Return why images of a space cannot be predicted; None if they can.

    Args:
        renderer: of the space.
        varying: names of controls that vary. They are fixed for each matrix, whatever
            they change; if there are any, light may not change.
    """
    linear = linear_inputs(renderer)
    searched = [group for group in renderer.plan.groups if group.control not in varying]
    lit = {} if varying else lighting(renderer).groups
    parts = renderer.scene.made[0].parts
    haze_prefixes = tuple(f"{part.name}." for part in parts if part.volumetric)
    for group in searched:
        if group.is_forced and group.estimator not in ("none", "image"):
            return Refusal(f"the estimator of {group.name} is forced")
        reached = renderer.routes.get(group.name, frozenset())
        is_haze = bool(reached) and all(
            name.startswith(haze_prefixes) for name in reached
        )
        if group.estimator == "image" or group.name in lit or is_haze:
            continue
        if reached & light_inputs(renderer) and fixed_lights(renderer):
            return Refusal(
                f"{group.name} changes light, and the scene has other lights of its own"
            )
        if group.estimator != "adjoint" or not reached <= linear:
            allowed = "base colours" if varying else "base colours and light"
            return Refusal(f"{group.name} changes more than {allowed}")
    if not any(
        renderer.routes.get(group.name) or lit.get(group.name) for group in searched
    ):
        return Refusal("nothing that is searched needs a render to be differentiated")
    if renderer.scene.volumetric and not all(group.name in lit for group in searched):
        return HAZE
    return None if renderer.formation.denoiser == "oidn" else NOISE


def predicting(
    renderer: Renderer, u: Tensor, seed: int, tick: Tick = untold
) -> Predictor:
    """Make what predicts the images of a renderer's space, at u.

    Arguments as for `LinearRenderer`.
    """
    moving = lighting(renderer)
    if moving.moved:
        return BasisRenderer(renderer, u, seed, tick, moving=moving)
    return LinearRenderer(renderer, u, seed, tick)


def lights_to_collect(renderer: Renderer) -> int:
    """Return the number of lights that have a basis image; 1 where no light changes."""
    moving = lighting(renderer)
    if not moving.moved:
        return 1
    inputs = renderer.scene.assembly(renderer.space.inputs(renderer.start))
    return len(Lights(renderer, moving, inputs).alone)


def samples_to_collect(renderer: Renderer) -> int:
    """Return the samples per pixel that are traced before anything can be predicted."""
    inputs: set[str] = set()
    for group in renderer.plan.groups:
        inputs |= renderer.routes.get(group.name, frozenset())
    n_matrices = len(inputs & linear_inputs(renderer))
    samples, n_passes = passes(renderer, SPP)
    per_light = samples * n_passes * n_matrices if n_matrices else SPP
    return lights_to_collect(renderer) * per_light
