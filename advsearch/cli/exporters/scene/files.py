"""Export the adversarial scene of a run for Mitsuba, and its object as glTF."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import advsearch
from advsearch.extend import InputError, exports, mitsuba_data, parts, reading, writing

GLB = ".glb"
XML = ".xml"


def write_mitsuba(run: str | Path, out: Path) -> list[str]:
    """Write the adversarial scene of a run as XML for Mitsuba.

    Its meshes and pictures are files in the same folder, whose names begin with the
    name of the XML file.

    Args:
        run: a name or a folder.
        out: a file that ends in .xml, or a folder for `scene.xml`.

    Returns:
        Sentences about how a rendering of the files becomes the picture of the run, and
        about what is missing in them.

    Raises:
        InputError: the files exist already, or Mitsuba without advsearch cannot render
            such a scene; other errors as for `AdversarialRun.load`.
    """
    path = out if out.suffix.lower() == XML else out / mitsuba_data.SCENE_FILE_NAME
    check_free(path, out)
    adversarial = exports.AdversarialRun.load(run)
    renderer = adversarial.problem.renderer
    # `scene_inputs` are inputs of the scene that Mitsuba renders; `image_inputs` are
    # for the steps after rendering, such as the exposure.
    scene_inputs, image_inputs = adversarial.split_inputs()
    # color of a plain background; None if the environment is visible
    backdrop = image_inputs.get("backdrop.color")
    hazy = has_haze(renderer, scene_inputs)
    _check_backdrop(backdrop, adversarial.folder, hazy=hazy)  # raises for photographs
    gain = _compute_exposed_gain(renderer, image_inputs)
    notes = [
        *describe_formation(renderer, gain, backdrop),
        *describe_omissions(adversarial, hazy=hazy),
    ]
    with writing.name_setting_in_errors("out"), writing.storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        _write_scene_files(
            path,
            renderer.scene,
            scene_inputs,
            notes,
            hide_environment=backdrop is not None,
        )
        _write_scene_readme(path, adversarial.folder.name, notes)
    return notes


def _compute_exposed_gain(renderer: Any, image_inputs: Mapping[str, Any]) -> Any:
    """Return the factor from radiance to the value that the sRGB curve takes."""
    gain = renderer.formation.gain
    if "camera.exposure" in image_inputs:
        # the exposure is in stops, each of which doubles the light
        gain *= float(torch.exp2(image_inputs["camera.exposure"]))
    return gain


def _write_scene_files(
    path: Path,
    scene: Any,
    scene_inputs: Mapping[str, Any],
    notes: Sequence[str],
    *,
    hide_environment: bool,
) -> None:
    """Write the XML of a scene with its meshes and pictures: all files, or none.

    Args:
        path: the XML file; its folder exists.
        scene: the scene of a renderer.
        scene_inputs: values of its inputs.
        notes: sentences for a comment in the file.
        hide_environment: whether the environment is invisible to the camera.
    """
    with tempfile.TemporaryDirectory(prefix=".export-", dir=path.parent) as folder:
        mitsuba_data.write_scene(
            scene,
            scene_inputs,
            Path(folder) / path.name,
            " ".join(notes),
            hide_environment=hide_environment,
        )
        # Moved when all files are written: so an error leaves none of them.
        for file in sorted(Path(folder).iterdir()):
            os.replace(file, path.parent / file.name)


def _write_scene_readme(path: Path, run_name: str, notes: Sequence[str]) -> None:
    """Write the notes about a scene as a text next to its XML file."""
    title = f"The adversarial scene of {run_name} as a scene for Mitsuba 3"
    text = [f"{title} (advsearch {advsearch.__version__}).\n", *notes, ""]
    writing.write_text(
        path.with_name(f"{path.stem}-README.txt"), "\n".join(text), durable=False
    )


def _check_backdrop(backdrop: torch.Tensor | None, folder: Path, *, hazy: bool) -> None:
    """Check that a scene file of Mitsuba can represent the background.

    Args:
        backdrop: a plain background (3,) or a photograph (H, W, 3); None without.
        folder: folder of the run, for the message.
        hazy: whether there is haze in the scene.

    Raises:
        InputError: it cannot.
    """
    if backdrop is None:
        return
    is_photograph = backdrop.ndim > 1
    if is_photograph:
        raise InputError(
            f"{folder}: the scene is rendered into a photograph, which is "
            "no part of a Mitsuba scene; export the object as glTF (.glb) instead"
        )
    if hazy:
        raise InputError(
            f"{folder}: haze before a plain background is no part of a Mitsuba scene"
        )


def check_free(path: Path, out: Path) -> None:
    """Check that the files of a scene can be written without replacing anything.

    Args:
        path: the XML file of the scene. The other files have names that begin with its
            own.
        out: that file or its folder, as the user named it.

    Raises:
        InputError: one of the files exists, there is a file in place of the folder, or
            `out` is a link.
    """
    candidates = [path]
    if path.parent.is_dir():
        candidates += path.parent.glob(f"{path.stem}-*")
    existing = [file for file in candidates if os.path.lexists(file)]
    if existing or path.parent.is_file() or os.path.islink(out):
        first_existing = existing[0] if existing else path.parent
        raise InputError(f"out: {first_existing} is there already; choose another name")


def has_haze(renderer: Any, inputs: Mapping[str, Any]) -> bool:
    """Return whether a scene with these inputs has visible haze.

    Haze with density 0 is invisible.
    """
    description, _filter = renderer.scene.description_and_filter
    names = [
        part.name for part in description.parts if isinstance(part, parts.HazePart)
    ]
    return any(float(inputs[f"{name}.density"]) > 0.0 for name in names)


def describe_formation(renderer: Any, gain: float, backdrop: Any) -> list[str]:
    """Return sentences about how radiance that Mitsuba renders becomes the run's
    picture.

    Args:
        renderer: renderer of the run.
        gain: factor from radiance to the value that the sRGB curve takes, with the
            exposure of the scene.
        backdrop: linear color (3,) of the plain background, times the renderer's gain
            without exposure; None if there is no plain background.
    """
    height, width = renderer.formation.resolution
    notes = [
        f"The sensor has {width} x {height} pixels, and light paths have at most "
        f"{renderer.scene.max_depth} segments.",
        f"The run's picture is the sRGB curve of {gain:.9g} times this radiance, "
        "clipped at 1.",
    ]
    if backdrop is not None:
        # The color is added to the radiance, before the gain.
        channels = (backdrop / renderer.formation.gain).tolist()
        notes.append(_describe_backdrop(channels))
    return notes


def _describe_backdrop(channels: Sequence[float]) -> str:
    """Return a sentence about the radiance (red, green, blue) of a plain background."""
    red, green, blue = (f"{channel:.9g}" for channel in channels)
    return (
        "Before that, add (1 - alpha) times the plain background "
        f"({red}, {green}, {blue}) to each pixel of the radiance."
    )


def describe_omissions(adversarial: Any, *, hazy: bool) -> list[str]:
    """Return sentences about how the files differ from the scene of the run.

    Args:
        adversarial: the adversarial scene of the run.
        hazy: whether there is haze in the scene.
    """
    notes = []
    if hazy:
        notes.append(
            "Haze scatters light, which Mitsuba counts as a segment: "
            f"{mitsuba_data.EXTRA_DEPTH} more are for that."
        )
    if adversarial.problem.renderer.formation.denoiser != "none":
        notes.append("Not in it: the denoiser. Take many samples a pixel.")
    if adversarial.image_controls:
        notes.append(
            f"Not in it: what the control {', '.join(adversarial.image_controls)} "
            "did to the finished picture."
        )
    if adversarial.problem.conditions is not None:
        notes.append("What varied by chance in the run is as in the clean scene.")
    return notes


def write_gltf(run: str | Path, out: Path) -> list[str]:
    """Write the object of a run's adversarial scene as binary glTF.

    It has the geometry, the pose and the texture of the adversarial scene.

    Args:
        run: a name or a folder.
        out: a file that ends in .glb.

    Returns:
        Sentences about differences from the scene of the run.

    Raises:
        InputError: the file has another suffix; other errors as for
            `AdversarialRun.load`.
    """
    if out.suffix.lower() != GLB:
        raise InputError(f"out: expected the name of a .glb file, got {out}")
    adversarial = exports.AdversarialRun.load(run)
    # the object as the scene describes it, and its mesh in its adversarial pose and
    # texture
    described_object, posed_asset = adversarial.posed_object()
    description = adversarial.problem.space.scene
    metres = None if description is None else description.object.size_in_metres
    if metres is not None:
        # lengths of our scenes are in object sizes, those of glTF in metres
        posed_asset = _scale_mesh(posed_asset, metres)
    with writing.name_setting_in_errors("out"):
        writing.write_bytes(out, reading.encode_glb([posed_asset]))
    unit = "object sizes" if metres is None else "metres"
    notes = [f"Lengths are in {unit}, y is up, and the texture is rounded to 8 bits."]
    notes += _describe_lost_material(described_object, posed_asset)
    return notes


def _scale_mesh(asset: Any, factor: float) -> Any:
    """Return an asset whose mesh is larger by a factor."""
    vertices = asset.mesh.vertices * np.float32(factor)
    return replace(asset, mesh=replace(asset.mesh, vertices=vertices))


def _describe_lost_material(described_object: Any, asset: Any) -> list[str]:
    """Return sentences about what glTF does not have of an object's material.

    Args:
        described_object: the object as the scene describes it.
        asset: the object with its material.
    """
    if described_object.surface is not None:
        return [
            "The object has a BSDF of Mitsuba. Of it, the file has the base color only."
        ]
    if asset.material.specular > reading.DEFAULT_SPECULAR:
        return [
            f"The object has a specular of {asset.material.specular:g}. The "
            f"file has {reading.DEFAULT_SPECULAR:g}, the maximum of glTF."
        ]
    return []
