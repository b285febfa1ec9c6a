"""`report.html` of `compare`: the sides, the pairs, where one is worse, and pictures that one alone gets right."""

from __future__ import annotations

from pathlib import Path

from advsearch.questions.compare.answer import ComparedPair, CompareResult
from advsearch.questions.compare.words import (
    SIDE_HEADS,
    alone_text,
    headline,
    paired_rows,
    part_heads,
    part_rows,
    parts_of,
    rules_texts,
    side_rows,
    values_text,
)
from advsearch.report import wording
from advsearch.report.markup import Html, element, join_html
from advsearch.viewer.document import again, data_url, document, facts_table, heading, study_table, subject_html

NOTE = (
    "p: how likely a split so uneven of the pairs that one side alone gets right is where both are right equally often "
    "(exact McNemar test, two-sided). Intervals of differences are Newcombe's for pairs, of shares "
    "Clopper-Pearson's, each for its row by itself."
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
    said = headline(result.pairs[0]) if result.pairs else "Interrupted before anything was compared."
    eyebrow = join_html("compare; ", subject_html(("", result.object), ("", result.model)))
    return document(
        f"{run.name}, compared",
        heading(eyebrow, said, result.warnings),
        main,
        footer=f"run {run.name}. This page needs no other file.",
    )


def _pair(run: Path, pair: ComparedPair, *, several: bool) -> Html:
    head, *rows = paired_rows(pair)
    rules, tables = rules_texts(pair), parts_of(pair)
    return join_html(
        element("h2", f"{pair.first} and {pair.second}, pair by pair"),
        element("p", headline(pair)) if several else None,
        element("p", alone_text(pair)),
        study_table(head, rows),
        join_html(element("h2", "Where one is worse"), *(element("p", text) for text in rules)) if rules else None,
        join_html(element("h2", "What only one gets right"), _figures(run, pair)) if pair.shown else None,
        element("h2", "By each parameter") if tables else None,
        *(
            join_html(element("h3", name), study_table(part_heads(pair, ""), part_rows(parts)))
            for name, parts in tables.items()
        ),
    )


def _figures(run: Path, pair: ComparedPair) -> Html:
    """The pairs that are shown: a picture each where both sides were shown the same, or else two beside each other."""
    figures, names = [], (pair.first, pair.second)
    for one in pair.shown:
        values = values_text(one)
        said = [
            f"{name}: {text}{' (right)' if name == one.right else ''}"
            for name, text in zip(names, one.answers, strict=True)
        ]
        files = [file for name in one.pictures if (file := _kept(run, name)) is not None]
        if len(files) == 2:
            captions = zip(files, said, ("", ""), strict=True)
            figures.append(element("div", *(_figure(*each) for each in captions), class_="pictures pair"))
            figures.append(element("p", values, class_="soft"))
        elif files:
            figures.append(_figure(files[0], "; ".join(said), values))
        else:
            figures.append(element("p", f"{'; '.join(said)}. {values}."))
    together = all(len(one.pictures) == 1 for one in pair.shown)
    return element("div", *figures, class_="pictures") if together else join_html(*figures)


def _figure(file: Path, said: str, values: str) -> Html:
    """A picture with what is said of it, and its values."""
    image = element("img", src=data_url(file.read_bytes(), "image/jpeg"), alt=said)
    return element("figure", image, element("figcaption", element("strong", said), f" {values}"))


def _kept(run: Path, name: str) -> Path | None:
    """The file of a picture in the folder of the run; None where there is none, or a summary names one elsewhere."""
    file = (run / name).resolve()
    return file if file.is_relative_to(run.resolve()) and file.is_file() else None
