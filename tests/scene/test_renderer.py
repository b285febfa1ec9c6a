"""The function in the middle: repeatable, stateless, finite, and differentiable as it claims."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from advsearch.controls import TextureControl
from advsearch.engine.loading import load_scene
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.description import load_description
from advsearch.scene.formation import ALL_OMISSIONS, ImageFormation
from advsearch.scene.mitsuba_backend.scene import BASE_COLOR, MitsubaScene
from advsearch.scene.renderer import Renderer

SIZE = 32
TEXELS = 16
LINEAR_TOLERANCE = 0.03
"""A path-replayed gradient against a difference with the same 256 samples: both are noisy by about one per cent."""


@pytest.fixture(scope="module")
def raw() -> Renderer:
    """A mug without denoiser, whose 16 x 16 texture may vary."""
    return load_scene("mug").renderer([TextureControl(resolution=TEXELS)], resolution=SIZE, denoise="none")


@pytest.fixture(scope="module")
def denoised() -> Renderer:
    return load_scene("mug").renderer([TextureControl(resolution=TEXELS)], resolution=SIZE)


def weights() -> Tensor:
    """A smooth linear loss: every pixel weighs, none cancels another by chance."""
    rows = torch.linspace(0.2, 1.0, SIZE)
    return (rows[:, None] * rows.flip(0)[None, :])[..., None] / SIZE**2


def loss(render: Renderer, u: Tensor, seed: int, spp: int) -> Tensor:
    return (render(u, seed=seed, spp=spp) * weights()).sum()


def inside(render: Renderer) -> Tensor:
    """The start, away from the ends of the unit box."""
    return render.start * 0.8 + 0.1


@pytest.mark.parametrize("which", ["raw", "denoised"])
def test_the_same_seed_gives_the_same_bytes_and_another_seed_another_picture(
    which: str, request: pytest.FixtureRequest
) -> None:
    render = request.getfixturevalue(which)
    with torch.no_grad():
        first, again, other = (render(render.start, seed=seed, spp=4) for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert first.shape == (SIZE, SIZE, 3) and first.dtype == torch.float32
    assert float(first.min()) >= 0.0 and float(first.max()) <= 1.0


def test_a_configuration_after_many_others_gives_the_bytes_of_a_fresh_renderer(raw: Renderer) -> None:
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for _ in range(20):
            raw(torch.rand(raw.start.shape, generator=generator), seed=1, spp=1)
        after = raw(raw.start, seed=7, spp=4)
        fresh = load_scene("mug").renderer([TextureControl(resolution=TEXELS)], resolution=SIZE, denoise="none")
        assert torch.equal(after, fresh(fresh.start, seed=7, spp=4))


def test_a_gradient_leaves_the_scene_as_it_was(raw: Renderer) -> None:
    with torch.no_grad():
        before = raw(raw.start, seed=2, spp=4)
    u = inside(raw).requires_grad_()
    loss(raw, u, 0, 4).backward()
    with torch.no_grad():
        assert torch.equal(before, raw(raw.start, seed=2, spp=4))


def test_an_interrupted_gradient_leaves_nothing_behind(raw: Renderer, monkeypatch: pytest.MonkeyPatch) -> None:
    base = raw.scene.render_radiance({}, 5, 4)

    class Interrupted:
        def render_backward(self, *_: object, **__: object) -> None:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setitem(raw.scene._integrators, ("path", raw.scene.current_max_depth), Interrupted())
        raw.scene.render_adjoint({BASE_COLOR: torch.zeros(TEXELS, TEXELS, 3)}, torch.ones(SIZE, SIZE, 3), 1, 4)
    assert torch.equal(base, raw.scene.render_radiance({}, 5, 4))


def test_a_tensor_changed_in_place_is_uploaded_again(raw: Renderer) -> None:
    texture = torch.full((TEXELS, TEXELS, 3), 0.2)
    dark = raw.scene.render_radiance({BASE_COLOR: texture}, 5, 4)
    texture += 0.5
    assert float(raw.scene.render_radiance({BASE_COLOR: texture}, 5, 4).mean()) > 1.1 * float(dark.mean())


@pytest.mark.medium
@pytest.mark.parametrize("size, spp, texels", [(16, 1, 16), (32, 4, 32), (32, 2, 4), (24, 3, 64)])
def test_recording_kernels_changes_no_byte(size: int, spp: int, texels: int) -> None:
    description = load_description("mug")
    frozen = MitsubaScene(description, (size, size))
    plain = MitsubaScene(description, (size, size), leave_out=ALL_OMISSIONS - {"tracing"})
    for seed in range(5):
        inputs = {BASE_COLOR: torch.full((texels, texels, 3), 0.1 + 0.15 * seed)}
        assert torch.equal(frozen.render_radiance(inputs, seed, spp), plain.render_radiance(inputs, seed, spp))
        for ours, theirs in zip(
            frozen.render_guides(inputs, seed, spp), plain.render_guides(inputs, seed, spp), strict=True
        ):
            assert torch.equal(ours, theirs)


@pytest.mark.medium
def test_the_gradient_agrees_with_a_central_difference_of_the_same_samples(raw: Renderer) -> None:
    u = inside(raw).requires_grad_()
    loss(raw, u, 0, 256).backward()
    generator = torch.Generator().manual_seed(1)
    direction = 0.03 * torch.rand(u.shape, generator=generator)
    with torch.no_grad():
        difference = (loss(raw, u + direction, 0, 256) - loss(raw, u - direction, 0, 256)) / 2
    assert u.grad is not None
    assert float((u.grad * direction).sum()) == pytest.approx(float(difference), rel=LINEAR_TOLERANCE)


@pytest.mark.medium
def test_a_loss_linear_in_the_texture_changes_by_step_times_gradient() -> None:
    """Direct light only (paths of two segments) makes radiance linear in reflectance, so the identity is exact."""
    scene = MitsubaScene(load_description("ball"), (SIZE, SIZE), max_depth=2)
    base = scene.get_base_value(BASE_COLOR)
    cotangent = torch.ones(SIZE, SIZE, 3)
    gradient = scene.render_adjoint({BASE_COLOR: base}, cotangent, 11, 64)[BASE_COLOR]
    step = torch.zeros_like(base)
    step[..., 1] = 0.05
    before, after = (scene.render_radiance({BASE_COLOR: base + k * step}, 11, 64).sum() for k in (0.0, 1.0))
    assert float((gradient * step).sum()) == pytest.approx(float(after - before), rel=2e-3)


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_gradients_are_finite_at_black_and_white_texels(raw: Renderer, value: float) -> None:
    u = torch.full_like(raw.start, value).requires_grad_()
    loss(raw, u, 0, 4).backward()
    assert u.grad is not None and bool(torch.isfinite(u.grad).all())
    assert float(u.grad.abs().sum()) > 0.0


def test_pictures_guides_and_gradients_have_noise_of_their_own(
    denoised: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gradient with the noise of its picture is biased: both are products of the same samples."""
    scene, used = denoised.scene, list[int]()
    pictures, adjoint = scene.render_images, scene.render_adjoint

    def pictured(inputs: Mapping[str, Tensor], seeds: Mapping[str, int], spp: int) -> list[Tensor]:
        used.extend(seeds.values())
        return pictures(inputs, seeds, spp)

    def differentiated(
        inputs: Mapping[str, Tensor], cotangent: Tensor, seed: int, spp: int, **more: Any
    ) -> dict[str, Tensor]:
        used.append(seed)
        return adjoint(inputs, cotangent, seed, spp, **more)

    monkeypatch.setattr(scene, "render_images", pictured)
    monkeypatch.setattr(scene, "render_adjoint", differentiated)
    for seed in (0, 1):
        loss(denoised, inside(denoised).requires_grad_(), seed, 1).backward()
    assert len(set(used)) == len(used) == 2 * 3


def test_the_denoiser_is_the_identity_in_the_backward_pass(raw: Renderer, denoised: Renderer) -> None:
    gradients = []
    for render in (raw, denoised):
        linear = Renderer(render.scene, render.space, replace(render.formation, gain=1e-3))  # below every clip
        u = inside(render).requires_grad_()
        linear.radiance(u, seed=0, spp=16).sum().backward()
        gradients.append(u.grad)
    assert gradients[0] is not None and gradients[1] is not None
    assert torch.allclose(gradients[0], gradients[1], rtol=1e-4, atol=1e-7)


def test_non_finite_radiance_is_counted_and_set_to_zero(raw: Renderer, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = torch.full((SIZE, SIZE, 3), 0.5)
    broken[0, 0, 0], broken[1, 1, 1] = float("nan"), float("inf")
    monkeypatch.setattr(raw.scene, "render_images", lambda *_, **__: [broken])
    before = raw.n_non_finite
    with torch.no_grad():
        image = raw(raw.start, seed=0, spp=1)
    assert raw.n_non_finite - before == 2
    assert bool(torch.isfinite(image).all()) and float(image[0, 0, 0]) == 0.0


def test_a_picture_is_radiance_times_the_gain_through_the_curve() -> None:
    radiance = torch.tensor([[0.0, 0.1, 0.2]])
    light = 2.5 * radiance
    shown = {
        "srgb": linear_to_srgb(light),
        "gamma": light.clamp_min(1e-6) ** (1.0 / 2.2),
        "reinhard": linear_to_srgb(light / (1.0 + light)),
        "linear": light,
    }
    for transfer, expected in shown.items():
        assert torch.allclose(ImageFormation(gain=2.5, transfer=transfer).map_to_display(radiance), expected)


@pytest.mark.medium
def test_multijittered_samples_have_the_same_mean_and_less_noise() -> None:
    scene = load_scene("mug")
    plain, better = (
        scene.renderer("camera", resolution=SIZE, denoise="none", sampler=name)
        for name in ("independent", "multijitter")
    )
    assert better.formation.sampler == "multijitter"
    with torch.no_grad():
        pictures = {
            name: torch.stack([render(render.start, seed, 16) for seed in range(8)])
            for name, render in (("plain", plain), ("better", better))
        }
        again = scene.renderer("camera", resolution=SIZE, denoise="none", sampler="multijitter")
        assert torch.equal(again(again.start, 3, 16), pictures["better"][3])
    noise = {name: float(found.var(0).mean()) for name, found in pictures.items()}
    assert noise["better"] < 0.75 * noise["plain"]
    means = [found.mean(0) for found in pictures.values()]
    assert float((means[0] - means[1]).square().mean()) < (noise["plain"] + noise["better"]) / 8 * 1.5
    assert better.scene.copy_with(max_depth=3).sampler_name == "multijitter"


SECOND = "render: it has first derivatives only"


@pytest.fixture(scope="module")
def numbers() -> Renderer:
    """One number by the tone curve, one by an adjoint and one by differences."""
    varied = {"camera": {"exposure": [-1, 1], "azimuth": [0, 90]}, "light": {"power": [0, 12]}}
    return load_scene("mug").renderer(varied, resolution=8, denoise="none")


@pytest.mark.parametrize("which", ["numbers", "raw"])
@pytest.mark.parametrize("of", ["hessian", "penalty", "grad", "backward", "model"])
def test_second_derivatives_are_refused_and_never_incomplete(
    which: str, of: str, request: pytest.FixtureRequest
) -> None:
    render: Renderer = request.getfixturevalue(which)
    u, weight = inside(render).requires_grad_(), torch.ones(3, requires_grad=True)

    def value(at: Tensor) -> Tensor:
        return (render(at, seed=0, spp=1) * weight).mean()

    (slope,) = torch.autograd.grad(value(u), u, create_graph=True)
    with pytest.raises(RuntimeError, match=SECOND):
        if of == "hessian":
            torch.autograd.functional.hvp(value, u.detach(), torch.ones_like(u))
        elif of == "penalty":
            torch.autograd.grad(slope.square().sum(), u)
        elif of == "grad":
            torch.autograd.grad(slope[0], [u])
        elif of == "backward":
            slope.square().sum().backward()
        else:
            torch.autograd.grad(slope.square().sum(), weight)


def test_the_transfer_curve_is_flat_where_it_clips_and_finite_at_black() -> None:
    linear = torch.tensor([-0.5, 0.0, 0.5, 1.5], requires_grad=True)
    linear_to_srgb(linear).sum().backward()
    assert linear.grad is not None
    assert bool(torch.isfinite(linear.grad).all())
    assert float(linear.grad[0]) == 0.0 and float(linear.grad[3]) == 0.0 and float(linear.grad[2]) > 0.0
