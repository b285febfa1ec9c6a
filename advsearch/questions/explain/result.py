"""The result of `explain`, its view and its claims."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar

from pydantic import Field

from advsearch.extend import ResultPart, RunResult, ShownResult, results, views, wording


class RightCounts(results.Fields):
    """Counts of right predictions with an interval."""

    right: int = Field(description="right predictions")
    total: int = Field(alias="of", description="how many")
    interval: results.Interval = Field(description="of the share, 95 %")
    share: float | None = Field(
        default=None,
        description="right ones of all; where rows share draws, the mean over draws of "
        "the share of each",
    )
    outcomes: results.Outcomes = results.optional_field(
        f"{results.OUTCOME_TEXT} in the other ones; {results.ONLY_OF_BOXES}"
    )

    @property
    def text(self) -> str:
        """The fraction with its interval and total: ``12 % (9 to 16) of 340``.

        Of a detector also the outcomes of the others: ``... of 340 (250 missed, 49
        loose)``.
        """
        share = wording.format_fraction_of(
            self.right, self.total, self.interval, self.share
        )
        outcomes = wording.format_outcomes(self.outcomes)
        return f"{share} ({outcomes})" if outcomes else share

    def make_extent(self, counted_text: str) -> results.Extent:
        """Return the counts for a claim; `counted_text` says what is counted."""
        return results.Extent.from_count(
            counted_text,
            self.right,
            self.total,
            self.interval,
            self.share,
            counts_right=True,
        )


class Confirmation(RightCounts):
    """Fresh renders inside a rule that no rule before it covers."""

    confirmed: bool = Field(
        default=False,
        description="whether they confirm it: they alone, beside the "
        "rows elsewhere, tell the rule",
    )


class RuleRow(RightCounts):
    """A rule under which the model is wrong more often than elsewhere.

    It is counted on rows that did not choose it.
    """

    conditions: list[results.ConditionRow] = Field(description="all of which hold")
    elsewhere: RightCounts = Field(description="rows under no rule so far")
    confirmed: Confirmation | None = Field(
        description="fresh renders drawn inside the rule, and `confirmed`, whether they "
        "tell it again; null where none were "
        "asked for"
    )


class RejectedRule(RightCounts):
    """The best rule that is not significant, counted on rows that did not choose it."""

    conditions: list[results.ConditionRow] = Field(description="all of which hold")
    elsewhere: RightCounts = Field(description="rows under no rule so far")
    chance: float = Field(
        description="how likely so few right predictions are by chance"
    )
    p_value_limit: float = Field(description="how unlikely they would have to be")
    rows: int | None = Field(
        description="of so many rows, with these shares, it would "
        "be told; null where of none"
    )


class ParameterWeight(results.Fields):
    """How much one parameter, or two together, decides the prediction."""

    parameters: list[str]
    share: results.JsonFloat = Field(
        description="of the variance of the predictions, by which of its parts a value "
        "lies in"
    )
    interval: results.Interval = Field(description="of the share, 95 %")
    parts: int = Field(
        default=0,
        description="into how many its values were cut, of two all pairs of parts",
    )


class EnvelopeRow(RightCounts):
    """A box of values inside which the model has at least an accuracy."""

    conditions: list[results.ConditionRow] = Field(
        description="all of which hold; empty for everything that was looked at"
    )
    accuracy: float = Field(description="what was asked for")
    confirmed: bool = Field(
        description="whether the rows that did not choose the box show it"
    )


class NearestRight(results.Fields):
    """A failure and the nearest right configuration that differs in one value."""

    values: dict[str, str | float] = Field(description="of the failure")
    parameter: str = Field(description="the one that differs")
    unit: str
    wrong_at: str | float
    right_at: str | float
    failure_label: str = Field(description="what the model says of the failure")
    right_label: str = Field(description="what it says of the other")
    pictures: list[str] = Field(
        description="files in the run's folder: of the failure, and of the other"
    )


class FailureCluster(results.Fields):
    """Failures that look alike to the model."""

    failures: int = Field(description="how many of those that were rendered again")
    labels: dict[str, int] = Field(
        description="what the model says of them, and how often"
    )
    values: dict[str, str | float] = Field(description="of the most typical one")
    picture: str = Field(description="of it: a file in the run's folder")


class FailureClusters(results.Fields):
    """Failures, clustered by the features that the model decides by."""

    features: str = Field(description="what these are")
    failures: int = Field(description="failures that were rendered again")
    silhouette: float | None = Field(
        description="how well they are apart, -1 to 1; null where all are one cluster"
    )
    are_separated: bool = Field(
        description="whether they are farther apart than groups of a cloud without any"
    )
    listed: list[FailureCluster] = Field(description="the largest first")


class ExplainResult(RunResult, RightCounts):
    """Rules, importance and clusters of a model's failures, from the rows of sweeps.

    `right` and `of` are those of all rows.
    """

    command: ClassVar[str] = "explain"

    sweeps: list[str] = Field(description="folders of the runs whose rows were read")
    object: str
    model: str
    units: int | None = Field(
        default=None,
        description="draws that the rows are of, such as [drives](drives.md), where "
        "some share one; absent where none "
        "do",
    )
    parameters: list[str] = Field(description="what varies in all of the rows")
    rules: list[RuleRow]
    rejected_rule: RejectedRule | None = Field(
        default=None, description="the next rule, which is not told; absent without"
    )
    importance: list[ParameterWeight] = Field(
        description="empty where all predictions are the same"
    )
    envelope: EnvelopeRow | None = Field(description="null where no box promises it")
    pairs: list[NearestRight]
    pairs_sought: int = Field(
        default=0,
        description="failures for which one was looked for by renders, the most "
        "typical; others are left out",
    )
    clusters: FailureClusters | None = Field(
        default=None, description="null where nothing was rendered for them"
    )
    renders: int = Field(description="pictures that were rendered")
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
        return f"{len(self.rules)} rules over {self.total} rows"


RULES_NOTE = (
    "Chosen on one half of the rows and counted on the other, each beyond the rules "
    "before it; 95 % intervals. Chance alone would tell any rule in one of a hundred "
    "cases at most. The search of the sweep's page takes the words of a rule and shows "
    "the pictures under it."
)
IMPORTANCE_NOTE = (
    "The share of the variance of the predictions, right or wrong, that is between "
    "parts of a parameter's values with equally many rows: its first-order Sobol "
    "index, by parts. Two parameters stand together where they decide more than each "
    "by itself. What differs inside a part is not counted."
)
WEIGHT_COLUMNS: Mapping[str, views.Column] = {
    "parameters": lambda weight: " with ".join(weight.parameters),
    "decides": lambda weight: wording.percent(weight.share),
    "95 % interval": lambda weight: wording.format_interval(weight.interval),
    "by parts": lambda weight: str(weight.parts or ""),
}
MAX_WEIGHTS = 12
"""Rows of the table of weights that a view has."""
MAX_LABELS = 3
"""Predictions of a cluster that a caption names."""


def make_explain_view(result: ExplainResult) -> ShownResult:
    """Return the view of an explanation.

    Its sections are the rules, the weights of the parameters, the box in which the
    model can be relied on, pairs of a failure and a right image, and kinds of failures.
    """
    rule_sentences = [
        f"{number}. {describe_rule_row(number, rule)}"
        for number, rule in enumerate(result.rules, start=1)
    ]
    note = RULES_NOTE if result.rules else ""
    sections = [
        ResultPart(
            "Rules", [*rule_sentences, describe_rejected_rule(result)], note=note
        ),
        ResultPart.make_table(
            result.importance[:MAX_WEIGHTS],
            WEIGHT_COLUMNS,
            title="What decides",
            note=IMPORTANCE_NOTE,
        ),
        ResultPart("Where it can be relied on", [describe_envelope(result)]),
    ]
    if result.pairs_sought:
        sections.append(ResultPart("One thing changed", [describe_pairs(result)]))
    sections += [_pair_section(pair) for pair in result.pairs]
    if result.clusters:
        sections.append(_cluster_section(result.clusters))
    draws = f", of {result.units:,} independent draws" if result.units else ""
    facts = {
        "rows": f"right in {result.text}{draws}",
        "sweeps": ", ".join(result.sweeps),
        "parameters": ", ".join(result.parameters),
    }
    about = [result.object, result.model]
    return ShownResult(_make_headline(result), sections, facts, about)


def _make_headline(result: ExplainResult) -> str:
    """Return the sentence that a reader sees first: how many rules there are."""
    if not result.rules:
        return (
            f"No rule is told from chance in {result.total:,} rows, of which one half "
            f"chooses and the other counts: the model is right in {result.text}."
        )
    return (
        f"{wording.format_count(len(result.rules), 'rule')} under which the model is "
        "wrong more often than elsewhere."
    )


def _pair_section(pair: NearestRight) -> ResultPart:
    """Return the sentence and the images of a failure and the nearest right image."""
    unit = "" if pair.unit in wording.PLAIN_UNITS else f" {pair.unit}"
    wrong_value = _format_value(pair.wrong_at)
    right_value = _format_value(pair.right_at)
    text = (
        f"{pair.parameter} {wrong_value}{unit}: {pair.failure_label}; "
        f"at {right_value}{unit}: {pair.right_label}."
    )
    captions = (f"wrong: {pair.failure_label}", f"right: {pair.right_label}")
    # There are no images if they could not be stored.
    pictures = [
        views.Picture(file, caption)
        for file, caption in zip(pair.pictures, captions, strict=False)
    ]
    return ResultPart(text=[text], pictures=[pictures])


def _format_value(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"


def describe_rule_row(number: int, rule: RuleRow) -> str:
    """Describe a rule with its counts and its confirmation in a sentence.

    `number` counts from 1.
    """
    rest = "elsewhere" if number == 1 else "in what no rule before covers"
    text = (
        f"{wording.format_conditions(rule.conditions)}: right in {rule.text}; {rest} "
        f"{rule.elsewhere.text}."
    )
    if rule.confirmed is None:
        return text
    verdict = "confirmed" if rule.confirmed.confirmed else "not confirmed"
    return f"{text} Fresh renders inside it: right in {rule.confirmed.text}; {verdict}."


def list_rule_triggers(result: ExplainResult) -> Iterator[str]:
    """Yield the rules in words, and whether fresh renders confirm each."""
    for number, rule in enumerate(result.rules, start=1):
        state = "Counted on rows that did not choose it, not rendered"
        if rule.confirmed is not None:
            state = "Confirmed" if rule.confirmed.confirmed else "Not confirmed"
        yield f"{state}: {describe_rule_row(number, rule)}"


def describe_rejected_rule(result: ExplainResult) -> str:
    """Describe the best rule that is not significant, and how many rows it would take.

    Empty if there is none.
    """
    rule = result.rejected_rule
    if rule is None:
        return ""
    text = (
        f"Not told{' either' if result.rules else ''}, but the best that one half of "
        "the rows suggests: "
        f"{wording.format_conditions(rule.conditions)}. In the other half the model is "
        f"right in {rule.right} of "
        f"{rule.total} under it and in {rule.elsewhere.right} of "
        f"{rule.elsewhere.total} elsewhere"
    )
    if rule.rows is None:
        return f"{text}, which is no difference that more rows would tell."
    chance = (
        f"chance does that with a probability of {rule.chance:.2g}, and at most "
        f"{rule.p_value_limit:g} is asked"
    )
    return (
        f"{text}; {chance}. About {rule.rows:,} rows with these shares would tell "
        "it: sweep more."
    )


def describe_envelope(result: ExplainResult) -> str:
    """Return in a sentence where the model can be relied on."""
    box = result.envelope
    if box is None:
        return "No box of enough rows promises the accuracy that was asked for."
    where = wording.format_conditions(box.conditions)
    if not box.confirmed:
        return (
            f"Not shown: inside {where} the rows that did not choose it are right "
            f"in {box.text}."
        )
    return (
        f"At least {100 * box.accuracy:g} % at 95 % confidence: {where}; right in "
        f"{box.text}."
    )


def describe_pairs(result: ExplainResult) -> str:
    """Describe for how many failures a nearby right configuration was found."""
    n_failures = result.total - result.right
    text = (
        f"Of the {result.pairs_sought} most typical of {n_failures} failures, "
        f"{len(result.pairs)} are right once one "
        "parameter is another."
    )
    n_untried = n_failures - result.pairs_sought
    if n_untried:
        text += f" The other {n_untried} were not tried; `pairs` says how many are."
    return text


def _cluster_section(clusters: FailureClusters) -> ResultPart:
    """Return the part of the page about the kinds of failures (their clusters): how
    many there are, and the most typical image of each.
    """
    failures = f"the {clusters.failures} failures that were rendered again"
    text = f"One kind: {failures} are alike by {clusters.features}."
    if clusters.silhouette is not None:
        reservation = ""
        if not clusters.are_separated:
            reservation = (
                "; they shade into one another: groups of any cloud may be as far apart"
            )
        text = (
            f"{len(clusters.listed)} kinds among {failures}, by {clusters.features} "
            f"(silhouette {clusters.silhouette:.2f}{reservation})."
        )
    pictures = []
    for cluster in clusters.listed:
        common_labels = list(cluster.labels.items())[:MAX_LABELS]
        labels = ", ".join(f"{label} {count}" for label, count in common_labels)
        pictures.append(views.Picture(cluster.picture, f"{cluster.failures}: {labels}"))
    return ResultPart("Kinds of failures", [text], pictures=[pictures])


def make_explain_claims(result: ExplainResult) -> Iterator[views.Claim]:
    """Yield the claims that the rules and the envelope (a box of values inside which
    the model has the accuracy that was asked for) support.
    """
    for number, rule in enumerate(result.rules, 1):
        yield _make_rule_claim(number, rule)
    box = result.envelope
    if box is not None and box.confirmed and box.total:
        yield _make_envelope_claim(box)
    elif not result.rules:
        reason = "no box of values was shown to keep the accuracy that was asked for"
        statement = f"Nothing is claimed: {reason}. {describe_envelope(result)}"
        yield views.Claim(kind="nothing claimed", statement=statement, extent=None)


def _make_rule_claim(number: int, rule: RuleRow) -> views.Claim:
    """Return what is claimed of a rule, by its number from 1.

    The counts are those of fresh renders if there are any; else those of the half of
    the rows that did not choose the rule.

    Args:
        number: number of the rule, from 1.
        rule: the rule with its counts.
    """
    counts: RightCounts = rule.confirmed or rule
    source = "rows that did not choose the rule"
    if rule.confirmed:
        source = "fresh renders"
    extent = counts.make_extent(f"right, of {source}")
    where = f"{wording.format_conditions(rule.conditions)} (rule {number})"
    inside = f"{wording.format_extent(extent)} {source}"
    statement = (
        f"Where {where} the model is right in {inside}; elsewhere in "
        f"{rule.elsewhere.text}."
    )
    return views.Claim(kind="measured", statement=statement, extent=extent)


def _make_envelope_claim(box: EnvelopeRow) -> views.Claim:
    """Return the claim that a model is right inside a box of parameter values.

    One half of the rows chose the box. The claim counts the other half, which tested
    it.
    """
    extent = box.make_extent("right, of rows that did not choose the box")
    where = wording.format_conditions(box.conditions)
    statement = (
        f"Inside {where} the model is right in {wording.format_extent(extent)} "
        "configurations that did not choose this box; the sweeps drew no others."
    )
    return views.Claim(kind="measured", statement=statement, extent=extent)
