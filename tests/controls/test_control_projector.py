"""The projector control: its light in the scene's units, its derivatives, its matrix, its files, and in which ambient
light it ends."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.controls import make_control
from advsearch.controls.projector.projector import DEFAULT_AMBIENT_LUX, ProjectorControl
from advsearch.controls.space import Space
from advsearch.errors import InputError
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.files import read_png, write_png
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.description import load_description
from advsearch.scene.geometry import camera_to_world, compute_center
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.lights import BasisRenderer, make_predictor
from samples import make_attacked

pytestmark = pytest.mark.island("advsearch.controls.projector")

DARK = EnvironmentAsset("dark", np.zeros((4, 8, 3), np.float32))
SIDE = 32
ROUNDING = 0.003
"""Relative: no sample depends on the pattern, so that at one seed adjoint and difference are of the same paths."""
SCENES = [("mug", "studio"), ("bowl", "kitchen"), ("bottle", "noon"), ("stop-sign", "avenue-dusk"), ("car", "street")]


def renderer_of(object: str = "mug", environment: str = "studio", side: int = SIDE, **settings: Any) -> Renderer:
    scene = advsearch.load_scene(object, environment=environment)
    return scene.renderer([make_control("projector", {"resolution": 16, **settings})], resolution=side)


def space_of(renderer: Renderer) -> Space:
    assert isinstance(renderer.space, Space)
    return renderer.space


def raw(renderer: Renderer, u: Tensor, spp: int) -> Tensor:
    """Radiance (H, W, 3) without the denoiser, at one seed."""
    return renderer.scene.render_radiance(renderer.scene.input_assembler(renderer.space.inputs(u)), 1, spp)


def smooth(renderer: Renderer, seed: int) -> Tensor:
    """A smooth change of a pattern of 16 x 16: random blocks of 4 x 4 texels."""
    blocks = torch.randn(4, 4, 3, generator=torch.Generator().manual_seed(seed))
    return blocks.repeat_interleave(4, 0).repeat_interleave(4, 1).reshape(-1)


def test_white_puts_its_lumens_over_its_area_on_what_faces_it() -> None:
    """White ground below a projector in the dark: radiance = E(ambient) / pi x lux / ambient lux."""
    scene = load_description(
        "mug", DARK, setting_values={"pose.x": 50.0, "ground.red": 1.0, "ground.green": 1.0, "ground.blue": 1.0}
    )
    control = ProjectorControl(
        elevation=89, distance=3 * scene.size_in_metres, fov=20, lumens=5, ambient=50, resolution=4
    )
    prepared = control.prepare(scene)
    bound = control.bind(prepared)
    white = torch.ones_like(bound.start)
    seen = MitsubaScene(prepared, (SIDE, SIDE)).render_radiance(bound.inputs(white), 0, 64)
    lux = 5.0 / (2.0 * 3.0 * scene.size_in_metres * math.tan(math.radians(10.0))) ** 2
    described = bound.describe(white)
    assert described["projector.white"]["value"] == pytest.approx(lux)
    assert described["projector.beside_ambient"]["value"] == pytest.approx(lux / 50.0)
    farther = (3.0 / (3.0 + compute_center(scene)[2])) ** 2  # the ground is below the middle
    expected = lux / 50.0 * scene.metered_irradiance / math.pi * farther
    camera = camera_to_world(scene)
    x, y, z = -camera[:3, 3] @ camera[:3, :3]
    scale = SIDE / 2.0 / math.tan(math.radians(scene.get_number("camera.fov") / 2.0)) / z
    row, column = int(SIDE / 2.0 - scale * y), int(SIDE / 2.0 - scale * x)
    under = seen[row - 1 : row + 2, column - 1 : column + 2]
    assert torch.allclose(under, torch.full_like(under, expected), rtol=0.02)


@pytest.mark.medium
def test_lux_are_those_of_the_place_where_it_has_a_unit() -> None:
    lit = {
        name: space_of(renderer_of(object, name)) for object, name in (("stop-sign", "avenue-dusk"), ("mug", "studio"))
    }
    dusk, studio = (space.controls[0] for space in lit.values())
    assert isinstance(dusk, ProjectorControl) and isinstance(studio, ProjectorControl)
    assert dusk.ambient_lux is not None and 5.0 < dusk.ambient_lux < 50.0  # civil dusk
    assert studio.ambient_lux == DEFAULT_AMBIENT_LUX
    assert any("lux" in note for note in lit["studio"].list_notes(studio.scene))
    assert not any("lux" in note for note in lit["avenue-dusk"].list_notes(dusk.scene))


@pytest.mark.medium
def test_the_picture_without_light_is_that_without_a_projector_and_all_others_are_brighter() -> None:
    renderer = renderer_of()
    some = torch.rand(len(renderer.start), generator=torch.Generator().manual_seed(0))
    dark, lit = (raw(renderer, u, 16) for u in (renderer.start, some))
    assert bool((lit >= dark - 1e-6).all()) and float((lit - dark).mean()) > 0.01
    without = advsearch.load_scene("mug").renderer(["lens"], resolution=SIDE)
    ours, plain = raw(renderer, renderer.start, 4096), raw(without, without.start, 4096)
    assert float((ours - plain).abs().mean()) < 0.01 * float(plain.mean())


@pytest.mark.medium
def test_the_adjoint_is_the_difference() -> None:
    renderer = renderer_of()
    scene, generator = renderer.scene, torch.Generator().manual_seed(2)
    inputs = renderer.scene.input_assembler(renderer.space.inputs(0.5 + 0.0 * renderer.start))
    change = torch.rand(inputs["projector.pattern"].shape, generator=generator)
    weight = torch.randn(SIDE, SIDE, 3, generator=generator)
    (gradient,) = scene.render_adjoint(inputs, weight, 3, 16, wrt=["projector.pattern"]).values()
    moved = {**inputs, "projector.pattern": inputs["projector.pattern"] + change}
    before, after = (float((scene.render_radiance(one, 3, 16) * weight).sum()) for one in (inputs, moved))
    assert float((gradient * change).sum()) == pytest.approx(after - before, rel=ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize(("object", "environment"), SCENES, ids=lambda one: one)
def test_derivatives_along_smooth_patterns_are_those_of_differences(object: str, environment: str) -> None:
    renderer = renderer_of(object, environment, start="grey")
    scene, u = renderer.scene, renderer.start
    weight = torch.randn(SIDE, SIDE, 3, generator=torch.Generator().manual_seed(4))
    weight = nn.functional.avg_pool2d(weight.permute(2, 0, 1)[None], 5, 1, 2)[0].permute(1, 2, 0)
    inputs = scene.input_assembler(renderer.space.inputs(u))
    pattern = inputs["projector.pattern"]
    ours, theirs = [], []
    for number in range(6):
        change = 0.5 * float(pattern.mean()) * smooth(renderer, number).reshape(pattern.shape)
        gradients = [
            scene.render_adjoint(inputs, weight, 10 * number + k, 64, wrt=["projector.pattern"])["projector.pattern"]
            for k in range(2)
        ]
        ours.append(float((torch.stack(gradients).mean(dim=0) * change).sum()))
        ends = [{**inputs, "projector.pattern": pattern + sign * change} for sign in (-0.5, 0.5)]
        low, high = (float((scene.render_radiance(one, 1000 + number, 256) * weight).sum()) for one in ends)
        theirs.append(high - low)
    cosine = float(nn.functional.cosine_similarity(torch.tensor(ours), torch.tensor(theirs), dim=0))
    assert cosine > 0.99, (ours, theirs)


@pytest.mark.medium
def test_beside_moving_lamps_and_textures_its_light_counts_once() -> None:
    scene = advsearch.load_scene("mug")
    controls = [
        make_control("projector", {"resolution": 8}),
        make_control("light", {"power": [0, 8]}),
        make_control("texture", {"resolution": 8}),
    ]
    renderer = scene.renderer(controls, resolution=24)
    basis = make_predictor(renderer, renderer.start, seed=1)
    assert isinstance(basis, BasisRenderer)
    u = renderer.start.clone()
    u[: 8 * 8 * 3] = 0.6
    u[8 * 8 * 3] = 0.5
    traced, told = renderer.radiance(u, seed=3, spp=1024), basis.renderer.radiance(u)
    assert float((told - traced).abs().mean()) < 0.03 * float(traced.mean())


@pytest.mark.medium
def test_the_stored_png_throws_the_same_picture_and_texels_have_eight_bits(tmp_path: Path) -> None:
    renderer = renderer_of()
    u = torch.rand(len(renderer.start), generator=torch.Generator().manual_seed(3))
    pattern = space_of(renderer).get_artifact_images(u)["projector"]
    file = write_png(tmp_path / "pattern.png", pattern)
    assert torch.equal(torch.from_numpy(read_png(file)), pattern)
    (thrown,) = space_of(renderer).controls
    assert isinstance(thrown, ProjectorControl)
    lumens = next(one for one in thrown.parameter_slots if one.parameter.name == "lumens").parameter.default
    again = advsearch.load_scene("mug").renderer(
        [make_control("projector", {"picture": str(file), "lumens": [0, lumens]})], resolution=SIDE
    )
    assert torch.equal(renderer(u, seed=5, spp=8), again(torch.ones(1), seed=5, spp=8))


@pytest.mark.island("advsearch.cli.exporters.projection")
@pytest.mark.medium
def test_the_export_has_the_picture_marks_and_what_to_set(tmp_path: Path) -> None:
    from advsearch.cli.exporters.projection.images import write_projection

    settings: dict[str, Any] = {"resolution": 4, "lumens": 10}
    config = AttackConfig(object="mug", controls={"projector": settings}, resolution=16)
    u = np.linspace(0.0, 1.0, 4 * 4 * 3)
    run = make_attacked(tmp_path / "run", config, u)
    notes = write_projection(run, tmp_path / "out")
    assert "10 lumens" in notes[0]
    texels = torch.from_numpy(read_png(tmp_path / "out" / "texels.png"))
    assert torch.equal(
        texels, space_of(renderer_of(**settings)).get_artifact_images(torch.from_numpy(u).float())["projector"]
    )
    marks, seen = (read_png(tmp_path / "out" / name) for name in ("marks.png", "seen.png"))
    assert marks.max() == 1.0 and marks.mean() < 0.1 and seen.shape == (16, 16, 3)
    assert {one.name for one in (tmp_path / "out").iterdir()} == {
        "picture.png", "texels.png", "marks.png", "seen.png", "README.txt",
    }  # fmt: skip
    with pytest.raises(InputError, match="there already"):
        write_projection(run, tmp_path / "out")
