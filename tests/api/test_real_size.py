"""An attack on a classifier of the usual size: MobileNetV2 at 224 x 224 pixels, a thousand classes, random weights."""

import torch
from torch import nn

import advsearch
from mobilenet import MobileNetV2


def mobilenet() -> nn.Module:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        made: nn.Module = MobileNetV2()
    return made.eval()


def test_a_classifier_of_real_size_is_searched_and_verified() -> None:
    names = [f"class {number}" for number in range(1000)]
    model = advsearch.load_model(mobilenet(), labels=names, input_size=224, name="mobilenet")
    scene = advsearch.load_scene("mug")
    render = scene.renderer("texture", resolution=224, denoise="none")
    with torch.no_grad():
        label = names[int(model(render(render.start, spp=1)[None]).argmax())]
    result = advsearch.attack(
        scene, model, label=label, controls={"texture": {"epsilon": 0.3}}, steps=2, trials=6, spp=1, verify_spp=1,
        denoise="none", baseline=False, measure="no", specialise=False,
    )  # fmt: skip
    summary = result.summary
    assert result.clean.shape == (224, 224, 3) and model.classes == 1000
    assert summary.clean.label == label and summary.clean.control and summary.clean.control.correct == 6
    assert summary.renders["gradient"] >= 1 and summary.verified and summary.verified.trials == 6
    assert 0.05 < float((result.u - render.start).abs().max()) <= 0.3 + 1e-6
    assert not torch.equal(result.adversarial, result.clean)
