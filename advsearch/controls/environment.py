"""The `environment` control: the map that lights the scene.

Its rotation, exposure and color can be searched. Mitsuba's own derivative of a rotation
has the wrong sign (docs/gradients.md), so the map is resampled by torch:

    map(rotation)[column c] = (1 - f) base[c + k] + f base[c + k + 1]
    rotation / 360 * columns = k + f

`compute_harmonic_light` adds real spherical harmonics of degrees 0 to 2 (Ramamoorthi
and Hanrahan 2001, section 3): 9 coefficients for each color channel, as multiples of
the map's mean radiance, in an L2 ball.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import torch
from torch import Tensor

from advsearch.controls.base import FULL_RANGE, Budget, Choice, Control, Values
from advsearch.controls.ranges import Fixed, ParameterValue, Range
from advsearch.controls.support.images import rotate_map
from advsearch.errors import InputError
from advsearch.scene import library, settings
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.description import (
    ENVIRONMENT,
    SCENE_ENVIRONMENT,
    SceneDescription,
    is_path,
)
from advsearch.scene.formation import compute_metered_gain
from advsearch.scene.geometry import compute_real_harmonics
from advsearch.scene.library import import_environment
from advsearch.scene.scene_data import cache_per_scene
from advsearch.scene.settings import CHANNELS, Parameter

N_COEFFICIENTS = 27  # degrees 0 to 2 of three color channels
BUNDLED_MAPS = tuple(
    sorted({*library.list_environments()} - {*library.list_environments("place")})
)
"""Bundled environments that are a map only; the others have meshes around the object."""
_lit = partial(Parameter.number, Parameter.LIT)


class EnvironmentControl(Control):
    """The environment that lights the scene, its rotation, exposure and colour."""

    kind = "environment"
    photograph_refusal = (
        "the photograph was taken in one light, and shows its own surroundings"
    )
    parameters = (
        Parameter.named(
            "which",
            (SCENE_ENVIRONMENT, *BUNDLED_MAPS),
            SCENE_ENVIRONMENT,
            "Another environment instead of the scene's own, metered "
            "anew: a bundled one, or a .hdr or .exr file.",
        ),
        *settings.ENVIRONMENT,
        *(
            _lit(f"tint_{color}", "1", 0.0, 10.0, 1.0, f"Factor on the map's {color}.")
            for color in CHANNELS
        ),
        Parameter(
            "harmonics",
            (N_COEFFICIENTS,),
            "mean radiances",
            -1.0,
            1.0,
            0.0,
            "Low-frequency light that is added: coefficients of spherical harmonics, 9 "
            "for each channel, in the ball of epsilon.",
            estimators=Parameter.LIT,
        ),
    )
    choices = (
        Choice(
            "epsilon",
            0.5,
            "Radius of the ball of `harmonics`: largest L2 norm of all coefficients.",
            "epsilon",
            "harmonics",
            max_value=100.0,
        ),
    )

    @classmethod
    def declare_parameters(cls, settings: Iterable[str]) -> tuple[Parameter, ...]:
        """Return the parameters, with files of the setting `which` among its options.

        Args:
            settings: settings by name, whose values are read by `list_allowed_names`; or
                only names, which add no options.
        """
        which, *others = cls.parameters
        files = [
            name
            for name in cls.list_allowed_names(settings, "which")
            if name not in which.options and is_path(name)
        ]
        options = tuple(dict.fromkeys((*which.options, *files)))
        return (replace(which, options=options), *others)

    def check_choices(self) -> None:
        """Raise InputError if `epsilon` is set without the harmonics that it limits."""
        epsilon = self.choice_values["epsilon"]
        if "epsilon" in self._settings and "harmonics" not in self._settings:
            raise InputError(
                f"{self.name}.epsilon: limits the harmonics, which are not set; leave "
                "it out, or set "
                f"a range of harmonics too, as in {self.name}={{harmonics: [-1, 1], "
                f"epsilon: {epsilon}}}"
            )

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene with the first allowed environment, or with its own.

        The scene keeps its own environment if that is allowed, or if several bundled
        ones are listed; then it must have one. If a single other environment is allowed,
        or any file, it gets the first that is allowed. Notes on environment files become
        remarks.

        Raises:
            InputError: the scene has no environment and needs one.
        """
        allowed = self.list_allowed_values("which", SCENE_ENVIRONMENT)
        files = [str(name) for name in allowed if _is_file(name)]
        notes = _list_environment_notes(files)
        keeps_environment = self._keeps_environment(scene, allowed)
        is_fixed = isinstance(self.specs.get("which"), Fixed)
        if not keeps_environment and (is_fixed or files):
            name = str(allowed[0])
            scene = replace(
                scene, environment=_load_environment(name), environment_spec=name
            )
        else:
            notes += self._list_table_notes(scene, files)
        return replace(scene, remarks=(*scene.remarks, *notes)) if notes else scene

    def _list_table_notes(
        self, scene: SceneDescription, files: Sequence[str]
    ) -> list[str]:
        """List the note that the object stands on the scene's table in all environments.

        Args:
            scene: scene that keeps its environment.
            files: environment files to choose from; without any, there is no note.

        Raises:
            InputError: the scene has no environment.
        """
        environment = scene.require_environment(f"`controls` {self.name}")
        shows_photograph = scene.photograph is not None or environment.photographed
        # A photograph shows its own floor instead of the table.
        if not files or shows_photograph:
            return []
        return _describe_table(scene, list(dict.fromkeys(files)))

    def _keeps_environment(
        self, scene: SceneDescription, allowed: Sequence[ParameterValue]
    ) -> bool:
        """Return whether a scene's own environment is among the allowed names."""
        return (
            SCENE_ENVIRONMENT in allowed
            or self._find_scene_environment_name(scene) is not None
        )

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter; the default of `which` is the scene's own environment.

        It is the option `SCENE_ENVIRONMENT`, which keeps the scene's environment. If the
        user lists environments without that option, the default is the name of the
        scene's environment, if that is listed.
        """
        if parameter.name != "which":
            return super().resolve_parameter(parameter)
        default = SCENE_ENVIRONMENT
        if not self._allows_scene_environment:
            # If that is not listed either, the slot starts at a value that is.
            scene_name = self._find_scene_environment_name(self.scene)
            default = scene_name or SCENE_ENVIRONMENT
        return replace(parameter, default=default)

    @property
    def _allows_scene_environment(self) -> bool:
        """Whether `SCENE_ENVIRONMENT` is among the allowed values of `which`."""
        return SCENE_ENVIRONMENT in self.list_allowed_values("which", SCENE_ENVIRONMENT)

    def get_setting_name(self, parameter: Parameter) -> str:
        if parameter.name == "which":
            return ENVIRONMENT
        return super().get_setting_name(parameter)

    def get_value_without_control(self, parameter: Parameter) -> ParameterValue:
        """Return the value of a parameter in the scene as it was described.

        For `which` it is `SCENE_ENVIRONMENT` if that is allowed. Otherwise it is the
        allowed name of the scene's environment; if none is allowed, its name in the
        scene.
        """
        # If `SCENE_ENVIRONMENT` is allowed, it is the default, see `resolve_parameter`.
        if parameter.name != "which" or self._allows_scene_environment:
            return parameter.default
        name = self._find_scene_environment_name(self.scene)
        return name or self.scene.environment_spec

    def _find_scene_environment_name(self, scene: SceneDescription) -> str | None:
        """Return the scene's own environment among the allowed names and files.

        None if it is not among them. `SCENE_ENVIRONMENT` does not count as a name.
        """
        return next(
            (
                str(name)
                for name in self.list_allowed_values("which", SCENE_ENVIRONMENT)
                if _is_scene_environment(name, scene)
            ),
            None,
        )

    def get_budget(self, parameter: Parameter) -> Budget:
        if parameter.name != "harmonics":
            return FULL_RANGE
        spec = self.specs["harmonics"]
        width = spec.high - spec.low if isinstance(spec, Range) else 2.0
        return Budget("l2", float(self.choice_values["epsilon"]) / width)

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the map "environment.data", (H, W, 3) linear radiance.

        The scene's own rotation and exposure are applied when it is rendered, so that
        only the differences from these are applied here.
        """
        base = self._load_chosen_map(values).to(values["rotation"].device)
        scene_rotation = self.scene.get_number("environment.rotation")
        rotated = rotate_map(base, values["rotation"] - scene_rotation)
        tint = torch.stack([values[f"tint_{color}"] for color in CHANNELS])
        # an exposure is in stops, each of which doubles the light
        stops = values["exposure"] - self.scene.get_number("environment.exposure")
        lit = rotated * tint * torch.exp2(stops)
        if "harmonics" in self.specs:
            # relative to the mean radiance of the map as it is in the file
            added_light = compute_harmonic_light(values["harmonics"], base)
            lit = (lit + added_light).clamp_min(0.0)
        return {"environment.data": lit}

    def _load_chosen_map(self, values: Values) -> Tensor:
        """Return the map (H, W, 3) of the environment that `which` selects."""
        which, *_ = self.instance_parameters
        name = which.options[int(values["which"])]
        is_scene_map = name == SCENE_ENVIRONMENT or _is_scene_environment(
            name, self.scene
        )
        other_asset = None if is_scene_map else _load_environment(name)
        return _load_map(self.scene, other_asset)


def _list_environment_notes(files: Iterable[str]) -> list[str]:
    """List the notes on environment files; a file that comes twice has them once."""
    assets_by_file = {name: _load_environment(name) for name in files}
    return [note for asset in assets_by_file.values() for note in asset.warnings]


def _describe_table(scene: SceneDescription, files: Sequence[str]) -> list[str]:
    """Return a note that the object stands on the scene's table in all environments.

    Args:
        scene: scene; without a table, there is no note.
        files: paths of the environments from files.
    """
    has_table = scene.get_number("ground.size") > 0.0
    if not has_table:
        return []
    names = ", ".join(Path(file).name for file in files)
    return [
        f"{names}: the object stands on the scene's table in these environments, "
        "too; ground.kind=photograph shows the floor of each picture instead"
    ]


def _is_file(name: ParameterValue) -> bool:
    """Return whether an environment is a file, and not a bundled one."""
    return (
        isinstance(name, str) and name not in EnvironmentControl.parameters[0].options
    )


def _is_scene_environment(name: ParameterValue, scene: SceneDescription) -> bool:
    """Return whether an environment is the scene's own.

    Args:
        name: name of a bundled environment, or path of a file.
        scene: scene, whose environment has a `source`: the path of its file,
            `BUNDLED_ENVIRONMENT`, or empty if it was made otherwise.
    """
    environment = scene.environment
    if environment is None:
        return False
    if not _is_file(name):
        is_bundled = environment.source == library.BUNDLED_ENVIRONMENT
        return is_bundled and environment.name == name
    if not environment.source:
        return False
    return os.path.realpath(str(name)) == os.path.realpath(environment.source)


def _load_environment(name: str) -> EnvironmentAsset:
    """Return an environment by its name or from a file.

    Files are cached by their path, modification time and size, so that a changed file
    is read again.
    """
    if not _is_file(name):
        return library.load_environment(name)
    try:
        status = os.stat(name)
    except OSError:
        return import_environment(name)  # which raises the error
    return _read_environment(
        os.path.realpath(name), name, status.st_mtime_ns, status.st_size
    )


@lru_cache(maxsize=64)
def _read_environment(real_path: str, name: str, *version: int) -> EnvironmentAsset:
    """Return the environment in a file; cached by its path, time and size."""
    return import_environment(name)


@cache_per_scene
def _load_map(scene: SceneDescription, asset: EnvironmentAsset | None) -> Tensor:
    """Return the map (H, W, 3) of an environment, linear radiance.

    A scene can be metered: its exposure is set by the brightness of its environment. That
    exposure stays as it is. So another map is multiplied by the exposure that it would
    have been metered to, over that of the scene: the image is then as bright as if the
    other map had been metered.

    Args:
        scene: the scene.
        asset: the environment; None for the scene's own.
    """
    scene_environment = scene.require_environment("the environment")
    if asset is None:
        return torch.from_numpy(scene_environment.radiance.copy())
    # `photographed`, which decides the kind of ground, stays as in the scene: another map
    # changes no ground.
    other_scene = replace(
        scene, environment=replace(asset, photographed=scene_environment.photographed)
    )
    factor = 1.0
    if scene.metered:
        factor = compute_metered_gain(other_scene) / compute_metered_gain(scene)
    return torch.from_numpy(asset.radiance.copy()) * factor


def compute_harmonic_light(coefficients: Tensor, reference: Tensor) -> Tensor:
    """Return light (H, W, 3) as a sum of 9 spherical harmonics in each channel.

    Args:
        coefficients: (27,) in units of the map's mean; three channels for each
            harmonic.
        reference: (H, W, 3) the map.
    """
    height, width = reference.shape[:2]
    basis = compute_real_harmonics(height, width).to(coefficients.device)
    mean = reference.detach().mean(dim=(0, 1))
    return basis @ coefficients.reshape(9, 3) * mean
