"""What a researcher guesses in Python: arrays for u, classes for instances, a function for a task, losses at hand."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch import losses
from advsearch.attacks import Random
from advsearch.attacks.objectives import read_signature
from advsearch.cli.main import main
from advsearch.controls.pose import PoseControl
from advsearch.errors import FileFormatError, InputError
from advsearch.tasks import Classification, Facts, make_task
from small_models import easy

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
    assert torch.equal(render.mask(render.start.numpy()), render.mask(render.start))
    several = torch.tensor([[0.5], [0.75]], requires_grad=True)
    pictures = render(several, spp=1)
    assert pictures.shape == (2, 8, 8, 3) and torch.equal(pictures[1], render(several[1], spp=1))
    pictures.sum().backward()
    assert several.grad is not None and several.grad.shape == (2, 1) and bool((several.grad != 0.0).all())
    assert render(np.array([[0.5], [0.75]]), spp=1).shape == (2, 8, 8, 3)
    with pytest.raises(InputError, match="expected u as a tensor or an array of numbers, got str"):
        render("start", spp=1)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"expected u of shape \(1,\), got \(2,\)"):
        render(np.zeros((3, 2)), spp=1)


def test_a_class_in_the_place_of_an_instance_is_told_how_to_be_one(scene: advsearch.Scene) -> None:
    for controls in (PoseControl, [PoseControl]):
        for ask in (
            lambda given: advsearch.attack(scene, easy(), controls=given),
            lambda given: advsearch.sweep(scene, easy(), controls=given),
            lambda given: scene.renderer(given),
        ):
            with pytest.raises(InputError, match=r"controls: .* got the class PoseControl; write PoseControl\(\)"):
                ask(controls)
    with pytest.raises(InputError, match=r"policy: .* got the class Random; write Random\(\)"):
        advsearch.attack(scene, easy(), policy=Random)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"task: .* got the class Classification; write Classification\(\)"):
        make_task(Classification)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"objective: .* got the class CrossEntropyLoss; write CrossEntropyLoss\(\)"):
        advsearch.attack(scene, easy(), objective=nn.CrossEntropyLoss)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"task wrong: expected a function of \(output, truth\): too many positional"):
        make_task(wrong)  # type: ignore[arg-type]
    assert scene.renderer(PoseControl(yaw=[0, 10]), resolution=8).start.shape == (1,)


def wrong(output: Tensor) -> Tensor:
    """It is told nothing of what is right."""
    return output[:, 0]


def test_two_parameters_are_an_output_and_labels_whatever_they_are_called() -> None:
    assert not read_signature(lambda x, y: x).images and read_signature(lambda x, z, y: x).images
    assert read_signature(lambda *given: given[0]).images
    functions: list[Any] = [lambda logits, images: logits, lambda logits, texture: logits]
    for one in functions:
        with pytest.raises(InputError, match=r"takes \(output, images, truth\) or \(output, labels\)"):
            read_signature(one)


def test_a_loss_that_leads_the_wrong_way_is_refused(scene: advsearch.Scene) -> None:
    with pytest.raises(InputError, match=r"losses.targeted_margin needs a `target`; name one, or take losses.margin"):
        advsearch.attack(scene, easy(), objective=losses.targeted_margin)
    sure = functools.partial(losses.carlini_wagner, confidence=3.0)
    with pytest.raises(InputError, match=r"losses.carlini_wagner leads away from the `target`; take losses.targeted_"):
        advsearch.attack(scene, easy(), objective=sure, target="bowl")
    with pytest.raises(InputError, match=r"labels: .* got Facts, the truth of another task than classification"):
        losses.margin(torch.zeros(1, 2), Facts("mug"))  # type: ignore[arg-type]


def test_a_space_has_what_a_loss_can_ask_for(scene: advsearch.Scene) -> None:
    """Type checkers know it: mypy reads this test."""
    render = scene.renderer({"texture": {"resolution": 4}, "pose": {"yaw": [0, 90]}}, resolution=8)
    assert render.space.get_printable_colors(render.start)["texture"].shape == (4, 4, 3)
    assert float(render.space.get_numeric_values(render.start)["pose.yaw"]) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.medium
def test_a_function_is_a_task(scene: advsearch.Scene) -> None:
    """The network says how bright it is; right is a level near that of the yaw."""
    seen: list[Facts] = []

    def judge(output: Tensor, truth: Facts) -> Tensor:
        seen.append(truth)
        return (output[:, 0] - 0.4 - truth.number("pose.yaw") / 100.0).abs() - 0.2

    network = advsearch.load_model(Level(), input_size=16, read=make_task(judge).reader)
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


def test_a_function_that_says_yes_or_no_is_no_task() -> None:
    task = make_task(lambda output, truth: output[:, 0] > 0.5)
    with pytest.raises(
        InputError, match=r"task <lambda>: expected how wrong .* 2 floating-point numbers.* got torch.bool"
    ):
        task.loss(torch.zeros(2, 1), Facts("mug"))
    with pytest.raises(InputError, match="got float"):
        make_task(lambda output, truth: output.sum().item()).loss(torch.zeros(2, 1), Facts("mug"))
    whole = make_task(lambda output, truth: output.sum())
    assert whole.judge(torch.tensor([[3.0, 1.0]]), Facts("mug", "cup"))[0].margin == -4.0
    assert whole.predictions(torch.tensor([[3.0, 1.0]]))[0][0].label == "3, 1"
    assert whole.predictions(torch.zeros(1, 4, 4))[0][0].label == "4 x 4 numbers, mean 0"
    assert whole.truth_names(Facts("mug", None, "cup")) == ("cup",)


@pytest.mark.medium
def test_the_losses_at_hand_make_what_printable_makes(scene: advsearch.Scene) -> None:
    """By the same search: with the weight of its terms, the answer is the same."""
    assert advsearch.losses is losses and "losses" in dir(advsearch)

    def own(logits: Tensor, images: Tensor, labels: Tensor, texture: Tensor) -> Tensor:
        terms = losses.total_variation(texture) + losses.non_printability(texture)
        return losses.margin(logits, labels) - 10.0 * terms

    settings: dict[str, Any] = {**SMALL, "controls": {"texture": {"epsilon": 0.3, "resolution": 16}}, "resolution": 32}
    ours = advsearch.attack(scene, easy(), objective=own, **settings)
    theirs = advsearch.attack(scene, easy(), printable=True, **settings)
    assert ours.found and torch.allclose(ours.u, theirs.u, atol=1e-5)


@pytest.mark.medium
def test_controls_may_be_given_as_on_the_command_line(scene: advsearch.Scene) -> None:
    for controls in ("pose={yaw: [0, 90], pitch: 5},light:key", ["pose={yaw: [0, 90], pitch: 5}", "light:key"]):
        render = scene.renderer(controls, resolution=8)
        assert render.space.groups[0].name == "pose.yaw" and len(render.start) == 9
    found = advsearch.sweep(scene, easy(), controls="pose={yaw: [0, 90]}", samples=2, trials=0, resolution=16, spp=2)
    assert found.summary.controls == ["pose"]
    with pytest.raises(InputError, match=r"controls: expected \{PARAMETER: VALUE .* for pose, .* close every bracket"):
        scene.renderer("pose={yaw: [0, 90}")
    with pytest.raises(InputError, match="controls: light is given twice"):
        scene.renderer("light,light")


@pytest.mark.medium
def test_names_that_are_guessed(scene: advsearch.Scene, tmp_path: Path) -> None:
    assert advsearch.controls.Texture is advsearch.controls.TextureControl
    with pytest.raises(
        AttributeError, match=r"advsearch.render\(scene\) makes a picture .* scene.renderer\(controls\)"
    ):
        scene.render  # noqa: B018
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        scene.nothing  # noqa: B018
    controls = {"pose": {"yaw": [0, 90]}}
    found = advsearch.attack(scene, easy(), controls=controls, policy="random", run=tmp_path / "run", **SMALL)
    assert found.path == found.run == tmp_path / "run" == advsearch.load_run(found.path).path  # type: ignore
    assert found.values.keys() == {"pose.yaw"} and 0.0 <= found.values["pose.yaw"] <= 90.0


def test_an_objective_that_takes_the_picture_first_is_told(scene: advsearch.Scene) -> None:
    for function in (lambda image, output, truth: output, lambda images, labels: images):
        with pytest.raises(InputError, match=r"gets what the model says; write \(output, images, truth\)"):
            advsearch.attack(scene, easy(), objective=function)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["mug"], "expected flags, got 'mug'; for the object write --object mug"),
        (["--eot", "camera"], "has no --eot; did you mean --over?"),
        (["--num-steps=3"], "unknown flag '--num-steps'. Did you mean '--steps'"),
        (["--device", "cuda"], "has no --device (pictures are made on the processor"),
        (["--control", "camra"], "unknown control 'camra'. Did you mean 'camera'?"),
        (["--control", "yaw"], "It is a parameter: write pose.yaw."),
    ],
)
def test_words_of_other_tools_are_told_what_they_are_called_here(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["attack", "--object", "mug", *words]) == 2
    assert told in capsys.readouterr().err


def test_a_python_file_is_no_model(tmp_path: Path) -> None:
    (tmp_path / "nets.py").write_text("net = 1\n")
    with pytest.raises(FileFormatError, match="is Python code; name what makes the network in it: 'nets:NAME'"):
        advsearch.load_model(tmp_path / "nets.py")
