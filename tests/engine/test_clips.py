"""Clips: pictures of a rig that are taken one after the other, and video classifiers of transformers that see them."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import advsearch
from advsearch import seeds
from advsearch.controls import compose_space
from advsearch.controls.path import PathControl
from advsearch.engine.loading import make_renderer
from advsearch.models import ModelWarning
from advsearch.models.all_at_once import AllAtOnce
from advsearch.scene.description import load_description

pytestmark = [pytest.mark.medium, pytest.mark.island("advsearch.controls.path")]

transformers = pytest.importorskip("transformers")

FRAMES, SIDE = 4, 32
CLIP = "cameras: [{}, {later: 0.1}, {later: 0.2}, {later: 0.3}]"


def clip(folder: Path, text: str = CLIP) -> str:
    (folder / "clip.yaml").write_text(text)
    return str(folder / "clip.yaml")


def kinds() -> dict[str, Any]:
    """Tiny networks with random weights, as (configuration, class)."""
    small = {
        "image_size": SIDE, "num_frames": FRAMES, "hidden_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2,
        "intermediate_size": 32, "id2label": {0: "mug passes", 1: "dog runs", 2: "car turns"},
        "label2id": {"mug passes": 0, "dog runs": 1, "car turns": 2},
    }  # fmt: skip
    return {
        "VideoMAE": (transformers.VideoMAEConfig(**small, patch_size=16, tubelet_size=2), "VideoMAE"),
        "Timesformer": (transformers.TimesformerConfig(**small, patch_size=16), "Timesformer"),
        "Vivit": (transformers.VivitConfig(**small, tubelet_size=[2, 16, 16]), "Vivit"),
    }


def network(kind: str) -> Any:
    torch.manual_seed(1)
    config, name = kinds()[kind]
    made = getattr(transformers, f"{name}ForVideoClassification")(config)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))  # as they begin, scores hardly depend on anything
    return made.eval()


@pytest.mark.parametrize("kind", ["VideoMAE", "Timesformer", "Vivit"])
def test_a_clip_is_classified_as_by_the_network_itself(kind: str) -> None:
    """And its gradient is that of central differences, for all frames."""
    given = network(kind)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # it has no processor here
        model = advsearch.load_model(given)
    assert isinstance(model.module, AllAtOnce) and model.module.cameras == FRAMES
    assert model.labels == ("mug passes", "dog runs", "car turns") and model.input_size == (SIDE, SIDE)
    seen = torch.rand(SIDE, FRAMES * SIDE, 3, generator=torch.Generator().manual_seed(2)).double().float()
    clips = replace(model, cameras=FRAMES)
    frames = torch.stack(seen.split(SIDE, dim=1)).permute(0, 3, 1, 2)[None]
    with torch.no_grad():
        own, theirs = clips(seen)[0], given(pixel_values=frames).logits
        turned = given(pixel_values=frames.flip(1)).logits
    assert len(own) == FRAMES and all((one - theirs).abs().max() < 1e-4 for one in own)
    assert float((turned - theirs).abs().max()) > 1e-3  # it is not the same backwards
    at = seen.clone().requires_grad_()
    (slope,) = torch.autograd.grad(clips(at)[0][0][0, 0], at)
    assert all(float(part.abs().max()) > 0.0 for part in slope.split(SIDE, dim=1))
    along = torch.randn(seen.shape, generator=torch.Generator().manual_seed(3))
    given.double()
    double = torch.stack(seen.double().split(SIDE, dim=1)).permute(0, 3, 1, 2)[None]
    moved = torch.stack(along.double().split(SIDE, dim=1)).permute(0, 3, 1, 2)[None]
    with torch.no_grad():
        above, below = (float(given(pixel_values=double + step * moved).logits[0, 0]) for step in (1e-4, -1e-4))
    assert float((slope * along).sum()) == pytest.approx((above - below) / 2e-4, rel=1e-3)


def test_each_picture_of_a_clip_is_that_of_its_time(tmp_path: Path) -> None:
    """The first bit for bit, the others with noise of their own, as in stills at these times."""
    scene = advsearch.load_scene("mug", camera=clip(tmp_path)).description
    path = PathControl(path="orbit", seconds=2.0, time=[0.0, 1.0])
    whole = make_renderer(scene, compose_space([path], scene), SIDE, "none", 0)
    alone = load_description("mug")
    still = make_renderer(alone, compose_space([path], alone), SIDE, "none", 0)
    u = torch.tensor([0.4])
    with torch.no_grad():
        pictures = whole(u, 3, 4).split(SIDE, dim=1)
        for number, picture in enumerate(pictures):
            seed = 3 if number == 0 else seeds.derive_seed(3, "camera", number)
            torch.testing.assert_close(picture, still(u + 0.1 * number, seed, 4), atol=2e-3, rtol=0.0)
            mask = still.compute_object_mask(u + 0.1 * number)
            assert torch.equal(whole.find_surfaces(u, camera=number).visible_mask("object"), mask)
    assert float((pictures[3] - pictures[0]).abs().mean()) > 0.02


def test_an_attack_on_a_video_classifier_is_carried_out(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        model = advsearch.load_model(network("VideoMAE"))
    found = advsearch.attack(
        "mug", model, camera=clip(tmp_path), task="rig", label="mug passes,dog runs", controls="texture", epsilon=0.5,
        over="path", path="orbit", steps=3, draws=1, trials=10, policy="pgd", baseline=False, resolution=SIDE, spp=1,
        verify_spp=1, denoise="none", run=tmp_path / "run", measure="no",
    )  # fmt: skip
    assert found.summary.ending in ("found", "not verified", "budget spent", "already wrong")
    assert tuple(found.clean.shape) == (SIDE, FRAMES * SIDE, 3)
