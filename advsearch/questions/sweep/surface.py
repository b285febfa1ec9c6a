"""Find which parts of an object's surface, when visible, go with wrong predictions.

docs/sweeps.md, "The surface". The interval of a difference is Newcombe's (1998,
Statistics in Medicine 17, method 10) from Wilson's (1927). What may be chance is found
by permuting the wrong predictions, each time with the part that stands out most
(Westfall and Young 1993, the single-step maximum) by the likelihood ratio. Where images
share a draw (frames of a drive), full draws are permuted, and there is no interval.
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

from advsearch import seeds
from advsearch.attacks.domain import split_into_batches
from advsearch.engine.loading import fit_camera, load_scene
from advsearch.engine.record import read_judgement
from advsearch.options import OUT_OF_VIEW
from advsearch.progress import Progress
from advsearch.questions.sweep.job import Job, SceneLoader
from advsearch.questions.sweep.result import count_independent
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
# permutations of the wrong predictions, so that no p-value is under 0.005
N_PERMUTATIONS = 199
# the chance that any part is significant if none has to do with the predictions
SIGNIFICANCE_LEVEL = 0.05


class PartCounts:
    """Counts of images and of wrong predictions for n parts of a surface.

    Attributes:
        n_images: images in all.
        n_failures: images whose prediction is wrong.
        visible_counts: (n,) images that show each part.
        wrong_counts: (n,) failures among these.
        permuted_counts: (N_PERMUTATIONS, n) the same after each permutation of the
            failures.
        permuted_failures: bits of (N_PERMUTATIONS, images), packed along the first
            axis: the permuted failures, from `permute_draws`; None permutes single
            images.
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
            n_parts: parts of the surface.
            n_images: images that will be added.
            n_failures: those of them whose prediction is wrong.
            seed: seed of the permutations.
            permuted_failures: permutations from `permute_draws`, packed as bits; None
                permutes single images while they are added.
        """
        self.permuted_failures = permuted_failures
        self.n_images = n_images
        self.n_failures = n_failures
        self.visible_counts = np.zeros(n_parts, np.int64)
        self.wrong_counts = np.zeros(n_parts, np.int64)
        self.permuted_counts = np.zeros((N_PERMUTATIONS, n_parts), np.uint32)
        # for the sequential sampling in `add`
        self._images_left = n_images
        self._failures_left = np.full(N_PERMUTATIONS, n_failures)
        self._random = np.random.default_rng(seed)

    def add(self, parts: Int64Array, failed: bool) -> None:
        """Count an image, and decide in which permutations it is a failure.

        A permutation deals the failures out to the images anew, at random: its counts
        are what chance alone could give if predictions had nothing to do with the
        parts. Images are added in the order of `permuted_failures`, `n_images` in all.

        Args:
            parts: indices of the parts that it shows, each once.
            failed: whether its prediction is wrong.
        """
        self.visible_counts[parts] += 1
        self.wrong_counts[parts] += failed
        if self.permuted_failures is not None:
            # one bit for each permutation, in the column of this image
            image = self.n_images - self._images_left
            bits = np.unpackbits(self.permuted_failures[:, image], count=N_PERMUTATIONS)
            permuted_failure = bits.astype(bool)
        else:
            # Sequential sampling (Knuth's algorithm S): an image is a failure with the
            # probability failures left / images left, so that each choice of
            # `n_failures` images is equally likely.
            uniform = self._random.random(N_PERMUTATIONS)
            permuted_failure = uniform * self._images_left < self._failures_left
        self._images_left -= 1
        self._failures_left = self._failures_left - permuted_failure
        self.permuted_counts[np.ix_(np.flatnonzero(permuted_failure), parts)] += 1


def compare_parts(
    counts: PartCounts, part_slice: slice, min_images: int
) -> pd.DataFrame:
    """Compare the predictions where a part is visible with those where it is not.

    Intervals: Newcombe (1998), method 10. P-values: single-step maximum of the
    likelihood ratio over permutations (Westfall and Young 1993).

    Args:
        counts: counts of all parts.
        part_slice: the parts that are compared.
        min_images: images of either kind that a comparison takes.

    Returns:
        A row per part, by its index; NaN where it was not `compared`. `difference`:
        fraction of wrong predictions where the part is visible, less that where it is
        not; `low` and `high`: bounds of its 95 % interval, for the part by itself, NaN
        where images share a draw; `p`: probability that any part stands out as far by
        chance; `significant`: whether `p` is at most `SIGNIFICANCE_LEVEL`; `strength`:
        the bound that is nearer to 0, without its sign, 0 if the interval contains 0.
        Without an interval `strength` is the absolute difference.
    """
    n_visible = counts.visible_counts[part_slice]
    n_hidden = counts.n_images - n_visible
    is_compared = (n_visible >= min_images) & (n_hidden >= min_images)
    nan_columns = dict.fromkeys(("difference", "low", "high", "p"), np.nan)
    part_indices = np.arange(len(counts.visible_counts))[part_slice]
    parts = pd.DataFrame(nan_columns, index=part_indices).assign(compared=is_compared)
    if is_compared.any():
        columns = _compute_comparison(counts, part_indices[is_compared])
        parts.loc[is_compared, list(nan_columns)] = columns
    # Positive if both bounds are on the same side of 0: then either `low` or `-high` is
    # positive, and it is the distance from 0.
    nearer_bound = np.where(
        parts.low.isna(), parts.difference.abs(), np.maximum(parts.low, -parts.high)
    )
    return parts.assign(
        significant=parts.p <= SIGNIFICANCE_LEVEL,
        strength=np.nan_to_num(np.maximum(nearer_bound, 0.0)),
    )


def _compute_comparison(counts: PartCounts, parts: Int64Array) -> Float64Array:
    """Compute difference, lower and upper bound and p-value of parts, (m, 4).

    The difference is the rate of wrong predictions where the part is visible, less that
    elsewhere. Where images share a draw, they are not independent, and the bounds are
    NaN.

    Args:
        counts: counts of all parts.
        parts: (m,) indices of those that are compared.
    """
    n = counts.visible_counts[parts]
    k = counts.wrong_counts[parts]
    difference, low, high = _newcombe(
        k, n, other_k=counts.n_failures - k, other_n=counts.n_images - n
    )
    if counts.permuted_failures is not None:  # images share draws
        low = np.full(len(n), np.nan)
        high = low
    p_value = _permutation_p_value(counts, k, n, parts)
    return np.stack([difference, low, high, p_value], axis=1)


def _permutation_p_value(
    counts: PartCounts, k: Int64Array, n: Int64Array, parts: Int64Array
) -> Float64Array:
    """Compute how likely it is that any part stands out as far as each by chance.

    The p-value of a part is the fraction of permutations in which the largest statistic
    of all parts is at least the statistic of this part. The data themselves count as
    one more permutation, so that p is never 0.

    Args:
        counts: counts with the permuted failures of all parts.
        k: (m,) failures among the images that show each compared part.
        n: (m,) these images.
        parts: (m,) indices of the compared parts.
    """
    images = counts.n_images
    failures = counts.n_failures
    # the largest statistic of any part in each permutation, ascending
    max_statistics = np.sort(
        [
            _likelihood_ratio(
                permuted[parts].astype(np.int64), n, failures, images
            ).max()
            for permuted in counts.permuted_counts
        ]
    )
    statistic = _likelihood_ratio(k, n, failures, images)
    n_permutations = len(max_statistics)
    # permutations whose largest statistic is at least that of the part, except for
    # rounding
    tolerance = 1e-9
    n_above = n_permutations - np.searchsorted(max_statistics, statistic - tolerance)
    return np.asarray((1 + n_above) / (1 + n_permutations))


def _likelihood_ratio(
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


def _newcombe(
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


# images that have to show a part, and as many that do not, before its predictions are
# compared
MIN_IMAGES = 5
MIN_RAYS = 4 * MAP_SIZE
"""Rays along each side of an image, at least: in smaller images, many cells would lie
between two pixels.
"""
MAX_LISTED_PARTS = 5
"""Parts of each kind that the summary lists, at most, that go with wrong predictions,
and as many with right ones.
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
"""Azimuth and elevation of the cameras that show the object in colours, degrees."""
VIEW_SIZE = 240
# the prediction of an image without a row, or without the object
UNKNOWN = -1
BATCH_SIZE = 16  # images whose configurations are computed at once


class SurfaceCounts:
    """Counts of visible parts and wrong predictions on the surface of one object.

    Attributes:
        parts: the parts of the surface.
        part_counts: their counts for each model.
    """

    def __init__(self, parts: SurfaceParts, part_counts: Sequence[PartCounts]) -> None:
        self.parts = parts
        self.part_counts = tuple(part_counts)

    def add(self, surfaces: Surfaces, wrong_by_model: Mapping[int, bool]) -> None:
        """Count an image for each model.

        Parts are the cells of the map; on a mesh of few faces also the faces, whose
        indices follow those of the cells.

        Args:
            surfaces: the surface that each pixel of the image shows.
            wrong_by_model: whether the prediction is wrong, by the index of the model.
        """
        is_object = surfaces.visible_mask(OBJECT)
        face = surfaces.face[is_object].numpy()
        uv = surfaces.uv[is_object].numpy().astype(np.float64)
        visible_parts = np.unique(self.parts.find_cells(face, uv))
        if self.parts.counts_faces:
            visible_faces = np.unique(face) + MAP_SIZE * MAP_SIZE
            visible_parts = np.concatenate([visible_parts, visible_faces])
        for model, failed in wrong_by_model.items():
            self.part_counts[model].add(visible_parts, failed)

    def summarize_kind(
        self,
        object_name: str,
        model: str,
        counts: PartCounts,
        kind: str,
        compared: pd.DataFrame,
    ) -> SurfaceTable:
        """Return how a model's predictions go with the parts of one kind.

        `strongest` of the table lists the most significant parts, no two close to each
        other: first those that go with wrong predictions, then with right ones.

        Args:
            object_name: name of the object.
            model: name of the model.
            counts: counts of the model.
            kind: kind of the parts, a key of `SurfaceParts.kinds`.
            compared: comparison of the parts, from `compare_parts`.
        """
        is_worse = compared.significant & (compared.difference > 0)
        is_better = compared.significant & (compared.difference < 0)
        strongest = list[SurfacePart]()
        for is_candidate in (is_worse, is_better):
            strongest += [
                self._describe_part(part, counts, compared)
                for part in self._select_spread(compared[is_candidate])
            ]
        return SurfaceTable(
            object=object_name,
            model=model,
            part=kind,
            unwrapped=self.parts.is_unwrapped,
            visible=int(
                (counts.visible_counts[self.parts.part_slices[kind]] > 0).sum()
            ),
            compared=int(compared.compared.sum()),
            worse=int(is_worse.sum()),
            better=int(is_better.sum()),
            strongest=strongest,
        )

    def _select_spread(self, candidates: pd.DataFrame) -> list[int]:
        """Select the strongest parts of which none is close to another.

        Of two parts within `MIN_PART_DISTANCE` the weaker one is left out; at most
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
        """Return the counts and the comparison of one part, as the summary has them.

        Args:
            part: index of the part.
            counts: counts of a model.
            compared: comparison of the parts, from `compare_parts`.
        """
        n_visible = int(counts.visible_counts[part])
        n_visible_wrong = int(counts.wrong_counts[part])
        n_hidden = counts.n_images - n_visible
        n_hidden_wrong = counts.n_failures - n_visible_wrong
        u, v = self.parts.center_uvs[part].tolist()
        return SurfacePart(
            face=int(self.parts.face[part]),
            u=u,
            v=v,
            center=self.parts.centers[part].tolist(),
            visible=count_independent(n_visible - n_visible_wrong, n_visible),
            hidden=count_independent(n_hidden - n_hidden_wrong, n_hidden),
            difference=float(compared.difference[part]),
            interval=(float(compared.low[part]), float(compared.high[part])),
            p=float(compared.p[part]),
        )


def map_surface(
    scenes: SceneLoader, rows: Iterable[Row], run: RunDirectory, progress: Progress
) -> SurfaceMap:
    """Count wrong predictions over the surface of each object of a sweep.

    Writes the counts and their figure into the run directory.

    Args:
        scenes: scenes of the sweep.
        rows: all of its rows.
        run: run directory into which the files are written.
        progress: advances by the number of predictions.

    Returns:
        What the summary says.
    """
    job = scenes.job
    wrong = _read_wrong(scenes, rows)  # (scenes, images, models)
    assets = {
        named_scene.object: named_scene.scene.description.object
        for named_scene in job.scenes
    }
    counts = _make_counts(scenes, assets, wrong)
    for scene, wrong_in_scene in enumerate(wrong):
        scene_counts = counts[job.scenes[scene].object]
        _count_scene(scenes, scene, wrong_in_scene, scene_counts, progress)
    return _write_map(counts, assets, [model.name for model in job.models], run)


def _read_wrong(scenes: SceneLoader, rows: Iterable[Row]) -> npt.NDArray[np.int8]:
    """Return which predictions are wrong: 1, 0 or UNKNOWN, (scenes, images, models)."""
    job = scenes.job
    shape = (len(job.scenes), job.images_per_scene, len(job.models))
    wrong: npt.NDArray[np.int8] = np.full(shape, UNKNOWN, np.int8)
    for row in rows:
        # An image without the object doesn't count as one that hides a part either.
        if row.label != OUT_OF_VIEW:
            wrong.flat[row.step] = not read_judgement(row).right
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
    job = scenes.job
    draws = _draw_of_images(scenes, wrong, job)
    n_models = len(job.models)
    counts = dict[str, SurfaceCounts]()
    for object_index, (name, asset) in enumerate(assets.items()):
        parts = SurfaceParts(asset.mesh)
        has_object = [named_scene.object == name for named_scene in job.scenes]
        # Each pair of an object and a model has a seed, so permutations, of its own.
        model_seeds = [
            seeds.stream(job.config.seed, "surface", object_index * n_models + model)
            for model in range(n_models)
        ]
        part_counts = [
            _make_part_counts(
                parts, wrong[has_object][..., model], draws[has_object], seed
            )
            for model, seed in enumerate(model_seeds)
        ]
        counts[name] = SurfaceCounts(parts, part_counts)
    return counts


def _draw_of_images(
    scenes: SceneLoader, wrong: npt.NDArray[np.int8], job: Job
) -> npt.NDArray[Any]:
    """Return the draw of each image, (scenes, images of a scene)."""
    units = scenes.load(0).points_of_size[job.image_sizes[0]].units
    image_numbers = np.arange(wrong[..., 0].size)
    return np.asarray(units.find_cluster(image_numbers)).reshape(wrong.shape[:2])


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
    n_known = int((wrong >= 0).sum())  # UNKNOWN is below 0
    n_failures = int((wrong >= 1).sum())
    return PartCounts(parts.count, n_known, n_failures, seed, permuted)


def _count_scene(
    scenes: SceneLoader,
    scene: int,
    wrong: npt.NDArray[np.int8],
    counts: SurfaceCounts,
    progress: Progress,
) -> None:
    """Trace the surface in every image of a scene and count it.

    Small images are traced with several rays per pixel; see `MIN_RAYS`. Models of one
    image size share the traced image.

    Args:
        scenes: scenes of the sweep.
        scene: the index of the scene.
        wrong: (images, models) of the scene, from `_read_wrong`.
        counts: counts of the scene's object.
        progress: advances by the number of predictions.
    """
    job = scenes.job
    swept_scene = scenes.load(scene)
    n_images, n_models = wrong.shape
    for batch in split_into_batches(0, n_images, BATCH_SIZE):
        for size in dict.fromkeys(job.image_sizes):
            models = [
                model for model in range(n_models) if job.image_sizes[model] == size
            ]
            configurations = swept_scene.points_of_size[size].make_configurations(
                # every scene before this one has as many images
                batch.start,
                len(batch),
                before=scene * n_images,
            )
            # at least `MIN_RAYS` rays along the shorter side of the image
            rays_per_pixel = ceil(MIN_RAYS / min(size))
            renderer = swept_scene.renderer_of_size[size]
            for number, u in zip(batch, configurations, strict=True):
                surfaces = renderer.surfaces(u, rays_per_pixel)
                counts.add(surfaces, _select_known(wrong[number], models))
        progress.advance(len(batch) * n_models)


def _select_known(
    wrong: npt.NDArray[np.int8], models: Sequence[int]
) -> dict[int, bool]:
    """Return whether each model is wrong, by its index, where that is known.

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
        wrong: (n,) whether each prediction is wrong, or UNKNOWN; every draw has as many
            images.
        draws: (n,) the draw of each image.
        seed: seed of the permutations.

    Returns:
        Whether the permuted predictions are wrong, without unknown ones, packed as
        `PartCounts` takes them; None if each image has a draw of its own.
    """
    is_known = wrong != UNKNOWN
    draw_sizes = np.unique(draws, return_counts=True)[1]  # images of each draw
    n_draws = len(draw_sizes)
    if draw_sizes.max(initial=1) == 1:
        return None
    is_wrong = wrong == 1
    # (draws, images of a draw): row k has the indices of the images of draw k
    images_of_draw = np.argsort(draws, kind="stable").reshape(n_draws, -1)
    generator = np.random.default_rng(seed)
    permuted = np.zeros((N_PERMUTATIONS, len(wrong)), bool)
    for permutation in permuted:
        # `permutation` is a row of `permuted`, which this fills.
        order = generator.permutation(n_draws)
        permutation[images_of_draw] = is_wrong[images_of_draw[order]]
    return np.packbits(permuted[:, is_known], axis=0)


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
        comparisons = [
            _compare_kinds(model_counts, object_counts.parts)
            for model_counts in object_counts.part_counts
        ]
        for array_name, array in _stored_arrays(object_counts, comparisons).items():
            arrays[f"{array_name}_{number}"] = array
        panels += _make_panels(assets[name], object_counts, comparisons, name, models)
        tables += _make_tables(models, object_counts, comparisons, name)
    _write_arrays(run, arrays)
    _save_figure(panels[:MAX_PANELS], run)
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
        models, object_counts.part_counts, comparisons, strict=True
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
    """Compare the predictions of a model by the parts of each kind."""
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
        models, counts.part_counts, comparisons, strict=True
    ):
        cells = compared_by_kind["cell"]
        yield Panel(
            title=f"{shorten_name(object_name)}, {shorten_name(model)}",
            grey_colors=_grey_colors(counts.parts, model_counts, cells),
            difference=cells.difference.where(cells.significant).to_numpy(),
            views=views,
        )


def _save_figure(panels: Sequence[Panel], run: RunDirectory) -> None:
    size = (10.0, 0.5 + 3.6 * len(panels))
    figures = render_figure(partial(_draw, panels), size, kinds=("png",))
    for suffix, data in figures.items():
        write_bytes(run.path / "images" / f"surface.{suffix}", data)


def _stored_arrays(
    counts: SurfaceCounts, comparisons: Sequence[Mapping[str, pd.DataFrame]]
) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays that the file holds of an object, by their names.

    Args:
        counts: counts of the object.
        comparisons: comparisons from `compare_parts`, by the kind of part, for each
            model.

    Returns:
        Arrays whose first axis is the models, (models,) or (models, parts); "map" has
        the corners of the parts.
    """
    model_counts = counts.part_counts
    arrays: dict[str, npt.NDArray[Any]] = {
        "pictures": np.stack([part_counts.n_images for part_counts in model_counts]),
        "failures": np.stack([part_counts.n_failures for part_counts in model_counts]),
        "seen": np.stack([part_counts.visible_counts for part_counts in model_counts]),
        "wrong": np.stack([part_counts.wrong_counts for part_counts in model_counts]),
    }
    for column in ("difference", "low", "high", "p"):
        column_of_model = [
            np.concatenate([compared[column] for compared in compared_by_kind.values()])
            for compared_by_kind in comparisons
        ]
        arrays[column] = np.stack(column_of_model).astype(np.float32)
    arrays["map"] = counts.parts.corners.astype(np.float32)
    return arrays


def _grey_colors(
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
    has_surface = parts.is_covered.ravel() | was_visible
    is_compared = cells.compared.to_numpy()
    colors = np.where(is_compared[:, None], NOT_SIGNIFICANT_GREY, NOT_COMPARED_GREY)
    return np.where(has_surface[:, None], colors, WHITE)


MAX_PANELS = 12  # pairs of object and model in the figure; the file has all counts
# the direction to the light that shades the object, world space; of length 1
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
N_VIEW_ROWS = 2  # of the views of an object


class MapView(NamedTuple):
    """What a camera sees of an object.

    Attributes:
        title: position of the camera, as text.
        cells: (H, W) index of the cell in each pixel, row by row of the map; -1 where
            the object is not.
        shade: (H, W) brightness in [0, 1].
    """

    title: str
    cells: Int64Array
    shade: Float64Array


class Panel(NamedTuple):
    """What the figure shows of one object and one model.

    Attributes:
        title: names of both.
        grey_colors: (cells, 3) of cells without a significant difference.
        difference: (cells,) by how much predictions are wrong more often where the
            cell is visible; NaN where that is not significant.
        views: views of the object.
    """

    title: str
    grey_colors: Float64Array
    difference: Float64Array
    views: tuple[MapView, ...]


def _render_views(asset: ObjectAsset, parts: SurfaceParts) -> Iterator[MapView]:
    """Yield the views of the object by itself from the cameras in `VIEW_ANGLES`.

    Args:
        asset: the object.
        parts: parts of its surface, whose cells the pixels of a view are looked up in.
    """
    # without a ground, which would hide the object from below
    scene_of_object = load_scene(asset, settings={"ground.size": 0.0})
    description = fit_camera(scene_of_object.description, VIEW_SIZE)
    scene = MitsubaScene(description, (VIEW_SIZE, VIEW_SIZE))
    for azimuth, elevation in VIEW_ANGLES:
        viewed = description.with_values(
            camera__azimuth=azimuth, camera__elevation=elevation
        )
        to_world = camera_to_world(viewed, 1.0).astype(np.float32)
        surfaces = scene.find_surfaces({"camera.to_world": torch.from_numpy(to_world)})
        is_object = surfaces.visible_mask(OBJECT).numpy()
        face = surfaces.face.numpy()[is_object]
        uv = surfaces.uv.numpy()[is_object].astype(np.float64)
        cells = np.full(is_object.shape, -1, np.int64)
        cells[is_object] = parts.find_cells(face, uv)
        cosine = np.clip(surfaces.normal.numpy() @ np.array(LIGHT_DIRECTION), 0.0, 1.0)
        shade = 0.7 + 0.3 * cosine  # never so dark that colors are hard to tell apart
        yield MapView(f"{azimuth:g}°, {elevation:g}° up", cells, shade)


def _draw(panels: Sequence[Panel], figure: Any) -> None:
    """Draw a row for each panel: the map of the surface, and the object from six sides.

    All panels have the same scale of colors, which is symmetric around 0.

    Args:
        panels: panels from the first row on.
        figure: figure of matplotlib.
    """
    import matplotlib as mpl  # takes long to import

    limit = _find_scale_limit(panels)
    scale = mpl.cm.ScalarMappable(
        mpl.colors.Normalize(-limit, limit), mpl.colormaps[COLORMAP]
    )
    axes = figure.subplots(len(panels), 2, squeeze=False, width_ratios=(1.0, 1.55))
    for (map_axes, view_axes), panel in zip(axes, panels, strict=True):
        is_grey = np.isnan(panel.difference)[:, None]
        scale_colors = scale.to_rgba(panel.difference)[:, :3]
        cell_colors = np.where(is_grey, panel.grey_colors, scale_colors)
        map_axes.imshow(
            cell_colors.reshape(MAP_SIZE, MAP_SIZE, 3),
            extent=(0, 1, 0, 1),
            interpolation="nearest",
        )
        map_axes.set(xlabel="u", ylabel="v")
        map_axes.set_title(panel.title)
        _draw_views(view_axes, panel.views, cell_colors)

    # the color bar stands beside all rows, and need not be as high
    shrink = 0.8 if len(panels) == 1 else 0.4
    bar = figure.colorbar(scale, ax=axes, shrink=shrink, format=_format_percent)
    bar.set_label(
        "share of wrong predictions where it is seen,\nless that where it is not"
    )
    patches = [
        mpl.patches.Patch(facecolor=color, label=label)
        for color, label in GREY_LABELS.items()
    ]
    figure.legend(handles=patches, loc="outside lower center", ncols=2)


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
        views: each with the cell of the map, or -1, and the shade of every pixel.
        cell_colors: (cells, 3) color of each cell.
    """
    axes.axis("off")
    n_columns = ceil(len(views) / N_VIEW_ROWS)
    mosaic = np.ones((N_VIEW_ROWS * VIEW_SIZE, n_columns * VIEW_SIZE, 3))
    for number, view in enumerate(views):
        row, column = divmod(number, n_columns)
        top = row * VIEW_SIZE
        left = column * VIEW_SIZE
        is_object = view.cells[..., None] >= 0
        # Pixels without the object have -1. They are looked up as cell 0 here, and made
        # white below.
        shaded = cell_colors[np.maximum(view.cells, 0)] * view.shade[..., None]
        image = np.where(is_object, shaded, 1.0)
        mosaic[top : top + VIEW_SIZE, left : left + VIEW_SIZE] = image
        axes.text(
            left + 0.5 * VIEW_SIZE,
            top + 4,
            view.title,
            ha="center",
            va="top",
            fontsize=7,
        )
    axes.imshow(mosaic)


def _format_percent(value: float, _: object) -> str:
    return f"{100.0 * value:+.3g} %" if value else "0 %"
