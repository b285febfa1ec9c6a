"""Compare a model's predictions about photographs with those about their renders."""

from __future__ import annotations

from typing import Any

from advsearch.extend import PositionalArgument, RunContext, experiment
from advsearch.questions.twins.result import (
    TwinsConfig,
    TwinsResult,
    make_twins_claims,
    make_twins_view,
)


@experiment(
    "twins data/lmo --model classifier.pt2 --name obj_000005=can",
    "twins photographs.csv --task detection --model detector.pt2 --json",
    positional_args=("photographs",),
    about="photographs",
    positional=PositionalArgument("PHOTOGRAPHS", "a folder in BOP's form, or a list"),
    python_arguments="advsearch.questions.twins.carry_out:run_twins",
    view=make_twins_view,
    claims=make_twins_claims,
)
def twins(context: RunContext[TwinsConfig], network: Any = None) -> TwinsResult:
    """Measure how far a model's verdicts on renders hold for photographs.

    Args:
        photographs: a folder in BOP's form, or a list (docs/twins.md).
    """
    # imports torch
    from advsearch.questions.twins.carry_out import run_twins

    return run_twins(context, network=network)
