"""`report.html` of `explain`: rules, what decides, the envelope, and failures beside the nearest right answers."""

from __future__ import annotations

from pathlib import Path

from advsearch.report import wording
from advsearch.report.explanations import (
    WEIGHT_HEADS,
    cluster_text,
    clusters_text,
    conditions_text,
    envelope_text,
    explain_text,
    not_told_text,
    pair_text,
    pairs_text,
    right_share_text,
    weight_rows,
)
from advsearch.report.markup import Html, element, join_html
from advsearch.runs.results.explain import ExplainResult, FailureCluster, NearestRight
from advsearch.viewer.document import data_url, document
from advsearch.viewer.study_page import again, facts_table, heading, study_table, subject_html

RULE_HEADS = ("rule", "right", "where no rule so far holds", "fresh renders inside")


def explain_page(run: Path, result: ExplainResult) -> str:
    """Return the page of an explanation in the folder `run`."""
    rules = [
        [
            conditions_text(one.conditions),
            right_share_text(one),
            right_share_text(one.elsewhere),
            "" if one.confirmed is None else right_share_text(one.confirmed),
        ]
        for one in result.rules
    ]
    note = (
        "Chosen on one half of the rows and counted on the other, each beyond the rules before it; 95 % "
        "Clopper-Pearson intervals. Chance alone would tell any rule in one of a hundred cases at most."
    )
    weights = weight_rows(result)
    decides = (
        "The share of the variance of the answers, right or wrong, that is between parts of a parameter's values with "
        "equally many rows: its first-order Sobol index, by parts. Two parameters stand together where they decide "
        "more than each by itself. What differs inside a part is not counted."
    )
    main = element(
        "main",
        join_html(element("h2", "Rules"), study_table(RULE_HEADS, rules), element("p", note, class_="soft"))
        if rules
        else None,
        element("p", not_told_text(result)) if result.not_told else None,
        join_html(
            element("h2", "What decides"), study_table(WEIGHT_HEADS, weights), element("p", decides, class_="soft")
        )
        if weights
        else None,
        element("h2", "Where it can be relied on"),
        element("p", envelope_text(result)),
        _pairs(run, result) if result.pairs_sought else None,
        join_html(
            element("h2", "Kinds of failures"),
            element("p", clusters_text(result.clusters)),
            element("div", *(_cluster(run, one) for one in result.clusters.listed), class_="pictures"),
        )
        if result.clusters is not None
        else None,
        element("h2", "Cost and conditions"),
        facts_table(
            {
                "Rows": f"right in {right_share_text(result)}",
                "Sweeps": ", ".join(result.sweeps),
                "Parameters": ", ".join(result.parameters),
                "Renders": str(result.renders),
                "Time": wording.seconds_text(result.seconds["total"]),
                "Seed": str(result.seed),
            }
        ),
        again(result.command_line),
    )
    header = heading(
        join_html("explain; ", subject_html(("", result.object), ("", result.model))),
        explain_text(result),
        result.warnings,
    )
    return document(f"{run.name}, explained", header, main, footer=f"run {run.name}. This page needs no other file.")


def _kept(run: Path, name: str) -> Path | None:
    """The file of a picture in the folder of the run; None where there is none, or a summary names one elsewhere."""
    file = (run / name).resolve()
    return file if file.is_relative_to(run.resolve()) and file.is_file() else None


def _cluster(run: Path, one: FailureCluster) -> Html | None:
    """The most typical failure of a cluster."""
    file = _kept(run, one.picture)
    if file is None:
        return None
    image = element("img", src=data_url(file.read_bytes(), "image/png"), alt=cluster_text(one))
    return element("figure", image, element("figcaption", cluster_text(one)))


def _pairs(run: Path, result: ExplainResult) -> Html:
    pairs = (_pair(run, one) for one in result.pairs)
    return join_html(element("h2", "One thing changed"), element("p", pairs_text(result)), *pairs)


def _pair(run: Path, pair: NearestRight) -> Html:
    """A failure beside the nearest right answer, pictures where they were kept."""
    words = ("wrong: " + pair.answered, "right: " + pair.answered_there)
    figures = [
        element(
            "figure",
            element("img", src=data_url(file.read_bytes(), "image/jpeg"), alt=text),
            element("figcaption", text),
        )
        for name, text in zip(pair.pictures, words, strict=False)
        if (file := _kept(run, name)) is not None
    ]
    return join_html(
        element("p", pair_text(pair)), element("div", *figures, class_="pictures pair") if figures else None
    )
