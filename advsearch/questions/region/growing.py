"""Grow the box in which the model's verdict stays, and draw a map of its margin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from advsearch.extend import (
    AttackConfig,
    InputError,
    Problem,
    RunContext,
    RunDirectory,
    directory,
    errors,
    figures,
    seeds,
    settings,
    workbench,
)
from advsearch.questions.region import boxes
from advsearch.questions.region.result import (
    AxisRange,
    BoxSide,
    GrownRegion,
    MarginMap,
    RegionConfig,
    RegionResult,
)

MAX_PARAMETERS = 8  # maximum number of parameters in which a box grows
CENTER_TRIALS = 20  # renders of the center, which decide its verdict


@dataclass(frozen=True, eq=False)
class VariedParameters:
    """The parameters in which the box grows.

    Attributes:
        names: names of the parameters.
        coordinate_indices: their indices in u (k,).
        center: the configuration around which the box grows (d,).
    """

    names: tuple[str, ...]
    coordinate_indices: Tensor
    center: Tensor

    @property
    def start(self) -> Tensor:
        """Their coordinates at the center (k,), in [0, 1]."""
        return self.center[self.coordinate_indices]

    def make_configuration(self, values: Tensor) -> Tensor:
        """Return the center (d,) with other coordinates (k,) of these parameters."""
        u = self.center.clone()
        u[self.coordinate_indices] = values
        return u


def find_region(context: RunContext[RegionConfig]) -> RegionResult:
    """Find the region around a configuration in which the prediction stays the same.

    The problem is loaded, the box is grown and checked, and the map is drawn. After an
    interrupt the result has no box.
    """
    config = context.config
    stages = context.stages
    problem, warnings = _load_region_problem(context)
    varied = find_varied(problem, config)
    ladder = workbench.choose_ladder(config.verify_spp, config.pixel_sampler)
    verifier = workbench.Verifier.open(context.run, problem, ladder, stages)
    grown = GrownRegion()
    with context.until_interrupted():
        grown = RegionSearch(context, verifier, varied).run()
    stages.end()
    return context.result(
        RegionResult,
        **vars(grown),
        environment=problem.environment,
        model=problem.model.name,
        task=problem.task.title,
        controls=[control.name for control in problem.space.controls],
        image_formation=problem.renderer.formation,
        # values of the scene outside of a control's range, which were replaced
        clean={"moved": problem.space.adjusted_defaults},
        warnings=warnings,
        transport=_get_transport_summary(verifier),
        renders=count_renders(verifier),
        seconds={**stages.seconds, "total": stages.total_seconds},
    )


def _load_region_problem(
    context: RunContext[RegionConfig],
) -> tuple[Problem, list[str]]:
    """Load the problem whose region is sought, and show the warnings about it.

    Returns:
        The problem, and the warnings.
    """
    config = context.config
    stages = context.stages
    stages.begin("setup", workbench.LOADING)
    # A budget limits the ranges of controls. With the budget of the run in `around`, the
    # ranges contain its adversarial configuration, which is the center.
    attack_config = AttackConfig.from_config(config, **_read_budget(config))
    problem, warnings = workbench.problem_from_config(attack_config)
    for text in warnings:
        stages.progress.message(text)
    return problem, warnings


def _read_budget(config: RegionConfig) -> dict[str, object]:
    """Return epsilon and norm of the attack whose run the setting `around` names.

    Empty without `around`: then the box grows around the scene's own configuration.
    """
    if config.around is None:
        return {}
    attack_config = AttackConfig.from_yaml(
        directory.find_run(config.around) / directory.CONFIG
    )
    return {"epsilon": attack_config.epsilon, "norm": attack_config.norm}


def _get_transport_summary(verifier: workbench.Verifier) -> Any:
    """Return how images from new viewpoints were predicted, or why they were not.

    None if no prediction was tried, for example because no camera moves.
    """
    state = verifier.run_state
    was_tried = state.predictor is not None or state.predictor_refusal is not None
    return state.transport_summary if was_tried else None


def count_renders(verifier: workbench.Verifier) -> dict[str, int]:
    """Return how many images were rendered, and how many predicted, if any.

    The keys are those of all results: "verification" for rendered images, here also
    those that prepared a predictor, and "products" for predicted ones.
    """
    state = verifier.run_state
    n_rendered = state.verification_renders
    if state.predictor is not None:
        n_rendered += state.predictor.n_traced
    renders = {"verification": n_rendered}
    if state.n_predicted_trials:
        renders["products"] = state.n_predicted_trials
    return renders


def find_varied(problem: Problem, config: RegionConfig) -> VariedParameters:
    """Find the parameters in which the box grows, and its center.

    They are the parameters that the setting `vary` names, or else all searched
    parameters. A discrete choice has no interval and is left out.

    Raises:
        UnknownNameError: `vary` names a parameter that the controls do not search.
        InputError: there are too few or too many parameters, a map has not two, or the
            run in `around` is over other controls.
    """
    coordinate_by_name = _list_coordinates(problem)
    names = tuple(coordinate_by_name)
    if config.vary is not None:
        names = settings.split_names(config.vary)
    _check_varied(names, coordinate_by_name, has_map=bool(config.map))
    # their indices among the coordinates of a configuration
    coordinates = torch.tensor([coordinate_by_name[name] for name in names])
    return VariedParameters(names, coordinates, read_center(problem, config))


def _check_varied(
    names: Sequence[str], known: Mapping[str, int], *, has_map: bool
) -> None:
    """Raise an error if a box cannot grow in some parameters, or a map not show them.

    Args:
        names: names of the parameters.
        known: the parameters that the controls search, by name.
        has_map: whether a map is drawn.
    """
    for name in names:
        if name not in known:
            raise errors.UnknownNameError("parameter in `vary`", name, known)
    if not 1 <= len(names) <= MAX_PARAMETERS:
        raise InputError(
            f"vary: expected 1 to {MAX_PARAMETERS} parameters, got {len(names)}; "
            f"name some of {', '.join(known)}"
        )
    if has_map and len(names) != 2:
        raise InputError(
            f"map: expected two parameters in `vary`, got {len(names)}: "
            f"{', '.join(names)}"
        )


def _list_coordinates(problem: Problem) -> dict[str, int]:
    """Return the index in u of each searched parameter that is no discrete choice.

    A vector has a parameter for each component, ``NAME.INDEX``.
    """
    coordinate_by_name: dict[str, int] = {}
    for group in problem.space.groups:
        is_choice = bool(group.options)
        if is_choice:
            continue
        for index in range(group.size):
            name = f"{group.name}.{index}" if group.size > 1 else group.name
            coordinate_by_name[name] = group.begin + index
    return coordinate_by_name


def read_center(problem: Problem, config: RegionConfig) -> Tensor:
    """Return the configuration (d,) around which the box grows.

    It is the scene's own configuration or, with the setting `around`, the adversarial
    configuration of a run.

    Raises:
        InputError: that run is over other controls.
    """
    start: Tensor = problem.domain.start.clone()
    if config.around is None:
        return start
    values = torch.from_numpy(
        workbench.read_configuration(directory.find_run(config.around))
    )
    # Other controls usually have another number of coordinates.
    if values.shape != start.shape:
        raise InputError(
            f"`around` {config.around}: expected a run over the same controls, whose "
            f"configuration has {problem.domain.dim} numbers, got one with "
            f"{len(values)}; leave `controls` out so that the run's own are taken"
        )
    return problem.domain.project(values)


class RegionSearch:
    """Grows and checks the box of one run."""

    def __init__(
        self,
        context: RunContext[RegionConfig],
        verifier: workbench.Verifier,
        varied: VariedParameters,
    ) -> None:
        """Prepare the search for the box.

        Args:
            context: the settings and the run.
            verifier: renders and evaluates points.
            varied: the parameters that the box has sides for.
        """
        self._config = context.config
        self._run = context.run
        self._verifier = verifier
        self._varied = varied
        self._is_checking = False  # True once the box has grown and is being checked
        self._is_wrong_at_center = False  # the verdict at the center, set by `run`

    def run(self) -> GrownRegion:
        """Find the verdict at the center, grow the box, and draw the map.

        The verdict is whether the model is right or wrong at the center. In the box the
        verdict is the same.
        """
        verifier = self._verifier
        varied = self._varied
        # Choose enough samples per pixel that noise does not decide the prediction at
        # the center.
        verifier.choose_spp({"centre": varied.center})
        self._is_wrong_at_center = find_verdict(verifier, varied.center)
        if self._config.specialise:
            self._prepare_predictor()
        grown = self._grow_box()
        sides = describe_box(verifier.problem, grown, varied)
        margin_map = self._draw_map_of(sides)
        return GrownRegion(
            verdict="wrong" if self._is_wrong_at_center else "right",
            box=sides,
            n_same=grown.n_same,
            samples=grown.samples,
            rate=grown.n_same / grown.samples,
            interval=grown.interval,
            volume=grown.volume,
            spp=verifier.run_state.spp,
            map=margin_map,
        )

    def _draw_map_of(self, sides: Sequence[BoxSide]) -> MarginMap | None:
        """Draw the map with the sides of the box; None without the setting `map`."""
        size = self._config.map
        if not size:
            return None
        return draw_map(self._verifier, size, self._varied, sides, self._run)

    def _prepare_predictor(self) -> None:
        """Prepare what predicts images of many cameras, such as light on surfaces.

        That pays only for enough images.
        """
        varied = self._varied
        n_growing_images = boxes.USUAL_PROBED * len(varied.names)
        n_map_images = self._config.map**2  # `map` is its size; 0 for no map
        n_images = n_growing_images + n_map_images
        self._verifier.prepare_predictor(
            varied.center, varied.coordinate_indices, n_images
        )

    def _grow_box(self) -> boxes.GrownBox:
        """Grow the box and check it."""
        self._begin_growing()
        return boxes.grow_box(
            self._is_same,
            self._varied.start,
            seed=seeds.derive_seed(self._config.seed, "region"),
            samples=self._config.samples,
            on_check=self._begin_check,
        )

    def _begin_growing(self) -> None:
        """Begin the stage in which the box grows."""
        hint = (
            f"pictures of {self._verifier.run_state.spp} samples a pixel; fewer parameters "
            "in `vary` or `verify_spp` shorten it"
        )
        limit = boxes.MAX_PROBED * len(self._varied.names)
        self._verifier.progress_stages.begin(
            "search", "growing the box", limit, hint=hint, at_most=True
        )

    def _begin_check(self) -> None:
        """Begin the stage of the check; later checks belong to the same stage."""
        if self._is_checking:
            return
        self._is_checking = True
        limit = boxes.ATTEMPTS * self._config.samples
        hint = (
            f"{self._config.samples} pictures, and as many again if any of them is an "
            "exception; `samples` shortens it"
        )
        title = "checking the box with fresh samples"
        self._verifier.progress_stages.begin(
            "search", title, limit, hint=hint, at_most=True
        )

    def _is_same(self, values: Tensor, number: int) -> bool:
        """Return whether the verdict at a point is that of the center.

        An image without the object, or with a prediction that is not a number, has no
        verdict, so the result is False.

        Args:
            values: values of the k parameters that vary, in [0, 1] (k,).
            number: number of the point, which decides the seed of its render.
        """
        # While the box grows, images may be predicted from the prepared light. Those of
        # the check are rendered, as its result is reported.
        predictor = None if self._is_checking else self._verifier.run_state.predictor
        u = self._varied.make_configuration(values)
        # A trial has a success, which is a wrong prediction. With `has_success=False` it
        # is not stored, since no wrong prediction is sought here.
        (trial,) = self._verifier.try_configurations(
            "region", {number: u}, has_success=False, predictor=predictor
        )
        has_verdict = not trial.prediction.is_out_of_view and not trial.is_non_finite
        is_wrong = trial.success
        return has_verdict and is_wrong == self._is_wrong_at_center


def find_verdict(verifier: workbench.Verifier, center: Tensor) -> bool:
    """Return whether the model is wrong at the center, tried with several seeds.

    Raises:
        InputError: the prediction depends on the noise, or is not a number, or the
            object is not in the image.
    """
    verifier.progress_stages.begin(
        "verification", "looking at the centre", CENTER_TRIALS
    )
    same_configurations = dict.fromkeys(range(CENTER_TRIALS), center)
    trials = list(
        verifier.try_configurations("centre", same_configurations, has_success=False)
    )
    _check_center_trials(trials)
    n_wrong = sum(trial.success for trial in trials)
    # True or False, or None if both right and wrong are too frequent for a verdict
    is_wrong = verifier.problem.verification_rule.decide(n_wrong, CENTER_TRIALS)
    if is_wrong is None:
        raise InputError(
            f"the model is wrong in {n_wrong} of {CENTER_TRIALS} trials at the centre, "
            "so its verdict there depends on the noise; choose another centre, or more "
            "samples with `verify_spp`"
        )
    return is_wrong


def _check_center_trials(trials: Sequence[Any]) -> None:
    """Raise an error if a trial has no verdict: no object in view, or no number."""
    n_hidden = sum(trial.prediction.is_out_of_view for trial in trials)
    if n_hidden:
        raise InputError(
            f"the object is not visible in {n_hidden} of {CENTER_TRIALS} trials at the "
            "centre, so there is no verdict; choose another centre"
        )
    n_non_finite = sum(trial.is_non_finite for trial in trials)
    if n_non_finite:
        raise InputError(
            f"the model's prediction is not a number in {n_non_finite} of "
            f"{CENTER_TRIALS} trials at the centre, so there is no verdict; choose "
            "another centre, or fix the model"
        )


def describe_box(
    problem: Problem, grown: boxes.GrownBox, varied: VariedParameters
) -> list[BoxSide]:
    """Return the range of each varied parameter inside the box, in its unit.

    A range is in the unit that the parameter's control describes, such as degrees. If
    no control describes it, it is a fraction of the parameter's range. A component of a
    vector is named ``NAME.INDEX``, for example "camera.target.0".

    Args:
        problem: problem of the scene.
        grown: the box.
        varied: the parameters that the box has sides for.
    """
    corners = (grown.low, grown.high, grown.center)
    described = [
        problem.describe(varied.make_configuration(corner)) for corner in corners
    ]
    sides = []
    for index, name in enumerate(varied.names):
        side = _make_described_side(name, *described)
        sides.append(side or _make_side_of_range(name, grown, index))
    return sides


def _make_side_of_range(name: str, grown: boxes.GrownBox, index: int) -> BoxSide:
    """Make a side of a box whose parameter no control describes.

    Args:
        name: name of the parameter.
        grown: the box.
        index: index of the side.
    """
    return BoxSide(
        name=name,
        unit="of the range",
        low=float(grown.low[index]),
        high=float(grown.high[index]),
        centre=float(grown.center[index]),
    )


def _make_described_side(
    name: str,
    low_values: Mapping[str, Any],
    high_values: Mapping[str, Any],
    center_values: Mapping[str, Any],
) -> BoxSide | None:
    """Make a side of a box from values that a control describes; None without any.

    Args:
        name: name of the parameter.
        low_values: described values at the lower corner.
        high_values: the same at the upper corner.
        center_values: the same at the center.
    """
    described_name = name
    component = ""
    if name not in low_values:
        # It may be a component, such as "camera.target.0" of "camera.target".
        described_name, _, component = name.rpartition(".")
    is_described = described_name in low_values
    if not is_described:
        return None
    return BoxSide(
        name=name,
        unit=str(low_values[described_name].get("unit", "")),
        low=read_described_value(low_values[described_name], component),
        high=read_described_value(high_values[described_name], component),
        centre=read_described_value(center_values[described_name], component),
    )


def read_described_value(described: Mapping[str, Any], component: str = "") -> float:
    """Return the described value of a parameter, or one of its components.

    Args:
        described: has the number or the vector under "value".
        component: index of a component as text; empty for a number.
    """
    value = described["value"]
    return float(value[int(component)] if component else value)


def draw_map(
    verifier: workbench.Verifier,
    size: int,
    varied: VariedParameters,
    box: Sequence[BoxSide],
    run: RunDirectory,
) -> MarginMap:
    """Draw the margin over two parameters, its zero line, and the box.

    Args:
        verifier: verifier that evaluates the points.
        size: number of points along each axis.
        varied: the two parameters that are the axes of the map.
        box: the two sides of the box, in the same order.
        run: run directory in which the figure is saved.
    """
    rows = _measure_margins(verifier, size, varied)
    x_range, y_range = find_ranges(verifier.problem, varied, box)

    def draw(axes: Any) -> None:
        draw_margins(axes, rows, x_range, y_range)
        draw_outline(axes, *box)

    for suffix, data in figures.render_axes(draw, (6.0, 4.6)).items():
        run.write_file(f"images/map.{suffix}", data)
    return MarginMap(axes=(x_range, y_range), margins=rows)


def _measure_margins(
    verifier: workbench.Verifier, size: int, varied: VariedParameters
) -> list[list[float]]:
    """Return the margin on a grid over two parameters, row by row from the lowest.

    Images are predicted if the light on surfaces was prepared, and rendered otherwise.

    Args:
        verifier: verifier that evaluates the points.
        size: number of points along each axis.
        varied: the parameters; the first changes along a row.
    """
    n_points = size * size
    hint = (
        f"{n_points} pictures of {verifier.run_state.spp} samples a pixel; `map` "
        "or `verify_spp` shorten it"
    )
    verifier.progress_stages.begin("map", "drawing the map", n_points, hint=hint)
    # coordinates of the points; a single point is at the center of the range
    grid = torch.linspace(0.0, 1.0, size) if size > 1 else torch.tensor([0.5])
    trials = verifier.try_in_batches(
        "map",
        n_points,
        partial(_find_grid_configuration, varied, grid),
        has_success=False,  # no prediction is sought
        predictor=verifier.run_state.predictor,
    )
    margins = [-trial.score for trial in trials]  # a score is a negative margin
    return [margins[begin : begin + size] for begin in range(0, len(margins), size)]


def _find_grid_configuration(
    varied: VariedParameters, grid: Tensor, number: int
) -> Tensor:
    """Return the configuration (d,) of a point of a square grid.

    Args:
        varied: the two parameters.
        grid: (n,) coordinates of the points along each axis.
        number: number of the point, counted row by row.
    """
    row, column = divmod(number, len(grid))
    return varied.make_configuration(torch.stack([grid[column], grid[row]]))


def find_ranges(
    problem: Problem, varied: VariedParameters, box: Sequence[BoxSide]
) -> list[AxisRange]:
    """Return the full range of each of two parameters, in its unit if it has one.

    Args:
        problem: problem of the scene.
        varied: the two parameters.
        box: the sides of the box, whose names and units are used.
    """
    low_values = problem.describe(varied.make_configuration(torch.full((2,), 0.0)))
    high_values = problem.describe(varied.make_configuration(torch.full((2,), 1.0)))
    ranges = []
    for side in box:
        # a fraction of the range, if no control describes the parameter
        low = 0.0
        high = 1.0
        if side.name in low_values:
            low = read_described_value(low_values[side.name])
            high = read_described_value(high_values[side.name])
        ranges.append(AxisRange(name=side.name, unit=side.unit, low=low, high=high))
    return ranges


def draw_margins(
    axes: Any, rows: list[list[float]], x_range: AxisRange, y_range: AxisRange
) -> None:
    """Draw margins and the line at which the verdict changes on matplotlib axes.

    Args:
        axes: axes of matplotlib.
        rows: margins on the grid, row by row from the lowest.
        x_range, y_range: ranges of both parameters.
    """
    extent = (x_range.low, x_range.high, y_range.low, y_range.high)
    x_title = figures.format_axis_title(x_range.name, x_range.unit)
    y_title = figures.format_axis_title(y_range.name, y_range.unit)
    figures.draw_heat_map(axes, rows, extent, figures.MARGIN, x_title, y_title)
    margins = [margin for row in rows for margin in row]
    # the model is right where the margin is above 0
    has_both_verdicts = min(margins) < 0.0 < max(margins)
    if has_both_verdicts:
        axes.contour(rows, levels=[0.0], extent=extent, colors="black", linewidths=1.0)


def draw_outline(axes: Any, x_side: BoxSide, y_side: BoxSide) -> None:
    """Draw the outline of the box and its center on matplotlib axes."""
    x_corners = [x_side.low, x_side.high, x_side.high, x_side.low, x_side.low]
    y_corners = [y_side.low, y_side.low, y_side.high, y_side.high, y_side.low]
    axes.plot(x_corners, y_corners, color="black", linestyle="--", label="region")
    axes.plot(x_side.centre, y_side.centre, "k+", label="centre")
    axes.legend(loc="upper right", frameon=True)
