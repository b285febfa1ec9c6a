"""Where the object is seen: the mask is what rays through the middles of pixels, cast by hand, hit first."""

import math

import numpy as np
import numpy.typing as npt
import pytest
import torch
from torch import Tensor

from advsearch.controls import Space
from advsearch.engine.loading import load_scene, make_controls
from advsearch.errors import InputError
from advsearch.scene.renderer import Renderer

pytestmark = pytest.mark.medium

SIZE = 32
VARIED: dict[str, dict[str, object]] = {
    "pose": {"yaw": [-60, 60], "pitch": [-20, 20], "roll": [-20, 20]},
    "camera": {"azimuth": [0, 360], "elevation": [5, 50], "fov": [25, 50]},
    "occlusion": {"which": "vase", "coverage": [0.2, 0.6], "direction": [0, 360]},
}

Doubles = npt.NDArray[np.float64]


def distances(origin: Doubles, rays: Doubles, vertices: Tensor, faces: npt.NDArray[np.uint32]) -> Doubles:
    """Distances (N,) to the first triangle on each of the rays (N, 3) (Moeller and Trumbore 1997); infinite: none."""
    a, b, c = (vertices.numpy().astype(np.float64)[faces[:, corner].astype(np.int64)] for corner in range(3))
    first, second, to_origin = b - a, c - a, origin - a
    found = np.full(len(rays), np.inf)
    across = np.cross(to_origin, first)
    for number, ray in enumerate(rays):
        normal = np.cross(ray, second)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1.0 / (first * normal).sum(axis=1)
            u, v = (to_origin * normal).sum(axis=1) * scale, across @ ray * scale
            distance = (second * across).sum(axis=1) * scale
            hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 0.0)
        found[number] = distance[hit].min(initial=np.inf)
    return found


def cast(render: Renderer, u: Tensor) -> dict[str, Doubles]:
    """Distance to every mesh (H, W), by name, through the middle of each pixel."""
    assert isinstance(render.space, Space) and render.space.scene is not None
    placed = render.scene.input_assembler(render.space.inputs(u))
    camera, fov = placed["camera.to_world"].numpy().astype(np.float64), float(placed["camera.fov"])
    half = math.tan(math.radians(fov) / 2.0)
    side = half * (1.0 - (2.0 * np.arange(SIZE) + 1.0) / SIZE)  # Mitsuba's cameras have x to the left
    y, x = np.meshgrid(side, side, indexing="ij")
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ camera[:3, :3].T
    found = {}
    for name, part in render.space.scene.meshes.items():
        found[name] = distances(camera[:3, 3], rays, placed[f"{name}.vertices"], part.mesh.faces).reshape(SIZE, SIZE)
    return found


@pytest.fixture(scope="module")
def moved() -> Renderer:
    return load_scene("banana").renderer(make_controls(VARIED), resolution=SIZE, denoise="none")


@pytest.mark.parametrize("seed", [0, 1])
def test_a_mask_is_where_the_object_is_hit_first(moved: Renderer, seed: int) -> None:
    u = torch.rand(moved.start.shape, generator=torch.Generator().manual_seed(seed))
    found = cast(moved, u)
    alone = np.isfinite(found["object"])
    nearest = alone & (found["object"] < found["occlusion"])
    mask = moved.compute_object_mask(u)
    assert mask.shape == (SIZE, SIZE) and mask.dtype == torch.bool
    assert np.array_equal(mask.numpy(), nearest)
    assert 20 < nearest.sum() < alone.sum() - 20, "a part of it is hidden"


def test_a_mask_is_of_its_own_configuration_and_leaves_renders_as_they_are(moved: Renderer) -> None:
    first, second = (torch.rand(moved.start.shape, generator=torch.Generator().manual_seed(seed)) for seed in (2, 3))
    before, mask = moved(first, seed=1, spp=2), moved.compute_object_mask(first)
    assert not torch.equal(moved.compute_object_mask(second), mask) and torch.equal(
        moved.compute_object_mask(first), mask
    )
    assert torch.allclose(moved(first, seed=1, spp=2), before, atol=1e-6)
    with pytest.raises(InputError, match="entry of u"):
        moved.compute_object_mask(first + 2.0)


def mask_of(controls: dict[str, dict[str, object]]) -> Tensor:
    render = load_scene("mug").renderer(make_controls(controls), resolution=SIZE, denoise="none")
    return render.compute_object_mask(render.start)


def test_a_lamp_hides_the_object_only_while_it_shines() -> None:
    between: dict[str, object] = {"x": 0.9, "y": 0.76, "z": 0.99, "size": 0.3}
    plain = mask_of({"material": {}})
    dark, lit = (mask_of({"light": {**between, "power": power}}) for power in ([0.0, 0.5], [4.0, 5.0]))
    assert torch.equal(dark, plain)
    assert int((plain & ~lit).sum()) > 10 and not bool((lit & ~plain).any())
