"""`report.html` of a hardening: how robust the model was and is, what it was trained on, and what never was."""

from __future__ import annotations

from pathlib import Path

from advsearch.report import wording
from advsearch.report.hardening import HEADS, hardened_rows, hardened_text
from advsearch.report.markup import element, join_html
from advsearch.report.phrases import percent
from advsearch.runs.directory import IMAGES
from advsearch.runs.results.harden import HardenResult
from advsearch.viewer.document import data_url, document, scrolled
from advsearch.viewer.study_page import again, facts_table, heading, study_table, subject_html

ROUND_HEADS = ("round", "views trained on", "part of the way", "plain pictures right", "worst pictures right", "kept")
SPLIT_HEADS = ("side", "objects", "environments", "scenes", "views")


def harden_page(run: Path, result: HardenResult) -> str:
    """Return the page of a hardening in the folder `run`."""
    rows, figure = hardened_rows(result), run / IMAGES / f"{result.command}.png"
    image = None
    if figure.is_file() and not figure.is_symlink():
        address = data_url(figure.read_bytes(), "image/png")
        image = element("figure", scrolled(element("img", src=address, alt=hardened_text(result)), "wide"))
    note = (
        "Robust: the plain picture of a held-out scene is right, and the search finds no wrong one. 95 % "
        f"Clopper-Pearson intervals over scenes. Search: {result.search}; the stronger one: {result.stronger_search}."
    )
    rounds = [
        [
            str(number),
            str(one.lessons),
            percent(one.part),
            percent(one.clean),
            percent(one.robust),
            "yes" if one.kept else "",
        ]
        for number, one in enumerate(result.rounds)
    ]
    trained = (
        "Round 0 is the model as it was. Weights are part of the way from those to the trained ones. Judged on "
        "scenes in the training's environments on which it was not trained."
    )
    split = [
        [name, ", ".join(one.objects), ", ".join(one.environments), str(one.scenes), str(one.views)]
        for name, one in result.split.items()
    ]
    facts = {
        "Model": result.model,
        "Task": result.task,
        "Hardened model": result.hardened or "",
        "Weights": result.weights or "",
        "Pictures": result.pictures or "",
        "Time": wording.seconds_text(result.seconds["total"]),
        "Seed": str(result.seed),
    }
    main = element(
        "main",
        join_html(element("h2", "Before and after"), image, study_table(HEADS, rows), element("p", note, class_="soft"))
        if rows
        else None,
        join_html(element("h2", "The training"), study_table(ROUND_HEADS, rounds), element("p", trained, class_="soft"))
        if rounds
        else None,
        element("h2", "What it was trained and measured on"),
        study_table(SPLIT_HEADS, split),
        element("h2", "Cost and conditions"),
        facts_table(facts),
        again(result.command_line),
    )
    what = join_html("harden; ", subject_html(("", ",".join(result.objects)), ("", ", ".join(result.controls))))
    header = heading(what, hardened_text(result), result.warnings)
    return document(f"{run.name}, harden", header, main, footer=f"run {run.name}. This page needs no other file.")
