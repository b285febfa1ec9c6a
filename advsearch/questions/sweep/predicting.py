"""Predictors of the images of a sweep.

A predictor serves a *group*: images of a sweep that differ in one respect only. If they
differ only in light, they are combined from basis images (docs/transport.md). If they
differ only in the camera, they are made from light on surfaces (docs/surface-light.md).
Some images are traced for comparison; if predicted ones deviate too much, the group is
rendered. A predictor depends only on its group, so that a sweep that was stopped
continues with the same one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Query
from advsearch.engine.acceptance import (
    ComparedView,
    Deviation,
    compare_views,
    compare_with_traced,
)
from advsearch.engine.image_groups import Groups
from advsearch.engine.prediction import SweepMethod, make_methods
from advsearch.engine.problem import Problem
from advsearch.questions.sweep.axes import Axis, SceneConfigurations
from advsearch.runs.results import LinearTransport, PredictionError
from advsearch.scene.color import round_to_8_bit
from advsearch.scene.predictor import (
    NOTHING_MOVES,
    Predictor,
    Refusal,
    RefusalCause,
)


@dataclass(frozen=True, eq=False)
class SweptImage:
    """An image of a sweep.

    Attributes:
        image: (H, W, 3), sRGB in [0, 1].
        prediction_spp: samples per pixel of what predicted it; 0 if it was rendered.
        n_traced: number of images that were traced for it. Those that were traced to
            prepare a predictor count for the first image of the group.
    """

    image: Tensor
    prediction_spp: int
    n_traced: int


@dataclass
class SweepPredictor:
    """Makes the images of one scene at one size, predicted if that saves time.

    Attributes:
        problem: problem of a model that gets these images.
        configurations: the configurations of the scene.
        axes: axes of the grid.
        seed: seed of the predictors.
        specialise: whether images may be predicted.
        images_before: number of images of the scenes before this one.
        deviations: deviations of the predictors from traced images.
        seconds: seconds that making and comparing the predictors took.
        rendered_groups: indices of the groups whose images are rendered because
            predictions deviated too much.
        renderer: renderer of the problem.
        method: method that predicts images, or would if it were not refused.
        refusal: why all images are rendered; None if they are predicted.
    """

    problem: Problem
    configurations: SceneConfigurations
    axes: tuple[Axis, ...]
    seed: int
    specialise: bool
    images_before: int = 0
    deviations: list[Deviation] = field(default_factory=list)
    seconds: float = 0.0
    rendered_groups: set[int] = field(default_factory=set)
    # number of images that were traced to prepare the predictor of each group
    _n_traced_of_group: dict[int, int] = field(default_factory=dict)
    # The cached predictors by the index of the group; None if its predictions deviated
    # too much, so that its images are rendered.
    _predictors: dict[int, Predictor | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.renderer = self.problem.renderer
        self.method, self.refusal = self._choose_method()
        self._groups = self._make_groups(self.method.parameters)

    def _choose_method(self) -> tuple[SweepMethod, Refusal | None]:
        """Choose the method that predicts images.

        Returns:
            The cheapest method that is not refused, and None. If all are refused, one
            of them and why it is refused, for the user to read. That is the first one
            which could predict something that varies, since its reason says what to
            change; else the last one.
        """
        refused: list[tuple[SweepMethod, Refusal]] = []
        for prediction_method in make_methods():  # cheapest first
            method = prediction_method.make_sweep_method(self.renderer, self.seed)
            if method is None:
                continue
            refusal = self._find_refusal(method)
            if refusal is None:
                return method, None
            refused.append((method, refusal))
        for method, refusal in refused:
            could_predict_something = refusal.cause is not RefusalCause.NOTHING_MOVES
            if could_predict_something:
                return method, refusal
        return refused[-1]

    def _find_refusal(self, method: SweepMethod) -> Refusal | None:
        """Return why a method does not predict these images; None if it does."""
        if not method.changes_scene:
            return NOTHING_MOVES
        if self.renderer.composition_reason or not self.specialise:
            return Refusal(self.renderer.composition_reason or "nothing is left out")
        return method.find_refusal(self._make_groups, self.problem.search_spp)

    def _make_groups(self, parameters: frozenset[str]) -> Groups:
        """Divide the images into groups whose images may differ in some parameters.

        Args:
            parameters: names (control.parameter) of these parameters. What is sampled
                may differ in a group only if all sampled parameters are among them.
        """
        axis_names = [axis.name for axis in self.axes]
        # Here a group is the coordinates of one parameter.
        parameter_names = [group.name for group in self.renderer.space.groups]
        sampled_names = [name for name in parameter_names if name not in axis_names]
        return Groups(
            self.configurations.grid,
            samples=self.configurations.samples_per_grid_point,
            within=tuple(name in parameters for name in axis_names),
            may_draws_differ=parameters.issuperset(sampled_names),
            frame_axis=self.configurations.independent_units.frames,
        )

    def make_images(self, query_of_image: Mapping[int, Query]) -> dict[int, SweptImage]:
        """Render or predict images.

        Images of the same predictor are collected first, and then predicted all at
        once.

        Args:
            query_of_image: the queries by the number of the image in the scene.

        Returns:
            The images by their numbers.
        """
        images: dict[int, SweptImage] = {}
        numbers_by_predictor: dict[Predictor, list[int]] = {}
        for number, query in query_of_image.items():
            predictor = self._find_predictor_of_image(number)
            if predictor is None:
                images[number] = self._render_swept_image(number, query)
            else:
                numbers_by_predictor.setdefault(predictor, []).append(number)
        for predictor, numbers in numbers_by_predictor.items():
            queries = [query_of_image[number] for number in numbers]
            images |= self._predict_swept_images(predictor, numbers, queries)
        return images

    def _find_predictor_of_image(self, number: int) -> Predictor | None:
        """Return the predictor of an image of the scene; None if it is rendered."""
        if self.refusal is not None:
            return None
        group = self._groups.find_group_of_image(number)
        return self._load_predictor(group, number)

    def _predict_swept_images(
        self, predictor: Predictor, numbers: Sequence[int], queries: Sequence[Query]
    ) -> dict[int, SweptImage]:
        """Predict images by one predictor, by their numbers in the scene.

        Args:
            predictor: the predictor.
            numbers: (n,) numbers of the images.
            queries: (n,) their queries.
        """
        predicted = predictor.predict_images([query.u for query in queries])
        images: dict[int, SweptImage] = {}
        for number, image in zip(numbers, predicted, strict=True):
            n_traced = self._count_traced(number)
            images[number] = SweptImage(
                image, prediction_spp=self.method.samples, n_traced=n_traced
            )
        return images

    def _render_swept_image(self, number: int, query: Query) -> SweptImage:
        """Render an image by its number in the scene."""
        image = self.renderer(query.u, seed=query.seed, spp=self.problem.search_spp)
        # Images may have been traced for a predictor that was then rejected.
        n_traced = self._count_traced(number) + 1
        return SweptImage(image, prediction_spp=0, n_traced=n_traced)

    def _count_traced(self, number: int) -> int:
        """Return how many images were traced to prepare the predictor of an image.

        The predictor serves a group of images. What was traced for it counts for the
        first of them; for the others this is 0.
        """
        first_of_group = self._groups.find_image_of_group(number, 0)
        if number != first_of_group:
            return 0
        return self._n_traced_of_group.get(self._groups.find_group_of_image(number), 0)

    def _load_predictor(self, group: int, number: int) -> Predictor | None:
        """Return the predictor of a group; None if its images are rendered.

        A predictor is cached. If too many are cached, the one that was made first is
        released.

        Args:
            group: index of the group.
            number: number of an image of the group, in the scene.
        """
        if group in self._predictors:
            return self._predictors[group]
        if len(self._predictors) >= self._groups.n_groups_to_cache:
            oldest = next(iter(self._predictors))
            self._predictors.pop(oldest)
        begin = time.perf_counter()
        self._predictors[group] = self._make_accurate_predictor(group, number)
        self.seconds += time.perf_counter() - begin
        return self._predictors[group]

    def _make_accurate_predictor(self, group: int, number: int) -> Predictor | None:
        """Make the predictor of a group, and compare it with traced images.

        It depends only on the index of its group, not on the image that needs it first,
        so that a sweep that was stopped continues with the same predictors.

        Args:
            group: index of the group.
            number: number of an image of the group, in the scene.

        Returns:
            The predictor; None if it deviates too much. Then the images of its group
            are rendered.
        """
        # A scene has no more groups than images. So no two groups of the sweep have
        # the same index.
        group_index = self.images_before + group
        seed = seeds.derive_seed(self.seed, "light", group_index)
        # that of the first image of the group, whichever image comes first
        configuration = self._make_configuration(number, index=0)
        predictor = self.method.make_predictor(configuration, seed)
        deviation = self._compare(predictor, number, seed)
        self.deviations.append(deviation)
        self._n_traced_of_group[group] = predictor.n_traced_images + deviation.n_traced
        if deviation.is_accepted:
            return predictor
        self.rendered_groups.add(group)
        return None

    def _compare(self, predictor: Predictor, number: int, seed: int) -> Deviation:
        """Compare predicted images of a group with traced ones.

        The compared images are random members of the group, of which one may be taken
        more than once. They and the noise of the traced images follow from `seed`.

        Args:
            predictor: predictor of the group.
            number: number of an image of the group, in the scene.
            seed: seed of the comparison.
        """
        compare_view = partial(self._compare_view, predictor, number, seed)
        with torch.no_grad():
            return compare_views(compare_view)  # calls it once for each view

    def _compare_view(
        self, predictor: Predictor, number: int, seed: int, check: int
    ) -> ComparedView:
        """Compare a random image of a group with a traced one.

        See `_compare` for the other arguments.

        Args:
            check: index of the comparison, for the seeds.
        """
        index = seeds.derive_seed(seed, "check", check) % self._groups.group_size
        u = self._make_configuration(number, index)
        (predicted,) = predictor.predict_images([u])
        return compare_with_traced(
            self.renderer,
            predicted,
            u,
            seeds.derive_seed(seed, "traced", check),
            self.problem.search_spp,
            self._compute_margin_in_8_bits,
        )

    def _compute_margin_in_8_bits(self, image: Tensor, u: Tensor) -> float:
        """Return the margin of the model's prediction about an image.

        The model gets images in 8 bits; other deviations are computed without rounding.
        """
        return self.problem.judge(round_to_8_bit(image), u).margin

    def _make_configuration(self, number: int, index: int) -> Tensor:
        """Return the configuration (d,) of an image of a group.

        Args:
            number: number of any image of the group, in the scene.
            index: index of the image in the group.
        """
        member = self._groups.find_image_of_group(number, index)
        return self.configurations.make_configurations(member, 1, self.images_before)[0]

    @property
    def n_non_finite(self) -> int:
        """Number of values of predicted images that were not finite and set to 0."""
        return sum(
            predictor.n_non_finite
            for predictor in self._predictors.values()
            if predictor is not None
        )

    def summarize(self) -> LinearTransport | None:
        """Return what a result states about predicted images.

        That is the worst deviation, the memory and the time, or why images are
        rendered. None if nothing varies that a method could predict.
        """
        if self.refusal is not None:
            if self.refusal.cause is RefusalCause.NOTHING_MOVES:
                return None
            return LinearTransport(used=False, reason=str(self.refusal))
        # `entries` and `renewed` are about the matrix of an attack. Sweeps have none.
        return LinearTransport(
            used=True,
            method=self.method.name,
            reason=self._explain_rendered_groups(),
            entries=0,
            bytes=self.method.bytes + self._count_predictor_bytes(),
            seconds=self.seconds,
            renewed=0,
            error=self._find_worst_error(),
        )

    def _explain_rendered_groups(self) -> str | None:
        """Return why some groups were rendered; None if none was."""
        if not self.rendered_groups:
            return None
        return (
            f"{len(self.rendered_groups)} of {self._groups.n_groups} groups were "
            "rendered: predicted pictures were too far off"
        )

    def _find_worst_error(self) -> PredictionError | None:
        """Return the largest deviation from traced images; None if none was compared."""
        if not self.deviations:
            return None
        worst = max(self.deviations, key=lambda deviation: deviation.levels)
        return PredictionError.from_values(worst)

    def _count_predictor_bytes(self) -> int:
        """Count the memory of the cached predictors."""
        return sum(
            predictor.n_bytes
            for predictor in self._predictors.values()
            if predictor is not None
        )


def combine_transport(
    all_summaries: Sequence[LinearTransport | None],
) -> LinearTransport | None:
    """Combine the summaries of the predicted images of several scenes.

    Args:
        all_summaries: summaries of all scenes and image sizes; None if nothing moves.

    Returns:
        The worst error, the largest memory, all seconds and the first reason, over the
        summaries with predicted images. If there are none, the last summary; None if
        nothing moves in any scene.
    """
    summaries = [summary for summary in all_summaries if summary is not None]
    with_predictions = [summary for summary in summaries if summary.used]
    if not with_predictions:
        return summaries[-1] if summaries else None
    reasons = [summary.reason for summary in with_predictions if summary.reason]
    errors = [summary.error for summary in with_predictions if summary.error]
    all_bytes = [summary.bytes or 0 for summary in with_predictions]
    all_seconds = [summary.seconds or 0.0 for summary in with_predictions]
    update = {
        "reason": reasons[0] if reasons else None,  # as an example for all
        "bytes": max(all_bytes),
        "seconds": math.fsum(all_seconds),
        # `levels` is how far an image was off, in levels of 8 bits.
        "error": max(errors, key=lambda error: error.levels or 0.0, default=None),
    }
    # The other fields, such as the method, are the same in all scenes.
    return with_predictions[0].model_copy(update=update)
