"""The texture control's further forms: a few colours, smooth waves, and other meshes than the object."""

import numpy as np
import pytest
import torch
from torch import Tensor

from advsearch.controls import make_space
from advsearch.controls.base import Control
from advsearch.controls.texture import TextureControl, compute_palette
from advsearch.errors import UnknownNameError
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.description import SceneDescription
from advsearch.scene.parts import MeshPart

EIGHT_BIT = 1e-4
"""Colours may differ by this much after the way to linear values and back."""


def texels(bound: Control, u: Tensor) -> Tensor:
    """The searched texture as sRGB."""
    (linear,) = bound.inputs(u).values()
    return linear_to_srgb(linear)


@pytest.mark.parametrize("form", ["palette", "waves"])
def test_a_form_starts_as_the_objects_own_texture(scene: SceneDescription, form: str) -> None:
    bound = TextureControl(form=form).bind(scene)
    own = torch.from_numpy(scene.object.base_color.copy())
    torch.testing.assert_close(texels(bound, bound.start), own, atol=EIGHT_BIT, rtol=0)


@pytest.mark.parametrize("form", ["palette", "waves"])
@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_no_configuration_in_the_budget_leaves_the_ball(scene: SceneDescription, form: str, norm: str) -> None:
    bound = TextureControl(form=form, norm=norm, epsilon=0.2, resolution=64).bind(scene)
    generator = torch.Generator().manual_seed(0)
    for step in range(4):
        direction = torch.rand(bound.start.shape, generator=generator) - 0.5
        direction = direction.sign() if step % 2 else direction
        if bound.largest_group_budget.epsilon is None:
            u = 0.5 + 0.5 * direction.sign()
        else:
            length = direction.norm() if norm == "l2" else direction.abs().max()
            u = (bound.start + bound.largest_group_budget.epsilon * direction / length).clamp(0.0, 1.0)
        change = texels(bound, u) - texels(bound, bound.start)
        reached = float(change.norm()) if norm == "l2" and form == "waves" else float(change.abs().max())
        assert 0.01 < reached <= 0.2 + EIGHT_BIT
        assert bound.describe(u)["texture.linf"]["value"] == pytest.approx(float(change.abs().max()), abs=EIGHT_BIT)


@pytest.mark.parametrize("form", ["palette", "waves"])
def test_the_derivative_is_that_of_a_difference(scene: SceneDescription, form: str) -> None:
    bound = TextureControl(form=form, epsilon=0.3, resolution=32).bind(scene)
    generator = torch.Generator().manual_seed(1)
    weights = torch.randn(32, 32, 3, generator=generator)
    direction = torch.randn(bound.start.shape, generator=generator)
    u = (0.8 * bound.start + 0.1).requires_grad_()

    def total(at: Tensor) -> Tensor:
        return (next(iter(bound.inputs(at).values())) * weights).sum()

    (slope,) = torch.autograd.grad(total(u), u)
    step = 2e-3 * direction
    with torch.no_grad():
        rise = float(total(u + step) - total(u - step)) / 2.0
    assert float(slope @ step) == pytest.approx(rise, rel=0.02, abs=1e-3)


def test_a_palette_repaints_what_resembles_its_colour() -> None:
    image = torch.zeros(8, 8, 3)
    image[:, :4] = torch.tensor([0.8, 0.2, 0.2])
    image[:, 4:] = torch.tensor([0.2, 0.2, 0.8])
    image[0, 0] = torch.tensor([0.75, 0.2, 0.2])  # a shade of red
    colors = compute_palette(image, np.ones((8, 8), dtype=np.float32), 2)
    assert colors.shape == (2, 3)
    red = int(colors[:, 0].argmax())
    from advsearch.controls.base import Budget
    from advsearch.controls.texture import make_palette_painter

    painter = make_palette_painter(image, colors, Budget("linf", 0.5))
    u = colors.clone()
    u[red] = torch.tensor([0.3, 0.7, 0.2])
    painted = painter.paint_texels(u.reshape(-1))
    assert float((painted[4, 2] - torch.tensor([0.3, 0.7, 0.2])).abs().max()) < 0.1
    assert float((painted[4, 6] - image[4, 6]).abs().max()) < 0.1
    assert float(painted[0, 0, 0]) < float(painted[4, 2, 0])  # the shade is still darker than the rest


def part(scene: SceneDescription) -> MeshPart:
    """A second mesh with a plain texture."""
    return MeshPart("post", scene.object.mesh, np.full((4, 4, 3), 0.25, dtype=np.float32))


def test_another_mesh_of_the_scene_can_be_painted(scene: SceneDescription) -> None:
    both = scene.with_part(part(scene))
    bound = TextureControl(name="texture:post", resolution=16).bind(both)
    (found,) = bound.inputs(bound.start).items()
    assert found[0] == "post.base_color"
    torch.testing.assert_close(found[1], srgb_to_linear(torch.full((16, 16, 3), 0.25)))
    space = make_space([TextureControl(), TextureControl(name="texture:post")], both)
    assert set(space.inputs(space.start)) == {"object.base_color", "post.base_color"}
    with pytest.raises(UnknownNameError, match="'pots'"):
        TextureControl(name="texture:pots").bind(both)
