"""Render images of one seed in which only the surfaces of some shapes change.

A light path that meets none of these surfaces is the same in all images of a seed. So
only the first image is traced in full. For each further image, only the samples are
traced again whose path has met one of the surfaces in the first image, with the same
random numbers. Every sample is bit for bit that of an image that is traced in full.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.interrupts import INTERRUPTS
from advsearch.scene.assets import Float64Array
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import dr, mi, mitsuba_lock, scene_registry

# samplers whose numbers `paths.PathSamples` can compute for any sample
SAMPLERS = ("independent", "multijitter")
MAX_SAMPLES = 1 << 21  # largest number of samples of one launch, for its memory
MAX_STORED_BYTES = 1 << 28  # memory limit of what is stored for all seeds
N_CHANNELS = 9  # radiance, albedo and normal


@dataclass(frozen=True, eq=False)
class StoredPaths:
    """The light that the images of one seed have in common.

    Attributes:
        channel_sums: (pixels, channels) float64 sums over samples, without the light
            that depends on a changed surface.
        changed_sample_indices: for each launch the indices, a Dr.Jit array, of the
            samples whose path has met a changed surface.
    """

    channel_sums: Float64Array
    changed_sample_indices: list[Any]

    @property
    def n_bytes(self) -> int:
        """Memory, bytes: 4 for the index of each sample."""
        return int(
            self.channel_sums.nbytes
            + 4 * sum(map(dr.width, self.changed_sample_indices))
        )


class SharedPaths:
    """Render images of one scene, and trace paths that images share only once.

    The light of the seeds that were used last is stored, up to `MAX_STORED_BYTES`.

    Attributes:
        scene: the scene.

    Args:
        scene: the scene; see `can_share_paths`.
        inputs: names of the inputs that may change between images, such as
            "object.roughness". They belong to surfaces of shapes that emit no light and
            do not move.
    """

    def __init__(self, scene: MitsubaScene, inputs: Collection[str]) -> None:
        """Store the scene, and which inputs may change.

        Args:
            scene: the scene.
            inputs: names of the inputs that may change, such as "object.roughness".
        """
        self.scene = scene
        self._changeable_inputs = frozenset(inputs)
        self._changeable_shapes = {name.partition(".")[0] for name in inputs}
        # by seed, samples and depth, the seed that was used last at the end
        self._stored = dict[tuple[Any, ...], StoredPaths]()
        # values of all other inputs, for which the stored paths are valid
        self._fixed = dict[str, Tensor]()

    def render_images(
        self, inputs: Mapping[str, Tensor], seeds: Mapping[str, int], spp: int
    ) -> list[Tensor]:
        """Render images of one configuration, as `MitsubaScene.render_images` does.

        Args:
            inputs: values of inputs that differ from the base values.
            seeds: seed of the image "path", and perhaps of "guides". The guides come
                from the same samples as the radiance, so only the seed of "path"
                counts.
            spp: samples per pixel.

        Returns:
            The radiance (H, W, 3), and for "guides" albedo and normal (H, W, 6).
        """
        INTERRUPTS.raise_pending()  # stops here if the user has interrupted the run
        with mitsuba_lock:
            self._discard_if_stale(inputs)
            self.scene.set_inputs(inputs)
            if scene_registry.unused_keys:
                scene_registry.free_unused()
            spp = self.scene.round_sample_count(spp)
            radiance, guides = self._render(seeds["path"], spp)
            guides[..., :3].clamp_(0.0, 1.0)
            return [radiance, guides] if "guides" in seeds else [radiance]

    def _discard_if_stale(self, inputs: Mapping[str, Tensor]) -> None:
        """Discard all stored paths if an input has changed that is not changeable."""
        fixed = {
            name: value
            for name, value in inputs.items()
            if name not in self._changeable_inputs
        }
        if not _have_equal_values(fixed, self._fixed):
            self._stored.clear()
            self._fixed = {
                name: value.detach().clone() for name, value in fixed.items()
            }

    def _render(self, seed: int, spp: int) -> tuple[Tensor, Tensor]:
        """Render radiance (H, W, 3) and guides (H, W, 6) of the inputs that are set.

        If images of the seed are stored, only the samples that have met a changed
        surface are traced again.
        """
        key = (seed, spp, self.scene.current_max_depth)
        height, width = self.scene.resolution
        # sums over samples of the light that depends on changed surfaces
        changing = np.zeros((height * width, N_CHANNELS))
        if key in self._stored:
            # Taken out, and stored again below: so the seed used last is at the end.
            stored = self._stored.pop(key)
            self._trace_again(seed, spp, stored, changing)  # adds to `changing`
        else:
            stored = self._trace_all(seed, spp, changing)  # adds to `changing`
        self._store(key, stored)
        image = torch.from_numpy((stored.channel_sums + changing) / spp).float()
        image = image.reshape(height, width, N_CHANNELS)
        return image[..., :3].contiguous(), image[..., 3:].contiguous()

    def _trace_again(
        self, seed: int, spp: int, stored: StoredPaths, changing: Float64Array
    ) -> None:
        """Trace the samples again whose path has met a changed surface, and add them.

        Args:
            seed: seed of the image.
            spp: samples per pixel.
            stored: the light of the seed's images, with the indices of these samples.
            changing: (pixels, channels) array to which their light is added, in place.
        """
        for samples in stored.changed_sample_indices:
            if dr.width(samples):
                _unchanged, values, _has_met = self._trace(seed, spp, samples)
                _add_samples(changing, samples, values, spp)

    def _trace_all(self, seed: int, spp: int, changing: Float64Array) -> StoredPaths:
        """Trace all samples of a seed.

        Args:
            seed: seed of the image.
            spp: samples per pixel.
            changing: (pixels, channels) array to which the light that depends on
                changed surfaces is added, in place.

        Returns:
            The light that is common to images of the seed.
        """
        common = np.zeros_like(changing)
        met_samples = []
        first_pixel = 0
        for samples in _divide_samples(len(changing), spp):
            unchanged, changing_values, has_met = self._trace(seed, spp, samples)
            sums = [dr.block_sum(channel, spp).numpy() for channel in unchanged]
            end_pixel = first_pixel + len(sums[0])
            common[first_pixel:end_pixel] = np.stack(sums, axis=1)
            first_pixel = end_pixel
            # of these samples, those that have met a changed surface
            index = dr.compress(has_met)
            met = dr.gather(mi.UInt32, samples, index)
            dr.eval(met)
            met_samples.append(met)
            _add_selected_samples(changing, met, changing_values, index, spp)
        return StoredPaths(common, met_samples)

    def _trace(self, seed: int, spp: int, samples: Any) -> tuple[Any, Any, Any]:
        """Trace samples of an image by their indices.

        Args:
            seed: seed of the image.
            spp: samples per pixel.
            samples: Dr.Jit's indices of the samples in the image.

        Returns:
            Nine channels (radiance, albedo, normal) that do not depend on the changed
            surfaces; nine that do; and whether a path has met such a surface.
        """
        depth = self.scene.current_max_depth
        roulette_depth = self.scene.roulette_depth
        is_stratified = self.scene.sampler_name == "multijitter"
        trace = _make_sample_tracer(spp, is_stratified, depth, roulette_depth)
        shape_ids = sorted(self._changeable_shapes)
        key = ("shared paths", *shape_ids, spp, depth, roulette_depth)
        changed = self._list_changed_shapes()
        traced: tuple[Any, Any, Any] = self.scene.run_recorded(
            key, trace, changed, dr.opaque(mi.UInt32, seed), samples
        )
        dr.eval(traced)
        return traced

    def _list_changed_shapes(self) -> list[Any]:
        """Return Mitsuba's shapes whose surfaces may have changed."""
        return [
            shape
            for shape in self.scene.mitsuba_shapes
            if shape.id() in self._changeable_shapes
        ]

    def _store(self, key: tuple[Any, ...], paths: StoredPaths) -> None:
        """Store the common light of a seed's images; drop the least recently used."""
        self._stored[key] = paths
        n_bytes = sum(stored.n_bytes for stored in self._stored.values())
        while n_bytes > MAX_STORED_BYTES and len(self._stored) > 1:
            oldest_key = next(iter(self._stored))
            n_bytes -= self._stored.pop(oldest_key).n_bytes


def _have_equal_values(
    first: Mapping[str, Tensor], second: Mapping[str, Tensor]
) -> bool:
    """Return whether two mappings have the same names with equal tensors."""
    return first.keys() == second.keys() and all(
        torch.equal(value, second[name]) for name, value in first.items()
    )


def _add_selected_samples(
    sums: Float64Array, samples: Any, channels: Any, index: Any, spp: int
) -> None:
    """Add those values of samples to their pixels that an index selects.

    Args:
        sums: (pixels, channels) array that is changed.
        samples: Dr.Jit's indices of the selected samples in the image.
        channels: values of all samples of a launch.
        index: indices of the selected samples in the launch.
        spp: samples per pixel.
    """
    if dr.width(samples):
        values = [dr.gather(mi.Float, value, index) for value in channels]
        _add_samples(sums, samples, values, spp)


def _make_sample_tracer(
    spp: int, is_stratified: bool, depth: int, roulette_depth: int
) -> Callable[..., Any]:
    """Return the function that traces samples of an image, which Dr.Jit records.

    Args:
        spp: samples per pixel.
        is_stratified: whether the sampler is `multijitter`.
        depth: longest path in segments.
        roulette_depth: bounces from which on Russian roulette may end a path.
    """
    # imported here, since its classes need Mitsuba's variant
    from advsearch.scene.mitsuba_backend import paths

    def trace(scene: Any, sensor: Any, changed: Any, seed: Any, samples: Any) -> Any:
        """Trace paths; this is the function that Dr.Jit records."""
        numbers = paths.PathSamples(seed, samples, spp, is_stratified)
        ray = paths.sample_rays(sensor, numbers, samples)
        return paths.trace_paths(scene, ray, numbers, changed, depth, roulette_depth)

    return trace


def can_share_paths(scene: MitsubaScene) -> bool:
    """Return whether images of a scene can share light paths, and save time by it.

    They save time where light paths are long, as among trees and houses: elsewhere
    light soon leaves the scene. The other conditions exclude what `trace_paths` does
    not support.
    """
    description, filter_name = scene.description_and_filter
    # `MitsubaScene` chooses this integrator for scenes with long paths.
    has_long_paths = scene.integrator_name == "path"
    has_known_samples = filter_name == "box" and scene.sampler_name in SAMPLERS
    has_lens = bool(description.thin_lens) or description.camera_model is not None
    is_unsupported = (
        has_lens
        or bool(description.backdrop)
        or description.has_opacity
        or scene.is_volumetric
    )
    return has_long_paths and has_known_samples and not is_unsupported


def _divide_samples(n_pixels: int, spp: int) -> Iterator[Any]:
    """Yield the indices of all samples of an image, for one launch after another."""
    step = max(1, MAX_SAMPLES // spp)
    for first in range(0, n_pixels, step):
        count = min(step, n_pixels - first) * spp
        # `opaque`: a literal would be compiled into a kernel of its own for each
        # launch.
        first_sample = dr.opaque(mi.UInt32, first * spp)
        samples = dr.arange(mi.UInt32, count) + first_sample
        dr.eval(samples)
        yield samples


def _add_samples(sums: Float64Array, samples: Any, channels: Any, spp: int) -> None:
    """Add values of samples to their pixels.

    Args:
        sums: (pixels, channels), is changed.
        samples: indices of the samples.
        channels: value of each sample, by channel.
        spp: samples per pixel.
    """
    pixel = (samples // spp).numpy()
    for index, channel in enumerate(channels):
        sums[:, index] += np.bincount(pixel, channel.numpy(), len(sums))
