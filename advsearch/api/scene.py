"""A scene as a person uses it from Python: load it, and ask it for `render(u, seed, spp)`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

from advsearch.controls import Control, Space, make_control, make_space
from advsearch.errors import InputError
from advsearch.scene import settings
from advsearch.scene.assets import EnvironmentAsset, ObjectAsset
from advsearch.scene.description import SceneDescription, describe
from advsearch.scene.formation import ImageFormation
from advsearch.scene.mitsuba_scene import MitsubaScene
from advsearch.scene.renderer import Renderer

Controls = str | Sequence[str | Control] | Mapping[str, Mapping[str, object]]
"""One control or several, by name or instance; a mapping gives each name its settings."""

DEFAULT_RESOLUTION = 128


@final
@dataclass(frozen=True, eq=False)
class Scene:
    """An object under an environment, with some parameters fixed. Made by `load_scene`.

    Attributes:
        description: the scene as data.
    """

    description: SceneDescription

    def renderer(
        self,
        controls: Controls,
        *,
        resolution: int | tuple[int, int] = DEFAULT_RESOLUTION,
        denoise: str = "oidn",
        seed: int = 0,
    ) -> Renderer:
        """Return `render(u, seed, spp)` for the space of these controls.

        Args:
            controls: what u varies.
            resolution: side, or (height, width), in pixels.
            denoise: "oidn" or "none".
            seed: root of the noise; the `seed` of each call counts on from it.

        Raises:
            InputError: a control is unknown or impossible in this scene, or an argument is out of range.
        """
        space = make_space(as_controls(controls), self.description)
        return make_renderer(self.description, space, resolution, denoise, seed)

    def with_settings(self, given: Mapping[str, float]) -> Scene:
        """Return the scene with some of its parameters fixed to other values.

        Raises:
            InputError: a name is unknown or a value out of range.
        """
        settings.resolve(given)
        return Scene(replace(self.description, values={**self.description.values, **given}))


def load_scene(
    object: str | Path | ObjectAsset,
    environment: str | Path | EnvironmentAsset | None = None,
    *,
    up: str | None = None,
    settings: Mapping[str, float] | None = None,
) -> Scene:
    """Load a scene.

    Args:
        object: a bundled name ("mug"), a path to an .obj, .ply or .glb file, or an asset.
        environment: a bundled name, a path to an .hdr or .exr file, an asset; default "studio".
        up: the up axis of a mesh file, "y" or "z"; by default the habit of its format.
        settings: parameters to fix, e.g. ``{"camera.azimuth": 130.0}``.

    Raises:
        InputError: a name is unknown, a file cannot be used, or a value is out of range.
    """
    return Scene(describe(object, environment, given=settings, up=up))


def make_renderer(
    description: SceneDescription, space: Space, resolution: int | tuple[int, int], denoise: str, seed: int
) -> Renderer:
    """Put a described scene into Mitsuba at one size and return its renderer."""
    size = (resolution, resolution) if isinstance(resolution, int) else resolution
    formation = ImageFormation(
        denoiser=denoise, exposure=description.number("camera.exposure"), resolution=size, gain=description.gain
    )
    return Renderer(MitsubaScene(description, size, filter=formation.filter), space, formation, seed)


def as_controls(controls: Controls) -> tuple[Control, ...]:
    """Return control instances for whatever form they were given in.

    Raises:
        UnknownNameError: a name is not a control.
        InputError: not controls at all.
    """
    if isinstance(controls, str):
        controls = [part.strip() for part in controls.split(",") if part.strip()]
    if isinstance(controls, Mapping):
        return tuple(make_control(kind, given) for kind, given in controls.items())
    if not all(isinstance(one, (str, Control)) for one in controls):
        raise InputError(f"controls: expected names or Control instances, got {controls!r}")
    return tuple(one if isinstance(one, Control) else make_control(one) for one in controls)
