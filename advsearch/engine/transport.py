"""The simplest predictor: a matrix of light transport, or an image of each light.

A matrix of light transport predicts the images of a search without random conditions.
Every `COMPARISON_INTERVAL` evaluations predictions are compared with traced images. If
they are not accurate enough (`engine.acceptance`), the matrix is computed again. The
ranking and all trials trace paths; the ranking does so only in the window.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluate, Evaluation, Policy
from advsearch.attacks.evaluation import Query
from advsearch.engine.acceptance import Deviation
from advsearch.engine.image_groups import Groups, MakeGroups
from advsearch.engine.prediction import (
    MIN_SAVING_FACTOR,
    CleanMatrix,
    PredictedSearch,
    PredictionMethod,
    SweepMethod,
    count_check_samples,
    find_general_refusal,
)
from advsearch.engine.problem import Problem
from advsearch.engine.windows import (
    N_WINDOW_IMAGES,
    FullImage,
    Windowing,
    find_window,
)
from advsearch.scene.color import round_to_8_bit
from advsearch.scene.predictor import (
    MAX_BYTES,
    NOISE,
    NOTHING_MOVES,
    Predictor,
    Refusal,
    RefusalCause,
)
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.lights import (
    BasisRenderer,
    LightBasis,
    count_lights,
    count_samples,
    find_light_groups,
    find_refusal,
    make_predictor,
)
from advsearch.scene.transport.matrix import COLLECTED_SPP, ProgressCallback
from advsearch.trust.stored_files import scale_limit

MIN_STEPS = 16
"""Smallest number of evaluations of a search for which the matrix pays. It costs as
much as about 6 rendered evaluations with gradients (`benchmarks/transport.py`).
"""
# Smallest number of evaluations for each light for which basis images pay. A basis
# image shows the scene under a single light; images under all lights are weighted sums.
MIN_STEPS_PER_LIGHT = 8
COMPARISON_INTERVAL = 20  # number of evaluations from one comparison to the next
SURROUNDINGS_SPP = 16  # samples per pixel of the surroundings of a matrix's window
MIN_SCORES = 4  # smallest number of trials to estimate a standard deviation
# 19 of 20 normally distributed scores lie above the mean minus this many standard
# deviations.
LOWER_END_DEVIATIONS = 1.64
BASIS_PIXEL_BYTES = 8  # approximate memory of a pixel of a basis image
ADVICE = {
    RefusalCause.HAZE: "leave the haze out",
    RefusalCause.NOISE: "`denoise=oidn` takes the noise out",
    RefusalCause.TOO_LARGE: "take a lower `resolution` or texture resolution, or set "
    "ADVSEARCH_LIMITS=2 where memory allows it",
}
"""What a user can do so that images are predicted, by the cause of a refusal."""


def find_matrix_refusal(
    problem: Problem, steps: int | None, specialise: bool
) -> Refusal | None:
    """Return why matrices of light transport do not predict a search; None if they do.

    Args:
        problem: problem of the search.
        steps: evaluations of the search; None if any number of them may follow, so that
            a predictor pays in any case.
        specialise: whether the search may leave out or predict anything at all (the
            setting of this name).
    """
    refusal = find_general_refusal(problem, specialise)
    if refusal is not None:
        return refusal
    if steps is not None and steps < MIN_STEPS:
        return Refusal(
            f"a matrix pays from {MIN_STEPS} evaluations on", RefusalCause.TOO_FEW_STEPS
        )
    refusal = find_refusal(problem.renderer, _list_condition_names(problem))
    if refusal is not None:
        return refusal
    # If lights are searched, an image of each light (basis image) takes the place of a
    # matrix. It remains to check whether these pay. They are not used under conditions,
    # and they pay if any number of steps may follow.
    if problem.conditions is not None or steps is None:
        return None
    return _find_basis_refusal(problem, steps)


def _list_condition_names(problem: Problem) -> list[str]:
    """List the names of the controls that vary by chance."""
    if problem.conditions is None:
        return []
    # the controls that vary by chance come after the searched ones
    conditions = problem.space.controls[problem.n_searched :]
    return [control.name for control in conditions]


def _find_basis_refusal(problem: Problem, steps: int) -> Refusal | None:
    """Return a refusal if basis images do not pay; None if they do."""
    # an image is rendered for each light before the first prediction
    min_steps = MIN_STEPS_PER_LIGHT * count_lights(problem.renderer)
    if steps < min_steps:
        return Refusal(
            f"basis pictures pay from {min_steps} evaluations on",
            RefusalCause.TOO_FEW_STEPS,
        )
    return None


def make_rendering_remark(refusal: Refusal | None) -> str:
    """Return advice for a search that renders; "" if the user can't change that."""
    advice = "" if refusal is None else ADVICE.get(refusal.cause, "")
    if not advice:
        return ""
    costs = (
        "Each step of the search is rendered, which takes several times as long "
        "as predicting it"
    )
    return f"{costs}: {refusal}; {advice}."


@dataclass
class Transport(PredictedSearch):
    """The matrices of a run whose searches have no random conditions.

    Attributes:
        clean_matrix: the matrix with which every search begins.
    """

    method: ClassVar[str] = "matrix"
    title: ClassVar[str] = "collecting light transport"
    is_exact: ClassVar[bool] = True
    clean_matrix: CleanMatrix = field(default_factory=CleanMatrix)
    # predicted score minus the lower end of the scores of trials (`update_score_bias`)
    _score_bias: float = 0.0
    # the latest matrix of each kind of search
    _current: dict[str, Predictor] = field(default_factory=dict)
    # If there is a window, the full image that surrounds it in each of these. Key
    # "start": that of the start.
    _full_images: dict[str, FullImage] = field(default_factory=dict)
    _is_prepared: bool = False

    @property
    def preparation_spp(self) -> int:
        return count_samples(self.problem.renderer)

    def prepare(self, tick: ProgressCallback = lambda samples: None) -> None:
        """Choose the window, and compute the matrix of the clean configuration.

        The matrix is computed only if no search with the same window has done so.

        Args:
            tick: called with samples per pixel as they are traced.
        """
        if not self._is_prepared:
            self._set_window()
            self._is_prepared = True
        # `clean_matrix` has predictors by window (None for full images). It may be
        # shared with another search, which has computed this one.
        if self.window not in self.clean_matrix.predictors:
            # number 0: it belongs to no query
            predictor = self._make_predictor(
                self.problem.domain.start, "start", number=0, tick=tick
            )
            self.clean_matrix.predictors[self.window] = predictor

    def _set_window(self) -> None:
        """Choose the window; without one, full images are predicted."""
        with self.measure_seconds():
            windowing = find_window(self.problem)
        # it may be a `Refusal`: there is no window
        if isinstance(windowing, Windowing):
            self.window = windowing.window
            self._full_images["start"] = windowing.start_image
            self.n_traced += N_WINDOW_IMAGES  # those of `find_window`

    @property
    def clean_predictor(self) -> Predictor:
        """The matrix of the clean configuration."""
        self.prepare()
        return self.clean_matrix.predictors[self.window]

    def count_entries_and_bytes(self) -> tuple[int, int]:
        """Return the entries of the clean matrix, for one color channel, and its
        bytes.
        """
        return self.clean_predictor.n_entries, self.clean_predictor.n_bytes

    def _make_predictor(
        self,
        u: Tensor,
        kind: str,
        number: int,
        tick: ProgressCallback = lambda samples: None,
    ) -> Predictor:
        """Compute the predictor at a configuration, in the window if there is one.

        Args:
            u: (d,) the configuration.
            kind: kind of the search.
            number: index of its query, for the seed.
            tick: called with the samples that were traced for the predictor, without
                those of the surroundings.
        """
        with self.measure_seconds():
            seed = seeds.derive_seed(self.problem.seed, f"transport {kind}", number)
            renderer = self.problem.renderer
            if self.window is not None:
                # only the window is predicted: what surrounds it is rendered once
                base_seed = seeds.derive_seed(seed, "surroundings")
                renderer = renderer.crop_to(self.window, u, base_seed, SURROUNDINGS_SPP)
                self.n_traced += 1
            predictor = make_predictor(renderer, u, seed, tick)
        self.n_traced += predictor.n_traced_images
        return predictor

    def get_window_renderer(self, kind: str) -> Renderer | None:
        """Return the renderer that traces paths in the window, in the latest
        surroundings.

        None if there is no window, or the search ended with full images.
        """
        ended_with_full_images = kind in self.first_traced
        if self.window is None or ended_with_full_images:
            return None
        predictor = self._current.get(kind, self.clean_predictor)
        return self.problem.renderer.copy_with(crop=predictor.path_renderer.crop)

    def replay(self, query: Query) -> None:
        self._update_predictor(query)

    def evaluate(self, query: Query) -> Evaluation:
        """Evaluate a query by its predicted image, or by a traced one.

        It is traced if predictions were given up, and in the ranking after the search.
        """
        predictor = self._update_predictor(query)
        if predictor is None:  # its image has to be traced
            return self.problem.evaluate(query)
        evaluation, _ = self.problem.evaluate_full(
            query, query.u, query.seed, predictor.renderer
        )
        # samples per pixel of the prediction: a matrix counts as one
        return replace(evaluation, predicted=1)

    def _update_predictor(self, query: Query) -> Predictor | None:
        """Return the predictor of a query; None if its image is traced.

        Queries of the ranking and trials are traced. Every `COMPARISON_INTERVAL`
        queries of a search the predictor is compared with traced images. If it is too
        inaccurate, it is computed again at the query's configuration. Basis images of
        lights would be the same again: then the rest of the search is traced.
        """
        kind = query.kind
        number = query.row_index
        # number of queries of this search whose images are predicted
        n_predicted = self.count_predicted(kind, self.steps)
        if query.phase != "search" or number >= n_predicted:
            return None
        predictor = self._current.setdefault(kind, self.clean_predictor)
        is_due = number > 0 and number % COMPARISON_INTERVAL == 0
        # A random search ("baseline") does not move away from the start, so that its
        # predictor does not get old.
        if not is_due or not kind.startswith("search"):
            return predictor
        return self._compare_and_replace(predictor, query)

    def _compare_and_replace(
        self, predictor: Predictor, query: Query
    ) -> Predictor | None:
        """Compare a predictor with traced images, and replace it if it is inaccurate.

        Returns:
            The predictor to use; None if images are traced from now on.
        """
        kind = query.kind
        deviation = self._compare_predictor(predictor, query)
        # Also compared if the predictor is rejected, since the next one needs the full
        # image.
        has_same_surroundings, full_image = self._compare_surroundings(kind, query.u)
        if deviation.is_accepted and has_same_surroundings:
            return predictor
        if self._has_basis_images:
            self.stop_predicting(kind, query.row_index, f" of the {kind}")
            return None
        self._current[kind] = self._make_predictor(query.u, kind, query.row_index)
        if full_image is not None:
            self._full_images[kind] = full_image
        assert self.n_renewals is not None  # None only for a `Bank`
        self.n_renewals += 1
        return self._current[kind]

    @property
    def _has_basis_images(self) -> bool:
        """Whether images of each light are weighted, in place of a matrix.

        They do not depend on u, so that computing them again would change nothing. They
        are no matrix, and so have 0 entries.
        """
        return self.clean_predictor.n_entries == 0

    def _compare_predictor(self, predictor: Predictor, query: Query) -> Deviation:
        """Compare a predictor with traced images of a query's configuration.

        If there is a window, only the window is traced and compared.
        """
        seed = seeds.derive_seed(self.problem.seed, "transport check", query.row_index)
        renderer = self.problem.renderer
        if self.window is not None:
            # the window, with the surroundings into which the predictor pastes it
            renderer = renderer.copy_with(crop=predictor.path_renderer.crop)
        return self.compare(
            lambda view: self.problem.compare_view(
                predictor,
                query.u,
                seeds.derive_seed(seed, "view", view),
                self.problem.search_spp,
                renderer=renderer,
            )
        )

    def _compare_surroundings(
        self, kind: str, u: Tensor
    ) -> tuple[bool, FullImage | None]:
        """Compare the surroundings of the window at u with those that are in use.

        Args:
            kind: kind of the search, whose latest full image is in use.
            u: (d,) current configuration of the search.

        Returns:
            Whether both are equal up to the allowed deviation, and the full image at u.
            Without a window there are no surroundings, and the result is (True, None).
        """
        if self.window is None:
            return True, None
        before = self._full_images.get(kind, self._full_images["start"])
        with self.measure_seconds():
            current, deviation = self.measure_surroundings(self.window, before, u)
        return deviation.is_accepted, current

    def is_likely_success(self, u: Tensor) -> bool:
        """Return whether a configuration (d,) would probably succeed in its trials.

        It would if its predicted score is over 0 after the bias is subtracted
        (`update_score_bias`).
        """
        return self._predict_score(u) > self._score_bias

    def update_score_bias(self, u: Tensor, scores: Sequence[float]) -> None:
        """Update the bias of predicted scores from the trials of a configuration.

        A configuration passes if nearly all of its trials have a score over 0. So the
        predicted score is compared with the lower end of the trials' scores, above
        which 95 % of normally distributed scores lie: their mean minus 1.64 standard
        deviations. The bias is the predicted score minus this lower end. With few
        trials, or with a score that is not finite, the bias stays.

        Args:
            u: (d,) the configuration.
            scores: scores of its trials.
        """
        if len(scores) >= MIN_SCORES and all(map(math.isfinite, scores)):
            mean = statistics.fmean(scores)
            lower_end = mean - LOWER_END_DEVIATIONS * statistics.stdev(scores)
            self._score_bias = self._predict_score(u) - lower_end

    def _predict_score(self, u: Tensor) -> float:
        """Return the score of the image that is predicted from the start."""
        with torch.no_grad():
            image = round_to_8_bit(self.clean_predictor(u))
            return self.problem.judge(image, u).score


class BasisPictures(SweepMethod):
    """Predicts images at one size of a scene by a basis image of each light.

    Images of a group differ only in the strength of lights: they are weighted sums of
    the basis images.
    """

    name = "basis pictures"
    samples = COLLECTED_SPP

    def __init__(self, renderer: Renderer) -> None:
        """Find the lights whose strength is a parameter."""
        self._renderer = renderer
        self._lighting = find_light_groups(renderer)
        self.parameters = frozenset(self._lighting.inputs_by_group)
        self.changes_scene = any(self._lighting.inputs_by_group.values())

    def find_refusal(self, make_groups: MakeGroups, spp: int) -> Refusal | None:
        """Return why images are rendered; None if they are predicted.

        Images are predicted if that takes at most 1 / `MIN_SAVING_FACTOR` of the
        samples that rendering a group takes, and if the basis images fit into memory.

        Args:
            make_groups: returns the groups whose images differ in some parameters.
            spp: samples per pixel of the images.
        """
        groups = make_groups(self.parameters)
        # Only an image without noise can be predicted from basis images.
        is_denoised = self._renderer.formation.denoiser == "oidn"
        if not is_denoised:
            return NOISE
        n_lights = self._count_lights()
        prediction_samples = n_lights * COLLECTED_SPP + count_check_samples(spp)
        # Rendering a group takes `spp` for each image.
        min_images = math.ceil(MIN_SAVING_FACTOR * prediction_samples / spp)
        if groups.group_size < min_images:
            return Refusal(
                f"basis pictures pay where {min_images} pictures or more differ in "
                f"light alone; here {groups.group_size} do"
            )
        return self._find_memory_refusal(groups, n_lights)

    def _count_lights(self) -> int:
        """Count the lights, whose number is the same in all configurations."""
        renderer = self._renderer
        start_inputs = renderer.space.inputs(renderer.start)
        inputs = renderer.scene.input_assembler(start_inputs)
        return len(LightBasis(renderer, self._lighting, inputs).inputs_of_light)

    def _find_memory_refusal(self, groups: Groups, n_lights: int) -> Refusal | None:
        """Return a refusal if the basis images take too much memory; else None."""
        height, width = self._renderer.formation.resolution
        bytes_per_basis_image = BASIS_PIXEL_BYTES * height * width
        n_bytes = groups.n_groups_to_cache * n_lights * bytes_per_basis_image
        if n_bytes > scale_limit(MAX_BYTES):
            return Refusal(
                f"basis pictures of {groups.n_groups} groups take too much memory; "
                "make "
                "light the last axes of the grid"
            )
        return None

    def make_predictor(self, u: Tensor, seed: int) -> Predictor:
        """Return the predictor of the images of a group.

        Args:
            u: (d,) configuration of any image of the group: they differ only in light,
                which the predictor takes from the image to predict.
            seed: seed of the light paths of its basis images.
        """
        return BasisRenderer(self._renderer, u, seed, changing=self._lighting)


class MatrixMethod(PredictionMethod):
    """Predicts by a matrix of light transport, or by basis images if lights change.

    A single matrix is for searches without random conditions, of which each needs a
    matrix of its own.
    """

    name = "matrix"
    pictures_are = "predicted by a matrix"

    def find_search_refusal(
        self, problem: Problem, steps: int, policy: Policy[Any]
    ) -> Refusal | None:
        if problem.conditions is not None:
            return NOTHING_MOVES
        return find_matrix_refusal(problem, steps, specialise=True)

    def make_search(
        self,
        problem: Problem,
        steps: int,
        *,
        collect_light: Evaluate,
        clean_matrix: CleanMatrix,
    ) -> PredictedSearch:
        return Transport(problem, steps, clean_matrix=clean_matrix)

    def make_sweep_method(self, renderer: Renderer, seed: int) -> SweepMethod:
        return BasisPictures(renderer)
