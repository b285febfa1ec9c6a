"""Methods that predict images in place of renders: their base classes and registry.

A method, such as a matrix of light transport, offers up to three things:

- a `PredictedSearch`, which predicts the images of the searches of a run;
- such a search for the trials of one configuration;
- a `SweepMethod`, which predicts the images of a sweep, group by group.

Methods are parts of the catalog, and other packages may add some (`PREDICTORS`).
"""

from __future__ import annotations

import inspect
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluate, Evaluation, Policy
from advsearch.attacks.domain import Domain, SampleSequence
from advsearch.attacks.evaluation import Query
from advsearch.attacks.policies.sampling import to_domain
from advsearch.catalog import list_built_ins
from advsearch.engine.acceptance import (
    CHECK_SPP,
    N_VIEWS,
    ComparedView,
    Deviation,
    compare_views,
)
from advsearch.engine.image_groups import MakeGroups
from advsearch.engine.problem import Problem
from advsearch.engine.windows import FullImage, measure_outside, render_full
from advsearch.registry import Registry
from advsearch.runs.results import BankOfConditions, LinearTransport, PredictionError
from advsearch.scene.predictor import (
    NOTHING_MOVES,
    Predictor,
    Refusal,
)
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.matrix import ProgressCallback
from advsearch.scene.window import Window

MIN_SAVING_FACTOR = 2.0
"""A group is predicted if rendering it takes at least this many times the samples of a
prediction, including the comparisons.
"""
MAX_SOBOL_DIM = 64  # coordinates of a condition up to which conditions are stratified


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

    method: ClassVar[str]
    title: ClassVar[str]
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


class SweepMethod(ABC):
    """Predicts the images of one scene of a sweep, at one size.

    Attributes:
        name: name of the method, for reports.
        samples: samples per pixel of what predicts an image.
        parameters: names (control.parameter) of the parameters in which images of a
            group may differ.
        changes_scene: whether a parameter among these changes more than the finished
            image, as exposure does.
    """

    name: ClassVar[str]
    samples: ClassVar[int]
    parameters: frozenset[str]
    changes_scene: bool

    @abstractmethod
    def find_refusal(self, make_groups: MakeGroups, spp: int) -> Refusal | None:
        """Return why images are rendered; None if they are predicted.

        Args:
            make_groups: returns the groups whose images differ in some parameters.
            spp: samples per pixel of the images.
        """

    @abstractmethod
    def make_predictor(self, u: Tensor, seed: int) -> Predictor:
        """Return the predictor of the images of a group.

        Args:
            u: (d,) configuration of any image of the group.
            seed: seed of what is traced for it.
        """

    @property
    def bytes(self) -> int:
        """Memory that groups share."""
        return 0


class PredictionMethod(ABC):
    """A method that predicts images in place of renders.

    The methods of the registry are tried in its order, the cheapest first.

    Attributes:
        name: name in the registry. Reports have the `method` of a search, or the `name`
            of a `SweepMethod`.
        pictures_are: text that completes "pictures are ...", such as "predicted by
            matrices".
        follows_bounces: whether its images have only the bounces of light that the
            search renders (`Problem.search_depth`); else they have all.
    """

    name: ClassVar[str]
    pictures_are: ClassVar[str]
    follows_bounces: ClassVar[bool] = True

    @abstractmethod
    def find_search_refusal(
        self, problem: Problem, steps: int, policy: Policy[Any]
    ) -> Refusal | None:
        """Return why the images of a search are not predicted; None if they may be.

        Called only if the setting `specialise` allows predictions. Whether they are
        accurate is measured later. A refusal with the cause `NOTHING_MOVES` is never
        reported.

        Args:
            problem: problem of the search, whose images are not composed of several.
            steps: evaluations of the search.
            policy: policy by which it searches.
        """

    @abstractmethod
    def make_search(
        self,
        problem: Problem,
        steps: int,
        *,
        collect_light: Evaluate,
        clean_matrix: CleanMatrix,
    ) -> PredictedSearch:
        """Return what predicts the images of a search. It is not prepared yet.

        Args:
            problem: problem of the search.
            steps: evaluations of the search.
            collect_light: evaluates queries of light, on workers if there are any.
            clean_matrix: the matrix of the clean scene, which attacks may share.
        """

    def find_trials_refusal(
        self, problem: Problem, coordinates: Tensor, spp: int, n_images: int
    ) -> Refusal | None:
        """Return why the images of trials are not predicted; None if they may be.

        The trials vary some coordinates of one configuration. A refusal with the cause
        `NOTHING_MOVES` is never reported.

        Args:
            problem: problem of the trials.
            coordinates: (k,) indices of the coordinates that vary.
            spp: samples per pixel of the trials.
            n_images: about how many trials there are.
        """
        return NOTHING_MOVES

    def make_trials(
        self, problem: Problem, u: Tensor, coordinates: Tensor
    ) -> PredictedSearch:
        """Return what predicts the images of trials. It is not prepared yet.

        Called only if `find_trials_refusal` returns None.

        Args:
            problem: problem of the trials.
            u: (d,) the configuration.
            coordinates: (k,) indices of the coordinates that vary.
        """
        raise NotImplementedError

    def make_sweep_method(self, renderer: Renderer, seed: int) -> SweepMethod | None:
        """Return what predicts the images of a sweep; None if the method can't.

        Args:
            renderer: renderer of the images of one scene at one size.
            seed: seed of the sweep.
        """
        return None


PREDICTORS: Registry[type[PredictionMethod]] = Registry(
    "advsearch.predictors",
    list_built_ins("predictor"),
    "a subclass of PredictionMethod whose name is that of the entry point",
    lambda name, entry: (
        isinstance(entry, type)
        and issubclass(entry, PredictionMethod)
        and not inspect.isabstract(entry)
        and getattr(entry, "name", None) == name
    ),
)
"""Every method by its name, the cheapest first, imported when it is used."""


def find_general_refusal(problem: Problem, specialise: bool) -> Refusal | None:
    """Return why no method may predict the images of a search; None if one may.

    Args:
        problem: problem of the search.
        specialise: whether the search may leave out or predict anything at all (the
            setting of this name).
    """
    if not specialise:
        return Refusal("nothing is left out")  # which the user has set
    # why the image is composed of several; "" if it is not
    if problem.renderer.composition_reason:
        return Refusal(problem.renderer.composition_reason)
    return None


def make_methods() -> list[PredictionMethod]:
    """Return every method that can be imported, the cheapest first."""
    return [method() for method in PREDICTORS.list_usable().values()]


def count_check_samples(spp: int) -> int:
    """Return how many samples per pixel the comparison with traced images takes.

    Of each of the `N_VIEWS` compared images two halves are traced, to estimate the
    noise, and once the image itself, with `spp`.
    """
    return N_VIEWS * (2 * CHECK_SPP + spp)


def sample_condition(domain: Domain, index: int, seed: int) -> Tensor:
    """Return the condition (d,) with an index, out of evenly spread ones.

    Conditions are points of a scrambled Sobol sequence, which covers their range better
    than independent samples; each is still uniformly distributed. Independent samples
    are taken if there are too many coordinates for the sequence, or if a block is an L2
    ball, which is no box.

    Args:
        domain: domain of the conditions.
        index: index in the sequence; a bank takes 0, 1, 2, ...
        seed: seed of the sequence.
    """
    has_l2_block = any(block.norm == "l2" for block in domain.blocks)
    if domain.dim > MAX_SOBOL_DIM or has_l2_block:
        generator = torch.Generator().manual_seed(
            seeds.derive_seed(seed, "bank condition", index)
        )
        return domain.sample(generator)[0]
    sequence = SampleSequence(domain.dim, "sobol", seed, "bank conditions")
    point = sequence.points(index, 1)[0]
    return to_domain(domain, torch.from_numpy(point).float())
