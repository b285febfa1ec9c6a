"""The clean scene is the one that the object, the environment and the settings describe: otherwise it is refused or
said."""

from typing import Any

import pytest
import torch

import advsearch
from advsearch.cli.flags import format_as_flags
from advsearch.controls import Space, make_control, make_space
from advsearch.errors import InputError
from advsearch.questions.sweep.carry_out import sweep_from_config
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.description import SceneDescription, load_description

AZIMUTH = {"camera.azimuth": 130.0}


def space_of(scene: SceneDescription, **controls: dict[str, Any]) -> Space:
    return make_space([make_control(name, given) for name, given in controls.items()], scene)


REFUSED: list[Any] = [
    ({"camera.elevation": 80.0}, "studio", {"camera": {"elevation": [5, 30]}}, "--set camera.elevation=80"),
    ({"pose.yaw": 0.0}, "studio", {"pose": {"yaw": {"choices": [10, 20]}}}, "pose.yaw is one of 10, 20"),
    ({"pose.yaw": 10.0}, "studio", {"mine": {"kind": "pose", "yaw": [20, 30]}}, "--control mine"),
    ({"camera.fov": 50.0}, "studio", {"camera": {"focal_length": [10, 20]}}, "38.6"),
    ({}, "loft", {"environment": {"which": ["noon", "kitchen"]}}, "--environment loft"),
    pytest.param({}, "loft", {"sky": {}}, "--control sky", marks=pytest.mark.island("advsearch.controls.sky")),
    pytest.param(
        {"ground.size": 5.0}, "studio", {"background": {}}, "--set ground.size=5",
        marks=pytest.mark.island("advsearch.controls.background"),
    ),
    ({"material.roughness": 0.9}, "studio", {"material": {"which": ["wood", "marble"]}}, "--set material.roughness"),
]  # fmt: skip


@pytest.mark.parametrize(("given", "environment", "controls", "named"), REFUSED)
def test_a_control_that_leaves_out_what_was_asked_for_is_refused(
    given: dict[str, float], environment: str, controls: dict[str, Any], named: str
) -> None:
    with pytest.raises(InputError) as error:
        space_of(load_description("mug", environment, setting_values=given), **controls)
    assert named in format_as_flags(str(error.value))


@pytest.mark.parametrize(
    ("given", "environment", "controls"),
    [
        (AZIMUTH, "studio", {"camera": {"azimuth": 130}}),
        (AZIMUTH, "studio", {"camera": {"azimuth": -230}}),
        (AZIMUTH, "studio", {"camera": {"azimuth": [0, 360]}}),
        (AZIMUTH, "studio", {"camera": {"elevation": [5, 60]}}),
        ({"camera.fov": 50.0}, "studio", {"camera": {"focal_length": [30, 60]}}),
        ({}, "noon", {"environment": {"which": ["kitchen", "noon"]}}),
        ({}, "loft", {"environment": {"which": ["own", "noon"]}}),
        pytest.param(
            {"ground.size": 5.0}, "studio", {"background": {"ground": "keep", "what": ["environment", "colour"]}},
            marks=pytest.mark.island("advsearch.controls.background"),
        ),
    ],
)  # fmt: skip
def test_a_control_that_agrees_starts_at_what_was_asked_for(
    given: dict[str, float], environment: str, controls: dict[str, Any]
) -> None:
    scene = load_description("mug", environment, setting_values=given)
    space = space_of(scene, **controls)
    assert space.adjusted_defaults == ()
    for name, value in space.describe(space.start).items():
        if name in given and isinstance(value["value"], float):
            assert (value["value"] - given[name]) % 360.0 == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("environment", ["noon", "kitchen"])
def test_an_environment_that_is_chosen_is_the_environment(environment: str) -> None:
    own = EnvironmentAsset("mine", torch.rand(16, 32, 3).numpy())
    scene = advsearch.load_scene("mug", own)
    chosen = scene.renderer({"environment": {"which": ["own", "noon", "kitchen"]}}, resolution=16, denoise="none")
    u = torch.tensor([0.5 if environment == "noon" else 0.9])
    plain = advsearch.load_scene("mug", environment).renderer(
        {"camera": {"roll": [-1, 1]}}, resolution=16, denoise="none"
    )
    difference = chosen(u, seed=1, spp=4) - plain(plain.start, seed=1, spp=4)
    assert float(difference.abs().max()) < 0.1 / 255.0
    assert bool(torch.isfinite(chosen.gradient(torch.mean, u, 0, 2)[1]).all())


def test_an_exposure_that_is_searched_is_over_the_metered_one_and_not_over_the_one_that_is_set() -> None:
    scene = advsearch.load_scene("mug", settings={"camera.exposure": 1.0})
    searched = scene.renderer({"camera": {"exposure": [-2, 2]}}, resolution=16, denoise="none")
    plain = scene.renderer({"camera": {"roll": [-1, 1]}}, resolution=16, denoise="none")
    assert torch.equal(searched(searched.start, seed=1, spp=2), plain(plain.start, seed=1, spp=2))


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"environment": "studio,loft", "grid": {"environment.which": ["noon", "kitchen"]}}, "--environment studio"),
        ({"set": AZIMUTH, "controls": {"camera": {}}}, "--control camera"),
        ({"exposure": 1.0, "grid": {"camera.exposure": [0, 1]}}, "--grid camera.exposure"),
    ],
)
def test_a_sweep_refuses_what_contradicts_its_scenes(options: dict[str, Any], named: str) -> None:
    with pytest.raises(InputError) as error:
        sweep_from_config(SweepConfig(**{"object": "mug", "trials": 0, **options}))
    assert named in format_as_flags(str(error.value))
