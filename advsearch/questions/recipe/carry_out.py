"""`recipe`: an experiment that a YAML file describes: runs of the commands there are, and figures of their answers."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch
from typing_extensions import Unpack

from advsearch.api.keywords import Named, Names, RunKeywords, asks, configured
from advsearch.api.studies import carry_out_part
from advsearch.config import AttackConfig, SweepConfig
from advsearch.config.scene import DEFAULT_ENVIRONMENT, SceneConfig, name_in
from advsearch.controls import CONTROLS
from advsearch.engine.attack_parts import check_from_config
from advsearch.errors import InputError
from advsearch.explanations import TRIAL, WORKERS, Answered, rows_of
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.photographs.carry_out import Photographs, photographs_in
from advsearch.questions.recipe.answer import RecipeFigure, RecipePart, RecipeResult
from advsearch.questions.recipe.description import (
    ANY,
    PlannedRun,
    Recipe,
    check_figures,
    check_powers,
    compute,
    draw_figure,
    made_of,
    names_listed,
    planned,
    read_options,
    read_recipe,
    recipe_of,
)
from advsearch.questions.recipe.settings import RecipeConfig
from advsearch.questions.recipe.table import Table, photographs_of
from advsearch.questions.sweep.carry_out import scenes_of
from advsearch.report.phrases import DETECTION
from advsearch.runs.directory import IMAGES, PARTS, RunDirectory
from advsearch.runs.files import write_bytes
from advsearch.runs.results.attack import AnswerDistribution, AttackSummary, DescribedValue, FoundValue
from advsearch.runs.results.base import INTERRUPTED
from advsearch.runs.results.sweep import SweepSummary
from advsearch.runs.store import NAME as STORE
from advsearch.runs.store import Store
from advsearch.runs.summary import NAME as SUMMARY
from advsearch.runs.summary import attack_of, read_result
from advsearch.threads import cores
from advsearch.viewer.pages import keep_answer


class RecipeKeywords(RunKeywords, total=False):
    quick: bool
    photographs: str | Path | None
    object: Path | Names | None
    environment: Path | Names | None
    up: Literal["y", "z"] | None
    resolution: int | str | tuple[int, int] | None
    model: Path | Names | None
    labels: Path | Names | None
    prompt: Names | None
    task: Named | None
    label: str | Mapping[str, str]
    seed: int
    threads: int | None
    deterministic: bool


TURN = 360.0

CUES = "cues"

NOTE = "recipe"
"""Under which a run's store keeps the recipe, so that it goes on as it began."""


@asks(RecipeConfig, RecipeKeywords)
def recipe(recipe: str | Path, *, progress: Watched = None, **settings: Unpack[RecipeKeywords]) -> RecipeResult:
    """Carry out a recipe: its runs, its figures, and what they say (docs/recipes.md).

    Args:
        recipe: the name of a bundled recipe, or a YAML file.
    """
    return recipe_from_config(configured(RecipeConfig, recipe=recipe, **settings), progress=watcher(progress))


def recipe_from_config(
    config: RecipeConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> RecipeResult:
    """Carry out the recipe that a configuration names; parts that are done are not done again.

    Raises:
        InputError: the recipe has a part or a figure that does not work; nothing is written where that is seen before.
    """
    begun = time.perf_counter()
    if config.photographs is not None and not Path(config.photographs).is_dir():
        raise InputError(f"photographs: expected a folder, got {config.photographs}")
    described = None if resumed is not None and _noted(resumed) else read_recipe(config.recipe)
    if described is not None:
        check_powers(described, config)
        _check(described, config)
        check_figures(described, _check_runs(planned(described, config)), config.recipe)
    with RunDirectory.of(config, resumed) as run:
        if described is None:
            described = recipe_of(run.store.noted(NOTE) or {}, f"{run.path}: the recipe that it began with")
            check_powers(described, config)
        run.store.set_note(NOTE, json.dumps(described.model_dump(mode="json")))
        notes: list[str] = []
        results = _carried_out(planned(described, config), run, progress or NullProgress(), notes)
        interrupted = any(one.goes_on for _, one in results)
        if config.photographs is not None and not interrupted:
            notes += _take(Path(config.photographs), _photographed(described, [one for one, _ in results]), run)
        figures = [] if interrupted else list(_figures(described, config, results, run))
        seconds = time.perf_counter() - begun + (_seconds(run.path) if resumed is not None else 0.0)
        settings = made_of(described, config).settings
        controls = [name for one, _ in results if isinstance(one.config, SceneConfig) for name in one.config.controls]
        notes += [
            f"{part.name} sweeps frames of drives, which are not independent: the intervals of figures take them as if "
            "they were, and are too narrow. What its own page, `explain` and `compare` say is over drives."
            for part, one in results
            if isinstance(one, SweepSummary) and one.drives
        ]
        warnings = [*notes, *(text for _, one in results for text in getattr(one, "warnings", ()))]
        result = RecipeResult(
            run=str(run.path),
            recipe=config.recipe,
            title=described.title,
            about=described.about,
            quick=config.quick,
            objects=names_listed(settings["object"]),
            environment=",".join(names_listed(settings.get("environment") or DEFAULT_ENVIRONMENT)),
            model=",".join(names_listed(settings.get("model") or "reference")),
            controls=list(dict.fromkeys(controls)),
            parts=[
                RecipePart(
                    name=one.name,
                    part=one.part,
                    command=one.config.command,
                    object=one.config.object,
                    ending=done.ending,
                    renders=sum(done.renders.values()),
                )
                for one, done in results
            ],
            figures=figures,
            ending=INTERRUPTED if interrupted else "done",
            warnings=list(dict.fromkeys(warnings)),
            seconds={"total": seconds},
            seed=config.seed,
            command_line=config.command_line(),
        )
        return keep_answer(run, result)


def _noted(path: Path) -> bool:
    """Whether a run has the recipe that it began with; one that was stopped at once has not."""
    if not (path / STORE).is_file():
        return False
    with Store(path / STORE, read_only=True) as store:
        return store.noted(NOTE) is not None


def _seconds(path: Path) -> float:
    """What a run that is gone on with took so far; a run that was killed has not noted it."""
    before = read_result(path) if (path / SUMMARY).is_file() else None
    return before.seconds["total"] if isinstance(before, RecipeResult) else 0.0


def _check(described: Recipe, config: RecipeConfig) -> None:
    """Read everything that a recipe says, so that what is wrong in it is told before anything is rendered."""
    if config.photographs is not None:
        wanted = _photographed(described, planned(described, config))
        if not wanted:
            raise InputError(
                f"photographs: {config.recipe} keeps no pictures to compare them with; recipe realism does"
            )
        for part in wanted:
            photographs_in(Path(config.photographs) / Path(part.config.object).stem, part.config.task)
    for one in described.figures:
        read_options(one, config.recipe)
        if one.get("figure") == CUES and config.task is not None and name_in(config.task) == DETECTION:
            raise InputError(
                f"task: {config.recipe} asks whether answers are classes of the texture or of the shape, and detection "
                "answers whether the object is found; give it a classifier"
            )


def _check_runs(runs: Sequence[PlannedRun]) -> dict[str, set[str]]:
    """Load everything that the runs name, as a wrong name or label would end hours of rendering; for each part the
    parameters that its rows will have."""
    known: dict[str, set[str]] = {}
    columns: dict[str, set[str]] = {}
    searches = {one.name: one.config for one in runs}
    for one in runs:
        plain = {name: value for name, value in one.config.plain().items() if name not in ("seed", WORKERS)}
        same = f"{plain} {one.around}"
        if same not in known:
            known[same] = _check_run(one.config, searches[one.around] if one.around else None)
        counted = {WORKERS} if getattr(one.config, WORKERS, None) is not None else set()
        columns[one.part] = columns.get(one.part, set()) | known[same] | counted
    return columns


def _check_run(config: SceneConfig, search: SceneConfig | None) -> set[str]:
    """Load what a run names, and return the parameters of its rows; those of `search` where it draws around one."""
    if search is not None:
        return _declared_columns(search, trials=False)
    if isinstance(config, AttackConfig):
        check_from_config(config)
    if not isinstance(config, SweepConfig):
        return _declared_columns(config, trials=True)
    job = scenes_of(config).job
    space = job.space(job.places[0], job.sizes[0])
    halfway = torch.full_like(space.start, 0.5)
    return {name for u in (space.start, halfway) for name in space.describe(u)}


def _declared_columns(config: SceneConfig, *, trials: bool) -> set[str]:
    """Return what the rows of a run may have, by what its controls declare; `trials` where they are an attack's."""
    names = [*config.controls, *getattr(config, "over", {})]
    found = {TRIAL} if trials else set[str]()
    for name in names:
        declared = CONTROLS[kind].parameters if (kind := name.partition(":")[0]) in CONTROLS else ()
        found |= {f"{name}.{one.name}" for one in declared} or {f"{name}.{ANY}"}
    return found


def _photographed(described: Recipe, runs: Iterable[PlannedRun]) -> list[PlannedRun]:
    """The runs that photographs are compared with: they keep all pictures, with which those can be aligned."""
    own = [one for one in runs if described.parts[one.part].drawn_as is None]
    return [one for one in own if isinstance(one.config, SweepConfig) and one.config.keep_pictures == "all"]


DoneRun = tuple[PlannedRun, AttackSummary | SweepSummary]


def _carried_out(runs: Sequence[PlannedRun], run: RunDirectory, progress: Progress, notes: list[str]) -> list[DoneRun]:
    """Carry out the runs that are not done, until one is interrupted; return all that there are. `notes` gets a
    sentence for each run that cannot be carried out after another one's answer."""
    results: list[DoneRun] = []
    for number, one in enumerate(runs):
        path = run.path / PARTS / one.name
        progress.message(f"run {number + 1} of {len(runs)}: {one.part}, {one.config.object}")
        own = one.config
        if one.around is not None:
            search = attack_of(run.path / PARTS / one.around)
            if search.distribution is None:
                notes.append(
                    f"{one.config.object}: the search ended with {search.ending!r} and no distribution, so that "
                    f"the part {one.part} is left out for it."
                )
                continue
            own = _around(own, search.distribution, search.configuration or {})
        done = carry_out_part(path, own, progress)
        assert isinstance(done, (AttackSummary, SweepSummary))
        results.append((one, done))
        if done.goes_on:
            break
    return results


def _around(config: SceneConfig, found: AnswerDistribution, searched: Mapping[str, FoundValue]) -> SceneConfig:
    """Draw evenly from the distribution that a search answers with, over the ranges that it searched: mean and
    deviation are the same.

    An even distribution of deviation s is sqrt(12) s wide. The ranges end where the search's did; angles that go all
    the way round may pass that end, and take the whole turn at most.
    """
    controls: dict[str, dict[str, object]] = {}
    for (name, mean), deviation in zip(found.mean.items(), found.deviation, strict=True):
        control, _, parameter = name.partition(".")
        controls.setdefault(control, {})[parameter] = _range(name, mean, searched[name], deviation)
    return config.model_copy(update={"controls": controls, "sampler": "random"})


def _range(name: str, mean: DescribedValue, searched: FoundValue, deviation: float) -> list[float]:
    control, _, parameter = name.partition(".")
    declared = next(one for one in CONTROLS[control].parameters if one.name == parameter)
    low, high, at = (float(value) for value in (searched.low, searched.high, mean.value))  # type: ignore[arg-type]
    if declared.log:
        low, high, at = (math.log(value) for value in (low, high, at))
    wide = math.sqrt(3.0) * deviation * (high - low)
    if declared.periodic and high - low >= TURN:
        ends = [at - min(wide, TURN / 2), at + min(wide, TURN / 2)]
    else:
        ends = [max(at - wide, low), min(at + wide, high)]
    return [math.exp(end) for end in ends] if declared.log else ends


def _take(folder: Path, wanted: Sequence[PlannedRun], run: RunDirectory) -> Iterable[str]:
    """Take the photographs in a folder into the runs that are compared with some; return what is missing. An InputError
    where there are none at all, or one cannot be read."""
    photographs, missing = Photographs(), list[str]()
    for one in wanted:
        inside = folder / Path(one.config.object).stem
        photographs.add_files(run.path / PARTS / one.name, files := photographs_in(inside, one.config.task))
        missing += [] if files else [f"{one.config.object}: {inside} has no photographs."]
    if len(missing) == len(wanted):
        names = ", ".join(Path(one.config.object).stem for one in wanted[:8])
        raise InputError(f"photographs: expected some in a folder for each object ({names}) in {folder}, got none")
    return missing


def _figures(
    described: Recipe, config: RecipeConfig, results: Sequence[DoneRun], run: RunDirectory
) -> Iterable[RecipeFigure]:
    rows: list[Answered] = []
    for one, result in results:
        found = rows_of(one.part, run.path / PARTS / one.name, result)
        count = getattr(one.config, WORKERS, None)
        rows += found if count is None else [replace(row, values={**row.values, WORKERS: count}) for row in found]
        if isinstance(result, SweepSummary):
            rows += photographs_of(run.path / PARTS / one.name, result)
    surfaces = {
        one.name: result.surface for one, result in results if isinstance(result, SweepSummary) and result.surface
    }
    table = Table(rows, described.groups, surfaces, cores())
    figures = (made for one in described.figures for made in compute(table, *read_options(one, config.recipe)))
    for number, made in enumerate(figures):
        for suffix, data in draw_figure(made, run.path).items():
            write_bytes(run.path / IMAGES / f"figure-{number + 1}.{suffix}", data)
        yield made
