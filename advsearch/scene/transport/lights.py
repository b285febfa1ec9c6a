"""Predict images of a scene in which only its lights change, by a basis image for each.

Light of different lamps adds up, channel by channel, so that

    radiance = sum over lights of weight x basis image

    weight: three color channels, from the configuration

where a basis image is rendered once with one light alone, and denoised once. An
environment whose power, exposure and tint change is one light. If spherical harmonics
are added to it, each harmonic is a further light, next to the map itself. Then the
weights are those with which the sum of these basis maps comes nearest to the map, by
least squares over solid angle. The sum may differ from the map, in which negative
values are replaced by zero.
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
# suffixes of the names of inputs that are the light of a lamp, (3,)
LAMP_SUFFIXES = (".intensity", ".radiance")
# Largest relative difference at which a map counts as a multiple of another one. It
# allows for float32 numbers that go through a tone curve and back.
MAX_RELATIVE_DIFFERENCE = 1e-3
MAX_OPTIONS = 64  # largest number of options of a discrete choice that are compared
TINY = 1e-30  # smallest brightness to divide by
COARSE_STEP = 4  # step in rows and columns of a map for a first comparison


def find_light_inputs(renderer: Renderer) -> frozenset[str]:
    """Return the names of a scene's inputs that are light."""
    return frozenset(
        name
        for name in renderer.scene.input_names
        if name == ENVIRONMENT_INPUT or name.endswith(LAMP_SUFFIXES)
    )


def has_fixed_lights(renderer: Renderer) -> bool:
    """Return whether the scene has lights that are no inputs.

    Such lights come from a Mitsuba scene, and cannot be switched off.
    """
    return any(
        isinstance(part, PluginPart) and part.emits_light
        for part in renderer.scene.description_and_filter[0].parts
    )


# ---- what changes


@dataclass(frozen=True)
class LightGroups:
    """The groups of coordinates that change only light, exposure or the finished image.

    A group is one parameter of a control, such as "environment.exposure".
    """

    # inputs that each group changes, by its name `control.parameter`; none if it only
    # changes the finished image
    inputs_by_group: Mapping[str, frozenset[str]]
    # names of groups that add spherical harmonics to the environment
    harmonic_groups: frozenset[str]
    # For each other group that changes the environment, its coordinates and the values
    # at which the environment is brightest. A basis map must not be black in a channel.
    brightest_values: Sequence[tuple[slice, Tensor]] = ()

    @property
    def changed_inputs(self) -> frozenset[str]:
        """The scene's inputs that change."""
        return frozenset[str]().union(*self.inputs_by_group.values()) - IMAGE_INPUTS


def find_light_groups(renderer: Renderer) -> LightGroups:
    """Find the groups of coordinates that change only light and the finished image.

    Each group is varied alone, and the scene inputs are compared. So the result does
    not depend on which kind of control sets them.

    Some lights of a Mitsuba scene cannot be switched off. If the image of each light
    were traced alone, it would contain these lights too, and their sum would contain
    them several times. So in such a scene, only groups that change nothing but the
    finished image are returned.
    """
    # While one group is varied, all others stay half way between the start and the
    # center of the unit cube, (start + 0.5) / 2. There a value is rarely at a border,
    # where a change may have no effect.
    reference = 0.5 * renderer.start + 0.25
    groups = {}
    harmonic_groups = set()
    brightest_values = []
    with torch.no_grad():
        for group, effect in _iterate_light_effects(renderer, reference):
            groups[group.name] = effect.changed
            if effect.is_harmonic:
                # The light that it adds has basis maps of its own, so that the map of
                # the environment itself need not be bright.
                harmonic_groups.add(group.name)
            elif ENVIRONMENT_INPUT in effect.changed:
                brightest = effect.brightest[group.coordinates]
                brightest_values.append((group.coordinates, brightest))
    return LightGroups(groups, frozenset(harmonic_groups), tuple(brightest_values))


class _Effect(NamedTuple):
    """Effect of a group of coordinates on light or on the finished image."""

    changed: frozenset[str]  # names of the inputs that it changes
    is_harmonic: bool  # whether it adds spherical harmonics to the environment
    # (d,) configuration with the brightest environment, among those that were compared
    brightest: Tensor


def _iterate_light_effects(
    renderer: Renderer, reference: Tensor
) -> Iterator[tuple[Group, _Effect]]:
    """Yield each group that changes only light or the finished image, and its effect.

    Groups that change light are left out if the scene has lights that are no inputs.

    Args:
        renderer: renderer of the space.
        reference: (d,) configuration from which one group at a time is varied.
    """
    base_inputs = renderer.scene.input_assembler(renderer.space.inputs(reference))
    for group in renderer.space.groups:
        effect = _measure_effect(renderer, group, reference, base_inputs)
        if effect is None:  # the group changes more than light
            continue
        only_changes_image = effect.changed <= IMAGE_INPUTS
        if only_changes_image or not has_fixed_lights(renderer):
            yield group, effect


def _measure_effect(
    renderer: Renderer, group: Group, reference: Tensor, base_inputs: Inputs
) -> _Effect | None:
    """Return the effect of a group of coordinates; None if it changes more than light.

    Several configurations, which differ from `reference` in this group only, are
    compared with `base_inputs`, the scene inputs at `reference`. The kinds of changes
    are those of `_Change`.
    """
    changed: set[str] = set()
    is_harmonic = False
    max_power = -1.0  # below that of any environment
    brightest = reference
    for configuration in _sample_configurations(group, reference):
        inputs = renderer.scene.input_assembler(renderer.space.inputs(configuration))
        changes = _find_input_changes(base_inputs, inputs, group.size)
        if changes is None:
            return None
        changed |= {name for name in changes if changes[name] is not _Change.NONE}
        is_harmonic |= changes.get(ENVIRONMENT_INPUT) is _Change.HARMONICS
        if ENVIRONMENT_INPUT in inputs:
            power = float(inputs[ENVIRONMENT_INPUT].sum())
            if power > max_power:
                max_power = power
                brightest = configuration
    return _Effect(frozenset(changed), is_harmonic, brightest)


def _find_input_changes(
    base_inputs: Inputs, inputs: Inputs, n_coordinates: int
) -> dict[str, _Change] | None:
    """Return how each input changes; None if one changes in more than light.

    Args:
        base_inputs: scene inputs at the reference configuration.
        inputs: scene inputs once a group is changed.
        n_coordinates: number of coordinates of the group.
    """
    changes: dict[str, _Change] = {}
    for name in base_inputs.keys() | inputs.keys():
        change = _find_change(
            name,
            before=base_inputs.get(name),
            after=inputs.get(name),
            n_coordinates=n_coordinates,
        )
        if change is _Change.OTHER:
            return None
        changes[name] = change
    return changes


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
    HARMONICS = "by spherical harmonics"  # smooth patterns over all directions
    OTHER = "in more than light"


def _find_change(
    name: str, before: Tensor | None, after: Tensor | None, n_coordinates: int
) -> _Change:
    """Return how a group of coordinates changes one input.

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
    return _find_environment_change(before, after, n_coordinates)


def _find_environment_change(
    before: Tensor, after: Tensor, n_coordinates: int
) -> _Change:
    """Return how a group of coordinates changes the environment's map (H, W, 3)."""
    # a multiple of the map before, by one factor for each color channel
    if _is_weighted_sum(after, before[None]):
        return _Change.POWER
    # A control that adds harmonics has a coordinate for each coefficient. So a group
    # with a single coordinate adds none, and the expensive test below is saved.
    if n_coordinates != 1 and _has_added_harmonics(before, after):
        return _Change.HARMONICS
    return _Change.OTHER


def _has_added_harmonics(before: Tensor, after: Tensor) -> bool:
    """Return whether a map (H, W, 3) is a multiple of one before, plus harmonics.

    The fit to every `COARSE_STEP`th pixel rejects most other changes in a tenth of the
    time.
    """
    harmonic_basis = torch.cat([before[None], _make_harmonic_maps(before)])
    coarse_map = after[::COARSE_STEP, ::COARSE_STEP]
    coarse_basis = harmonic_basis[:, ::COARSE_STEP, ::COARSE_STEP]
    if not _is_weighted_sum(coarse_map, coarse_basis):
        return False
    return _is_weighted_sum(after, harmonic_basis)


def _is_weighted_sum(target: Tensor, basis: Tensor) -> bool:
    """Return whether a map (H, W, 3) is a weighted sum of basis maps (k, H, W, 3).

    Where a sum with harmonics is negative, the map is 0 instead, and the fit would not
    hold. So only texels are compared in which the target is positive. For the same
    reason the first basis map has to be positive there: that is the environment before
    a change, to which other harmonics may have been added already.
    """
    is_lit = ((basis[0] > 0.0) & (target > 0.0)).to(torch.float32)
    basis_maps = BasisMaps(basis * is_lit)
    lit_target = target * is_lit
    weights = basis_maps.fit_weights(lit_target)
    residual = lit_target - basis_maps.compose(weights)
    return float(residual.norm()) <= MAX_RELATIVE_DIFFERENCE * float(target.norm())


def _make_harmonic_maps(like: Tensor) -> Tensor:
    """Return spherical harmonics of degrees 0 to 2 as maps (9, H, W, 3).

    Light cannot be negative. So each harmonic is raised to at least zero by adding a
    multiple of the first one, which is constant. The weighted sums of the raised maps
    are all weighted sums of the harmonics, with other weights.

    Args:
        like: (H, W, 3) map whose size and mean the results have. Its first and last
            columns are copies of the columns at the other end.
    """
    basis = compute_real_harmonics(like.shape[0], like.shape[1] - 2)
    # (9, H, W): the last column before the first, and the first after the last
    padded = torch.cat([basis[:, -1:], basis, basis[:, :1]], dim=1).permute(2, 0, 1)
    # The minimum is a negative multiple of the first harmonic, which is 1 everywhere.
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
        flat_target = target.permute(2, 0, 1).reshape(3, -1, 1)  # (3, H W, 1)
        if len(self.maps) == 1:
            # A proportional target is the map times one factor in each channel: the
            # quotient at any texel, of which the brightest has the least rounding.
            texel, brightness = self._brightest
            target_value = flat_target[..., 0].gather(1, texel)  # (3, 1)
            return (target_value / brightness.clamp_min(TINY)).T
        channel_weights = self._weighted_inverse @ flat_target  # (3, k, 1)
        weights: Tensor = channel_weights[..., 0].T
        return weights

    def compose(self, weights: Tensor) -> Tensor:
        """Return the map (H, W, 3) with given weights (k, 3)."""
        return torch.einsum("khwc,kc->hwc", self.maps, weights)

    @cached_property
    def _brightest(self) -> tuple[Tensor, Tensor]:
        """Index of the first map's brightest texel in each channel, and its value.

        Both are (3, 1).
        """
        texels = self.maps[0].reshape(-1, 3)
        return texels.argmax(dim=0)[:, None], texels.amax(dim=0)[:, None]

    @cached_property
    def _weighted_inverse(self) -> Tensor:
        """(3, k, H W) matrices from a map to the weights of the basis maps.

        For each channel it is the pseudo-inverse of the basis maps, weighted by solid
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
    """The light of a scene, split into lights that are rendered one by one.

    Args:
        renderer: renderer of the scene.
        lighting: groups of coordinates that change light.
        inputs: scene inputs whose map is the environment's first basis map.

    Attributes:
        inputs_of_light: scene inputs of each light, in which all other lights are dark.
            The first light is everything that does not change, together with
            projectors, if there is any. Then come the lamps that change, each with a
            radiance or intensity of 1, and then the basis maps of the environment. A
            scene without light has one dark light.
    """

    def __init__(
        self, renderer: Renderer, lighting: LightGroups, inputs: Inputs
    ) -> None:
        """Split the light of scene inputs into lights of which each has its own image.

        Radiance is the sum over lights, so that an image under any mixture of them is
        the sum of their images, each times its brightness.

        Args:
            renderer: renderer of the scene.
            lighting: groups of coordinates that change light.
            inputs: scene inputs whose light is split.
        """
        patterns = _find_patterns(renderer)
        values = _get_values(renderer, find_light_inputs(renderer) | patterns, inputs)
        dark_values = {name: torch.zeros_like(value) for name, value in values.items()}
        changed_names = lighting.changed_inputs
        fixed_values = _select_fixed_values(values, patterns, changed_names)
        changed_lights = changed_names & values.keys()
        # A scene without any light still gets one, which is dark, so that there is an
        # image.
        self._has_fixed_light = bool(fixed_values) or not changed_lights
        self.inputs_of_light = list[Inputs]()
        if self._has_fixed_light:
            self.inputs_of_light.append({**dark_values, **fixed_values})

        # Lamps. Each is rendered with a radiance or intensity of 1, so that its weight
        # is its radiance or intensity.
        self._lamps = sorted(changed_lights - {ENVIRONMENT_INPUT})
        for name in self._lamps:
            self.inputs_of_light.append({**dark_values, name: torch.ones(3)})

        # The environment. Its weights are fitted to its basis maps.
        self._basis_maps: BasisMaps | None = None
        if ENVIRONMENT_INPUT in changed_lights:
            maps = _make_basis_maps(renderer, lighting, values[ENVIRONMENT_INPUT])
            self._basis_maps = BasisMaps(maps)
            for basis_map in maps:
                inputs_of_map = {**dark_values, ENVIRONMENT_INPUT: basis_map}
                self.inputs_of_light.append(inputs_of_map)

    def compute_weights(self, inputs: Inputs) -> Tensor:
        """Return the factor (lights, 3) of each light, differentiable in the inputs.

        The order is that of `inputs_of_light`.
        """
        weights = [torch.ones(1, 3)] if self._has_fixed_light else []
        weights += [inputs[name].reshape(1, 3) for name in self._lamps]
        if self._basis_maps is not None:
            weights.append(self._basis_maps.fit_weights(inputs[ENVIRONMENT_INPUT]))
        return torch.cat(weights)


def _find_patterns(renderer: Renderer) -> set[str]:
    """Return the names of a scene's inputs that are patterns of projectors."""
    return {
        name for name in renderer.scene.input_names if name.endswith(PATTERN_SUFFIX)
    }


def _get_values(
    renderer: Renderer, names: Collection[str], inputs: Inputs
) -> dict[str, Tensor]:
    """Return the values of scene inputs by name, in alphabetical order.

    Inputs that are not in `inputs` have the value of the scene itself.
    """
    values = {}
    for name in sorted(names):
        if name in inputs:
            values[name] = inputs[name]
        else:
            values[name] = renderer.scene.get_base_value(name)
    return values


def _make_basis_maps(
    renderer: Renderer, lighting: LightGroups, first: Tensor
) -> Tensor:
    """Return the environment's basis maps (k, H, W, 3).

    The first is `first`. If a group adds spherical harmonics to the environment, the
    harmonics are the others, with zeros in texels to which none are added.

    Args:
        renderer: renderer of the scene.
        lighting: groups that change light.
        first: (H, W, 3) map of the environment.
    """
    if not lighting.harmonic_groups:
        return first[None]
    start_inputs = renderer.scene.input_assembler(renderer.space.inputs(renderer.start))
    start_map = start_inputs[ENVIRONMENT_INPUT]
    # A texel of `first` is black for one of two reasons. It may be black in the
    # environment itself, and so at the start, too. Or its sum with harmonics was
    # negative and was cut off: there no harmonics are added.
    is_added = first > 0.0
    if start_map.shape == first.shape:
        is_always_black = start_map <= 0.0
        is_added = is_added | is_always_black
    harmonics = _make_harmonic_maps(first) * is_added.to(torch.float32)
    return torch.cat([first[None], harmonics])


def _set_brightest(u: Tensor, lighting: LightGroups) -> Tensor:
    """Return a configuration (d,) with the environment at its brightest.

    It gives the first basis map. Others are predicted by scaling its image, which fails
    if a channel of it is black.
    """
    brightest = u.detach().clone()
    for coordinates, values in lighting.brightest_values:
        brightest[coordinates] = values
    return brightest


def _select_fixed_values(
    values: Inputs, patterns: Collection[str], changed_names: Collection[str]
) -> dict[str, Tensor]:
    """Return the values of the first light: all that does not change, and projectors.

    A pattern of a projector that changes has a matrix of its own under this light.

    Args:
        values: values of all lights and patterns, by the names of the inputs.
        patterns: names of the patterns.
        changed_names: names of the inputs that change.
    """
    return {
        name: value
        for name, value in values.items()
        if name in patterns or (name not in changed_names and bool((value > 0.0).any()))
    }


class BasisRenderer(Predictor):
    """Compose images from one basis image for each light.

    If base colors are searched too, each light has matrices of its own. So radiance is
    bilinear in lights and base colors: first-order in the base colors, under any light.

    Args:
        traced, seed, tick: as for `LinearRenderer`.
        u: (d,) configuration; everything that does not change has its value there.
        changing: result of `find_light_groups`, which is called if this is None.

    Attributes:
        n_non_finite: how many numbers were not finite, and were replaced by 0.
    """

    def __init__(
        self,
        traced: Renderer,
        u: Tensor,
        seed: int,
        tick: ProgressCallback = ignore_progress,
        *,
        changing: LightGroups | None = None,
    ) -> None:
        """Trace an image for each light, and the matrices of base colors under it.

        Args:
            traced: renderer that traces the paths.
            u: (d,) configuration at which the images are traced.
            seed: seed of the samples.
            tick: called as the passes are done, with the progress.
            changing: result of `find_light_groups`, which is called if this is None.
        """
        super().__init__(traced)
        with torch.no_grad():
            changing = changing or find_light_groups(traced)
            brightest = _set_brightest(u, changing)
            inputs = traced.scene.input_assembler(traced.space.inputs(brightest))
            self._lights = LightBasis(traced, changing, inputs)
            # Everything but light is traced at u: each light's inputs are replaced by
            # those of `self._lights`.
            self._renderers = self._trace_lights(traced, u, seed, tick)
        self.n_non_finite = sum(renderer.n_non_finite for renderer in self._renderers)

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
        set_inputs = traced.scene.input_assembler(traced.space.inputs(u)).keys()
        linear_names = set_inputs & find_linear_inputs(traced)
        base_colors = {
            name for name in linear_names if not name.endswith(PATTERN_SUFFIX)
        }
        renderers = []
        for index, light_inputs in enumerate(self._lights.inputs_of_light):
            # All projectors are in the first light of `LightBasis`, so that only there
            # their patterns have an effect, and need a matrix.
            names = linear_names if index == 0 else base_colors
            light_seed = seeds.derive_seed(seed, "light", index)
            renderers.append(
                LinearRenderer(
                    traced, u, light_seed, tick, names=names, light=light_inputs
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
        """Return radiance (H, W, 3); with a backdrop, coverage is a fourth channel.

        Coverage is the same under any light.
        """
        # Each renderer takes the base colors of the inputs, and ignores their light.
        images = [renderer.predict_radiance(inputs) for renderer in self._renderers]
        weights = self._lights.compute_weights(inputs)
        basis = torch.stack(images)[..., :3]
        # l: lights, c: channels
        radiance = torch.einsum("lc,lhwc->hwc", weights, basis)
        further_channels = images[0][..., 3:]  # the same for all lights
        return torch.cat([radiance, further_channels], dim=-1)


HAZE = Refusal("there is haze", RefusalCause.HAZE)


def find_refusal(renderer: Renderer, varying: Collection[str] = ()) -> Refusal | None:
    """Return why images of a space cannot be predicted; None if they can.

    A searched group of coordinates may change

    - the finished image,
    - light, if no control varies,
    - haze; `_find_general_refusal` decides about it, so that haze and a missing
      denoiser are reported only if there is no other reason,
    - inputs to which radiance is linear, such as base colors, if their derivatives are
      computed by the adjoint estimator.

    Args:
        renderer: renderer of the space.
        varying: names of controls that vary. Each matrix is traced at fixed values of
            theirs, so that they may change anything. If there are any, light may not
            change.
    """
    if renderer.scene.description_and_filter[0].get_number("ground.gloss") > 0.0:
        return Refusal("the ground reflects the object")
    searched_groups = [
        group for group in renderer.plan.groups if group.control not in varying
    ]
    light_groups: Mapping[str, frozenset[str]] = {}
    if not varying:
        light_groups = find_light_groups(renderer).inputs_by_group
    # With a photographed ground, a lamp also changes the photograph around the object,
    # which no basis image contains.
    if light_groups and renderer.scene.plane_radiance is not None:
        return Refusal("light that changes falls on the ground of the photograph too")
    for group in searched_groups:
        is_light = group.name in light_groups
        refusal = _find_group_refusal(renderer, group, is_light, bool(varying))
        if refusal is not None:
            return refusal
    return _find_general_refusal(renderer, searched_groups, light_groups)


def _find_group_refusal(
    renderer: Renderer, group: Group, is_light: bool, has_varying: bool
) -> Refusal | None:
    """Return why what a searched group changes cannot be predicted; None if it can.

    Args:
        renderer: renderer of the space.
        group: the group of coordinates.
        is_light: whether the group changes only light or the finished image.
        has_varying: whether some control varies, so that light may not change.
    """
    # A prediction has derivatives of its own. A user who has chosen an estimator for
    # renders would not get it.
    if group.is_forced and group.estimator not in ("none", "image"):
        return Refusal(f"the estimator of {group.name} is forced")
    changed_inputs = renderer.inputs_by_group.get(group.name, frozenset())
    is_haze = _are_all_of_haze(renderer, changed_inputs)
    needs_matrix = not (group.estimator == "image" or is_light or is_haze)
    if not needs_matrix:
        return None
    if changed_inputs & find_light_inputs(renderer) and has_fixed_lights(renderer):
        return Refusal(
            f"{group.name} changes light, and the scene has other lights of its own"
        )
    is_linear = changed_inputs <= find_linear_inputs(renderer)
    if group.estimator != "adjoint" or not is_linear:
        allowed = "base colors" if has_varying else "base colors and light"
        return Refusal(f"{group.name} changes more than {allowed}")
    return None


def _are_all_of_haze(renderer: Renderer, names: Collection[str]) -> bool:
    """Return whether there are inputs, and all of them are those of haze."""
    parts = renderer.scene.description_and_filter[0].parts
    haze_prefixes = tuple(f"{part.name}." for part in parts if part.volumetric)
    return bool(names) and all(name.startswith(haze_prefixes) for name in names)


def _find_general_refusal(
    renderer: Renderer,
    searched_groups: Sequence[Group],
    light_groups: Mapping[str, frozenset[str]],
) -> Refusal | None:
    """Return a reason against predictions that is not about a single group.

    There are three: nothing needs a render, the scene has haze, or no denoiser.

    Args:
        renderer: renderer of the space.
        searched_groups: groups that are searched.
        light_groups: for each group that changes only light or the finished image, by
            its name, the inputs that it changes.
    """
    # If only the finished image changed, one render would serve for all images anyway.
    needs_render = any(
        renderer.inputs_by_group.get(group.name) or light_groups.get(group.name)
        for group in searched_groups
    )
    if not needs_render:
        return Refusal("nothing that is searched needs a render to be differentiated")
    # With haze, images of lights still add up, but base colors have no matrix.
    changes_only_light = all(group.name in light_groups for group in searched_groups)
    if renderer.scene.is_volumetric and not changes_only_light:
        return HAZE
    if renderer.formation.denoiser != "oidn":
        return NOISE
    return None


def make_predictor(
    renderer: Renderer, u: Tensor, seed: int, tick: ProgressCallback = ignore_progress
) -> Predictor:
    """Make the predictor of images of a renderer's space, at a configuration.

    It is a `BasisRenderer` if light changes, and else a `LinearRenderer`. The arguments
    are the first ones of both.
    """
    lighting = find_light_groups(renderer)
    if lighting.changed_inputs:
        return BasisRenderer(renderer, u, seed, tick, changing=lighting)
    return LinearRenderer(renderer, u, seed, tick)


def count_lights(renderer: Renderer) -> int:
    """Return the number of lights that have a basis image; 1 if no light changes."""
    lighting = find_light_groups(renderer)
    if not lighting.changed_inputs:
        return 1
    inputs = renderer.scene.input_assembler(renderer.space.inputs(renderer.start))
    return len(LightBasis(renderer, lighting, inputs).inputs_of_light)


def count_samples(renderer: Renderer) -> int:
    """Return the samples per pixel that are traced before anything can be predicted.

    Under each light, there is a matrix for each base color that a group may change.
    Each matrix needs the samples of all its passes. Without a matrix, the light needs
    those of one image.
    """
    changed_inputs: set[str] = set()
    for group in renderer.plan.groups:
        changed_inputs |= renderer.inputs_by_group.get(group.name, frozenset())
    n_matrices = len(changed_inputs & find_linear_inputs(renderer))
    samples_per_light = COLLECTED_SPP
    if n_matrices:
        samples_per_pass, n_passes = plan_passes(renderer, COLLECTED_SPP)
        samples_per_light = samples_per_pass * n_passes * n_matrices
    return count_lights(renderer) * samples_per_light
