"""`recipe`: run an experiment that a YAML file describes, and make its figures."""

from __future__ import annotations

import itertools
import json
import math
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from advsearch.extend import (
    AttackConfig,
    InputError,
    RunContext,
    RunDirectory,
    SceneConfig,
    Store,
    SweepConfig,
    errors,
    figures,
    read_result,
    results,
    wording,
    workbench,
)
from advsearch.questions.recipe import description, given, rates
from advsearch.questions.recipe.description import (
    PHOTOGRAPHS,
    PlannedRun,
    Recipe,
    format_first_error,
    plan_runs,
)
from advsearch.questions.recipe.rates import (
    TRIAL_COLUMN,
    TRIAL_NAMES,
    WORKERS_COLUMN,
    FigureContent,
    Options,
    Rows,
    make_frame,
    read_rows,
)
from advsearch.questions.recipe.result import (
    RecipeConfig,
    RecipeFigure,
    RecipePart,
    RecipeResult,
)

# degrees
FULL_TURN = 360.0
# name of the note in a run's store that holds the recipe, so that a resumed run has it
RECIPE_NOTE = "recipe"
# a run, and the result of its attack or sweep
DoneRun = tuple[PlannedRun, Any]

FIGURES: Mapping[str, tuple[type[Options], Any]] = {
    "rates": (rates.RatesOptions, rates.make_rates_figure),
    "answers": (given.PredictionsOptions, given.make_predictions_figure),
    "cues": (given.CuesOptions, given.make_cues_figure),
    "ternary": (given.TernaryOptions, given.make_ternary_figure),
    "agreement": (rates.AgreementOptions, rates.make_agreement_figure),
    "scaling": (Options, rates.make_scaling_figure),
    "surface": (Options, rates.make_surface_figure),
}
"""The options of each kind of figure, and the function that makes the figure."""

COMPARES_MODELS = ("agreement", "scaling", "surface")
"""Kinds of figures that show all models together. Of other kinds there is one figure
for each model.
"""

# options of figures that name columns
COLUMN_OPTIONS = ("by", "series", "texture", "shape", "shares")
# columns that every recipe has
COMMON_COLUMNS = (
    "object",
    "environment",
    rates.MODEL_COLUMN,
    rates.PREDICTION_COLUMN,
    rates.PART_COLUMN,
)
# in place of the parameters of a control that does not declare them
ANY_PARAMETER = "*"


def run_recipe(context: RunContext[RecipeConfig]) -> RecipeResult:
    """Run a recipe, except for the parts that are already finished.

    After an interrupt there are no figures.

    Args:
        context: settings, run directory and progress of the run.

    Raises:
        InputError: before anything is written, if the recipe or its settings are wrong.
    """
    _check_photograph_folder(context.config)
    recipe = _load_recipe(context)
    runs = _plan_checked_runs(recipe, context)
    _write_recipe_note(recipe, context)
    done, warnings = _run_parts(runs, context)
    if any(result.is_unfinished for _, result in done):
        context.ending = results.INTERRUPTED
    else:
        warnings += _compare_photographs(recipe, done, context)
    recipe_figures = list(_write_figures(recipe, done, context))
    for _, result in done:
        warnings += getattr(result, "warnings", ())
    return _make_result(recipe, done, recipe_figures, warnings, context)


def _write_recipe_note(recipe: Recipe, context: RunContext[RecipeConfig]) -> None:
    """Note the recipe in the run's store, from which a resumed run reads it."""
    # For a resumed run this writes the same note again.
    recipe_note = json.dumps(recipe.model_dump(mode="json"))
    context.run.store.write_note(RECIPE_NOTE, recipe_note)


def _check_photograph_folder(config: RecipeConfig) -> None:
    """Raise an error if the folder of photographs is set and does not exist."""
    if config.photographs is not None and not Path(config.photographs).is_dir():
        raise InputError(f"photographs: expected a folder, got {config.photographs}")


def _plan_checked_runs(
    recipe: Recipe, context: RunContext[RecipeConfig]
) -> list[PlannedRun]:
    """Plan the runs of a recipe, and check what they and its figures name."""
    config = context.config
    runs = plan_runs(recipe, config)
    description.check_powers(recipe, runs, config.recipe)
    is_new = _read_noted_recipe(context) is None
    if is_new:  # a resumed run was checked when it began
        check_recipe(recipe, config)
        check_figures(recipe, find_columns_of_parts(runs), config.recipe)
    return runs


def _compare_photographs(
    recipe: Recipe, done: Sequence[DoneRun], context: RunContext[RecipeConfig]
) -> list[str]:
    """Add the photographs of the settings, if any, to the finished runs.

    Returns:
        A sentence for each run without photographs.
    """
    folder = context.config.photographs
    if folder is None:
        return []
    photographed = _select_photographed(recipe, [run for run, _ in done])
    return _add_photographs(Path(folder), photographed, context.run)


def _read_noted_recipe(context: RunContext[RecipeConfig]) -> dict[str, Any] | None:
    """Read the recipe that a resumed run began with.

    None for a new run, and for a run that was stopped before it noted its recipe.
    """
    resumed = context.resumed_directory
    if resumed is None or not Store.is_in(resumed):
        return None
    with Store.open_to_read(resumed) as store:
        return store.read_json_note(RECIPE_NOTE) or None


def _load_recipe(context: RunContext[RecipeConfig]) -> Recipe:
    """Load the recipe: as a resumed run began with it, or by its name or file."""
    noted = _read_noted_recipe(context)
    if noted is None:
        return description.read_recipe(context.config.recipe)
    return description.parse_recipe(
        noted, f"{context.resumed_directory}: the recipe that it began with"
    )


def _make_result(
    recipe: Recipe,
    done: Sequence[DoneRun],
    recipe_figures: list[RecipeFigure],
    warnings: Sequence[str],
    context: RunContext[RecipeConfig],
) -> RecipeResult:
    """Make the result of a recipe.

    The total of its seconds includes those before the run was stopped and resumed.

    Args:
        recipe: the recipe.
        done: the runs with their results; only the last may be unfinished.
        recipe_figures: content of the figures.
        warnings: warnings of all runs.
        context: context of the recipe's run.
    """
    config = context.config
    names = _list_scene_names(recipe, config)
    controls = [name for run, _ in done for name in run.config.controls]
    result = context.result(
        RecipeResult,
        recipe=config.recipe,
        title=recipe.title,
        about=recipe.about,
        quick=config.quick,
        objects=names["object"],
        environment=",".join(names["environment"]),
        model=",".join(names["model"]),
        controls=list(dict.fromkeys(controls)),
        parts=[_make_recipe_part(run, run_result) for run, run_result in done],
        figures=recipe_figures,
        warnings=list(dict.fromkeys(warnings)),
    )
    _add_previous_seconds(result, context.resumed_directory)
    return result


def _make_recipe_part(run: PlannedRun, run_result: Any) -> RecipePart:
    """Make the entry of one run in the result of its recipe."""
    return RecipePart(
        name=run.name,
        part=run.part_name,
        command=run.config.command,
        object=run.config.object,
        ending=run_result.ending,
        renders=sum(run_result.renders.values()),
    )


def _add_previous_seconds(result: RecipeResult, resumed: Path | None) -> None:
    """Add the seconds of a run before it was stopped to the total of its result.

    Args:
        result: the result, whose total changes.
        resumed: directory of the run that is resumed; None for a new run.
    """
    # A run that was killed has no summary, and its seconds are unknown.
    if resumed is not None and (resumed / "summary.json").is_file():
        previous = read_result(resumed)
        previous_seconds = getattr(previous, "seconds", {"total": 0.0})
        result.seconds["total"] += previous_seconds["total"]


def _list_scene_names(recipe: Recipe, config: RecipeConfig) -> dict[str, list[str]]:
    """Return the names of the objects, environments and models of a recipe.

    The keys are the names of the settings: "object", "environment" and "model".
    """
    recipe_settings = description.apply_command_settings(recipe, config).settings
    defaults = {
        "object": "",
        "environment": SceneConfig.default_environment,
        "model": "reference",
    }
    return {
        setting: description.split_name_list(recipe_settings.get(setting) or default)
        for setting, default in defaults.items()
    }


def check_recipe(recipe: Recipe, config: RecipeConfig) -> None:
    """Check the photographs and figures of a recipe before anything is rendered.

    Args:
        recipe: the recipe.
        config: settings of the command.

    Raises:
        InputError: if something that the recipe describes cannot work.
    """
    if config.photographs is not None:
        _check_photograph_runs(recipe, config)
    for figure in recipe.figures:
        kind, _ = read_figure_options(figure, config.recipe)  # checks the options, too
        if kind == "cues" and config.task_name == wording.DETECTION:
            raise InputError(
                f"task: {config.recipe} asks whether predictions are classes of the "
                "texture or of the shape, and "
                "detection says whether the object is found; give it a classifier"
            )


def _check_photograph_runs(recipe: Recipe, config: RecipeConfig) -> None:
    """Check that the task of each run that photographs belong to can evaluate them.

    Raises:
        InputError: if it cannot, or there is no such run.
    """
    assert config.photographs is not None
    photographed = _select_photographed(recipe, plan_runs(recipe, config))
    if not photographed:
        raise InputError(
            f"photographs: {config.recipe} keeps no pictures to compare them with; "
            "recipe realism does"
        )
    photographs = workbench.load_photographs()
    for run in photographed:
        # The photographs of an object are in a directory of its name.
        directory = Path(config.photographs) / Path(run.config.object).stem
        # only a check: raises if the task cannot evaluate a photograph
        photographs.list_files(directory, run.config.task)


def find_columns_of_parts(runs: Sequence[PlannedRun]) -> dict[str, set[str]]:
    """Load everything that the runs name, and return the columns of each part.

    Without this check, a wrong name might be found only after hours of rendering. Runs
    whose settings differ only in seed and workers are loaded once.

    Returns:
        For each part the names of the columns that its rows have: parameters, and
        "workers" if it sets that.
    """
    columns_of_settings = dict[str, set[str]]()
    columns_of_part = defaultdict[str, set[str]](set)
    config_of_run = {run.name: run.config for run in runs}
    for run in runs:
        key = _format_distinct_settings(run)
        if key not in columns_of_settings:
            # the search around whose distribution this run samples
            search = config_of_run[run.search_run_name] if run.search_run_name else None
            columns_of_settings[key] = _check_run(run.config, search)
        columns_of_part[run.part_name] |= columns_of_settings[key]
        if getattr(run.config, WORKERS_COLUMN, None) is not None:
            columns_of_part[run.part_name].add(WORKERS_COLUMN)
    return columns_of_part


def _format_distinct_settings(run: PlannedRun) -> str:
    """Return a text that is equal for runs that differ only in seed and workers."""
    distinct_settings = {
        name: value
        for name, value in run.config.to_json().items()
        if name not in ("seed", WORKERS_COLUMN)
    }
    # A mapping has no hash, so its text is the key.
    return f"{distinct_settings} {run.search_run_name}"


def _check_run(config: SceneConfig, search: SceneConfig | None) -> set[str]:
    """Check a run by loading what it names, and return the columns of its rows.

    The parameters of a sweep are those that its scenes describe. A run that samples
    around the distribution that a search found cannot be loaded before the search: its
    columns are the parameters of the search's controls.

    Args:
        config: the settings of the run.
        search: settings of the search that the run samples around; None without one.
    """
    if search is not None:
        return _list_control_columns(search)
    if isinstance(config, SweepConfig):
        return workbench.row_parameters(config)
    assert isinstance(config, AttackConfig)  # there is no other command
    workbench.check_from_config(config)
    # Rows of an attack are its trials.
    return {TRIAL_COLUMN, *_list_control_columns(config)}


def _list_control_columns(config: SceneConfig) -> set[str]:
    """Return the columns of the parameters that controls of a run vary."""
    columns = set[str]()
    # `over` are the controls of an attack that vary at random.
    for name in (*config.controls, *getattr(config, "over", {})):
        columns |= {f"{name}.{parameter}" for parameter in _list_parameters(name)}
    return columns


def _list_parameters(control_name: str) -> list[str]:
    """Return the names of the parameters that a control declares.

    A control that declares no parameters has some of the scene's, which are not known
    here: the list is `ANY_PARAMETER`.
    """
    kind = control_name.partition(":")[0]
    parameters = []
    if kind in workbench.CONTROLS:
        declared = workbench.CONTROLS[kind].parameters
        parameters = [parameter.name for parameter in declared]
    return parameters or [ANY_PARAMETER]


def check_figures(
    recipe: Recipe, columns: Mapping[str, Collection[str]], where: str
) -> None:
    """Check that the parts and columns that figures name exist.

    Args:
        recipe: the recipe with the figures.
        columns: names of columns by part.
        where: the recipe's file or name, for messages.

    Raises:
        InputError: if a part or a column does not exist.
    """
    for index, described in enumerate(recipe.figures, start=1):
        kind, options = read_figure_options(described, where)
        location = f"It stands in {where}, figure {index} ({kind})"
        _check_figure(recipe, options, columns, location)


def _check_figure(
    recipe: Recipe,
    options: Options,
    columns: Mapping[str, Collection[str]],
    location: str,
) -> None:
    """Check that the parts and columns that the options of a figure name exist.

    Args:
        recipe: the recipe.
        options: options of the figure.
        columns: names of columns by part.
        location: location of the figure, for messages.
    """
    # The part that all others are compared with needs none of the columns.
    baseline = getattr(options, "beside", None)
    _check_option_parts(recipe, options, baseline, location)
    parts = options.of or tuple(columns)  # by default all parts
    columns_of_part = {
        part: columns[part] for part in columns if part in parts and part != baseline
    }
    if columns_of_part:  # otherwise it shows only the baseline or photographs
        _check_option_columns(recipe, options, columns_of_part, location)


def _check_option_columns(
    recipe: Recipe,
    options: Options,
    columns_of_part: Mapping[str, Collection[str]],
    location: str,
) -> None:
    """Check that the parts of a figure have all columns that its options name.

    Args:
        recipe: the recipe.
        options: options of the figure.
        columns_of_part: names of columns of each part of the figure.
        location: location of the figure, for messages.
    """
    common = _list_common_columns(recipe)
    for option in COLUMN_OPTIONS:
        value = getattr(options, option, None) or ()  # a name, or several
        names = [value] if isinstance(value, str) else value
        for name in names:
            _check_column(name, option, common, columns_of_part, location)


def _list_common_columns(recipe: Recipe) -> set[str]:
    """Return the names of the columns that all parts of a recipe have."""
    common = set(COMMON_COLUMNS)
    if recipe.groups:
        common.add(rates.GROUP_COLUMN)
    return common


def _check_option_parts(
    recipe: Recipe, options: Options, baseline: str | None, location: str
) -> None:
    """Raise an error if an option of a figure names a part that does not exist.

    Args:
        recipe: the recipe with its parts.
        options: options of the figure; `of` are the parts that it shows.
        baseline: the part that all others are compared with; None without one.
        location: location of the figure, for messages.
    """
    option_parts = [("of", part) for part in options.of]
    if baseline:
        option_parts.append(("beside", baseline))
    known_parts = [*recipe.parts, PHOTOGRAPHS]
    for option, part in option_parts:
        if part not in known_parts:
            raise errors.UnknownNameError(
                "part", part, known_parts, f"{location}, as `{option}`."
            )


def _check_column(
    name: str,
    option: str,
    common: Collection[str],
    columns_of_part: Mapping[str, Collection[str]],
    location: str,
) -> None:
    """Check that all parts of a figure have a column.

    Args:
        name: name of the column.
        option: option of the figure that names the column.
        common: names of the columns that all parts have.
        columns_of_part: names of columns of each part of the figure.
        location: location of the figure, for messages.

    Raises:
        InputError: if no part has it, or only some have.
    """
    if name in common:
        return
    lacking = _list_parts_without(name, columns_of_part)
    if len(lacking) == len(columns_of_part):
        # the columns that any part has, for the message
        known = set(common).union(*columns_of_part.values())
        raise _make_unknown_column_error(name, known, f"{location}, as `{option}`.")
    if lacking:
        raise InputError(
            f"{location}: {lacking[0]} has no {name}; name the "
            "parts that have it as `of`"
        )


def _make_unknown_column_error(
    name: str, known: Collection[str], location: str
) -> errors.UnknownNameError:
    """Make the error that no part has a column, with the columns that are known."""
    listed = {column for column in known if not column.endswith(ANY_PARAMETER)}
    return errors.UnknownNameError("column", name, listed, location)


def _list_parts_without(
    column: str, columns_of_part: Mapping[str, Collection[str]]
) -> list[str]:
    """Return the names of the parts that certainly lack a column."""
    # "mitsuba.*" stands for any parameter of the control "mitsuba".
    control_name = column.partition(".")[0]
    matching = {column, f"{control_name}.{ANY_PARAMETER}"}
    return [
        part
        for part, columns in columns_of_part.items()
        if matching.isdisjoint(columns)
    ]


def _select_photographed(
    recipe: Recipe, runs: Sequence[PlannedRun]
) -> list[PlannedRun]:
    """Select the runs that photographs are compared with.

    They are sweeps that store all images, since a photograph is aligned with the image
    of its configuration. Sweeps that repeat the configurations of another part
    (`drawn_as`) are left out.
    """
    selected = []
    for run in runs:
        repeats_another = recipe.parts[run.part_name].drawn_as is not None
        if repeats_another or not isinstance(run.config, SweepConfig):
            continue
        if run.config.keep_pictures == "all":
            selected.append(run)
    return selected


def _run_parts(
    runs: Sequence[PlannedRun], context: RunContext[RecipeConfig]
) -> tuple[list[DoneRun], list[str]]:
    """Run what is not finished, until a run is interrupted.

    A run may sample around the distribution that a search found. If the search found
    none, the run is left out.

    Args:
        runs: all runs, a search before the runs around it.
        context: context of the recipe's run.

    Returns:
        The runs with their results, of which the last is unfinished if it was
        interrupted; and a sentence for each run that was left out.
    """
    done = list[DoneRun]()
    left_out = list[str]()
    for number, run in enumerate(runs, start=1):
        _report_run(run, f"run {number} of {len(runs)}", context)
        search = _read_search(context, run.search_run_name)
        if search is not None and search.distribution is None:
            left_out.append(_describe_run_without_search(run, search.ending))
            continue
        result = context.run_part(run.name, _choose_config(run.config, search))
        done.append((run, result))
        if result.is_unfinished:
            break
    return done, left_out


def _report_run(
    run: PlannedRun, number: str, context: RunContext[RecipeConfig]
) -> None:
    """Report that a run begins: ``run 2 of 5: search, mug``; `number` comes first."""
    context.progress.message(f"{number}: {run.part_name}, {run.config.object}")


def _read_search(context: RunContext[RecipeConfig], name: str | None) -> Any:
    """Read the result of a search that is a run of the recipe; None without a name."""
    if name is None:
        return None
    return read_result(RunDirectory.locate_part(context.run.path, name))


def _choose_config(config: SceneConfig, search: Any) -> SceneConfig:
    """Return the settings of a run, around the distribution of its search, if any."""
    if search is None:
        return config
    search_ranges = search.configuration or {}
    return sample_around(config, search.distribution, search_ranges)


def _describe_run_without_search(run: PlannedRun, search_ending: str) -> str:
    """Describe that a run is left out, since its search found no distribution."""
    return (
        f"{run.config.object}: the search ended with {search_ending!r} and no "
        "distribution, so that the part "
        f"{run.part_name} is left out for it."
    )


def sample_around(
    config: SceneConfig, distribution: Any, search_ranges: Mapping[str, Any]
) -> SceneConfig:
    """Return settings that sample uniformly around the distribution a search found.

    The uniform distribution has the same mean and standard deviation s, so that it is
    sqrt(12) s wide. Its range is clipped to that of the search. The range of an angle
    that was searched over the full circle is not clipped, but spans at most one turn.

    Args:
        config: settings of the run that samples.
        distribution: mean of each parameter, and deviations as fractions of ranges.
        search_ranges: the parameters of the search by name, with their ranges.
    """
    controls: dict[str, dict[str, object]] = {}
    # Means are by parameter; deviations are in the same order.
    for (name, mean), deviation in zip(
        distribution.mean.items(), distribution.deviation, strict=True
    ):
        control, _, parameter_name = name.partition(".")
        parameter = _find_parameter(control, parameter_name)
        search_range = (search_ranges[name].low, search_ranges[name].high)
        sampled_range = _range_around(mean.value, deviation, search_range, parameter)
        controls.setdefault(control, {})[parameter_name] = sampled_range
    return config.model_copy(update={"controls": controls, "sampler": "random"})


def _find_parameter(control: str, name: str) -> Any:
    """Return a parameter that a control declares, by its name."""
    parameters = workbench.CONTROLS[control].parameters
    return next(parameter for parameter in parameters if parameter.name == name)


def _range_around(
    mean: float, deviation: float, search_range: tuple[float, float], parameter: Any
) -> list[float]:
    """Return the range of the uniform distribution with some mean and deviation.

    The range is clipped to that of the search. If the search went over a full turn of
    an angle, it is clipped to one turn instead. For a logarithmic parameter, the
    logarithm is uniform.

    Args:
        mean: mean of the distribution.
        deviation: standard deviation as a fraction of the search's range.
        search_range: bounds of the search.
        parameter: the parameter, which may be logarithmic or periodic.
    """
    to_scale = math.log if parameter.log else float
    lower, upper, center = (to_scale(value) for value in (*search_range, mean))
    # A uniform distribution of deviation s is 2 sqrt(3) s wide.
    half_width = math.sqrt(3.0) * deviation * (upper - lower)
    is_full_turn = parameter.periodic and upper - lower >= FULL_TURN
    if is_full_turn:  # an angle beyond the bounds is the same as one within them
        half_width = min(half_width, FULL_TURN / 2)
        lower = -math.inf  # not clipped
        upper = math.inf
    bounds = [max(center - half_width, lower), min(center + half_width, upper)]
    if parameter.log:
        return [math.exp(bound) for bound in bounds]
    return bounds


def _add_photographs(
    folder: Path, runs: Sequence[PlannedRun], run: RunDirectory
) -> list[str]:
    """Add photographs to the runs that they are compared with.

    Args:
        folder: folder with a directory of photographs for each object, of its name.
        runs: the runs to add them to.
        run: the run of the recipe.

    Returns:
        A sentence for each run without photographs.

    Raises:
        InputError: if no run has any.
    """
    photographs = workbench.load_photographs()
    missing = list[str]()
    for planned_run in runs:
        object_name = planned_run.config.object
        directory = folder / Path(object_name).stem
        files = photographs.list_files(directory, planned_run.config.task)
        photographs.add_files(
            RunDirectory.locate_part(run.path, planned_run.name), files
        )
        if not files:
            missing.append(f"{object_name}: {directory} has no photographs.")
    if len(missing) == len(runs):
        raise _make_no_photographs_error(folder, runs)
    return missing


def _make_no_photographs_error(folder: Path, runs: Sequence[PlannedRun]) -> InputError:
    """Make the error that no run has photographs, with the folders that may have some."""
    stems = [Path(planned_run.config.object).stem for planned_run in runs[:8]]
    return InputError(
        "photographs: expected some in a folder for each object "
        f"({', '.join(stems)}) in {folder}, got none"
    )


def _write_figures(
    recipe: Recipe, done: Sequence[DoneRun], context: RunContext[RecipeConfig]
) -> Iterator[RecipeFigure]:
    """Write the images of all figures of a recipe, and yield their content.

    There are no figures if the run was interrupted.

    Args:
        recipe: the recipe.
        done: the finished runs with their results.
        context: context of the recipe's run, whose directory gets the images.
    """
    if context.ending == results.INTERRUPTED:
        return
    rows = _read_frame(recipe, done, context.run)
    numbers = itertools.count(1)
    for kind, options in _read_all_figure_options(recipe, context.config.recipe):
        for figure in make_figures(rows, kind, options):
            _write_figure(figure, next(numbers), context.run)
            yield RecipeFigure.from_values({"figure": kind, **vars(figure)})


def _read_all_figure_options(recipe: Recipe, where: str) -> list[tuple[str, Options]]:
    """Return the kind and the options of each figure of a recipe.

    `where` is the recipe's file or name, for messages.
    """
    return [read_figure_options(described, where) for described in recipe.figures]


def _write_figure(figure: FigureContent, number: int, recipe_run: RunDirectory) -> None:
    """Write the images of one figure, in all formats, into the run of the recipe."""
    for suffix, data in draw_files(figure).items():
        recipe_run.write_file(f"images/figure-{number}.{suffix}", data)


def _read_frame(
    recipe: Recipe, done: Sequence[DoneRun], recipe_run: RunDirectory
) -> Rows:
    """Read the rows of all runs into one frame.

    The column "part" has the name of the run's part. Photographs that a sweep was
    compared with have rows, too, with the part `PHOTOGRAPHS`. Rows of a sweep with the
    setting `workers` have it as a column.

    Args:
        recipe: the recipe.
        done: the finished runs with their results.
        recipe_run: run directory of the recipe.
    """
    rows = list[dict[str, Any]]()
    units = dict[str, str]()
    for run, result in done:
        run_rows, run_units = _read_run_rows(run, result, recipe_run)
        rows += run_rows
        units |= run_units
    return make_frame(
        rows,
        recipe.groups,
        units=units,
        surfaces=_collect_surfaces(done),
        cores=workbench.count_cores(),
        folder=recipe_run.path,
    )


def _collect_surfaces(done: Sequence[DoneRun]) -> dict[str, Any]:
    """Return what sweeps found about the surface of their object, by name of the run.

    Sweeps without the setting `surface` are left out.
    """
    return {
        run.name: result.surface
        for run, result in done
        if isinstance(run.config, SweepConfig) and result.surface
    }


def _list_row_kinds(run: PlannedRun) -> dict[str, Sequence[str]]:
    """Return the kinds of a run's stored rows that count for each part."""
    if isinstance(run.config, SweepConfig):
        return {
            run.part_name: ("sweep",),
            PHOTOGRAPHS: workbench.load_photographs().row_kinds,
        }
    return {run.part_name: tuple(TRIAL_NAMES)}


def _read_run_rows(
    run: PlannedRun, result: Any, recipe_run: RunDirectory
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Read the rows of a run, each with its part, and the units of their columns.

    Args:
        run: the finished run.
        result: its result.
        recipe_run: run directory of the recipe.
    """
    rows = list[dict[str, Any]]()
    units = dict[str, str]()
    workers = getattr(run.config, WORKERS_COLUMN, None)
    more_columns = {} if workers is None else {WORKERS_COLUMN: workers}
    folder = RunDirectory.locate_part(recipe_run.path, run.name)
    seed = run.config.seed
    for part, kinds in _list_row_kinds(run).items():
        part_rows, part_units = read_rows(
            part, folder, summary=result, seed=seed, kinds=kinds, **more_columns
        )
        rows += part_rows
        units |= part_units
    return rows, units


def read_figure_options(
    figure_entry: Mapping[str, object], where: str
) -> tuple[str, Options]:
    """Return the kind of a figure and its options.

    Args:
        figure_entry: entry of the recipe: the kind as `figure`, and options by name.
        where: the recipe's file or name, for messages.

    Raises:
        InputError: if the kind or an option does not exist, or a value is wrong.
    """
    values = dict(figure_entry)
    kind = str(values.pop("figure", ""))
    if kind not in FIGURES:
        raise errors.UnknownNameError("figure", kind, FIGURES, f"It stands in {where}.")
    options_type, _ = FIGURES[kind]
    try:
        return kind, options_type(**values)
    except ValidationError as error:
        raise errors.FileFormatError(
            f"{where}: figures: {kind}: {format_first_error(error)}; see "
            "docs/recipes.md"
        ) from None


def make_figures(rows: Rows, kind: str, options: Options) -> Iterator[FigureContent]:
    """Yield a figure, or one for each model if the kind does not compare models.

    A figure shows the rows of the parts that its options require. If they require none,
    it shows all rows but photographs.

    Args:
        rows: rows of all runs.
        kind: kind of the figure, such as "rates".
        options: options of the figure.

    Raises:
        InputError: if the rows lack what the figure needs.
    """
    _, make_figure = FIGURES[kind]
    rows_of_model = _split_selected_rows(rows, kind, options)
    for model, model_rows in rows_of_model.items():
        figure = make_figure(model_rows, options)
        title = options.title or figure.title
        if len(rows_of_model) > 1:
            title = f"{title}: {model}"
        yield replace(figure, title=title)


def _split_selected_rows(rows: Rows, kind: str, options: Options) -> dict[str, Rows]:
    """Select the rows that the figures of an entry show, by the model of each figure.

    If one figure shows all models, its key is "".
    """
    part_of_row = rows[rates.PART_COLUMN]
    if options.required_parts:
        is_selected = part_of_row.isin(options.required_parts)
    else:
        is_selected = part_of_row != PHOTOGRAPHS
    selected = rows[is_selected]
    # An option such as `by` or `series` may name the column of the models.
    shows_models = rates.MODEL_COLUMN in vars(options).values()
    compares_models = kind in COMPARES_MODELS or shows_models
    if not compares_models and rates.MODEL_COLUMN in selected:
        return rates.split_rows(selected, rates.MODEL_COLUMN)
    return {"": selected}


def draw_files(figure_content: FigureContent) -> dict[str, bytes]:
    """Draw a figure, and return its files by suffix."""

    def draw(figure: Any) -> None:
        figure.suptitle(
            figure_content.title, x=0.01, ha="left", fontsize=10, fontweight="bold"
        )
        figure_content.draw(figure)

    return figures.render_figure(draw, figure_content.size)
