"""Pictures of a scene in which nothing moves but the power and colour of its lights:
one basis picture for each light.

Light of different lamps adds up, channel by channel, so that

    radiance = sum over lights of weight x basis picture,        weight: three colour channels, from the configuration,

where a basis picture is rendered once with one light alone, and denoised once. An
environment whose power, exposure and
tint move is one light. Where spherical harmonics are added to it, each of them is another one, beside the map itself:
the weights are those with which the basis maps come nearest to the map, by least
squares over solid angle. What is cut off below zero is why they need not meet it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

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
# what the names of inputs end in that are the light of a lamp, (3,)
LAMPS = (".intensity", ".radiance")
# relative difference up to which a map is a multiple of another one: float32 after a
# tone curve and back
SAME = 1e-3
PROBED = 64  # options of a discrete choice that are looked at, at most
TINY = 1e-30
FEW = 4  # every so many rows and columns of a map are looked at first


def light_inputs(renderer: Renderer) -> frozenset[str]:
    return frozenset(
        name
        for name in renderer.scene.names
        if name == ENVIRONMENT or name.endswith(LAMPS)
    )


def fixed_lights(renderer: Renderer) -> bool:
    """Whether a light of the scene is no input: one of a Mitsuba scene."""
    return any(
        isinstance(part, PluginPart) and part.shines
        for part in renderer.scene.made[0].parts
    )


# ---- what moves
# -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lighting:
    """What of a space is power and colour of lights, exposure, or done to the finished
    picture.
    """

    # by `control.parameter`, the inputs changed; none if the finished picture is
    groups: Mapping[str, frozenset[str]]
    harmonic: frozenset[str]  # those that add spherical harmonics to the environment
    bright: Sequence[tuple[slice, Tensor]] = ()
    """Of the others that change a map, their coordinates and what these are where it is
    brightest: a basis map must not be black in a channel.
    """

    @property
    def moved(self) -> frozenset[str]:
        return frozenset[str]().union(*self.groups.values()) - ON_PICTURE


def lighting(renderer: Renderer) -> Lighting:
    """Return which groups of coordinates change nothing but light, and the picture
    behind the renderer.

    Found by looking at the inputs of configurations, so that it holds for whatever sets
    them. A light that is no input would be in every basis picture: beside one only
    those that change the picture behind the renderer are returned.
    """
    middle = 0.5 * renderer.start + 0.25
    groups = {}
    harmonic = set()
    bright = []
    with torch.no_grad():
        here = renderer.scene.assembly(renderer.space.inputs(middle))
        for group in renderer.space.groups:
            changed: set[str] = set()
            most = -1.0
            brightest = middle
            for place in _places(group, middle):
                there = renderer.scene.assembly(renderer.space.inputs(place))
                ways = {
                    name: _change(name, here.get(name), there.get(name), group.size)
                    for name in here | there
                }
                if None in ways.values():
                    break
                if ENVIRONMENT in there and float(there[ENVIRONMENT].sum()) > most:
                    most = float(there[ENVIRONMENT].sum())
                    brightest = place
                changed |= {name for name, way in ways.items() if way}
                if ways.get(ENVIRONMENT) == "harmonics":
                    harmonic.add(group.name)
            else:
                if not changed <= ON_PICTURE and fixed_lights(renderer):
                    continue
                groups[group.name] = frozenset(changed)
                if ENVIRONMENT in changed and group.name not in harmonic:
                    bright.append((group.coordinates, brightest[group.coordinates]))
    return Lighting(groups, frozenset(harmonic & groups.keys()), tuple(bright))


def _places(group: Group, middle: Tensor) -> Iterator[Tensor]:
    values = list(BETWEEN)
    if group.options:
        values = [
            (number + 0.5) / group.options
            for number in range(0, group.options, -(-group.options // PROBED))
        ]
    numbers = [torch.full((group.size,), value) for value in values]
    if group.size > 1:
        numbers.append(
            torch.rand(group.size, generator=torch.Generator().manual_seed(0))
        )
    for chosen in numbers:
        place = middle.clone()
        place[group.coordinates] = chosen
        yield place


def _change(
    name: str, here: Tensor | None, there: Tensor | None, numbers: int
) -> str | None:
    """How so many numbers change an input: in power and colour, by spherical harmonics,
    or not at all (empty); None if in more than light.
    """
    if here is None or there is None:
        return None
    if not differs(here, there):
        return ""
    if name in ON_PICTURE or name.endswith(LAMPS):
        return "power"
    if name != ENVIRONMENT or here.shape != there.shape:
        return None
    if _explained(here[None], there):
        return "power"
    if numbers == 1:  # one number adds no harmonics of a choice
        return None
    basis = torch.cat([here[None], _harmonic_maps(here)])
    # tells most others apart in a tenth of the time
    some = basis[:, ::FEW, ::FEW], there[::FEW, ::FEW]
    return "harmonics" if _explained(*some) and _explained(basis, there) else None


def _explained(basis: Tensor, lit: Tensor) -> bool:
    both = ((basis[0] > 0.0) & (lit > 0.0)).to(torch.float32)
    span = Span(basis * both)
    left = lit * both - span.map(span.weights(lit * both))
    return float(left.norm()) <= SAME * float(lit.norm())


def _harmonic_maps(like: Tensor) -> Tensor:
    """Spherical harmonics of degrees 0 to 2, (9, H, W, 3): each lifted to at least zero
    by a multiple of the first.
    """
    basis = real_harmonics(like.shape[0], like.shape[1] - 2)
    padded = torch.cat([basis[:, -1:], basis, basis[:, :1]], dim=1).permute(2, 0, 1)
    lifted = padded - padded.amin(dim=(1, 2), keepdim=True).clamp_max(0.0)
    return (
        (lifted * float(like.mean().clamp_min(1e-12)))[..., None]
        .expand(-1, -1, -1, 3)
        .contiguous()
    )


@dataclass(frozen=True, eq=False)
class Span:
    """Basis maps of an environment (k, H, W, 3), all at least zero, and how a map is
    put together from them.
    """

    maps: Tensor

    def weights(self, lit: Tensor) -> Tensor:
        """Return (k, 3): the weights with which the maps come nearest to (H, W, 3);
        differentiable.
        """
        flat = lit.permute(2, 0, 1).reshape(3, -1, 1)
        # it is a multiple of the one map, which the brightest texel of each channel
        # tells
        if len(self.maps) == 1:
            brightest, most = self._brightest
            return (flat[..., 0].gather(1, brightest) / most.clamp_min(TINY)).T
        weights: Tensor = (self._inverse @ flat)[..., 0].T
        return weights

    def map(self, weights: Tensor) -> Tensor:
        return torch.einsum("khwc,kc->hwc", self.maps, weights)

    @cached_property
    def _brightest(self) -> tuple[Tensor, Tensor]:
        """The brightest texel of the first map in each channel (3, 1), and how bright
        it is.
        """
        flat = self.maps[0].reshape(-1, 3)
        return flat.argmax(dim=0)[:, None], flat.amax(dim=0)[:, None]

    @cached_property
    def _inverse(self) -> Tensor:
        """(3, k, H W): the pseudo-inverse of each channel, weighted by solid angle."""
        count, height, width, _ = self.maps.shape
        sine = (
            torch.sin((torch.arange(height) + 0.5) * torch.pi / height)[:, None]
            .expand(height, width)
            .reshape(-1)
        )
        columns = self.maps.permute(3, 0, 1, 2).reshape(3, count, -1).double()
        weighted = columns * sine
        inverse: Tensor = (
            torch.linalg.pinv(weighted @ columns.transpose(1, 2)) @ weighted
        )
        return inverse.float()


# ---- pictures
# -------------------------------------------------------------------------------------------------------


class Lights:
    """The lights of a scene of which some move, each as what it is alone: `alone` has
    the inputs of each, and all others are dark there. The map of the inputs that it is
    made with is the environment's first basis map.
    """

    def __init__(self, renderer: Renderer, lighting: Lighting, inputs: Inputs) -> None:
        # light that stands still here
        patterns = {name for name in renderer.scene.names if name.endswith(PATTERN)}
        every = light_inputs(renderer) | patterns
        own = {
            name: inputs[name] if name in inputs else renderer.scene.base(name)
            for name in sorted(every)
        }
        dark = {name: torch.zeros_like(value) for name, value in own.items()}
        moved = lighting.moved
        shining = {
            name
            for name, value in own.items()
            if name not in moved and bool((value > 0.0).any())
        }
        still = {
            name: value for name, value in own.items() if name in patterns | shining
        }
        self._lamps = sorted(moved & every - {ENVIRONMENT})
        lit = ENVIRONMENT in moved
        self._still = bool(still) or not (self._lamps or lit)
        self.alone: list[Inputs] = [{**dark, **still}] if self._still else []
        self.alone += [{**dark, name: torch.ones(3)} for name in self._lamps]
        self._span: Span | None = None
        if lit:
            there = own[ENVIRONMENT]
            maps = there[None]
            if lighting.harmonic:  # added where the environment is not cut off
                start = renderer.scene.assembly(renderer.space.inputs(renderer.start))[
                    ENVIRONMENT
                ]
                whole = (there > 0.0) | (
                    start <= 0.0
                    if start.shape == there.shape
                    else torch.zeros_like(there).bool()
                )
                maps = torch.cat(
                    [maps, _harmonic_maps(there) * whole.to(torch.float32)]
                )
            self._span = Span(maps)
            self.alone += [{**dark, ENVIRONMENT: basis} for basis in maps]

    def weights(self, inputs: Inputs) -> Tensor:
        """Return how much of each light there is in a configuration, (lights, 3);
        differentiable.
        """
        weights = [torch.ones(1, 3)] if self._still else []
        weights += [inputs[name].reshape(1, 3) for name in self._lamps]
        if self._span is not None:
            weights.append(self._span.weights(inputs[ENVIRONMENT]))
        return torch.cat(weights)


class BasisRenderer(Predictor):
    """Puts pictures together from one basis picture a light.

    Where base colours are searched too, each light has matrices of its own, so that
    radiance is bilinear in both: to first order in the base colours, under any light.
    Arguments as of `LinearRenderer`; what does not move is as it is at u, and `moving`
    is what moves; None looks.
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
            lit = u.detach().clone()
            for coordinates, values in moving.bright:
                lit[coordinates] = values
            self._lights = Lights(
                traced, moving, traced.scene.assembly(traced.space.inputs(lit))
            )
            linear = traced.scene.assembly(
                traced.space.inputs(u)
            ).keys() & linear_inputs(traced)
            elsewhere = {
                name for name in linear if not name.endswith(PATTERN)
            }  # projectors are in the first alone
            self._of_each: list[LinearRenderer] = []
            for number, alone in enumerate(self._lights.alone):
                noise = seeds.stream(seed, "light", number)
                names = elsewhere if number else linear
                self._of_each.append(
                    LinearRenderer(traced, u, noise, tick, names=names, light=alone)
                )
        self.non_finite = sum(light.non_finite for light in self._of_each)

    @property
    def lights(self) -> int:
        return len(self._of_each)

    @property
    def entries(self) -> int:
        return sum(light.entries for light in self._of_each)

    @property
    def bytes(self) -> int:
        return sum(light.bytes for light in self._of_each)

    def radiance(self, inputs: Inputs) -> Tensor:
        pictures = [light.radiance(inputs) for light in self._of_each]
        radiance = torch.einsum(
            "lc,lhwc->hwc", self._lights.weights(inputs), torch.stack(pictures)[..., :3]
        )
        return torch.cat([radiance, pictures[0][..., 3:]], dim=-1)


HAZE = Refusal("there is haze", RefusalCause.HAZE)


def why_not(renderer: Renderer, varying: Collection[str] = ()) -> Refusal | None:
    """Why pictures of a renderer's space cannot be predicted, in words; None if they
    can. Controls that vary stand still for each matrix, whatever they change; beside
    them light may not move.
    """
    plan = renderer.plan
    linear = linear_inputs(renderer)
    searched = [group for group in plan.groups if group.control not in varying]
    lit = {} if varying else lighting(renderer).groups
    hazes = tuple(
        f"{part.name}." for part in renderer.scene.made[0].parts if part.volumetric
    )
    for group in searched:
        if group.is_forced and group.estimator not in ("none", "image"):
            return Refusal(f"the estimator of {group.name} is forced")
        reached = renderer.routes.get(group.name, frozenset())
        of_haze = bool(reached) and all(name.startswith(hazes) for name in reached)
        if group.estimator == "image" or group.name in lit or of_haze:
            continue
        if reached & light_inputs(renderer) and fixed_lights(renderer):
            return Refusal(
                f"{group.name} changes light, and the scene has other lights of its own"
            )
        if group.estimator != "adjoint" or not reached <= linear:
            return Refusal(
                f"{group.name} changes more than base "
                f"colours{'' if varying else ' and light'}"
            )
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
    """Return what predicts the pictures of a renderer's space, made at u; arguments as
    for `LinearRenderer`.
    """
    moving = lighting(renderer)
    if moving.moved:
        return BasisRenderer(renderer, u, seed, tick, moving=moving)
    return LinearRenderer(renderer, u, seed, tick)


def lights_to_collect(renderer: Renderer) -> int:
    """The lights that a basis picture, or a matrix, is made of; 1 where no light
    moves.
    """
    moving = lighting(renderer)
    inputs = renderer.scene.assembly(renderer.space.inputs(renderer.start))
    return len(Lights(renderer, moving, inputs).alone) if moving.moved else 1


def samples_to_collect(renderer: Renderer) -> int:
    """Samples a pixel that are traced before anything can be predicted."""
    inputs = {
        name
        for group in renderer.plan.groups
        for name in renderer.routes.get(group.name, ())
    }
    matrices = len(inputs & linear_inputs(renderer))
    samples, count = passes(renderer, SPP)
    return lights_to_collect(renderer) * (
        samples * count * matrices if matrices else SPP
    )
