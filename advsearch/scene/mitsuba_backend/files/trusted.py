"""What of a scene file may reach Mitsuba: its own plugins by name, and files that are read here first.

Mitsuba finds a plugin as a library, the current folder included, and reads most files without the checks that a file
from anywhere needs.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.files import note_opened
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.environments import SUFFIXES as RADIANCE
from advsearch.scene.environments import import_environment, read_light
from advsearch.scene.importing.files import References, shown
from advsearch.scene.importing.images import TEXTURE_LIMIT, banded_average, read_picture
from advsearch.scene.importing.objects import read_parts
from advsearch.scene.mitsuba_backend.variant import Plugin

STOCK = frozenset(
    """
    aov area batch bitmap blackbody blendbsdf blendphase box bsplinecurve bumpmap catmullrom checkerboard circular
    conductor constant constvolume cube cylinder d65 depth dielectric diffuse direct directional directionalarea disk
    distant ellipsoids ellipsoidsmesh envmap gaussian gridvolume hair hdrfilm heterogeneous hg homogeneous independent
    instance irradiancemeter irregular isotropic lanczos ldsampler linearcurve mask mesh_attribute mitchell moment
    multijitter normalmap null obj orthogonal orthographic path perspective plastic ply point polarizer pplastic prb
    prb_basic prb_projective prbvolpath principled principledthin projector ptracer radiancemeter rawconstant rayleigh
    rectangle ref regular retarder rgb roughconductor roughdielectric roughplastic scene sdfgrid serialized sggx
    shapegroup specfilm spectrum sphere spot srgb stokes stratified sunsky tabphase tent thindielectric thinlens
    timed_sunsky twosided uniform volpath volpathmis volume
    """.split()
)
"""The plugins that come with Mitsuba 3.9, but for `measured` and `merge`."""


def trusted(path: Path, scene: Mapping[str, object], notes: list[str]) -> Plugin:
    """Return a file's dictionary with pictures read, and with the full names of meshes that were read once.

    Args:
        path: of the file.
        scene: its dictionary.
        notes: warnings about pictures are put here.

    Raises:
        FileFormatError: a plugin that Mitsuba does not bring, or a file that is missing, outside the folder of `path`,
            damaged, or of a kind that only Mitsuba reads.
    """
    references = References(path)

    def file_of(kind: str, name: object) -> Path:
        try:
            references.get(str(name))
        except FileNotFoundError:
            reason = references.refused.get(next(reversed(references.refused)), "is missing")
            raise FileFormatError(f"{path}: {kind} needs {shown(str(name))}, which {reason}") from None
        for candidate in (str(name), os.path.basename(str(name))):
            found = Path(os.path.realpath(os.path.join(path.parent, candidate)))
            if found.is_file() and found.is_relative_to(os.path.realpath(path.parent)):
                note_opened(found)
                return found
        raise FileFormatError(f"{path}: {kind} needs {shown(str(name))}; write its name as it is in the folder")

    def mesh(plugin: Plugin) -> Plugin:
        found = file_of("a shape", plugin["filename"])
        if found.suffix.lower() != f".{plugin['type']}":
            raise FileFormatError(f"{path}: expected a .{plugin['type']} file, got {shown(found.name)}; rename it")
        read_parts(found, found.read_bytes())
        return {**plugin, "filename": str(found)}

    def bitmap(plugin: Plugin) -> Plugin:
        found = file_of("a texture", plugin.pop("filename"))
        if found.suffix.lower() in RADIANCE:
            return {**plugin, "bitmap": _texture(found, notes), "raw": True}
        raw = bool(plugin.get("raw"))
        picture = read_picture(found, raw=raw)
        return {**plugin, "bitmap": picture if raw else srgb_to_linear(picture), "raw": True}

    def envmap(plugin: Plugin) -> Plugin:
        found = file_of("a light", plugin.pop("filename"))
        if found.suffix.lower() in RADIANCE:
            environment = import_environment(found)
            notes.extend(environment.warnings)
            return {**plugin, "bitmap": environment.radiance}
        return {**plugin, "bitmap": np.asarray(srgb_to_linear(read_picture(found)), np.float32)}

    readers: dict[str, Callable[[Plugin], Plugin]] = {"obj": mesh, "ply": mesh, "bitmap": bitmap, "envmap": envmap}

    def checked(plugin: Mapping[str, object]) -> Plugin:
        kind = str(plugin["type"])
        if kind not in STOCK:
            raise FileFormatError(
                f"{path}: {shown(kind)} is no plugin that comes with Mitsuba; leave it out of the file"
            )
        if not re.fullmatch(r"\w*", str(plugin.get("material", ""))):
            raise FileFormatError(f"{path}: {shown(str(plugin['material']))} is no name of a material")
        found = {key: checked(value) if isinstance(value, Mapping) else value for key, value in plugin.items()}
        if kind in readers and "filename" not in found:  # without one Mitsuba's bitmap ends the process
            raise FileFormatError(f"{path}: expected a filename in each {kind}, got none; name the file")
        if "filename" in found:
            if kind not in readers:
                named = shown(str(found["filename"]))
                raise FileFormatError(
                    f"{path}: {kind} names the file {named}, which only Mitsuba reads, without checks; convert it to "
                    "a .ply mesh or a picture, or give the scene as a dictionary from Python"
                )
            found = readers[kind](found)
        return found

    return checked(scene)


def _texture(file: Path, notes: list[str]) -> npt.NDArray[np.float32]:
    """The linear values (H, W, 3) of an .hdr or .exr picture, averaged down as other textures are."""
    picture = read_light(file, "texture")
    notes.extend(f"{file.name}: {note}" for note in picture.notes)
    height, width = picture.size
    scale = min(1.0, TEXTURE_LIMIT / max(height, width))
    if scale == 1.0:
        return picture.band(0, height)
    return banded_average(picture.band, picture.size, (max(1, round(height * scale)), max(1, round(width * scale))))
