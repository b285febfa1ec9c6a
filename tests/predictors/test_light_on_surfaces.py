"""Pictures from light that is kept on surfaces, beside traced ones."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from advsearch.engine.loading import Scene, load_scene
from advsearch.predictors.surface_light import arrangement, texels
from advsearch.predictors.surface_light.renderer import SurfaceRenderer, find_refusal
from advsearch.predictors.surface_light.texels import prepare_sky
from advsearch.scene.library import load_object
from advsearch.scene.predictor import RefusalCause
from advsearch.scene.renderer import Renderer
from small_models import levels

pytestmark = pytest.mark.island("advsearch.predictors.surface_light")

SIDE = 32
VARYING = ["camera", "environment"]


@pytest.fixture(autouse=True, scope="module")
def coarse() -> Iterator[None]:
    """Few texels and rays, which are quick."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(texels, "GROUND_TEXELS", 32)
        for name, value in {"OBJECT_TEXELS": 48, "RAYS_PER_TEXEL": 100}.items():
            patched.setattr(arrangement, name, value)
        yield


def renderer_of(scene: Scene, side: int | tuple[int, int] = SIDE, texture: int = 16) -> Renderer:
    """Render its texture, camera and environment."""
    controls: Mapping[str, object] = {"texture": {"resolution": texture}, "camera": {}, "environment": {}}
    return scene.renderer(controls, resolution=side)


@pytest.fixture(scope="module")
def traced() -> Renderer:
    """The bundled mug."""
    return renderer_of(load_scene("mug"))


@pytest.fixture(scope="module")
def light(traced: Renderer) -> SurfaceRenderer:
    """Its light."""
    return SurfaceRenderer(traced, traced.start, seed=0)


def drawn(of: Renderer, number: int) -> Tensor:
    """A configuration with another camera and another light."""
    u = of.start.clone()
    noise = torch.rand(len(u), generator=torch.Generator().manual_seed(number))
    for group in of.space.groups:
        if group.control in VARYING:
            u[group.coordinates] = noise[group.coordinates]
    return u


def set_to(of: Renderer, value: float, **numbers: float) -> Tensor:
    """The start with an even texture, and some numbers of the camera's range."""
    u = of.start.clone()
    for group in of.space.groups:
        if group.control == "texture":
            u[group.coordinates] = value
        elif group.name.partition(".")[2] in numbers:
            u[group.coordinates] = numbers[group.name.partition(".")[2]]
    return u


@pytest.mark.medium
def test_pictures_are_those_that_are_traced(traced: Renderer, light: SurfaceRenderer) -> None:
    """From other cameras and under other lights, about as near as rendered ones of 8 samples."""
    with torch.no_grad():
        for number in range(3):
            u = drawn(traced, number)
            truth = traced(u, seed=1, spp=256)
            assert levels(light(u), truth) < 1.3 * levels(traced(u, seed=2, spp=8), truth) + 0.5


@pytest.mark.medium
@pytest.mark.parametrize(
    ("camera", "fixed"), [("fisheye", {}), (None, {"k1": -0.9, "fov": 60.0}), ("fisheye", {"k1": -0.1})]
)
def test_pictures_through_a_lens_are_those_that_are_traced(camera: str | None, fixed: dict[str, float]) -> None:
    """Ray by ray, so that they are far from what a pinhole sees, and black where the lens sees nothing."""
    scene = load_scene("mug", camera=camera)
    traced = scene.renderer({"texture": {"resolution": 16}, "camera": {"azimuth": [0, 360], **fixed}}, resolution=SIDE)
    assert find_refusal(traced, ["camera"]) is None
    light = SurfaceRenderer(traced, traced.start, seed=0)
    u = drawn(traced, 1)
    with torch.no_grad():
        truth = traced(u, seed=1, spp=256)
        assert levels(light(u), truth) < 1.3 * levels(traced(u, seed=2, spp=8), truth) + 0.5
        assert float(light(u)[:2, :2].max()) == 0.0


@pytest.mark.medium
def test_the_derivative_is_that_of_differences(traced: Renderer) -> None:
    """Of radiance in the texture, in which it is linear but for the curve between both."""
    linear = SurfaceRenderer(traced.copy_with(transfer="linear"), traced.start, seed=0)
    u = set_to(traced, 0.5).requires_grad_()
    generator = torch.Generator().manual_seed(3)
    weights = torch.rand(SIDE, SIDE, 3, generator=generator) - 0.5
    way = torch.zeros(len(u))
    texture = next(group for group in traced.space.groups if group.control == "texture")
    way[texture.coordinates] = torch.rand(texture.size, generator=generator) - 0.5
    (found,) = torch.autograd.grad((linear(u) * weights).sum(), u)
    with torch.no_grad():
        ends = [(linear(u + sign * 1e-2 * way).double() * weights).sum() for sign in (1.0, -1.0)]
    assert float(found @ way) == pytest.approx(float(ends[0] - ends[1]) / 2e-2, rel=2e-3)


@pytest.mark.medium
@pytest.mark.parametrize("size", [(24, 40), (40, 24)])
def test_rays_go_where_those_of_the_camera_do(size: tuple[int, int]) -> None:
    """Surfaces are where Mitsuba's own camera sees them, with a shifted picture of any shape and another lens."""
    scene = load_scene("mug", settings={"ground.size": 1.0})
    camera = {"shift_x": 0.2, "shift_y": -0.1, "fov": 50.0, "roll": 20.0, "azimuth": [0, 360]}
    of = scene.renderer({"camera": camera}, resolution=size)
    made = SurfaceRenderer(of, of.start, seed=0)
    inputs = of.scene.input_assembler(of.space.inputs(of.start))
    cameras = [{name: inputs.get(name, of.scene.get_base_value(name)) for name in arrangement.CAMERA_INPUTS}]
    covered = made.arrangement.start_tracing(cameras, made.compute_light(inputs))().coverage[0, ..., 0]
    same = (covered > 0.5) == (of.find_surfaces(of.start).id > 0)
    assert 0.1 < float((covered > 0.5).float().mean()) < 0.9
    assert float(same.float().mean()) > 0.97


@pytest.mark.medium
def test_what_is_seen_of_a_photographed_room_is_its_map() -> None:
    """A photographed ground shows the photograph, and where a ray escapes there is the map."""
    scene = load_scene("ball", "kitchen", settings={"ground.kind": "photograph"})
    of = scene.renderer({"camera": {"azimuth": [0, 360], "elevation": [5, 60]}}, resolution=SIDE)
    made, u = SurfaceRenderer(of, of.start, seed=0), torch.tensor([0.4, 0.1])
    with torch.no_grad():
        truth = of(u, seed=1, spp=256)
        away = ~of.compute_object_mask(u)
        assert levels(made(u)[away], truth[away]) < 8.0


STRANGE = {
    "inside": {"distance": 0.0, "elevation": 1.0},
    "close": {"distance": 0.02, "elevation": 0.0},
    "far": {"distance": 1.0},
}


@pytest.mark.medium
@pytest.mark.parametrize("value", [0.0, 1.0])
@pytest.mark.parametrize("place", STRANGE)
def test_strange_views_have_finite_pictures_and_derivatives(value: float, place: str) -> None:
    """A camera inside of the mug, one at its surface and one far off, under a black and a white map of light."""
    scene = load_scene("mug")
    camera = {"distance": [0.05, 40.0], "elevation": [0.0, 89.0], "azimuth": [0, 360]}
    controls = {"texture": {"resolution": 2}, "camera": camera, "environment": {"exposure": [-10, 6]}}
    of = scene.renderer(controls, resolution=16)
    made = SurfaceRenderer(of, of.start, seed=0)
    u = set_to(of, value, exposure=value, **STRANGE[place]).requires_grad_()
    picture = made(u)
    (found,) = torch.autograd.grad(picture.sum(), u)
    assert bool(torch.isfinite(picture).all()) and bool(torch.isfinite(found).all())
    assert 0.0 <= float(picture.detach().min()) and float(picture.detach().max()) <= 1.0


@pytest.mark.medium
def test_light_between_surfaces_follows_the_texture_when_it_is_renewed(traced: Renderer) -> None:
    """A black mug sends nothing to its inside."""
    made, black = SurfaceRenderer(traced, traced.start, seed=0), set_to(traced, 0.0)
    white = set_to(traced, 1.0)
    with torch.no_grad():
        before = made(white).mean()
        made.update_base_color(black)
        after = made(white).mean()
    assert float(after) < float(before)


@pytest.mark.medium
def test_what_it_cannot_predict_is_refused_before_anything_is_measured() -> None:
    mug = load_scene("mug")
    yaw, lamp = {"pose": {"yaw": [0, 9]}}, {"texture": {"resolution": 2}, "light": {"power": [0, 9]}}
    still = find_refusal(mug.renderer({"environment": {"exposure": [0, 1]}}, resolution=8), ["environment"])
    assert still is not None and still.cause is RefusalCause.NO_CAMERA
    assert find_refusal(renderer_of(mug), VARYING) is None
    assert find_refusal(mug.renderer(yaw, resolution=8), ["pose"])
    assert find_refusal(mug.renderer(lamp, resolution=8), ["light"])
    assert "pose.yaw" in str(find_refusal(mug.renderer(yaw, resolution=8), []))
    assert find_refusal(mug.renderer({"camera": {"azimuth": [0, 9]}}, resolution=8, denoise="none"), ["camera"])


def cut(opacity: float) -> Renderer:
    """A ball with a band cut out, which lets light through to its inside and to what is behind it."""
    ball = load_object("ball")
    share = np.ones((32, 32), np.float32)
    share[10:22] = opacity
    return renderer_of(load_scene(replace(ball, opacity=share)))


@pytest.fixture(scope="module")
def whole() -> SurfaceRenderer:
    """Light on the ball without the band."""
    ball = cut(1.0)
    return SurfaceRenderer(ball, ball.start, seed=0)


@pytest.mark.medium
@pytest.mark.parametrize("opacity", [0.0, 0.4])
def test_light_passes_cut_outs(opacity: float, whole: SurfaceRenderer) -> None:
    """What is behind them is seen, with the light that comes in; without that a picture is much further off."""
    of = cut(opacity)
    made = SurfaceRenderer(of, of.start, seed=0)
    assert find_refusal(of, VARYING) is None and made.arrangement.n_sides == 2 and whole.arrangement.n_sides == 1
    with torch.no_grad():
        for number in range(2):
            u = drawn(of, number)
            truth = of(u, seed=1, spp=256)
            assert levels(made(u), truth) < min(5.0, 0.5 * levels(whole(u), truth))


def test_a_sun_of_one_texel_is_as_wide_as_the_map_shows_it() -> None:
    """Looked up between texels it is a tent, a texel to each side, whose variance is a sixth of a texel squared."""
    padded = torch.full((16, 34, 3), 0.3)
    padded[7, 12] = 1e5
    ways, light = (sky := prepare_sky(padded)).hot_directions, sky.hot_light
    row, column = ways[:, 1].acos() * (15.0 / torch.pi), torch.atan2(ways[:, 0], -ways[:, 2]) * (16.0 / torch.pi)
    for found, middle in ((row, 7.0), (column, 11.5)):
        assert float(found.mean()) == pytest.approx(middle, abs=0.01)
        assert float(found.var()) == pytest.approx(1.0 / 6.0, rel=0.1)
        assert float((found - middle).abs().max()) < 1.0
    solid = (torch.pi / 15.0) * (torch.pi / 16.0) * torch.sin(torch.tensor(7.0 * torch.pi / 15.0))
    assert float(light.sum(dim=0)[0]) == pytest.approx(1e5 * float(solid), rel=0.03)  # the rest is left to the cells


@pytest.mark.medium
def test_exposures_of_one_map_share_its_light(traced: Renderer, light: SurfaceRenderer) -> None:
    """Its pictures are those of light that was found for the other exposure; a turned map has a light of its own."""
    first = drawn(traced, 1)
    brighter, turned = first.clone(), first.clone()
    for group in traced.space.groups:
        for changed, name in ((brighter, "environment.exposure"), (turned, "environment.rotation")):
            if group.name == name:
                changed[group.coordinates] = 1.0 - 0.8 * first[group.coordinates]
    assert not torch.equal(brighter, first) and not torch.equal(turned, first)
    with torch.no_grad():
        inputs = [traced.scene.input_assembler(traced.space.inputs(u)) for u in (first, brighter, turned)]
        lights, factors = zip(*map(light.get_light_and_factor, inputs), strict=True)
        own = SurfaceRenderer(traced, traced.start, seed=0)(brighter)
        assert lights[1] is lights[0] and lights[2] is not lights[0]
        assert float((factors[1] - factors[0]).abs().min()) > 0.05
        torch.testing.assert_close(light(brighter), own, rtol=1e-3, atol=1e-4)


def test_pictures_of_several_cameras_at_once_are_those_of_each(light: SurfaceRenderer) -> None:
    """Two of them under one light, one under another."""
    renderer = light.path_renderer
    first, second = drawn(renderer, 0), drawn(renderer, 1)
    third = second.clone()
    for group in renderer.space.groups:
        if group.control == "environment":
            third[group.coordinates] = first[group.coordinates]
    wholes = [first, second, third]
    with torch.no_grad():
        inputs = [light.compute_inputs(one) for one in wholes]
        together = light.compose_images(light.trace_views(inputs), inputs, light.get_color(inputs[0]), wholes)
        assert torch.equal(together, torch.stack([light(one) for one in wholes]))
