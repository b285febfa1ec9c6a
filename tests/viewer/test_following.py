"""A run that goes on, as the dashboard follows it: what is new in its rows, and when its page is shown."""

import json
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np

from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import CachedEvaluation, Row
from advsearch.viewer.server import FIRST_ROW_ID, is_unfinished, make_progress_json
from stored_sweeps import described, serving


def step(run: RunDirectory, number: int, *, picture: bool = True) -> None:
    """What a search leaves of one evaluation."""
    shown = np.full((4, 4, 3), 20 * number, np.uint8) if picture else None
    told = CachedEvaluation(number, b"", 0, 1, gradient=np.zeros(5, np.float32), picture=shown)
    values = {"pose.yaw": described(10.0 * number, "degrees")}
    run.append_rows(
        Row("search", number, objective=float(number), success=False, label="mug", values=values), cached=told
    )


def news(run: Path, after: int = FIRST_ROW_ID) -> dict[str, Any]:
    found = json.loads(make_progress_json(run, after))
    assert isinstance(found, dict)
    return found


def test_what_is_new_is_told_once(tmp_path: Path) -> None:
    with RunDirectory.create_for(AttackConfig(object="mug", run=str(tmp_path / "run"))) as run:
        for number in range(3):
            step(run, number, picture=number != 1)
        first = news(run.path)
        assert [(row["kind"], row["step"], row["objective"]) for row in first["rows"]] == [
            ("search", 0, 0.0), ("search", 1, 1.0), ("search", 2, 2.0),
        ]  # fmt: skip
        assert first["rows"][2]["values"] == {"pose.yaw": [20.0, "degrees"]}
        assert [one["step"] for one in first["pictures"]] == [0, 2]
        assert first["pictures"][0]["picture"].startswith("data:image/jpeg;base64,")
        assert first["running"] and not first["ended"]
        again = news(run.path, first["next"])
        assert again["rows"] == again["pictures"] == [] and again["next"] == first["next"]
        step(run, 3)
        run.append_rows(Row("baseline", 0, objective=float("nan"), values={"pose.yaw": described(float("inf"))}))
        later = news(run.path, again["next"])
        assert [(row["kind"], row["objective"]) for row in later["rows"]] == [("search", 3.0), ("baseline", None)]
        assert [one["step"] for one in later["pictures"]] == [3]
    assert not news(tmp_path / "run")["running"]


def test_its_own_page_is_shown_when_it_has_ended(tmp_path: Path) -> None:
    path = tmp_path / "run"
    with RunDirectory.create_for(AttackConfig(object="mug", run=str(path))) as run, serving(path) as server:
        step(run, 0)
        address = f"{server.address}runs/run/"
        with urlopen(address) as answer:
            page = answer.read().decode()
        assert "has not ended" in page and "A process is working on it." in page and "1 of search" in page
        with urlopen(f"{address}progress?after={FIRST_ROW_ID}") as answer:
            assert answer.headers["Content-Type"] == "application/json"
            assert len(json.load(answer)["rows"]) == 1
        (path / "report.html").write_text("what came out")
        assert is_unfinished(path)  # an attack that is resumed has the page of its first sitting
        run.store.delete_cached()
        assert not is_unfinished(path) and news(path)["ended"]
        with urlopen(address) as answer:
            assert answer.read().endswith(b"what came out")
