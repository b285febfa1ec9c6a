"""`report.html` of `compare`: the sides, the pairs, where one is worse, and pictures that one alone gets right."""

from __future__ import annotations

from pathlib import Path

from advsearch.questions.compare.answer import ComparedPair, CompareResult, PairPicture
from advsearch.questions.compare.words import (
    SIDE_HEADS,
    paired_rows,
    part_heads,
    part_rows,
    parts_of,
    rules_texts,
    side_rows,
    values_text,
    verdict,
)
from advsearch.report import wording
from advsearch.report.markup import Html, element, join_html
from advsearch.viewer.document import data_url, document
from advsearch.viewer.study_page import again, facts_table, heading, study_table, subject_html

NOTE = (
    "p: how likely a split so uneven of the pairs that one side alone gets right is where both are right equally often "
    "(exact McNemar test, two-sided). Intervals of differences are Newcombe's for pairs, of shares Clopper-Pearson's."
)


def page(run: Path, result: CompareResult) -> str:
    """Return the page of a comparison in the folder `run`."""
    facts = {
        "Sweeps": ", ".join(dict.fromkeys(one.run for one in result.sides)),
        "They differ in": ", ".join(result.differ),
        "Renders": str(result.renders),
        "Time": wording.seconds_text(result.seconds["total"]),
        "Seed": str(result.seed),
    }
    main = element(
        "main",
        join_html(element("h2", "How often each is right"), study_table(SIDE_HEADS, side_rows(result)))
        if result.sides
        else None,
        *(_pair(run, one, several=len(result.pairs) > 1) for one in result.pairs),
        element("p", NOTE, class_="soft") if result.pairs else None,
        element("h2", "Cost and conditions"),
        facts_table(facts),
        again(result.command_line),
    )
    said = " ".join(verdict(one) for one in result.pairs[:1]) or "Interrupted before anything was compared."
    eyebrow = join_html("compare; ", subject_html(("", result.object), ("", result.model)))
    return document(
        f"{run.name}, compared",
        heading(eyebrow, said, result.warnings),
        main,
        footer=f"run {run.name}. This page needs no other file.",
    )


def _pair(run: Path, pair: ComparedPair, *, several: bool) -> Html:
    head, *rows = paired_rows(pair)
    rules = rules_texts(pair)
    parts = [
        join_html(element("h3", name), study_table(part_heads(pair, name), part_rows(parts)))
        for name, parts in parts_of(pair).items()
    ]
    figures = [_figure(run, one, pair) for one in pair.shown]
    return join_html(
        element("h2", f"{pair.first} and {pair.second}, pair by pair"),
        element("p", verdict(pair)) if several else None,
        study_table(head, rows),
        join_html(element("h2", "Where one is worse"), *(element("p", text) for text in rules)) if rules else None,
        join_html(element("h2", "By each parameter"), *parts) if parts else None,
        join_html(element("h2", "What only one gets right"), *figures) if figures else None,
    )


def _figure(run: Path, one: PairPicture, pair: ComparedPair) -> Html:
    """A pair: its pictures with what was said of each; of one picture, both answers below it."""
    names = (pair.first, pair.second)
    said = [
        f"{name}: {text}{' (right)' if name == one.right else ''}"
        for name, text in zip(names, one.answers, strict=True)
    ]
    captions = said if len(one.pictures) == len(said) else ["; ".join(said)]
    files = [file for name in one.pictures if (file := _kept(run, name)) is not None]
    if len(files) != len(captions):
        return element("p", f"{'; '.join(said)}. {values_text(one)}.")
    figures = [
        element(
            "figure",
            element("img", src=data_url(file.read_bytes(), "image/jpeg"), alt=text),
            element("figcaption", text),
        )
        for file, text in zip(files, captions, strict=True)
    ]
    return join_html(element("div", *figures, class_="pictures pair"), element("p", values_text(one), class_="soft"))


def _kept(run: Path, name: str) -> Path | None:
    """The file of a picture in the folder of the run; None where there is none, or a summary names one elsewhere."""
    file = (run / name).resolve()
    return file if file.is_relative_to(run.resolve()) and file.is_file() else None
