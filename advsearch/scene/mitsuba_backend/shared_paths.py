"""Images of one seed, among which only the surfaces of some shapes change.

A light path that meets none of these surfaces is the same in all images of a seed. So
only the first image is traced in full. Of each further image, those samples are traced
again, with the random numbers that they have, whose path has met one of the surfaces in
the first. Every sample is bit for bit what it is in an image that is traced in full.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.interrupts import INTERRUPTS
from advsearch.scene.assets import Float64Array
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import dr, mi, mitsuba_lock, population

SAMPLERS = ("independent", "multijitter")  # those whose numbers are known by sample
MAX_SAMPLES = 1 << 21  # of one launch, for its memory
MAX_STORED_BYTES = 1 << 28
N_CHANNELS = 9  # radiance, albedo and normal


@dataclass(frozen=True, eq=False)
class StoredPaths:
    """What the images of one seed have in common.

    Attributes:
        sums: (pixels, channels) float64, the sums over samples of what depends on no
            changed surface.
        samples: for each launch the indices (Dr.Jit's) of the samples that have met
            one.
    """

    sums: Float64Array
    samples: list[Any]

    @property
    def n_bytes(self) -> int:
        """Memory that it takes."""
        return int(self.sums.nbytes + 4 * sum(map(dr.width, self.samples)))


class SharedPaths:
    """Render images of one scene, each path that is common to several only once.

    The latest seeds are stored, `MAX_STORED_BYTES` of them.

    Attributes:
        scene: the scene.

    Args:
        scene: scene; see `can_share_paths`.
        inputs: names of the inputs that may change: of surfaces of shapes that emit no
            light and don't move.
    """

    def __init__(self, scene: MitsubaScene, inputs: Collection[str]) -> None:
        """Store the scene and which inputs may change, as "object.roughness"."""
        self.scene = scene
        self._inputs = frozenset(inputs)
        self._shapes = {name.partition(".")[0] for name in inputs}
        self._stored = dict[tuple[Any, ...], StoredPaths]()
        # the other inputs of what is stored
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
        INTERRUPTS.look()
        with mitsuba_lock:
            self._check_fixed(inputs)
            self.scene.set_inputs(inputs)
            if population.unused:
                population.free_unused()
            spp = self.scene.round_sample_count(spp)
            radiance, guides = self._render(seeds["path"], spp)
            guides[..., :3].clamp_(0.0, 1.0)
            return [radiance, guides] if "guides" in seeds else [radiance]

    def _check_fixed(self, inputs: Mapping[str, Tensor]) -> None:
        """Forget everything if inputs have changed that should not."""
        fixed = {
            name: value for name, value in inputs.items() if name not in self._inputs
        }
        is_same = fixed.keys() == self._fixed.keys() and all(
            torch.equal(value, self._fixed[name]) for name, value in fixed.items()
        )
        if not is_same:
            self._stored.clear()
            self._fixed = {
                name: value.detach().clone() for name, value in fixed.items()
            }

    def _render(self, seed: int, spp: int) -> tuple[Tensor, Tensor]:
        """Render radiance (H, W, 3) and guides (H, W, 6) of the inputs that are set.

        If images of the seed are stored, only the samples that have met a changed
        surface are traced again.
        """
        key = (seed, spp, self.scene.depth)
        height, width = self.scene.resolution
        changing = np.zeros((height * width, N_CHANNELS))
        if key in self._stored:
            stored = self._stored.pop(key)
            for samples in stored.samples:
                if dr.width(samples):
                    _, values, _ = self._trace(seed, spp, samples)
                    _add_samples(changing, samples, values, spp)
        else:
            stored = self._trace_all(seed, spp, changing)
        self._store(key, stored)
        image = torch.from_numpy((stored.sums + changing) / spp).float()
        image = image.reshape(height, width, N_CHANNELS)
        return image[..., :3].contiguous(), image[..., 3:].contiguous()

    def _trace_all(self, seed: int, spp: int, changing: Float64Array) -> StoredPaths:
        """Trace all samples, and return what is common to images of the seed.

        Args:
            seed: seed of the image.
            spp: samples per pixel.
            changing: (pixels, channels) to which the sums of all else are added.
        """
        common = np.zeros_like(changing)
        met_samples = []
        first = 0  # pixel
        for samples in _divide_samples(len(changing), spp):
            unchanged, values, has_met = self._trace(seed, spp, samples)
            sums = [dr.block_sum(channel, spp).numpy() for channel in unchanged]
            last = first + len(sums[0])
            common[first:last] = np.stack(sums, axis=1)
            first = last
            index = dr.compress(has_met)
            met = dr.gather(mi.UInt32, samples, index)
            dr.eval(met)
            met_samples.append(met)
            if dr.width(met):
                met_values = [dr.gather(mi.Float, value, index) for value in values]
                _add_samples(changing, met, met_values, spp)
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
        # it needs the variant
        from advsearch.scene.mitsuba_backend import paths

        is_stratified = self.scene.sampler == "multijitter"
        depth = self.scene.depth
        roulette_depth = self.scene.roulette_depth

        def trace(
            scene: Any, sensor: Any, changed: Any, seed: Any, samples: Any
        ) -> Any:
            """Trace paths; this is the function that Dr.Jit records."""
            numbers = paths.PathSamples(seed, samples, spp, is_stratified)
            ray = paths.sample_rays(sensor, numbers, samples)
            return paths.trace_paths(
                scene, ray, numbers, changed, depth, roulette_depth
            )

        changed = [
            shape for shape in self.scene.mitsuba_shapes if shape.id() in self._shapes
        ]
        key = ("shared paths", *sorted(self._shapes), spp, depth, roulette_depth)
        traced: tuple[Any, Any, Any] = self.scene.run_recorded(
            key, trace, changed, dr.opaque(mi.UInt32, seed), samples
        )
        dr.eval(traced)
        return traced

    def _store(self, key: tuple[Any, ...], paths: StoredPaths) -> None:
        """Store what images of a seed have in common; the oldest makes room."""
        self._stored[key] = paths
        n_bytes = sum(stored.n_bytes for stored in self._stored.values())
        while n_bytes > MAX_STORED_BYTES and len(self._stored) > 1:
            n_bytes -= self._stored.pop(next(iter(self._stored))).n_bytes


def can_share_paths(scene: MitsubaScene) -> bool:
    """Return whether images of a scene can share light paths, and save time by it.

    They save time where light paths are long, as among trees and houses: elsewhere
    light soon leaves the scene. The other conditions are what `trace_paths` covers.
    """
    description, filter_name = scene.definition
    has_long_paths = scene.integrator == "path"
    has_known_samples = filter_name == "box" and scene.sampler in SAMPLERS
    has_lens = bool(description.thin_lens) or description.camera_model is not None
    passes_surfaces = (
        bool(description.backdrop) or description.has_opacity or scene.is_volumetric
    )
    return has_long_paths and has_known_samples and not (has_lens or passes_surfaces)


def _divide_samples(n_pixels: int, spp: int) -> Iterator[Any]:
    """Yield the indices of all samples of an image, for one launch after another."""
    step = max(1, MAX_SAMPLES // spp)
    for first in range(0, n_pixels, step):
        count = min(step, n_pixels - first) * spp
        samples = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first * spp)
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
