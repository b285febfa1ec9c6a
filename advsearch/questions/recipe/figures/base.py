"""What every kind of figure is: options, numbers made from the answers, sentences about these, and a drawing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from advsearch.attacks import clopper_pearson
from advsearch.explanations.observations import TRIAL
from advsearch.questions.recipe.answer import NamedCount, RecipeFigure
from advsearch.questions.recipe.table import Table, counted
from advsearch.report.phrases import percent
from advsearch.report.wording import interval_text

CONFIDENCE = 0.95


class Options(BaseModel):
    """Options that every figure has.

    Attributes:
        title: over it; made from the other options where it is empty.
        of: the parts whose answers it shows; all where none is named.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str = Field(default="", max_length=200)
    of: tuple[str, ...] = ()

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts whose answers it is made from; none for all that were rendered."""
        return self.of


Chosen = TypeVar("Chosen", bound=Options)
FigureType = TypeVar("FigureType", bound=RecipeFigure)


@dataclass(frozen=True)
class FigureKind(Generic[Chosen, FigureType]):
    """One kind of figure.

    Attributes:
        options: that it takes.
        result: its numbers.
        compute: makes these from the answers.
        draw: draws them on a figure of matplotlib; it may look into the recipe's folder.
        size: of that, width and height in inches.
        tells_models: whether it tells several models apart by itself; of others each model has one.
    """

    options: type[Chosen]
    result: type[FigureType]
    compute: Callable[[Table, Chosen], FigureType]
    draw: Callable[[FigureType, Any, Path], None]
    size: Callable[[FigureType], tuple[float, float]]
    tells_models: bool = False


def rate_with_interval(one: NamedCount, verb: str = "right") -> str:
    """Return ``right in 12 of 20 (60 %, 95 % interval 36-81 %)``; `verb` is what is counted."""
    return (
        f"{verb} in {one.correct} of {one.configurations} "
        f"({percent(one.accuracy)}, 95 % interval {interval_text(one.interval)})"
    )


def extremes(counts: Sequence[NamedCount], worst: str, best: str, thing: str, verb: str = "right") -> list[str]:
    """Return which of several has the lowest accuracy and which the highest, and whether that is more than chance.

    The two were chosen among k for being extreme, so that they are compared by intervals of confidence 1 - 0.05 / k,
    which hold for all k together (Bonferroni). Where these overlap, no difference is shown.

    Args:
        counts: of each.
        worst: what the lowest is called: "Hardest".
        best: what the highest is called: "easiest".
        thing: what they are, for several of them: "environments".
        verb: what is counted.
    """
    known = [one for one in counts if one.configurations]
    if len(known) < 2:
        return [f"{one.name}: {rate_with_interval(one, verb)}." for one in known]
    low, high = (pick(known, key=lambda one: one.accuracy or 0.0) for pick in (min, max))
    if low.accuracy == high.accuracy:
        return [f"All {len(known)} {thing} have the same share, {percent(low.accuracy)}: no difference is shown."]
    least, most = rate_with_interval(low, verb), rate_with_interval(high, verb)
    said = f"{worst} {_tied(low, known)}: {least}; {best} {_tied(high, known)}: {most}."
    widened = f"the intervals of the two, widened for having been chosen among {len(known)},"
    if intervals_apart(low, high, len(known)):
        return [said, f"The difference is shown: {widened} do not overlap."]
    return [said, f"No difference between the {thing} is shown: {widened} overlap."]


def _tied(one: NamedCount, counts: Sequence[NamedCount]) -> str:
    """``is kitchen``, and where others have the same share ``is kitchen (as 2 others)``."""
    others = sum(other.accuracy == one.accuracy for other in counts) - 1
    return f"is {one.name}" + (f" (as {others} other{'s' if others > 1 else ''})" if others else "")


def intervals_apart(low: NamedCount, high: NamedCount, among: int = 1) -> bool:
    """Return whether the intervals of two rates do not overlap, each widened for a choice among so many."""
    confidence = 1.0 - (1.0 - CONFIDENCE) / max(among, 1)
    _, top = clopper_pearson(low.correct, low.configurations, confidence)
    bottom, _ = clopper_pearson(high.correct, high.configurations, confidence)
    return top < bottom


def counted_by(table: Table, column: str) -> list[NamedCount]:
    """Return how often the model is right, by what rows have in a column."""
    return [counted(name, rows) for name, rows in table.by(column).items()]


def plural(column: str) -> str:
    """Return what several values of a column are called: ``environments``, ``materials``, ``values of pose.yaw``."""
    if column == TRIAL:
        return "kinds of trials"
    control, _, parameter = column.partition(".")
    return f"values of {column}" if parameter not in ("", "which") else f"{control}s"
