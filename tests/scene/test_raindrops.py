"""Raindrops before the camera: rays are Snell's, truth is that of the scene without them, gradients go through them."""

import math
from typing import Any

import numpy as np
import pytest
import torch

import advsearch
from advsearch.scene.mitsuba_backend.own_plugins import APERTURE_RADIUS, SHEET_DISTANCE, WATER_IOR, sample_raindrops
from advsearch.scene.mitsuba_backend.variant import mi

pytestmark = [pytest.mark.usefixtures("two_threads"), pytest.mark.medium]
SIDE = 64


def renderer_of(drops: int, controls: Any = None, **settings: float) -> Any:
    given = {
        "camera.drops": drops,
        "camera.drop_size": 3.0,
        **{f"camera.{name}": one for name, one in settings.items()},
    }
    return advsearch.load_scene("mug", "noon", settings=given).renderer(controls or ["pose"], resolution=SIDE)


def bent(direction: np.ndarray, normal: np.ndarray, first: float, second: float) -> tuple[np.ndarray | None, float]:
    """Snell's law in angles: the refracted direction, None where there is none, and the share of light that passes."""
    angle = math.acos(min(1.0, float(direction @ normal)))
    sine = first / second * math.sin(angle)
    if sine >= 1.0:
        return None, 0.0
    behind = math.asin(sine)
    aside = direction - (direction @ normal) * normal
    aside = aside / np.linalg.norm(aside) if np.linalg.norm(aside) > 0.0 else aside
    if angle < 1e-9:
        return direction, 1.0 - ((first - second) / (first + second)) ** 2
    across = (math.sin(angle - behind) / math.sin(angle + behind)) ** 2
    along = (math.tan(angle - behind) / math.tan(angle + behind)) ** 2
    return math.cos(behind) * normal + math.sin(behind) * aside, 1.0 - (across + along) / 2.0


def expected(ahead: np.ndarray, lens: np.ndarray, drops: np.ndarray) -> tuple[np.ndarray, float]:
    """One ray through the drop that is tallest where it meets the sheet."""
    place = ahead[:2] / ahead[2] * SHEET_DISTANCE + lens
    best, tall = None, 0.0
    for x, y, radius, curve in drops.astype(float):
        away = math.hypot(place[0] - x, place[1] - y)
        if away < radius:
            height = math.sqrt(curve**2 - away**2) - math.sqrt(curve**2 - radius**2)
            if height > tall:
                best, tall = (x, y, radius, curve), height
    if best is None:
        return ahead, 1.0
    x, y, radius, curve = best
    inner, first = bent(ahead, np.array([0.0, 0.0, 1.0]), 1.0, WATER_IOR)
    assert inner is not None
    middle = np.array([x, y, -math.sqrt(curve**2 - radius**2)])
    start = np.array([*place, 0.0]) - middle
    a, b, c = inner @ inner, 2.0 * inner @ start, start @ start - curve**2
    hit = start + inner * (-b + math.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    outer, second = bent(inner, hit / curve, WATER_IOR, 1.0)
    return (ahead, 0.0) if outer is None or outer[2] <= 0.0 else (outer, first * second)


def test_rays_are_refracted_by_snells_law_and_lose_what_fresnel_says() -> None:
    renderer = renderer_of(25)
    sensor = renderer.scene._scene.sensors()[0]
    _, drops, _ = sample_raindrops(25, 3.0, 0, math.tan(math.radians(35.0) / 2.0))
    random = np.random.default_rng(1)
    u, v, lens = random.random(600), random.random(600), random.random((600, 2))
    place, sample = mi.Point2f(u, v), mi.Point2f(lens[:, 0], lens[:, 1])
    ray, weight = sensor.sample_ray(0.0, 0.5, place, sample)
    clear, _ = sensor.sample_ray_without_drops(0.0, place)
    to_camera = np.array(sensor.world_transform().matrix).reshape(4, 4)[:3, :3].T
    shift = APERTURE_RADIUS * np.array(mi.warp.square_to_uniform_disk_concentric(sample)).T
    ours, before = (np.array(one.d).T @ to_camera.T for one in (ray, clear))
    shares, changed, near = np.array(weight).T[:, 0], 0, 0
    for k in range(600):
        wanted, share = expected(before[k], shift[k], drops)
        close = np.abs(ours[k] - wanted).max() < 2e-4 and abs(shares[k] - share) < 2e-4
        near += close or share == 0.0 == shares[k]
        changed += np.abs(wanted - before[k]).max() > 1e-3
    assert changed > 100 and near >= 594, "all but those at an edge, where the grid of the drops decides"


def test_what_is_true_of_a_picture_is_so_of_the_scene_without_drops() -> None:
    wet, dry = renderer_of(40), renderer_of(0)
    ours, theirs = (one.find_surfaces(one.start).visible_mask("object") for one in (wet, dry))
    assert (ours != theirs).float().mean() < 0.002  # the ray through a pixel's middle is looked up, not worked out
    pictures = [one.radiance(one.start, seed=1, spp=16) for one in (wet, dry)]
    assert float((pictures[0] - pictures[1]).abs().mean()) > 0.02 * float(pictures[1].mean())
    assert wet.scene.description_and_filter[0].gain == dry.scene.description_and_filter[0].gain


def test_a_textures_derivative_goes_through_the_drops() -> None:
    renderer = renderer_of(40, {"texture": {"resolution": 4, "epsilon": 0.5}}, distance=0.35)
    weights = torch.rand(SIDE, SIDE, 3, generator=torch.Generator().manual_seed(2))
    u = renderer.start.clone().clamp(0.2, 0.8).requires_grad_()
    (renderer.radiance(u, seed=3, spp=256) * weights).mean().backward()
    way = torch.ones_like(u)
    values = []
    for h in (0.05, -0.05):
        with torch.no_grad():
            values.append(float((renderer.radiance(u.detach() + h * way, seed=3, spp=256) * weights).mean()))
    assert u.grad is not None
    assert float(u.grad @ way) == pytest.approx((values[0] - values[1]) / 0.1, rel=0.05)
