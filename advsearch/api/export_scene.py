"""The adversarial scene of a run, for other programs."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

import advsearch
from advsearch import seeds
from advsearch.config import AttackConfig
from advsearch.engine.attack_parts import judged_alone, problem_from_config
from advsearch.engine.problem import Problem
from advsearch.engine.retrial import kept_answer
from advsearch.errors import InputError
from advsearch.runs.directory import CONFIG, find_run
from advsearch.runs.files import placed_by, storage_errors, write_bytes, write_text
from advsearch.runs.summary import attack_of
from advsearch.scene.assembly import ON_PICTURE
from advsearch.scene.description import OBJECT
from advsearch.scene.exporting.gltf import PLAIN, glb, posed
from advsearch.scene.mitsuba_backend.files.writing import NAME, SCATTERINGS, write_scene
from advsearch.scene.parts import HazePart

GLB, XML = ".glb", ".xml"


@dataclass(frozen=True, eq=False)
class AnsweredRun:
    """A run with its answer.

    Attributes:
        folder: of the run.
        problem: as the run had it.
        u: (d,) the configuration of the whole space; what varies by chance is as in the clean scene.
    """

    folder: Path
    problem: Problem
    u: Tensor

    @property
    def on_picture(self) -> list[str]:
        """The controls that change the finished picture there."""
        grey = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))
        slices = self.problem.space.slices(self.u)
        return [control.name for control, part in slices if not torch.equal(control.picture(part, grey), grey)]

    @property
    def inputs(self) -> dict[str, Tensor]:
        """Those of the scene inside Mitsuba, and what is applied to its picture."""
        renderer = self.problem.renderer
        with torch.no_grad():
            return renderer.scene.assembly(renderer.space.inputs(self.u))


def answer_of(run: str | Path) -> AnsweredRun:
    """Load a run's scene and its answer.

    Args:
        run: name or folder of a run of `attack` that has ended.

    Raises:
        InputError: the run has no answer, or its scene is another one now.
        FileFormatError: the run did not end, or is of another command.
    """
    folder = find_run(run)
    summary = attack_of(folder)
    if summary.adversarial is None:
        raise InputError(f"{folder}: ended with {summary.ending!r}, so that there is no answer to export")
    problem, _ = problem_from_config(judged_alone(AttackConfig.from_yaml(folder / CONFIG)))
    trial = summary.adversarial.trial  # where conditions vary, those of the picture that the run keeps
    draw = None if trial is None else seeds.stream(problem.seed, "verification", trial)
    return AnsweredRun(folder, problem, problem.whole(kept_answer(folder, problem), draw))


def write_mitsuba(run: str | Path, out: Path) -> list[str]:
    """Write the scene of a run's answer as XML with its meshes and pictures beside it.

    Args:
        run: name or folder of a run of `attack` that has ended.
        out: a file that ends in .xml, or a folder for `scene.xml`; what is beside it has names that begin with its own.

    Returns:
        Sentences about how its picture becomes that of the run, and what is no part of it.

    Raises:
        InputError: the run has no answer, files of these names are there, or stock Mitsuba has no such scene.
        FileFormatError: the run did not end, or is of another command.
    """
    path = out if out.suffix.lower() == XML else out / NAME
    taken = [path, *path.parent.glob(f"{path.stem}-*")] if path.parent.is_dir() else []
    there = [one for one in taken if one.exists()]
    if there or path.parent.is_file():
        raise InputError(f"out: {(there or [path.parent])[0]} is there already; choose another name")
    answer = answer_of(run)
    renderer = answer.problem.renderer
    inputs = answer.inputs
    on_picture = {name: inputs.pop(name) for name in ON_PICTURE if name in inputs}
    backdrop = on_picture.get("backdrop.color")
    hazes = [part.name for part in renderer.scene.made[0].parts if isinstance(part, HazePart)]
    hazy = any(float(inputs[f"{name}.density"]) > 0.0 for name in hazes)
    if hazy and backdrop is not None:
        raise InputError(f"{answer.folder}: haze before a plain background is no part of a Mitsuba scene")
    gain = renderer.formation.gain
    if "camera.exposure" in on_picture:
        gain *= float(torch.exp2(on_picture["camera.exposure"]))
    height, width = renderer.formation.resolution
    notes = [
        f"The sensor has {width} x {height} pixels, and light paths have at most {renderer.scene.max_depth} segments.",
        f"The run's picture is the sRGB curve of {gain:.9g} times this radiance, cut off at 1.",
    ]
    if backdrop is not None:
        red, green, blue = (f"{one:.9g}" for one in (backdrop / renderer.formation.gain).tolist())
        notes.append(f"Where its alpha is under 1, add 1 - alpha times the plain background ({red}, {green}, {blue}).")
    if hazy:
        notes.append(f"Haze scatters light, which Mitsuba counts as a segment: {SCATTERINGS} more are for that.")
    if renderer.formation.denoiser != "none":
        notes.append("Not in it: the denoiser. Take many samples a pixel.")
    if answer.on_picture:
        notes.append(f"Not in it: what the control {', '.join(answer.on_picture)} did to the finished picture.")
    if answer.problem.conditions is not None:
        notes.append("What varied by chance in the run is as in the clean scene.")
    with placed_by("out"), storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".export-", dir=path.parent) as made:
            write_scene(renderer.scene, inputs, Path(made) / path.name, " ".join(notes), hide=backdrop is not None)
            for one in sorted(Path(made).iterdir()):
                os.replace(one, path.parent / one.name)
        text = f"The answer of {answer.folder.name} as a scene for Mitsuba 3 (advsearch {advsearch.__version__}).\n"
        write_text(path.with_name(f"{path.stem}-README.txt"), "\n".join([text, *notes, ""]), durable=False)
    return notes


def write_gltf(run: str | Path, out: Path) -> list[str]:
    """Write the object of a run's answer as binary glTF: displaced and in its pose, with its texture.

    Args:
        run: name or folder of a run of `attack` that has ended.
        out: a file that ends in .glb.

    Returns:
        Sentences about what is not as in the run.

    Raises:
        InputError: the run has no answer, or the file is called otherwise.
        FileFormatError: the run did not end, or is of another command.
    """
    if out.suffix.lower() != GLB:
        raise InputError(f"out: expected the name of a .glb file, got {out}")
    answer = answer_of(run)
    description = answer.problem.space.scene
    assert description is not None
    part = description.meshes[OBJECT]
    found = posed(part, answer.inputs)
    with placed_by("out"):
        write_bytes(out, glb([found]))
    notes = ["Lengths are in object sizes, y is up, and the texture is rounded to 8 bits."]
    if part.surface is not None:
        notes.append("Its surface is one of Mitsuba's own, of which glTF has the base colour only.")
    elif found.material.specular > PLAIN:
        notes.append(
            f"A specular of {found.material.specular:g} is over glTF's largest, {PLAIN:g}, which it has there."
        )
    return notes
