"""Searches that render only the window of the image in which something can change.

The surroundings of the window are taken from a full image. Every `COMPARISON_INTERVAL`
evaluations a new full image is rendered, which shows how much the surroundings have
changed. If they have changed too much twice in a row, the search renders full images
from there on. All trials render full images. `advsearch.engine.windows` chooses the
window.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from advsearch import seeds
from advsearch.attacks import Evaluation
from advsearch.attacks.evaluation import Query
from advsearch.engine.prediction import PredictedSearch
from advsearch.engine.transport import COMPARISON_INTERVAL
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
    """The window of a run's searches, and its surroundings.

    Attributes:
        selected_window: the window; None before it is chosen, or if there is none.
        refusal: why there is no window; None if there is one.
    """

    method: ClassVar[str] = "crop"
    title: ClassVar[str] = "finding the part of the picture that can change"
    what_it_renders: ClassVar[str] = "renders that part alone"

    selected_window: Windowing | None = None
    refusal: Refusal | None = None
    # For each kind of search the latest full image, and the renderer that pastes the
    # window into it. Key "start": those at the start, with which all searches begin.
    _current: dict[str, tuple[FullImage, Renderer]] = field(default_factory=dict)

    @property
    def preparation_spp(self) -> int:
        return 2 * N_WINDOW_IMAGES * PROBE_SPP  # each image has two halves

    @property
    def accuracy_refusal(self) -> Refusal | None:
        return self.refusal

    def count_entries_and_bytes(self) -> tuple[int, int]:
        """Return the entries of a matrix of light transport, and the bytes of memory.

        There is no matrix, hence 0 entries. The memory is that of stored images.
        """
        height, width = self.problem.renderer.formation.resolution
        # stored for each kind of search: the two halves of its full image, their mean,
        # and the surroundings of the window
        n_images = 4 * len(self._current)
        bytes_per_pixel = 3 * 4  # three channels of float32
        return 0, bytes_per_pixel * height * width * n_images

    def count_predicted(self, kind: str, evaluations: int) -> int:
        """Return 0, since all images are rendered, if only in the window."""
        return 0

    def prepare(self, tick: ProgressCallback = lambda samples: None) -> None:
        """Choose the window, and render the surroundings at the start."""
        with self.measure_seconds():
            windowing = find_window(self.problem)
            if isinstance(windowing, Refusal):
                self.refusal = windowing
                return
            self.selected_window = windowing
            self.window = windowing.window
            self.deviations.append(windowing.deviation)
            # images that `find_window` has rendered
            tick(self.preparation_spp)
            self.n_traced += N_WINDOW_IMAGES
            # number 0: it belongs to no query
            self._renew_surroundings(
                windowing, "start", number=0, image=windowing.start_image
            )

    def _renew_surroundings(
        self, windowing: Windowing, kind: str, number: int, image: FullImage
    ) -> Renderer:
        """Render new surroundings of the window at the configuration of a full image.

        A kind of search uses them from now on. They are rendered with the samples and
        the light paths of the search; the full image has fewer samples.

        Args:
            windowing: the selected window.
            kind: kind of the search.
            number: index of the query, for the seed.
            image: full image; it is stored, to be compared with later ones.

        Returns:
            The renderer that traces the window and pastes it into these surroundings.
        """
        problem = self.problem
        seed = seeds.derive_seed(problem.seed, f"crop {kind}", number)
        with problem.renderer.scene.limit_depth(problem.search_depth):
            # renders the surroundings
            renderer = problem.renderer.crop_to(
                windowing.window, image.u, seed, problem.search_spp
            )
        self.n_traced += 1
        self._current[kind] = image, renderer
        return renderer

    def get_window_renderer(self, kind: str) -> Renderer | None:
        """Return the latest renderer of the window for a kind of search.

        None if there is no window, or the search ended with full images.
        """
        ended_with_full_images = kind in self.first_traced
        if self.selected_window is None or ended_with_full_images:
            return None
        # (full image, renderer) that this kind of search uses; at first those of the
        # start
        _, renderer = self._current.get(kind, self._current["start"])
        return renderer

    def replay(self, query: Query) -> None:
        self._update_renderer(query)

    def evaluate(self, query: Query) -> Evaluation:
        """Evaluate a query, by rendering only the window if that is enough."""
        renderer = self._update_renderer(query)
        if renderer is None:
            return self.problem.evaluate(query)
        evaluation, _ = self.problem.evaluate_full(query, query.u, query.seed, renderer)
        return evaluation

    def _update_renderer(self, query: Query) -> Renderer | None:
        """Return the renderer of the window for a query; None to render a full image.

        Every `COMPARISON_INTERVAL` queries of a search a full image is rendered. It is
        compared outside of the window with the surroundings in use, and new ones are
        rendered in their place. After two comparisons in a row that differ too much,
        the search renders full images from there on.
        """
        kind = query.kind
        number = query.row_index
        if query.phase != "search" or number >= self._find_first_full(kind):
            return None
        if self.selected_window is None:
            self.prepare()
        assert self.selected_window is not None
        # a search begins with the surroundings of the start
        image_in_use, renderer = self._current.setdefault(kind, self._current["start"])
        is_due = number > 0 and number % COMPARISON_INTERVAL == 0
        # A random search ("baseline") does not move away from the start, so that its
        # surroundings do not get old.
        if not is_due or not kind.startswith("search"):
            return renderer
        return self._compare_and_renew(query, self.selected_window, image_in_use)

    def _find_first_full(self, kind: str) -> int:
        """Return the index of the first query of a search that renders a full image.

        Without one in `first_traced`, it is after all queries.
        """
        return self.first_traced.get(kind, self.steps)

    def _compare_and_renew(
        self, query: Query, windowing: Windowing, image_in_use: FullImage
    ) -> Renderer | None:
        """Compare the surroundings in use with a new full image, and renew them.

        Returns:
            The renderer with new surroundings; None if full images are rendered from
            now on.
        """
        was_accepted = self.deviations[-1].is_accepted
        with self.measure_seconds():
            new_image, deviation = self.measure_surroundings(
                windowing.window, image_in_use, query.u
            )
            self.deviations.append(deviation)
            # After a single bad comparison new surroundings may be enough.
            if deviation.is_accepted or was_accepted:
                assert self.n_renewals is not None  # None only for a `Bank`
                self.n_renewals += 1
                return self._renew_surroundings(
                    windowing, query.kind, query.row_index, new_image
                )
        self.stop_predicting(query.kind, query.row_index, f" of the {query.kind}")
        return None
