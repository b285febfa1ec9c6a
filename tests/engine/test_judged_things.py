"""Judging a thing beside the object, or all, with truth for each in the rows."""

from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.tasks.base import Facts, Sight
from advsearch.tasks.segmentation import Segmentation
from advsearch.tasks.together import make_each_thing_task

pytestmark = [pytest.mark.usefixtures("two_threads"), pytest.mark.island("advsearch.tasks.segmentation")]

VIEW = {"camera.distance": 9.0, "camera.azimuth": 0.0, "camera.elevation": 12.0, "camera.fov": 60.0}
ASKED: dict[str, Any] = {
    "environment": "street", "set": VIEW, "things": "stop-sign@2,2.5,size=1.6", "task": "segmentation",
    "resolution": 48, "denoise": "none", "spp": 2,
}  # fmt: skip


class Half(nn.Module):
    """Says "stop sign" of the right half of the picture, "car" of the other one."""

    def forward(self, x: Tensor) -> Tensor:
        right = torch.zeros_like(x[:, 0])
        right[:, :, x.shape[3] // 2 + 3 :] = 1.0
        return torch.stack([5.0 - 10.0 * right, 10.0 * right - 5.0], dim=1) + 0.1 * x[:, :2]


def model() -> Any:
    return advsearch.load_model(Half(), input_size=48, task="segmentation", labels=["car", "stop sign"])


@pytest.mark.medium
@pytest.mark.parametrize("judge", ["object", "stop-sign", "all"])
def test_rows_have_the_truth_of_each_thing_and_tasks_judge_what_is_asked(judge: str, tmp_path: Path) -> None:
    found = advsearch.sweep(
        "car", model(), grid={"pose.x": [0.0, 0.05]}, judge=judge, trials=0, run=tmp_path / "run",
        **{**ASKED, "task": {"name": "segmentation", "accuracy": 0.4}},
    )  # fmt: skip
    rows = list(found.rows())
    payload: Any = rows[0].payload
    things = payload["things"]
    assert list(things) == ["object", "stop-sign"] and things["stop-sign"]["label"] == "stop sign"
    x0, y0, x1, y1 = things["stop-sign"]["box"]
    assert 24 < x0 < x1 <= 48 and 0 <= y0 < y1 <= 48 and things["stop-sign"]["share"] > 0.95
    assert things["stop-sign"]["distance"] == pytest.approx(7.0, abs=0.8)
    if judge == "all":
        assert things["object"]["right"] is things["stop-sign"]["right"] is True
        assert payload["worst"] in things and payload["mean_margin"] > 0.0
    assert all(row.correct for row in rows)


def test_all_things_have_to_be_right() -> None:
    masks = {"object": torch.zeros(2, 4, dtype=torch.bool), "sign": torch.zeros(2, 4, dtype=torch.bool)}
    masks["object"][:, :2], masks["sign"][:, 2:] = True, True
    own = make_each_thing_task(Segmentation(labels=("car", "sign"), accuracy=1.0))
    each = {
        name: Facts(
            name, name if name == "sign" else "car", compute_sight=partial(Sight, mask, mask.float(), mask.float())
        )
        for name, mask in masks.items()
    }
    truth = own.truth(Facts("car", "car", facts_of_thing=each))
    right = torch.zeros(1, 2, 2, 4)
    right[0, 0, :, :2], right[0, 1, :, 2:] = 3.0, 2.0
    wrong = right.clone()
    wrong[0, :, 0, 3] = torch.tensor([1.0, 0.0])
    said = own.judge(torch.cat([right, wrong]), truth)
    assert [one.right for one in said] == [True, False]
    assert [one.margin for one in said] == pytest.approx([2.0, -1.0])
    assert own.score(torch.cat([right, wrong]), truth).tolist() == pytest.approx([-2.0, 1.0])
    assert said[1].payload["worst"] == "sign"  # type: ignore[index, call-overload]
    assert said[1].payload["mean_margin"] == pytest.approx((3.0 - 1.0) / 2)  # type: ignore[index, call-overload]
    assert own.truth_names(truth) == ("car", "sign") and len(own.marks(right, truth)[0]) == 3
