"""The clean scene is the one that the object, the environment and the settings describe: otherwise it is refused or
said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

import advsearch
from advsearch.cli.flags import format_as_flags
from advsearch.cli.main import main
from advsearch.controls import Space, make_control, make_space
from advsearch.controls.base import describe_adjusted_defaults
from advsearch.controls.pose import PoseControl
from advsearch.errors import InputError
from advsearch.progress import NullProgress
from advsearch.questions.sweep.carry_out import sweep_from_config
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.runs.results import to_json_value
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.description import DEFAULT_ENVIRONMENT, SceneDescription, load_description

AZIMUTH = {"camera.azimuth": 130.0}


def space_of(scene: SceneDescription, **controls: dict[str, Any]) -> Space:
    return make_space([make_control(name, given) for name, given in controls.items()], scene)


# ---- what was asked for is kept -------------------------------------------------------------------------------------

REFUSED: dict[str, tuple[dict[str, float], str | None, dict[str, Any], str]] = {
    "a range": (
        {"camera.elevation": 80.0},
        "studio",
        {"camera": {"elevation": [5, 30]}},
        "--set camera.elevation=80 and --control camera contradict each other: camera.elevation is from 5 to 30, which "
        "leaves 80 out; change one of the two, or leave one out",
    ),
    "a value": (AZIMUTH, "studio", {"camera": {"azimuth": 10}}, "camera.azimuth is 10, which leaves 130 out"),
    "a list": ({"pose.yaw": 0.0}, "studio", {"pose": {"yaw": {"choices": [10, 20]}}}, "one of 10, 20, which leaves 0"),
    "an instance with a name of its own": (
        {"pose.yaw": 10.0},
        "studio",
        {"mine": {"kind": "pose", "yaw": [20, 30]}},
        "--set pose.yaw=10 and --control mine contradict each other: mine.yaw is from 20 to 30, which leaves 10 out",
    ),
    "another name for it": ({"camera.fov": 50.0}, "studio", {"camera": {"focal_length": [10, 20]}}, "leaves 38.6"),
    "environments": (
        {},
        "loft",
        {"environment": {"which": ["noon", "kitchen"]}},
        "--environment loft and --control environment contradict each other: environment.which is one of noon, kitchen",
    ),
    "the default environment": (
        {},
        "studio",
        {"environment": {"which": ["noon", "kitchen"]}},
        "--environment studio and --control environment contradict each other: environment.which is one of noon",
    ),
    "an environment": ({}, "loft", {"environment": {"which": "noon", "rotation": [0, 90]}}, "--environment loft and"),
    "a sky": ({}, "loft", {"sky": {}}, "--environment loft and --control sky contradict each other"),
    "a turned sky": ({"environment.rotation": 90.0}, None, {"sky": {}}, "--set environment.rotation=90 and"),
    "a hidden ground": ({"ground.size": 5.0}, "studio", {"background": {}}, "--set ground.size=5 and --control"),
    "the surface of a named material": (
        {"material.roughness": 0.9},
        "studio",
        {"material": {"which": ["wood", "marble"]}},
        "--set material.roughness=0.9 and --control material contradict each other",
    ),
    "the exposure": ({"camera.exposure": 1.0}, "studio", {"camera": {"exposure": [-1, 0.5]}}, "leaves 1 out"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_control_that_leaves_out_what_was_asked_for_is_refused(name: str) -> None:
    given, environment, controls, message = REFUSED[name]
    with pytest.raises(InputError) as error:
        space_of(load_description("mug", environment, setting_values=given), **controls)
    assert message in format_as_flags(str(error.value))


@pytest.mark.parametrize(
    ("given", "environment", "controls"),
    [
        (AZIMUTH, "studio", {"camera": {"azimuth": 130}}),
        (AZIMUTH, "studio", {"camera": {"azimuth": -230}}),
        (AZIMUTH, "studio", {"camera": {"azimuth": [0, 360]}}),
        (AZIMUTH, "studio", {"camera": {"azimuth": [-300, -200]}}),
        (AZIMUTH, "studio", {"camera": {"elevation": [5, 60]}}),
        ({"camera.distance": 2.0}, "studio", {"camera": {"distance": [2, 4]}}),
        ({"camera.fov": 50.0}, "studio", {"camera": {"focal_length": [30, 60]}}),
        ({"material.roughness": 0.9}, "studio", {"material": {"which": ["own", "wood"]}}),
        ({}, "noon", {"environment": {"which": ["kitchen", "noon"]}}),
        ({}, "noon", {"environment": {"which": "noon", "rotation": [0, 90]}}),
        ({}, "loft", {"environment": {"which": ["own", "noon"]}}),
        ({"ground.size": 5.0}, "studio", {"background": {"ground": "keep", "what": ["environment", "colour"]}}),
    ],
)
def test_a_control_that_agrees_starts_at_what_was_asked_for(
    given: dict[str, float], environment: str, controls: dict[str, Any]
) -> None:
    scene = load_description("mug", environment, setting_values=given)
    space = space_of(scene, **controls)
    assert space.adjusted_defaults == ()
    for name, value in space.describe(space.start).items():
        if name in given and isinstance(value["value"], float):
            assert (value["value"] - given[name]) % 360.0 == pytest.approx(0.0, abs=1e-4)


@pytest.mark.medium
def test_the_default_environment_is_asked_for_only_where_it_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    words = ["sweep", "--object", "mug", "--control", "environment={which: [noon, kitchen]}", "--run", str(run)]
    more = "--samples 2 --resolution 16 --spp 1 --trials 0 --quiet".split()
    assert main([*words, *more, "--environment", "studio"]) == 2
    assert "error: --environment studio and --control environment contradict each other" in capsys.readouterr().err
    assert main([*words, *more]) == 0
    (run / "summary.json").unlink()  # as if it had been stopped
    assert main(["resume", str(run), "--quiet"]) == 0
    assert SweepConfig(object="mug").environment_name == DEFAULT_ENVIRONMENT


# ---- what nobody asked for moves, and that is said ------------------------------------------------------------------

MOVED: dict[str, tuple[dict[str, Any], str]] = {
    "a range": ({"pose": {"yaw": [90, 180]}}, "pose.yaw 90 degrees instead of 0, which the control pose leaves out"),
    "the nearer way around": ({"camera": {"azimuth": [350, 390]}}, "camera.azimuth 390 degrees instead of 40"),
    "the nearest of a list": ({"pose": {"yaw": {"choices": [100, 300, 200]}}}, "pose.yaw 300 degrees instead of 0"),
    "a name": ({"environment": {"which": ["noon", "kitchen"]}}, "environment noon instead of studio"),
    "a sky": ({"sky": {}}, "environment sky instead of studio, which the control sky leaves out"),
    "a lamp that is on": ({"light": {"x": [0, 1]}}, "light.power 6 instead of 0"),
    "a distance that was worked out": ({"camera": {"distance": [2, 3]}}, "camera.distance 2 metres instead of 0.238,"),
    "haze": ({"haze": {"density": [0.1, 0.2]}}, "haze.density 0.1 per object size instead of 0"),
    "a backdrop": (
        {"background": {}},
        "ground.size 0 object sizes instead of 3 and background.what colour instead of environment",
    ),
    "a narrow printer": (
        {"patch": {"pixels": [0.45, 0.5]}},
        "patch.pixels the nearest from 0.45 to 0.5 instead of the texture underneath",
    ),
}


@pytest.mark.medium
@pytest.mark.parametrize("name", MOVED)
def test_a_default_that_is_left_out_moves_and_is_said(name: str) -> None:
    controls, sentence = MOVED[name]
    (said,) = describe_adjusted_defaults(space_of(load_description("mug"), **controls).adjusted_defaults)
    assert said.startswith("The clean scene has ") and said.endswith(" leaves out.") and sentence in said


@pytest.mark.medium
@pytest.mark.parametrize(
    "controls",
    [
        {"pose": {}}, {"camera": {}}, {"texture": {"resolution": 8}}, {"material": {}}, {"light": {}}, {"geometry": {}},
        {"environment": {}}, {"patch": {}}, {"occlusion": {}}, {"contents": {}}, {"haze": {}}, {"lens": {}},
        {"corruption": {}}, {"pose": {"yaw": 90, "pitch": [0, 10]}}, {"camera": {"azimuth": [0, 360]}},
        {"camera": {"azimuth": [350, 410]}}, {"environment": {"which": ["noon", "studio"]}},
        {"light": {"power": 3.0, "x": [4, 5]}}, {"occlusion": {"which": ["sphere", "book"]}},
    ],
)  # fmt: skip
def test_where_nothing_moves_nothing_is_said(controls: dict[str, Any]) -> None:
    assert space_of(load_description("mug"), **controls).adjusted_defaults == ()


class Screen(NullProgress):
    """Keeps what is said."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def message(self, text: str) -> None:
        self.said.append(text)


@pytest.mark.medium
def test_what_moved_is_in_the_summary_in_the_report_and_on_the_screen(tmp_path: Path) -> None:
    screen = Screen()
    result = advsearch.attack(
        "mug", controls={"pose": {"yaw": [90, 180]}}, policy="random", steps=1, trials=6, resolution=16, spp=1,
        verify_spp=1, baseline=False, run=tmp_path / "run", progress=screen,
    )  # fmt: skip
    summary = result.summary
    assert to_json_value(summary.clean.moved) == [
        {"parameter": "pose.yaw", "unit": "degrees", "scene": 0.0, "used": 90.0}
    ]
    said = "The clean scene has pose.yaw 90 degrees instead of 0, which the control pose leaves out."
    assert said in summary.warnings and said in screen.said
    assert said in (tmp_path / "run" / "report.html").read_text("utf-8")


# ---- a control says what the setting of the same name says ----------------------------------------------------------


@pytest.mark.parametrize("environment", ["noon", "kitchen"])
def test_an_environment_that_is_chosen_is_the_environment(environment: str) -> None:
    own = EnvironmentAsset("mine", torch.rand(16, 32, 3).numpy())
    scene = advsearch.load_scene("mug", own)
    chosen = scene.renderer({"environment": {"which": ["own", "noon", "kitchen"]}}, resolution=16, denoise="none")
    u = torch.tensor([0.5 if environment == "noon" else 0.9])
    plain = advsearch.load_scene("mug", environment).renderer({"lens": {}}, resolution=16, denoise="none")
    difference = chosen(u, seed=1, spp=4) - plain(plain.start, seed=1, spp=4)
    assert float(difference.abs().max()) < 0.1 / 255.0
    assert bool(torch.isfinite(chosen.gradient(torch.mean, u, 0, 2)[1]).all())


def test_an_exposure_that_is_searched_is_over_the_metered_one_and_not_over_the_one_that_is_set() -> None:
    scene = advsearch.load_scene("mug", settings={"camera.exposure": 1.0})
    searched = scene.renderer({"camera": {"exposure": [-2, 2]}}, resolution=16, denoise="none")
    plain = scene.renderer({"camera": {"roll": [-1, 1]}}, resolution=16, denoise="none")
    assert torch.equal(searched(searched.start, seed=1, spp=2), plain(plain.start, seed=1, spp=2))


def test_a_distance_that_is_set_does_not_follow_the_field_of_view() -> None:
    near = load_description("mug", setting_values={"camera.distance": 2.0})
    for scene, stays in ((near, True), (load_description("mug"), False)):
        space = space_of(scene, camera={"fov": [20, 60]})
        near_end, far_end = (space.inputs(torch.tensor([share]))["camera.to_world"][:3, 3] for share in (0.0, 1.0))
        assert torch.allclose(near_end, far_end) is stays


# ---- sweeps ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"environment": "studio,loft", "grid": {"environment.which": ["noon", "kitchen"]}},
            "--environment studio,loft and --grid environment.which both choose what lights the scene; name",
        ),
        (
            {"environment": "studio,loft", "controls": {"environment": {"which": ["own", "noon"]}}},
            "--environment studio,loft and --control environment both choose what lights the scene",
        ),
        ({"environment": "loft", "grid": {"environment.which": ["noon"]}}, "--environment loft and --control environ"),
        (
            {"set": AZIMUTH, "controls": {"camera": {}}},
            "--control camera: draws azimuth by chance, and --set camera.az",
        ),
        ({"set": AZIMUTH, "grid": {"camera.azimuth": [130, 140]}}, "--grid camera.azimuth: --set fixes it already"),
        ({"exposure": 1.0, "grid": {"camera.exposure": [0, 1]}}, "--grid camera.exposure: --set fixes it already"),
    ],
)
def test_a_sweep_refuses_what_contradicts_its_scenes(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as error:
        sweep_from_config(SweepConfig(**{"object": "mug", "trials": 0, **options}))
    assert message in format_as_flags(str(error.value))


def test_the_grid_of_a_control_of_ones_own_is_checked_too() -> None:
    class Squat(PoseControl):
        kind = "squat"

    controls = [Squat(roll=[0, 10])]
    found = advsearch.sweep("mug", grid={"squat.yaw": [0, 90]}, controls=controls, trials=0, resolution=8, spp=1)
    assert [row.values["squat.yaw"]["value"] for row in found.rows()] == [0.0, 90.0]


def test_a_sweep_of_a_loaded_scene_refuses_the_same() -> None:
    scene = advsearch.load_scene("mug", settings=AZIMUTH)
    with pytest.raises(InputError, match="fixes it already"):
        advsearch.sweep(scene, grid={"camera.azimuth": [130, 140]})


@pytest.mark.medium
def test_a_row_names_the_environment_that_lights_it() -> None:
    plain: dict[str, Any] = {"resolution": 8, "spp": 1, "trials": 0}

    def lit_by(**options: Any) -> list[Any]:
        found = advsearch.sweep("mug", **options, **plain)
        named = [row.values["environment"]["value"] for row in found.rows()]
        assert found.summary.environment == (named[0] if len(set(named)) == 1 else "studio")
        return named

    assert lit_by(grid={"environment.which": ["noon", "own"]}) == ["noon", "studio"]
    assert lit_by(controls={"environment": {"which": "noon", "rotation": [0, 90]}}, samples=1) == ["noon"]
    assert lit_by(controls=["sky"], samples=1) == ["sky"]
    assert lit_by(grid={"pose.yaw": [0]}) == ["studio"]
