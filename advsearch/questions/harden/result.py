"""The settings of `harden`, its result, and the views of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, ClassVar, Literal

from pydantic import Field, JsonValue, model_validator

from advsearch.extend import (
    AttackConfig,
    RunResult,
    figures,
    results,
    setting,
    setting_as_in,
    views,
    wording,
)

STEPS = 40
"""Default number of steps of a search, as for an attack."""
ALL_OBJECTS = "all"
"""Value of `object` that stands for all bundled objects."""
PLAIN_SCENES = 6
"""Number of further scenes for each training scene, with one plain view each.

With fewer, the training generalizes worse to other scenes, and loses clean accuracy.
"""
RENDERED_SCENES = 15
"""The same if controls are rendered: the view is rendered at random configurations."""

TEXTURE_USES_PER_EPOCH = 6
"""How often an epoch uses a scene with a texture, counted over all of its views.

The texture is different each time, while a rendered image stays the same.
"""

QUICK: dict[str, int] = {
    "rounds": 1,
    "scenes": 14,
    "views": 2,
    "epochs": 6,
    "measured": 14,
    "steps": 20,
}
"""Defaults of settings with `quick`: minutes instead of an hour."""


class HardenConfig(AttackConfig):
    """Settings of `harden`: training on worst cases, measured before and after."""

    # fmt: off
    command: ClassVar[str] = "harden"
    list_settings: ClassVar[tuple[str, ...]] = ("object", "environment")
    excluded_settings: ClassVar[tuple[str, ...]] = (
        "smallest", "ensemble", "printable", "aov", "metrics", "log", "target",
        "minimise", "over", "draws", "path", "shutter", "rolling", "average",
        "baseline", "seconds", "camera", "up", "facing", "size", "unit", "label",
        "measure", "estimators", "things", "judge", "backdrop", "occluder",
        "twins",
    )

    object: str = setting_as_in(
        AttackConfig, "object", default=ALL_OBJECTS,
        description="objects to train on, separated by commas; all stands for every "
                    "bundled object that the model has a class for; a file is named "
                    "after its class: coffee-mug.glb",
    )
    environment: str | None = setting_as_in(
        AttackConfig, "environment",
        description="environments of the training, separated by commas; each scene has "
                    "one of them at random",
        otherwise="the bundled environments that the reference model was trained in",
    )
    held_out: str | None = setting(
        None, "scene", "objects for the measurement, which are not trained on, "
                       "separated by commas",
        "names of objects or files", otherwise="other instances of the bundled objects",
        min_length=1,
    )
    held_out_environment: str | None = setting(
        None, "scene", "environments of the measurement, which are not trained on",
        "names of environments or files, separated by commas",
        otherwise="the bundled environments that the reference model was not trained in",
        min_length=1,
    )
    task: str | dict[str, JsonValue] = setting_as_in(
        AttackConfig, "task", description="what the model does: classification, "
                                          "detection or segmentation"
    )
    data: str | None = setting(
        None, "training", "your own pictures that a detector is also trained on: "
                          "`annotations.json` and `images/`",
        "a folder such as that of `export --format coco`", otherwise="none", min_length=1,
    )
    layers: Literal["all", "last"] = setting("all", "training", "layers that are trained")
    rounds: int = setting(2, "training", "rounds of search and training", ge=1, le=1000)
    scenes: int = setting(
        336, "training",
        "number of new scenes per round for each control; controls that are rendered "
        f"have {RENDERED_SCENES + 1} times as many",
        ge=1, le=100_000,
    )
    views: int = setting(2, "training", "views of each scene with a texture", ge=1, le=1000)
    epochs: int = setting(
        3, "training",
        "number of epochs of a round; an epoch uses each view once, and a scene with a "
        f"searched texture up to {TEXTURE_USES_PER_EPOCH} times over its views",
        ge=1, le=10_000,
    )
    rate: float = setting(1e-3, "training", "the maximum learning rate", gt=0.0, le=1.0)
    clean_loss: float = setting(
        0.02, "training", "maximum loss of clean accuracy; weights that lose more are "
                          "not used", ge=0.0, le=1.0
    )
    measured: int = setting(28, "verification", "held-out scenes that are attacked, "
                                                "before and after", ge=1, le=100_000)
    steps: int = setting_as_in(AttackConfig, "steps", default=STEPS, otherwise="")
    trials: int | None = setting_as_in(AttackConfig, "trials", default=6)
    verify_spp: int | None = setting_as_in(AttackConfig, "verify_spp", default=32)
    workers: int | None = setting_as_in(
        AttackConfig, "workers", description="number of worker processes, which share "
                                             "the scenes to render and to attack"
    )
    quick: bool = setting(False, "training", "minutes instead of an hour: fewer "
                                             "rounds, scenes and steps")
    # fmt: on

    @model_validator(mode="before")
    @classmethod
    def _apply_quick(cls, data: Any) -> Any:
        """Fill in the defaults of `quick`; settings that are set stay."""
        return {**QUICK, **data} if data.get("quick") is True else data

    @property
    def texture_uses_per_epoch(self) -> int:
        """How often an epoch uses each view of a scene with a texture."""
        return max(1, TEXTURE_USES_PER_EPOCH // self.views)

    @property
    def run_name_words(self) -> tuple[str, ...]:
        return self.command, *self.controls


class Share(results.Fields):
    """The fraction of right predictions with its interval."""

    accuracy: float = Field(description="`right` / `count`")
    interval: results.Interval = Field(
        description="95 % interval of the accuracy, over scenes of the same objects"
    )
    right: int
    count: int
    outcomes: results.Outcomes = results.optional_field(
        f"of plain pictures, {results.OUTCOME_TEXT} in the other ones; "
        f"{results.ONLY_OF_BOXES}"
    )


class HardenedControl(results.Fields):
    """Robust accuracy over the held-out scenes against searches over one control."""

    control: str
    before: Share
    stronger_before: Share = Field(
        description="`before`, but against the search `stronger_search`"
    )
    after: Share
    stronger: Share = Field(
        description="`after`, but against the search `stronger_search`"
    )


class TrainingRound(results.Fields):
    """One round of search and training.

    It is evaluated on other scenes, with environments of the training.
    """

    lessons: int = Field(description="number of views that it was trained on")
    part: float = Field(
        description="interpolation between the original weights (0) and the trained "
        "weights (1)"
    )
    clean: float = Field(description="fraction of plain pictures that are right")
    robust: float = Field(
        description="fraction of the worst pictures that are right; these were searched "
        "against the weights of the round"
    )
    is_selected: bool = Field(description="whether its weights are the result")


class SplitSide(results.Fields):
    """One part of the split of scenes.

    No environment is in the held-out part and in another one, and no instance of an
    object.
    """

    objects: list[str]
    environments: list[str]
    scenes: int = Field(
        description="number of scenes; of the held-out ones, a fourth is attacked"
    )
    views: int = Field(description="number of views of each scene")


class HardenResult(views.InNotebook, RunResult):
    """How robust a model was, and how robust it is after training on worst cases."""

    command: ClassVar[str] = "harden"

    objects: list[str]
    model: str
    task: str = Field(description="the task of the model")
    before: Share | None = Field(
        description="held-out scenes that are right, and in which no search over any "
        "control has found a wrong prediction; null after an interrupt, as are the "
        "following fields"
    )
    after: Share | None = Field(
        description="the same for the hardened model, which was searched anew"
    )
    clean_before: Share | None = Field(
        description="plain renders of held-out scenes that are right"
    )
    clean_after: Share | None = Field(description="the same for the hardened model")
    gained: int | None = Field(
        default=None,
        description="number of held-out scenes that are robust only after the training; "
        "null after an interrupt",
    )
    lost: int | None = Field(
        default=None,
        description="number of held-out scenes that were robust only before the "
        "training; null after an interrupt",
    )
    p: float | None = Field(
        default=None,
        description="p-value of McNemar's exact test over scenes: the probability of "
        "such a difference between `gained` and `lost` by chance. It holds for further "
        "scenes of the same objects, and not for other objects",
    )
    table: list[HardenedControl]
    search: str = Field(
        description="policy and steps of the searches for `before` and `after`"
    )
    stronger_search: str = Field(
        description="policy and steps of the stronger search: another policy with three "
        "times the steps"
    )
    split: dict[str, SplitSide] = Field(
        description="the parts of the split: `training`, `further training`, "
        "`validation`, `held out`"
    )
    rounds: list[TrainingRound]
    hardened: str | None = Field(
        description="value of `model` that loads the hardened model; null if no name "
        "can load it, or after an interrupt"
    )
    weights: str | None = Field(
        description="file of the hardened weights, safetensors; null after an interrupt"
    )
    pictures: str | None = Field(
        description="folder of the pictures of the training, with a folder for each "
        "class; null after an interrupt"
    )
    shared: results.SharedWork | None = Field(
        default=None,
        description="how [workers](cluster.md) shared the work; null without workers",
    )
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def outcome_summary(self) -> str:
        """How many scenes are robust after and before; empty if that is unknown."""
        if self.before is None or self.after is None:
            return ""
        return (
            f"robust in {self.after.right} of {self.after.count} scenes, before "
            f"{self.before.right}"
        )


ROBUST_NOTE = (
    "Robust: the plain picture of a held-out scene is right, and the search finds no "
    "wrong one. 95 % intervals over scenes: Clopper-Pearson; for plain pictures, of "
    "which each scene has two, by betting. The scenes have the named objects: intervals "
    "and p do not hold for other objects."
)
TRAINING_NOTE = (
    "Round 0 is the original model. Weights are interpolated between the original and "
    "the trained ones. They are evaluated on scenes that were not trained on, with "
    "environments of the training."
)
HEADS = ("on held-out scenes", "before", "95 % interval", "after", "95 % interval")
ROUND_COLUMNS: Mapping[str, views.Column] = {
    "round": "{0[0]}",
    "views trained on": "{0[1].lessons}",
    "interpolation": lambda row: wording.percent(row[1].part),
    "plain pictures right": lambda row: wording.percent(row[1].clean),
    "worst pictures right": lambda row: wording.percent(row[1].robust),
    "kept": lambda row: "yes" if row[1].is_selected else "",
}
SPLIT_COLUMNS: Mapping[str, views.Column] = {
    "side": "{0[0]}",
    "objects": lambda row: ", ".join(row[1].objects),
    "environments": lambda row: ", ".join(row[1].environments),
    "scenes": "{0[1].scenes}",
    "views": "{0[1].views}",
}

ShareChanges = Mapping[str, tuple[Share | None, Share | None]]
"""Fractions before and after the training, by a description."""


def make_harden_view(result: HardenResult) -> views.ShownResult:
    """Return the view of a hardening.

    The page has all tables; the terminal has the text, the facts and the first table.
    """
    sections = [_make_robustness_part(result), *_make_training_parts(result)]
    return views.ShownResult(
        _summarize(result),
        sections,
        _list_facts(result),
        about=[",".join(result.objects), ", ".join(result.controls)],
    )


def _list_facts(result: HardenResult) -> dict[str, str]:
    """Return the model, the searches and the files of the run, by what they are."""
    return {
        "model": result.model,
        "searched with": result.search,
        "stronger": result.stronger_search,
        "load it with": f"model={result.hardened}" if result.hardened else "",
        "weights": result.weights or "",
        "pictures": result.pictures or "",
    }


def _make_training_parts(result: HardenResult) -> list[views.ResultPart]:
    """Return the table of the rounds and that of the split of scenes."""
    return [
        views.ResultPart.make_table(
            enumerate(result.rounds),
            ROUND_COLUMNS,
            title="The training",
            note=TRAINING_NOTE,
            only_medium="page",
        ),
        views.ResultPart.make_table(
            result.split.items(),
            SPLIT_COLUMNS,
            title="What it was trained and measured on",
            only_medium="page",
        ),
    ]


def _make_robustness_part(result: HardenResult) -> views.ResultPart:
    """Return the table of fractions before and after, with a chart if it has rows."""
    shares = _list_shares(result)
    rows = [
        [name, *_share_cells(before), *_share_cells(after)]
        for name, (before, after) in shares.items()
    ]
    return views.ResultPart(
        "Before and after",
        column_heads=HEADS,
        rows=rows,
        note=ROBUST_NOTE,
        height=110 + 44 * len(shares),
        **_make_share_chart(shares, result.model),
    )


def _make_share_chart(shares: ShareChanges, model: str) -> dict[str, Any]:
    """Return the fields of a part with a chart of fractions; none without fractions."""
    if not shares:
        return {}
    return {
        "draw": partial(_draw_shares, shares=shares, model=model),
        "size": (6.4, 1.4 + 0.45 * len(shares)),
    }


def _list_shares(
    result: HardenResult,
) -> dict[str, tuple[Share | None, Share | None]]:
    """Return the fractions of right images before and after, by a description."""
    shares: dict[str, tuple[Share | None, Share | None]] = {}
    for row in result.table:
        shares[f"robust to {row.control}"] = (row.before, row.after)
        shares[f"robust to {row.control}, stronger search"] = (
            row.stronger_before,
            row.stronger,
        )
    if len(result.table) > 1:
        shares["robust to each"] = (result.before, result.after)
    if result.clean_after is not None:
        shares["plain pictures right"] = (result.clean_before, result.clean_after)
    return shares


def _share_cells(share: Share | None) -> list[str]:
    """Return a fraction and its interval as texts, empty ones if it is unknown."""
    if share is None:
        return ["", ""]
    return [wording.percent(share.accuracy), wording.format_interval(share.interval)]


def _draw_shares(axes: Any, shares: ShareChanges, model: str) -> None:
    """Draw fractions before and after as bars with intervals."""
    bars = {
        name: [
            None if share is None else (share.accuracy, share.interval)
            for share in before_and_after
        ]
        for name, before_and_after in shares.items()
    }
    figures.draw_fractions(axes, bars, ("before", "after"), (figures.RED, figures.BLUE))
    axes.set(xlabel="fraction that is right, with 95 % interval")
    axes.set_title(f"Held-out scenes: {wording.shorten_name(model)}")
    axes.figure.legend(loc="outside lower center", ncols=2)


def _summarize(result: HardenResult) -> str:
    """Describe in words how robust and how accurate the model was and is.

    The run may have stopped before all of it was measured.
    """
    before = result.before
    after = result.after
    clean_before = result.clean_before
    clean_after = result.clean_after
    if before is None or after is None or clean_before is None or clean_after is None:
        return "Stopped before the hardened model was measured."
    text = (
        f"Of {after.count} held-out scenes, {after.right} are robust to the searches, "
        f"before {before.right}; "
        f"of {clean_after.count} plain pictures {clean_after.right} are right, before "
        f"{clean_before.right}."
    )
    text += _describe_plain_outcomes("Now", clean_after, result.task)
    text += _describe_plain_outcomes("Before", clean_before, result.task)
    return text + _describe_changed_scenes(result)


def _describe_plain_outcomes(when: str, share: Share, task: str) -> str:
    """Describe what becomes of the object in plain images that are not right.

    The result begins with a space; it is empty if nothing is known about that.

    Args:
        when: "Now" or "Before".
        share: the fraction of plain images that are right.
        task: the task that evaluates the predictions.
    """
    outcomes = wording.format_outcomes(share.outcomes, task)
    return f" {when}, the other plain pictures are {outcomes}." if outcomes else ""


def _describe_changed_scenes(result: HardenResult) -> str:
    """Describe in how many scenes the model got better or worse, after a space.

    The text is empty if the scenes before and after cannot be compared one by one.
    """
    if result.lost is None:
        return ""
    return (
        f" Scene by scene: {result.gained} got better, {result.lost} worse "
        f"(p = {result.p:.2g}, for scenes of these objects and not for other "
        "objects)."
    )


def make_harden_claims(result: HardenResult) -> Iterator[views.Claim]:
    """Yield the fractions of held-out scenes without a failure, before and after."""
    for when, share in (("Before", result.before), ("After hardening", result.after)):
        if share is not None:
            yield _make_share_claim(when, share, result.search)


def _make_share_claim(when: str, share: Share, search: str) -> views.Claim:
    """Return the claim of how many held-out scenes have no failure.

    Args:
        when: "Before" or "After hardening".
        share: the scenes without a failure.
        search: description of the search.
    """
    extent = {
        "what": "held-out scenes",
        "count": share.right,
        "of": share.count,
        "interval": share.interval,
        "counts_right": True,
    }
    accuracy = wording.percent(share.accuracy)
    interval = wording.format_interval(share.interval)
    text = (
        f"{when}, the searches ({search}) found no failure in {share.right} of "
        f"{share.count} ({accuracy}, 95 % interval {interval}) held-out scenes. This "
        "does not show that there is none."
    )
    return views.Claim.from_values(
        {"kind": "measured", "statement": text, "extent": extent}
    )
