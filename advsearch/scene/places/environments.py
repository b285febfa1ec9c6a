"""Environments that are a place: ``--environment my-street/place.yaml``, or one of its
lights, ``place.yaml#night``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.grounds import LUMINANCE
from advsearch.scene.importing.files import make_safe_name
from advsearch.scene.library import (
    import_environment,
    list_environments,
    load_environment,
)
from advsearch.scene.photographed_ground import compute_open_sky_irradiance
from advsearch.scene.places.place_file import (
    read_place,
    read_place_file,
    resolve_sibling_path,
    split_light,
)
from advsearch.scene.places.schema import PlaceFile, PlaceLight
from advsearch.trust.stored_files import track_opened_files


def import_place(spec: str) -> EnvironmentAsset:
    """Read a place with its light, the first in its file or the one that is named.

    The map of a light is the name of a bundled environment, or else a file beside that
    of the place. If the light has lux, that is the illuminance of level ground under
    the open sky, and tells the luminance of a radiance of 1 (`candelas`).

    Args:
        spec: the place's file, and perhaps the name of a light: ``place.yaml#night``.

    Raises:
        FileFormatError: a file is missing, damaged, or outside of the folder.
        InputError: the light has lux, but its map is black.
        UnknownNameError: the place has no such light, mesh or variant, or there is no
            such bundled environment.
    """
    name, requested_light = split_light(spec)
    path = Path(name)
    with track_opened_files(path):
        file = read_place_file(path)
        light_name = _find_light_name(path, file, requested_light)
        light = file.lights[light_name]
        place = read_place(path, file, light.variant)
        environment = _load_light_map(path, light)
    return replace(
        environment,
        name=_make_asset_name(place.name, requested_light),
        source=spec,
        warnings=(*environment.warnings, *place.notes),
        # The ground is that of the place, not one that belongs to the map.
        photographed=False,
        ground=None,
        candelas=_compute_candelas(path, light_name, light, environment),
        place=place,
    )


def _make_asset_name(name: str, requested_light: str | None) -> str:
    """Return the name of a place, with that of the light if one is requested."""
    if requested_light is None:
        return name
    # `make_safe_name` leaves out the suffix of a file. The name of a light may have a
    # dot in it, so that a suffix is added.
    return make_safe_name(Path(f"{name}-{requested_light}.x"))


def _find_light_name(path: Path, file: PlaceFile, requested: str | None) -> str:
    """Return the name of the light that is requested, or of the first if it is None.

    Raises UnknownNameError: the file of a place, `path`, has no such light.
    """
    light_name = requested
    if light_name is None:
        light_name = next(iter(file.lights))
    if light_name not in file.lights:
        raise UnknownNameError(
            f"light of {path}:",
            light_name,
            file.lights,
            f"Write it as {path}#NAME.",
        )
    return light_name


def _load_light_map(path: Path, light: PlaceLight) -> EnvironmentAsset:
    """Return the map of a light: a bundled environment, or a file beside the place's."""
    if light.map in list_environments():
        return load_environment(light.map)
    return import_environment(resolve_sibling_path(path, light.map))


def _compute_candelas(
    path: Path, light_name: str, light: PlaceLight, environment: EnvironmentAsset
) -> float | None:
    """Return the luminance in cd/m2 of a radiance of 1; None for a light without lux.

    Raises InputError: the map, `environment`, is black.
    """
    if light.lux is None:
        return None
    illuminance = _compute_illuminance(environment)
    if illuminance <= 0.0:
        raise InputError(
            f"{path}: lights.{light_name}: expected a map with light for its lux, "
            f"got {light.map}, which is black where the sky is; leave lux out"
        )
    return light.lux / illuminance


def _compute_illuminance(environment: EnvironmentAsset) -> float:
    """Return the luminance of the light on level ground under the open sky.

    In the environment's own unit: its radiance has none.
    """
    radiance = torch.from_numpy(environment.radiance.copy())
    return float(compute_open_sky_irradiance(radiance) @ torch.tensor(LUMINANCE))
