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
from advsearch.scene.assembly import IMAGE_INPUTS
from advsearch.scene.geometry import compute_real_harmonics
from advsearch.scene.gradients import Group
from advsearch.scene.parts import PATTERN_SUFFIX, PluginPart
from advsearch.scene.predictor import (
    NOISE,
    PROBE_FRACTIONS,
    Predictor,
    Refusal,
    RefusalCause,
    inputs_differ,
)
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.matrix import (
    COLLECTED_SPP,
    Inputs,
    LinearRenderer,
    ProgressCallback,
    find_linear_inputs,
    ignore_progress,
    plan_passes,
)

ENVIRONMENT_INPUT = "environment.padded"
# ends of names of inputs that are the light of a lamp, (3,)
LAMP_SUFFIXES = (".intensity", ".radiance")
# largest relative difference between a map and a multiple of another one: float32
# through a tone curve and back
MAX_RELATIVE_DIFFERENCE = 1e-3
MAX_OPTIONS = 64  # largest number of options of a discrete choice that are compared
TINY = 1e-30
COARSE_STEP = 4  # step in rows and columns of a map for a first comparison


def find_light_inputs(renderer: Renderer) -> frozenset[str]:
    """Return the names of a scene's inputs that are light."""
    return frozenset(
        name
        for name in renderer.scene.input_names
        if name == ENVIRONMENT_INPUT or name.endswith(LAMP_SUFFIXES)
    )


def has_fixed_lights(renderer: Renderer) -> bool:
    """Return whether a light of the scene is no input: one of a Mitsuba scene."""
    return any(
        isinstance(part, PluginPart) and part.emits_light
        for part in renderer.scene.definition[0].parts
    )


# ---- what changes


@dataclass(frozen=True)
class Lighting:
    """Which groups of a space change only light, exposure or the finished image."""

    # The inputs that each group changes, by its name `control.parameter`; none if it
    # changes the finished image.
    groups: Mapping[str, frozenset[str]]
    harmonic_groups: frozenset[
        str
    ]  # groups that add spherical harmonics to the environment
    # Brightest values of the others that change a map, their coordinates and the values
    # where it is brightest: a basis map must not be black in a channel.
    brightest_values: Sequence[tuple[slice, Tensor]] = ()

    @property
    def changed_inputs(self) -> frozenset[str]:
        """The scene's inputs that change."""
        return frozenset[str]().union(*self.groups.values()) - IMAGE_INPUTS


def find_lighting(renderer: Renderer) -> Lighting:
    """Find the groups of coordinates that change only light and the finished image.

    Each group is varied alone, and the scene inputs are compared. So the result does
    not depend on which kind of control sets them.

    Some lights of a Mitsuba scene are no inputs. They cannot be switched off, and would
    be counted again in the image of every light that is traced by itself. In a scene
    with such lights, only groups that change nothing but the finished image are
    returned.
    """
    # Other groups stay half way between the start and the center of the unit cube:
    # there a value is rarely at a border, where a change may have no effect.
    reference = 0.5 * renderer.start + 0.25
    groups = {}
    harmonic_groups = set()
    brightest_values = []
    with torch.no_grad():
        base_inputs = renderer.scene.assembly(renderer.space.inputs(reference))
        for group in renderer.space.groups:
            effect = _measure_effect(renderer, group, reference, base_inputs)
            if effect is None:  # the group changes more than light
                continue
            changes_light = not effect.changed <= IMAGE_INPUTS
            if changes_light and has_fixed_lights(renderer):
                continue
            groups[group.name] = effect.changed
            if effect.is_harmonic:
                harmonic_groups.add(group.name)
            elif ENVIRONMENT_INPUT in effect.changed:
                brightest = effect.brightest[group.coordinates]
                brightest_values.append((group.coordinates, brightest))
    return Lighting(groups, frozenset(harmonic_groups), tuple(brightest_values))


class _Effect(NamedTuple):
    """What a group of coordinates changes, if that is light or the finished image."""

    changed: frozenset[str]  # inputs
    is_harmonic: bool  # it adds spherical harmonics to the environment
    brightest: Tensor  # (d,) configuration with the brightest environment


def _measure_effect(
    renderer: Renderer, group: Group, reference: Tensor, base_inputs: Inputs
) -> _Effect | None:
    """Return what a group of coordinates changes; None if that is more than light.

    Several configurations, which differ from `reference` in this group alone, are
    compared with `base_inputs`, the scene inputs at `reference`. The effect names the
    inputs that change; its brightest configuration is that whose environment has most
    light.
    """
    changed: set[str] = set()
    is_harmonic = False
    max_power = -1.0  # below that of any environment
    brightest = reference
    for configuration in _sample_configurations(group, reference):
        inputs = renderer.scene.assembly(renderer.space.inputs(configuration))
        for name in base_inputs.keys() | inputs.keys():
            change = _find_change(
                name, base_inputs.get(name), inputs.get(name), group.size
            )
            if change is _Change.OTHER:
                return None
            if change is not _Change.NONE:
                changed.add(name)
            if name == ENVIRONMENT_INPUT and change is _Change.HARMONICS:
                is_harmonic = True
        if ENVIRONMENT_INPUT in inputs:
            power = float(inputs[ENVIRONMENT_INPUT].sum())
            if power > max_power:
                max_power = power
                brightest = configuration
    return _Effect(frozenset(changed), is_harmonic, brightest)


def _sample_configurations(group: Group, reference: Tensor) -> Iterator[Tensor]:
    """Yield copies of a configuration in which one group has other values.

    All coordinates of the group have the same value, one of a few fractions of the
    range. For a choice it is the middle of an option, and at most `MAX_OPTIONS` options
    are taken at even steps. For a group of several coordinates a random point is added,
    since equal values may cancel.
    """
    fractions = list(PROBE_FRACTIONS)
    if group.options:
        stride = -(-group.options // MAX_OPTIONS)  # the quotient rounded up
        options = range(0, group.options, stride)
        fractions = [(option + 0.5) / group.options for option in options]
    values = [torch.full((group.size,), fraction) for fraction in fractions]
    if group.size > 1:
        generator = torch.Generator().manual_seed(0)
        values.append(torch.rand(group.size, generator=generator))
    for group_values in values:
        configuration = reference.clone()
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
    """Return in which way a group of coordinates changes one input.

    Args:
        name: name of the input.
        before: its value at the reference configuration; None if it has none.
        after: its value once the group is changed.
        n_coordinates: number of coordinates of the group.

    Returns:
        POWER: a lamp's light or an input of the finished image changed, or the
        environment was multiplied by a factor. HARMONICS: spherical harmonics were
        added to the environment. NONE: it is the same. OTHER: anything else.
    """
    if before is None or after is None:
        return _Change.OTHER
    if not inputs_differ(before, after):
        return _Change.NONE
    if name in IMAGE_INPUTS or name.endswith(LAMP_SUFFIXES):
        return _Change.POWER
    if name != ENVIRONMENT_INPUT or before.shape != after.shape:
        return _Change.OTHER
    if _is_explained(before[None], after):
        return _Change.POWER
    # A control that adds harmonics has a coordinate for each coefficient.
    if n_coordinates == 1:
        return _Change.OTHER
    harmonic_basis = torch.cat([before[None], _make_harmonic_maps(before)])
    # The fit to every `COARSE_STEP`th pixel rejects most other changes in a tenth of
    # the time.
    if not _is_explained(
        harmonic_basis[:, ::COARSE_STEP, ::COARSE_STEP],
        after[::COARSE_STEP, ::COARSE_STEP],
    ):
        return _Change.OTHER
    return _Change.HARMONICS if _is_explained(harmonic_basis, after) else _Change.OTHER


def _is_explained(basis: Tensor, target: Tensor) -> bool:
    """Return whether a map (H, W, 3) is a weighted sum of basis maps (k, H, W, 3).

    Only texels count in which the map and the first basis map are both positive: where
    harmonics made a sum negative, it was cut off at zero.
    """
    is_lit = ((basis[0] > 0.0) & (target > 0.0)).to(torch.float32)
    basis_maps = BasisMaps(basis * is_lit)
    residual = target * is_lit - basis_maps.compose(
        basis_maps.fit_weights(target * is_lit)
    )
    return float(residual.norm()) <= MAX_RELATIVE_DIFFERENCE * float(target.norm())


def _make_harmonic_maps(like: Tensor) -> Tensor:
    """Return spherical harmonics of degrees 0 to 2 as maps (9, H, W, 3).

    Light cannot be negative. So each harmonic is raised to at least zero by adding a
    multiple of the first one, which is constant: sums of the maps stay the same.

    Args:
        like: (H, W, 3) map whose size and mean the results have. Its first and last
            columns are copies of the columns at the other end.
    """
    basis = compute_real_harmonics(like.shape[0], like.shape[1] - 2)
    # (9, H, W): the last column before the first, and the first after the last
    padded = torch.cat([basis[:, -1:], basis, basis[:, :1]], dim=1).permute(2, 0, 1)
    # the first is 1 everywhere: to subtract the minimum is to add a multiple of it
    lifted = padded - padded.amin(dim=(1, 2), keepdim=True).clamp_max(0.0)
    scaled = lifted * float(like.mean().clamp_min(1e-12))
    return scaled[..., None].expand(-1, -1, -1, 3).contiguous()


@dataclass(frozen=True, eq=False)
class BasisMaps:
    """Basis maps of an environment, and how a map is composed of them."""

    maps: Tensor  # (k, H, W, 3), all at least zero

    def fit_weights(self, target: Tensor) -> Tensor:
        """Return the weights (k, 3) with which the maps add up to a map (H, W, 3).

        There is one weight for each map and channel. With several maps they are a least
        squares fit, weighted by solid angle. A single map is assumed to be proportional
        to the target. The weights are differentiable.
        """
        flat_target = target.permute(2, 0, 1).reshape(3, -1, 1)
        if len(self.maps) == 1:
            # A proportional target is the map times one factor in each channel: the
            # quotient at any texel, of which the brightest has the least rounding.
            texel, brightness = self._brightest
            target_value = flat_target[..., 0].gather(1, texel)
            return (target_value / brightness.clamp_min(TINY)).T
        weights: Tensor = (self._inverse @ flat_target)[..., 0].T
        return weights

    def compose(self, weights: Tensor) -> Tensor:
        """Return the map (H, W, 3) with given weights (k, 3)."""
        return torch.einsum("khwc,kc->hwc", self.maps, weights)

    @cached_property
    def _brightest(self) -> tuple[Tensor, Tensor]:
        """The brightest texel of the first map in each channel (3, 1), and its
        value.
        """
        texels = self.maps[0].reshape(-1, 3)
        return texels.argmax(dim=0)[:, None], texels.amax(dim=0)[:, None]

    @cached_property
    def _inverse(self) -> Tensor:
        """(3, k, H W) matrices from a map to the weights of the basis maps.

        Of each channel it is the pseudo-inverse of the basis maps, weighted by solid
        angle: the least squares fit.
        """
        count, height, width, _ = self.maps.shape
        # The solid angle of a texel is proportional to the sine of its angle from
        # straight up. Least squares with weights W: (A W A^T)^-1 A W.
        polar = (torch.arange(height) + 0.5) * torch.pi / height
        sine = torch.sin(polar)[:, None].expand(height, width).reshape(-1)
        channel_maps = self.maps.permute(3, 0, 1, 2).reshape(3, count, -1).double()
        weighted = channel_maps * sine  # (3, k, H W)
        gram = weighted @ channel_maps.transpose(1, 2)  # (3, k, k)
        inverse: Tensor = torch.linalg.pinv(gram) @ weighted
        return inverse.float()


# ---- images


class LightBasis:
    """The lights of a scene of which some change, each separately.

    Args:
        renderer: renderer of the scene.
        lighting: what changes.
        inputs: scene inputs whose map is the environment's first basis map.

    Attributes:
        inputs_of_light: the inputs of each light, in which all others are dark: first
            that of all light that does not change, if there is any, and of projectors;
            then each lamp that changes, at a radiance or intensity of one; then each
            basis map of the environment. There is at least one, if a dark one.
    """

    def __init__(self, renderer: Renderer, lighting: Lighting, inputs: Inputs) -> None:
        """Split the light of scene inputs into lights of which each has its own image.

        Radiance is the sum over lights, so that an image under any mixture of them is
        the sum of their images, each times its brightness.

        Args:
            renderer: renderer of the scene.
            lighting: groups of coordinates that change light.
            inputs: scene inputs whose light is split.
        """
        patterns = {
            name for name in renderer.scene.input_names if name.endswith(PATTERN_SUFFIX)
        }
        names = find_light_inputs(renderer) | patterns
        values = {
            name: inputs[name]
            if name in inputs
            else renderer.scene.get_base_value(name)
            for name in sorted(names)
        }
        # The inputs of one light are this, with its own value put in: all others dark.
        dark = {name: torch.zeros_like(value) for name, value in values.items()}
        changed_names = lighting.changed_inputs
        # The patterns of projectors are in the first light, whether they change or not.
        fixed_values = {
            name: value
            for name, value in values.items()
            if name in patterns
            or (name not in changed_names and bool((value > 0.0).any()))
        }
        self._lamps = sorted(changed_names & names - {ENVIRONMENT_INPUT})
        changes_environment = ENVIRONMENT_INPUT in changed_names
        is_unlit = not (fixed_values or self._lamps or changes_environment)
        # A scene without any light still gets one, which is dark: so that there is an
        # image.
        self._has_fixed_light = bool(fixed_values) or is_unlit
        self.inputs_of_light = list[Inputs]()
        if self._has_fixed_light:
            self.inputs_of_light.append({**dark, **fixed_values})
        self.inputs_of_light += [{**dark, name: torch.ones(3)} for name in self._lamps]
        self._basis_maps: BasisMaps | None = None
        if changes_environment:
            maps = _make_basis_maps(renderer, lighting, values[ENVIRONMENT_INPUT])
            self._basis_maps = BasisMaps(maps)
            self.inputs_of_light += [
                {**dark, ENVIRONMENT_INPUT: basis} for basis in maps
            ]

    def compute_weights(self, inputs: Inputs) -> Tensor:
        """Return the factor (lights, 3) of each light, differentiable in the inputs."""
        weights = [torch.ones(1, 3)] if self._has_fixed_light else []
        weights += [inputs[name].reshape(1, 3) for name in self._lamps]
        if self._basis_maps is not None:
            weights.append(self._basis_maps.fit_weights(inputs[ENVIRONMENT_INPUT]))
        return torch.cat(weights)


def _make_basis_maps(renderer: Renderer, lighting: Lighting, first: Tensor) -> Tensor:
    """Return the environment's basis maps (k, H, W, 3).

    The first is `first`. If a group adds spherical harmonics to the environment, they
    are the others. They are zero in texels in which no harmonics are added.

    Args:
        renderer: renderer of the scene.
        lighting: groups that change light.
        first: (H, W, 3) the environment's map.
    """
    if not lighting.harmonic_groups:
        return first[None]
    start_inputs = renderer.scene.assembly(renderer.space.inputs(renderer.start))
    start_map = start_inputs[ENVIRONMENT_INPUT]
    # Harmonics are added where the environment is not cut off at zero. A texel that is
    # black at the start too counts as one that is not.
    is_added = first > 0.0
    if start_map.shape == first.shape:
        is_added = is_added | (start_map <= 0.0)
    harmonics = _make_harmonic_maps(first) * is_added.to(torch.float32)
    return torch.cat([first[None], harmonics])


class BasisRenderer(Predictor):
    """Compose images of one basis image for each light.

    Where base colors are searched too, each light has matrices of its own, so that
    radiance is bilinear in both: to first order in the base colors, under any light.

    Args:
        traced, seed, tick: as for `LinearRenderer`.
        u: (d,) configuration; what does not change is as it is there.
        changing: what changes; None finds it.

    Attributes:
        non_finite: numbers that were not finite, and were replaced by 0.
    """

    def __init__(
        self,
        traced: Renderer,
        u: Tensor,
        seed: int,
        tick: ProgressCallback = ignore_progress,
        *,
        changing: Lighting | None = None,
    ) -> None:
        """Trace an image for each light, and the matrices of base colors under it.

        Args:
            traced: renderer that traces the paths.
            u: (d,) configuration at which the images are traced.
            seed: seed of the samples.
            tick: called as the passes are done, with the progress.
            changing: result of `find_lighting`, which is called if this is None.
        """
        super().__init__(traced)
        with torch.no_grad():
            changing = changing or find_lighting(traced)
            # The environment is traced at its brightest: other environments are
            # predicted by scaling its image, which fails if a channel of it is black.
            brightest = u.detach().clone()
            for coordinates, values in changing.brightest_values:
                brightest[coordinates] = values
            inputs = traced.scene.assembly(traced.space.inputs(brightest))
            self._lights = LightBasis(traced, changing, inputs)
            self._renderers = self._trace_lights(traced, u, seed, tick)
        self.non_finite = sum(renderer.non_finite for renderer in self._renderers)

    @property
    def n_traced_images(self) -> int:
        """Number of basis images, each traced with its matrices."""
        return len(self._renderers)

    def _trace_lights(
        self, traced: Renderer, u: Tensor, seed: int, tick: ProgressCallback
    ) -> list[LinearRenderer]:
        """Trace the image and the matrices of base colors under each light.

        Args:
            traced: renderer of the scene.
            u: (d,) configuration at which images are traced.
            seed: seed of the noise; each light gets its own.
            tick: called with the samples per pixel of each pass as it is done.
        """
        set_inputs = traced.scene.assembly(traced.space.inputs(u)).keys()
        linear_names = set_inputs & find_linear_inputs(traced)
        # patterns of projectors shine in the first light alone
        base_colors = {
            name for name in linear_names if not name.endswith(PATTERN_SUFFIX)
        }
        renderers = []
        for index, light_inputs in enumerate(self._lights.inputs_of_light):
            renderers.append(
                LinearRenderer(
                    traced,
                    u,
                    seeds.stream(seed, "light", index),
                    tick,
                    names=linear_names if index == 0 else base_colors,
                    light=light_inputs,
                )
            )
        return renderers

    @property
    def n_entries(self) -> int:
        """Number of entries of all lights' matrices."""
        return sum(renderer.n_entries for renderer in self._renderers)

    @property
    def n_bytes(self) -> int:
        """Memory of all lights' matrices and basis images."""
        return sum(renderer.n_bytes for renderer in self._renderers)

    def predict_radiance(self, inputs: Inputs) -> Tensor:
        """Return radiance (H, W, 3), and coverage as a fourth channel if there is a
        backdrop.

        Coverage is the same under any light.
        """
        images = [renderer.predict_radiance(inputs) for renderer in self._renderers]
        weights = self._lights.compute_weights(inputs)
        basis = torch.stack(images)[..., :3]
        # l: lights, c: channels
        radiance = torch.einsum("lc,lhwc->hwc", weights, basis)
        return torch.cat([radiance, images[0][..., 3:]], dim=-1)


HAZE = Refusal("there is haze", RefusalCause.HAZE)


def find_refusal(renderer: Renderer, varying: Collection[str] = ()) -> Refusal | None:
    """Return why images of a space cannot be predicted; None if they can.

    A group that is searched may change the finished image, haze, light (if nothing
    varies), or inputs to which radiance is linear, such as base colors. The last need
    the adjoint estimator. At least one group has to need a render, as otherwise a
    prediction would save nothing. Haze and a missing denoiser are named only if there
    is no other reason.

    Args:
        renderer: renderer of the space.
        varying: names of controls that vary. They are fixed for each matrix, whatever
            they change; if there are any, light may not change.
    """
    if renderer.scene.definition[0].get_number("ground.gloss") > 0.0:
        return Refusal("the ground reflects the object")
    linear_inputs = find_linear_inputs(renderer)
    searched_groups = [
        group for group in renderer.plan.groups if group.control not in varying
    ]
    light_groups = {} if varying else find_lighting(renderer).groups
    if light_groups and renderer.scene.plane_radiance is not None:
        return Refusal("light that changes falls on the ground of the photograph too")
    parts = renderer.scene.definition[0].parts
    haze_prefixes = tuple(f"{part.name}." for part in parts if part.volumetric)
    for group in searched_groups:
        if group.is_forced and group.estimator not in ("none", "image"):
            return Refusal(f"the estimator of {group.name} is forced")
        changed_inputs = renderer.routes.get(group.name, frozenset())
        is_haze = bool(changed_inputs) and all(
            name.startswith(haze_prefixes) for name in changed_inputs
        )
        if group.estimator == "image" or group.name in light_groups or is_haze:
            continue  # needs no matrix of base colors
        if changed_inputs & find_light_inputs(renderer) and has_fixed_lights(renderer):
            return Refusal(
                f"{group.name} changes light, and the scene has other lights of its own"
            )
        if group.estimator != "adjoint" or not changed_inputs <= linear_inputs:
            allowed = "base colours" if varying else "base colours and light"
            return Refusal(f"{group.name} changes more than {allowed}")
    return _find_general_refusal(renderer, searched_groups, light_groups)


def _find_general_refusal(
    renderer: Renderer,
    searched_groups: Sequence[Group],
    light_groups: Mapping[str, object],
) -> Refusal | None:
    """Return a reason against predictions that is not about a single group.

    There are three: nothing needs a render, the scene has haze, or no denoiser.

    Args:
        renderer: renderer of the space.
        searched_groups: groups that are searched.
        light_groups: inputs that are changed by the groups that change only light, by
            the group's name.
    """
    if not any(
        renderer.routes.get(group.name) or light_groups.get(group.name)
        for group in searched_groups
    ):
        return Refusal("nothing that is searched needs a render to be differentiated")
    if renderer.scene.is_volumetric and not all(
        group.name in light_groups for group in searched_groups
    ):
        return HAZE
    return None if renderer.formation.denoiser == "oidn" else NOISE


def make_predictor(
    renderer: Renderer, u: Tensor, seed: int, tick: ProgressCallback = ignore_progress
) -> Predictor:
    """Make what predicts the images of a renderer's space, at u.

    Arguments as for `LinearRenderer`.
    """
    lighting = find_lighting(renderer)
    if lighting.changed_inputs:
        return BasisRenderer(renderer, u, seed, tick, changing=lighting)
    return LinearRenderer(renderer, u, seed, tick)


def count_lights(renderer: Renderer) -> int:
    """Return the number of lights that have a basis image; 1 where no light changes."""
    lighting = find_lighting(renderer)
    if not lighting.changed_inputs:
        return 1
    inputs = renderer.scene.assembly(renderer.space.inputs(renderer.start))
    return len(LightBasis(renderer, lighting, inputs).inputs_of_light)


def count_samples(renderer: Renderer) -> int:
    """Return the samples per pixel that are traced before anything can be predicted.

    Each light needs the samples of all its matrices, or without a matrix those of one
    image.
    """
    changed_inputs: set[str] = set()
    for group in renderer.plan.groups:
        changed_inputs |= renderer.routes.get(group.name, frozenset())
    n_matrices = len(changed_inputs & find_linear_inputs(renderer))
    samples_per_light = COLLECTED_SPP
    if n_matrices:
        samples, n_passes = plan_passes(renderer, COLLECTED_SPP)
        samples_per_light = samples * n_passes * n_matrices
    return count_lights(renderer) * samples_per_light
