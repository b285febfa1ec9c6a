"""Command: an action about the clean one, a state beside pictures, and a policy that a texture turns the wrong way."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.cli.main import main
from advsearch.errors import AdvsearchError, FileFormatError, InputError, ModelError
from advsearch.models.all_at_once import AllAtOnce
from advsearch.options import convert_to_setting
from advsearch.questions.attack.settings import AttackConfig
from advsearch.tasks import Facts, make_task
from advsearch.tasks.command import Command

pytestmark = pytest.mark.island("advsearch.tasks.command")

SIDE = 24
ASKED: dict[str, Any] = {
    "name": "command",
    "state": {"speed": 2},
    "envelope": 0.4,
    "names": "yaw rate",
    "units": "rad/s",
}
QUICK: dict[str, Any] = {
    "resolution": SIDE,
    "spp": 4,
    "verify_spp": 4,
    "trials": 12,
    "measure": "no",
    "denoise": "none",
}


class TowardsBlue(nn.Module):
    """Turns towards the mean column of what is more blue than red, as the mug's band is: over 0 is to the left."""

    def forward(self, images: Tensor, state: dict[str, Tensor]) -> Tensor:
        blue = (images[:, 2] - images[:, 0] - 0.02).clamp_min(0.0)
        columns = torch.linspace(1.0, -1.0, images.shape[3])
        middle = (blue * columns).sum(dim=(1, 2)) / (blue.sum(dim=(1, 2)) + 1e-3)
        return state["speed"] * middle[:, None]


class Colours(nn.Module):
    """Commands the mean of each colour."""

    def forward(self, images: Tensor) -> Tensor:
        return images.mean(dim=(2, 3))


def judged(**options: Any) -> Command:
    """A task after it has seen a clean action of 0.1 and -0.2."""
    task = Command(envelope=[0.5, 0.1], names="steer,gas", units="rad,", **options) if options else Command(
        envelope=[0.5, 0.1], names=["steer", "gas"]
    )  # fmt: skip
    return task.after_calibration(torch.tensor([[0.1, -0.2]]), None)


@pytest.mark.medium
def test_the_margin_is_the_largest_difference_in_envelopes_less_one() -> None:
    task, clean = judged(), torch.tensor([0.1, -0.2])
    output = torch.tensor([[0.1, -0.2], [0.35, -0.2], [0.1, -0.45], [-0.9, -0.15]], requires_grad=True)
    margins = task.loss(output, clean)
    torch.testing.assert_close(margins, torch.tensor([-1.0, -0.5, 1.5, 1.0]))
    (slope,) = torch.autograd.grad(margins[2], output)
    torch.testing.assert_close(slope[2], torch.tensor([0.0, -10.0]))
    labels = [one.prediction.label for one in task.judge(output.detach(), clean)]
    assert labels == [
        "action within its envelope", "action within its envelope",
        "action outside its envelope (gas below it)", "action outside its envelope (steer below it)",
    ]  # fmt: skip
    kept: Any = task.judge(output.detach(), clean)[2].payload
    assert kept["text"] == "steer 0.1, gas -0.45, clean 0.1, -0.2" and kept["envelopes"] == pytest.approx(2.5)


@pytest.mark.medium
def test_a_target_is_reached_within_its_envelope() -> None:
    model = advsearch.load_model(Colours(), task=Command(), input_size=8)
    asked = Command(envelope=0.1, names="r,g,b").on(model, target="g=0.9")
    task = asked.after_calibration(torch.tensor([[0.5, 0.5, 0.5]]), None)
    clean = task.truth(Facts("mug"))
    assert clean is not None
    output = torch.tensor([[0.2, 0.85, 0.9], [0.5, 0.5, 0.5], [0.5, 0.75, 0.5]], requires_grad=True)
    torch.testing.assert_close(task.score(output, clean), torch.tensor([0.5, -3.0, -0.5]))
    assert torch.autograd.grad(task.score(output, clean).sum(), output)[0].isfinite().all()
    reached = task.judge(output.detach(), clean)
    assert [one.success for one in reached] == [True, False, False] and [one.right for one in reached][1]
    assert reached[0].prediction.label == "action within the envelope of the target"
    positional = Command(envelope=0.1).on(model, target="0.9, 0.5,0.5").target
    assert positional is not None and positional.tolist() == pytest.approx([0.9, 0.5, 0.5])
    with pytest.raises(InputError, match="envelopes"):
        replace(asked, target=torch.tensor([0.5, 0.65, 0.5])).after_calibration(torch.full((1, 3), 0.5), None)
    with pytest.raises(InputError, match="an action of 3 elements, got 1"):
        replace(asked, target=torch.tensor([9.0])).after_calibration(torch.full((1, 3), 0.5), None)


def test_a_state_is_read_from_a_file_that_is_not_trusted(tmp_path: Path) -> None:
    file = tmp_path / "state.json"
    file.write_text(json.dumps({"speed": 2, "joints": [0.1, 0.2]}))
    task = Command(state=str(file), envelope=1)
    assert task.state == {"speed": (2.0,), "joints": (0.1, 0.2)} and make_task(convert_to_setting(task)) == task
    for text in ("[1]", "{", '{"a": NaN}', '{"a": "b"}', "1" * (1 << 21), "[" * 1000):
        file.write_text(text)
        with pytest.raises(AdvsearchError):
            Command(state=str(file))
    for path in (tmp_path, tmp_path / "none.json", Path("/dev/zero")):
        with pytest.raises(FileFormatError):
            Command(state=str(path))


def exported(folder: Path) -> str:
    batch = torch.export.Dim("batch", min=1, max=64)
    example = torch.rand(2, 3, SIDE, SIDE), {"speed": torch.ones(2, 1)}
    shapes = ({0: batch}, {"speed": {0: batch}})
    torch.export.save(torch.export.export(TowardsBlue().eval(), example, dynamic_shapes=shapes), folder / "turn.pt2")
    return str(folder / "turn.pt2")


@pytest.mark.medium
def test_a_policy_gets_pictures_and_a_state(tmp_path: Path) -> None:
    pictures = torch.rand(3, SIDE, SIDE, 3, generator=torch.Generator().manual_seed(1))
    expected = TowardsBlue()(pictures.permute(0, 3, 1, 2), {"speed": torch.full((3, 1), 2.0)})
    task = make_task(ASKED)
    for policy in (TowardsBlue(), exported(tmp_path)):
        model = advsearch.load_model(policy, task=task, input_size=None if isinstance(policy, str) else SIDE)
        torch.testing.assert_close(model(pictures), expected)
        assert model.differentiable
    again = advsearch.load_model(model, task=make_task({**ASKED, "state": {"speed": 4}}))
    torch.testing.assert_close(again(pictures), 2.0 * expected)
    with pytest.raises(ModelError, match="state"):
        advsearch.load_model(TowardsBlue(), task=make_task({**ASKED, "state": {"sped": 2}}), input_size=SIDE)


@pytest.mark.medium
def test_a_policy_of_a_rig_takes_all_pictures_at_once(tmp_path: Path) -> None:
    class Mean(nn.Module):
        def forward(self, images: Tensor, state: dict[str, Tensor]) -> Tensor:
            return images.mean(dim=(1, 2, 3, 4))[:, None] * state["speed"]

    task = make_task(ASKED)
    model = advsearch.load_model(AllAtOnce(Mean(), cameras=2), task=task, input_size=SIDE)
    rig = tmp_path / "rig.yaml"
    rig.write_text("cameras: [{}, {around: 90}]")
    given: dict[str, Any] = {"camera": str(rig), "controls": {"light": {"power": [1, 20]}}, "steps": 3, **QUICK}
    part = {**ASKED, "envelope": 0.05}
    found = advsearch.attack("mug", model, task={"name": "rig", "task": part}, policy="random", baseline=False, **given)
    assert found.summary.ending == "found"
    alone = advsearch.load_model(TowardsBlue(), task=task, input_size=SIDE)
    with pytest.raises(InputError, match="one output for all pictures"):
        advsearch.attack("mug", alone, task={"name": "rig", "task": part}, **given)


@pytest.mark.medium
def test_a_texture_turns_a_policy_the_wrong_way_and_the_page_says_no_more(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    task = "command={state: {speed: 2}, envelope: 0.2, names: yaw rate, units: rad/s}"
    given = ["attack", "--object", "mug", "--model", exported(tmp_path), "--task", task, "--set", "pose.x=-0.2"]
    given += ["--set", "pose.y=0.16", "--control", "texture={resolution: 16, epsilon: 0.5}", "--steps", "16"]
    given += ["--trials", "20", "--spp", "4", "--verify-spp", "4", "--measure", "no", "--run", str(tmp_path / "run")]
    assert main([*given, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    clean, wrong = (found[name]["payload"]["action"][0] for name in ("clean", "adversarial"))
    assert clean < -0.1 and wrong > 0.1, "the mug is to the right, and it turns to the left"
    assert found["ending"] == "found" and found["verified"]["successes"] == found["verified"]["trials"] == 20
    assert found["renders"]["gradient"] > 0 or found["renders"].get("products", 0) > 0
    kept: Any = AttackConfig.from_yaml(tmp_path / "run" / "run.yaml").task
    assert kept["state"] == {"speed": 2}
