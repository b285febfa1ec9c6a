"""What searches leave out changes neither pictures nor gradients, and bounces only within a bound."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch

from advsearch import attack, load_scene
from advsearch.attacks import Query
from advsearch.cli.output import format_result as text_of
from advsearch.controls import CameraControl, LightControl, MaterialControl, TextureControl
from advsearch.engine.gradients import find_interior_point, make_smooth_loss
from advsearch.engine.gradients.planning import MAX_CHANGE, measure_path_length
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.check import check
from advsearch.questions.check.leaving_out import ALL, WHAT, measure_gains, measure_texels
from advsearch.questions.check.result import CheckConfig
from advsearch.scene.formation import ALL_OMISSIONS, NO_OMISSIONS, OMISSIONS
from advsearch.scene.renderer import Renderer
from covering import only

SIZE = 40


def made(controls: Any, object: str = "mug", environment: str = "studio", denoiser: str = "none") -> Renderer:
    return load_scene(object, environment).renderer(controls, resolution=SIZE, denoise=denoiser)


@pytest.mark.medium
@pytest.mark.parametrize("control", only(["texture"], ["texture", "haze"]))
def test_nothing_that_is_left_out_changes_a_picture_or_a_gradient(control: str) -> None:
    renderer = made(control)
    loss, u = make_smooth_loss((SIZE, SIZE)), find_interior_point(renderer)
    full = renderer.copy_with(renderer.scene.copy_with(leave_out=NO_OMISSIONS))
    with torch.no_grad():
        noise = (renderer(u, 100, 4) - renderer(u, 101, 4)).norm()
        for seed in range(3):  # the second is replayed where the first was recorded
            assert (full(u, seed, 4) - renderer(u, seed, 4)).norm() <= 0.01 * noise
    mine, theirs = (one.gradient(loss, u, 5, 4)[1] for one in (renderer, full))
    assert mine.norm() > 0.0
    assert (mine - theirs).norm() <= 0.01 * mine.norm()


@pytest.mark.medium
def test_putting_an_item_back_takes_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = made("texture")
    written: list[str] = []
    note: Any = written.append

    def adjoints(item: str) -> tuple[set[str], set[str]]:
        scene = renderer.scene.copy_with(leave_out=ALL_OMISSIONS - {item})
        names = {key: name for name, (key, _) in scene.declared_inputs.items()}
        inner = scene.parameters.set_dirty
        monkeypatch.setattr(scene.parameters, "set_dirty", lambda key: [note(names[key]), inner(key)])
        inputs = {"object.base_color": scene.get_base_value("object.base_color") * 0.5}
        scene.render_radiance(inputs, 0, 1)
        by_render = set(written)
        written.clear()
        scene.render_adjoint(inputs, torch.ones(SIZE, SIZE, 3), 0, 1)
        by_adjoint = set(written)
        written.clear()
        return by_render, by_adjoint

    only = {"object.base_color"}
    assert adjoints("tracing") == (only, only)
    every, _ = adjoints("uploads")
    assert {"environment.padded", "object.vertices", "camera.to_world"} <= every
    _, differentiated = adjoints("gradients")
    assert {"environment.padded", "object.roughness"} <= differentiated and "object.vertices" not in differentiated
    _, differentiated = adjoints("boundary")
    assert {"object.base_color", "object.vertices"} <= differentiated


@pytest.mark.slow
def test_gains_have_a_row_for_each_item_and_their_proof() -> None:
    renderer = made("texture")
    rows = measure_gains(renderer, make_smooth_loss((SIZE, SIZE)), renderer.start, seed=1, spp=2, repeats=2, depth=4)
    assert [row.item for row in rows] == [*OMISSIONS, "bounces", ALL]
    assert {row.item for row in rows} == set(WHAT)
    assert all(row.time_gain > 0.0 and row.safe for row in rows)


@pytest.mark.medium
def test_what_changes_the_picture_is_not_called_safe(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advsearch.questions.check.leaving_out.ITEMS", {"tracing": ""})
    monkeypatch.setattr("advsearch.questions.check.leaving_out.NOTHING", ALL_OMISSIONS)
    renderer = made("camera.exposure")
    rows = measure_gains(renderer, make_smooth_loss((SIZE, SIZE)), renderer.start, seed=1, spp=128, repeats=2, depth=2)
    tracing, bounces, _ = rows
    assert tracing.picture_difference < 1e-5 and tracing.safe  # a recorded kernel rounds otherwise
    assert tracing.time_gain > 0.0
    assert bounces.item == "bounces" and bounces.picture_difference > 1.0 and not bounces.safe


@pytest.mark.medium
def test_bounces_are_cut_where_they_are_dark_and_not_where_they_are_seen() -> None:
    dark, light = made("texture", "bottle", "noon"), made("texture", "mug", "studio")
    cut = measure_path_length(dark, [dark.start], seed=0, spp=4)
    assert cut.depth < cut.full == dark.scene.max_depth
    kept = {one.depth: one for one in cut.cuts}
    assert kept[cut.depth].levels <= MAX_CHANGE < kept[cut.depth - 1].levels
    assert "segments leave out" in cut.reason
    seen = measure_path_length(light, [light.start], seed=0, spp=4)
    assert seen.depth > cut.depth and seen.cuts[-1].levels > MAX_CHANGE
    assert dark.scene.depth == dark.scene.max_depth


@pytest.mark.medium
def test_the_measured_bias_does_not_depend_on_the_noise() -> None:
    renderer = made("texture")
    few, many = (
        measure_path_length(renderer, [renderer.start], seed=3, spp=spp, bound=1e9).cuts[-1] for spp in (4, 256)
    )
    assert few.depth == many.depth == 2 and few.levels == pytest.approx(many.levels, rel=0.2)
    assert few.light == pytest.approx(many.light, rel=0.1)


def test_a_black_scene_needs_no_bounces() -> None:
    renderer = made({"camera": {"exposure": [-10.0, -9.0]}})
    cut = measure_path_length(renderer, [torch.zeros_like(renderer.start)], seed=0, spp=1)
    assert cut.depth == 2 and cut.cuts[-1].levels <= MAX_CHANGE


@pytest.mark.medium
def test_searches_cut_paths_and_verifications_do_not() -> None:
    config = AttackConfig(object="bowl", controls={"texture": {}}, denoise="none", resolution=(SIZE, SIZE))
    problem, _ = problem_from_config(config)
    start = problem.domain.start
    seen: list[torch.Tensor] = []
    searched, tried = Query(start, 0, phase="search", with_image=True), Query(start, 3, spp=8)
    trial = problem.evaluate(tried)
    for depth, gradient in ((None, False), (2, False), (2, True)):
        problem.search_depth = depth
        picture = problem.evaluate(replace(searched, gradient=gradient)).picture
        assert picture is not None
        seen.append(picture)
    assert seen[1].mean() < seen[0].mean() - 0.005 and torch.equal(seen[1], seen[2])
    assert problem.evaluate(tried).required_judgement == trial.required_judgement


@pytest.mark.medium
def test_a_long_search_says_what_paths_it_rendered() -> None:
    options: dict[str, Any] = {"controls": "camera.exposure", "steps": 1, "trials": 6, "verify_spp": 4}
    options |= {"resolution": SIZE}
    options |= {"environment": "noon", "baseline": False, "measure": "full", "denoise": "none", "spp": 2}
    found = attack("bottle", **options)
    segments = found.summary.light_path_segments
    assert 2 <= segments.search < segments.verification == 6
    whole = attack("bottle", **{**options, "specialise": False})
    assert whole.summary.light_path_segments.to_dict() == {"search": 6, "verification": 6}


@pytest.mark.medium
def test_texels_beyond_what_a_pixel_shows_are_counted() -> None:
    fine = made({"texture": {"resolution": 512}})
    (found,) = measure_texels(fine, fine.start, seed=0, spp=64)
    assert found.side == 512 and 0 < found.pixels < SIZE**2
    assert found.enough < 512 and found.seen > 4 * found.pixels
    coarse = made({"texture": {"resolution": 16}})
    (found,) = measure_texels(coarse, coarse.start, seed=0, spp=64)
    assert found.enough == found.side == 16
    assert measure_texels(made("light"), made("light").start, seed=0) == []


@pytest.mark.slow
@pytest.mark.parametrize("specialise", [True, False])
def test_a_check_shows_what_is_left_out(specialise: bool, tmp_path: Path) -> None:
    config = CheckConfig(
        loss="model",
        object="mug",
        controls={"texture": {"resolution": 32}},
        resolution=(32, 32),
        spp=2,
        denoise="none",
        specialise=specialise,
        run=str(tmp_path / "run"),
    )
    found = check.run(config)
    said = text_of(found)
    if specialise:
        assert {row.item for row in found.gains} >= {*OMISSIONS, ALL}
        assert found.bounces is not None and found.bounces.reason in said and "texels of texture" in said
    else:
        assert not found.gains and "nothing (--no-specialise)" in said


def test_every_input_of_a_light_has_a_base_value() -> None:
    scene = made("light").scene
    assert all(torch.isfinite(scene.get_base_value(name)).all() for name in scene.input_names)
    assert scene.get_base_value("light.radiance").shape == (3,)


def test_a_shorter_path_is_only_for_the_block() -> None:
    scene = made("texture").scene
    with scene.limit_depth(3):
        assert scene.depth == 3
        with scene.limit_depth(None):
            assert scene.depth == 3
        with scene.limit_depth(50):
            assert scene.depth == scene.max_depth
    assert scene.depth == scene.max_depth


def two_lamps(power: float) -> Renderer:
    """The mug in the studio with a lamp, and another of some power."""
    lamps = [LightControl(name="key", type="point", power=6.0), LightControl(name="fill", type="area", power=power)]
    return load_scene("mug").renderer([TextureControl(resolution=16), *lamps], resolution=SIZE, denoise="none")


@pytest.mark.medium
def test_dark_lamps_get_no_samples_and_change_nothing_but_noise() -> None:
    renderer = two_lamps(0.0)
    full = renderer.copy_with(renderer.scene.copy_with(leave_out=ALL_OMISSIONS - {"emitters"}))
    with torch.no_grad():
        mine, theirs = (torch.stack([one(renderer.start, seed, 16) for seed in range(12)]) for one in (renderer, full))
    noise, other = float(mine.var(0).mean()), float(theirs.var(0).mean())
    assert 1.2 * noise < other
    assert float((mine.mean(0) - theirs.mean(0)).square().mean()) < 1.5 * (noise + other) / 12


def test_lamps_that_shine_or_may_shine_are_sampled() -> None:
    def weights(renderer: Renderer) -> list[float]:
        parameters = renderer.scene.parameters
        return [float(parameters[key]) for key in sorted(parameters.keys()) if key.endswith("sampling_weight")]

    assert sorted(weights(two_lamps(0.0)))[:2] == [0.0, 1.0] and min(weights(two_lamps(1.0))) == 1.0


NUMBERS = ("roughness", "metallic", "specular", "clearcoat")
ENDS = [dict(zip(NUMBERS, values, strict=True)) for values in product((0.0, 1.0), repeat=len(NUMBERS))]
QUICK = [ENDS[int("".join(map(str, ends)), 2)] for ends in ((1, 1, 0, 0), (0, 0, 1, 1), (1, 0, 0, 1))]


@pytest.mark.medium
@pytest.mark.parametrize("ends", only(QUICK, ENDS), ids=lambda one: "".join(f"{end:g}" for end in one.values()))
def test_a_material_looks_the_same_however_its_numbers_come_and_whatever_is_left_out(ends: dict[str, float]) -> None:
    """Fixed, searched, and searched from the other ends, at both ends of every number."""
    searched = MaterialControl(**{name: [0.0, 1.0] for name in NUMBERS})
    other = {name: 1.0 - value for name, value in ends.items()}
    pictures = []
    for control, start in ((CameraControl(exposure=[0, 1]), ends), (searched, ends), (searched, other)):
        settings = {f"material.{name}": value for name, value in start.items()}
        renderer = load_scene("ball", "studio", settings=settings).renderer([control], resolution=24, denoise="none")
        u = torch.tensor(list(ends.values())) if control is searched else renderer.start
        with torch.no_grad():
            pictures += [
                renderer(u, 3, 16),
                renderer.copy_with(renderer.scene.copy_with(leave_out=NO_OMISSIONS))(u, 3, 16),
            ]
    assert max(float((one - pictures[0]).abs().mean()) for one in pictures) < 1e-3


@pytest.mark.medium
def test_a_metal_looks_the_same_whatever_reflection_paint_would_have() -> None:
    """Mitsuba's own metal is black at a specular of exactly 0."""
    pictures = []
    for specular in (0.0, 0.5):
        settings = {"material.metallic": 1.0, "material.specular": specular, "material.clearcoat": 0.0}
        renderer = load_scene("ball", "studio", settings=settings).renderer("camera", resolution=24, denoise="none")
        with torch.no_grad():
            pictures.append(renderer(renderer.start, 3, 16))
    assert float((pictures[0] - pictures[1]).abs().mean()) < 1e-3 < float(pictures[0].mean())
