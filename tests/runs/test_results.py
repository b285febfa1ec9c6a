"""Results: what every one of them promises, whatever the command."""

import json
import math
import re
from pathlib import Path
from typing import ClassVar

from pydantic import Field, computed_field

from advsearch.cli.output import format_result as check_text
from advsearch.questions.attack.page import make_page as attack_page
from advsearch.questions.attack.summary import AttackSummary
from advsearch.runs.results import Fields, Interval, JsonFloat, Result, make_fact_schema
from samples import attack


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
    result = Outer(inner=Inner.from_values(Measured()))
    written = json.dumps(result.to_dict(), allow_nan=False)
    assert written == '{"schema": 2, "command": "outer", "inner": {"value": null, "interval": [0.0, null]}}'
    again = Outer.from_values(json.loads(written))
    assert again.inner is not None and math.isnan(again.inner.value) and again.extra is None
    assert Outer(inner=None, extra=3).to_dict() == {"schema": 2, "command": "outer", "inner": None, "extra": 3}


class Timed(AttackSummary):
    """An attack with two fields more: one that was measured, one that is computed from others."""

    picture_bytes: int | None = Field(default=None, description="of a picture", json_schema_extra=make_fact_schema())

    @computed_field(description="renders over seconds", json_schema_extra=make_fact_schema("{:.3g}"))  # type: ignore[prop-decorator]
    @property
    def renders_a_second(self) -> float:
        return sum(self.renders.values()) / self.seconds["total"]


def test_a_field_that_is_declared_as_a_fact_is_in_terminal_page_and_json(tmp_path: Path) -> None:
    earlier = attack().to_dict()
    old, new = Timed.from_values(earlier), Timed.from_values({**earlier, "picture_bytes": 768})
    assert "picture_bytes" not in old.to_dict() and new.to_dict()["picture_bytes"] == 768
    assert old.to_dict()["renders_a_second"] == Timed.from_values(old.to_dict()).renders_a_second == 101 / 14.6
    assert AttackSummary.from_values(new.to_dict()) == attack()
    page = attack_page(tmp_path, new)
    for name, text in (("picture bytes", "768"), ("renders a second", "6.92")):
        assert re.search(rf"^  {name} +{text}$", check_text(new), re.M)
        assert re.search(rf"<th[^>]*>{name.capitalize()}</th><td[^>]*>{text}</td>", str(page))
    assert "picture bytes" not in check_text(old)
