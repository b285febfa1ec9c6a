"""`report.html` of a recipe: each figure with what it says and its numbers, and the runs that it took."""

from __future__ import annotations

from pathlib import Path

from advsearch.questions.recipe.answer import AnyFigure, RecipePart, RecipeResult
from advsearch.questions.recipe.words import figure_table, told_once
from advsearch.report import wording
from advsearch.report.markup import Html, element, join_html
from advsearch.runs.directory import IMAGES, PARTS
from advsearch.viewer.document import data_url, document, scrolled
from advsearch.viewer.study_page import again, facts_table, heading, part_links, study_table


def recipe_page(run: Path, result: RecipeResult) -> str:
    """Return the page of a recipe in the folder `run`."""
    objects, environments, models = (
        ", ".join(map(wording.short_name, names))
        for names in (result.objects, result.environment.split(","), result.model.split(","))
    )
    facts = {
        "Objects": objects,
        "Environments": environments,
        "Models": models,
        "Renders": str(sum(one.renders for one in result.parts)),
        "Time": wording.seconds_text(result.seconds["total"]),
        "Seed": str(result.seed),
    }
    main = element(
        "main",
        element("p", result.about) if result.about else None,
        *(
            _section(one, texts, run / IMAGES / f"figure-{number}.png")
            for number, (one, texts) in enumerate(zip(result.figures, told_once(result.figures), strict=True), start=1)
        ),
        join_html(element("h2", "Cost and conditions"), facts_table(facts)),
        _runs(run, result.parts),
        again(result.command_line),
    )
    header = heading(
        f"recipe {Path(result.recipe).stem}; {models}; {objects}", result.title, [*_cautions(result), *result.warnings]
    )
    return document(
        f"{run.name}, {result.title}", header, main, footer=f"run {run.name}. This page needs no other file."
    )


def _cautions(result: RecipeResult) -> list[str]:
    said = ["Made with few and small pictures, to see what comes out; no result."] if result.quick else []
    return [*said, "Interrupted before its end; there are no figures yet."] if result.goes_on else said


def _section(made: AnyFigure, texts: list[str], picture: Path) -> Html:
    heads, rows = figure_table(made)
    image = None
    if picture.is_file():
        alt = " ".join(made.text) or made.title
        image = element("img", src=data_url(picture.read_bytes(), "image/png"), alt=alt)
    return join_html(
        element("h2", made.title),
        *(element("p", text) for text in texts),
        element("figure", scrolled(image, "wide")) if image else None,
        element("details", element("summary", "The numbers"), study_table(heads, rows)) if rows else None,
    )


def _runs(run: Path, parts: list[RecipePart]) -> Html:
    rows = [[one.name, one.command, one.ending, str(one.renders)] for one in parts]
    links = part_links(run, [one.name for one in parts])
    listed = study_table([f"runs in {PARTS}/", "command", "ending", "renders"], rows, links)
    return element("details", element("summary", wording.count(len(rows), "run")), listed)
