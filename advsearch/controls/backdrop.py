"""The `backdrop` control: which photograph of a folder the scene is rendered into.

Each photograph has its own camera, and the object may have been turned and moved between
photographs. In the scene the object stays as it is in the first photograph. The cameras
and the light of the other photographs are transformed instead, by a map T:

    T = pose of the object in the first . inverse(pose of the object in another)
    camera = T . camera of the other;   light is turned about the vertical by T

So a control of the object has the same meaning in each photograph. T has to keep the
ground plane, which receives the shadow, level. Its height is transformed as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from advsearch.extend import (
    Control,
    InputError,
    Parameter,
    SceneDescription,
    Values,
    assets,
    geometry,
    images,
    parts,
    reading,
)

# option as long as the photographs of the scene are not known
NO_PHOTOGRAPH = "own"
# largest difference between the vertical direction and (0, 0, 1), per component
PLANE_TOLERANCE = 1e-3
# settings of the plane that must be the same in all photographs of a scene
PLANE_SURFACE = ("ground.size", "ground.gloss", "ground.roughness")


class BackdropControl(Control):
    """Which photograph of a folder the scene is rendered into, with its camera."""

    kind = "backdrop"
    parameters = (
        Parameter.named(
            "which",
            (NO_PHOTOGRAPH,),
            NO_PHOTOGRAPH,
            "The photograph, by the name of its file.",
        ),
    )

    @classmethod
    def declare_parameters(cls, settings: Iterable[str]) -> tuple[Parameter, ...]:
        """Return the parameter `which`, with the photographs in the settings as options.

        See `Control.list_allowed_names` for the forms of the setting.
        """
        which = cls.parameters[0]
        options = tuple(dict.fromkeys(cls.list_allowed_names(settings, "which")))
        if not options:
            return (which,)
        # The value of a choice among names is the index of an option.
        high = len(options) - 1.0
        return (replace(which, options=options, default=options[0], high=high),)

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene in the first allowed photograph, after checking all of them.

        If any of the photographs has a camera model, the scene gets that of the first
        photograph, or the model of a pinhole with its field of view.

        Args:
            scene: scene that is rendered into a folder of photographs.

        Raises:
            InputError: there is no folder, a name is none of its photographs, or the
                photographs differ in what a scene can't change, e.g. the kind of lens.
        """
        folder = scene.photographs
        if folder is None:
            raise InputError(
                f"`controls` {self.name}: chooses among the photographs of a folder, "
                "and the scene has none; set `backdrop=FOLDER`"
            )
        views = self._select_views(scene, folder.path, folder.scenes)
        self._check_views(views)
        first = next(iter(views.values()))
        # The scene shows the first photograph of the folder. If that is not allowed, it
        # is replaced by the first allowed one.
        if first.backdrop_photograph is not scene.backdrop_photograph:
            scene = _move_into_photograph(scene, first)
        photographs = replace(folder, scenes=views)
        camera_model = _find_shared_model(views)
        return replace(scene, camera_model=camera_model, photographs=photographs)

    def _select_views(
        self,
        scene: SceneDescription,
        folder: str,
        views: Mapping[str, SceneDescription],
    ) -> dict[str, SceneDescription]:
        """Return the scene in each allowed photograph, by the photograph's name.

        Args:
            scene: scene that is rendered into a folder of photographs.
            folder: path of the folder, for messages.
            views: scene in each photograph of the folder, by name.

        Raises:
            InputError: a name is none of the photographs.
        """
        allowed = self._list_names(scene)
        for name in allowed:
            if name not in views:
                raise InputError(
                    f"{self.name}.which: {folder} has no photograph "
                    f"{name}; it has {', '.join(views)[:200]}"
                )
        return {name: views[name] for name in allowed}

    def _check_views(self, views: Mapping[str, SceneDescription]) -> None:
        """Raise InputError if the photographs can't all be shown in one scene.

        Args:
            views: scene in each photograph, by name; all are compared with the first.
        """
        first_name, first = next(iter(views.items()))
        first_lens = _get_lens(first)
        for name, view in views.items():
            lens = _get_lens(view)
            if lens.kind != first_lens.kind:
                raise InputError(
                    f"`controls` {self.name}: {name} has a {lens.kind} lens and "
                    f"{first_name} a {first_lens.kind} one; choose among photographs "
                    f"of one kind, with {self.name}.which, or sweep over all"
                )
            _check_compatible(name, view, first)

    def _list_names(self, scene: SceneDescription) -> tuple[str, ...]:
        """Return the names of the photographs that may be chosen."""
        if scene.photographs is None:
            return ()
        names = self.list_allowed_values("which", *scene.photographs.scenes)
        return tuple(map(str, names))

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return the parameter with the photographs as options, the first as default.

        Without a setting of the user all of them are searched.
        """
        # `prepare` has checked that at least one photograph is allowed.
        options = self._list_names(self.scene)
        last_index = float(len(options) - 1)
        return replace(
            parameter,
            options=options,
            default=options[0],
            high=last_index,
            search=(0.0, last_index),
        )

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the photograph, its camera, its exposure and its light."""
        which = values["which"]
        inputs = _compute_view_inputs(self.scene, int(which))
        # Copies, since the cached tensors must not change.
        return {
            name: value.to(which.device, copy=True) for name, value in inputs.items()
        }


def _find_shared_model(
    views: Mapping[str, SceneDescription],
) -> geometry.CameraModel | None:
    """Return the camera model of a scene in photographs; None if none needs a model.

    Args:
        views: scene in each photograph, by name.
    """
    # If one photograph needs a camera model, all of them are rendered with one:
    # `_compute_view_inputs` sets the lens of the photograph that is shown.
    has_model = any(view.camera_model is not None for view in views.values())
    first = next(iter(views.values()))
    return _get_lens(first) if has_model else None


@geometry.cache_per_scene
def _compute_view_inputs(scene: SceneDescription, index: int) -> dict[str, Tensor]:
    """Return the scene inputs that replace the first photograph by another one.

    They set the photograph, the camera's pose, lens and exposure, the ground plane, and
    the environment, turned with the camera.

    Args:
        scene: scene in the first photograph.
        index: index of the photograph to show.
    """
    assert scene.photographs is not None
    view = list(scene.photographs.scenes.values())[index]
    view_to_scene = _compute_view_to_first(view, scene)
    pose = view_to_scene @ geometry.camera_to_world(view)
    # A gain is the factor of an exposure; the input is in stops, relative to the scene.
    exposure_stops = math.log2(view.gain / scene.gain)
    inputs = {
        parts.PHOTOGRAPH_INPUT: torch.tensor(float(index)),
        "camera.to_world": torch.from_numpy(pose).float(),
        "camera.exposure": torch.tensor(exposure_stops),
        **_compute_lens_input(scene, view),
    }
    if reading.backdrop.has_plane(scene):
        inputs["ground.to_world"] = _compute_plane_pose(view, view_to_scene)
    if scene.environment is not None:
        inputs["environment.data"] = _turn_environment(scene.environment, view_to_scene)
    return inputs


def _compute_lens_input(
    scene: SceneDescription, view: SceneDescription
) -> dict[str, Tensor]:
    """Return the lens of a photograph as a scene input: a camera model, or an angle."""
    if scene.camera_model is not None:
        return {"camera.lens": torch.tensor(_get_lens(view).intrinsics)}
    return {"camera.fov": torch.tensor([view.get_number("camera.fov")])}


def _move_into_photograph(
    scene: SceneDescription, view: SceneDescription
) -> SceneDescription:
    """Return a scene with the photograph, the camera and the values of another view."""
    return replace(
        scene,
        backdrop_photograph=view.backdrop_photograph,
        camera=view.camera,
        values=view.values,
    )


def _turn_environment(
    environment: assets.EnvironmentAsset, view_to_scene: assets.Float64Array
) -> Tensor:
    """Return the map (h, w, 3) of an environment, turned with a photograph's world.

    All photographs have the same environment, whose directions refer to the camera.

    Args:
        environment: the environment.
        view_to_scene: (4, 4) map from the photograph's world to that of the scene.
    """
    radiance = torch.from_numpy(environment.radiance.copy())
    # `view_to_scene` can only turn about the vertical (see `_check_compatible`): by this
    # angle, counter-clockwise seen from above.
    angle = math.atan2(view_to_scene[1, 0], view_to_scene[0, 0])
    degrees = torch.tensor(math.degrees(angle))
    return images.rotate_map(radiance, degrees)


def _compute_view_to_first(
    view: SceneDescription, first: SceneDescription
) -> assets.Float64Array:
    """Return the map (4, 4) from the world of one photograph to that of the first.

    It maps the object's pose in the one to its pose in the other.

    Args:
        view: scene in one photograph.
        first: scene in the first photograph.
    """
    pose = geometry.compute_object_to_world(view)
    pose_in_first = geometry.compute_object_to_world(first)
    view_to_first: assets.Float64Array = pose_in_first @ np.linalg.inv(pose)
    return view_to_first


def _compute_plane_pose(
    view: SceneDescription, view_to_first: assets.Float64Array
) -> Tensor:
    """Return the pose (4, 4) of the ground plane of a photograph in the scene.

    Its mesh is a square with a side of 2 at height 0, so that it is scaled by half the
    plane's size and lifted to the plane's height.

    Args:
        view: scene in the photograph.
        view_to_first: (4, 4) map from the photograph's world to that of the scene. Only
            its vertical shift is used, since the plane follows the object otherwise.
    """
    half_size = view.get_number("ground.size") / 2.0
    pose = torch.diag(torch.tensor([half_size, half_size, half_size, 1.0]))
    pose[2, 3] = view.get_number("ground.level") + float(view_to_first[2, 3])
    return pose


def _get_lens(view: SceneDescription) -> geometry.CameraModel:
    """Return the camera model of a photograph.

    Without one, it is the model of a pinhole with the photograph's field of view.
    """
    if view.camera_model is not None:
        return view.camera_model
    return geometry.make_pinhole(view.get_number("camera.fov"), view.aspect)


def _check_compatible(
    name: str, view: SceneDescription, first: SceneDescription
) -> None:
    """Raise InputError if a photograph can't be shown in the scene of the first one.

    Both need the same environment, the same direction up and the same ground plane.

    Args:
        name: name of the photograph, for messages.
        view: scene in this photograph.
        first: scene in the first photograph.
    """
    if view.environment_spec != first.environment_spec:
        raise InputError(
            f"`controls` backdrop: {name} has a file with its own light next to it; "
            "state one `environment` for all photographs, or sweep over them"
        )
    difference = _describe_difference(view, first)
    if difference is not None:
        raise InputError(
            f"`controls` backdrop: in {name} {difference} than in the first "
            "photograph; "
            "leave it out of backdrop.which, or sweep over the photographs"
        )


def _describe_difference(view: SceneDescription, first: SceneDescription) -> str | None:
    """Return how the plane of a photograph differs from the first; None if it fits."""
    view_to_first = _compute_view_to_first(view, first)
    # The z axis of the first photograph's world, in the world of this photograph.
    up_of_first = view_to_first[2, :3]
    up_error = np.abs(up_of_first - [0.0, 0.0, 1.0]).max()
    is_upright = up_error <= PLANE_TOLERANCE
    if not is_upright:
        return "the object stands on another side"
    if reading.backdrop.has_plane(view) != reading.backdrop.has_plane(first):
        return "the camera is on another side of the plane, or its size differs,"
    if not _has_same_surface(view, first):
        return f"the plane has another size or gloss ({', '.join(PLANE_SURFACE)})"
    return None


def _has_same_surface(view: SceneDescription, first: SceneDescription) -> bool:
    """Return whether the planes of two photographs have the same size and gloss."""
    return all(
        view.get_number(setting) == first.get_number(setting)
        for setting in PLANE_SURFACE
    )
