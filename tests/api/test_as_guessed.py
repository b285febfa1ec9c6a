"""The Python interface as somebody guesses it who has not read about it."""

from __future__ import annotations

import inspect
import io
import pickle
import pydoc
import re
import sys
import types
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor, nn

import advsearch
from advsearch.controls import CONTROLS, LightControl, PoseControl
from advsearch.engine.loading import controls_to_settings, list_control_instances, make_controls
from advsearch.engine.naming import make_configured_controls
from advsearch.errors import FileFormatError, InputError, ModelError, UnknownNameError
from advsearch.progress import BarProgress, LineProgress, NotebookProgress, NullProgress, open_progress
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.region.result import RegionResult
from advsearch.questions.sweep.result import SweepResult
from advsearch.runs.results import Result

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


class Detector(nn.Module):
    """A box a picture, as torchvision's detectors answer."""

    def forward(self, images: Tensor) -> list[dict[str, Tensor]]:
        box = torch.tensor([[2.0, 2.0, 14.0, 14.0]])
        return [{"boxes": box, "scores": image.mean()[None], "labels": torch.tensor([1])} for image in images]


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


# ---- a run from its folder ------------------------------------------------------------------------------------------


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
    with pytest.raises(InputError, match="the model bright: only the Python session that asked has what judges"):
        loaded.render()


@pytest.mark.medium
def test_every_other_question_does_too(scene: advsearch.Scene, model: advsearch.Model, tmp_path: Path) -> None:
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
    with pytest.raises(InputError, match=r"^run: expected a text or a path, got SweepResult\("):
        advsearch.load_run(swept)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"^grid: expected a mapping or None, got \["):
        advsearch.sweep(scene, model, [("pose.yaw", [0, 90])])  # type: ignore[arg-type]
    (tmp_path / "region" / "summary.json").unlink()
    with pytest.raises(FileFormatError, match="did the run end"):
        advsearch.load_run(tmp_path / "region")


# ---- an answer elsewhere --------------------------------------------------------------------------------------------


@pytest.mark.medium
def test_an_adversarial_scene_is_rendered_under_another_view(attacked: AttackResult, tmp_path: Path) -> None:
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
    above = attacked.render(camera={"elevation": np.float32(80.0)}, spp=64).views[0].picture
    assert (above - same.views[0].picture).abs().mean() > 0.01
    words: Any = {"environment": "noon"}
    with pytest.raises(TypeError, match="unexpected keyword argument 'environment'; it takes model, scene, camera"):
        attacked.render(**words)
    with pytest.raises(UnknownNameError, match="unknown camera 'none'"):
        attacked.render(camera="none")
    other = pickle.loads(pickle.dumps(attacked))
    with pytest.raises(InputError, match=r"load_run\(FOLDER\) has it"):
        other.render()


@pytest.mark.medium
def test_an_adversarial_scene_of_another_session_is_rendered_with_what_its_run_names(tmp_path: Path) -> None:
    asked: dict[str, Any] = {**FAST, "resolution": 32, "steps": 1}
    controls: list[Any] = ["pose.yaw", LightControl()]
    metrics = {"here": lambda image, output, truth: image.mean()}
    run = tmp_path / "run"
    found = advsearch.attack("mug", controls=controls, policy="random", metrics=metrics, run=run, **asked)
    loaded = advsearch.load_run(run)
    assert isinstance(loaded, AttackResult) and found.summary.controls == ["pose", "light"]
    one, other = (result.render(spp=4) for result in (found, loaded))
    assert torch.equal(one.views[0].picture, other.views[0].picture) and one.model == other.model == "reference"


@pytest.mark.medium
def test_the_adversarial_scene_of_several_models_is_rendered(scene: advsearch.Scene) -> None:
    """Each of them says what it sees, and a metric gets what each of them says."""

    def least(image: Tensor, output: tuple[Tensor, ...], truth: tuple[Tensor, ...]) -> Tensor:
        return torch.stack([one[right] for one, right in zip(output, truth, strict=True)]).min()

    both = [
        advsearch.load_model(Bright(one), labels=["mug", "vase"], input_size=SIDE, name=f"{one}") for one in (0.0, 1.0)
    ]
    asked: dict[str, Any] = {**FAST, "steps": 1, "policy": "random"}
    found = advsearch.attack(scene, both, ensemble="worst", controls="pose.yaw", metrics={"least": least}, **asked)
    assert all((row.metrics["least"] or 0.0) < 0.0 for row in found.rows()), "of the one that sees a vase"
    assert found.render(spp=4).views[0].predictions[0].label == "mug; vase"
    assert found.render(both[1], spp=4).views[0].predictions[0].label == "vase"


@pytest.mark.medium
def test_what_an_adversarial_scene_says_is_not_set_beside_it(scene: advsearch.Scene, model: advsearch.Model) -> None:
    found = advsearch.attack(scene, model, controls={"pose.yaw": np.array([0.0, 90.0])}, policy="random", **FAST)
    with pytest.raises(InputError, match=r"settings: the adversarial configuration says what pose.yaw is"):
        found.render(settings={"pose.yaw": 3.0})
    with pytest.raises(InputError, match="expected an attack that was kept, got one that was not; give it a `run`"):
        advsearch.replay(found)


def test_a_result_is_replayed_with_the_network_of_the_session(attacked: AttackResult, tmp_path: Path) -> None:
    replayed = advsearch.replay(attacked, ways="curve", trials=6, run=tmp_path / "again", threads=1)
    assert replayed.model == "bright" and len(replayed.table) > 1
    assert replayed.command_line is None and replayed.python_only[0] == "the model bright"
    own = replayed.table[0]
    assert attacked.summary.verified is not None and own.verified is not None
    assert own.verified.trials == 6 and own.clean is not None


def test_a_found_texture_is_put_on_another_scene(attacked: AttackResult, tmp_path: Path) -> None:
    texture = attacked.artifacts["texture"]
    painted = advsearch.load_scene("mug", "noon", texture=texture)
    assert painted.is_session_only and np.array_equal(painted.description.object.base_color, texture.numpy())
    drawn = advsearch.render("mug", Bright(), texture=texture, resolution=SIDE, spp=4, denoise="none")
    plain = advsearch.render("mug", Bright(), resolution=SIDE, spp=4, denoise="none")
    assert not torch.equal(drawn.views[0].picture, plain.views[0].picture)
    levels = (texture.numpy() * 255.0).round().astype(np.uint8)
    Image.fromarray(levels).save(tmp_path / "texture.png")
    given: list[Any] = [levels, tmp_path / "texture.png", Image.fromarray(levels)]
    for one in (advsearch.load_scene("mug", texture=one) for one in given):
        assert np.allclose(one.description.object.base_color, levels / 255.0, atol=1e-6)
    for wrong, words in ((texture[..., 0], r"\(h, w, 3\), got an array of shape"), (2.0 * texture + 1.0, "sRGB in")):
        with pytest.raises(InputError, match=f"^texture: expected .*{words}"):
            advsearch.load_scene("mug", texture=wrong)


# ---- metrics --------------------------------------------------------------------------------------------------------


def test_metrics_are_columns_of_an_attack(attacked: AttackResult) -> None:
    seen = attacked.to_pandas()["red"]
    assert len(seen) > 10 and all(0.0 < one < 1.0 for one in seen) and len(set(seen)) > 4
    assert attacked.summary.command_line is None and attacked.summary.python_only == ["the model bright"]
    assert all(row.metrics.keys() == {"red"} for row in attacked.rows())


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
            with pytest.raises(InputError, match=r"cannot resume with .* began with: metric both;"):
                advsearch.sweep(scene, model, metrics={"both": _other()}, run=run, **asked)
    again = advsearch.load_run(run)
    assert isinstance(again, SweepResult)
    assert [row.metrics for row in again.rows()] == [row.metrics for row in whole.rows()]


def test_a_metric_gets_a_picture_of_its_own_and_a_label_as_losses_do(scene: advsearch.Scene) -> None:
    def spoils(image: Tensor, output: Tensor, truth: Tensor) -> Tensor:
        image.zero_()
        return nn.functional.cross_entropy(output, truth)

    def light(image: Tensor, output: Tensor, truth: Tensor) -> Tensor:
        return image.mean()

    metrics, unsure = {"loss": spoils, "light": light}, advsearch.load_model(Bright(0.42), labels=["mug", "vase"])
    swept = advsearch.sweep(scene, unsure, {"pose.yaw": [0, 90]}, metrics=metrics, trials=0, **PICTURE)
    for row in swept.rows():
        loss, seen = row.metrics["loss"], row.metrics["light"]
        assert row.margin is not None and loss == pytest.approx(np.log1p(np.exp(-row.margin)), rel=1e-4, abs=1e-6)
        assert seen is not None and seen > 0.1


def _other() -> Callable[..., float]:
    def both(image: Tensor, output: Tensor, truth: Any) -> float:
        return 1.0

    return both


@pytest.mark.medium
def test_a_metric_has_a_name_that_workers_and_files_can_use(model: advsearch.Model) -> None:
    from advsearch.engine.judging import list_session_only_metrics, metrics_to_settings
    from advsearch.questions.sweep.carry_out import load_job, sweep_worker
    from advsearch.questions.sweep.settings import SweepConfig

    named = metrics_to_settings({"red": red, "own": lambda image, output, truth: 0.0})
    assert named == {"red": f"{__name__}:red", "own": "<lambda>"}
    assert list_session_only_metrics(named) == ["own"]
    config = SweepConfig(object="mug", grid={"pose.yaw": [0, 90]}, metrics={"red": "math:hypot"}, **PICTURE)
    advsearch.allow_code("math:hypot")  # as the coordinator sends it along
    with pytest.raises(ValueError, match="only one element tensors"):  # a worker has math.hypot from its name
        sweep_worker(config.to_json())(load_job(config).make_queries(range(1)))
    refused: list[tuple[Any, str]] = [
        ({"f": 3}, "f: expected a function"),
        ({"f": lambda image, output: 0.0}, r"f: expected a function of \(image, output, truth\): too many"),
        ({"margin": red}, "a column that rows have"),
    ]
    for wrong, words in refused:
        with pytest.raises(InputError, match=f"^metrics: .*{words}"):
            advsearch.sweep("mug", model, {"pose.yaw": [0, 90]}, metrics=wrong, trials=0, **PICTURE)
    with pytest.raises(InputError, match=r"^metrics: f: expected a number, or a dict from names to numbers, got 'red'"):
        advsearch.sweep("mug", model, {"pose.yaw": [0, 90]}, metrics={"f": lambda *_: "red"}, trials=0, **PICTURE)
    with pytest.raises(InputError, match=r"^metrics: f: workers import a metric by its name"):
        advsearch.attack("mug", metrics={"f": lambda *_: 0.0}, workers=2)
    with pytest.raises(InputError, match=r"^metrics: f: no.such:thing cannot be imported"):
        advsearch.attack("mug", metrics={"f": "no.such:thing"}, **FAST)


# ---- progress -------------------------------------------------------------------------------------------------------


def test_progress_is_a_bar_where_somebody_looks(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def watcher(asked: Any) -> type[Any]:
        with open_progress(asked) as progress:
            progress.stage("searching", 4)
            progress.advance(2, best=0.5)
            progress.message("a sentence")
            return type(progress)

    assert [watcher(asked) for asked in (None, False, True)] == [NullProgress, NullProgress, LineProgress]
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    assert [watcher(asked) for asked in (None, False, True)] == [BarProgress, NullProgress, BarProgress]
    shown: list[str] = []

    def display(what: Any, raw: bool, display_id: bool) -> Any:
        assert raw and display_id
        return types.SimpleNamespace(update=lambda one, raw: shown.append(one["text/plain"]))

    shell = types.SimpleNamespace(kernel=object())
    notebook = types.SimpleNamespace(get_ipython=lambda: shell, display=types.SimpleNamespace(display=display))
    monkeypatch.setitem(sys.modules, "IPython", notebook)
    monkeypatch.setattr("advsearch.progress.MIN_UPDATE_SECONDS", 0.0)
    assert watcher(True) is NotebookProgress
    assert any(re.search(r"searching, 2 of 4.*best 0\.5", one) for one in shown) and not shown[-1]
    assert capsys.readouterr().out == "a sentence\n"
    with pytest.raises(InputError, match=r"^progress: expected True, False, None or a Progress, got 3"):
        watcher(3)


@pytest.mark.medium
def test_every_question_takes_true(
    scene: advsearch.Scene, model: advsearch.Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []
    monkeypatch.setattr(LineProgress, "stage", lambda self, name, *_, **__: seen.append(name))
    advsearch.attack(scene, model, controls="pose.yaw", policy="random", progress=True, **{**FAST, "steps": 1})
    advsearch.render(scene, model, resolution=SIDE, spp=1, progress=True)
    assert "searching" in " ".join(seen) and "rendering" in seen
    seen.clear()
    advsearch.render(scene, model, resolution=SIDE, spp=1)
    assert not seen, "nobody looks at a file"


# ---- what is taken --------------------------------------------------------------------------------------------------


@pytest.mark.medium
def test_labels_numbers_and_ranges_come_as_they_are(scene: advsearch.Scene) -> None:
    asked: dict[str, Any] = {**FAST, "steps": 1, "policy": "random"}
    labels: list[Any] = [np.int64(0), torch.tensor(0), 0]
    for label in labels:
        found = advsearch.attack(scene, Bright(), labels=["mug", "vase"], label=label, controls="pose.yaw", **asked)
        assert found.summary.label_set == ["mug"]
    ends = np.array([10.0, 20.0], np.float32)
    for controls in ({"pose": {"yaw": ends}}, {"pose.yaw": ends}, PoseControl(yaw=ends)):
        found = advsearch.attack(scene, Bright(), labels=["mug", "vase"], controls=controls, **asked)
        yaw = (found.summary.configuration or {})["pose.yaw"]
        assert (yaw.low, yaw.high) == pytest.approx((10.0, 20.0))


def test_a_mapping_may_have_instances(scene: advsearch.Scene) -> None:
    """In the order in which they are given, which is that of a file."""
    given: dict[str, Any] = {"pose.yaw": {}, "light": LightControl(), "camera": None}
    for controls in (given, ["pose.yaw", given["light"], "camera"]):
        made = make_controls(controls)
        assert [one.name for one in made] == ["pose", "light", "camera"] and made[1] is given["light"]
        assert list(controls_to_settings(controls)) == [*given] and list_control_instances(controls) == [made[1]]
        assert [one.name for one in make_configured_controls(AttackConfig(object="mug"), controls)] == [
            "pose",
            "light",
            "camera",
        ]
    refused: list[tuple[Any, str]] = [
        (
            {"mine": LightControl()},
            "mine: expected settings, or an instance of that name, got one that is called light",
        ),
        ({"light": LightControl}, r"light: .* got the class LightControl; write LightControl\(\)"),
        ([LightControl(), "light.power"], "light is given twice, by an instance and by name"),
        ([LightControl(), LightControl()], "a name of its own, got light twice"),
    ]
    for wrong, words in refused:
        with pytest.raises(InputError, match=words):
            scene.renderer(wrong)


@pytest.mark.parametrize("key", ["task", "objective", "policy"])
def test_what_a_question_takes_by_name_alone_it_says(key: str) -> None:
    given: dict[str, Any] = {key: lambda output, truth: output}
    with pytest.raises(
        InputError, match=f"^{key}: expected a name for harden, got <function .*; `attack` takes your own"
    ):
        advsearch.harden("mug", **given)


def test_a_detector_is_told_what_it_is() -> None:
    with pytest.raises(ModelError, match="boxes are what a detector gives: use `task=detection`"):
        advsearch.load_model(Detector(), input_size=SIDE)
    detector = advsearch.load_model(Detector(), input_size=SIDE, task="detection", labels=["none", "mug"])
    assert advsearch.render("mug", detector, task="detection", resolution=SIDE, spp=1).model == "Detector"


@pytest.mark.medium
def test_a_loaded_scene_is_asked_about_as_it_is(model: advsearch.Model, tmp_path: Path) -> None:
    turned = advsearch.load_scene("mug", settings={"pose.yaw": 77.0})
    asked: dict[str, Any] = {**FAST, "steps": 1, "average": 6, "policy": "random"}
    attacked = advsearch.attack(turned, model, controls="pose.pitch", run=tmp_path / "attack", **asked)
    assert (attacked.summary.command_line, attacked.summary.python_only) == (None, ["the model bright"])
    assert "pose.yaw: 77.0" in (tmp_path / "attack" / "run.yaml").read_text("utf-8")
    with pytest.raises(InputError, match="environment: belongs to the scene, and a loaded scene was given"):
        advsearch.region(turned, model, environment="noon")
    with pytest.raises(InputError, match="workers: other processes load objects, models"):
        advsearch.attack(turned, model, workers=2)


# ---- what is shown --------------------------------------------------------------------------------------------------


@pytest.mark.medium
def test_rows_are_there_without_a_folder(
    scene: advsearch.Scene, model: advsearch.Model, attacked: AttackResult
) -> None:
    held = advsearch.attack(scene, model, controls="texture", epsilon=1.0, metrics={"red": red}, **FAST)
    assert held.run is None
    kept, rows = list(attacked.rows()), list(held.rows())
    assert len(rows) == len(kept) and rows[0].values and rows[0].time is not None
    for ours, theirs in zip(rows, kept, strict=True):
        assert (ours.id, ours.kind, ours.step, ours.seed, ours.phase) == (
            theirs.id, theirs.kind, theirs.step, theirs.seed, theirs.phase,
        )  # fmt: skip
        assert ours.objective == pytest.approx(theirs.objective) and ours.metrics == pytest.approx(theirs.metrics)
    assert [row.kind for row in held.rows("control")] == ["control"] * 6


def test_a_table_says_which_rows_are_steps(attacked: AttackResult) -> None:
    frame, search = attacked.to_pandas("search"), attacked.search
    assert search is not None and (len(search.history), len(search.ranking)) == (4, 8)
    assert frame["phase"].tolist() == ["search"] * 4 + ["ranking"] * 8
    axes = attacked.plot()
    best = axes.lines[1].get_ydata()
    assert list(best) == list(np.fmax.accumulate([record.objective for record in search.history]))
    assert attacked.history == pytest.approx([record.objective for record in search.history])


def test_names_that_people_guess_are_there(attacked: AttackResult) -> None:
    assert attacked.success is attacked.found
    assert attacked.images["clean"] is attacked.clean and attacked.images["adversarial"] is attacked.adversarial
    assert advsearch.losses.nps is advsearch.losses.non_printability
    for base in (advsearch.Policy, advsearch.Task):
        assert inspect.isabstract(base), base
    assert all(issubclass(kind, advsearch.Control) for kind in CONTROLS.values())


def test_columns_have_plain_names_and_units_stand_beside_them(scene: advsearch.Scene, model: advsearch.Model) -> None:
    swept = advsearch.sweep(scene, model, {"pose.yaw": [0, 90], "camera.azimuth": [0, 1]}, trials=0, **PICTURE)
    frame = swept.to_pandas()
    assert frame["pose.yaw"].tolist() == [0.0, 0.0, 90.0, 90.0] and not [one for one in frame.columns if "[" in one]
    assert frame.attrs["units"] == {"pose.yaw": "degrees", "camera.azimuth": "degrees"}


@pytest.mark.medium
def test_a_notebook_shows_pictures(scene: advsearch.Scene, model: advsearch.Model) -> None:
    rendering = advsearch.render(scene, model, resolution=SIDE, spp=1, denoise="none")
    renderer = scene.renderer("pose.yaw", resolution=SIDE, denoise="none")
    before = renderer.renders
    for one in (rendering, renderer):
        with Image.open(io.BytesIO(one._repr_png_())) as picture:
            assert picture.size == (SIDE, SIDE) and np.asarray(picture).std() > 1.0
        assert "\n" not in repr(one) and len(repr(one)) < 120
    assert renderer.renders == before and repr(rendering.views[0]) == "View(azimuth=40, 'mug')"
    sheet = advsearch.render(scene, model, around=2, resolution=SIDE, spp=1, denoise="none")._repr_png_()
    assert Image.open(io.BytesIO(sheet)).width > 2 * SIDE


# ---- help and types -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [one for one in advsearch.__all__ if inspect.isfunction(getattr(advsearch, one))])
def test_help_fits_a_screen_before_the_settings(name: str) -> None:
    thing = getattr(advsearch, name)
    text = pydoc.plain(pydoc.render_doc(thing))
    lines = [part for line in text.splitlines() for part in (re.findall(".{1,88}", line) or [""])]
    settings = [k for k, line in enumerate(lines) if re.match(r" +(environment|seed|confirm|case|quick): ", line)]
    assert (settings[0] if settings else len(lines)) <= 56, "lines of 88 characters"


def test_an_editable_install_is_a_path_that_type_checkers_follow() -> None:
    """setuptools makes a plain path of one if every package lies where its name says (`package_dir` of the root)."""
    import configparser

    root = Path(__file__).resolve().parents[2]
    setup = configparser.ConfigParser()
    setup.read(root / "setup.cfg", encoding="utf-8")
    assert setup["options"]["package_dir"].split() == ["=", "."]
    for package in setup["options"]["packages"].split("\n"):
        if package.strip() and not package.startswith("#"):
            assert (root / package.strip().replace(".", "/") / "__init__.py").is_file(), package
    assert "py.typed" in setup["options.package_data"]["advsearch"] and (root / "advsearch" / "py.typed").is_file()


def test_type_checkers_know_what_comes_back(attacked: AttackResult) -> None:
    """Each comment would be one too many, and mypy would say so, if these had no types."""
    found: AttackResult | SweepResult | Result = advsearch.load_run(attacked.run or "")
    loaded: int = found  # type: ignore[assignment]
    assert isinstance(loaded, object)
