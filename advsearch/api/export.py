"""The adversarial scene of a run for other programs and for print.

Other programs get the adversarial scene. Printed are patches, and textures unwrapped
into pieces, in true millimetres.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from advsearch import seeds
from advsearch.controls.base import file_name
from advsearch.controls.support.images import enlarged
from advsearch.controls.texture import TextureControl
from advsearch.engine.loading import Scene, as_controls, load_scene
from advsearch.engine.problem import Problem
from advsearch.engine.verifier import kept_configuration
from advsearch.errors import InputError
from advsearch.questions.attack.carry_out import judged_alone, problem_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.summary import attack_of
from advsearch.report.sheets import Mask, Piece
from advsearch.runs.directory import ARTIFACTS, CONFIG, find_run
from advsearch.runs.files import read_png, to_8bit
from advsearch.scene.assembly import ON_PICTURE, posed
from advsearch.scene.assets import Floats, Ints, Mesh, Shape
from advsearch.scene.description import NO_MAP, OBJECT
from advsearch.scene.parts import MeshPart
from advsearch.scene.raster import doubled_areas, rasterised


@dataclass(frozen=True, eq=False)
class AdversarialRun:
    """A run's folder, its problem as it had it, and its adversarial configuration: u
    (d,), the configuration of the whole space; what varies by chance is as in the clean
    scene.
    """

    folder: Path
    problem: Problem
    u: Tensor

    @classmethod
    def load(cls, run: str | Path) -> AdversarialRun:
        """Load the scene of a run of `attack` that has ended, by its name or folder,
        and its adversarial configuration.

        Raises InputError where it has none, or its scene is another one now, and
        FileFormatError where it did not end, or is of another command.
        """
        folder = find_run(run)
        summary = attack_of(folder)
        if summary.adversarial is None:
            raise InputError(
                f"{folder}: ended with {summary.ending!r}, so that there is no "
                "adversarial configuration to export"
            )
        problem, _ = problem_from_config(
            judged_alone(AttackConfig.from_yaml(folder / CONFIG))
        )
        # where conditions vary, those of the picture that the run keeps
        trial = summary.adversarial.trial
        draw = (
            None if trial is None else seeds.stream(problem.seed, "verification", trial)
        )
        return cls(
            folder, problem, problem.whole(kept_configuration(folder, problem), draw)
        )

    def split_inputs(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Return the inputs of the scene inside Mitsuba, and those that are applied to
        its image.
        """
        inputs = self.inputs
        on_image = {name: inputs.pop(name) for name in ON_PICTURE if name in inputs}
        return inputs, on_image

    def posed_object(self) -> tuple[MeshPart, Shape]:
        """Return the object as the scene describes it, and as it is there: displaced,
        in its pose, with its texture.
        """
        description = self.problem.space.scene
        assert description is not None
        part = description.meshes[OBJECT]
        return part, posed(part, self.inputs)

    def render(self, inputs: Mapping[str, Tensor], seed: int, spp: int) -> Tensor:
        """Render the scene with some inputs, as the run does it: an image (H, W, 3)
        sRGB in [0, 1].
        """
        renderer = self.problem.renderer
        traced = {
            name: value for name, value in inputs.items() if name not in ON_PICTURE
        }
        with torch.no_grad():
            rendered = renderer.rendered(traced, seed, spp, "backdrop.color" in inputs)
            return renderer.finished(rendered, inputs, self.u)

    @property
    def on_picture(self) -> list[str]:
        """The controls that change the finished picture there."""
        grey = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))
        slices = self.problem.space.slices(self.u)
        return [
            control.name
            for control, part in slices
            if not torch.equal(control.picture(part, grey), grey)
        ]

    @property
    def inputs(self) -> dict[str, Tensor]:
        """Those of the scene inside Mitsuba, and what is applied to its picture."""
        renderer = self.problem.renderer
        with torch.no_grad():
            return renderer.scene.assembly(renderer.space.inputs(self.u))


BLEED = 3.0  # millimetres of colour beyond the line to cut
FINEST = 0.2
"""Millimetres of a pixel that is fine enough: texels are divided until they are no
larger, and are interpolated between as the renderer does it.
"""
# parts of a texel along each side, odd: the middle one has the texel's own colour
MOST_PARTS = 9
LONGEST = 100_000.0  # longest side of a printed object, in millimetres


def real_size(run: str | Path) -> float | None:
    """Return the longest side of the object of a run of `attack`, in millimetres; None
    where its size is not known.
    """
    folder = find_run(run)
    attack_of(folder)  # refuses others
    metres = _alone(AttackConfig.from_yaml(folder / CONFIG)).description.object.metres
    return None if metres is None else metres * 1000.0


def _alone(config: AttackConfig) -> Scene:
    return load_scene(
        config.object,
        NO_MAP,
        up=config.up,
        facing=config.facing,
        size=config.size,
        unit=config.unit,
    )


def printable(run: str | Path, size: float) -> list[Piece]:
    """Return what of the adversarial scene of a run of `attack` can be printed, by the
    longest side of the real object in millimetres. A patch is one piece. A texture has
    one for each connected part of the unwrapped surface, stretched along both sides to
    the mean size that its texels have on the object; what is left of distortion within
    a piece is in its name. Raises InputError where nothing can be printed, or the size
    is out of range, and FileFormatError where the run is of another kind, has not
    ended, or lacks its files.
    """
    if not 1.0 <= size <= LONGEST:
        raise InputError(
            "size: expected the object's longest side in millimetres, 1 "
            f"to {LONGEST:.0f}, got {size}"
        )
    folder = find_run(run)
    summary = attack_of(folder)
    config = AttackConfig.from_yaml(folder / CONFIG)
    scene = _alone(config)
    pieces = list[Piece]()
    for control in as_controls(config.controls):
        picture = folder / ARTIFACTS / f"{file_name(control.name)}.png"
        if control.kind == "patch":
            pixels = read_png(folder / ARTIFACTS / f"{control.name}-pixels.png")
            searched = (summary.configuration or {}).get(f"{control.name}.size")
            fixed: Any = (
                config.controls.get(control.name, {}).get("size")
                if searched is None
                else searched.value
            )
            default = next(
                parameter.default
                for parameter in control.parameters
                if parameter.name == "size"
            )
            side = size * float(fixed if isinstance(fixed, (int, float)) else default)
            pieces.append(
                _piece(
                    f"{control.name}, {side:.1f} mm a side",
                    pixels,
                    (side / len(pixels),) * 2,
                    None,
                )
            )
        elif isinstance(control, TextureControl) and picture.is_file():
            mesh = control.mesh_in(scene.description).mesh
            named = control.materials_in(scene.description)
            faces = (
                None
                if named is None
                else np.concatenate([mesh.materials[one] for one in named])
            )
            extent = float(np.ptp(scene.description.object.mesh.vertices, axis=0).max())
            pieces.extend(
                _charts(control.name, read_png(picture), mesh, faces, size / extent)
            )
    if not pieces:
        raise InputError(
            f"{folder}: it has neither a texture nor a patch, so that "
            "there is nothing to print"
        )
    return pieces


def _charts(
    name: str, texture: Floats, mesh: Mesh, faces: Ints | None, scale: float
) -> Iterator[Piece]:
    """Yield the connected parts of a texture as they are seen from outside, the largest
    first; with `faces` those of these faces. Neighbouring texels of one part lie a
    distance apart on the surface; the mean over the part, along columns and rows, is
    the size that they get. `scale` is in millimetres a mesh unit.
    """
    areas = doubled_areas(mesh.uvs[mesh.faces].astype(np.float64))
    charts = rasterised(mesh, (texture.shape[0], texture.shape[1]))
    places = charts.positions().astype(np.float64)
    labels, count = ndimage.label(
        charts.covered & (True if faces is None else np.isin(charts.face, faces))
    )
    boxes = ndimage.find_objects(labels)
    order = sorted(
        range(count), key=lambda index: -int((labels[boxes[index]] == index + 1).sum())
    )
    for number, index in enumerate(order, 1):
        rows, columns = boxes[index]
        inside = labels[rows, columns] == index + 1
        # distances on the surface between texels that are neighbours along an axis
        steps = []
        for axis in (1, 0):
            lengths = np.linalg.norm(
                np.diff(places[rows, columns] * scale, axis=axis), axis=-1
            )
            within = np.delete(inside, 0, axis) & np.delete(inside, -1, axis)
            steps.append(lengths[within])
        if not all(len(step) for step in steps):
            continue  # a line of texels has no area to print
        pixel = float(np.mean(steps[0])), float(np.mean(steps[1]))
        if min(pixel) <= 0.0:
            continue
        stretch = max(float(np.std(step) / np.mean(step)) for step in steps)
        nearest = ndimage.distance_transform_edt(
            ~inside, return_distances=False, return_indices=True
        )
        picture = texture[rows, columns][tuple(nearest)]
        if areas[np.unique(charts.face[rows, columns][inside])].sum() < 0.0:
            picture = picture[:, ::-1]
            inside = inside[:, ::-1]
        title = name if count == 1 else f"{name}, piece {number}"
        title += (
            f" (sizes within it differ by {100 * stretch:.0f} %)"
            if stretch >= 0.005
            else ""
        )
        yield _piece(title, picture, pixel, inside)


def _piece(
    name: str, picture: Floats, pixel: tuple[float, float], inside: Mask | None
) -> Piece:
    parts = (
        min(MOST_PARTS, 2 * math.ceil((max(pixel) / FINEST - 1.0) / 2.0) + 1)
        if max(pixel) > FINEST
        else 1
    )
    fine = (
        enlarged(torch.from_numpy(np.ascontiguousarray(picture)), parts)
        if parts > 1
        else torch.from_numpy(picture)
    )
    size = pixel[0] / parts, pixel[1] / parts
    columns, rows = (math.ceil(BLEED / side) for side in size)
    levels = np.pad(
        to_8bit(fine.numpy()), ((rows, rows), (columns, columns), (0, 0)), mode="edge"
    )
    mask = None
    if inside is not None and not inside.all():
        mask = np.pad(
            inside.repeat(parts, 0).repeat(parts, 1), ((rows, rows), (columns, columns))
        )
    return Piece(name, levels, size, (columns, rows), mask)
