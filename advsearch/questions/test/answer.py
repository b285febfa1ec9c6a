"""The result of `test`."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.runs.results.base import Fields, Interval, JsonFloat, RunResult

HELD, UNDECIDED, FAILED = "held", "undecided", "failed"
ANSWERS = (HELD, UNDECIDED, FAILED)
"""From the best to the worst."""

STATUS = {HELD: 0, FAILED: 1, UNDECIDED: 2}
"""Exit status of the command, by what the suite says as a whole."""


class ClaimAnswer(Fields):
    """One claim, or one counterexample, and what came out."""

    name: str = Field(description="in the suite; of a counterexample, its file's")
    kind: str = Field(description="`right`, `not_broken`, `no_worse` or `counterexample`")
    statement: str = Field(description="what is claimed, in words")
    answer: str = Field(description="`held`, `failed` or `undecided`")
    reason: str = Field(description="why, with the numbers")
    expected: str = Field(HELD, description="what it said when `update` was given last; absent for `held`")
    pictures: int = Field(0, description="that it took; absent if none")
    rate: JsonFloat | None = Field(
        None, description="share of right answers, or the difference of two models; absent of a search"
    )
    interval: Interval | None = Field(None, description="that holds at all times together, at the suite's confidence")
    spp: int | None = Field(None, description="samples a pixel of the pictures; absent of a search")
    picture: str | None = Field(None, description="a picture that the model gets wrong, in the run's folder")
    part: str | None = Field(None, description="the run in `parts` that has the search; absent without one")
    repeat: str = Field("", description="the command that repeats it; absent where there is none")
    seconds: JsonFloat = Field(0.0, description="that it took")

    @property
    def accepted(self) -> bool:
        """Whether it is no worse than expected."""
        return ANSWERS.index(self.answer) <= ANSWERS.index(self.expected)


class SuiteResult(InNotebook, RunResult):
    """What the claims of a suite came to."""

    command: ClassVar[str] = "test"

    suite: str = Field(description="its file")
    title: str = Field(description="what it is about")
    object: str = Field(description="of all claims, with commas between them")
    model: str = Field(description="the model that the claims are about")
    answer: str = Field(
        description="`failed` if a claim is that was not expected to be, else `undecided` likewise, else `held`"
    )
    confidence: float = Field(description="of each claim that is decided by drawn pictures")
    claims: list[ClaimAnswer]
    added: str | None = Field(None, description="the file of the counterexample that was added; only with `add`")
    changes: list[str] = Field([], description="what is expected from now on; only with `update`")
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
        """How many claims were held, failed and undecided."""
        counts = {answer: sum(one.answer == answer for one in self.claims) for answer in (HELD, FAILED, UNDECIDED)}
        return ", ".join(f"{count} {answer}" for answer, count in counts.items() if count)

    @property
    def status(self) -> int:
        """Exit status of the command."""
        return 0 if self.added is not None else STATUS[self.answer]


def verdict(claims: list[ClaimAnswer]) -> str:
    """Return what a suite says as a whole: the worst of what was not expected."""
    worse = [one.answer for one in claims if not one.accepted]
    return max(worse, key=ANSWERS.index, default=HELD)


RESULT = SuiteResult
