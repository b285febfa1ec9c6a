"""The pictures of an attack that a run keeps, as the model sees them and with its answers, and the object to turn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from advsearch import seeds
from advsearch.engine.problem import Problem
from advsearch.engine.record import KEPT, Findings
from advsearch.report.marks import marked
from advsearch.runs import images
from advsearch.runs.directory import IMAGES, OBJECT_FILE, RunDirectory
from advsearch.runs.files import write_bytes
from advsearch.scene.description import OBJECT
from advsearch.scene.exporting.gltf import PosedMesh, posed, web_glb
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.simpler import simpler
from advsearch.tasks import Mark

MOST_FACES = 30_000
"""Faces of the meshes that are kept to turn; of more, as many are shown."""

NEAR = 2.0
"""How far from the object's middle another mesh may be to be shown with it, in the object's extent."""


def write_pictures(
    run: RunDirectory,
    problem: Problem,
    findings: Findings,
    linear: dict[str, Tensor],
    seen: dict[str, Tensor],
    u: Tensor,
) -> None:
    """Write the pictures of the clean and the adversarial scene, of their difference, of trials and of the search.

    Args:
        run: gets them.
        problem: that was attacked.
        findings: of the attack.
        linear: (H, W, 3) radiance by "clean" and "adversarial".
        seen: the pictures (H, W, 3) that the model sees, likewise.
        u: (d,) of the adversarial one.
    """
    gain = problem.renderer.formation.gain
    for name, at in (("clean", problem.domain.start), ("adversarial", u)):
        run.save_image(name, seen[name])
        run.save_exr(name, linear[name] * gain)
        save_marked(run, name, seen[name], problem.marks(seen[name], problem.whole(at)))
        if problem.aovs:
            surfaces, file = problem.renderer.surfaces(problem.whole(at)), run.path / IMAGES / f"{name}.aov.exr"
            images.write_layers(file, surfaces.layers(problem.aovs, OBJECT), surfaces.notes(problem.aovs))
    run.save_image("difference", images.difference(seen["clean"], seen["adversarial"]))
    checked = findings.verification
    kind = "verification" if findings.beaten is None else "baseline verification"
    for number in range(min(KEPT, len(checked.adversarial_trials) if checked else 0)):
        assert checked is not None
        seed, name = seeds.stream(problem.seed, "verification", number), f"verification-{number:02d}"
        picture = findings.pictures.get((kind, number))
        picture = problem.picture(checked.u, seed, findings.spp) if picture is None else picture
        run.save_image(name, picture)
        save_marked(run, name, picture, problem.marks(picture, problem.whole(checked.u, seed)))
    if findings.frames:
        run.save_animation("search", [*findings.frames, seen["adversarial"].numpy()])


def save_marked(run: RunDirectory, name: str, picture: Tensor, marks: list[Mark]) -> None:
    """Write ``<name>-answer.png``, the picture with marks; nothing where there are none."""
    if marks:
        run.save_image(f"{name}-answer", marked(picture.numpy(), marks))


def write_artifacts(run: RunDirectory, artifacts: dict[str, Tensor]) -> None:
    """Keep what the controls hand over: an 8-bit PNG, and an EXR of the same display-referred values in float32."""
    for name, picture in artifacts.items():
        run.save_image(name, picture, folder="artifacts")
        run.save_exr(name, picture, folder="artifacts")


def write_object(run: RunDirectory, problem: Problem, u: Tensor) -> None:
    """Keep the object, and the meshes beside it that controls move or paint, to turn in a browser.

    Args:
        run: gets them as a file of binary glTF, before and after.
        problem: that was attacked.
        u: (d,) of the answer.
    """
    scene, assembly = problem.space.scene, problem.renderer.scene.assembly
    if scene is None:
        return
    with torch.no_grad():
        after, before = (assembly(problem.space.inputs(problem.whole(at))) for at in (u, problem.domain.start))
    parts = [part for name, part in scene.meshes.items() if name == OBJECT or any(_of(key) == name for key in after)]
    fewer = {part.name: simpler(part.mesh, MOST_FACES // len(parts)) for part in parts}

    def shown(inputs: Mapping[str, Tensor]) -> list[PosedMesh]:
        found = [posed(part, inputs) for part in parts]
        thing = next(one for one in found if one.name == OBJECT).mesh.vertices
        middle, reach = thing.mean(axis=0), NEAR * float(np.ptp(thing, axis=0).max())
        near = [one for one in found if np.abs(one.mesh.vertices.mean(axis=0) - middle).max() < reach]
        return [replace(one, mesh=left.of(one.mesh)) if (left := fewer[one.name]) else one for one in near]

    camera = after.get("camera.to_world")
    pose = camera_to_world(scene) if camera is None else camera.double().numpy()
    cut = [f"{len(part.mesh.faces):,} of {part.name}" for part in parts if fewer[part.name]]
    note = f"It is shown with fewer faces than it has ({', '.join(cut)})." if cut else ""
    write_bytes(run.path / OBJECT_FILE, web_glb(shown(after), shown(before), pose, note))


def _of(key: str) -> str:
    return key.partition(".")[0]
