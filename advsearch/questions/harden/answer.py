"""The result of `harden`."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.runs.results.attack import SharedWork
from advsearch.runs.results.base import Fields, Interval, RunResult


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
