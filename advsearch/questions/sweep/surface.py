"""Find which parts of an object's surface, when visible, go with wrong predictions.

See docs/sweeps.md, "The surface". The interval of a difference is that of Newcombe
(1998, Statistics in Medicine 17, method 10), from Wilson's (1927). Whether a difference
may be chance is tested by permuting the wrong predictions: the likelihood ratio of a
part is compared with the largest one of all parts in each permutation (Westfall and
Young 1993, single-step maximum). If images share a draw (frames of a drive), the
predictions of a draw are permuted together, and there is no interval.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from math import ceil
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from scipy.special import xlogy
from torch import Tensor

from advsearch import seeds
from advsearch.attacks.domain import split_into_batches
from advsearch.engine.loading import fit_camera, load_scene
from advsearch.engine.record import read_judgement
from advsearch.options import OUT_OF_VIEW
from advsearch.progress import Progress
from advsearch.questions.sweep.job import Job, SceneLoader, SweptScene
from advsearch.questions.sweep.result import count_independent_predictions
from advsearch.questions.sweep.summary import SurfaceMap, SurfacePart, SurfaceTable
from advsearch.report.figures import render_figure
from advsearch.report.wording import shorten_name
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row
from advsearch.scene.assets import ObjectAsset
from advsearch.scene.description import OBJECT
from advsearch.scene.formation import Surfaces
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.surface_parts import MAP_SIZE, SurfaceParts
from advsearch.statistics.intervals import wilson_interval
from advsearch.trust.writing import write_bytes

Int64Array = npt.NDArray[np.int64]
Float64Array = npt.NDArray[np.float64]
# number of permutations of the wrong predictions; no p-value is below 1 / 200
N_PERMUTATIONS = 199
# probability that any part is significant if no part affects the predictions
SIGNIFICANCE_LEVEL = 0.05
# numbers of a compared part; see `_compute_comparison`
COMPARISON_COLUMNS = ("difference", "low", "high", "p")


class PartCounts:
    """Counts of images and of wrong predictions for n parts of a surface.

    Attributes:
        n_images: number of images.
        n_failures: number of images whose prediction is wrong.
        visible_counts: (n,) number of images that show each part.
        wrong_counts: (n,) number of failures among these.
        permuted_counts: (N_PERMUTATIONS, n) what `wrong_counts` is after each
            permutation of the failures.
        permuted_failures: (bytes of N_PERMUTATIONS bits, n_images) whether each image
            is a failure in each permutation, from `permute_draws`; None permutes single
            images while they are added.
    """

    def __init__(
        self,
        n_parts: int,
        n_images: int,
        n_failures: int,
        seed: int,
        permuted_failures: npt.NDArray[np.uint8] | None = None,
    ) -> None:
        """Begin with counts of 0.

        Args:
            n_parts: number of parts of the surface.
            n_images: number of images that will be added.
            n_failures: number of these whose prediction is wrong.
            seed: seed of the permutations.
            permuted_failures: permutations from `permute_draws`, if images share draws;
                None permutes single images while they are added.
        """
        self.permuted_failures = permuted_failures
        self.n_images = n_images
        self.n_failures = n_failures
        self.visible_counts = np.zeros(n_parts, np.int64)
        self.wrong_counts = np.zeros(n_parts, np.int64)
        self.permuted_counts = np.zeros((N_PERMUTATIONS, n_parts), np.uint32)
        # images that are still to be added, and failures left in each permutation
        self._images_left = n_images
        self._failures_left = np.full(N_PERMUTATIONS, n_failures)
        self._random = np.random.default_rng(seed)

    def add_image(self, parts: Int64Array, failed: bool) -> None:
        """Count an image, and decide in which permutations it is a failure.

        A permutation assigns the failures to the images anew, at random. Its counts
        show what chance alone would give if the predictions did not depend on the
        parts. Images are added in the order of `permuted_failures`, `n_images` in all.

        Args:
            parts: indices of the parts that the image shows, each once.
            failed: whether its prediction is wrong.
        """
        self.visible_counts[parts] += 1
        self.wrong_counts[parts] += failed
        if self.permuted_failures is None:
            is_failure = self._sample_permutations()
        else:
            image = self.n_images - self._images_left
            # (bytes,) one bit for each permutation
            packed_bits = self.permuted_failures[:, image]
            is_failure = np.unpackbits(packed_bits, count=N_PERMUTATIONS).astype(bool)
        self._images_left -= 1
        failing_permutations = np.flatnonzero(is_failure)
        self._failures_left[failing_permutations] -= 1
        self.permuted_counts[np.ix_(failing_permutations, parts)] += 1

    def _sample_permutations(self) -> npt.NDArray[np.bool_]:
        """Sample whether the next image is a failure in each permutation.

        This is sequential sampling (Knuth's algorithm S): the probability is failures
        left / images left, so that each choice of `n_failures` images is equally
        likely.
        """
        uniform = self._random.random(N_PERMUTATIONS)
        return uniform * self._images_left < self._failures_left


def compare_parts(
    counts: PartCounts, part_slice: slice, min_images: int
) -> pd.DataFrame:
    """Compare predictions about images that show a part with those that do not.

    Intervals: Newcombe (1998), method 10. P-values: single-step maximum of the
    likelihood ratio over permutations (Westfall and Young 1993).

    Args:
        counts: counts of all parts.
        part_slice: the parts to compare.
        min_images: number of images that have to show a part, and number that have to
            hide it, for a comparison.

    Returns:
        A row for each part, by its index; NaN if it was not `compared`. Columns:
        `difference`, `low`, `high` and `p`, as `_compute_comparison` returns them;
        `significant`: whether `p` is at most `SIGNIFICANCE_LEVEL`;
        `strength`: see `_compute_strength`.
    """
    n_visible = counts.visible_counts[part_slice]
    n_hidden = counts.n_images - n_visible
    is_compared = (n_visible >= min_images) & (n_hidden >= min_images)
    part_indices = np.arange(len(counts.visible_counts))[part_slice]
    parts = pd.DataFrame(np.nan, index=part_indices, columns=list(COMPARISON_COLUMNS))
    if is_compared.any():
        compared_parts = part_indices[is_compared]
        parts.loc[compared_parts] = _compute_comparison(counts, compared_parts)
    significant = parts.p <= SIGNIFICANCE_LEVEL
    strength = _compute_strength(parts)
    return parts.assign(
        compared=is_compared, significant=significant, strength=strength
    )


def _compute_strength(parts: pd.DataFrame) -> Float64Array:
    """Compute how clearly each part differs, (n,).

    That is the distance of the interval from 0, which is 0 if the interval contains 0.
    Without an interval it is the absolute difference; 0 if the part was not compared.

    Args:
        parts: the `COMPARISON_COLUMNS` of each part.
    """
    # An interval above 0 has the distance `low`, one below 0 the distance `-high`. In
    # both cases the other number is negative. If the interval contains 0, both are.
    distance_from_0 = np.maximum(parts.low, -parts.high)
    has_interval = parts.low.notna()
    strength = np.where(has_interval, distance_from_0, parts.difference.abs())
    strength_or_0: Float64Array = np.nan_to_num(np.maximum(strength, 0.0))
    return strength_or_0


def _compute_comparison(counts: PartCounts, parts: Int64Array) -> pd.DataFrame:
    """Compare the rates of wrong predictions where parts are visible and hidden.

    Args:
        counts: counts of all parts.
        parts: (m,) indices of the parts to compare.

    Returns:
        A row for each part, by its index. `difference`: rate of wrong predictions where
        the part is visible, minus that where it is hidden; `low` and `high`: bounds of
        its 95 % interval for this part alone, NaN if images share a draw, since they
        are not independent then; `p`: probability that any part would differ at least
        as clearly by chance.
    """
    n = counts.visible_counts[parts]
    k = counts.wrong_counts[parts]
    difference, low, high = _compare_rates(
        k, n, other_k=counts.n_failures - k, other_n=counts.n_images - n
    )
    share_draws = counts.permuted_failures is not None
    if share_draws:
        low = np.full(len(n), np.nan)
        high = np.full(len(n), np.nan)
    p_value = _compute_permutation_p_value(counts, k, n, parts)
    columns = np.stack([difference, low, high, p_value], axis=1)
    return pd.DataFrame(columns, index=parts, columns=list(COMPARISON_COLUMNS))


STATISTIC_TOLERANCE = 1e-9  # statistics that differ by less, by rounding, are equal


def _compute_permutation_p_value(
    counts: PartCounts, k: Int64Array, n: Int64Array, parts: Int64Array
) -> Float64Array:
    """Compute for each part the probability that any part differs as clearly by chance.

    The p-value of a part is the fraction of permutations in which the largest statistic
    of all parts is at least the statistic of this part. The data themselves count as
    one more permutation, so that p is never 0.

    Args:
        counts: counts with the permuted failures of all parts.
        k: (m,) number of failures among the images that show each compared part.
        n: (m,) number of these images.
        parts: (m,) indices of the compared parts.
    """
    # The number of images that show a part is the same in all permutations. Only the
    # number of failures among them changes.
    max_statistics = np.sort(
        [
            _compute_statistic(counts, failure_counts[parts].astype(np.int64), n).max()
            for failure_counts in counts.permuted_counts
        ]
    )
    statistic = _compute_statistic(counts, k, n)
    n_permutations = len(max_statistics)
    n_below = np.searchsorted(max_statistics, statistic - STATISTIC_TOLERANCE)
    # permutations whose largest statistic is at least that of the part
    n_above = n_permutations - n_below
    return np.asarray((1 + n_above) / (1 + n_permutations))


def _compute_statistic(
    counts: PartCounts, k: Int64Array, n: Int64Array
) -> Float64Array:
    """Compute the likelihood ratio statistic (m,) of parts from `counts` of all images.

    Args:
        counts: counts of all parts.
        k: (m,) number of failures among the images that show each part.
        n: (m,) number of these images.
    """
    return _compute_likelihood_ratio(k, n, counts.n_failures, counts.n_images)


def _compute_likelihood_ratio(
    k: Int64Array, n: Int64Array, n_failures: int, n_images: int
) -> Float64Array:
    """Compute the likelihood ratio statistic of two failure rates against one (G-test).

    The images that show a part may have one failure rate, and the others another; or
    all have the same. The statistic is 2 log(likelihood with two rates / likelihood
    with one rate), at least 0. With the cells c, the row and column sums m and the
    total N of the table of counts it is 2 (N log N + sum c log c - sum m log m).

    Args:
        k: failures among the images that show the part.
        n: images that show the part; broadcast with `k`.
        n_failures: failures in all.
        n_images: images in all.
    """
    # the table of images by whether they show the part, and by whether they fail
    visible_failing = k
    visible_passing = n - k
    hidden_failing = n_failures - k
    hidden_passing = n_images - n - n_failures + k
    cells = (visible_failing, visible_passing, hidden_failing, hidden_passing)
    # the sums of the rows and of the columns of this table
    margins = (n, n_images - n, np.array(n_failures), np.array(n_images - n_failures))
    log_ratio = (
        xlogy(n_images, n_images)
        + sum(xlogy(count, count) for count in cells)
        - sum(xlogy(count, count) for count in margins)
    )
    return np.asarray(2.0 * log_ratio)


def _compare_rates(
    k: Int64Array, n: Int64Array, other_k: Int64Array, other_n: Int64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Compute the difference k/n - other_k/other_n with its 95 % interval.

    Newcombe (1998), method 10, from the Wilson intervals (l, u) of both rates p:
    low = d - sqrt((p1 - l1)² + (u2 - p2)²), high = d + sqrt((u1 - p1)² + (p2 - l2)²).

    Returns:
        The difference d, and the lower and the upper bound.
    """
    rate_1 = k / n
    rate_2 = other_k / other_n
    lower_1, upper_1 = wilson_interval(rate_1, n)
    lower_2, upper_2 = wilson_interval(rate_2, other_n)
    difference = rate_1 - rate_2
    low = difference - np.hypot(rate_1 - lower_1, upper_2 - rate_2)
    high = difference + np.hypot(upper_1 - rate_1, rate_2 - lower_2)
    return difference, low, high


# A part is compared if at least this many images show it, and as many do not.
MIN_IMAGES = 5
MIN_RAYS = 4 * MAP_SIZE
"""Minimum number of rays along each side of an image. With fewer, many cells of the map
would lie between two pixels.
"""
MAX_LISTED_PARTS = 5
"""Maximum number of parts of each kind that the summary lists: so many that go with
wrong predictions, and as many that go with right ones.
"""
# distance between two listed parts, in units of the object's largest extent, so that
# a spot is listed once
MIN_PART_DISTANCE = 0.1
COUNTS_FILE = "artifacts/surface.npz"
VIEW_ANGLES = (
    (0.0, 20.0),
    (90.0, 20.0),
    (180.0, 20.0),
    (270.0, 20.0),
    (0.0, 80.0),
    (0.0, -60.0),
)
"""Azimuth and elevation in degrees of the cameras of the figure's views."""
VIEW_SIZE = 240
# the prediction of an image without a row, or without the object
UNKNOWN = -1
BATCH_SIZE = 16  # number of images whose configurations are computed at once


class SurfaceCounts:
    """Counts of visible parts and wrong predictions on the surface of one object.

    Attributes:
        parts: the parts of the surface.
        part_counts_of_model: counts of the parts for each model.
    """

    def __init__(self, parts: SurfaceParts, part_counts: Sequence[PartCounts]) -> None:
        self.parts = parts
        self.part_counts_of_model = tuple(part_counts)

    def add_image(self, surfaces: Surfaces, wrong_by_model: Mapping[int, bool]) -> None:
        """Count an image for each model.

        Parts are the cells of the map. On a mesh of few faces, the faces are parts,
        too; their indices follow those of the cells.

        Args:
            surfaces: the surface that each pixel of the image shows.
            wrong_by_model: whether the prediction is wrong, by the index of the model.
        """
        is_object = surfaces.visible_mask(OBJECT)
        face = surfaces.face_index[is_object].numpy()
        uv = surfaces.uv[is_object].numpy().astype(np.float64)
        visible_parts = np.unique(self.parts.find_cells(face, uv))
        if self.parts.counts_faces:
            visible_faces = np.unique(face) + MAP_SIZE * MAP_SIZE
            visible_parts = np.concatenate([visible_parts, visible_faces])
        for model, failed in wrong_by_model.items():
            self.part_counts_of_model[model].add_image(visible_parts, failed)

    def compare_all(self) -> list[dict[str, pd.DataFrame]]:
        """Return for each model the comparison of its parts, by the kind of the parts."""
        return [
            _compare_kinds(part_counts, self.parts)
            for part_counts in self.part_counts_of_model
        ]

    def summarize_kind(
        self,
        object_name: str,
        model: str,
        counts: PartCounts,
        kind: str,
        compared: pd.DataFrame,
    ) -> SurfaceTable:
        """Return how a model's predictions depend on the parts of one kind.

        `strongest` of the table lists the strongest significant parts, no two of them
        close to each other: first those that go with wrong predictions, then those that
        go with right ones.

        Args:
            object_name: name of the object.
            model: name of the model.
            counts: counts of the model.
            kind: kind of the parts, a key of `SurfaceParts.kinds`.
            compared: comparison of the parts, from `compare_parts`.
        """
        is_worse = compared.significant & (compared.difference > 0)
        is_better = compared.significant & (compared.difference < 0)
        # `counts` has the parts of all kinds, `compared` only those of this one.
        visible_counts = counts.visible_counts[self.parts.part_slices[kind]]
        return SurfaceTable(
            object=object_name,
            model=model,
            part=kind,
            unwrapped=self.parts.is_unwrapped,
            visible=int((visible_counts > 0).sum()),
            compared=int(compared["compared"].sum()),
            worse=int(is_worse.sum()),
            better=int(is_better.sum()),
            strongest=[
                *self._list_strongest(counts, compared, is_worse),
                *self._list_strongest(counts, compared, is_better),
            ],
        )

    def _list_strongest(
        self, counts: PartCounts, compared: pd.DataFrame, is_candidate: pd.Series
    ) -> list[SurfacePart]:
        """Return the strongest of some parts, no two of them close to each other.

        Args:
            counts: counts of a model.
            compared: comparison of the parts, from `compare_parts`.
            is_candidate: whether each part may be listed.
        """
        return [
            self._describe_part(part, counts, compared)
            for part in self._select_spread(compared[is_candidate])
        ]

    def _select_spread(self, candidates: pd.DataFrame) -> list[int]:
        """Select the strongest parts such that no two are close to each other.

        Of two parts within `MIN_PART_DISTANCE` the weaker one is left out. At most
        `MAX_LISTED_PARTS` are selected.
        """
        extent = float(np.ptp(self.parts.mesh.vertices, axis=0).max())
        position = self.parts.centers
        selected: list[int] = []
        by_strength = candidates.sort_values("strength", ascending=False, kind="stable")
        for part in by_strength.index:
            distance = np.linalg.norm(position[selected] - position[part], axis=1)
            if distance.min(initial=np.inf) >= MIN_PART_DISTANCE * extent:
                selected.append(int(part))
            if len(selected) == MAX_LISTED_PARTS:
                break
        return selected

    def _describe_part(
        self, part: int, counts: PartCounts, compared: pd.DataFrame
    ) -> SurfacePart:
        """Return the counts and the comparison of one part for the summary.

        Args:
            part: index of the part.
            counts: counts of a model.
            compared: comparison of the parts, from `compare_parts`.
        """
        n_visible = int(counts.visible_counts[part])
        n_visible_wrong = int(counts.wrong_counts[part])
        n_hidden = counts.n_images - n_visible
        n_hidden_wrong = counts.n_failures - n_visible_wrong
        n_visible_right = n_visible - n_visible_wrong
        n_hidden_right = n_hidden - n_hidden_wrong
        u, v = self.parts.center_uvs[part].tolist()
        numbers = compared.loc[part]
        return SurfacePart(
            face=int(self.parts.face_of_part[part]),
            u=u,
            v=v,
            center=self.parts.centers[part].tolist(),
            visible=count_independent_predictions(n_visible_right, n_visible),
            hidden=count_independent_predictions(n_hidden_right, n_hidden),
            difference=float(numbers["difference"]),
            interval=(float(numbers["low"]), float(numbers["high"])),
            p=float(numbers["p"]),
        )


def map_surface(
    scenes: SceneLoader, rows: Iterable[Row], run: RunDirectory, progress: Progress
) -> SurfaceMap:
    """Count wrong predictions over the surface of each object of a sweep.

    Writes the counts and their figure into the run directory.

    Args:
        scenes: scenes of the sweep.
        rows: all rows of the sweep.
        run: run directory into which the files are written.
        progress: advances by the number of predictions.

    Returns:
        The tables for the summary.
    """
    job = scenes.job
    wrong = _read_wrong(scenes, rows)  # (scenes, images, models)
    assets = {
        named_scene.object_name: named_scene.scene.description.object
        for named_scene in job.scenes
    }
    counts = _make_counts(scenes, assets, wrong)
    for scene, wrong_in_scene in enumerate(wrong):
        scene_counts = counts[job.scenes[scene].object_name]
        _count_scene(scenes, scene, wrong_in_scene, scene_counts, progress)
    return _write_map(counts, assets, [model.name for model in job.models], run)


def _read_wrong(scenes: SceneLoader, rows: Iterable[Row]) -> npt.NDArray[np.int8]:
    """Return which predictions are wrong: 1, 0 or UNKNOWN, (scenes, images, models)."""
    job = scenes.job
    shape = (len(job.scenes), job.images_per_scene, len(job.models))
    wrong: npt.NDArray[np.int8] = np.full(shape, UNKNOWN, np.int8)
    for row in rows:
        # If nothing of the object is in an image, the image counts neither as one that
        # shows a part nor as one that hides it.
        if row.label != OUT_OF_VIEW:
            row_number = row.step
            wrong.flat[row_number] = not read_judgement(row).right
    return wrong


def _make_counts(
    scenes: SceneLoader,
    assets: Mapping[str, ObjectAsset],
    wrong: npt.NDArray[np.int8],
) -> dict[str, SurfaceCounts]:
    """Create the counts of each object, before any image is added.

    Args:
        scenes: scenes of the sweep.
        assets: the objects by name.
        wrong: (scenes, images, models) 1, 0 or UNKNOWN, from `_read_wrong`.
    """
    draws = _find_draws(scenes, wrong, scenes.job)
    name_of_scene = [scene.object_name for scene in scenes.job.scenes]
    counts = dict[str, SurfaceCounts]()
    for object_index, (name, asset) in enumerate(assets.items()):
        has_object = np.array([scene_name == name for scene_name in name_of_scene])
        model_seeds = _make_model_seeds(scenes.job, object_index)
        parts = SurfaceParts(asset.mesh)
        part_counts = _make_all_part_counts(
            parts, wrong[has_object], draws[has_object], model_seeds
        )
        counts[name] = SurfaceCounts(parts, part_counts)
    return counts


def _make_all_part_counts(
    parts: SurfaceParts,
    wrong: npt.NDArray[np.int8],
    draws: Int64Array,
    model_seeds: Sequence[int],
) -> list[PartCounts]:
    """Create the counts of one object for each model, before any image is added.

    Args:
        parts: parts of the object.
        wrong: (scenes, images, models) 1, 0 or UNKNOWN.
        draws: (scenes, images) the draw of each image.
        model_seeds: seed of the permutations for each model.
    """
    return [
        _make_part_counts(parts, wrong[..., model], draws, seed)
        for model, seed in enumerate(model_seeds)
    ]


def _make_model_seeds(job: Job, object_index: int) -> list[int]:
    """Return the seed of the permutations of an object for each model.

    Each pair of an object and a model has a seed of its own, and so permutations of its
    own.
    """
    n_models = len(job.models)
    pair_numbers = [object_index * n_models + model for model in range(n_models)]
    return [
        seeds.derive_seed(job.config.seed, "surface", number) for number in pair_numbers
    ]


def _find_draws(
    scenes: SceneLoader, wrong: npt.NDArray[np.int8], job: Job
) -> npt.NDArray[Any]:
    """Return the draw of each image, (scenes, images of a scene).

    Images are numbered through all scenes. Which image has which draw is the same for
    all sizes of images, so those of the first size are used.
    """
    n_scenes, images_per_scene, _ = wrong.shape
    configurations = scenes.load_scene(0).configurations_by_size[job.image_sizes[0]]
    units = configurations.independent_units
    image_numbers = np.arange(n_scenes * images_per_scene)
    draws = np.asarray(units.find_cluster(image_numbers))
    return draws.reshape(n_scenes, images_per_scene)


def _make_part_counts(
    parts: SurfaceParts, wrong: npt.NDArray[np.int8], draws: Int64Array, seed: int
) -> PartCounts:
    """Create the counts of one object and one model, before any image is added.

    Args:
        parts: parts of the object.
        wrong: (scenes, images) 1, 0 or UNKNOWN.
        draws: (scenes, images) the draw of each image.
        seed: seed of the permutations.
    """
    permuted = permute_draws(wrong.ravel(), draws.ravel(), seed)
    n_known = int((wrong != UNKNOWN).sum())
    n_failures = int((wrong == 1).sum())
    return PartCounts(parts.n_parts, n_known, n_failures, seed, permuted)


def _count_scene(
    scenes: SceneLoader,
    scene: int,
    wrong: npt.NDArray[np.int8],
    counts: SurfaceCounts,
    progress: Progress,
) -> None:
    """Find the visible surface in every image of a scene and count its parts.

    Small images are traced with several rays per pixel; see `MIN_RAYS`. Models of one
    image size share the traced image.

    Args:
        scenes: scenes of the sweep.
        scene: the index of the scene.
        wrong: (images, models) 1, 0 or UNKNOWN, from `_read_wrong`.
        counts: counts of the scene's object.
        progress: advances by the number of predictions.
    """
    swept_scene = scenes.load_scene(scene)
    n_images, n_models = wrong.shape
    for batch in split_into_batches(0, n_images, BATCH_SIZE):
        for size in dict.fromkeys(scenes.job.image_sizes):
            _count_batch(swept_scene, size, batch, wrong, counts)
        progress.advance(len(batch) * n_models)


def _count_batch(
    scene: SweptScene,
    size: tuple[int, int],
    batch: range,
    wrong: npt.NDArray[np.int8],
    counts: SurfaceCounts,
) -> None:
    """Count the visible parts in consecutive images of one size.

    Args:
        scene: the scene.
        size: (height, width) of the images.
        batch: numbers of the images in the scene.
        wrong: (images, models) 1, 0 or UNKNOWN, of all images of the scene.
        counts: counts of the scene's object.
    """
    # The scenes before this one have the same number of images each.
    images_before = scene.number * len(wrong)
    batch_u = scene.configurations_by_size[size].make_configurations(
        batch.start, len(batch), before=images_before
    )
    images_surfaces = _find_batch_surfaces(scene, size, batch_u)
    models = scene.job.list_models_of_size(size)
    for number, surfaces in zip(batch, images_surfaces, strict=True):
        counts.add_image(surfaces, _select_known(wrong[number], models))


def _find_batch_surfaces(
    scene: SweptScene, size: tuple[int, int], batch_u: Tensor
) -> Iterator[Surfaces]:
    """Find the visible surface in each of several images of a scene, one by one.

    Args:
        scene: the scene.
        size: (height, width) of the images.
        batch_u: (n, d) configurations of the images.
    """
    renderer = scene.renderer_of_size[size]
    # at least `MIN_RAYS` rays along the shorter side of the image
    rays_per_pixel = ceil(MIN_RAYS / min(size))
    for u in batch_u:
        yield renderer.find_surfaces(u, rays_per_pixel)


def _select_known(
    wrong: npt.NDArray[np.int8], models: Sequence[int]
) -> dict[int, bool]:
    """Return whether each model is wrong, by its index, without unknown predictions.

    Args:
        wrong: (all models,) 1, 0 or UNKNOWN.
        models: indices of the models to select.
    """
    return {model: bool(wrong[model]) for model in models if wrong[model] != UNKNOWN}


def permute_draws(
    wrong: npt.NDArray[np.int8], draws: Int64Array, seed: int
) -> npt.NDArray[np.uint8] | None:
    """Permute predictions among the draws, `N_PERMUTATIONS` times.

    Images of one draw are not independent. Therefore all predictions of a draw move
    together to another draw.

    Args:
        wrong: (n,) whether each prediction is wrong, or UNKNOWN. Every draw has the
            same number of images.
        draws: (n,) the draw of each image.
        seed: seed of the permutations.

    Returns:
        Whether each image with a known prediction gets a wrong one, in each
        permutation: uint8 (bytes, known images), where the bits of a column are the
        permutations. A known image may get an unknown prediction, which counts as not
        wrong. None if each image has a draw of its own.
    """
    _, draw_sizes = np.unique(draws, return_counts=True)
    is_independent = draw_sizes.max(initial=1) == 1
    if is_independent:
        return None
    is_known = wrong != UNKNOWN
    is_wrong = wrong == 1
    # (draws, images of a draw): row k has the indices of the images of draw k
    images_of_draw = np.argsort(draws, kind="stable").reshape(len(draw_sizes), -1)
    permuted_is_wrong = _permute_rows(is_wrong, images_of_draw, seed)
    return np.packbits(permuted_is_wrong[:, is_known], axis=0)


def _permute_rows(
    is_wrong: npt.NDArray[np.bool_], images_of_draw: npt.NDArray[np.intp], seed: int
) -> npt.NDArray[np.bool_]:
    """Return predictions (N_PERMUTATIONS, n) that are permuted among the draws.

    Args:
        is_wrong: (n,) whether each prediction is wrong.
        images_of_draw: (draws, images of a draw) indices of the images of each draw.
        seed: seed of the permutations.
    """
    generator = np.random.default_rng(seed)
    permuted_is_wrong = np.zeros((N_PERMUTATIONS, len(is_wrong)), bool)
    for permutation in permuted_is_wrong:  # a view of one row, which is filled
        # The images of each draw get the predictions of another draw.
        source_images = images_of_draw[generator.permutation(len(images_of_draw))]
        permutation[images_of_draw] = is_wrong[source_images]
    return permuted_is_wrong


def _write_map(
    counts: Mapping[str, SurfaceCounts],
    assets: Mapping[str, ObjectAsset],
    models: Sequence[str],
    run: RunDirectory,
) -> SurfaceMap:
    """Compare the counts of all objects, and write them with their figure.

    Args:
        counts: counts by the name of the object.
        assets: the objects by name.
        models: names of the models.
        run: run directory into which the files are written.
    """
    tables = list[SurfaceTable]()
    panels = list[Panel]()
    arrays: dict[str, Any] = {
        "objects": np.array(list(counts)),
        "models": np.array(models),
    }
    for number, (name, object_counts) in enumerate(counts.items()):
        comparisons = object_counts.compare_all()
        for array_name, array in _list_arrays(object_counts, comparisons).items():
            arrays[f"{array_name}_{number}"] = array
        panels += _make_panels(assets[name], object_counts, comparisons, name, models)
        tables += _make_tables(models, object_counts, comparisons, name)
    _write_arrays(run, arrays)
    _save_figure(panels[:MAX_PANELS], run)  # the file above has all counts
    return SurfaceMap(
        file=COUNTS_FILE, cells=MAP_SIZE, min_pictures=MIN_IMAGES, tables=tables
    )


def _make_tables(
    models: Sequence[str],
    object_counts: SurfaceCounts,
    comparisons: Sequence[Mapping[str, pd.DataFrame]],
    object_name: str,
) -> list[SurfaceTable]:
    """Return the tables of an object: one for each model and kind of part.

    Args:
        models: names of the models.
        object_counts: counts of the object.
        comparisons: for each model, the comparison of its parts by kind.
        object_name: name of the object.
    """
    tables = list[SurfaceTable]()
    for model, model_counts, compared_by_kind in zip(
        models, object_counts.part_counts_of_model, comparisons, strict=True
    ):
        tables += [
            object_counts.summarize_kind(
                object_name, model, model_counts, kind, compared
            )
            for kind, compared in compared_by_kind.items()
        ]
    return tables


def _write_arrays(run: RunDirectory, arrays: dict[str, Any]) -> None:
    """Write the counts as a compressed numpy archive."""
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    write_bytes(run.path / COUNTS_FILE, stream.getvalue())


def _compare_kinds(counts: PartCounts, parts: SurfaceParts) -> dict[str, pd.DataFrame]:
    """Compare the parts of each kind (cells, faces) for a model, by the kind's name."""
    return {
        kind: compare_parts(counts, part_slice, MIN_IMAGES)
        for kind, part_slice in parts.part_slices.items()
    }


def _make_panels(
    asset: ObjectAsset,
    counts: SurfaceCounts,
    comparisons: Sequence[Mapping[str, pd.DataFrame]],
    object_name: str,
    models: Sequence[str],
) -> Iterator[Panel]:
    """Yield what the figure shows of an object, for each model.

    Args:
        asset: the object.
        counts: counts of it.
        comparisons: for each model, the comparison of its parts by kind.
        object_name: name of the object.
        models: names of the models.
    """
    views = tuple(_render_views(asset, counts.parts))
    for model, model_counts, compared_by_kind in zip(
        models, counts.part_counts_of_model, comparisons, strict=True
    ):
        cells = compared_by_kind["cell"]  # the figure shows no faces
        significant_difference = cells.difference.where(cells.significant)  # else NaN
        yield Panel(
            title=f"{shorten_name(object_name)}, {shorten_name(model)}",
            grey_colors=_compute_grey_colors(counts.parts, model_counts, cells),
            difference=significant_difference.to_numpy(),
            views=views,
        )


def _save_figure(panels: Sequence[Panel], run: RunDirectory) -> None:
    size = (10.0, 0.5 + 3.6 * len(panels))
    figures = render_figure(partial(_draw_panels, panels), size, kinds=("png",))
    for suffix, data in figures.items():
        write_bytes(run.path / "images" / f"surface.{suffix}", data)


def _list_arrays(
    counts: SurfaceCounts, comparisons: Sequence[Mapping[str, pd.DataFrame]]
) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays that the file stores for an object, by their names.

    Args:
        counts: counts of the object.
        comparisons: for each model, the comparison of its parts by kind, from
            `compare_parts`.

    Returns:
        Arrays (models,) or (models, parts), and "map": where the corners of each face
        of the mesh lie on the map, (faces, 3, 2).
    """
    model_counts = counts.part_counts_of_model
    arrays: dict[str, npt.NDArray[Any]] = {
        "pictures": np.stack([part_counts.n_images for part_counts in model_counts]),
        "failures": np.stack([part_counts.n_failures for part_counts in model_counts]),
        "seen": np.stack([part_counts.visible_counts for part_counts in model_counts]),
        "wrong": np.stack([part_counts.wrong_counts for part_counts in model_counts]),
    }
    for column in ("difference", "low", "high", "p"):
        arrays[column] = _stack_comparisons(comparisons, column)
    arrays["map"] = counts.parts.face_uvs.astype(np.float32)
    return arrays


def _stack_comparisons(
    comparisons: Sequence[Mapping[str, pd.DataFrame]], column: str
) -> npt.NDArray[np.float32]:
    """Return a column of the comparisons of all models, (models, parts).

    Args:
        comparisons: for each model, the comparison of its parts by kind.
        column: name of the column.
    """
    # The columns of all kinds, one after the other, are in the order of the parts.
    column_of_model = [
        np.concatenate([compared[column] for compared in compared_by_kind.values()])
        for compared_by_kind in comparisons
    ]
    return np.stack(column_of_model).astype(np.float32)


def _compute_grey_colors(
    parts: SurfaceParts, counts: PartCounts, cells: pd.DataFrame
) -> Float64Array:
    """Return the colors (cells, 3) of cells without a significant difference.

    A cell without surface is white, one that was not compared dark grey, the others
    light grey.

    Args:
        parts: parts of the object.
        counts: counts of one model.
        cells: comparison of the cells, from `compare_parts`.
    """
    was_visible = counts.visible_counts[parts.part_slices["cell"]] > 0
    # `is_covered` tests only the center of a cell. Another point of it may be visible.
    has_surface = parts.is_covered.ravel() | was_visible
    is_compared = cells.compared.to_numpy()
    colors = np.where(is_compared[:, None], NOT_SIGNIFICANT_GREY, NOT_COMPARED_GREY)
    return np.where(has_surface[:, None], colors, WHITE)


# maximum number of panels, pairs of object and model, in the figure
MAX_PANELS = 12
# unit vector to the light that shades the object, in world space
LIGHT_DIRECTION = (0.36, 0.48, 0.80)
COLORMAP = "PuOr_r"
"""ColorBrewer's purple to orange, which color-blind people can tell apart: orange is
wrong more often.
"""
NOT_SIGNIFICANT_GREY = (0.78, 0.78, 0.78)
NOT_COMPARED_GREY = (0.45, 0.45, 0.45)
WHITE = (1.0, 1.0, 1.0)
"""Grey where the difference may be chance, darker where too few images show the part or
too few do not; white outside of charts.
"""
GREY_LABELS = {
    NOT_SIGNIFICANT_GREY: "not told from chance",
    NOT_COMPARED_GREY: "too few pictures with or without it",
}
N_VIEW_ROWS = 2  # rows of the views of an object
VIEWS_WIDTH = 1.55  # width of the views, in widths of the map
MIN_SHADE = 0.7  # brightness of a surface that faces away from the light
LIT_SHADE = 0.3  # what is added where the surface faces the light


class MapView(NamedTuple):
    """An image of an object that shows the cells of its map.

    Attributes:
        title: position of the camera, as text.
        cells: (H, W) index of the cell in each pixel, row by row of the map; -1 without
            the object.
        shade: (H, W) brightness in [0, 1].
    """

    title: str
    cells: Int64Array
    shade: Float64Array


class Panel(NamedTuple):
    """What the figure shows of one object and one model.

    Attributes:
        title: names of the object and the model.
        grey_colors: (cells, 3) colors of the cells without a significant difference.
        difference: (cells,) fraction of wrong predictions where the cell is visible,
            minus that where it is hidden; NaN if not significant.
        views: views of the object.
    """

    title: str
    grey_colors: Float64Array
    difference: Float64Array
    views: tuple[MapView, ...]


def _render_views(asset: ObjectAsset, parts: SurfaceParts) -> Iterator[MapView]:
    """Yield the views of the object alone from the cameras in `VIEW_ANGLES`.

    Args:
        asset: the object.
        parts: parts of its surface; their cells are found for each pixel.
    """
    # without a ground, which would hide the object from below
    scene_of_object = load_scene(asset, settings={"ground.size": 0.0})
    description = fit_camera(scene_of_object.description, VIEW_SIZE)
    scene = MitsubaScene(description, (VIEW_SIZE, VIEW_SIZE))
    for azimuth, elevation in VIEW_ANGLES:
        viewed = description.with_values(
            camera__azimuth=azimuth, camera__elevation=elevation
        )
        to_world = camera_to_world(viewed, aspect=1.0).astype(np.float32)
        surfaces = scene.find_surfaces({"camera.to_world": torch.from_numpy(to_world)})
        title = f"{azimuth:g}°, {elevation:g}° up"
        cells = _find_cell_of_pixels(surfaces, parts)
        yield MapView(title, cells, _compute_shade(surfaces))


def _compute_shade(surfaces: Surfaces) -> Float64Array:
    """Return the brightness of each pixel (H, W) in [0, 1], by its surface's normal.

    It is never so dark that colors are hard to distinguish.
    """
    cosine = np.clip(surfaces.normal.numpy() @ np.array(LIGHT_DIRECTION), 0.0, 1.0)
    return np.asarray(MIN_SHADE + LIT_SHADE * cosine)


def _find_cell_of_pixels(surfaces: Surfaces, parts: SurfaceParts) -> Int64Array:
    """Return the cell of the object's map in each pixel (H, W); -1 without the object.

    Args:
        surfaces: the surface that each pixel shows.
        parts: parts of the object's surface.
    """
    is_object = surfaces.visible_mask(OBJECT).numpy()
    face = surfaces.face_index.numpy()[is_object]
    uv = surfaces.uv.numpy()[is_object].astype(np.float64)
    cells = np.full(is_object.shape, -1, np.int64)
    cells[is_object] = parts.find_cells(face, uv)
    return cells


def _draw_panels(panels: Sequence[Panel], figure: Any) -> None:
    """Draw a row for each panel: the map of the surface, and the object from six sides.

    All panels have the same scale of colors, which is symmetric around 0.

    Args:
        panels: panels from the first row on.
        figure: figure of matplotlib.
    """
    import matplotlib as mpl  # takes long to import

    limit = _find_scale_limit(panels)
    normalize = mpl.colors.Normalize(-limit, limit)
    scale = mpl.cm.ScalarMappable(normalize, mpl.colormaps[COLORMAP])
    axes = figure.subplots(
        len(panels), 2, squeeze=False, width_ratios=(1.0, VIEWS_WIDTH)
    )
    for (map_axes, view_axes), panel in zip(axes, panels, strict=True):
        cell_colors = _color_cells(panel, scale)
        _draw_cells(map_axes, panel.title, cell_colors)
        _draw_views(view_axes, panel.views, cell_colors)

    _add_color_bar(figure, axes, scale)
    patches = [
        mpl.patches.Patch(facecolor=color, label=label)
        for color, label in GREY_LABELS.items()
    ]
    figure.legend(handles=patches, loc="outside lower center", ncols=2)


def _add_color_bar(figure: Any, axes: npt.NDArray[Any], scale: Any) -> None:
    """Add one color bar for all rows of a figure, at their right.

    Args:
        figure: figure of matplotlib.
        axes: (rows, 2) axes of its rows.
        scale: matplotlib's map from differences to colors.
    """
    # its height as a fraction of that of all rows
    shrink = 0.8 if len(axes) == 1 else 0.4
    bar = figure.colorbar(scale, ax=axes, shrink=shrink, format=_format_percent)
    bar.set_label(
        "share of wrong predictions where it is seen,\nless that where it is not"
    )


def _draw_cells(axes: Any, title: str, cell_colors: Float64Array) -> None:
    """Draw the map of a surface; `cell_colors` (cells, 3) has its cells row by row."""
    axes.imshow(
        # Row 0 of the cells is at v = 1, the top of the image.
        cell_colors.reshape(MAP_SIZE, MAP_SIZE, 3),
        extent=(0, 1, 0, 1),
        interpolation="nearest",
    )
    axes.set(xlabel="u", ylabel="v")
    axes.set_title(title)


def _color_cells(panel: Panel, scale: Any) -> Float64Array:
    """Return the color (cells, 3) of each cell of a map.

    Args:
        panel: panel of the figure; cells without a significant difference are gray.
        scale: matplotlib's map from differences to colors.
    """
    is_grey = np.isnan(panel.difference)[:, None]
    scale_colors = scale.to_rgba(panel.difference)[:, :3]
    return np.where(is_grey, panel.grey_colors, scale_colors)


def _find_scale_limit(panels: Sequence[Panel]) -> float:
    """Return the largest difference of all panels, rounded up to 10 %."""
    max_difference = max(
        (float(np.nanmax(np.abs(panel.difference), initial=0.0)) for panel in panels),
        default=0.0,
    )
    # - 1e-9: rounding may have made a multiple of 10 % a little larger. At least 10 %,
    # so that the scale has a width even without any significant difference.
    return max(ceil(10.0 * max_difference - 1e-9) / 10.0, 0.1)


def _draw_views(axes: Any, views: Sequence[MapView], cell_colors: Float64Array) -> None:
    """Draw the views of an object, in rows, in the colors of its map.

    Args:
        axes: axes of matplotlib.
        views: views with the cell, or -1, and the shade of every pixel.
        cell_colors: (cells, 3) color of each cell.
    """
    axes.axis("off")
    n_columns = ceil(len(views) / N_VIEW_ROWS)
    mosaic = np.ones((N_VIEW_ROWS * VIEW_SIZE, n_columns * VIEW_SIZE, 3))
    for number, view in enumerate(views):
        row, column = divmod(number, n_columns)
        top = row * VIEW_SIZE
        left = column * VIEW_SIZE
        image = _shade_view(view, cell_colors)
        mosaic[top : top + VIEW_SIZE, left : left + VIEW_SIZE] = image
        center = left + 0.5 * VIEW_SIZE
        axes.text(center, top + 4, view.title, ha="center", va="top", fontsize=7)
    axes.imshow(mosaic)


def _shade_view(view: MapView, cell_colors: Float64Array) -> Float64Array:
    """Return a view of an object as an image (H, W, 3), white around the object.

    Args:
        view: the view, with the cell, or -1, and the shade of every pixel.
        cell_colors: (cells, 3) color of each cell.
    """
    is_object = view.cells[..., None] >= 0
    # Pixels without the object have -1. They are looked up as cell 0 here, and made
    # white below.
    shaded = cell_colors[np.maximum(view.cells, 0)] * view.shade[..., None]
    return np.where(is_object, shaded, 1.0)


def _format_percent(value: float, _: object) -> str:
    return f"{100.0 * value:+.3g} %" if value else "0 %"
