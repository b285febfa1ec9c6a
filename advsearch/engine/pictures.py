"""The pictures of an attack that a run keeps, as the model sees them and with its answers, and the object to turn."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

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
from advsearch.scene.assets import simpler
from advsearch.scene.description import OBJECT
from advsearch.scene.formation import to_8_bit
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.glb import PosedMesh, posed, web_glb
from advsearch.tasks import Judgement, Mark

MOST_FACES = 30_000
"""Faces of the meshes that are kept to turn; of more, as many are shown."""

NEAR = 2.0
"""How far from the object's middle another mesh may be to be shown with it, in the object's extent."""


PICTURE_SPP = 16
"""Samples a pixel of the pictures that are kept where nothing was tried."""


@dataclass(frozen=True, eq=False)
class KeptPicture:
    """The picture of a configuration that is kept, and what is true of this picture alone.

    Attributes:
        whole: the configuration of the whole space, with the conditions of this picture.
        radiance: (H, W, 3) linear.
        picture: (H, W, 3) sRGB as the model sees it, 8-bit values in [0, 1].
        judgement: what the task says of the model's answer to it.
        trial: number of the trial that it is of; None where nothing was tried.
    """

    whole: Tensor
    radiance: Tensor
    picture: Tensor
    judgement: Judgement
    trial: int | None

    @classmethod
    def of(cls, problem: Problem, findings: Findings, u: Tensor, trial: int | None) -> KeptPicture:
        """Render the searched controls at `u` as they are in a trial; as the scene comes, where that is None."""
        seed = seeds.stream(problem.seed, *(("pictures",) if trial is None else ("verification", trial)))
        whole, spp = problem.whole(u, None if trial is None else seed), PICTURE_SPP if trial is None else findings.spp
        with torch.no_grad():
            radiance = problem.renderer.radiance(whole, seed, spp)
            picture = to_8_bit(problem.space.picture(whole, problem.renderer.formation.display(radiance)))
        return cls(whole, radiance, picture, problem.judge(picture, whole), trial)


def trial_to_show(findings: Findings) -> int | None:
    """Return the trial whose pictures are kept, of the clean scene and of the answer, which see the same conditions.

    It is the first with the most frequent answer among the successes (else among the trials that count), if there is
    one beside which the clean scene has its own most frequent answer. None where nothing was tried.
    """
    checked, clean = findings.verification, _labels(findings.clean)
    if checked is None:
        return clean.index(_usual(clean)) if clean else None
    answers = _labels(checked.adversarial_trials)
    usual, usual_clean = _usual(_labels(checked.successes or checked.counting)), _usual(clean)
    ranks = [
        (answer == usual and outcome is bool(checked.successes), answer == usual, beside == usual_clean)
        for answer, outcome, beside in zip(answers, checked.outcomes, clean, strict=False)
    ]
    return ranks.index(max(ranks))


def _labels(trials: Sequence[Judgement]) -> list[str]:
    return [trial.answer.label for trial in trials]


def _usual(labels: Sequence[str]) -> str:
    """The most frequent label; the first of equals."""
    return Counter(labels).most_common(1)[0][0]


def write_pictures(run: RunDirectory, problem: Problem, findings: Findings, shown: Mapping[str, KeptPicture]) -> None:
    """Write the pictures of the clean and the adversarial scene, of their difference, of trials and of the search.

    Args:
        run: gets them.
        problem: that was attacked.
        findings: of the attack.
        shown: "clean" and "adversarial".
    """
    gain = problem.renderer.formation.gain
    for name, one in shown.items():
        run.save_image(name, one.picture)
        run.save_exr(name, one.radiance * gain)
        save_marked(run, name, one.picture, problem.marks(one.picture, one.whole))
        if problem.aovs:
            surfaces, file = problem.renderer.surfaces(one.whole), run.path / IMAGES / f"{name}.aov.exr"
            images.write_layers(file, surfaces.layers(problem.aovs, OBJECT), surfaces.notes(problem.aovs))
    run.save_image("difference", images.difference(shown["clean"].picture, shown["adversarial"].picture))
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
        last = shown["adversarial"].picture
        if problem.conditions is not None and findings.search is not None:  # the frames see the scene as it comes
            last = KeptPicture.of(problem, findings, problem.domain.project(findings.search.best_u), None).picture
        run.save_animation("search", [*findings.frames, last.numpy()])


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
    parts = [
        part
        for name, part in scene.meshes.items()
        if name == OBJECT or any(key.partition(".")[0] == name for key in after)
    ]
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
