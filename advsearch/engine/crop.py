"""Searches that render only the window of the image in which something can change.

The rest of each image is that of a whole one. It is rendered again every
`COMPARISON_INTERVAL` evaluations, which also measures what was missed. Where this is
too much twice in a row, the rest of the search renders whole images. All trials do so
anyway. How the window is chosen: `advsearch.engine.windows`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from advsearch import seeds
from advsearch.attacks import Evaluation
from advsearch.attacks.evaluation import Query
from advsearch.engine.transport import COMPARISON_INTERVAL, PredictedSearch
from advsearch.engine.windows import (
    N_WINDOW_IMAGES,
    PROBE_SPP,
    FullImage,
    Windowing,
    find_window,
)
from advsearch.scene.predictor import Refusal
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.matrix import ProgressCallback


@dataclass
class CroppedSearch(PredictedSearch):
    """The window of a run's searches, and what is around it.

    Attributes:
        windowing: the window; None before it is chosen, or if there is none.
        refusal: why there is none.
    """

    method: ClassVar[str] = "crop"
    title: ClassVar[str] = "finding the part of the picture that can change"
    what_it_renders: ClassVar[str] = "renders that part alone"

    windowing: Windowing | None = None
    refusal: Refusal | None = None
    # the latest whole image of each kind of search, and the renderer with that around
    _current: dict[str, tuple[FullImage, Renderer]] = field(default_factory=dict)

    @property
    def n_samples(self) -> int:
        return 2 * N_WINDOW_IMAGES * PROBE_SPP  # each image has two halves

    @property
    def accuracy_refusal(self) -> Refusal | None:
        return self.refusal

    def measure_size(self) -> tuple[int, int]:
        """Return 0 entries, as there is no matrix, and the bytes of stored images."""
        height, width = self.problem.renderer.formation.resolution
        # stored for each kind of search: the two halves of its full image, their mean,
        # and the surroundings of the window
        n_images = 4 * len(self._current)
        bytes_per_pixel = 3 * 4  # three channels of float32
        return 0, bytes_per_pixel * height * width * n_images

    def count_predicted(self, kind: str, evaluations: int) -> int:
        return 0  # they are rendered

    def prepare(self, tick: ProgressCallback = lambda samples: None) -> None:
        """Choose the window, and render the surroundings at the start."""
        with self.count_time():
            windowing = find_window(self.problem)
            if isinstance(windowing, Refusal):
                self.refusal = windowing
                return
            self.windowing = windowing
            self.window = windowing.window
            self.deviations.append(windowing.deviation)
            tick(self.n_samples)
            self.n_traced += N_WINDOW_IMAGES
            # all searches begin with these; they belong to no query: number 0
            self._renew_surroundings(windowing, "start", 0, windowing.start)

    def _renew_surroundings(
        self, windowing: Windowing, kind: str, number: int, image: FullImage
    ) -> Renderer:
        """Render new surroundings of the window, for a kind of search from now on.

        Args:
            windowing: the window.
            kind: kind of the search.
            number: index of the query, for the seed.
            image: full image of the configuration whose surroundings are rendered; it
                is stored, to be compared with later ones.

        Returns:
            The renderer that traces the window and pastes it into these surroundings.
        """
        problem = self.problem
        seed = seeds.stream(problem.seed, f"crop {kind}", number)
        with problem.renderer.scene.limit_depth(problem.search_depth):
            renderer = problem.renderer.crop_to(
                windowing.window, image.u, seed, problem.spp
            )
        self.n_traced += 1
        self._current[kind] = image, renderer
        return renderer

    def get_window_renderer(self, kind: str) -> Renderer | None:
        """Return the latest renderer of the window for a kind of search.

        None if there is no window, or the search ended with full images.
        """
        if self.windowing is None or kind in self.first_traced:
            return None
        _, renderer = self._current.get(kind, self._current["start"])
        return renderer

    def replay(self, query: Query) -> None:
        self._update(query)

    def evaluate(self, query: Query) -> Evaluation:
        """Evaluate a query, by rendering only the window if that is enough."""
        renderer = self._update(query)
        if renderer is None:
            return self.problem.evaluate(query)
        evaluation, _ = self.problem.evaluate_full(query, query.u, query.seed, renderer)
        return evaluation

    def _update(self, query: Query) -> Renderer | None:
        """Return the renderer of the window for a query; None to render a full image.

        Every `COMPARISON_INTERVAL` queries of a search a full image is rendered, and
        the surroundings of the window in it are compared with those in use, which it
        then replaces. After two comparisons in a row that differ too much, the rest of
        the search renders full images.
        """
        kind = query.kind
        number = query.index
        first_full = self.first_traced.get(kind, self.steps)
        if query.phase != "search" or number >= first_full:
            return None
        if self.windowing is None:
            self.prepare()
        assert self.windowing is not None
        image, renderer = self._current.setdefault(kind, self._current["start"])
        is_due = number > 0 and number % COMPARISON_INTERVAL == 0
        # A random search ("baseline") does not move away from the start, so that its
        # surroundings do not get old.
        if not is_due or not kind.startswith("search"):
            return renderer
        was_accepted = self.deviations[-1].is_accepted
        with self.count_time():
            current, deviation = self.measure_surroundings(
                self.windowing.window, image, query.u
            )
            self.deviations.append(deviation)
            # After a single bad comparison the surroundings are only renewed, since
            # this may have been enough.
            if deviation.is_accepted or was_accepted:
                assert self.n_renewals is not None  # None only for a `Bank`
                self.n_renewals += 1
                return self._renew_surroundings(self.windowing, kind, number, current)
        self.trace_from(kind, number, f" of the {kind}")
        return None
