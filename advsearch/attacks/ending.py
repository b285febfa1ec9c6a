"""How a search ended, and what a run may say about it."""

from __future__ import annotations

from enum import Enum


class Ending(Enum):
    """Why a search or a run stopped. The value is what JSON holds; `explanation` is one sentence for a person.

    A search ends with a claim at most; only `verify` makes it `FOUND` (docs/design.md, "Verification").
    """

    FOUND = "found"
    BUDGET_SPENT = "budget spent"
    NOT_VERIFIED = "not verified"
    ALREADY_WRONG = "already wrong"
    STALLED = "stalled"
    NON_FINITE = "non-finite objective"
    INTERRUPTED = "interrupted"

    @property
    def explanation(self) -> str:
        """One sentence that says what happened."""
        return _EXPLANATIONS[self]


_EXPLANATIONS = {
    Ending.FOUND: "A configuration inside the budget makes the model answer wrongly.",
    Ending.BUDGET_SPENT: "All renders were spent and no configuration made the model answer wrongly.",
    Ending.NOT_VERIFIED: "The search claimed a wrong answer, but it did not hold in the trials with fresh seeds.",
    Ending.ALREADY_WRONG: "The model is wrong on the clean configuration already, so there is nothing to attack.",
    Ending.STALLED: "The policy had nothing more to propose before the budget was spent.",
    Ending.NON_FINITE: "The objective was NaN or infinite several times in a row.",
    Ending.INTERRUPTED: "The search was interrupted; the best configuration so far was kept.",
}
