"""Results: what every one of them promises, whatever the command."""

from __future__ import annotations

import json
import math
from typing import ClassVar

from advsearch.cli.output import shown_text as plan_text
from advsearch.questions.plan.answer import DenoiserAdvice, EstimatorLimit, PlanResult
from advsearch.runs.results.base import Fields, Interval, JsonFloat, Result


class Inner(Fields):
    value: JsonFloat
    interval: Interval


class Outer(Result):
    command: ClassVar[str] = "outer"

    inner: Inner | None
    extra: int | None = None


class Measured:
    value, interval, more = math.inf, (0.0, math.nan), "passed over"


def test_a_result_is_json_without_what_was_not_asked_for_and_reads_back() -> None:
    result = Outer(inner=Inner.of(Measured()))
    written = json.dumps(result.to_dict(), allow_nan=False)
    assert written == '{"schema": 1, "command": "outer", "inner": {"value": null, "interval": [0.0, null]}}'
    again = Outer.of(json.loads(written))
    assert again.inner is not None and math.isnan(again.inner.value) and again.extra is None
    assert Outer(inner=None, extra=3).to_dict() == {"schema": 1, "command": "outer", "inner": None, "extra": 3}


def test_limits_of_a_plan_are_sentences() -> None:
    advice = DenoiserAdvice(asked="oidn", advised="oidn", reason="")
    limit = EstimatorLimit(what="a mirror's reflections stay", measured="as far as that")
    formation = {"denoiser": "oidn", "filter": "box", "sampler": "independent", "exposure": 0.0, "gain": 1.0}
    plan = PlanResult.of(
        {
            **{name: [] for name in ("controls", "not_measured", "groups", "cosines", "left_out")},
            **{name: "" for name in ("object", "environment", "model", "ending", "command_line")},
            "run": "runs/mug-plan-001",
            "seconds": {"total": 1.0},
            "seed": 0,
            "image_formation": {**formation, "resolution": [8, 8]},
            "renders_per_gradient": 0,
            "spp": 1,
            "denoise": advice,
            "specialised": False,
            "limits": [limit],
        }
    )
    assert "Limits of the material form\na mirror's reflections stay\n" in plan_text(plan)
