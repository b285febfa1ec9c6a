"""A scene as its users have it: `SceneData` with its light, exposure and cameras.

It also has what there is to say of the scene. `load_description` reads one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy.typing as npt
import torch

from advsearch.errors import InputError, UnknownNameError
from advsearch.scene import geometry, library, settings
from advsearch.scene.assets import (
    EnvironmentAsset,
    Float64Array,
    ObjectAsset,
    describe_size_doubts,
    with_size,
)
from advsearch.scene.backdrop import (
    PLANE_SETTINGS,
    PLANE_SIZE,
    compute_photograph_gain,
    compute_view_settings,
    make_matrix_camera,
    read_backdrop,
    with_front,
)
from advsearch.scene.backdrop_photograph import BackdropPhotograph
from advsearch.scene.camera_entries import (
    MAX_TABLETOP_SIZE,
    PRESETS,
    TABLE_HEIGHT,
    TABLE_SIDE,
    CameraPreset,
)
from advsearch.scene.camera_files import read_camera
from advsearch.scene.camera_model import CameraModel, make_bundled_models
from advsearch.scene.formation import (
    CARD_DISPLAY_VALUE,
    CARD_REFLECTANCE,
    compute_environment_light,
    compute_metered_gain,
)
from advsearch.scene.grounds import (
    find_place,
    has_lanes,
    is_against_traffic,
    is_paved,
    make_traffic_remark,
    with_requested_ground,
)
from advsearch.scene.headlamps import add_lamps
from advsearch.scene.importing.objects import import_object
from advsearch.scene.importing.scenes import (
    MITSUBA_SUFFIX,
    ImportedScene,
    import_scene,
    split_node_argument,
)
from advsearch.scene.parts import (
    Lamp,
    PluginPart,
    PosedCamera,
    ScenePart,
    iterate_plugins,
)
from advsearch.scene.places.environments import import_place
from advsearch.scene.places.place_file import is_place_file
from advsearch.scene.rig import AXES, PhotographCameras, RigCamera, read_rig
from advsearch.scene.scene_data import NO_ENVIRONMENT as NO_ENVIRONMENT
from advsearch.scene.scene_data import OBJECT as OBJECT
from advsearch.scene.scene_data import SceneData
from advsearch.scene.settings import ORBIT_CAMERA
from advsearch.scene.things import (
    ThingPart,
    add_solid_remarks,
    add_things,
    find_ground_height,
)
from advsearch.trust.stored_files import track_opened_files

DEFAULT_ENVIRONMENT = "studio"
# what stands for the environment among the settings that were asked for
ENVIRONMENT = "environment"
ENVIRONMENTS = ("constant", "envmap", "sunsky", "timed_sunsky")
"""Mitsuba's lights from everywhere, of which a scene can have one."""
# what the scene's own environment is called where another may be chosen
SCENE_ENVIRONMENT = "own"


@dataclass(frozen=True, eq=False)
class PhotographFolder:
    """A folder of photographs, and the scene as it is rendered into each of them.

    Attributes:
        path: path of the folder, as it was stated.
        camera: camera that the user stated for all of them; None if each has its own.
        scenes: scenes by the name of the photograph's file, in alphabetical order.
    """

    path: str
    camera: str | None
    scenes: Mapping[str, SceneDescription]


@dataclass(frozen=True, eq=False)
class SceneDescription(SceneData):
    """Everything that fixes a scene except what a control varies."""

    # The folder of photographs among which the control `backdrop` chooses. The scene
    # itself is in the first of them.
    photographs: PhotographFolder | None = None

    def with_part(self, part: ScenePart) -> SceneDescription:
        """Return the scene with one more part, such as a lamp that a control adds.

        Raises InputError: the scene has a part of that name.
        """
        self._check_name_is_free(part.name)
        return replace(self, parts=(*self.parts, part))

    def _check_name_is_free(self, name: str) -> None:
        """Raise InputError if the scene has a part of a name, or reserves it."""
        part_by_name = {part.name: part for part in self.parts}
        if name in (OBJECT, "environment", "ground", "camera", *part_by_name):
            alternative = ""
            if isinstance(part_by_name.get(name), PluginPart):
                alternative = f", or vary what is there: mitsuba:{name}.KEY=[low, high]"
            raise InputError(
                f"`controls` {name}: the scene has something of that name "
                f"already; choose another name, as in light:{name}-2{alternative}"
            )

    def with_values(self, **replaced: float | None) -> SceneDescription:
        """Return the scene with some settings replaced.

        Dots in their names are written as two underscores.
        """
        return replace(
            self,
            values={
                **self.values,
                **{name.replace("__", "."): v for name, v in replaced.items()},
            },
        )

    def without_ground(self) -> SceneDescription:
        """Return the scene without a table, a road or a place."""
        return with_requested_ground(self.with_values(ground__size=0.0))

    def with_backdrop(
        self,
        photograph: str | Path | BackdropPhotograph,
        occluder: str | Path | None = None,
    ) -> SceneDescription:
        """Return the scene as it is rendered into a photograph.

        The camera of the scene is the one that took the photograph. The photograph is
        seen in place of the environment, which still lights the object, and the ground
        is a plane of which only the shadow on it is seen.

        Args:
            photograph: a picture file; with the part to use behind its name,
                ``photo.jpg#X,Y,WIDTH,HEIGHT`` in pixels from the top left corner.
            occluder: a mask of the photograph's size, white where something is in front
                of the object; or a picture of the photograph's depth
                (`advsearch.scene.depth_pictures`).

        Raises:
            FileFormatError: the file can not be used.
            InputError: the part leaves the photograph; a ground was requested, there
                are several cameras, or drops on the lens.
        """
        if not isinstance(photograph, BackdropPhotograph):
            photograph = read_backdrop(photograph)
        if occluder is not None:
            photograph = with_front(photograph, occluder)
        self._check_backdrop(photograph)
        values = dict(self.values)
        if "ground.size" not in self.requested:
            values["ground.size"] = PLANE_SIZE
        # `backdrop` says that something is behind the object instead of the
        # environment.
        scene = replace(
            self, backdrop=True, backdrop_photograph=photograph, values=values
        )
        # A scene in a photograph has no road or place: those of `self` are removed.
        return with_requested_ground(scene)

    def _check_backdrop(self, photograph: BackdropPhotograph) -> None:
        """Check that no setting contradicts a photograph as backdrop.

        Raises InputError: the user requests a ground other than the plane, several
        cameras (a rig), or drops on the lens.
        """
        self._check_plane_settings(photograph)
        if self.rig:
            raise InputError(
                f"`backdrop={photograph.spec}` and `camera={self.rig_spec}` contradict "
                "each other: a photograph was taken by one camera; name one of them, "
                f"{self.rig_spec}#NAME"
            )
        if self.get_number("camera.drops") > 0.0:
            raise InputError(
                f"`backdrop={photograph.spec}` and `set` camera.drops contradict each "
                "other: drops would show the photograph; leave one of the two out"
            )

    def _check_plane_settings(self, photograph: BackdropPhotograph) -> None:
        """Raise InputError if the user requests another ground than a photograph's."""
        other_grounds = sorted(
            name
            for name in self.requested - PLANE_SETTINGS
            if name.startswith("ground.")
        )
        if other_grounds:
            raise InputError(
                f"`backdrop={photograph.spec}` and `set` {other_grounds[0]} contradict "
                "each other: the ground of a photograph is a plane that takes the "
                f"shadow, with {', '.join(sorted(PLANE_SETTINGS))}; leave one of the "
                "two out"
            )

    def with_measured_view(
        self,
        camera_matrix: npt.ArrayLike,
        object_to_camera: npt.ArrayLike,
        up: npt.ArrayLike | None = None,
    ) -> SceneDescription:
        """Return the scene with a measured camera and pose of the object.

        They are those of the photograph that the scene is rendered into. If the
        photograph already shows the object, and so its shadow, set ``ground.size`` to
        0. Then no second shadow is rendered.

        Args:
            camera_matrix: intrinsics (3, 3) of the full photograph, in pixels, as
                OpenCV has them.
            object_to_camera: rigid (4, 4) from coordinates of the object's file to
                those of the camera: x right, y down, z ahead, in the file's unit.
            up: (3,) direction in the camera's coordinates that is up in the world;
                None: the object stands upright.

        Raises:
            InputError: the scene has no photograph; the object's file or size is not
                known; or the pose is not rigid or puts the object behind the camera.
        """
        if self.backdrop_photograph is None:
            raise InputError(
                "camera_matrix: is that of a photograph, and there is none; give a "
                "`backdrop`"
            )
        model = make_matrix_camera(camera_matrix, self.backdrop_photograph.full_size)
        measured = compute_view_settings(self.object, object_to_camera, up)
        return replace(
            self,
            camera=ORBIT_CAMERA,
            camera_model=model,
            values={**self.values, **measured},
            requested=self.requested | set(measured),
        )

    def with_photograph_camera(
        self, photograph_cameras: PhotographCameras, photograph: Path
    ) -> SceneDescription:
        """Return the scene as the camera of one of many photographs sees it.

        The world of the camera file (z up, in metres) becomes that of the scene, with
        the object at its origin until its pose is set.

        Args:
            photograph_cameras: cameras of many photographs.
            photograph: the file of the photograph.

        Raises:
            FileFormatError: they do not name the photograph, or its camera cannot be
                used.
            InputError: the size of the object is not known; or a setting of the camera
                around the object was requested.
        """
        spec = photograph_cameras.path
        size_in_meters = self._require_size(spec)
        with track_opened_files(photograph):
            pose, model = photograph_cameras.find_pose_and_model(photograph)
        # The file's pose is for other camera axes. `AXES` maps ours (left, up, ahead)
        # to these.
        to_world = pose @ AXES
        # from meters to object sizes
        to_world[:3, 3] /= size_in_meters
        model.check_no_fov(self.requested)  # the lens has a field of view of its own
        fov = _compute_fov_of_lens(model)
        # The pose becomes a camera of the scene, and is selected; `with_camera` also
        # checks the settings. Then it gets its lens, which `with_camera` has removed.
        cameras = {**self.cameras, spec: PosedCamera(to_world, fov)}
        scene = replace(self, cameras=cameras).with_camera(spec)
        return replace(scene, camera_model=replace(model, name=spec))

    def _require_size(self, spec: str) -> float:
        """Return the meters of one object size, which a camera file needs.

        Raises InputError: the size of the object is not known.
        """
        size_in_meters = self.object.size_in_metres
        if size_in_meters is None:
            raise InputError(
                f"`camera={spec}` is in metres, and the size of {self.object.name} is "
                "not known; give its longest side in metres, such as `size=0.1`"
            )
        return size_in_meters

    @staticmethod
    def load_object(spec: str | Path) -> ObjectAsset:
        """Return a bundled object or one from a mesh file.

        Raises InputError: there is none, or it can't be used.
        """
        return _load_object(spec, None, None)

    def with_camera(self, camera: str) -> SceneDescription:
        """Return the scene with another camera, or with another lens of its camera.

        Args:
            camera: name of a camera of the scene, or of a preset of a mounted camera.
                Or a lens for the camera around the object: the path of a camera file,
                or the name of a bundled camera model.

        Raises:
            InputError: a setting of the camera around the object was requested, and
                another camera is chosen; or a file cannot be used.
            UnknownNameError: it has no such camera.
        """
        # A camera of the scene goes before a preset with the same name.
        if camera in PRESETS and camera not in self.cameras:
            return self._with_mounted_camera(camera)
        scene = replace(self, camera=ORBIT_CAMERA, camera_model=None)
        is_lens = camera not in (ORBIT_CAMERA, *self.cameras)
        if is_lens:
            return scene._with_lens(camera)
        if camera != ORBIT_CAMERA:
            self._check_no_orbit_settings(camera)
        return replace(scene, camera=camera)

    def _check_no_orbit_settings(self, camera: str) -> None:
        """Raise InputError if settings are requested that a camera has itself."""
        # The exposure is allowed with any camera. The others are those of the camera
        # around the object.
        camera_settings = sorted(
            name
            for name in self.requested
            if name.startswith("camera.") and name != "camera.exposure"
        )
        if camera_settings:
            raise InputError(
                f"`camera={camera}` and `set` {camera_settings[0]} contradict each "
                "other: the camera of the file has a place and a field of view of its "
                "own; leave one of the two out"
            )

    def _with_lens(self, camera: str) -> SceneDescription:
        """Return the scene with the lens of a camera file or a bundled camera model.

        A file with several cameras makes the scene a rig, whose first camera becomes
        that of the scene.

        Args:
            camera: path of the file, or name of the model.

        Raises:
            FileFormatError: the file cannot be used.
            InputError: a field of view was requested, and the lens has its own.
            UnknownNameError: there is no such model.
        """
        self._check_lens_exists(camera)
        scene = self
        # empty for a bundled model, and for a file with one camera
        rig = read_rig(camera) if is_path(camera) else ()
        if rig:
            model = rig[0].camera_model
            scene = self._with_rig(rig, camera)
        else:
            model = _load_lens(camera)
        # A camera of a rig may have a field of view, and no model of a lens.
        if model is not None:
            model.check_no_fov(self.requested)
        return replace(scene, camera_model=model)

    def _check_lens_exists(self, camera: str) -> None:
        """Raise UnknownNameError if there is no file and no bundled model of a name."""
        if not is_path(camera) and camera not in make_bundled_models():
            known = (ORBIT_CAMERA, *self.cameras, *make_bundled_models(), *PRESETS)
            raise UnknownNameError(
                "camera",
                camera,
                known,
                "Or give the path of a camera file, such as calib.yaml.",
            )

    def _with_rig(self, rig: tuple[RigCamera, ...], spec: str) -> SceneDescription:
        """Return the scene with several cameras, of the file `spec`."""
        scene = replace(self, rig=rig, rig_spec=spec)
        fov = rig[0].fov
        return scene if fov is None else scene.with_values(camera__fov=fov)

    def _with_mounted_camera(self, name: str) -> SceneDescription:
        """Return the scene as a mounted camera sees it, by its name in `PRESETS`.

        A preset is a usual way to mount a camera, with its height in metres above the
        floor. The floor is that of the place, or the one on which the table of a small
        object stands. Settings that the user requested stay. The camera stands at the
        preset's distance, or farther away if the object would not fit into the image.

        Raises InputError: the object's size in metres is not known.
        """
        preset = PRESETS[name]
        self._check_size_for_preset(name, preset)
        preset_values = {
            setting: value
            for setting, value in self._make_preset_values(preset).items()
            if setting not in self.requested
        }
        values = {**self.values, **preset_values}
        scene = replace(
            self, camera=ORBIT_CAMERA, camera_model=None, preset=name, values=values
        )
        if "camera.distance" in self.requested:
            return scene
        return scene._with_preset_distance(preset)

    def _check_size_for_preset(self, name: str, preset: CameraPreset) -> None:
        """Raise InputError if the object has no size for a camera at a height in
        meters.
        """
        if self.object.size_in_metres is None:
            raise InputError(
                f"`camera={name}` is {preset.height:g} m high, and the "
                f"size of {self.object.name} is not known; give its longest side in "
                "metres, such as `size=0.1`"
            )

    def _with_preset_distance(self, preset: CameraPreset) -> SceneDescription:
        """Return the scene with a mounted camera at its distance, or farther away."""
        fov = torch.tensor(self.get_number("camera.fov"), dtype=torch.float64)
        # the distance from which the object fits into the image, in object sizes
        framing_distance = float(
            geometry.compute_framing_distance(self, fov, self.aspect)
        )
        distance = max(preset.distance, framing_distance * self.size_in_metres)
        return self.with_values(camera__distance=distance)

    def _make_preset_values(self, preset: CameraPreset) -> dict[str, float]:
        """Return the settings of a mounted camera by name, except for its distance.

        Heights are in meters above the ground of the scene. A small object on a plain
        ground stands on a table: then this ground is the table top, with the size of a
        table, and the floor is `TABLE_HEIGHT` below it.
        """
        is_on_table = self._is_on_table()
        preset_values = {"camera.fov": preset.fov}
        # A requested elevation takes the place of the height: only one can be set.
        if "camera.elevation" not in self.requested:
            # The preset's height is above the floor, the setting above the ground.
            floor = -TABLE_HEIGHT if is_on_table else self._find_floor_height()
            preset_values["camera.height"] = preset.height + floor
        if preset.in_lane:  # azimuth 0 is in the lane of the object
            preset_values["camera.azimuth"] = 0.0
        if is_on_table:
            preset_values["ground.size"] = TABLE_SIDE / self.size_in_metres
        return preset_values

    def _find_floor_height(self) -> float:
        """Return the height of the place's floor, meters; 0 without a place."""
        surroundings = find_place(self)
        return 0.0 if surroundings is None else surroundings.file.floor

    def _is_on_table(self) -> bool:
        """Return whether the object is so small that its plain ground is a table."""
        is_on_plain_ground = (
            self.get_number("ground.size") > 0.0
            and self.photograph is None
            and not is_paved(self)
        )
        return is_on_plain_ground and self.size_in_metres <= MAX_TABLETOP_SIZE

    @property
    def things(self) -> Mapping[str, ThingPart]:
        """The things next to the object by name, in the order of the setting."""
        return {part.name: part for part in self.parts if isinstance(part, ThingPart)}

    @property
    def has_opacity(self) -> bool:
        return any(
            mesh.opacity is not None for mesh in self.meshes.values()
        ) or self._has_plugin("mask")

    @property
    def has_normal_maps(self) -> bool:
        return any(
            mesh.normal_map is not None for mesh in self.meshes.values()
        ) or self._has_plugin("normalmap", "bumpmap")

    def _has_plugin(self, *kinds: str) -> bool:
        """Return whether a Mitsuba plugin of one of these kinds is in the scene.

        Plugins inside other plugins count too, and so do those of surfaces that are
        described as Mitsuba plugins.

        Args:
            *kinds: values of a plugin's "type", such as "thinlens".
        """
        surfaces = [
            mesh.surface for mesh in self.meshes.values() if mesh.surface is not None
        ]
        plugins = [part.plugin for part in self.parts if isinstance(part, PluginPart)]
        return any(
            inner.get("type") in kinds
            for plugin in (*surfaces, *plugins)
            for inner in iterate_plugins(plugin)
        )

    @property
    def has_emission(self) -> bool:
        return any(mesh.emission is not None for mesh in self.meshes.values())

    @property
    def lamps(self) -> Mapping[str, Lamp]:
        """Every light beside the environment, by name."""
        return geometry.list_lamps(self)

    @property
    def is_lit(self) -> bool:
        """Whether there is anything that shines."""
        # `has_emission` is about meshes; Mitsuba's own plugins may shine as well.
        has_shining_plugin = any(
            part.emits_light for part in self.parts if isinstance(part, PluginPart)
        )
        return (
            self.environment is not None
            or bool(self.lamps)
            or has_shining_plugin
            or self.has_emission
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user: how files were read, and what is doubtful in the scene.

        Each is a sentence. They come from the object's file, its front and size, the
        environment, the camera, the traffic, and from controls.
        """
        light_notes = () if self.environment is None else self.environment.warnings
        camera_notes = () if self.camera_model is None else self.camera_model.notes
        size_remarks = describe_size_doubts(
            self.object,
            has_user_size=self.size is not None,
            needs_metres=is_paved(self),
        )
        notes = (
            *self.object.notes,
            *self._front_remarks,
            *size_remarks,
            *light_notes,
            *camera_notes,
            *self._traffic_remarks,
            *self.remarks,
        )
        return tuple(dict.fromkeys(note for note in notes if note))

    @property
    def _front_remarks(self) -> tuple[str, ...]:
        """How the object's front was found, which matters on a road."""
        front = self.object.front
        stands_on_road = self.is_in_lane or has_lanes(self)
        return () if front is None or not stands_on_road else (front.reason,)

    @property
    def _traffic_remarks(self) -> tuple[str, ...]:
        """A remark if the object drives against the traffic."""
        return (make_traffic_remark(self),) if self._drives_against_traffic else ()

    @property
    def _drives_against_traffic(self) -> bool:
        return self.uses_orbit_camera and is_against_traffic(
            self, geometry.camera_to_world(self)
        )

    def require_environment(self, requester: str) -> EnvironmentAsset:
        """Return the environment of the scene.

        Args:
            requester: the setting or control that needs it, for the message.

        Raises InputError: the scene has no environment map.
        """
        if self.environment is None:
            # Raises another message if a Mitsuba scene has environments of its own.
            check_single_environment(self.parts, requester)
            raise InputError(
                f"{requester}: the scene has no environment map; give it one, "
                f"or leave {requester} out"
            )
        return self.environment

    @property
    def uses_orbit_camera(self) -> bool:
        """Whether the settings `camera.*` say where its camera is, and not a file."""
        return self.camera == ORBIT_CAMERA

    @property
    def metered_irradiance(self) -> float:
        """Irradiance that the exposure of images is metered for, in scene units.

        It is the solution of the equation for a grey card, whose radiance is
        reflectance * irradiance / pi:

            gain * radiance = CARD_DISPLAY_VALUE
        """
        return (
            CARD_DISPLAY_VALUE
            * math.pi
            / (CARD_REFLECTANCE * compute_metered_gain(self))
        )

    def list_environment_light(self) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Return the light of the environment as directional lights.

        Returns:
            Unit directions (N, 3) to the light, solid angles (N,), and radiance
                times these.
        """
        return compute_environment_light(self)

    def get_ground_height(self, position: Float64Array) -> float:
        """Return how high the ground lies at a place (2,), object sizes.

        Road, pavement, table or floor; or 0.
        """
        return find_ground_height(self, position)

    @property
    def requested_values(self) -> dict[str, float | str]:
        """The settings that were requested and have a value, by name.

        Values are as users write them: of a choice the name of the option, not its
        index.
        """
        requested: dict[str, float | str] = {}
        for name in self.requested & self.values.keys():
            value = self.values[name]
            if value is not None:
                requested[name] = _to_user_value(name, value)
        return requested

    @property
    def gain(self) -> float:
        """Factor from scene radiance to display-linear values.

        It is a base factor times 2 to the power of `camera.exposure`. The base factor
        is the first of these that applies: that of the exposure value `camera.ev`; that
        of the photograph that the scene is rendered into; the metered one; 1.
        """
        exposure_value = self.values.get("camera.ev")
        base_gain = 1.0
        if exposure_value is not None:
            base_gain = self._compute_gain_of_ev(exposure_value)
        elif self.backdrop_photograph is not None:
            base_gain = compute_photograph_gain(self, self.backdrop_photograph)
        elif self.metered:
            base_gain = compute_metered_gain(self)
        return base_gain * math.pow(2.0, self.get_number("camera.exposure"))

    def _compute_gain_of_ev(self, exposure_value: float) -> float:
        """Return the factor from scene radiance to display-linear values of an EV.

        A sensor saturates, and the display value is 1, at a luminance of 1.2 * 2^EV in
        cd/m2 (Lagarde and de Rousiers 2014, Moving Frostbite to PBR, section 5.1).

        Raises InputError: the radiance of the environment has no unit.
        """
        # luminance of a radiance of 1, cd/m2
        unit = None if self.environment is None else self.environment.candelas
        if unit is None:
            raise InputError(
                "`set` camera.ev: the brightness of this environment has no unit; take "
                "one of the avenue, or leave camera.ev out, and exposure is metered"
            )
        return unit / (1.2 * math.pow(2.0, exposure_value))


def _load_lens(camera: str) -> CameraModel:
    """Return the lens of a camera file with one camera, or a bundled camera model.

    `camera` is the path of the file, or the name of the model.
    """
    if not is_path(camera):
        return make_bundled_models()[camera]
    with track_opened_files(camera.partition("#")[0]):
        return read_camera(camera)


def _compute_fov_of_lens(model: CameraModel) -> float:
    """Return the field of view of a lens along the larger side, in degrees."""
    # Focal lengths are in widths and heights of the image, so that half a side's angle
    # has the tangent 0.5 / focal. The field of view is along the larger side.
    tangents = (
        0.5 / model.intrinsic_by_name["fx"],
        0.5 / model.intrinsic_by_name["fy"],
    )
    return 2.0 * math.degrees(math.atan(max(tangents)))


def _to_user_value(name: str, value: float) -> float | str:
    """Return the value of a setting as users write it: of a choice the option."""
    setting = settings.find_parameter(name)
    if setting is None or not setting.options:
        return value
    return setting.options[int(value)]


def load_description(
    object_spec: str | Path | ObjectAsset,
    environment_spec: str | Path | EnvironmentAsset | None = None,
    *,
    setting_values: settings.SettingValues | None = None,
    up: str | None = None,
    facing: str | None = None,
    size: float | None = None,
    unit: str | None = None,
    plugins: Mapping[str, object] | None = None,
    things: str | None = None,
) -> SceneDescription:
    """Find and read an object and an environment, bundled or from a file.

    The object may be one node of a glTF scene, or one shape of a Mitsuba scene. Then
    the rest of that scene stays around it. There is no ground plane then, and no
    environment map if the scene has lights of its own.

    Args:
        object_spec: name or file of the object; with `plugins` the id of a shape.
        environment_spec: name or file of the environment; None chooses one, and
            `NO_ENVIRONMENT` is no map at all.
        setting_values: settings of the scene by name, such as "camera.fov".
        up: the axis of a mesh file that points up, such as "z".
        facing: the axis of a mesh file that is its front.
        size: longest side of the object, metres.
        unit: unit of the object's file, such as "cm"; not together with `size`.
        plugins: a Mitsuba scene as a dictionary, as `mitsuba.load_dict` takes it.
        things: what stands beside the object, such as "car@12,3.5,heading=180".

    Raises:
        FileFormatError: a file cannot be used.
        InputError: arguments or settings are out of range or contradict each other.
        UnknownNameError: there is no object, environment or setting of such a name.
    """
    setting_values = setting_values or {}
    values = settings.resolve_settings(setting_values)
    source = _find_source(object_spec, plugins)
    is_mitsuba = source.is_mitsuba
    if source.is_scene:
        _check_not_turned(up, facing, is_mitsuba=is_mitsuba)
    imported = _import_source(source, object_spec, plugins, up, facing)
    imported = replace(imported, object=with_size(imported.object, size, unit))

    lit_by = environment_spec or _choose_environment(imported, is_mitsuba=is_mitsuba)
    check_ground(setting_values, lit_by)
    _check_environment(imported, lit_by)
    # what stands around the object has a ground of its own
    if source.is_scene and not {"ground.size", "ground.kind"} & set(setting_values):
        values["ground.size"] = 0.0
    camera = _choose_camera(imported, setting_values, is_mitsuba=is_mitsuba)
    described = SceneDescription(
        object=imported.object,
        environment=_load_environment(lit_by),
        values=values,
        object_spec=_spec_text(object_spec),
        environment_spec=_spec_text(lit_by),
        up=up,
        facing=facing,
        size=size,
        unit=unit,
        requested=_list_requested(setting_values, environment_spec),
        parts=imported.surroundings,
        cameras=imported.cameras,
        camera=camera,
        # The light of a Mitsuba scene counts as it is, without metering.
        metered=not is_mitsuba,
    )
    described = _add_surroundings(described, things)
    check_mesh_names(described, values)
    _check_material_settings(described.object, setting_values)
    return described


def _choose_camera(
    imported: ImportedScene,
    setting_values: settings.SettingValues,
    *,
    is_mitsuba: bool,
) -> str:
    """Return the name of the camera that sees a scene.

    A Mitsuba scene is seen by its first camera, if it has one and settings describe no
    other.
    """
    if is_mitsuba and not _describes_orbit(setting_values):
        return next(iter(imported.cameras), ORBIT_CAMERA)
    return ORBIT_CAMERA


def _check_environment(
    imported: ImportedScene, lit_by: str | Path | EnvironmentAsset
) -> None:
    """Raise InputError if a scene with an environment map has a second environment."""
    if lit_by != NO_ENVIRONMENT:
        check_single_environment(
            imported.surroundings, f"`environment={_spec_text(lit_by)}`"
        )


def _list_requested(
    setting_values: settings.SettingValues,
    environment_spec: str | Path | EnvironmentAsset | None,
) -> frozenset[str]:
    """Return the names of what the user requests: settings, and an environment."""
    environment_names = () if environment_spec is None else (ENVIRONMENT,)
    return frozenset((*setting_values, *environment_names))


def _add_surroundings(
    described: SceneDescription, things: str | None
) -> SceneDescription:
    """Return a scene with its ground, the things next to the object, and lamps.

    Things stand on the ground, and lamps are carried by things.
    """
    described = with_requested_ground(described)
    described = add_things(described, things, _load_thing)
    described = add_solid_remarks(described)
    return add_lamps(described)


class _Source(NamedTuple):
    """What an object is read from."""

    file: str | Path | ObjectAsset  # a file, the name of a bundled object, or itself
    node: str | None  # node or shape of a scene file that is the object
    is_mitsuba: bool  # whether it is a Mitsuba scene, a file or a dictionary

    @property
    def is_scene(self) -> bool:
        """Whether there are other things around the object."""
        return self.node is not None or self.is_mitsuba


def _find_source(
    object_spec: str | Path | ObjectAsset, plugins: Mapping[str, object] | None
) -> _Source:
    """Return the file and the node that an object spec names.

    "scene.glb#car" names the file "scene.glb" and its node "car". With `plugins`, a
    Mitsuba scene as a dictionary, the spec is the id of a shape, and the file of the
    result is not used.
    """
    file: str | Path | ObjectAsset = object_spec
    node = None
    if isinstance(object_spec, str):
        file, node = split_node_argument(object_spec)
    is_mitsuba_file = node is not None and str(file).lower().endswith(MITSUBA_SUFFIX)
    return _Source(file, node, is_mitsuba=plugins is not None or is_mitsuba_file)


def _import_source(
    source: _Source,
    object_spec: str | Path | ObjectAsset,
    plugins: Mapping[str, object] | None,
    up: str | None,
    facing: str | None,
) -> ImportedScene:
    """Read an object, and the scene around it if its source has one.

    Args:
        source: which file and which node of it the object is.
        object_spec: name or file of the object; with `plugins` the id of a shape.
        plugins: a Mitsuba scene as a dictionary; None: the object is from a file.
        up: the axis of a mesh file that points up.
        facing: the axis of a mesh file that is its front.
    """
    if plugins is not None:
        # Imported here, since other scenes do not need Mitsuba to be read.
        from advsearch.scene.mitsuba_backend.scene_files import import_mitsuba_scene

        # The spec names a shape of the dictionary: "mug", or "scene#mug".
        shape_id = source.node or str(object_spec)
        return import_mitsuba_scene(plugins, shape_id)
    if source.node is None:
        return ImportedScene(_load_object(object_spec, up, facing))
    return _import_scene_file(
        Path(str(source.file)), source.node, is_mitsuba=source.is_mitsuba
    )


def _choose_environment(imported: ImportedScene, *, is_mitsuba: bool) -> str:
    """Return the environment if none is requested; "none" if the scene has lights.

    A light may be one around the object, or in a Mitsuba scene also the object itself.
    """
    object_shines = is_mitsuba and imported.object.emission is not None
    if object_shines or _has_lights(imported.surroundings):
        return NO_ENVIRONMENT
    return DEFAULT_ENVIRONMENT


def _check_not_turned(up: str | None, facing: str | None, *, is_mitsuba: bool) -> None:
    """Check that the user gives no axes for a scene file, whose axes are known.

    Raises InputError: `up` or `facing` is given.

    Args:
        up: the axis that is to point up; None if none is given.
        facing: the axis that is to be the front; None if none is given.
        is_mitsuba: whether it is a Mitsuba scene; otherwise it is glTF.
    """
    if up is not None:
        reason = "glTF files have y up"
        if is_mitsuba:
            reason = "the first camera of a Mitsuba scene says which way is up"
        raise InputError(f"up: {reason}; leave `up` out")
    if facing is not None:
        raise InputError(
            "facing: a scene file stays as it is; leave `facing` out, or "
            "turn the object: `set` pose.yaw"
        )


def _import_scene_file(path: Path, node: str, *, is_mitsuba: bool) -> ImportedScene:
    """Read a glTF scene or a Mitsuba scene around one of its nodes or shapes."""
    with track_opened_files(path):
        if not is_mitsuba:
            return import_scene(path, node)
        # Mitsuba is imported only for what it reads
        from advsearch.scene.mitsuba_backend.scene_files import import_mitsuba_scene

        return import_mitsuba_scene(path, node)


def _has_lights(parts: Iterable[ScenePart]) -> bool:
    """Return whether one of the parts is a light."""
    return any(
        isinstance(part, Lamp) or (isinstance(part, PluginPart) and part.emits_light)
        for part in parts
    )


def _describes_orbit(requested: settings.SettingValues) -> bool:
    """Return whether settings say where the camera around the object is."""
    return any(
        name.startswith("camera.") and name != "camera.exposure" for name in requested
    )


def _load_environment(
    lit_by: str | Path | EnvironmentAsset,
) -> EnvironmentAsset | None:
    """Return an environment, bundled or from a file; None for `NO_ENVIRONMENT`.

    Args:
        lit_by: an environment, the name of a bundled one, the file of a map, or the
            YAML file of a place.
    """
    if isinstance(lit_by, EnvironmentAsset):
        return lit_by
    if lit_by == NO_ENVIRONMENT:
        return None
    if is_place_file(lit_by):
        return import_place(str(lit_by))
    if is_path(lit_by):
        with track_opened_files(lit_by):
            return library.import_environment(Path(lit_by))
    return library.load_environment(str(lit_by))


def _check_material_settings(
    asset: ObjectAsset, requested: settings.SettingValues
) -> None:
    """Check that an object has the single material that settings change.

    Raises InputError: "material." settings are requested, but the object has several
    materials or a surface that is described as a Mitsuba plugin.
    """
    material_settings = [name for name in requested if name.startswith("material.")]
    if asset.surface is not None and material_settings:
        # Several materials (finishes) are one surface, too.
        surface = "a surface of Mitsuba's own"
        if asset.finishes:
            surface = "several materials"
        raise InputError(
            f"`set` {material_settings[0]}: the object has {surface}, which this "
            "setting cannot change; leave it out"
        )


def check_mesh_names(scene: SceneDescription, names: Iterable[str]) -> None:
    """Check that a scene has the meshes around the object that settings name.

    Args:
        scene: the scene.
        names: names of settings. Those of other things than meshes are ignored.

    Raises UnknownNameError: there is no such mesh.
    """
    for name in names:
        mesh = settings.parse_mesh_name(name)  # None for settings of other things
        if mesh is not None and mesh not in scene.surrounding_meshes:
            raise UnknownNameError(
                "mesh around the object",
                mesh,
                scene.surrounding_meshes,
                f"It stands in `set` {name}.",
            )


def check_single_environment(parts: Iterable[ScenePart], requester: str) -> None:
    """Check that a Mitsuba scene has no environment of its own among its parts.

    Raises InputError: it has one. A scene can have only one environment.

    Args:
        parts: parts of the scene.
        requester: the setting that needs a map of ours, as users write it.
    """
    for part in parts:
        if isinstance(part, PluginPart) and part.plugin.get("type") in ENVIRONMENTS:
            raise InputError(
                f"{requester}: the Mitsuba scene has an environment of its own, "
                f"{part.name} (a {part.plugin['type']}), and there can be one only; "
                f"leave {requester} out, or take {part.name} out of the scene"
            )


def check_ground(
    requested: settings.SettingValues, lit_by: str | Path | EnvironmentAsset
) -> None:
    """Check the settings of a ground that is a photograph, a road or a place.

    Raises InputError: there is no environment map for a photographed ground, or a
    setting of a table is given as well.

    Args:
        requested: the user's settings by name.
        lit_by: the environment; `NO_ENVIRONMENT` for none.
    """
    kind = requested.get("ground.kind")
    if kind not in (settings.PHOTOGRAPH, *settings.ROAD_KINDS, *settings.PLACE_KINDS):
        return
    if lit_by == NO_ENVIRONMENT and kind == settings.PHOTOGRAPH:
        raise InputError(
            "`set` ground.kind=photograph: the scene has no environment map to show; "
            "give it one, or leave it out"
        )
    _check_no_table_settings(kind, requested)


def _check_no_table_settings(kind: object, requested: settings.SettingValues) -> None:
    """Raise InputError if settings of a table are set with a ground that is none.

    Args:
        kind: the kind of ground, for the message.
        requested: the user's settings by name.
    """
    table_settings = [name for name in settings.TABLE_SETTINGS if name in requested]
    if table_settings:
        raise InputError(
            f"`set` ground.kind={kind} and `set` {table_settings[0]} contradict each "
            "other: only a table has that; leave one of the two out"
        )


def _spec_text(spec: str | Path | ObjectAsset | EnvironmentAsset) -> str:
    return spec.name if isinstance(spec, (ObjectAsset, EnvironmentAsset)) else str(spec)


def _load_thing(spec: str, facing: str | None) -> ObjectAsset:
    return _load_object(spec, None, facing)


def _load_object(
    spec: str | Path | ObjectAsset, up: str | None, facing: str | None
) -> ObjectAsset:
    """Return an asset as it is, or load a bundled object or a mesh file.

    Args:
        spec: an asset, the name of a bundled object, or a mesh file.
        up: "y" or "z", the axis of a mesh file that points up; None: its usual one.
        facing: the axis of a mesh file that is its front; None: its usual one.

    Raises InputError: an axis is given for a bundled object.
    """
    if isinstance(spec, ObjectAsset):
        return spec
    if is_path(spec):
        with track_opened_files(spec):
            return import_object(Path(spec), up=_narrow_up_axis(up), facing=facing)
    _check_bundled_axes(spec, up, facing)
    return library.load_object(str(spec))


def _narrow_up_axis(up: str | None) -> Literal["y", "z"] | None:
    """Return an axis as it is, with the type that `import_object` accepts.

    It is "y", "z" or None: others were rejected before.
    """
    if up == "y":
        return "y"
    if up == "z":
        return "z"
    return None


def _check_bundled_axes(spec: str | Path, up: str | None, facing: str | None) -> None:
    """Raise InputError if axes of a bundled object are given."""
    if up is not None:
        raise InputError(
            "up: bundled objects stand upright already; leave `up` out, or give a "
            f"file instead of {spec!r}"
        )
    if facing is not None:
        raise InputError(
            f"facing: {spec} is bundled and faces +x; leave `facing` out, "
            "or turn it: `set` pose.yaw"
        )


def is_path(spec: str | Path) -> bool:
    """Return whether a spec is a path: it has a directory or a suffix.

    A bare word is the name of something bundled.
    """
    return (
        isinstance(spec, Path) or "/" in spec or "\\" in spec or Path(spec).suffix != ""
    )
