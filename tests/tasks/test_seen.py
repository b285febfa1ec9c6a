"""A task that judges by where the object is seen, and what is kept of its answers: in rows, exports and summaries."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.attacks import Query
from advsearch.engine.journal import Journal, ParallelEvaluator
from advsearch.engine.record import make_trial_row, read_judgement
from advsearch.models import load_model
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results import to_json_value
from advsearch.runs.store import Row, Store
from advsearch.tasks import Facts, Judgement, Prediction, Sight, Task


@dataclass(frozen=True, kw_only=True)
class Edge(Task):
    """Tell in which column the object begins, within a tolerance in pixels."""

    name = "edge"
    varies = True
    tolerance: float = 2.0

    def truth(self, facts: Facts) -> float:
        assert facts.box is not None and facts.mask[:, facts.box[0]].any() and not facts.mask[:, : facts.box[0]].any()
        return float(facts.box[0])

    def loss(self, output: Tensor, truth: float) -> Tensor:
        return (output[:, 0] - truth).abs() - self.tolerance

    def predictions(self, output: Tensor, count: int = 1) -> list[tuple[Prediction, ...]]:
        return [(Prediction("here"),) for _ in output]

    def payloads(self, output: Tensor) -> list[Any]:
        return [{"column": column, "boxes": [[column, 0.0, 16.0, 16.0]]} for column in output[:, 0]]


class Middle(nn.Module):
    """Answers with the column where a picture that is 16 wide would begin to be the object: always the fourth."""

    def forward(self, x: Tensor) -> Tensor:
        return 4.0 + 1e-6 * x.mean(dim=(1, 2, 3))[:, None]


def seen(rows: list[list[int]]) -> Facts:
    there = torch.tensor(rows)
    return Facts("mug", compute_sight=lambda: Sight(there.bool(), there.float(), there.float()))


def test_a_box_holds_what_is_seen() -> None:
    facts = seen([[0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]])
    assert facts.mask.dtype == torch.bool and facts.box == (1, 1, 3, 3)
    assert seen([[1, 0], [0, 1]]).box == (0, 0, 2, 2)
    assert seen([[0, 0]]).box is None
    assert Facts("mug", compute_sight=lambda: pytest.fail("nobody asked")).numbers == {}


KEPT = {"boxes": [[1, 2.5, 3, 4]], "words": ["a, b", 'c"d', None], "deep": {"er": [[True]]}}


@pytest.mark.parametrize("payload", [KEPT, None, 0, [], "text", {"lost": math.nan, "tensor": torch.tensor([1.0, 2.0])}])
def test_a_payload_comes_back_from_the_rows_of_searches_and_trials(tmp_path: Path, payload: Any) -> None:
    judgement = Judgement(1.0, 1.0, False, Prediction("here"), payload)
    with RunDirectory.create(tmp_path / "run") as run:
        run.append_rows(make_trial_row("sweep", 0, 7, 1, judgement), Row("sweep", 1))
    with Store(tmp_path / "run" / "results.sqlite", read_only=True) as store:
        row, without = store.rows()
    assert row.payload == to_json_value(payload) and without.payload is None
    assert read_judgement(row) == Judgement(1.0, 1.0, False, Prediction("here"), to_json_value(payload))
    with RunDirectory.resume(tmp_path / "run") as run:
        problem: Any = None
        (answer,) = Journal(run, ParallelEvaluator(problem)).evaluate_all(
            [Query(torch.zeros(1), 0, "sweep", 0)], lambda queries: []
        )
        assert answer.required_judgement == read_judgement(row), "it is read back, and nothing is asked"


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the runs `swept` and `attacked`."""
    folder = tmp_path_factory.mktemp("home")
    model, task = load_model(Middle(), input_size=16, read=Edge().output_reader), Edge()
    fast: dict[str, Any] = {"spp": 1, "denoise": "none", "task": task}
    azimuths = {"camera.azimuth": [0.0, 120.0, 240.0], "camera.elevation": [5.0, 60.0]}
    advsearch.sweep("banana", model, azimuths, trials=6, run=str(folder / "runs/swept"), **fast)
    advsearch.attack(
        "banana", model, controls={"camera": {"azimuth": [0, 360]}, "occlusion": {"coverage": [0, 0.5]}},
        policy="random", steps=4, trials=6, verify_spp=1, measure="no", run=str(folder / "runs/attacked"), **fast,
    )  # fmt: skip
    return folder


@pytest.mark.medium
def test_rows_have_what_was_said_beside_the_words(home: Path) -> None:
    for name in ("swept", "attacked"):
        with Store(home / "runs" / name / "results.sqlite", read_only=True) as store:
            rows = list(store.rows())
        assert rows and all(isinstance(row.payload, dict) and list(row.payload) == ["column", "boxes"] for row in rows)
    with Store(home / "runs/swept/results.sqlite", read_only=True) as store:
        margins = [row.margin for row in store.rows("sweep")]
    assert len({round(margin or 0.0) for margin in margins}) > 2, "the truth is another one in every configuration"
