"""Settings and result of `recipe`: its runs and figures."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path, PurePath
from typing import Any, ClassVar, Literal

from pydantic import Field, JsonValue, field_validator

from advsearch.extend import (
    Config,
    RunResult,
    SceneConfig,
    SweepConfig,
    results,
    setting,
    setting_as_in,
    settings,
    views,
    wording,
)

Cell = str | int | float | None

FROM_RECIPE = "what the recipe names"

# its validators check the settings of the same names
SCENE_SETTINGS: Any = SceneConfig


class RecipeConfig(Config):
    """Settings of `recipe`: the recipe, and the objects, environments and models that
    replace those of the recipe.
    """

    command: ClassVar[str] = "recipe"
    changeable_settings: ClassVar[tuple[str, ...]] = (
        *Config.changeable_settings,
        "photographs",
    )
    clashes: ClassVar[tuple[settings.Clash, ...]] = SceneConfig.clashes

    # fmt: off
    recipe: str = setting(
        ..., "recipe", "the experiment to run",
        "the name of a recipe, which advsearch recipe list shows, or a YAML file",
    )
    quick: bool = setting(
        False, "recipe", "use few and small pictures, for a first look"
    )
    photographs: str | None = setting(
        None, "recipe", "photographs to compare with renderings, in a folder for each "
                        "object, named after it", "a folder",
        otherwise="those taken with advsearch dashboard",
    )
    object: str | None = setting_as_in(SweepConfig, "object", default=None, otherwise=FROM_RECIPE)
    environment: str | None = setting_as_in(
        SceneConfig, "environment", otherwise=FROM_RECIPE,
        description="the environment map that lights the scene; several, separated by "
                    "commas",
        expects="names of environments or .hdr or .exr files",
    )
    up: Literal["y", "z"] | None = setting_as_in(SceneConfig, "up")
    facing: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None = setting_as_in(
        SceneConfig, "facing"
    )
    size: float | None = setting_as_in(SceneConfig, "size")
    unit: Literal["mm", "cm", "m", "in"] | None = setting_as_in(SceneConfig, "unit")
    resolution: tuple[int, int] | None = setting_as_in(
        SceneConfig, "resolution", otherwise="what the recipe says, or what the model "
                                             "takes"
    )
    model: str | None = setting_as_in(
        SceneConfig, "model", default=None, otherwise=FROM_RECIPE,
        description="the network under test; several separated by commas",
    )
    labels: str | None = setting_as_in(SceneConfig, "labels")
    prompt: str | None = setting_as_in(SceneConfig, "prompt")
    value_range: tuple[float, float] | None = setting_as_in(SceneConfig, "value_range")
    task: str | dict[str, JsonValue] | None = setting_as_in(
        SceneConfig, "task", default=None, otherwise="what the recipe says, or "
                                                     "classification"
    )
    label: dict[str, str] = setting(
        dict, "model",
        "the right labels, separated by commas, for all objects or one "
        "(OBJECT=LABELS); may be repeated",
        'names of classes, such as "coffee mug,cup" or mug="coffee mug,cup"',
        read_texts=settings.parse_choices, metavar="LABELS", otherwise="each object's own",
    )
    seed: int = setting_as_in(SceneConfig, "seed")
    threads: int | None = setting_as_in(SceneConfig, "threads")
    deterministic: bool = setting_as_in(SceneConfig, "deterministic")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/RECIPE-NNN")
    overwrite: bool = setting_as_in(SceneConfig, "overwrite")
    # fmt: on

    _named = field_validator(
        "recipe",
        "photographs",
        "object",
        "environment",
        "model",
        "labels",
        "task",
        "run",
        mode="before",
    )(lambda value, info: SCENE_SETTINGS._as_text(value, info))
    _prompts = field_validator("prompt", mode="before")(
        lambda value: SCENE_SETTINGS._prompts_as_text(value)
    )
    _range = field_validator("value_range", mode="before")(
        lambda value: SCENE_SETTINGS._range_from_text(value)
    )
    _range_in_order = field_validator("value_range")(
        lambda value: SCENE_SETTINGS._range_in_order(value)
    )
    _sized = field_validator("resolution", mode="before")(
        lambda value: SCENE_SETTINGS._resolution_from_text(value)
    )
    _sides_in_range = field_validator("resolution")(
        lambda value: SCENE_SETTINGS._sides_in_range(value)
    )
    _task = field_validator("task", mode="before")(
        lambda value: SCENE_SETTINGS._task_with_options(value)
    )

    @field_validator("photographs")
    @classmethod
    def _resolve_photographs(cls, value: str | None) -> str | None:
        """Make the path absolute, since a run is resumed from any directory."""
        return None if value is None else str(Path(value).expanduser().resolve())

    @field_validator("label")
    @classmethod
    def _check_labels(cls, value: dict[str, str]) -> dict[str, str]:
        """Reject labels without a name, and zero bytes."""
        for name, label in value.items():
            # A label is a list of names that commas separate.
            names_nothing = not label.strip(" ,\t\n")
            if names_nothing or "\0" in name + label:
                raise ValueError("an empty name")
        return value

    @property
    def run_name_words(self) -> tuple[str, ...]:
        """The names that a run's directory is named after: the recipe and an object."""
        objects = settings.split_names(self.object or "")
        return Path(self.recipe).stem, *(Path(name).stem for name in objects[:1])

    @property
    def task_name(self) -> str | None:
        """The name of the task, or None if the recipe states it."""
        if self.task is None or isinstance(self.task, str):
            return self.task
        return str(self.task["name"])

    def find_label(self, name: str) -> str | None:
        """Return the right label of an object from the settings; None without one.

        The settings may name the object, the stem of its file, or all objects.
        """
        return (
            self.label.get(name)
            or self.label.get(Path(name).stem)
            or self.label.get(settings.FOR_ALL)
        )


# columns of a figure's numbers: a fraction, and the bounds of its 95 % interval
FRACTION_COLUMNS = ("share", "low", "high")
QUICK_REMARK = "Made with few and small pictures, to see what comes out; no result."


class RecipePart(results.Fields):
    """One run of a recipe."""

    name: str = Field(description="name of its folder in `parts`")
    part: str = Field(description="the part of the recipe that it belongs to")
    command: str
    object: str
    ending: str
    renders: int = Field(description="number of pictures that were rendered")


class RecipeFigure(results.Fields):
    """One figure: its numbers, and sentences about them."""

    figure: str = Field(description="kind of the figure")
    title: str
    text: list[str] = Field(description="sentences that describe the figure")
    columns: list[str] = Field(
        description="heads of the table; `low` and `high` are the 95 % interval of a "
        "fraction"
    )
    rows: list[list[Cell]] = Field(description="rows of the table")


class RecipeResult(views.InNotebook, RunResult):
    """Result of a recipe: its runs, its figures and what they show."""

    command: ClassVar[str] = "recipe"

    recipe: str = Field(description="name or file of the recipe")
    title: str = Field(description="the question that the recipe answers")
    about: str = Field(
        description="how the result is obtained, and whose experiment it is"
    )
    quick: bool = Field(description="whether few and small pictures were used")
    objects: list[str]
    model: str
    parts: list[RecipePart] = Field(description="the runs in the folder `parts`")
    figures: list[RecipeFigure]
    warnings: list[str] = Field(description="remarks that limit what the result shows")

    @property
    def outcome_summary(self) -> str:
        return f"{len(self.figures)} figures"


def make_view(result: RecipeResult) -> views.ShownResult:
    """Lay out a result: each figure with its sentences and numbers, then the runs."""
    sections = [views.ResultPart(text=[result.about], only_medium="page")]
    sections += _list_figures(result)
    sections.append(_list_runs(result.parts))
    objects = ", ".join(map(wording.shorten_name, result.objects))
    models = _shorten_names(result.model)
    facts = {
        "objects": objects,
        "environments": _shorten_names(result.environment),
        "models": models,
        "runs": str(len(result.parts)),
        "renders": str(sum(run.renders for run in result.parts)),
    }
    remarks = [QUICK_REMARK] if result.quick else []
    recipe_name = PurePath(result.recipe).stem
    return views.ShownResult(
        result.title, sections, facts, [recipe_name, models, objects], remarks
    )


def _list_figures(result: RecipeResult) -> list[views.ResultPart]:
    """Return a section for each figure, and one for its numbers."""
    sections = list[views.ResultPart]()
    # the sentences of each figure, without those of earlier figures
    sentences = omit_repeated_sentences(result.figures)
    for number, (figure, text) in enumerate(
        zip(result.figures, sentences, strict=True), start=1
    ):
        image = f"images/figure-{number}.png"
        sections.append(views.ResultPart(figure.title, text, figure=image))
        sections.append(_make_numbers_part(figure))
    return sections


def _make_numbers_part(figure: RecipeFigure) -> views.ResultPart:
    """Make the section with the numbers of a figure."""
    rows = [list(map(_format_cell, figure.columns, row)) for row in figure.rows]
    return views.ResultPart(
        "The numbers",
        column_heads=figure.columns,
        rows=rows,
        folded=True,
        only_medium="page",
    )


def _list_runs(parts: Sequence[RecipePart]) -> views.ResultPart:
    """Make the table of a recipe's runs."""
    rows = [[run.name, run.command, run.ending, str(run.renders)] for run in parts]
    return views.ResultPart(
        wording.format_count(len(parts), "run"),
        column_heads=("run in parts/", "command", "ending", "renders"),
        rows=rows,
        parts=[run.name for run in parts],
        folded=True,
        only_medium="page",
    )


def _shorten_names(names: str) -> str:
    """Shorten each of the names that commas separate."""
    return ", ".join(map(wording.shorten_name, names.split(",")))


def _format_cell(column: str, value: Cell) -> str:
    """Format a cell of a figure's numbers."""
    if column in FRACTION_COLUMNS:
        return wording.percent(value) if isinstance(value, (int, float)) else ""
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value)


def omit_repeated_sentences(figures: Sequence[RecipeFigure]) -> list[list[str]]:
    """Return the sentences of each figure without those that an earlier figure has.

    Only sentences with a count, as in "3 of 5", are left out. If no sentence remains,
    or the text is equal to that of the previous figure, a sentence states this.
    """
    reported = set[str]()
    remaining = list[list[str]]()
    previous: RecipeFigure | None = None
    for figure in figures:
        if previous is not None and figure.text == previous.text:
            new = ["It says the same as the figure before it."]
        else:
            new = _select_new_sentences(figure.text, reported)
        remaining.append(new or ["It says what figures before it say."])
        reported |= set(figure.text)
        previous = figure
    return remaining


def _select_new_sentences(text: Sequence[str], reported: Collection[str]) -> list[str]:
    """Return the sentences that have no count, or are not yet reported."""
    return [
        sentence
        for sentence in text
        if sentence not in reported or not re.search(r"\d of \d", sentence)
    ]
