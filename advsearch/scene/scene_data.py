"""A scene as data: meshes, of which one is the object, lamps, an environment and the
settings; nothing of Mitsuba.

Conventions: z up, right-handed, lengths in object sizes (the object's largest extent is
1 before `pose.scale`), angles in degrees. Lengths of the camera and of a photograph's
floor and paths of files are in metres where the object has a size in metres. The camera
at azimuth 0 and elevation 0 looks from +x towards the object.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import Any, Concatenate, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from advsearch.scene import settings
from advsearch.scene.assets import (
    TRIPOD_HEIGHT,
    EnvironmentAsset,
    Float64Array,
    Material,
    ObjectAsset,
)
from advsearch.scene.backdrop_photograph import BackdropPhotograph
from advsearch.scene.camera_entries import PRESETS
from advsearch.scene.camera_model import CameraModel
from advsearch.scene.parts import (
    LampGlass,
    MeshPart,
    PosedCamera,
    ScenePart,
    make_mesh_part,
)
from advsearch.scene.photographed_ground import (
    PhotographedGround,
    get_photographed_ground,
)
from advsearch.scene.poses import apply_settings, compute_base_vertices, compute_pose
from advsearch.scene.rig import RigCamera
from advsearch.scene.settings import ORBIT_CAMERA, POSE

OBJECT = "object"  # the name of the mesh under test
NO_ENVIRONMENT = "none"  # what the environment of a scene without a map is called


@dataclass(frozen=True, eq=False)
class SceneData:
    """Everything that fixes a scene except what a control varies.

    What has to be worked out of it, by the modules that take it, is in
    `advsearch.scene.description.SceneDescription`.
    """

    object: ObjectAsset  # the thing to recognise
    # the map that lights it; None where only lamps do
    environment: EnvironmentAsset | None
    # every setting of `advsearch.scene.settings` by name; None where the scene works
    # the value out. Those of meshes around the object, `pose:chair.yaw`, only where
    # they were given
    values: Mapping[str, float | None] = field(default_factory=dict)
    # how the object was asked for: a bundled name, a path, or an asset's own name
    object_spec: str = ""
    environment_spec: str = ""  # how the environment was asked for, likewise
    up: str | None = None  # the up axis that was given for a mesh file
    facing: str | None = None  # the axis of a mesh file that was given for its front
    size: float | None = None  # the object's longest side in metres that was given
    # Unit of the object's file, that was given
    # (`advsearch.scene.assets.METRES_PER_UNIT`).
    unit: str | None = None
    # what was asked for: names of settings, and "environment"
    requested: frozenset[str] = frozenset()
    # beside object, environment and ground: further meshes, lamps, haze
    parts: tuple[ScenePart, ...] = ()
    thin_lens: bool = False  # the camera has an aperture and a focus distance
    # the environment may be hidden behind a plain colour or a photograph
    # (`backdrop.color`)
    backdrop: bool = False
    # Backdrop photograph that it is rendered into; None for none.
    backdrop_photograph: BackdropPhotograph | None = None
    aspect: float = 1.0  # width over height of the picture
    # those with poses of their own, by name
    cameras: Mapping[str, PosedCamera] = field(default_factory=dict)
    # name of the one in use; `ORBIT_CAMERA` for that of the settings
    camera: str = ORBIT_CAMERA
    # name of the mounted camera that it is (`advsearch.scene.camera_entries`); "" for
    # none
    preset: str = ""
    # Camera model of the camera around the object; None for a pinhole.
    camera_model: CameraModel | None = None
    # cameras that take pictures at the same time, this one first; empty where it is
    # alone
    rig: tuple[RigCamera, ...] = ()
    rig_spec: str = ""  # how they were asked for
    # exposure is; otherwise a radiance of 1 is the white of the picture, as Mitsuba
    # shows it
    metered: bool = True
    # remarks for users: on further files that controls have read, on things that
    # overlap
    remarks: tuple[str, ...] = ()
    things_spec: str = ""  # the setting that names the things next to the object

    @property
    def azimuth_zero(self) -> float:
        """Direction from the object to the camera of azimuth 0, degrees from +x."""
        return 180.0 if self.is_in_lane and self.object.drives else 0.0

    @property
    def is_in_lane(self) -> bool:
        """Whether the camera is mounted in a car that drives in the object's lane."""
        return self.preset != "" and PRESETS[self.preset].in_lane

    @cached_property
    def meshes(self) -> Mapping[str, MeshPart]:
        """All meshes by name, with poses and materials of the settings.

        The object under test is named `OBJECT`. The glass of a car's lamps has the pose
        of the car.
        """
        around = {
            name: apply_settings(part, self.values)
            for name, part in self.surrounding_meshes.items()
        }
        object_part = make_mesh_part(
            OBJECT, self.object, compute_object_to_world(self), self.material
        )
        return _move_glasses({OBJECT: object_part, **around})

    @cached_property
    def surrounding_meshes(self) -> Mapping[str, MeshPart]:
        """The meshes around the object by name, as they came."""
        return {part.name: part for part in self.parts if isinstance(part, MeshPart)}

    @property
    def size_in_metres(self) -> float:
        """Metres of one object size, or 1 where they are not known."""
        return self.object.size_in_metres or 1.0

    @property
    def object_name(self) -> str:
        """How the object was asked for, or else its own name."""
        return self.object_spec or self.object.name

    @property
    def environment_name(self) -> str:
        """How the environment was requested, or else its own name.

        `NO_ENVIRONMENT` if it was not requested and there is none.
        """
        if self.environment_spec:
            return self.environment_spec
        if self.environment is None:
            return NO_ENVIRONMENT
        return self.environment.name

    @property
    def base_vertices(self) -> Float64Array:
        """(V, 3) the object's vertices in world space, in its base pose."""
        return compute_base_vertices(self.meshes[OBJECT])

    def get_number(self, name: str) -> float:
        """Return the value of a setting that is a number in every scene.

        The field of view is that of the camera in use.

        Raises:
            KeyError: the setting has no value, or there is no such setting.
        """
        if name == "camera.fov" and self.camera != ORBIT_CAMERA:
            return self.cameras[self.camera].compute_larger_fov(self.aspect)
        value = self.values[name]
        if value is None:
            raise KeyError(name)
        return value

    @property
    def photograph(self) -> PhotographedGround | None:
        """The ground that shows the environment's photograph; None for another ground."""
        environment = self.environment
        if environment is None or self.get_number("ground.size") == 0.0:
            return None
        if not self._shows_photograph(environment):
            return None
        rotation = self.get_number("environment.rotation")
        return get_photographed_ground(environment, self.capture_height, rotation)

    def _shows_photograph(self, environment: EnvironmentAsset) -> bool:
        """Return whether the ground shows the photograph of the environment.

        The setting `ground.kind` decides if it is set. Otherwise a photographed
        environment has such a ground, with two exceptions: settings describe a table,
        or a plain color hides the environment. The ground would still show the
        photograph then.
        """
        kind = self.values.get("ground.kind")
        if kind is not None:
            return settings.GROUND_KINDS[int(kind)] == settings.PHOTOGRAPH
        return (
            environment.photographed
            and not self.backdrop
            and self.requested.isdisjoint(settings.TABLE_SETTINGS)
        )

    @property
    def capture_height(self) -> float:
        """Height above the floor of the photograph's camera, object sizes."""
        height = self.values.get("ground.height")
        if height is None and self.object.size_in_metres is None:
            return settings.DEFAULT_PHOTOGRAPH_HEIGHT
        return (TRIPOD_HEIGHT if height is None else height) / self.size_in_metres

    @property
    def ground_color(self) -> tuple[float, ...]:
        """(3,) colour of the ground plane, display-referred sRGB."""
        return tuple(
            self.get_number(f"ground.{channel}") for channel in settings.CHANNELS
        )

    @property
    def material(self) -> Material:
        """The object's material with the `material.*` settings over it."""
        return self.object.material.with_values(self.values, "material.")


def _move_glasses(meshes: dict[str, MeshPart]) -> Mapping[str, MeshPart]:
    """Return meshes in which the glass of lamps has the pose of the car.

    Args:
        meshes: meshes by name, the cars among them.
    """
    glasses = {
        name: mesh for name, mesh in meshes.items() if isinstance(mesh, LampGlass)
    }
    return meshes | {
        name: replace(glass, to_world=meshes[glass.carrier].to_world)
        for name, glass in glasses.items()
    }


AnyScene = TypeVar("AnyScene", bound=SceneData)
P = ParamSpec("P")
R = TypeVar("R")

MAX_CACHED_RESULTS = 64  # of one function and one scene


def cache_per_scene(
    compute: Callable[Concatenate[AnyScene, P], R],
) -> Callable[Concatenate[AnyScene, P], R]:
    """Cache what a function returns for a scene and hashable arguments.

    The cache does not keep a scene alive, since it has large meshes and maps: when the
    scene is deleted, so are its results. A result must not refer to its scene, as
    otherwise neither would ever be deleted. The oldest of more than
    `MAX_CACHED_RESULTS` results of one scene is dropped.
    """
    results_by_scene: WeakKeyDictionary[Any, dict[Any, R]] = WeakKeyDictionary()

    @wraps(compute)
    def compute_cached(scene: AnyScene, /, *args: P.args, **kwargs: P.kwargs) -> R:
        results = results_by_scene.setdefault(scene, {})
        key = (args, tuple(kwargs.items()))
        if key not in results:
            if len(results) >= MAX_CACHED_RESULTS:
                del results[next(iter(results))]
            results[key] = compute(scene, *args, **kwargs)
        return results[key]

    return compute_cached


def compute_object_to_world(description: SceneData) -> Float64Array:
    """Return the object's pose (4, 4).

    Scale and rotate about the middle of its bounding box, keep it on the ground, shift.
    "On the ground" means that the lowest vertex is at z = 0 before `pose.z` is added,
    whatever the rotation.
    """
    vertices = description.object.mesh.vertices.astype(np.float64)
    parameters = {
        parameter.name: description.get_number(f"pose.{parameter.name}")
        for parameter in POSE
    }
    return compute_pose(vertices, floor=0.0, parameters=parameters)
