"""Meshes, places and views that break naive code."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from advsearch.controls.occlusion import sphere
from advsearch.engine.gradients import smooth_loss
from advsearch.questions.stability.scene import (
    BARE,
    SPP,
    CaseGroup,
    Check,
    ControlSettings,
    Outcome,
    compared,
    dark,
    examine_gradient,
    holds,
    mesh_of,
    search_domain,
    small,
    thing,
)
from advsearch.scene.assets import Mesh, normalised
from advsearch.scene.importing.objects import import_object

QUAD = [[0.0, -0.5, 0.0], [0.0, 0.5, 0.0], [0.0, 0.5, 1.0], [0.0, -0.5, 1.0]]
"""A square that faces +x."""
HALVES = [[0, 1, 2], [0, 2, 3]]
FRONT = {"camera.azimuth": 0.0, "camera.elevation": 10.0}
PAINTED: ControlSettings = {"texture": {"resolution": 8}, "pose": {"y": [-0.3, 0.3]}}
SAME_PICTURE = 2e-3
"""Mean difference of two pictures that should be one: an 8-bit level is 4e-3."""
FAR = 1e4

GEOMETRY = CaseGroup("geometry")
_SCENE = "counted and set to zero where they arise (Renderer.non_finite); none is expected"
_IMPORT = "the import removes faces without area and says so; the renderer never hits one"
_NORMAL = "the import brings every object to size 1 at the origin, in 64-bit numbers"
_PIXEL = "a difference is as wide as moves the outline by a pixel, whatever the units"
_WRAP = "periodic blocks wrap (Domain.project, Renderer differences)"


def mesh(made: Mesh) -> Outcome:
    """A mesh of our own, seen from the front: painted and shifted."""
    return examine_gradient(small(thing(made), PAINTED, settings=FRONT)).findings()


@GEOMETRY.case("degenerate-triangles", _IMPORT, "texture, pose", cheap=False)
def degenerate() -> Outcome:
    """Faces without area change neither the picture nor the gradient."""
    line = [[0.0, 0.0, 0.5], [0.0, 0.1, 0.5], [0.0, 0.2, 0.5]]
    faces = [*HALVES, [0, 0, 1], [4, 5, 6], [4, 4, 4]]
    same = _difference(mesh_of(QUAD + line, faces), mesh_of(QUAD, HALVES))
    text = _obj(np.array(QUAD + line), faces)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "degenerate.obj"
        path.write_text(text)
        asset = import_object(path)
    return mesh(mesh_of(QUAD + line, faces)).with_checks(
        Check("mean difference from the square alone", same, most=SAME_PICTURE),
        Check("faces left after the import", float(len(asset.mesh.faces)), 2.0, 2.0),
        holds("the import says what it removed", any("without area" in note for note in asset.warnings)),
    )


@GEOMETRY.case("sliver-triangles", _SCENE, "texture, pose", cheap=False)
def sliver() -> Outcome:
    """A triangle a million times as long as wide leaves everything finite and right."""
    return mesh(mesh_of([*QUAD, [0.0, -0.5, 0.5], [0.0, 0.5, 0.5], [0.0, 0.5, 0.5 + 1e-6]], [*HALVES, [4, 5, 6]]))


@GEOMETRY.case("coincident-faces", _SCENE, "texture, pose", cheap=False)
def coincident() -> Outcome:
    """Two faces in one place look like one."""
    twice = mesh_of(QUAD + QUAD, [*HALVES, [4, 5, 6], [4, 6, 7]])
    apart = _difference(twice, mesh_of(QUAD, HALVES))
    return mesh(twice).with_checks(Check("mean difference from one square", apart, most=SAME_PICTURE))


@GEOMETRY.case("one-triangle", _SCENE, "texture, pose", cheap=False)
def one_triangle() -> Outcome:
    """Finite, and both gradients are right."""
    return mesh(mesh_of([[0.0, -0.5, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 1.0]], [[0, 1, 2]]))


@GEOMETRY.case("million-triangles", _SCENE, "texture, pose", cheap=False)
def million() -> Outcome:
    """Finite, right, and like the coarse mesh of the same shape."""
    fine, rough = (normalised(sphere(*counts)) for counts in ((501, 1000), (64, 128)))
    found = examine_gradient(small(thing(fine), {"texture": {"resolution": 8}}), evaluations=2)
    coarse, renderer = (small(thing(one), {"pose": {"x": [-0.3, 0.3]}}) for one in (rough, fine))
    _, slope = renderer.gradient(smooth_loss(renderer.formation.resolution), renderer.start, 0, SPP)
    with torch.no_grad():
        apart = float((renderer(renderer.start, 0, 64) - coarse(coarse.start, 0, 64)).abs().mean())
    return found.findings(
        Check("triangles", float(len(fine.faces)), least=1e6),
        holds("the gradient by a shift is finite", bool(torch.isfinite(slope).all())),
        Check("mean difference from a sphere of 16,000", apart, most=SAME_PICTURE),
    )


def sized(scale: float) -> Outcome:
    """The object 100 times smaller or larger: a speck, or a wall around the camera."""
    low, high = (scale, 2.0 * scale) if scale < 1.0 else (scale / 2.0, scale)
    renderer = small("mug", {"pose": {"scale": [low, high]}})
    return examine_gradient(renderer, torch.tensor([0.0 if scale < 1.0 else 1.0]), compare=False).findings()


for scale in (0.01, 100.0):
    GEOMETRY.case(f"scale-{scale:g}", _SCENE, "pose", holds="Picture and gradient are finite.")(partial(sized, scale))


def file_units(scale: float, shift: float = 0.0) -> Outcome:
    """A file in other units, or far from its origin, is the same object."""
    points = np.array([[x, y, z] for x in (-0.3, 0.3) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
    corners = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]]
    faces = [[a, b, c] for a, b, c, _ in corners] + [[a, c, d] for a, _, c, d in corners]
    with tempfile.TemporaryDirectory() as folder:
        pictures = []
        for factor, away in ((1.0, 0.0), (scale, shift)):
            path = Path(folder) / "box.obj"
            path.write_text(_obj(points * factor + away, faces))
            renderer = small(path, {"pose": {"x": [-0.3, 0.3]}})
            pictures.append(_shown(renderer.start, renderer))
        found = examine_gradient(renderer, compare=False)
    apart = float((pictures[0] - pictures[1]).abs().mean())
    return found.findings(Check("mean difference from the same box at home", apart, most=SAME_PICTURE))


for scale in (0.01, 100.0):
    GEOMETRY.case(
        f"file-in-units-of-{scale:g}", _NORMAL, "pose", holds="A file in other units gives the same picture."
    )(partial(file_units, scale))
GEOMETRY.case(
    "file-10000-sizes-off",
    _NORMAL,
    "pose",
    holds="A mesh that its file puts 10,000 sizes from the origin gives the same picture.",
)(partial(file_units, 1.0, FAR))


@GEOMETRY.case("translation-10000", _SCENE, "pose")
def far_away() -> Outcome:
    """The picture is that of the scene without the object, and the gradient is zero."""
    renderer = small("mug", {"pose": {"y": [9e3, FAR]}})
    found = examine_gradient(renderer, torch.tensor([1.0]))
    empty = small("mug", {"pose": {"z": [-3.0, -2.0]}}, settings={"pose.x": 9e3})
    apart = float((_shown(torch.tensor([1.0]), renderer) - _shown(empty.start, empty)).abs().mean())
    return found.findings(
        Check("mean difference from the scene without it", apart, most=SAME_PICTURE),
        Check("largest gradient", found.gradient, most=1e-6),
    )


def extreme_view(controls: ControlSettings, u: Sequence[float], *, black: bool = True, compare: bool = True) -> Outcome:
    """The mug, in black on a bare sky where only its outline is to move, seen in some extreme way."""
    renderer = small(dark() if black else "mug", controls, settings=BARE if black else None)
    return examine_gradient(renderer, torch.tensor(u, dtype=torch.float32), compare=compare).findings()


GEOMETRY.case(
    "grazing-view", _PIXEL, "camera", holds="Looking along the ground, the gradient by the elevation is right."
)(partial(extreme_view, {"camera": {"elevation": [-10.0, 10.0]}}, [0.5]))
GEOMETRY.case(
    "near-plane", _SCENE, "camera", holds="With the camera inside the object, picture and gradient are finite."
)(partial(extreme_view, {"camera": {"distance": [0.05, 0.2]}}, [0.5], black=False, compare=False))
GEOMETRY.case("object-fills-the-frame", _SCENE, "camera", holds="Finite where nothing but the object is seen.")(
    partial(extreme_view, {"camera": {"distance": [0.5, 0.8], "fov": 10.0}}, [0.5], black=False, compare=False)
)
GEOMETRY.case("object-leaves-the-frame", _PIXEL, "pose", holds="Half outside, the gradient by the shift is right.")(
    partial(extreme_view, {"pose": {"x": [0.0, 2.0]}}, [0.5])
)


@GEOMETRY.case("gimbal-angles", "differences of each number; the rotation vector does not lock", "pose", cheap=False)
def gimbal() -> Outcome:
    """At a pitch of 90 degrees the gradients by angles and by the rotation vector are right."""
    angles = {"pose": {"yaw": [-90.0, 90.0], "pitch": [45.0, 135.0], "roll": [-90.0, 90.0], "on_ground": "no"}}
    locked = small(dark(), angles, settings=BARE)
    u = torch.tensor([0.7, 0.5, 0.5])
    found = examine_gradient(locked, u, seeds=(3, 12), spp=2 * SPP)
    with torch.no_grad():
        one = locked(torch.tensor([0.7, 0.5, 0.5]), 0, 16)
        other = locked(torch.tensor([0.5, 0.5, 0.3]), 0, 16)  # yaw 36 is roll -36 here
    free = small(dark(), {"pose": {"rotation": [-90.0, 90.0], "pitch": 90.0, "on_ground": "no"}}, settings=BARE)
    vector = compared(free, free.start + 0.1, seeds=(3, 5))
    worst = max(one.excess for one in vector.values())
    return found.findings(
        Check("mean difference of yaw 36 and roll -36", float((one - other).abs().mean()), most=SAME_PICTURE),
        Check("gradient error of the rotation vector", worst, most=0.1),
    )


def full_turn(controls: ControlSettings) -> Outcome:
    """0 and 360 degrees are one place: one picture, one gradient, and a step across the seam goes on."""
    renderer = small("mug", controls)
    zero, one = torch.zeros_like(renderer.start), torch.ones_like(renderer.start)
    loss = smooth_loss(renderer.formation.resolution)
    slopes = [renderer.gradient(loss, u, 0, SPP)[1] for u in (zero, one)]
    apart = float((_shown(zero, renderer) - _shown(one, renderer)).abs().mean())
    domain = search_domain(renderer)
    wrapped = domain.project(one + 0.01)
    found = examine_gradient(renderer, zero, compare=False)
    size = float(slopes[0].abs().max())
    return found.findings(
        Check("mean difference of the pictures", apart, most=SAME_PICTURE),
        Check("difference of the gradients", float((slopes[0] - slopes[1]).abs().max()) / size, most=0.05),
        Check("where a step of 0.01 past the end goes", float(wrapped.max()), 0.0099, 0.0101),
    )


for name in ("pose.yaw", "camera.azimuth", "environment.rotation"):
    GEOMETRY.case(
        f"full-turn-{name.replace('.', '-')}",
        _WRAP,
        name.partition(".")[0],
        holds="0 and 360 degrees give one picture and one gradient, and a step goes on across the seam.",
    )(partial(full_turn, {name.partition(".")[0]: {name.partition(".")[2]: [0.0, 360.0]}}))


def _shown(u: Tensor, renderer: object) -> Tensor:
    with torch.no_grad():
        picture: Tensor = renderer(u, seed=0, spp=16)  # type: ignore[operator]
    return picture


def _difference(one: Mesh, other: Mesh) -> float:
    shown = []
    for made in (one, other):
        renderer = small(thing(made), PAINTED, settings=FRONT)
        shown.append(_shown(renderer.start, renderer))
    return float((shown[0] - shown[1]).abs().mean())


def _obj(vertices: np.ndarray, faces: Sequence[Sequence[int]]) -> str:
    points = "".join(f"v {x:.12g} {y:.12g} {z:.12g}\n" for x, y, z in vertices)
    return points + "".join("f " + " ".join(str(1 + corner) for corner in face) + "\n" for face in faces)
