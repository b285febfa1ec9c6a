"""The result of `harden`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

from pydantic import Field

from advsearch.report import wording
from advsearch.report.figures import BLUE, RED, Figures, drawn
from advsearch.report.markup import InNotebook
from advsearch.report.shown import NO_PROOF, AnswerPart, Claim, Column, Extent, ShownAnswer, claim, share_text
from advsearch.report.wording import percent
from advsearch.runs.results import Fields, Interval, RunResult, SharedWork


class Share(Fields):
    """A share of right answers."""

    accuracy: float = Field(description="`right` of `count`")
    interval: Interval
    right: int
    count: int


class HardenedControl(Fields):
    """Robust accuracy over the held-out scenes against searches over one control."""

    control: str
    before: Share
    stronger_before: Share | None = Field(
        default=None, description="before, against the search `stronger_search`; absent from runs of older versions"
    )
    after: Share
    stronger: Share = Field(description="after, against the search `stronger_search`")


class TrainingRound(Fields):
    """One round of search and training, judged on scenes of the training's environments that it was not trained on."""

    lessons: int = Field(description="views that it was trained on")
    part: float = Field(description="of the way from the weights that were given to the trained ones, in 0 to 1")
    clean: float = Field(description="share of plain pictures that are right")
    robust: float = Field(description="share of the worst pictures, searched for against these weights")
    kept: bool = Field(description="whether its weights are the answer")


class SplitSide(Fields):
    """What one side of the split consists of; no object and, held out, no environment is on two sides."""

    objects: list[str]
    environments: list[str]
    scenes: int = Field(description="of those held out, a fourth is attacked")
    views: int


class HardenResult(InNotebook, RunResult):
    """How robust a model was, and how robust it is after training on worst cases."""

    command: ClassVar[str] = "harden"

    objects: list[str]
    model: str
    task: str = Field(description="what judges the answers")
    before: Share | None = Field(
        description="held-out scenes that are right and in which no search over any control has found a wrong answer; "
        "null if it was interrupted, as are the others"
    )
    after: Share | None = Field(description="the same, of the hardened model, searched again")
    clean_before: Share | None = Field(description="plain renders of held-out scenes that are right")
    clean_after: Share | None
    table: list[HardenedControl]
    search: str = Field(description="policy and steps of the searches of `before` and `after`")
    stronger_search: str = Field(description="another policy with three times the steps")
    split: dict[str, SplitSide] = Field(description="by side: `training`, `further training`, `validation`, `held out`")
    rounds: list[TrainingRound]
    hardened: str | None = Field(description="what `model` takes to load the hardened one; null if nothing was kept")
    weights: str | None = Field(description="the hardened weights, safetensors")
    pictures: str | None = Field(description="folder of the pictures of the training, a folder for each class")
    shared: SharedWork | None = Field(
        default=None, description="how [workers](cluster.md) did that shared the work; absent without"
    )
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
        """How many scenes were robust and are."""
        if self.before is None or self.after is None:
            return ""
        return f"robust in {self.after.right} of {self.after.count} scenes, before {self.before.right}"


RESULT = HardenResult


ROBUST = (
    "Robust: the plain picture of a held-out scene is right, and the search finds no wrong one. 95 % Clopper-Pearson "
    "intervals over scenes."
)
TRAINED = (
    "Round 0 is the model as it was. Weights are part of the way from those to the trained ones. Judged on scenes in "
    "the training's environments on which it was not trained."
)

HEADS = ("on held-out scenes", "before", "95 % interval", "after", "95 % interval")


def shown(result: HardenResult) -> ShownAnswer:
    """Return how robust the model was and is, what it was trained on, and what never was."""
    rounds: Mapping[str, Column] = {
        "round": "{0[0]}",
        "views trained on": "{0[1].lessons}",
        "part of the way": lambda one: percent(one[1].part),
        "plain pictures right": lambda one: percent(one[1].clean),
        "worst pictures right": lambda one: percent(one[1].robust),
        "kept": lambda one: "yes" if one[1].kept else "",
    }
    split: Mapping[str, Column] = {
        "side": "{0[0]}",
        "objects": lambda one: ", ".join(one[1].objects),
        "environments": lambda one: ", ".join(one[1].environments),
        "scenes": "{0[1].scenes}",
        "views": "{0[1].views}",
    }
    facts = {
        "model": result.model,
        "searched with": result.search,
        "stronger": result.stronger_search,
        "load it with": f"model={result.hardened}" if result.hardened else "",
        "weights": result.weights or "",
        "pictures": result.pictures or "",
    }
    before, after, clean, left = result.before, result.after, result.clean_before, result.clean_after
    said = "Stopped before the hardened model was measured."
    if before is not None and after is not None and clean is not None and left is not None:
        said = (
            f"Of {after.count} held-out scenes the searches leave {after.right} right, before {before.right}; "
            f"of {left.count} plain pictures {left.right} are right, before {clean.right}."
        )
    sections = [
        AnswerPart(
            "Before and after", heads=HEADS, rows=hardened_rows(result), note=ROBUST, figure="images/harden.png"
        ),
        AnswerPart.table(enumerate(result.rounds), rounds, title="The training", note=TRAINED, only="page"),
        AnswerPart.table(result.split.items(), split, title="What it was trained and measured on", only="page"),
    ]
    return ShownAnswer(said, sections, facts, about=[",".join(result.objects), ", ".join(result.controls)])


def claims(result: HardenResult) -> Iterator[Claim]:
    """Yield the shares of held-out scenes without a failure."""
    for when, share in (("Before", result.before), ("After hardening", result.after)):
        if share is not None:
            extent = Extent(what="held-out scenes", count=share.right, total=share.count, interval=share.interval)
            text = f"{when}, the searches ({result.search}) found no failure in {share_text(extent)} held-out"
            yield claim("measured", f"{text} scenes. {NO_PROOF}", extent)


def hardened_rows(result: HardenResult) -> list[list[str]]:
    """Return two rows for each control, one of each search; one for all of them where there are several; and one for
    plain pictures."""

    def cells(share: Share | None) -> tuple[str, str]:
        return ("", "") if share is None else (percent(share.accuracy), wording.interval_text(share.interval))

    return [[name, *cells(before), *cells(after)] for name, before, after in _shares(result)]


def _shares(result: HardenResult) -> list[tuple[str, Share | None, Share | None]]:
    """What was measured, before and after."""
    shares = list[tuple[str, Share | None, Share | None]]()
    for row in result.table:
        shares.append((f"robust to {row.control}", row.before, row.after))
        shares.append((f"robust to {row.control}, stronger search", row.stronger_before, row.stronger))
    if len(result.table) > 1:
        shares.append(("robust to each", result.before, result.after))
    if result.clean_after is not None:
        shares.append(("plain pictures right", result.clean_before, result.clean_after))
    return shares


def hardened_figure(result: HardenResult) -> Figures:
    """Draw each share before and after with its interval; nothing where none is known."""
    shares = _shares(result)
    if not shares:
        return {}

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        for place, (_, *of_each) in enumerate(shares):
            for label, colour, share, shift in zip(
                ("before", "after"), (RED, BLUE), of_each, (-0.14, 0.14), strict=True
            ):
                if share is not None:
                    axes.plot(share.interval, [place + shift] * 2, color=colour, alpha=0.35, linewidth=5)
                    axes.plot(share.accuracy, place + shift, "o", color=colour, ms=4, label=None if place else label)
        axes.set_yticks(range(len(shares)), [name for name, *_ in shares])
        axes.invert_yaxis()
        axes.set(xlabel="share that is right, with 95 % interval", xlim=(-0.03, 1.03))
        axes.set_title(f"Held-out scenes: {wording.short_name(result.model)}")
        axes.grid(True, axis="x")
        figure.legend(loc="outside lower center", ncols=2)

    return drawn(draw, (6.4, 1.4 + 0.45 * len(shares)))
