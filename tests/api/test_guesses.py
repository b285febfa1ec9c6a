"""What a researcher guesses in Python: arrays for u, and a function for a task."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.errors import InputError
from advsearch.tasks import Facts, make_task

SMALL: dict[str, Any] = {
    "resolution": 16, "steps": 4, "spp": 2, "trials": 6, "verify_spp": 4, "denoise": "none", "baseline": False,
    "measure": "no",
}  # fmt: skip


class Level(nn.Module):
    """One number: how bright the picture is."""

    def forward(self, images: Tensor) -> Tensor:
        return images.mean(dim=(1, 2, 3))[:, None]


@pytest.fixture(scope="module")
def scene() -> advsearch.Scene:
    return advsearch.load_scene("mug")


def test_u_may_be_an_array_or_a_batch(scene: advsearch.Scene) -> None:
    render = scene.renderer("pose.yaw", resolution=8, denoise="none")
    whole = render(render.start, spp=1)
    for u in (render.start.numpy(), render.start.double(), render.start.tolist()):
        assert torch.equal(render(u, spp=1), whole)
    assert torch.equal(render.compute_object_mask(render.start.numpy()), render.compute_object_mask(render.start))
    several = torch.tensor([[0.5], [0.75]], requires_grad=True)
    pictures = render(several, spp=1)
    assert pictures.shape == (2, 8, 8, 3) and torch.equal(pictures[1], render(several[1], spp=1))
    pictures.sum().backward()
    assert several.grad is not None and several.grad.shape == (2, 1) and bool((several.grad != 0.0).all())
    assert render(np.array([[0.5], [0.75]]), spp=1).shape == (2, 8, 8, 3)
    with pytest.raises(InputError, match="got str"):
        render("start", spp=1)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"expected u of shape \(1,\), got \(2,\)"):
        render(np.zeros((3, 2)), spp=1)


@pytest.mark.medium
def test_a_function_is_a_task(scene: advsearch.Scene) -> None:
    """The network says how bright it is; right is a level near that of the yaw."""
    seen: list[Facts] = []

    def judge(output: Tensor, truth: Facts) -> Tensor:
        seen.append(truth)
        return (output[:, 0] - 0.4 - truth.get_number("pose.yaw") / 100.0).abs() - 0.2

    network = advsearch.load_model(Level(), input_size=16, read=make_task(judge).output_reader)
    shown = advsearch.render(scene, network, task=judge, controls={"pose": {"yaw": 0}}, spp=4)
    level = float(shown.views[0].predictions[0].label)
    assert 0.2 < level < 0.6 and shown.task == "judge"
    swept = advsearch.sweep(
        scene, Level(), {"pose.yaw": [0, 90]}, task=judge, resolution=16, spp=2, denoise="none", trials=0
    )
    assert [row.correct for row in swept.rows()] == [True, False], "its level is no 1.3"
    found = advsearch.attack(scene, Level(), task=judge, controls={"pose": {"yaw": [0, 90]}}, policy="random", **SMALL)
    assert found.summary.objective == "score" and found.found and found.summary.task == "judge"
    assert found.summary.command_line is None
    assert found.summary.python_only == ["the model Level", "the task judge"]
    assert seen[0].mask.shape == (128, 128) or seen[0].mask.shape == (16, 16)
