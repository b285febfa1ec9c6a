"""Photographs behind the object: what is composed, which camera sees it, and what is refused."""

import json
import math
import shutil
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image
from scipy import ndimage

import advsearch
from advsearch.engine.loading import Scene, fit_camera, scene_to_settings
from advsearch.errors import FileFormatError, InputError
from advsearch.scene import assets
from advsearch.scene.backdrop import (
    compute_front,
    compute_plane_radiance,
    compute_view_settings,
    make_backdrop,
    make_image_inputs,
    make_matrix_camera,
    read_backdrop,
)
from advsearch.scene.depth_pictures import is_depth, read_depth
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.geometry import camera_to_world, project_points
from advsearch.scene.image_quality import blur_image, measure_blur, measure_noise
from advsearch.scene.mitsuba_backend import parts
from advsearch.scene.transport.lights import find_refusal
from advsearch.scene.transport.matrix import LinearRenderer

SIZE = (24, 32)
NO_SHADOW = {"ground.size": 0.0}
AS_RENDERED = {"backdrop.noise": 0.0, "backdrop.blur": 0.0}
make_ground = parts._make_ground


def write_photograph(path: Path, size: tuple[int, int] = SIZE) -> np.ndarray:
    levels = np.random.default_rng(3).integers(0, 256, (*size, 3), dtype=np.uint8)
    Image.fromarray(levels).save(path)
    return levels


def decode(levels: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, written out once more in float64."""
    display = levels.astype(np.float64) / 255.0
    return np.asarray(np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4))


def encode(linear: np.ndarray) -> np.ndarray:
    clipped = np.clip(linear, 0.0, 1.0)
    return np.asarray(np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055))


@pytest.fixture(scope="module")
def photograph(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("photographs") / "desk.png"
    write_photograph(path)
    return path


@pytest.mark.medium
def test_the_picture_is_the_object_over_the_photograph_by_its_coverage(photograph: Path) -> None:
    settings = {"camera.exposure": 0.5, **NO_SHADOW, **AS_RENDERED}
    scene = advsearch.load_scene("mug", backdrop=photograph, settings=settings)
    render = scene.renderer("texture", resolution=SIZE, denoise="none")
    picture = render(render.start, seed=4, spp=16).detach().numpy()
    inputs = render.compute_scene_inputs(render.start)
    rgba = render.render_radiance(inputs, 4, 16, True).detach().double().numpy()
    coverage = rgba[..., 3:]
    assert 0.05 < coverage.mean() < 0.7 and ((coverage > 0.1) & (coverage < 0.9)).sum() > 10
    behind = decode(np.asarray(Image.open(photograph)))
    expected = encode(render.formation.gain * rgba[..., :3] + (1.0 - coverage) * behind)
    np.testing.assert_allclose(picture, expected, atol=2e-6)
    away = coverage[..., 0] == 0.0
    levels = np.round(picture * 255.0).astype(int)
    assert (levels[away] == np.asarray(Image.open(photograph))[away]).all(), "it is left as it is, bit for bit"


@pytest.mark.medium
def test_the_derivative_in_a_photograph_is_that_of_differences(photograph: Path) -> None:
    scene = advsearch.load_scene("mug", backdrop=photograph, settings={"camera.exposure": -1.0, **AS_RENDERED})
    render = scene.renderer({"texture": {"resolution": 4}}, resolution=SIZE, denoise="none")
    weights = torch.linspace(0.5, 1.0, SIZE[1])[None, :, None] * torch.tensor([1.0, -0.5, 0.7])
    u = (0.25 + 0.5 * torch.rand(len(render.start), generator=torch.Generator().manual_seed(2))).requires_grad_()
    direction = torch.randn(len(u), generator=torch.Generator().manual_seed(5))
    (weights * render(u, 1, 256)).sum().backward()
    assert u.grad is not None
    step = 0.02
    with torch.no_grad():
        ends = [(weights * render((u + sign * step * direction).clamp(0, 1), 1, 256)).sum() for sign in (1.0, -1.0)]
    difference = float(ends[0] - ends[1]) / (2.0 * step)
    assert float(u.grad @ direction) == pytest.approx(difference, rel=0.02)


TABLE = {"ground.size": 12.0, "ground.red": 0.5, "ground.green": 0.4, "ground.blue": 0.3}


def make_plastic_ground(description: SceneDescription) -> Any:
    """A table with a coat by Mitsuba's own plugin: reflectance .04, roughness .2."""
    plane = make_ground(description)
    reflectance = plane["bsdf"]["bsdf"]["reflectance"]
    coat = {"type": "roughplastic", "distribution": "ggx", "alpha": 0.04, "int_ior": 1.5, "ext_ior": 1.0}
    return plane | {"bsdf": coat | {"diffuse_reflectance": reflectance}}


@pytest.fixture(scope="module", params=[0.0, 0.04])
def table(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, np.ndarray, np.ndarray, float, float]:
    """A photograph of a table that is a render, and what the same render shows with the mug on it."""
    with pytest.MonkeyPatch.context() as patch:
        if request.param:
            patch.setattr(parts, "_make_ground", make_plastic_ground)
        scene = advsearch.load_scene("mug", settings=TABLE | {"ground.kind": "table"})
        render = scene.renderer("texture", resolution=48, denoise="none")
        full = render(render.start, 0, 400).detach().numpy()
        empty = scene.renderer("texture", resolution=48, denoise="none")
        empty.scene.input_assembler.is_object_hidden = True
        levels = np.round(empty(empty.start, 5, 400).detach().numpy() * 255.0).astype(np.uint8)
    path = tmp_path_factory.mktemp("photographs") / "table.png"
    Image.fromarray(levels).save(path)
    return path, full, render.compute_object_mask(render.start).numpy(), scene.description.gain, request.param


@pytest.mark.medium
def test_the_composition_is_the_full_render_of_the_scene_that_was_photographed(
    table: tuple[Path, np.ndarray, np.ndarray, float, float],
) -> None:
    path, full, mask, gain, gloss = table
    plain = load_description("mug", setting_values=TABLE).with_backdrop(path)
    settings = TABLE | AS_RENDERED | {"camera.exposure": float(np.log2(gain / plain.gain)), "ground.gloss": gloss}
    scene = advsearch.load_scene("mug", settings=settings, backdrop=path)
    render = scene.renderer("texture", resolution=48, denoise="none")
    picture = render(render.start, 1, 400).detach().numpy()
    photograph = np.asarray(Image.open(path)).astype(np.float64) / 255.0
    error = np.abs(picture - full) * 255.0
    in_shadow = ~mask & (np.abs(full - photograph).max(axis=2) * 255.0 > 6.0)
    assert in_shadow.sum() > 100 and np.abs(photograph - full)[in_shadow].mean() * 255.0 > 10.0, "there is a shadow"
    # a coat adds noise to the photograph too, and Mitsuba's takes light from the matt part
    noise = 1.6 if gloss else 1.0
    assert error.mean() < 1.3 * noise, f"{error.mean():.2f} levels"
    assert abs((picture - full)[in_shadow].mean()) * 255.0 < 0.5 * noise, "it is neither darker nor lighter on average"
    # denoised, from a few samples, it is as near
    denoised = scene.renderer("texture", resolution=48)
    few = denoised(denoised.start, 1, 16).detach().numpy()
    assert np.abs(few - full)[in_shadow].mean() * 255.0 < 4.0 * noise


@pytest.mark.medium
def test_the_ground_is_darker_below_the_object_and_as_it_was_far_away(tmp_path: Path) -> None:
    Image.new("RGB", (64, 48), (120, 160, 90)).save(tmp_path / "a.png")
    scene = advsearch.load_scene("mug", backdrop=tmp_path / "a.png", settings={"camera.distance": 0.9})
    for denoise in ("none", "oidn"):
        render = scene.renderer("texture", resolution=(48, 64), denoise=denoise)
        levels = np.round(render(render.start, 0, 36).detach().numpy() * 255.0)
        change = levels - np.array([120, 160, 90])
        mask = render.compute_object_mask(render.start).numpy()
        rows, columns = np.nonzero(mask)
        below = change[rows.max() + 1, columns.min() : columns.max()]
        assert below.min() < -15 and below.mean() < -2, denoise
        corners = [change[:6, :6], change[:6, -6:], change[-4:, :4], change[-4:, -4:]]
        # of a few samples there is one that meets the mug, and changes its pixel by a level
        assert max(np.abs(corner).max() for corner in corners) <= 4, denoise
        assert max(np.abs(corner).mean() for corner in corners[:2]) < 0.3, denoise


@pytest.mark.medium
@pytest.mark.parametrize(
    "control, gloss", [("light.power", 0.0), ("texture", 0.0), ("light.power", 1.0), ("texture", 1.0)]
)
def test_the_derivative_with_a_shadow_is_that_of_differences(tmp_path: Path, control: str, gloss: float) -> None:
    Image.new("RGB", (32, 32), (120, 160, 90)).save(tmp_path / "a.png")
    controls: dict[str, dict[str, object]] = {
        "light.power": {"light": {"power": [0.2, 2.0]}},
        "texture": {"texture": {"resolution": 2}},
    }
    settings = {"camera.exposure": -1.0, "ground.gloss": gloss}
    scene = advsearch.load_scene("mug", backdrop=tmp_path / "a.png", settings=settings)
    render = scene.renderer(controls[control], resolution=32, denoise="none")
    u = torch.full((len(render.start),), 0.4)
    leaf = u.clone().requires_grad_()
    for part in (render.compute_object_mask(u), ~render.compute_object_mask(u)):
        weights = part[..., None] * torch.linspace(0.2, 1.0, 32)[None, :, None]
        (slope,) = torch.autograd.grad((weights * render(leaf, 1, 256)).sum(), leaf)
        with torch.no_grad():
            above, below = ((weights * render(u + step, 1, 256)).sum() for step in (0.03, -0.03))
        assert float(slope.sum()) == pytest.approx(float(above - below) / 0.06, rel=0.03, abs=0.02)


CUBE = """v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nv 0 0 1\nv 1 0 1\nv 0 1 1\nv 1 1 1
f 1 3 4 2\nf 5 6 8 7\nf 1 2 6 5\nf 3 7 8 4\nf 1 5 7 3\nf 2 4 8 6
"""


@pytest.mark.medium
@pytest.mark.parametrize("gloss", [0.02, 0.3, 0.99])
def test_a_coat_loses_what_fresnel_says_where_the_mirrored_object_is(tmp_path: Path, gloss: float) -> None:
    """A black cube under an even sky: its reflection takes the sky's."""
    Image.new("RGB", (48, 48), (120, 160, 90)).save(tmp_path / "a.png")
    (tmp_path / "cube.obj").write_text(CUBE)
    sky = assets.EnvironmentAsset("even", np.full((16, 32, 3), 2.0, np.float32))
    view = {"camera.elevation": 15.0, "camera.distance": 4.0, "material.specular": 0.0}
    scene = advsearch.load_scene(
        tmp_path / "cube.obj",
        sky,
        up="z",
        size=1.0,
        texture=np.zeros((4, 4, 3)),
        backdrop=tmp_path / "a.png",
        settings=view | {"ground.gloss": gloss, "ground.roughness": 0.05},
    )
    render = scene.renderer("texture", resolution=48, denoise="none")
    layers = render.render_radiance(render.compute_scene_inputs(render.start), 0, 64, True).detach().numpy()
    camera = camera_to_world(scene.description, 1.0)
    steps = (23.5 - np.arange(48)) / 24.0 * np.tan(np.radians(35.0 / 2.0))
    ray = np.stack([*np.meshgrid(steps, steps), np.ones((48, 48))], axis=-1) @ camera[:3, :3].T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    # where the mirrored ray meets the cube, which stands over the origin
    box = np.array([[-0.5, -0.5, -1.0], [0.5, 0.5, 0.0]])
    crossings = np.sort((box[:, None, None] - camera[:3, 3]) / ray, axis=0)
    is_hit = crossings[0].max(axis=-1) < crossings[1].min(axis=-1)
    is_ground = layers[..., 3] == 0.0
    inside = ndimage.binary_erosion(is_hit, iterations=2, border_value=1) & is_ground
    around = ~ndimage.binary_dilation(is_hit, iterations=3) & is_ground
    assert inside.sum() > 100
    reflection = layers[..., 7:10]
    assert np.abs(reflection[around]).max() < 0.02 * gloss
    cosine = -ray[..., 2][inside]
    index = (1.0 + np.sqrt(gloss)) / (1.0 - np.sqrt(gloss))
    refracted = np.sqrt(1.0 - (1.0 - cosine**2) / index**2)
    across = (cosine - index * refracted) / (cosine + index * refracted)
    along = (index * cosine - refracted) / (index * cosine + refracted)
    expected = -2.0 * (across**2 + along**2) / 2.0
    np.testing.assert_allclose(reflection[inside].mean(axis=-1), expected, rtol=0.04)
    assert reflection[inside].mean() == pytest.approx(expected.mean(), rel=0.01)


def test_a_coat_needs_a_plane_and_a_photograph(photograph: Path) -> None:
    gloss = {"ground.gloss": 0.04}
    with pytest.raises(InputError, match=r"ground.gloss: only applies to a scene that is rendered into a photograph"):
        advsearch.load_scene("mug", settings=gloss)
    wrong = {
        "ground.size is 0": gloss | NO_SHADOW,
        "the camera is not above": gloss | {"camera.elevation": -20.0},
        "give ground.gloss as well": {"ground.roughness": 0.1},
    }
    for words, settings in wrong.items():
        scene = advsearch.load_scene("mug", backdrop=photograph, settings=settings)
        with pytest.raises(InputError, match=words):
            scene.renderer("texture", resolution=SIZE)


@pytest.mark.medium
def test_a_matrix_predicts_the_picture_in_a_photograph(tmp_path: Path) -> None:
    Image.new("RGB", (32, 32), (120, 160, 90)).save(tmp_path / "a.png")
    scene = advsearch.load_scene("mug", backdrop=tmp_path / "a.png")
    render = scene.renderer({"texture": {"resolution": 8, "epsilon": 0.4}}, resolution=32)
    glossy = advsearch.load_scene("mug", backdrop=tmp_path / "a.png", settings={"ground.gloss": 0.04})
    refusal = find_refusal(glossy.renderer("texture", resolution=32))
    assert find_refusal(render) is None and refusal is not None and "reflects" in refusal.text
    predicted = LinearRenderer(render, render.start, 0, spp=64)
    change = torch.rand(len(render.start), generator=torch.Generator().manual_seed(0)) - 0.5
    u = (render.start + 0.3 * change).clamp(0, 1)
    with torch.no_grad():
        error = (predicted(u) - render(u, 3, 256)).abs().mean() * 255.0
        noise = (render(u, 4, 256) - render(u, 3, 256)).abs().mean() * 255.0
    assert error < 2.0 * noise + 0.5


def test_light_and_ground_follow_from_the_photograph(tmp_path: Path) -> None:
    """A level grey card of the mean reflectance is as bright as the photograph is on average."""
    levels = np.full((48, 64, 3), 200, np.uint8)
    levels[:24] = 60
    Image.fromarray(levels).save(tmp_path / "a.png")
    environment = assets.EnvironmentAsset("even", np.full((16, 32, 3), 2.0, np.float32))
    scene = load_description("mug", environment).with_backdrop(tmp_path / "a.png")
    irradiance = np.pi * 2.0  # of a level surface under an even sky
    mean = (decode(np.array([200]))[0] + decode(np.array([60]))[0]) / 2.0
    assert scene.gain * 0.18 * irradiance / np.pi == pytest.approx(mean, rel=1e-5)
    fitted = fit_camera(scene, (48, 64))
    shown = decode(np.array([200]))[0]  # the mug stands in the lower half
    albedo = shown / (scene.gain * irradiance / np.pi)
    expected = 255.0 * encode(np.array([min(albedo, 0.8)]))[0]
    assert fitted.get_number("ground.red") * 255.0 == pytest.approx(expected, abs=0.5)
    plane = compute_plane_radiance(fitted)
    assert plane is not None and plane[0] == pytest.approx(min(albedo, 0.8) * irradiance / np.pi, rel=1e-3)
    below = load_description("mug", environment, setting_values={"camera.elevation": -20.0})
    assert compute_plane_radiance(below.with_backdrop(tmp_path / "a.png")) is None, "the camera is below the ground"


def test_the_map_beside_a_photograph_lights_it(tmp_path: Path) -> None:
    from advsearch.trust.stored_files import list_opened_files

    write_photograph(tmp_path / "a.png")
    # Radiance's header, and two rows of eight texels of 2, 1 and 1
    texels = bytes([128, 64, 64, 130]) * 16
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 8\n" + texels)
    scene = advsearch.load_scene("mug", backdrop=f"{tmp_path / 'a.png'}#0,0,20,15")
    environment = scene.description.environment
    assert environment is not None and environment.radiance[0, 0].tolist() == pytest.approx([2.0, 1.0, 1.0], rel=0.02)
    assert str(tmp_path / "a.hdr") in list_opened_files(tmp_path / "a.png"), "a run keeps its digest"
    assert advsearch.load_scene("mug", "studio", backdrop=tmp_path / "a.png").description.environment_name == "studio"


@pytest.mark.parametrize("sigma", [0.0, 1.5, 4.0, 9.0])
def test_the_noise_of_a_photograph_is_measured_beside_its_texture(sigma: float) -> None:
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:160, :200]
    values = 120.0 + 40.0 * np.sin(x / 23.0) + 30.0 * np.cos(y / 17.0)
    values[:, 120:] += 60.0 * (rng.random((160, 80)) < 0.1)  # a part of it is textured
    values[:20] = 300.0  # and another one overexposed
    noisy = values[..., None] + rng.normal(0.0, sigma, (160, 200, 3))
    levels = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    assert measure_noise(levels) == pytest.approx([sigma] * 3, rel=0.1, abs=0.2)


@pytest.mark.parametrize("sigma", [0.0, 0.8, 1.5, 2.5])
def test_the_blur_of_a_photograph_is_measured_at_its_edges(sigma: float) -> None:
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:640, :800] / 8.0
    fine = np.zeros((640, 800))
    for _ in range(12):
        turn = rng.uniform(0.0, np.pi)
        u = (x - rng.uniform(0, 100)) * np.cos(turn) + (y - rng.uniform(0, 80)) * np.sin(turn)
        fine[np.abs(u) < rng.uniform(6.0, 12.0)] = rng.uniform(0.05, 1.0)
    pixels = fine.reshape(80, 8, 100, 8).mean(axis=(1, 3))
    image = ndimage.gaussian_filter(pixels, sigma) if sigma else pixels
    assert measure_blur(image.astype(np.float32)) == pytest.approx(sigma, rel=0.2, abs=0.1)
    flat = np.full((60, 60), 0.3, np.float32)
    assert measure_blur(flat) == 0.0


def test_an_image_is_blurred_as_by_another_program() -> None:
    image = np.random.default_rng(0).random((30, 40, 2)).astype(np.float32)
    expected = ndimage.gaussian_filter(image, (1.3, 1.3, 0.0), mode="nearest", truncate=3.0)
    np.testing.assert_allclose(blur_image(torch.from_numpy(image), 1.3).numpy(), expected, atol=2e-3)


@pytest.mark.medium
def test_the_object_has_the_noise_and_the_blur_of_the_photograph_and_is_behind_what_is_in_front(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    noisy = np.clip(np.round(140.0 + rng.normal(0.0, 6.0, (96, 96, 3))), 0, 255).astype(np.uint8)
    Image.fromarray(noisy).save(tmp_path / "a.png")
    mask = np.zeros((96, 96), np.uint8)
    mask[:, :48] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    pictures = {}
    for name, settings, front in (
        ("plain", {**AS_RENDERED}, None),
        ("matched", {}, tmp_path / "mask.png"),
        ("blurred", {**AS_RENDERED, "backdrop.blur": 2.0}, None),
    ):
        scene = advsearch.load_scene("mug", backdrop=tmp_path / "a.png", occluder=front, settings=NO_SHADOW | settings)
        render = scene.renderer("texture", resolution=96)
        pictures[name] = render(render.start, 0, 16).detach().numpy() * 255.0
        if name == "plain":
            inside = ndimage.binary_erosion(render.compute_object_mask(render.start).numpy(), iterations=8)
    assert (np.round(pictures["matched"][:, :48]) == noisy[:, :48]).all(), "the photograph is in front"
    assert not render.compute_object_mask(render.start).numpy().all()
    right = inside.copy()
    right[:, :48] = False
    difference = (pictures["matched"] - pictures["plain"])[right & (pictures["plain"].max(axis=2) < 230.0)]
    assert difference.std() == pytest.approx(6.0, rel=0.15) and abs(difference.mean()) < 1.0
    again = advsearch.load_scene("mug", backdrop=tmp_path / "a.png", occluder=tmp_path / "mask.png", settings=NO_SHADOW)
    render = again.renderer("texture", resolution=96)
    assert (render(render.start, 0, 16).detach().numpy() * 255.0 == pictures["matched"]).all(), "it repeats"
    assert (
        not render.compute_object_mask(render.start)[:, :48].any()
        and render.compute_object_mask(render.start)[:, 48:].any()
    )
    steps = {name: np.abs(np.diff(picture, axis=1)).max() for name, picture in pictures.items()}
    assert steps["blurred"] < 0.6 * steps["plain"]


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["png", "npy"])
def test_what_is_farther_than_the_depth_of_the_photograph_is_hidden(tmp_path: Path, kind: str) -> None:
    """A ball is cut by a slanted plane, where rays meet the plane before the ball."""
    height, width, metres, distance, fov = 48, 64, 0.2, 0.5, 50.0
    Image.new("RGB", (2 * width, 2 * height), (120, 160, 90)).save(tmp_path / "a.png")
    focal = 0.5 * 2 * width / np.tan(np.radians(fov) / 2.0)
    x = (np.arange(2 * width) + 0.5 - width) / focal
    y = (np.arange(2 * height) + 0.5 - height) / focal
    # the plane z = distance - radius + 1.5 x, in metres
    depth = np.tile((distance - metres / 2) / (1.0 - 1.5 * x), (2 * height, 1))
    depth[:, x > 0.6] = 0.0  # nothing is known there, and nothing hidden
    if kind == "png":
        Image.fromarray(np.round(depth / 1e-4).astype(np.uint16)).save(tmp_path / "depth.png")
        occluder = f"{tmp_path / 'depth.png'}#0.0001"
    else:
        np.save(tmp_path / "depth.npy", depth)
        occluder = str(tmp_path / "depth.npy")
    settings = {"camera.distance": distance, "camera.elevation": 0.0, "camera.fov": fov, **AS_RENDERED, **NO_SHADOW}
    scene = advsearch.load_scene("ball", size=metres, backdrop=tmp_path / "a.png", occluder=occluder, settings=settings)
    render = scene.renderer("texture", resolution=(height, width), denoise="none")
    # a ray (x, y, 1) t meets the ball where |t (x, y, 1) - (0, 0, distance)| is its radius
    square = 1.0 + x[None] ** 2 + y[:, None] ** 2
    root = distance**2 - square * (distance**2 - metres**2 / 4)
    ball = np.where(root > 0.0, (distance - np.sqrt(np.maximum(root, 0.0))) / square, np.inf)
    shown = np.isfinite(ball) & ((depth == 0.0) | (ball < depth))
    fraction = shown.reshape(height, 2, width, 2).mean(axis=(1, 3))
    found = render.compute_object_mask(render.start).numpy()
    sure = (fraction == 0.0) | (fraction == 1.0)
    assert 200 < shown.sum() / 4 < 0.8 * np.isfinite(ball).sum() / 4
    assert (found == (fraction == 1.0))[sure].mean() > 0.99
    picture = render(render.start, 0, 16).detach().numpy() * 255.0
    is_photograph = np.abs(picture - [120, 160, 90]).max(axis=2) < 0.01
    assert is_photograph[fraction == 0.0].mean() > 0.98
    assert is_photograph[fraction == 1.0].mean() < 0.02
    predicted = LinearRenderer(render, render.start, 0, spp=16)
    assert np.abs(predicted(render.start).detach().numpy() * 255.0 - [120, 160, 90])[fraction == 0.0].mean() < 0.5


def test_a_pixel_between_two_depths_is_hidden_by_its_part() -> None:
    """Two of four points of the object are hidden, and one of the two of the ground in the next pixel."""
    infinite = math.inf
    surfaces = SimpleNamespace(
        shape_names=("ground", "object"),
        z_depth=torch.tensor([[2.0, 2.0, 3.0, infinite], [2.0, 2.0, 3.0, infinite]]),
        visible_mask=lambda name: torch.tensor([[False, False, True, False]] * 2),
    )
    depth = torch.tensor([[1.0, infinite, 1.0, 1.0], [1.0, 1.99, 2.98, 1.0]])
    front = compute_front(surfaces, depth, 2, 1)  # type: ignore[arg-type]
    # the second pixel has no point of the object, and the first none of the ground
    assert front[0, :, 0].tolist() == pytest.approx([0.5, 0.5]) and front[0, :, 1].tolist() == pytest.approx([0.5, 0.5])


def test_depths_are_metres_in_each_kind_of_file(tmp_path: Path) -> None:
    expected = np.array([[0.5, 2.0, math.inf], [1.25, 3.0, 4.0]], np.float32)
    stored = np.where(np.isfinite(expected), expected, 0.0).astype(np.float32)
    Image.fromarray((stored * 1000.0).astype(np.uint16)).save(tmp_path / "a.png")
    np.save(tmp_path / "a.npy", np.asfortranarray(expected))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Y": stored}) as file:
        file.write(str(tmp_path / "a.exr"))
    for name in ("a.png#0.001", "a.npy", "a.exr"):
        assert is_depth(name)
        np.testing.assert_allclose(read_depth(tmp_path / name), expected, rtol=1e-6)
    assert not is_depth("mask.png") and not is_depth("a.png#1,2,3,4")


def test_hostile_depths_are_refused(tmp_path: Path) -> None:
    write_photograph(tmp_path / "a.png", (12, 16))
    Image.fromarray(np.full((12, 16), 700, np.uint16)).save(tmp_path / "deep.png")
    np.save(tmp_path / "negative.npy", np.full((12, 16), -1.0))
    np.save(tmp_path / "objects.npy", np.array([None]), allow_pickle=True)
    np.save(tmp_path / "small.npy", np.ones((2, 2)))

    def header_of(shape: str) -> bytes:
        header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".encode()
        return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header

    (tmp_path / "huge.npy").write_bytes(header_of("(99999999, 99999999)"))
    (tmp_path / "minus.npy").write_bytes(header_of("(-2, -3)") + bytes(48))
    (tmp_path / "cut.npy").write_bytes((tmp_path / "negative.npy").read_bytes()[:-9])
    (tmp_path / "text.npy").write_text("no array")
    write_photograph(tmp_path / "coloured.png", (12, 16))
    messages = {
        "deep.png": "metres of a level behind its name",
        "deep.png#1000": "depths of 0 to 100000 metres, got 700000",
        "negative.npy": "depths of 0 to",
        "objects.npy": "an array .height, width. of numbers",
        "minus.npy": "an array .height, width. of numbers",
        "small.npy": "depths of 16 x 12 pixels",
        "huge.npy": "at most",
        "cut.npy": "another length",
        "text.npy": "corrupt or of another version",
        "coloured.png#0.001": "one depth for each pixel",
        "missing.npy": "expected a picture of depth",
    }
    for name, message in messages.items():
        with pytest.raises(InputError, match=message):
            load_description("mug").with_backdrop(tmp_path / "a.png", tmp_path / name)
    np.save(tmp_path / "good.npy", np.ones((12, 16)))
    mesh = Path(__file__).parents[2] / "scenes" / "photographs" / "models" / "obj_000001.ply"
    scene = load_description(mesh).with_backdrop(tmp_path / "a.png", tmp_path / "good.npy")
    with pytest.raises(InputError, match=r"the size of .* is not known; give its longest side"):
        make_image_inputs(scene, (12, 16))


def test_what_is_said_of_a_photograph_needs_one_and_a_mask_has_its_size(tmp_path: Path) -> None:
    write_photograph(tmp_path / "a.png")
    write_photograph(tmp_path / "b.png", (12, 16))
    for settings, front in (({"backdrop.noise": 1.0}, None), ({"ground.level": 1.0}, None), ({}, "b.png")):
        with pytest.raises(InputError, match="set `backdrop`"):
            advsearch.load_scene("mug", settings=settings, occluder=front)
    with pytest.raises(InputError, match="expected a mask of 32 x 24 pixels"):
        load_description("mug").with_backdrop(tmp_path / "a.png", tmp_path / "b.png")


def test_a_photograph_is_averaged_in_linear_light(tmp_path: Path) -> None:
    levels = write_photograph(tmp_path / "a.png", (12, 20))
    got = read_backdrop(tmp_path / "a.png").resample((6, 10)).numpy()
    expected = decode(levels).reshape(6, 2, 10, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(got, expected, atol=1e-6)
    larger = read_backdrop(tmp_path / "a.png").resample((24, 40)).numpy()
    assert larger.shape == (24, 40, 3) and larger.mean() == pytest.approx(decode(levels).mean(), abs=2e-3)


ROTATION = np.array([[0.0, 1.0, 0.0], [0.6, 0.0, -0.8], [-0.8, 0.0, -0.6]])
"""From the world, z up, to a camera that looks along (-0.8, 0, -0.6): x right, y down, z ahead."""
SHIFT = np.array([0.1, 0.05, 0.7])


def write_poses(folder: Path) -> list[str]:
    """Write COLMAP's files and a transforms.json, which name two photographs of one name in two folders."""
    # the rotation as a quaternion, the real part first, found by its trace
    w = np.sqrt(1.0 + np.trace(ROTATION)) / 2.0
    skew = (ROTATION - ROTATION.T) / (4.0 * w)
    quaternion = f"{w} {skew[2, 1]} {skew[0, 2]} {skew[1, 0]}"
    (folder / "cameras.txt").write_text("4 FULL_OPENCV 64 48 50 60 32 24 0.1 0.02 0.001 0.002 0.03 0.2 0.1 0.05\n")
    shift = " ".join(map(str, SHIFT))
    (folder / "images.txt").write_text(f"1 {quaternion} {shift} 4 left/a.png\n\n2 1 0 0 0 0 0 1 4 right/a.png\n\n")
    pose = np.linalg.inv(np.vstack([np.column_stack([ROTATION, SHIFT]), [0, 0, 0, 1]])) @ np.diag([1, -1, -1, 1])
    lens = {"camera_model": "OPENCV", "fl_x": 50, "fl_y": 60, "cx": 32, "cy": 24, "w": 64, "h": 48, "k1": 0.1}
    frames = [
        {"file_path": "./left/a", "transform_matrix": pose.tolist()},
        {"file_path": "./right/a", "transform_matrix": np.eye(4).tolist()},
    ]
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return [str(folder / "images.txt"), str(folder / "transforms.json")]


def test_a_file_with_poses_has_the_camera_by_the_name_of_the_photograph(tmp_path: Path) -> None:
    """Points of the world lie where COLMAP's own formula, written out, has them."""
    (tmp_path / "left").mkdir()
    write_photograph(tmp_path / "left" / "a.png", (48, 64))
    shutil.copy(tmp_path / "left" / "a.png", tmp_path / "a.png")
    points = np.array([[0.0, 0.0, 0.0], [0.05, 0.1, 0.02], [0.0, -0.1, 0.1]])  # metres
    x, y, z = (points @ ROTATION.T + SHIFT).T
    x, y, square = x / z, y / z, (x**2 + y**2) / z**2
    full = (1 + 0.1 * square + 0.02 * square**2 + 0.03 * square**3) / (
        1 + 0.2 * square + 0.1 * square**2 + 0.05 * square**3
    )
    columns = x * full + 2 * 0.001 * x * y + 0.002 * (square + 2 * x**2)
    rows = y * full + 0.001 * (square + 2 * y**2) + 2 * 0.002 * x * y
    images, transforms = write_poses(tmp_path)
    expected = {
        images: np.column_stack([50 * columns, 60 * rows]),
        transforms: np.column_stack([50 * x * (1 + 0.1 * square), 60 * y * (1 + 0.1 * square)]),
    }
    for camera, pixels in expected.items():
        scene = advsearch.load_scene("mug", camera=camera, backdrop=f"{tmp_path / 'left' / 'a.png'}#0,0,64,48")
        description = fit_camera(scene.description, (48, 64))
        to_world = camera_to_world(description)
        relative = (points / description.size_in_metres - to_world[:3, 3]) @ to_world[:3, :3]
        found, visible = project_points(description, {}, torch.from_numpy(relative), (48, 64))
        assert bool(visible.all())
        np.testing.assert_allclose(found.numpy(), pixels, atol=1e-9)
        assert scene_to_settings(scene)["camera"] == camera
        with pytest.raises(FileFormatError, match=r"one camera of the photograph a\.png, got 2"):
            advsearch.load_scene("mug", camera=camera, backdrop=tmp_path / "a.png")
        with pytest.raises(InputError, match="has a place and a field of view of its own"):
            advsearch.load_scene(
                "mug", camera=camera, backdrop=tmp_path / "left" / "a.png", settings={"camera.azimuth": 1}
            )


def test_a_part_is_seen_by_the_camera_of_the_photograph(tmp_path: Path) -> None:
    """The points of the object lie where the camera of the full photograph has them, less the part's corner."""
    write_photograph(tmp_path / "a.png", (240, 320))
    (tmp_path / "cam.yaml").write_text(
        "image_width: 640\nimage_height: 480\ncamera_matrix: [500, 0, 330, 0, 510, 200, 0, 0, 1]\n"
        "distortion_coefficients: [0.1, 0.02, 0.001, 0.002]\n"
    )
    points = torch.tensor([[0.1, 0.05, 1.0], [-0.2, 0.1, 1.5], [0.0, 0.0, 2.0]], dtype=torch.float64)
    places = {}
    for name, spec, size in (("all", "a.png", (240, 320)), ("part", "a.png#40,20,160,120", (60, 80))):
        scene = load_description("mug").with_camera(str(tmp_path / "cam.yaml")).with_backdrop(tmp_path / spec)
        fitted = fit_camera(scene, size)
        pixels, _ = project_points(fitted, {}, points, size)
        places[name] = pixels.numpy() + np.array(size[::-1]) / 2.0
    np.testing.assert_allclose(places["part"] * 2.0, places["all"] - [40, 20], atol=1e-9)
    # without a camera file the field of view is that of the full photograph
    scene = load_description("mug", setting_values={"camera.fov": 50.0})
    plain, _ = project_points(fit_camera(scene, (240, 320)), {}, points, (240, 320))
    part = fit_camera(scene.with_backdrop(tmp_path / "a.png#40,20,160,120"), (120, 160))
    pixels, _ = project_points(part, {}, points, (120, 160))
    np.testing.assert_allclose(pixels.numpy() + np.array([80, 60]), plain.numpy() + np.array([120, 100]), atol=1e-9)


def write_tetrahedron(path: Path) -> np.ndarray:
    corners = np.array([[10.0, 0, 5], [50, 2, 3], [20, 40, 9], [25, 15, 70]])
    faces = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]
    lines = [*(f"v {x} {y} {z}" for x, y, z in corners), *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces)]
    path.write_text("\n".join(lines) + "\n")
    return corners


@pytest.mark.parametrize("up", [None, (0.1, -0.9, -0.3), (0.5, -0.2, -0.6)])
def test_a_measured_pose_puts_the_object_where_the_camera_matrix_has_it(
    tmp_path: Path, up: tuple[float, float, float] | None
) -> None:
    corners = write_tetrahedron(tmp_path / "t.obj")
    asset = load_description(str(tmp_path / "t.obj"), up="z", unit="mm").object
    turn = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))[0]
    pose = np.eye(4)
    pose[:3, :3] = turn * np.sign(np.linalg.det(turn))
    pose[:3, 3] = [30.0, -20.0, 600.0]
    matrix = np.array([[500.0, 0, 330], [0, 510, 200], [0, 0, 1]])
    settings = compute_view_settings(asset, pose, up)
    scene = load_description(asset, setting_values=settings)
    scene = replace(scene, camera_model=make_matrix_camera(matrix, (480, 640)))
    camera = camera_to_world(scene, 640 / 480)
    relative = (scene.base_vertices - camera[:3, 3]) @ camera[:3, :3]
    pixels, _ = project_points(scene, {}, torch.from_numpy(relative), (480, 640))
    seen = corners @ pose[:3, :3].T + pose[:3, 3]
    image = seen @ matrix.T
    expected = image[:, :2] / image[:, 2:] + 0.5  # the centre of OpenCV's first pixel is (0, 0)
    got = pixels.numpy() + np.array([320, 240])
    distance = np.linalg.norm(got[:, None] - expected[None], axis=2)
    assert distance.min(axis=1).max() < 5e-3 and distance.min(axis=0).max() < 5e-3
    depth = np.unique(np.round(relative[:, 2] * scene.size_in_metres * 1e3, 2))
    np.testing.assert_allclose(depth, np.sort(seen[:, 2]), atol=0.02)
    if up is not None:
        axes = camera[:3, :3] @ np.diag([-1.0, -1.0, 1.0])  # columns: right, down and ahead in the world
        np.testing.assert_allclose(axes @ (np.array(up) / np.linalg.norm(up)), [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (2.0 * np.eye(4), "rotation and a translation"),
        (np.eye(3), "rotation and a translation"),
        (np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -900], [0, 0, 0, 1]]), "behind the camera"),
    ],
)
def test_no_pose_of_an_object_is_refused(tmp_path: Path, pose: np.ndarray, words: str) -> None:
    write_tetrahedron(tmp_path / "t.obj")
    asset = load_description(str(tmp_path / "t.obj"), up="z", unit="mm").object
    with pytest.raises(InputError, match=words):
        compute_view_settings(asset, pose)


def test_an_object_without_a_file_has_no_measured_pose() -> None:
    with pytest.raises(InputError, match="mesh file with a known unit"):
        compute_view_settings(load_description("mug").object, np.eye(4))


def refuse(match: str, scene: SceneDescription, spec: str | Path, size: tuple[int, int] = SIZE) -> None:
    with pytest.raises((InputError, FileFormatError), match=match):
        fit_camera(scene.with_backdrop(spec), size)


def test_hostile_photographs_are_refused_in_a_sentence(tmp_path: Path) -> None:
    scene = load_description("mug")
    write_photograph(tmp_path / "a.png")
    data = (tmp_path / "a.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.jpg").write_text("no photograph")
    (tmp_path / "folder.png").mkdir()
    header = b"IHDR" + (20000).to_bytes(4, "big") + (9000).to_bytes(4, "big") + data[24:29]
    (tmp_path / "huge.png").write_bytes(data[:12] + header + zlib.crc32(header).to_bytes(4, "big") + data[33:])
    Image.new("RGBA", (32, 24), (255, 0, 0, 128)).save(tmp_path / "clear.png")
    Image.new("RGB", (4, 3)).save(tmp_path / "small.png")
    for name in ("cut.png", "text.jpg", "folder.png", "nowhere.png"):
        refuse("expected a picture file", scene, tmp_path / name)
    refuse("pixels", scene, tmp_path / "huge.png")
    refuse("transparent in some pixels", scene, tmp_path / "clear.png")
    refuse("at least 8 x 8", scene, tmp_path / "small.png")
    refuse("leaves the photograph", scene, f"{tmp_path / 'a.png'}#20,0,20,20")
    refuse("another shape", scene, tmp_path / "a.png", (32, 32))


def test_a_wrong_suffix_sixteen_bits_and_a_turned_photograph_are_read_as_a_viewer_shows_them(tmp_path: Path) -> None:
    levels = write_photograph(tmp_path / "a.png")
    (tmp_path / "a.jpg").write_bytes((tmp_path / "a.png").read_bytes())
    assert (read_backdrop(tmp_path / "a.jpg").levels == levels).all()
    assert read_backdrop(tmp_path / "a.jpg").digest == read_backdrop(tmp_path / "a.png").digest
    grey = (np.arange(24 * 32, dtype=np.uint16).reshape(24, 32) * 85).astype(np.uint16)
    Image.fromarray(grey).save(tmp_path / "grey.png")
    expected = np.round(grey.astype(np.float64) / 65535.0 * 255.0)
    assert np.abs(read_backdrop(tmp_path / "grey.png").levels[..., 0] - expected).max() <= 1
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned by 90 degrees clockwise
    Image.fromarray(levels).save(tmp_path / "turned.png", exif=exif)
    turned = read_backdrop(tmp_path / "turned.png")
    assert turned.full_size == (32, 24) and (turned.levels == np.rot90(levels, -1)).all()


def test_a_camera_of_another_shape_several_cameras_and_a_ground_are_refused(tmp_path: Path) -> None:
    write_photograph(tmp_path / "a.png")
    (tmp_path / "cam.yaml").write_text("image_width: 480\nimage_height: 640\nfx: 500\nfy: 500\ncx: 240\ncy: 320\n")
    scene = load_description("mug")
    refuse("was turned or cropped", scene.with_camera(str(tmp_path / "cam.yaml")), tmp_path / "a.png")
    table = load_description("mug", setting_values={"ground.kind": "photograph"})
    refuse("a plane that takes the shadow", table, tmp_path / "a.png")
    refuse("drops would show", load_description("mug", setting_values={"camera.drops": 5.0}), tmp_path / "a.png")
    part = scene.with_camera("equirectangular")
    refuse("shows all around", part, f"{tmp_path / 'a.png'}#0,0,16,12", (12, 16))
    with pytest.raises(InputError, match="uint8"):
        make_backdrop(np.zeros((24, 32, 3)))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "control",
    [
        "camera",
        "environment",
        pytest.param("sky", marks=pytest.mark.island("advsearch.controls.sky")),
        pytest.param("haze", marks=pytest.mark.island("advsearch.controls.haze")),
        pytest.param("background", marks=pytest.mark.island("advsearch.controls.background")),
        pytest.param("path", marks=pytest.mark.island("advsearch.controls.path")),
    ],
)
def test_controls_that_the_photograph_contradicts_are_refused(photograph: Path, control: str) -> None:
    scene = Scene(load_description("mug").with_backdrop(photograph))
    with pytest.raises(InputError, match=f"{control} and `backdrop=.*contradict each other: .*leave one"):
        scene.renderer(control, resolution=SIZE)
