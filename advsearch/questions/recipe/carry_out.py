"""`recipe`: an experiment that a YAML file describes: runs of the commands there are,
and figures of their results.
"""

from __future__ import annotations

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
    first_of,
    planned,
)
from advsearch.questions.recipe.rates import (
    TRIAL,
    TRIALS,
    WORKERS,
    MadeFigure,
    Options,
    Rows,
    frame_of,
    read_rows,
)
from advsearch.questions.recipe.result import (
    RecipeConfig,
    RecipeFigure,
    RecipePart,
    RecipeResult,
)

TURN = 360.0
# under which a run's store keeps the recipe, so that it goes on as it began
NOTE = "recipe"
DoneRun = tuple[PlannedRun, Any]  # with the result of an attack or of a sweep

FIGURES: Mapping[str, tuple[type[Options], Any]] = {
    "rates": (rates.RatesOptions, rates.rates),
    "answers": (given.PredictionsOptions, given.predictions),
    "cues": (given.CuesOptions, given.cues),
    "ternary": (given.TernaryOptions, given.ternary),
    "agreement": (rates.AgreementOptions, rates.agreement),
    "scaling": (Options, rates.scaling),
    "surface": (Options, rates.surface),
}
"""The options that each kind takes, and what makes it of the rows."""

TOGETHER = ("agreement", "scaling", "surface")
"""Kinds that tell several models apart by themselves; of the others each model has
one.
"""

# options of figures that name columns
NAMING = ("by", "series", "texture", "shape", "shares")
# columns of every recipe
OUTER = ("object", "environment", rates.MODEL, rates.PREDICTION, rates.PART)
# stands for the parameters of a control that does not say beforehand which it has
ANY = "*"


def carried_out(asked: RunContext[RecipeConfig]) -> RecipeResult:
    """Carry out a recipe, but for what is done; what is seen not to work is refused
    before anything is written.
    """
    config = asked.config
    resumed = asked.resumed
    noted = None
    if config.photographs is not None and not Path(config.photographs).is_dir():
        raise InputError(f"photographs: expected a folder, got {config.photographs}")
    # a run that was stopped at once has noted no recipe
    if resumed is not None and Store.is_in(resumed):
        with Store.open_to_read(resumed) as store:
            noted = store.noted(NOTE)
    where = f"{resumed}: the recipe that it began with"
    recipe = (
        description.recipe_of(noted, where)
        if noted
        else description.read_recipe(config.recipe)
    )
    runs = planned(recipe, config)
    description.check_powers(recipe, runs, config.recipe)
    if not noted:
        check_described(recipe, config)
        check_figures(recipe, check_runs(runs), config.recipe)
    asked.run.store.set_note(NOTE, json.dumps(recipe.model_dump(mode="json")))
    done, warnings = _carried_out(runs, asked)
    if any(result.goes_on for _, result in done):
        asked.ending = results.INTERRUPTED
    elif config.photographs is not None:
        warnings += _take(
            Path(config.photographs),
            _photographed(recipe, [run for run, _ in done]),
            asked.run,
        )
    settings = description.made_of(recipe, config).settings
    usual = {
        "object": "",
        "environment": SceneConfig.default_environment,
        "model": "reference",
    }
    listed = {
        name: description.names_listed(settings.get(name) or other)
        for name, other in usual.items()
    }
    warnings += [text for _, result in done for text in getattr(result, "warnings", ())]
    result = asked.result(
        RecipeResult, recipe=config.recipe, title=recipe.title, about=recipe.about, quick=config.quick,
        objects=listed["object"], environment=",".join(listed["environment"]), model=",".join(listed["model"]),
        controls=list(dict.fromkeys(name for run, _ in done for name in run.config.controls)),
        parts=[
            RecipePart(name=run.name, part=run.part, command=run.config.command, object=run.config.object,
                       ending=result.ending, renders=sum(result.renders.values()))
            for run, result in done
        ],
        figures=[] if asked.ending == results.INTERRUPTED else list(_figures(recipe, config, done, asked.run)),
        warnings=list(dict.fromkeys(warnings)),
    )  # fmt: skip
    # a run that was killed has not noted any seconds
    if resumed is not None and (resumed / "summary.json").is_file():
        result.seconds["total"] += getattr(
            read_result(resumed), "seconds", {"total": 0.0}
        )["total"]
    return result


def check_described(recipe: Recipe, config: RecipeConfig) -> None:
    """Read everything that a recipe says, so that an InputError tells what is wrong
    before anything is rendered.
    """
    if config.photographs is not None:
        if not (wanted := _photographed(recipe, planned(recipe, config))):
            raise InputError(
                f"photographs: {config.recipe} keeps no pictures to compare them with; "
                "recipe realism does"
            )
        photographs = workbench.load_photographs()
        for run in wanted:
            photographs.list_files(
                Path(config.photographs) / Path(run.config.object).stem, run.config.task
            )
    for figure in recipe.figures:
        kind, _ = read_options(figure, config.recipe)
        if kind == "cues" and config.task_name == wording.DETECTION:
            raise InputError(
                f"task: {config.recipe} asks whether predictions are classes of the "
                "texture or of the shape, and "
                "detection says whether the object is found; give it a classifier"
            )


def check_runs(runs: Sequence[PlannedRun]) -> dict[str, set[str]]:
    """Load all that the runs name, as a wrong name would end hours of rendering; return
    each part's parameters.
    """
    known = dict[str, set[str]]()
    columns = defaultdict[str, set[str]](set)
    searches = {run.name: run.config for run in runs}
    for run in runs:
        plain = {
            name: value
            for name, value in run.config.plain().items()
            if name not in ("seed", WORKERS)
        }
        same = f"{plain} {run.around}"
        if same not in known:
            known[same] = _check_run(
                run.config, searches[run.around] if run.around else None
            )
        columns[run.part] |= known[same]
        if getattr(run.config, WORKERS, None) is not None:
            columns[run.part].add(WORKERS)
    return columns


def _check_run(config: SceneConfig, search: SceneConfig | None) -> set[str]:
    """Load what a run names, and return the parameters of its rows; those of `search`
    where it draws around one.
    """
    if search is None and isinstance(config, SweepConfig):
        return workbench.row_parameters(config)
    names = set[str]()
    if search is None:
        names.add(TRIAL)  # rows of an attack are its trials
        assert isinstance(config, AttackConfig)
        workbench.check_from_config(config)
    source = search or config
    for name in (*source.controls, *getattr(source, "over", {})):
        kind = name.partition(":")[0]
        declared = (
            workbench.CONTROLS[kind].parameters if kind in workbench.CONTROLS else ()
        )
        names |= {f"{name}.{parameter.name}" for parameter in declared} or {
            f"{name}.{ANY}"
        }
    return names


def check_figures(
    recipe: Recipe, columns: Mapping[str, Collection[str]], where: str
) -> None:
    """Refuse, by an InputError, a figure of a part or a column that there is not;
    `columns` are those of each part.
    """
    known = {*OUTER, *([rates.GROUP] if recipe.groups else [])}
    for number, described in enumerate(recipe.figures, start=1):
        kind, options = read_options(described, where)
        place = f"It stands in {where}, figure {number} ({kind})"
        beside = getattr(options, "beside", None)
        for option, part in [
            *(("of", part) for part in options.of),
            *([("beside", beside)] if beside else []),
        ]:
            if part not in (*recipe.parts, PHOTOGRAPHS):
                raise errors.UnknownNameError(
                    "part",
                    part,
                    [*recipe.parts, PHOTOGRAPHS],
                    f"{place}, as `{option}`.",
                )
        shown = {
            part: has
            for part, has in columns.items()
            if part != beside and part in (options.of or columns)
        }
        for option in NAMING if shown else ():
            value = getattr(options, option, None) or ()
            for column in [value] if isinstance(value, str) else value:
                names = {column, f"{column.partition('.')[0]}.{ANY}"}
                lacking = [
                    part
                    for part, has in shown.items()
                    if column not in known and not names & {*has}
                ]
                if len(lacking) == len(shown):
                    others = {
                        name
                        for has in shown.values()
                        for name in has
                        if not name.endswith(ANY)
                    }
                    raise errors.UnknownNameError(
                        "column", column, known | others, f"{place}, as `{option}`."
                    )
                if lacking:
                    raise InputError(
                        f"{place}: {lacking[0]} has no {column}; name the "
                        "parts that have it as `of`"
                    )


def _photographed(recipe: Recipe, runs: Sequence[PlannedRun]) -> list[PlannedRun]:
    """The runs that photographs are compared with: they keep all pictures, with which
    those can be aligned.
    """
    drawn_anew = [run for run in runs if recipe.parts[run.part].drawn_as is None]
    return [
        run
        for run in drawn_anew
        if isinstance(run.config, SweepConfig) and run.config.keep_pictures == "all"
    ]


def _carried_out(
    runs: Sequence[PlannedRun], asked: RunContext[RecipeConfig]
) -> tuple[list[DoneRun], list[str]]:
    """Carry out what is not done, until a run is interrupted; return the runs, and a
    sentence for each left out.
    """
    done = list[DoneRun]()
    left_out = list[str]()
    for number, run in enumerate(runs, start=1):
        config = run.config
        asked.progress.message(
            f"run {number} of {len(runs)}: {run.part}, {config.object}"
        )
        if run.around is not None:
            search: Any = read_result(
                RunDirectory.locate_part(asked.run.path, run.around)
            )
            if search.distribution is None:
                left_out.append(
                    f"{config.object}: the search ended with {search.ending!r} and no "
                    "distribution, so that the part "
                    f"{run.part} is left out for it."
                )
                continue
            config = around(config, search.distribution, search.configuration or {})
        result = asked.run_part(run.name, config)
        done.append((run, result))
        if result.goes_on:
            break
    return done, left_out


def around(
    config: SceneConfig, distribution: Any, searched: Mapping[str, Any]
) -> SceneConfig:
    """Draw evenly from the distribution that a search found, over the ranges that it
    searched: mean and deviation are the same. An even distribution of deviation s is
    sqrt(12) s wide. The ranges end where the search's did; angles that go all the way
    round may pass that end, and take the whole turn at most.
    """
    controls: dict[str, dict[str, object]] = {}
    for (name, mean), deviation in zip(
        distribution.mean.items(), distribution.deviation, strict=True
    ):
        control, _, parameter = name.partition(".")
        declared = next(
            known
            for known in workbench.CONTROLS[control].parameters
            if known.name == parameter
        )
        ends = searched[name].low, searched[name].high, mean.value
        low, high, at = (
            math.log(value) if declared.log else float(value) for value in ends
        )
        wide = math.sqrt(3.0) * deviation * (high - low)
        if declared.periodic and high - low >= TURN:
            drawn = [at - min(wide, TURN / 2), at + min(wide, TURN / 2)]
        else:
            drawn = [max(at - wide, low), min(at + wide, high)]
        controls.setdefault(control, {})[parameter] = (
            [math.exp(end) for end in drawn] if declared.log else drawn
        )
    return config.model_copy(update={"controls": controls, "sampler": "random"})


def _take(folder: Path, wanted: Sequence[PlannedRun], run: RunDirectory) -> list[str]:
    """Take the photographs in a folder into the runs that are compared with some;
    return what is missing.
    """
    photographs = workbench.load_photographs()
    missing = list[str]()
    for each in wanted:
        inside = folder / Path(each.config.object).stem
        files = photographs.list_files(inside, each.config.task)
        photographs.add_files(RunDirectory.locate_part(run.path, each.name), files)
        missing += (
            [] if files else [f"{each.config.object}: {inside} has no photographs."]
        )
    if len(missing) == len(wanted):
        names = ", ".join(Path(each.config.object).stem for each in wanted[:8])
        raise InputError(
            "photographs: expected some in a folder for each object "
            f"({names}) in {folder}, got none"
        )
    return missing


def _figures(
    recipe: Recipe, config: RecipeConfig, done: Sequence[DoneRun], kept: RunDirectory
) -> Iterator[RecipeFigure]:
    rows = list[dict[str, Any]]()
    units = dict[str, str]()
    surfaces = dict[str, Any]()
    for run, result in done:
        kinds: dict[str, Sequence[str]] = {run.part: tuple(TRIALS)}
        if isinstance(run.config, SweepConfig):
            kinds = {
                run.part: ("sweep",),
                PHOTOGRAPHS: workbench.load_photographs().row_kinds,
            }
            surfaces |= {run.name: result.surface} if result.surface else {}
        workers = getattr(run.config, WORKERS, None)
        more = {} if workers is None else {WORKERS: workers}
        for part, names in kinds.items():
            folder = RunDirectory.locate_part(kept.path, run.name)
            stored, of_them = read_rows(
                part, folder, result, run.config.seed, names, **more
            )
            rows = rows + stored
            units = units | of_them
    table = frame_of(
        rows,
        recipe.groups,
        units=units,
        surfaces=surfaces,
        cores=workbench.cores(),
        folder=kept.path,
    )
    wanted = [read_options(described, config.recipe) for described in recipe.figures]
    every = (
        (kind, made) for kind, options in wanted for made in make(table, kind, options)
    )
    for number, (kind, made) in enumerate(every, start=1):
        for suffix, data in files_of(made).items():
            kept.write_file(f"images/figure-{number}.{suffix}", data)
        yield RecipeFigure.of({"figure": kind, **vars(made)})


def read_options(described: Mapping[str, object], where: str) -> tuple[str, Options]:
    """Return the kind of a figure and its options; refuse a kind that there is not, or
    such an option.
    """
    kind = str(described.get("figure", ""))
    if kind not in FIGURES:
        raise errors.UnknownNameError("figure", kind, FIGURES, f"It stands in {where}.")
    try:
        return kind, FIGURES[kind][0](
            **{name: value for name, value in described.items() if name != "figure"}
        )
    except ValidationError as error:
        raise errors.FileFormatError(
            f"{where}: figures: {kind}: {first_of(error)}; see docs/recipes.md"
        ) from None


def make(rows: Rows, kind: str, options: Options) -> Iterator[MadeFigure]:
    """Yield a figure, or one for each model; an InputError where it needs what the
    predictions do not have.
    """
    parts = rows[rates.PART]
    made = FIGURES[kind][1]
    shown = rows[parts.isin(options.parts) if options.parts else parts != PHOTOGRAPHS]
    together = (
        kind in TOGETHER
        or rates.MODEL in vars(options).values()
        or rates.MODEL not in shown
    )
    models = {"": shown} if together else rates.by(shown, rates.MODEL)
    for name, some in models.items():
        figure = made(some, options)
        title = options.title or figure.title
        yield replace(figure, title=title if len(models) == 1 else f"{title}: {name}")


def files_of(made: MadeFigure) -> dict[str, bytes]:

    def draw(figure: Any) -> None:
        figure.suptitle(made.title, x=0.01, ha="left", fontsize=10, fontweight="bold")
        made.draw(figure)

    return figures.drawn(draw, made.size)
