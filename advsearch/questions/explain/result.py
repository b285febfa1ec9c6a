"""The result of `explain`, its view and its claims."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar

from pydantic import Field

from advsearch.extend import (
    RunResult,
    results,
    views,
    wording,
)


class RightCounts(results.Fields):
    """Counts of right predictions with an interval."""

    right: int = Field(description="number of right predictions")
    total: int = Field(alias="of", description="number of predictions")
    interval: results.Interval = Field(description="95 % interval of the fraction")
    share: float | None = Field(
        default=None,
        description="fraction of right predictions; if rows share draws, the mean over "
        "draws of the fraction of each; null without rows",
    )
    outcomes: results.Outcomes = results.optional_field(
        f"{results.OUTCOME_TEXT} in the other predictions; {results.ONLY_OF_BOXES}"
    )

    @property
    def text(self) -> str:
        """The fraction with its interval and total, ``12 % (9 to 16) of 340``.

        For a detector it has the outcomes of the wrong predictions, too: ``... of 340
        (250 missed, 49 loose)``.
        """
        share = wording.format_fraction_of(
            self.right, self.total, self.interval, self.share
        )
        outcomes = wording.format_outcomes(self.outcomes)
        return f"{share} ({outcomes})" if outcomes else share

    def make_extent(self, counted_text: str) -> results.Extent:
        """Return the counts for a claim; `counted_text` states what is counted."""
        return results.Extent.from_count(
            counted_text,
            self.right,
            self.total,
            self.interval,
            self.share,
            counts_right=True,
        )


class Confirmation(RightCounts):
    """Counts of fresh renders inside a rule that no earlier rule covers."""

    confirmed: bool = Field(
        default=False,
        description="whether these renders confirm the rule: compared with the rows "
        "elsewhere, they alone are significant",
    )


class RuleRow(RightCounts):
    """A rule under which the model is wrong more often than elsewhere.

    Its counts are from rows that did not choose it.
    """

    conditions: list[results.ConditionRow] = Field(
        description="conditions of the rule, all of which hold under it"
    )
    elsewhere: RightCounts = Field(
        description="counts of the rows under neither this rule nor an earlier one"
    )
    confirmed: Confirmation | None = Field(
        description="counts of fresh renders inside the rule, and whether they confirm "
        "it; null if nothing was rendered"
    )


class RejectedRule(RightCounts):
    """The best rule that is not significant, counted on rows that did not choose it."""

    conditions: list[results.ConditionRow] = Field(
        description="conditions of the rule, all of which hold under it"
    )
    elsewhere: RightCounts = Field(
        description="counts of the rows under neither this rule nor an earlier one"
    )
    chance: float = Field(
        description="p-value: probability of so few right predictions by chance"
    )
    p_value_limit: float = Field(description="maximum p-value of a significant rule")
    rows: int | None = Field(
        description="number of rows that would make the rule significant, with these "
        "fractions; null if no number would"
    )


class ParameterWeight(results.Fields):
    """How much one parameter, or two together, decides the prediction."""

    parameters: list[str]
    share: results.JsonFloat = Field(
        description="fraction of the variance of the predictions that is between parts "
        "of the parameter's values"
    )
    interval: results.Interval = Field(description="95 % interval of the fraction")
    parts: int = Field(
        default=0,
        description="number of parts into which the values are divided; for two "
        "parameters, the number of pairs of parts",
    )


class EnvelopeRow(RightCounts):
    """A box of values inside which the model has at least an accuracy."""

    conditions: list[results.ConditionRow] = Field(
        description="conditions of the box, all of which hold inside it; empty if the "
        "box has all rows"
    )
    accuracy: float = Field(description="required accuracy")
    confirmed: bool = Field(
        description="whether the rows that did not choose the box have that accuracy, "
        "at 95 % confidence"
    )


class NearestRight(results.Fields):
    """A failure and the nearest right configuration that differs in one value."""

    values: dict[str, str | float] = Field(
        description="values of the parameters of the failure"
    )
    parameter: str = Field(description="the parameter that differs")
    unit: str = Field(description="unit of that parameter")
    wrong_at: str | float = Field(description="its value in the failure")
    right_at: str | float = Field(description="its value in the right configuration")
    failure_label: str = Field(description="prediction for the failure")
    right_label: str = Field(description="prediction for the right configuration")
    pictures: list[str] = Field(
        description="files in the run's folder: image of the failure, and of the right "
        "configuration"
    )


class FailureCluster(results.Fields):
    """Failures that look alike to the model."""

    failures: int = Field(description="number of failures in the cluster")
    labels: dict[str, int] = Field(
        description="predictions for these failures, with their counts"
    )
    values: dict[str, str | float] = Field(
        description="values of the parameters of the most typical failure"
    )
    picture: str = Field(
        description="image of the most typical failure: a file in the run's folder"
    )


class FailureClusters(results.Fields):
    """Failures, clustered by features of the model."""

    features: str = Field(
        description='description of the features, such as "the input of head (Linear), '
        '192 numbers"'
    )
    failures: int = Field(description="number of failures that were rendered again")
    silhouette: float | None = Field(
        description="mean silhouette, -1 to 1, which is larger for clusters that are "
        "farther apart; null if there is a single cluster"
    )
    are_separated: bool = Field(
        description="whether the silhouette is larger than that of random points "
        "without clusters"
    )
    listed: list[FailureCluster] = Field(description="clusters, the largest first")


class ExplainResult(RunResult, RightCounts):
    """Rules, importance and clusters of a model's failures, from the rows of sweeps.

    `right`, `of`, `share` and `outcomes` are those of all rows.
    """

    command: ClassVar[str] = "explain"

    sweeps: list[str] = Field(description="folders of the runs whose rows were read")
    object: str
    model: str
    units: int | None = Field(
        default=None,
        description="number of independent draws, such as [drives](drives.md), if "
        "several rows share a draw; absent if each row is a draw",
    )
    parameters: list[str] = Field(description="parameters that vary in all sweeps")
    rules: list[RuleRow]
    rejected_rule: RejectedRule | None = Field(
        default=None,
        description="the next rule, which is not significant; absent if there is none",
    )
    importance: list[ParameterWeight] = Field(
        description="empty if all predictions are right, or all are wrong"
    )
    envelope: EnvelopeRow | None = Field(
        description="null if no box of enough rows has the required accuracy"
    )
    pairs: list[NearestRight]
    pairs_sought: int = Field(
        default=0,
        description="number of failures, the most typical ones, for which a right "
        "configuration was searched by renders",
    )
    clusters: FailureClusters | None = Field(
        default=None, description="null if no failures were rendered again"
    )
    renders: int = Field(description="number of images that were rendered")
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def outcome_summary(self) -> str:
        return f"{len(self.rules)} rules over {self.total} rows"


RULES_NOTE = (
    "Rules are chosen on one half of the rows and counted on the other half. Rows "
    "under an earlier rule are left out. Intervals are 95 % intervals. If there were "
    "no rules, chance would produce one in at most one of a hundred cases. The text of "
    "a rule, entered in the search field of the sweep's page, shows its images."
)
IMPORTANCE_NOTE = (
    "The fraction of the variance of the predictions, right or wrong, that is between "
    "parts of a parameter's values with equally many rows: its first-order Sobol "
    "index, by parts. Two parameters are listed together if they decide more than the "
    "sum of both. Differences inside a part are not counted."
)
WEIGHT_COLUMNS: Mapping[str, views.Column] = {
    "parameters": lambda weight: " with ".join(weight.parameters),
    "decides": lambda weight: wording.percent(weight.share),
    "95 % interval": lambda weight: wording.format_interval(weight.interval),
    "by parts": lambda weight: str(weight.parts or ""),
}
MAX_WEIGHTS = 12
"""Maximum number of rows in the table of weights."""
MAX_LABELS = 3
"""Maximum number of predictions of a cluster in a caption."""


def make_explain_view(result: ExplainResult) -> views.ShownResult:
    """Return the view of an explanation.

    Its sections are the rules, the weights of the parameters, the box in which the
    model can be relied on, pairs of a failure and a right image, and kinds of failures.
    """
    sections = [
        _make_rules_part(result),
        views.ResultPart.make_table(
            result.importance[:MAX_WEIGHTS],
            WEIGHT_COLUMNS,
            title="What decides",
            note=IMPORTANCE_NOTE,
        ),
        views.ResultPart("Where it can be relied on", [describe_envelope(result)]),
        *_make_failure_parts(result),
    ]
    about = [result.object, result.model]
    return views.ShownResult(
        _make_headline(result), sections, _list_row_facts(result), about
    )


def _list_row_facts(result: ExplainResult) -> dict[str, str]:
    """Return the rows, the sweeps and the parameters, by what they are."""
    # None if each row is an independent draw
    draws = f", of {result.units:,} independent draws" if result.units else ""
    return {
        # for example "right in 88 % (84 to 91) of 340, of 20 independent draws"
        "rows": f"right in {result.text}{draws}",
        "sweeps": ", ".join(result.sweeps),
        "parameters": ", ".join(result.parameters),
    }


def _make_rules_part(result: ExplainResult) -> views.ResultPart:
    """Return the part with all rules in sentences, and the best one that was rejected."""
    rule_sentences = [
        f"{number}. {describe_rule_row(number, rule)}"
        for number, rule in enumerate(result.rules, start=1)
    ]
    rule_sentences.append(describe_rejected_rule(result))  # "" if there is none
    note = RULES_NOTE if result.rules else ""
    return views.ResultPart("Rules", rule_sentences, note=note)


def _make_failure_parts(result: ExplainResult) -> Iterator[views.ResultPart]:
    """Yield the parts about single failures: pairs with a right image, and kinds."""
    if result.pairs_sought:  # the number of failures for which a pair was looked for
        yield views.ResultPart("One thing changed", [describe_pairs(result)])
    for pair in result.pairs:
        yield _pair_section(pair)
    if result.clusters:
        yield _cluster_section(result.clusters)


def _make_headline(result: ExplainResult) -> str:
    """Return the sentence that a reader sees first: how many rules there are."""
    if not result.rules:
        return (
            f"No rule is significant in {result.total:,} rows, of which one half "
            f"chooses and the other counts: the model is right in {result.text}."
        )
    return (
        f"{wording.format_count(len(result.rules), 'rule')} under which the model is "
        "wrong more often than elsewhere."
    )


def _pair_section(pair: NearestRight) -> views.ResultPart:
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
    return views.ResultPart(text=[text], pictures=[pictures])


def _format_value(value: str | float) -> str:
    """Format a number with four significant digits; return a name as it is."""
    return value if isinstance(value, str) else f"{value:.4g}"


def describe_rule_row(number: int, rule: RuleRow) -> str:
    """Describe a rule with its counts and its confirmation in a sentence.

    Args:
        number: number of the rule, from 1.
        rule: the rule. Its `text`, and that of other counts, is such as "12 % (9 to 16)
            of 340".
    """
    rest = "elsewhere" if number == 1 else "in rows under no earlier rule"
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
    """Describe the best rule that is not significant, and how many rows it needs.

    "" if there is none.
    """
    rule = result.rejected_rule
    if rule is None:
        return ""
    text = (
        f"Not significant{' either' if result.rules else ''}, but the best rule that "
        "one half of the rows suggests: "
        f"{wording.format_conditions(rule.conditions)}. In the other half the model is "
        f"right in {rule.right} of "
        f"{rule.total} under it and in {rule.elsewhere.right} of "
        f"{rule.elsewhere.total} elsewhere"
    )
    return text + _describe_missing_significance(rule)


def _describe_missing_significance(rule: RejectedRule) -> str:
    """Describe how many rows a rule would need to be significant.

    The text continues a sentence.
    """
    if rule.rows is None:
        return ". More rows would not make this difference significant."
    chance = (
        f"its p-value is {rule.chance:.2g}, and a significant rule has at most "
        f"{rule.p_value_limit:g}"
    )
    return (
        f"; {chance}. About {rule.rows:,} rows with these fractions would make "
        "it significant: sweep more."
    )


def describe_envelope(result: ExplainResult) -> str:
    """Describe in a sentence where the model can be relied on."""
    box = result.envelope
    if box is None:
        return "No box of enough rows has the required accuracy."
    where = wording.format_conditions(box.conditions)
    # `box.text` is the rate of the rows that tested the box: "88 % (84 to 91) of 340"
    if not box.confirmed:
        return (
            f"Not confirmed: inside {where} the rows that did not choose the box are "
            f"right in {box.text}."
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
        f"{len(result.pairs)} become right if one parameter is changed."
    )
    n_untried = n_failures - result.pairs_sought
    if n_untried:
        text += f" The other {n_untried} were not tried; `pairs` sets how many are."
    return text


def _cluster_section(clusters: FailureClusters) -> views.ResultPart:
    """Return the part of the page about the kinds of failures.

    Kinds are clusters of failures. It states how many clusters there are, and has the
    most typical image of each.
    """
    pictures = []
    for cluster in clusters.listed:
        common_labels = list(cluster.labels.items())[:MAX_LABELS]
        labels = ", ".join(f"{label} {count}" for label, count in common_labels)
        pictures.append(views.Picture(cluster.picture, f"{cluster.failures}: {labels}"))
    text = _describe_clusters(clusters)
    return views.ResultPart("Kinds of failures", [text], pictures=[pictures])


def _describe_clusters(clusters: FailureClusters) -> str:
    """Describe in a sentence how many kinds of failures there are."""
    failures = f"the {clusters.failures} failures that were rendered again"
    has_multiple_clusters = clusters.silhouette is not None  # one cluster has none
    if not has_multiple_clusters:
        # `features` describes where they come from: "the input of head (Linear)"
        return f"One kind: {failures} are alike by {clusters.features}."
    reservation = ""
    if not clusters.are_separated:
        reservation = (
            "; the kinds merge into each other: random points without clusters may "
            "be separated as well"
        )
    return (
        f"{len(clusters.listed)} kinds among {failures}, by {clusters.features} "
        f"(silhouette {clusters.silhouette:.2f}{reservation})."
    )


def make_explain_claims(result: ExplainResult) -> Iterator[views.Claim]:
    """Yield what is claimed of the rules and of the envelope.

    The envelope is a box of values inside which the model has the required accuracy.
    """
    for number, rule in enumerate(result.rules, 1):
        yield _make_rule_claim(number, rule)
    box = result.envelope
    if box is not None and box.confirmed and box.total:
        yield _make_envelope_claim(box)
    elif not result.rules:
        reason = "no box of values is confirmed to have the required accuracy"
        statement = f"Nothing is claimed: {reason}. {describe_envelope(result)}"
        yield views.Claim(kind="nothing claimed", statement=statement, extent=None)


def _make_rule_claim(number: int, rule: RuleRow) -> views.Claim:
    """Return what is claimed of a rule.

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
        "configurations that did not choose this box; only configurations that the "
        "sweeps sampled were tested."
    )
    return views.Claim(kind="measured", statement=statement, extent=extent)
