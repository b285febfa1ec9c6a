"""Export the adversarial scene of a run to other programs and to a printer.

Other programs get the scene. On paper, patches and the pieces of unwrapped textures
have the size in millimetres that they have on the real object.
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
from advsearch.controls.base import Control, to_file_name
from advsearch.controls.support.images import enlarge
from advsearch.controls.texture import TextureControl
from advsearch.engine.loading import Scene, load_scene, make_controls
from advsearch.engine.problem import Problem
from advsearch.engine.verifier import read_stored_configuration
from advsearch.errors import InputError
from advsearch.questions.attack.carry_out import (
    problem_from_config,
    with_evaluation_only,
)
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.summary import AttackSummary, load_attack_summary
from advsearch.report.sheets import Mask, Piece
from advsearch.runs.directory import ARTIFACTS, CONFIG, find_run
from advsearch.runs.files import read_png, to_8bit
from advsearch.scene.assembly import IMAGE_INPUTS, pose_mesh
from advsearch.scene.assets import Float32Array, Float64Array, IntArray, Mesh, Shape
from advsearch.scene.description import NO_ENVIRONMENT, OBJECT, SceneDescription
from advsearch.scene.parts import MeshPart
from advsearch.scene.raster import Charts, compute_doubled_areas, rasterize_charts


@dataclass(frozen=True, eq=False)
class AdversarialRun:
    """A run of `attack` with its adversarial scene.

    Attributes:
        folder: folder of the run.
        problem: the optimization problem of the run, with its scene and model.
        u: (d,), the adversarial configuration, with coordinates for the conditions
            that vary at random. Without a stored trial these have the values of the
            clean scene.
    """

    folder: Path
    problem: Problem
    u: Tensor

    @classmethod
    def load(cls, run: str | Path) -> AdversarialRun:
        """Load the adversarial scene of a finished run of `attack`, by its name or
        folder.

        Raises:
            InputError: it has no adversarial scene, or the scene of the run has changed
                since.
            FileFormatError: it has not finished, or is of another command.
        """
        folder = find_run(run)
        summary = load_attack_summary(folder)
        if summary.adversarial is None:
            raise _make_no_scene_error(folder, summary.ending)
        # A policy or an objective may exist only in the Python session of the run, and
        # is not needed here.
        config = with_evaluation_only(AttackConfig.from_yaml(folder / CONFIG))
        problem, _warnings = problem_from_config(config)
        conditions_seed = _derive_conditions_seed(problem, summary.adversarial.trial)
        u = read_stored_configuration(folder, problem)
        return cls(folder, problem, problem.make_full_configuration(u, conditions_seed))

    def split_inputs(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Return the inputs of the scene inside Mitsuba, and those applied to its
        image.
        """
        scene_inputs = {}
        image_inputs = {}
        for name, value in self.inputs.items():
            if name in IMAGE_INPUTS:
                image_inputs[name] = value
            else:
                scene_inputs[name] = value
        return scene_inputs, image_inputs

    def posed_object(self) -> tuple[MeshPart, Shape]:
        """Return the object as the scene describes it, and its mesh as it is in the
        adversarial scene: displaced, in its pose, with its texture.
        """
        description = self.problem.space.scene
        assert description is not None
        part = description.meshes[OBJECT]
        return part, pose_mesh(part, self.inputs)

    def render(self, inputs: Mapping[str, Tensor], seed: int, spp: int) -> Tensor:
        """Render the scene with other inputs, by the renderer of the run.

        Args:
            inputs: inputs of the scene and of the finished image, by name.
            seed: seed of the render.
            spp: samples per pixel.

        Returns:
            The image (H, W, 3), sRGB in [0, 1].
        """
        renderer = self.problem.renderer
        # inputs that are applied to the image after rendering are left out
        scene_inputs = {
            name: value for name, value in inputs.items() if name not in IMAGE_INPUTS
        }
        with torch.no_grad():
            rendered = renderer.render_radiance(
                scene_inputs, seed, spp, hide_environment="backdrop.color" in inputs
            )
            # `u` has the values of controls that change the finished image
            return renderer.finish_image(rendered, inputs, self.u)

    @property
    def image_controls(self) -> list[str]:
        """The names of the controls that change the finished image, such as lens blur.

        They are found by a test: a control is among them if it changes an image of
        noise.
        """
        noise = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))
        return [
            control.name
            for control, control_u in self.problem.space.split_by_control(self.u)
            if not torch.equal(control.apply_to_image(control_u, noise), noise)
        ]

    @property
    def inputs(self) -> dict[str, Tensor]:
        """The inputs of the scene inside Mitsuba, and those applied to its image."""
        renderer = self.problem.renderer
        with torch.no_grad():
            return renderer.scene.input_assembler(renderer.space.inputs(self.u))


def _derive_conditions_seed(problem: Problem, trial: int | None) -> int | None:
    """Return the seed of the conditions that vary at random, such as the camera.

    Args:
        problem: the problem of the run.
        trial: the trial (verification render) whose image the run stores; None without
            one: then there is no seed.
    """
    if trial is None:
        return None
    return seeds.derive_seed(problem.seed, "verification", trial)


BLEED = 3.0  # width of the color beyond the line to cut, in millimetres
MAX_PIXEL_SIZE = 0.2
"""Maximum size of a printed pixel in millimetres. Larger texels are subdivided, and
interpolated as by the renderer.
"""
# Maximum subdivisions of a texel per axis; odd, so that the center has its own color.
MAX_SUBDIVISIONS = 9
MAX_OBJECT_SIZE = 100_000.0  # maximum size of a printed object in millimetres


def get_real_size(run: str | Path) -> float | None:
    """Return the length of the longest side of a run's object in millimetres; None if
    it is unknown.

    The run is one of `attack`.
    """
    folder = find_run(run)
    load_attack_summary(folder)  # raises for runs of other commands
    scene = _load_object_scene(AttackConfig.from_yaml(folder / CONFIG))
    metres = scene.description.object.size_in_metres
    return None if metres is None else metres * 1000.0


def _load_object_scene(config: AttackConfig) -> Scene:
    """Load the scene of an attack with the object alone, without an environment."""
    return load_scene(
        config.object,
        NO_ENVIRONMENT,
        up=config.up,
        facing=config.facing,
        size=config.size,
        unit=config.unit,
    )


def _make_no_scene_error(folder: Path, ending: str) -> InputError:
    """Return the error for a run that found no adversarial scene.

    Args:
        folder: folder of the run.
        ending: status with which the run ended.
    """
    return InputError(
        f"{folder}: ended with {ending!r}, so that there is no adversarial "
        "configuration to export"
    )


def make_printable_pieces(run: str | Path, size: float) -> list[Piece]:
    """Return the printable pieces of the adversarial scene of a run of `attack`.

    A patch is one piece. A texture has a piece for each connected part of its unwrapped
    surface. A piece is scaled along both axes to the mean size of its texels on the
    object. Texels within it may still differ in size; then its name says by how much.

    Args:
        run: name or folder of the run.
        size: longest side of the real object in millimetres.

    Raises:
        InputError: nothing can be printed, or the size is out of range.
        FileFormatError: the run is of another kind, has not finished, or lacks files.
    """
    _check_printed_size(size)
    folder = find_run(run)
    summary = load_attack_summary(folder)
    config = AttackConfig.from_yaml(folder / CONFIG)
    scene = _load_object_scene(config)
    pieces = list[Piece]()
    for control in make_controls(config.controls):
        texture_file = folder / ARTIFACTS / f"{to_file_name(control.name)}.png"
        if control.kind == "patch":
            patch_size = size * _get_relative_patch_size(control, config, summary)
            pieces.append(_make_patch_piece(control, folder, patch_size))
        elif isinstance(control, TextureControl) and texture_file.is_file():
            description = scene.description
            pieces += _make_texture_pieces(control, description, texture_file, size)
    _check_any_pieces(folder, pieces)
    return pieces


def _check_printed_size(size: float) -> None:
    """Check the longest side of the real object, in millimetres.

    Raises:
        InputError: it is out of range.
    """
    if not 1.0 <= size <= MAX_OBJECT_SIZE:
        raise InputError(
            "size: expected the object's longest side in millimetres, 1 "
            f"to {MAX_OBJECT_SIZE:.0f}, got {size}"
        )


def _check_any_pieces(folder: Path, pieces: list[Piece]) -> None:
    """Check that a run has at least one piece to print.

    Raises:
        InputError: it has none.
    """
    if not pieces:
        raise InputError(
            f"{folder}: it has neither a texture nor a patch, so that there is nothing "
            "to print"
        )


def _make_patch_piece(control: Control, folder: Path, patch_size: float) -> Piece:
    """Return the piece of a patch, whose pixels the run stores.

    Args:
        control: control of the patch.
        folder: folder of the run.
        patch_size: width and height of the patch in millimetres.
    """
    file_stem = to_file_name(control.name)
    pixels = read_png(folder / ARTIFACTS / f"{file_stem}-pixels.png")
    pixel_size = patch_size / len(pixels)  # as many rows as columns
    name = f"{control.name}, {patch_size:.1f} mm a side"
    return _make_piece(name, pixels, (pixel_size, pixel_size), inside=None)


def _make_texture_pieces(
    control: TextureControl,
    description: SceneDescription,
    texture_file: Path,
    size: float,
) -> Iterator[Piece]:
    """Return a piece for each connected part of the unwrapped surface of a texture.

    Args:
        control: control of the texture.
        description: description of the scene.
        texture_file: PNG file of the texture.
        size: longest side of the real object in millimetres.
    """
    # the mesh with the texture: the object, or another mesh of the scene
    mesh = control.get_mesh(description).mesh
    materials = control.list_materials(description)
    faces = None  # all of them
    if materials is not None:
        faces = np.concatenate([mesh.materials[name] for name in materials])
    # All meshes of a scene have the same unit of length. `size` is the longest side of
    # the object, so the object determines how many millimetres a unit has.
    object_vertices = description.object.mesh.vertices
    scale = size / float(np.ptp(object_vertices, axis=0).max())
    texture = read_png(texture_file)
    return _find_charts(control.name, texture, mesh, faces, scale)


def _get_relative_patch_size(
    control: Control, config: AttackConfig, summary: AttackSummary
) -> float:
    """Return the size of a patch as a fraction of the object's size.

    It is the size that the search found, if it searched for one; otherwise the size in
    the settings, or the default.

    Args:
        control: control of the patch.
        config: settings of the run.
        summary: result of the run.
    """
    searched_size = (summary.configuration or {}).get(f"{control.name}.size")
    size: Any
    if searched_size is not None:
        size = searched_size.value
    else:
        size = config.controls.get(control.name, {}).get("size")
    if isinstance(size, (int, float)):
        return float(size)
    return _get_default_patch_size(control)  # not set, or a range


def _get_default_patch_size(control: Control) -> float:
    """Return the default size of a patch, as a fraction of the object's size."""
    default = next(
        parameter.default
        for parameter in control.parameters
        if parameter.name == "size"
    )
    return float(default)


def _find_charts(
    name: str, texture: Float32Array, mesh: Mesh, faces: IntArray | None, scale: float
) -> Iterator[Piece]:
    """Yield the charts of an unwrapped texture as pieces, the largest first.

    A chart is a connected part of the texture. Pieces are oriented as seen from outside
    of the object, so that they can be glued on it.

    Args:
        name: name of the texture.
        texture: image of the texture, (h, w, 3).
        mesh: mesh with the texture coordinates.
        faces: indices of the faces to print; None for all.
        scale: millimetres per unit of the mesh.
    """
    # signed areas of the faces in the texture
    uv_areas = compute_doubled_areas(mesh.uvs[mesh.faces].astype(np.float64))
    raster = rasterize_charts(mesh, (texture.shape[0], texture.shape[1]))
    positions = raster.compute_positions().astype(np.float64)
    charts = _label_charts(_find_printed_texels(raster, faces))
    for number, (box, inside) in enumerate(charts, 1):
        # A chart whose texture coordinates are mirrored has a negative signed area.
        chart_faces = np.unique(raster.face_index[box][inside])
        is_mirrored = bool(uv_areas[chart_faces].sum() < 0.0)
        chart_name = name if len(charts) == 1 else f"{name}, piece {number}"
        chart_positions = positions[box] * scale
        piece = _make_chart_piece(
            chart_name, texture[box], chart_positions, inside, is_mirrored=is_mirrored
        )
        if piece is not None:
            yield piece


def _make_chart_piece(
    name: str,
    texture: Float32Array,
    positions: Float64Array,
    inside: Mask,
    *,
    is_mirrored: bool,
) -> Piece | None:
    """Return a chart as a piece; None for a line or a point, which cannot be printed.

    Args:
        name: name of the chart.
        texture: (h, w, 3), the image in the box around the chart.
        positions: (h, w, 3) of its texels, in millimetres.
        inside: (h, w) bool, the texels of the chart.
        is_mirrored: whether the chart is mirrored in the texture.
    """
    size_and_distortion = _measure_texel_size(positions, inside)
    if size_and_distortion is None:
        return None
    texel_size, distortion = size_and_distortion
    image = _extend_inside(texture, inside)
    if is_mirrored:  # mirror it back; the size of its texels stays the same
        image = image[:, ::-1]
        inside = inside[:, ::-1]
    title = name + _describe_distortion(distortion)
    return _make_piece(title, image, texel_size, inside)


def _find_printed_texels(raster: Charts, faces: IntArray | None) -> Mask:
    """Return which texels (h, w) of a texture are printed.

    Args:
        raster: the face that each texel belongs to.
        faces: indices of the faces to print; None for all.
    """
    if faces is None:
        return raster.is_covered
    is_printed: Mask = raster.is_covered & np.isin(raster.face_index, faces)
    return is_printed


def _describe_distortion(distortion: float) -> str:
    """Return by how much the sizes of texels differ, for a title; "" if they are equal.

    Args:
        distortion: coefficient of variation of the sizes.
    """
    if distortion >= 0.005:  # half a percent: less is rounded to 0 %
        return f" (sizes within it differ by {100 * distortion:.0f} %)"
    return ""


def _label_charts(is_printed: Mask) -> list[tuple[tuple[slice, slice], Mask]]:
    """Return the connected parts of a mask (h, w), the largest first: the bounding box
    of each (rows, columns), and its mask inside the box.
    """
    labels, _ = ndimage.label(is_printed)
    # Labels of parts begin at 1; 0 is what is outside of all parts.
    boxes = ndimage.find_objects(labels)
    charts = [(box, labels[box] == label) for label, box in enumerate(boxes, 1)]

    def count_texels(chart: tuple[tuple[slice, slice], Mask]) -> int:
        _box, inside = chart
        return int(inside.sum())

    # `reverse` keeps the order of charts of equal size
    return sorted(charts, key=count_texels, reverse=True)


def _extend_inside(image: Float32Array, inside: Mask) -> Float32Array:
    """Replace the pixels outside a mask by the nearest ones inside."""
    nearest_inside = ndimage.distance_transform_edt(
        ~inside, return_distances=False, return_indices=True
    )
    extended: Float32Array = image[tuple(nearest_inside)]
    return extended


def _measure_texel_size(
    positions: Float64Array, inside: Mask
) -> tuple[tuple[float, float], float] | None:
    """Measure the texels of a part on the surface.

    Args:
        positions: (h, w, 3) of the texels, in millimetres.
        inside: (h, w) bool, the texels of the part.

    Returns:
        Width and height of a texel, the mean distances of neighbours along rows and
        columns; and the distortion, the larger of the coefficients of variation of
        these distances. None if the part is a line or a point of texels, which has no
        area to print.
    """
    # along rows (width), then along columns (height)
    distances_by_axis = [
        _measure_texel_distances(positions, inside, axis) for axis in (1, 0)
    ]
    has_both = all(len(distances) > 0 for distances in distances_by_axis)
    if not has_both:  # the texels are a line or a point
        return None
    width, height = (float(np.mean(distances)) for distances in distances_by_axis)
    if min(width, height) <= 0.0:
        return None
    distortion = max(
        float(np.std(distances) / np.mean(distances)) for distances in distances_by_axis
    )
    return (width, height), distortion


def _measure_texel_distances(
    positions: Float64Array, inside: Mask, axis: int
) -> Float64Array:
    """Return the distances (n,) of the texels of a part to the next along an axis.

    Args:
        positions: (h, w, 3) of the texels.
        inside: (h, w) bool, the texels of the part.
        axis: 0 along columns, 1 along rows.
    """
    # one distance for each texel that has a next texel along the axis
    distances = np.linalg.norm(np.diff(positions, axis=axis), axis=-1)
    is_inside = np.delete(inside, -1, axis)  # all but the last texel
    is_next_inside = np.delete(inside, 0, axis)  # all but the first texel
    part_distances: Float64Array = distances[is_inside & is_next_inside]
    return part_distances


def _make_piece(
    name: str, image: Float32Array, pixel_size: tuple[float, float], inside: Mask | None
) -> Piece:
    """Return a piece to print, with fine pixels and a margin.

    Pixels are subdivided until they are no larger than `MAX_PIXEL_SIZE`. The edge is
    repeated in a margin (bleed), so that no paper shows after an imprecise cut.

    Args:
        name: name of the piece.
        image: (h, w, 3), sRGB in [0, 1].
        pixel_size: (width, height) of a pixel in millimetres.
        inside: (h, w) bool, the part that is cut out with scissors; None for the full
            image.
    """
    subdivisions = _count_subdivisions(max(pixel_size))
    fine = _subdivide_pixels(image, subdivisions)
    fine_width = pixel_size[0] / subdivisions
    fine_height = pixel_size[1] / subdivisions
    bleed_columns = math.ceil(BLEED / fine_width)
    bleed_rows = math.ceil(BLEED / fine_height)
    padding = ((bleed_rows, bleed_rows), (bleed_columns, bleed_columns))
    # the edge is repeated into the bleed
    levels = np.pad(to_8bit(fine.numpy()), (*padding, (0, 0)), mode="edge")
    return Piece(
        name=name,
        picture=levels,
        pixel_size_mm=(fine_width, fine_height),
        bleed=(bleed_columns, bleed_rows),
        cut_mask=_make_cut_mask(inside, subdivisions, padding),
    )


def _make_cut_mask(
    inside: Mask | None,
    subdivisions: int,
    padding: tuple[tuple[int, int], tuple[int, int]],
) -> Mask | None:
    """Return the part to cut out with its bleed; None for the full image.

    Args:
        inside: (h, w) bool, the part; None for the full image.
        subdivisions: number of parts of a pixel along each axis.
        padding: width of the bleed in these parts: above and below, left and right.
    """
    if inside is None or inside.all():
        return None
    fine_inside = inside.repeat(subdivisions, axis=0).repeat(subdivisions, axis=1)
    return np.pad(fine_inside, padding)  # the bleed is outside of the cut


def _subdivide_pixels(image: Float32Array, subdivisions: int) -> Tensor:
    """Return an image (h, w, 3) with each pixel divided along both axes."""
    if subdivisions > 1:
        return enlarge(torch.from_numpy(np.ascontiguousarray(image)), subdivisions)
    return torch.from_numpy(image)


def _count_subdivisions(pixel_size: float) -> int:
    """Return into how many parts a pixel is divided along each axis.

    No part is larger than `MAX_PIXEL_SIZE`, unless that needs more than
    `MAX_SUBDIVISIONS` parts. The number is odd, so that one part is at the center of
    the pixel and has exactly its color.

    Args:
        pixel_size: longer side of the pixel in millimetres.
    """
    if pixel_size <= MAX_PIXEL_SIZE:
        return 1
    # the smallest odd number, 2 n + 1, that is at least pixel_size / MAX_PIXEL_SIZE
    n = math.ceil((pixel_size / MAX_PIXEL_SIZE - 1.0) / 2.0)
    return min(MAX_SUBDIVISIONS, 2 * n + 1)
