"""`recipe`: an experiment that a YAML file describes: runs of the commands there are, and figures of their answers."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from advsearch.api.keywords import asks, configured
from advsearch.config import DEFAULT_ENVIRONMENT, SceneConfig, name_in
from advsearch.controls import CONTROLS
from advsearch.errors import InputError
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.attack.parts import check_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.studies import carry_out_part
from advsearch.questions.attack.summary import AnswerDistribution, AttackSummary, FoundValue, attack_of
from advsearch.questions.photographs.answer import LOOSE_PHOTO, PHOTO
from advsearch.questions.photographs.carry_out import Photographs, photographs_in
from advsearch.questions.recipe.answer import PHOTOGRAPHS, RecipeFigure, RecipePart, RecipeResult
from advsearch.questions.recipe.description import (
    PlannedRun,
    Recipe,
    check_powers,
    made_of,
    names_listed,
    planned,
    read_recipe,
    recipe_of,
)  # fmt: skip
from advsearch.questions.recipe.figures import ANY, check_figures, files_of, make, read_options
from advsearch.questions.recipe.settings import RecipeConfig
from advsearch.questions.recipe.table import TRIAL, TRIALS, WORKERS, Table, read_rows
from advsearch.questions.sweep.carry_out import scenes_of
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.report.wording import DETECTION
from advsearch.runs.directory import IMAGES, PARTS, RunDirectory
from advsearch.runs.files import write_bytes
from advsearch.runs.results import INTERRUPTED
from advsearch.runs.store import NAME as STORE
from advsearch.runs.store import Store
from advsearch.runs.summary import NAME as SUMMARY
from advsearch.runs.summary import read_result
from advsearch.threads import cores
from advsearch.viewer.pages import keep_answer

TURN = 360.0

NOTE = "recipe"
"""Under which a run's store keeps the recipe, so that it goes on as it began."""


@asks(RecipeConfig)
def recipe(recipe: str | Path, *, progress: Watched = None, **settings: Any) -> RecipeResult:
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
    noted = None  # a run that was stopped at once has noted no recipe
    if resumed is not None and (resumed / STORE).is_file():
        with Store(resumed / STORE, read_only=True) as store:
            noted = store.noted(NOTE)
    described = recipe_of(noted, f"{resumed}: the recipe that it began with") if noted else read_recipe(config.recipe)
    check_powers(described, config)
    if not noted:
        check_described(described, config)
        check_figures(described, check_runs(planned(described, config)), config.recipe)
    with RunDirectory.of(config, resumed) as run:
        run.store.set_note(NOTE, json.dumps(described.model_dump(mode="json")))
        done, warnings = _carried_out(planned(described, config), run, progress or NullProgress())
        interrupted = any(result.goes_on for _, result in done)
        if config.photographs is not None and not interrupted:
            wanted = _photographed(described, [each for each, _ in done])
            warnings += _take(Path(config.photographs), wanted, run)
        figures = [] if interrupted else list(_figures(described, config, done, run))
        seconds = time.perf_counter() - begun
        if resumed is not None and (run.path / SUMMARY).is_file():  # a run that was killed has not noted any
            seconds += getattr(read_result(run.path), "seconds", {"total": 0.0})["total"]
        settings = made_of(described, config).settings
        controls = [name for each, _ in done for name in each.config.controls]
        warnings += [text for _, result in done for text in getattr(result, "warnings", ())]
        parts = [
            RecipePart(
                name=each.name,
                part=each.part,
                command=each.config.command,
                object=each.config.object,
                ending=result.ending,
                renders=sum(result.renders.values()),
            )
            for each, result in done
        ]
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
            parts=parts,
            figures=figures,
            ending=INTERRUPTED if interrupted else "done",
            warnings=list(dict.fromkeys(warnings)),
            seconds={"total": seconds},
            seed=config.seed,
            command_line=config.command_line(),
        )
        return keep_answer(run, result)


def check_described(described: Recipe, config: RecipeConfig) -> None:
    """Read everything that a recipe says, so that an InputError tells what is wrong before anything is rendered."""
    if config.photographs is not None:
        wanted = _photographed(described, planned(described, config))
        if not wanted:
            raise InputError(
                f"photographs: {config.recipe} keeps no pictures to compare them with; recipe realism does"
            )
        for part in wanted:
            photographs_in(Path(config.photographs) / Path(part.config.object).stem, part.config.task)
    for figure in described.figures:
        kind, _ = read_options(figure, config.recipe)
        if kind == "cues" and config.task is not None and name_in(config.task) == DETECTION:
            raise InputError(
                f"task: {config.recipe} asks whether answers are classes of the texture or of the shape, and detection "
                "answers whether the object is found; give it a classifier"
            )


def check_runs(runs: Sequence[PlannedRun]) -> dict[str, set[str]]:
    """Load everything that the runs name, as a wrong name or label would end hours of rendering; for each part the
    parameters that its rows will have."""
    known: dict[str, set[str]] = {}
    columns: dict[str, set[str]] = {}
    searches = {each.name: each.config for each in runs}
    for each in runs:
        plain = {name: value for name, value in each.config.plain().items() if name not in ("seed", WORKERS)}
        same = f"{plain} {each.around}"
        if same not in known:
            known[same] = _check_run(each.config, searches[each.around] if each.around else None)
        counted = {WORKERS} if getattr(each.config, WORKERS, None) is not None else set()
        columns[each.part] = columns.get(each.part, set()) | known[same] | counted
    return columns


def _check_run(config: SceneConfig, search: SceneConfig | None) -> set[str]:
    """Load what a run names, and return the parameters of its rows; those of `search` where it draws around one."""
    if search is None and isinstance(config, SweepConfig):
        job = scenes_of(config).job
        space = job.space(job.places[0], job.sizes[0])
        halfway = torch.full_like(space.start, 0.5)
        return {name for u in (space.start, halfway) for name in space.describe(u)}
    if search is None and isinstance(config, AttackConfig):
        check_from_config(config)
    found = {TRIAL} if search is None else set[str]()  # rows of an attack are its trials
    source = search or config
    for name in (*source.controls, *getattr(source, "over", {})):
        declared = CONTROLS[kind].parameters if (kind := name.partition(":")[0]) in CONTROLS else ()
        found |= {f"{name}.{parameter.name}" for parameter in declared} or {f"{name}.{ANY}"}
    return found


def _photographed(described: Recipe, runs: Sequence[PlannedRun]) -> list[PlannedRun]:
    """The runs that photographs are compared with: they keep all pictures, with which those can be aligned."""
    drawn_anew = [each for each in runs if described.parts[each.part].drawn_as is None]
    return [each for each in drawn_anew if isinstance(each.config, SweepConfig) and each.config.keep_pictures == "all"]


DoneRun = tuple[PlannedRun, AttackSummary | SweepSummary]


def _carried_out(runs: Sequence[PlannedRun], run: RunDirectory, progress: Progress) -> tuple[list[DoneRun], list[str]]:
    """Carry out the runs that are not done, until one is interrupted; return all that there are, and a sentence for
    each that cannot be carried out after another one's answer."""
    done, left_out = list[DoneRun](), list[str]()
    for number, each in enumerate(runs):
        config = each.config
        progress.message(f"run {number + 1} of {len(runs)}: {each.part}, {config.object}")
        if each.around is not None:
            search = attack_of(run.path / PARTS / each.around)
            if search.distribution is None:
                left_out.append(
                    f"{config.object}: the search ended with {search.ending!r} and no distribution, so that the part "
                    f"{each.part} is left out for it."
                )
                continue
            config = around(config, search.distribution, search.configuration or {})
        result = carry_out_part(run.path / PARTS / each.name, config, progress)
        assert isinstance(result, (AttackSummary, SweepSummary))
        done.append((each, result))
        if result.goes_on:
            break
    return done, left_out


def around(config: SceneConfig, answer: AnswerDistribution, searched: Mapping[str, FoundValue]) -> SceneConfig:
    """Draw evenly from the distribution that a search answers with, over the ranges that it searched: mean and
    deviation are the same.

    An even distribution of deviation s is sqrt(12) s wide. The ranges end where the search's did; angles that go all
    the way round may pass that end, and take the whole turn at most.
    """
    controls: dict[str, dict[str, object]] = {}
    for (name, mean), deviation in zip(answer.mean.items(), answer.deviation, strict=True):
        control, _, parameter = name.partition(".")
        declared = next(one for one in CONTROLS[control].parameters if one.name == parameter)
        ends = searched[name].low, searched[name].high, mean.value
        low, high, at = (float(value) for value in ends)  # type: ignore[arg-type]
        if declared.log:
            low, high, at = (math.log(value) for value in (low, high, at))
        wide = math.sqrt(3.0) * deviation * (high - low)
        if declared.periodic and high - low >= TURN:
            drawn_from = [at - min(wide, TURN / 2), at + min(wide, TURN / 2)]
        else:
            drawn_from = [max(at - wide, low), min(at + wide, high)]
        given = [math.exp(end) for end in drawn_from] if declared.log else drawn_from
        controls.setdefault(control, {})[parameter] = given
    return config.model_copy(update={"controls": controls, "sampler": "random"})


def _take(folder: Path, wanted: Sequence[PlannedRun], run: RunDirectory) -> list[str]:
    """Take the photographs in a folder into the runs that are compared with some; return what is missing. An InputError
    where there are none at all, or one cannot be read."""
    photographs, missing = Photographs(), list[str]()
    for each in wanted:
        inside = folder / Path(each.config.object).stem
        photographs.add_files(run.path / PARTS / each.name, files := photographs_in(inside, each.config.task))
        missing += [] if files else [f"{each.config.object}: {inside} has no photographs."]
    if len(missing) == len(wanted):
        names = ", ".join(Path(each.config.object).stem for each in wanted[:8])
        raise InputError(f"photographs: expected some in a folder for each object ({names}) in {folder}, got none")
    return missing


def _figures(
    described: Recipe, config: RecipeConfig, done: Sequence[DoneRun], run: RunDirectory
) -> Iterator[RecipeFigure]:
    """Make and draw the figures of a recipe."""
    rows, units, surfaces = list[dict[str, Any]](), dict[str, str](), {}
    for each, result in done:
        swept, workers = isinstance(result, SweepSummary), getattr(each.config, WORKERS, None)
        for part, kinds in (
            (each.part, ("sweep",) if swept else tuple(TRIALS)),
            *([(PHOTOGRAPHS, (PHOTO, LOOSE_PHOTO))] if swept else []),
        ):
            found, named = read_rows(part, run.path / PARTS / each.name, result, each.config.seed, kinds)
            rows += [row if workers is None else {**row, WORKERS: workers} for row in found]
            units |= named
        if isinstance(result, SweepSummary) and result.surface:
            surfaces[each.name] = result.surface
    table = Table.of(rows, described.groups, units=units, surfaces=surfaces, cores=cores(), folder=run.path)
    number = 0
    for figure in described.figures:
        kind, options = read_options(figure, config.recipe)
        for made in make(table, kind, options):
            number += 1
            for suffix, data in files_of(made).items():
                write_bytes(run.path / IMAGES / f"figure-{number}.{suffix}", data)
            yield RecipeFigure(
                figure=kind, title=made.title, text=list(made.text), columns=list(made.columns),
                rows=[list(row) for row in made.rows],
            )  # fmt: skip
