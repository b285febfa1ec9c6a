"""Searches whose images are predicted, and their simplest predictor: a matrix.

A matrix of light transport predicts the images of a search without random conditions.
Every `COMPARISON_INTERVAL` evaluations predictions are compared with traced images. If
they are not accurate enough (`engine.acceptance`), the matrix is computed again. The
ranking and all trials trace paths; the ranking does so only in the window.
"""

from __future__ import annotations

import math
import statistics
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluate, Evaluation
from advsearch.attacks.evaluation import Query
from advsearch.engine.acceptance import ComparedView, Deviation, compare_views
from advsearch.engine.problem import Problem
from advsearch.engine.windows import (
    N_WINDOW_IMAGES,
    FullImage,
    Windowing,
    find_window,
    measure_outside,
    render_full,
)
from advsearch.runs.results import BankOfConditions, LinearTransport, PredictionError
from advsearch.scene.color import round_to_8_bit
from advsearch.scene.predictor import Predictor, Refusal, RefusalCause
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.lights import (
    count_lights,
    count_samples,
    find_refusal,
    make_predictor,
)
from advsearch.scene.transport.matrix import ProgressCallback
from advsearch.scene.window import Window

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
    if not specialise:
        return Refusal("nothing is left out")  # which the user has set
    # why the image is composed of several; "" if it is not
    if problem.renderer.composition_reason:
        return Refusal(problem.renderer.composition_reason)
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
class PredictedSearch(ABC):
    """A predictor of the images of a run's searches.

    All of it follows from the seed, so that a resumed run computes the same again.

    Attributes:
        method: name of the method, for reports.
        title: text about its preparation, for the progress bar.
        what_it_renders: text about what the search still renders, for the progress bar.
        is_exact: whether equal configurations have equal objectives.
        problem: problem of the searches.
        steps: number of evaluations of a search. Later ones belong to the ranking, and
            are traced.
        draws_conditions: whether each evaluation draws conditions; see
            `Domain.draws_conditions`.
        deviations: deviation of predictions from traced images, for each comparison.
        n_traced: number of images that were traced, for the predictor and for
            comparisons.
        seconds: time that was spent on both.
        n_renewals: how often the predictor was computed again; None for a predictor
            that never is.
        first_traced: by kind of search, index of the first evaluation that is traced
            because predictions were given up.
        tracing_reason: why predictions were given up, as a sentence; None if they were
            not.
        window: the window of the image that is traced; None for the full image.
    """

    method: ClassVar[str] = "matrix"
    title: ClassVar[str] = "collecting light transport"
    what_it_renders: ClassVar[str] = "renders nothing"
    is_exact: ClassVar[bool] = False

    problem: Problem
    steps: int
    draws_conditions: bool = field(default=False, kw_only=True)
    deviations: list[Deviation] = field(default_factory=list, kw_only=True)
    n_traced: int = field(default=0, kw_only=True)
    seconds: float = field(default=0.0, kw_only=True)
    n_renewals: int | None = field(default=0, kw_only=True)
    first_traced: dict[str, int] = field(default_factory=dict, kw_only=True)
    tracing_reason: str | None = field(default=None, kw_only=True)
    window: Window | None = field(default=None, kw_only=True)

    @property
    @abstractmethod
    def preparation_spp(self) -> int:
        """Samples per pixel that are traced before the search can begin."""

    @abstractmethod
    def prepare(self, tick: ProgressCallback = lambda samples: None) -> None:
        """Compute the predictor at the start of the search.

        `tick` is called with samples per pixel as they are traced.
        """

    @property
    def accuracy_refusal(self) -> Refusal | None:
        """Why it is too inaccurate to be used; None if it is not.

        This was measured with images that were traced to prepare it.
        """
        return None

    @abstractmethod
    def replay(self, query: Query) -> None:
        """Replay a query that was read from the store.

        Comparisons and renewals happen as they did when it was evaluated.
        """

    @abstractmethod
    def evaluate(self, query: Query) -> Evaluation:
        """Evaluate one query of the search itself."""

    def evaluate_all(
        self, queries: Sequence[Query], trace: Evaluate
    ) -> Iterator[Evaluation]:
        """Evaluate queries of a search lazily.

        Args:
            queries: the queries.
            trace: evaluates queries by rendered images. A subclass may use it for those
                that it can't predict; here `evaluate` renders their images itself.
        """
        return map(self.evaluate, queries)

    def get_window_renderer(self, kind: str) -> Renderer | None:
        """Return the renderer of the window at the end of a kind of search.

        None if full images are rendered.
        """
        return None

    def rank_all(
        self, queries: Sequence[Query], trace: Evaluate
    ) -> Iterator[Evaluation]:
        """Evaluate the queries of a ranking lazily.

        A ranking renders the best configurations of a search again, to choose the best
        one. So images are traced and not predicted; if there is a window, only the
        window is traced.

        Args:
            queries: the queries, all of one kind.
            trace: renders full images.
        """
        renderer = self.get_window_renderer(queries[0].kind)
        if renderer is None:
            yield from trace(queries)
            return
        for query in queries:
            evaluation, _ = self.problem.evaluate_full(
                query, query.u, query.seed, renderer
            )
            yield evaluation

    @abstractmethod
    def count_entries_and_bytes(self) -> tuple[int, int]:
        """Return the number of entries of the matrices, for one color channel, and
        their size in bytes.
        """

    def summarize_conditions(self) -> BankOfConditions | None:
        """Return the state of a bank of conditions; None without conditions."""
        return None

    def count_predicted(self, kind: str, evaluations: int) -> int:
        """Return how many of the first evaluations of a search were predicted."""
        return min(evaluations, self.first_traced.get(kind, evaluations))

    def compare(self, compare_view: Callable[[int], ComparedView]) -> Deviation:
        """Compare predictions with traced images, and store the deviation.

        `compare_view` compares a single view; see `acceptance.compare_views`.
        """
        with self.measure_seconds():
            self.deviations.append(compare_views(compare_view))
        self.n_traced += self.deviations[-1].n_traced
        return self.deviations[-1]

    def measure_surroundings(
        self, window: Window, before: FullImage, u: Tensor
    ) -> tuple[FullImage, Deviation]:
        """Render the full image, and measure how it differs outside of the window.

        Args:
            window: the pixels that are predicted, which do not count.
            before: an earlier full image, whose surroundings are in use.
            u: (d,) the configuration to render.

        Returns:
            The full image of u, and the deviation of the earlier one from it.
        """
        current = render_full(self.problem, u)
        self.n_traced += 1
        return current, measure_outside(self.problem, window, before, [current])

    def stop_predicting(self, kind: str, number: int, where: str = "") -> None:
        """Give predictions up for a kind of search, and trace its images from now on.

        Args:
            kind: kind of the search.
            number: index of the first evaluation that is traced.
            where: text that follows "evaluation 20" in the reason for the user, such as
                " of the search". If there is a reason already, it stays.
        """
        self.first_traced[kind] = number
        reason = (
            f"pictures are rendered from evaluation {number}{where} on: predicted "
            "ones were too far off"
        )
        self.tracing_reason = self.tracing_reason or reason

    @contextmanager
    def measure_seconds(self) -> Iterator[None]:
        """Count the time of a block as spent on the predictor."""
        started = time.perf_counter()
        yield
        self.seconds += time.perf_counter() - started

    def summarize(self) -> LinearTransport:
        """Return the summary of the predictor, of any method, that a result stores.

        A predictor was used even if predictions were given up later; `reason` then says
        why.
        """
        entries, n_bytes = self.count_entries_and_bytes()
        error = None
        if self.deviations:
            latest_deviation = self.deviations[-1]
            error = PredictionError.from_values(latest_deviation)
        return LinearTransport(
            used=True,
            method=self.method,
            reason=self.tracing_reason,
            window=self.window,
            conditions=self.summarize_conditions(),
            entries=entries,
            bytes=n_bytes,
            seconds=self.seconds,
            renewed=self.n_renewals,
            error=error,
        )


@dataclass
class CleanMatrix:
    """The matrices of the clean configuration, by the window that was traced.

    Attacks that differ only in their budget of change share them.
    """

    predictors: dict[Window | None, Predictor] = field(default_factory=dict)


@dataclass
class Transport(PredictedSearch):
    """The matrices of a run whose searches have no random conditions.

    Attributes:
        clean_matrix: the matrix with which every search begins.
    """

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
