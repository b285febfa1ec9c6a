"""The Python interface as somebody guesses it who has not read about it."""

import pickle
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.errors import FileFormatError, InputError, UnknownNameError
from advsearch.progress import NullProgress
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.sweep.result import SweepResult

SIDE = 16
PICTURE: dict[str, Any] = {"resolution": SIDE, "spp": 1, "denoise": "none", "threads": 1}
FAST: dict[str, Any] = {**PICTURE, "verify_spp": 1, "trials": 6, "measure": "no", "baseline": False, "steps": 4}


class Bright(nn.Module):
    """The first class where a picture is brighter than a threshold, else the second."""

    def __init__(self, threshold: float = 0.2) -> None:
        super().__init__()
        self.threshold = nn.Parameter(torch.tensor(threshold))

    def forward(self, images: Tensor) -> Tensor:
        score = 40.0 * (images.mean(dim=(1, 2, 3)) - self.threshold)
        return torch.stack([score, -score], dim=1)


def red(image: Tensor, output: Tensor, truth: Any) -> float:
    """A metric that other processes can import."""
    assert image.shape == (SIDE, SIDE, 3) and output.shape == (2,)
    return float(image[..., 0].mean())


@pytest.fixture(scope="module")
def scene() -> advsearch.Scene:
    return advsearch.load_scene("mug")


@pytest.fixture(scope="module")
def model() -> advsearch.Model:
    return advsearch.load_model(Bright(), labels=["mug", "vase"], input_size=SIDE, name="bright")


@pytest.fixture(scope="module")
def attacked(scene: advsearch.Scene, model: advsearch.Model, tmp_path_factory: pytest.TempPathFactory) -> AttackResult:
    run = tmp_path_factory.mktemp("guesses") / "run"
    return advsearch.attack(scene, model, controls="texture", epsilon=1.0, run=run, metrics={"red": red}, **FAST)


@pytest.mark.medium
def test_an_attack_comes_back_from_its_folder(attacked: AttackResult) -> None:
    assert attacked.run is not None
    loaded = advsearch.load_run(attacked.run)
    assert isinstance(loaded, AttackResult) and loaded.summary == attacked.summary and loaded.run == attacked.run
    for name in ("u", "clean", "adversarial"):
        assert torch.equal(getattr(loaded, name), getattr(attacked, name)), name
    assert loaded.artifacts.keys() == attacked.artifacts.keys() == {"texture", "texture-original"}
    assert all(torch.equal(loaded.artifacts[name], one) for name, one in attacked.artifacts.items())
    assert list(loaded.rows()) == list(attacked.rows()) and repr(loaded) == repr(attacked)
    with pytest.raises(InputError, match="the model bright"):
        loaded.render()


@pytest.mark.island("advsearch.questions.region")
@pytest.mark.medium
def test_every_other_question_does_too(scene: advsearch.Scene, model: advsearch.Model, tmp_path: Path) -> None:
    from advsearch.questions.region.result import RegionResult

    swept = advsearch.sweep(
        scene, model, {"pose.yaw": np.array([0.0, 90.0])}, run=tmp_path / "sweep", trials=0, **PICTURE
    )
    again = advsearch.load_run(tmp_path / "sweep")
    assert isinstance(again, SweepResult) and again.summary == swept.summary and [*again.rows()] == [*swept.rows()]
    few = {**PICTURE, "samples": 8, "map": 0, "verify_spp": 1}
    del few["spp"]
    region = advsearch.region(scene, model, controls="pose.yaw", run=tmp_path / "region", **few)
    loaded = advsearch.load_run(tmp_path / "region")
    assert isinstance(loaded, RegionResult) and loaded == region
    with pytest.raises(UnknownNameError):
        advsearch.load_run(tmp_path / "none")
    (tmp_path / "region" / "summary.json").unlink()
    with pytest.raises(FileFormatError, match="did the run end"):
        advsearch.load_run(tmp_path / "region")


@pytest.mark.medium
def test_an_adversarial_scene_is_rendered_under_another_view(attacked: AttackResult) -> None:
    same, turned = attacked.render(spp=64), attacked.render(settings={"camera.azimuth": 200.0}, spp=64)
    texture, plain = attacked.artifacts["texture"], {**PICTURE, "spp": 64}
    del plain["threads"]
    painted = advsearch.render("mug", Bright(), texture=texture, **plain)
    assert torch.allclose(same.views[0].picture, painted.views[0].picture, atol=1.5 / 255.0)
    assert turned.views[0].azimuth == 200.0 and (turned.views[0].picture - same.views[0].picture).abs().mean() > 0.01
    elsewhere = attacked.render(scene=advsearch.load_scene("mug", "noon"), resolution=24)
    assert elsewhere.scene.environment_name == "noon" and elsewhere.views[0].picture.shape == (24, 24, 3)
    clean = advsearch.render("mug", Bright(), **plain)
    assert (clean.views[0].picture - same.views[0].picture).abs().max() > 4.0 / 255.0
    other = pickle.loads(pickle.dumps(attacked))
    with pytest.raises(InputError, match=r"load_run\(FOLDER\) loads one"):
        other.render()


@pytest.mark.island("advsearch.questions.replay")
def test_a_result_is_replayed_with_the_network_of_the_session(attacked: AttackResult, tmp_path: Path) -> None:
    replayed = advsearch.replay(attacked, ways="curve", trials=6, run=tmp_path / "again", threads=1)
    assert replayed.model == "bright" and len(replayed.table) > 1
    assert replayed.command_line is None and replayed.python_only[0] == "the model bright"
    own = replayed.table[0]
    assert attacked.summary.verified is not None and own.verified is not None
    assert own.verified.trials == 6 and own.clean is not None


@pytest.mark.medium
def test_metrics_are_columns_of_a_sweep_and_of_one_that_goes_on(
    scene: advsearch.Scene, model: advsearch.Model, tmp_path: Path
) -> None:
    class Stops(NullProgress):
        def advance(self, n: int = 1, **info: float | str) -> None:
            if n:
                raise KeyboardInterrupt

    def both(image: Tensor, output: Tensor, truth: Any) -> dict[str, Any]:
        return {"light": image.mean(), "sure": np.float32(output.softmax(0)[0]), "none": float("nan")}

    asked: dict[str, Any] = {**PICTURE, "grid": {"pose.yaw": [0, 90, 180, 270]}, "trials": 0, "batch": 1}
    whole = advsearch.sweep(scene, model, metrics={"both": both}, **asked)
    frame = whole.to_pandas()
    assert all(0.0 < one < 1.0 for one in frame["both.light"]) and frame["both.none"].isna().all()
    run = tmp_path / "run"
    for progress in (Stops(), NullProgress()):
        with suppress(KeyboardInterrupt):
            advsearch.sweep(scene, model, metrics={"both": both}, run=run, progress=progress, **asked)
        if isinstance(progress, Stops):
            with pytest.raises(InputError, match="metric both"):
                advsearch.sweep(scene, model, metrics={"both": _other()}, run=run, **asked)
    again = advsearch.load_run(run)
    assert isinstance(again, SweepResult)
    assert [row.metrics for row in again.rows()] == [row.metrics for row in whole.rows()]


def _other() -> Callable[..., float]:
    def both(image: Tensor, output: Tensor, truth: Any) -> float:
        return 1.0

    return both
