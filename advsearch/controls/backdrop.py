"""The `backdrop` control: which photograph of a folder the scene is rendered into.

The photographs were taken by cameras of their own, of an object that may have been
turned and moved. The object stays as it stands in the first photograph, and camera and
light are carried there from the others:

    T = pose of the object in the first . inverse(pose of the object in another)
    camera = T . camera of the other;   light is turned about the vertical by T

so that controls of the object mean the same in each. T has to leave the plane that
takes the shadow level; its height is carried there too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from advsearch.controls.base import Control, Values
from advsearch.controls.ranges import ParameterValue, list_set_names
from advsearch.controls.support.images import rotate_map
from advsearch.errors import InputError
from advsearch.scene.assembly import PHOTOGRAPH_INPUT
from advsearch.scene.assets import Float64Array
from advsearch.scene.backdrop import has_plane
from advsearch.scene.camera_model import CameraModel, make_pinhole
from advsearch.scene.description import SCENE_ENVIRONMENT, SceneDescription
from advsearch.scene.geometry import camera_to_world, object_to_world
from advsearch.scene.scene_data import cache_per_scene
from advsearch.scene.settings import Parameter

PLANE_TOLERANCE = 1e-3  # of a cosine: how far the plane may be from level
# settings of the plane that have one value in a scene
PLANE_SURFACE = ("ground.size", "ground.gloss", "ground.roughness")


class BackdropControl(Control):
    """Which photograph of a folder the scene is rendered into, seen by its camera."""

    kind = "backdrop"
    parameters = (
        Parameter.named(
            "which",
            (SCENE_ENVIRONMENT,),
            SCENE_ENVIRONMENT,
            "The photograph, by the name of its file.",
        ),
    )

    @classmethod
    def declare_parameters(cls, settings: Iterable[str]) -> tuple[Parameter, ...]:
        """Return the parameter, with the photographs that a setting names as options.

        See `list_set_names` for the forms of the setting.
        """
        which = cls.parameters[0]
        options = tuple(dict.fromkeys(list_set_names(settings, "which")))
        if not options:
            return (which,)
        high = len(options) - 1.0
        return (replace(which, options=options, default=options[0], high=high),)

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene in the first allowed photograph, after checking all of them.

        If one of the photographs has a camera model, the scene gets one: all are then
        seen through the same kind of lens.

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
                "and there is none; give `backdrop=FOLDER`"
            )
        allowed = [str(name) for name in self._list_names(scene)]
        for name in allowed:
            if name not in folder.scenes:
                raise InputError(
                    f"{self.name}.which: {folder.path} has no photograph "
                    f"{name}; it has {', '.join(folder.scenes)[:200]}"
                )
        views = {name: folder.scenes[name] for name in allowed}
        self._check_views(views)
        first = views[allowed[0]]
        # The scene shows the first photograph of the folder, which may not be allowed.
        if first.backdrop_photograph is not scene.backdrop_photograph:
            scene = replace(
                scene,
                backdrop_photograph=first.backdrop_photograph,
                camera=first.camera,
                values=first.values,
            )
        has_model = any(view.camera_model is not None for view in views.values())
        return replace(
            scene,
            camera_model=_get_lens(first) if has_model else None,
            photographs=replace(folder, scenes=views),
        )

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

    def _list_names(self, scene: SceneDescription) -> tuple[ParameterValue, ...]:
        """Return the names of the photographs that may be chosen."""
        if scene.photographs is None:
            return ()
        return self.list_allowed_values("which", *scene.photographs.scenes)

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return the parameter with the photographs as options, the first as default.

        Without a setting of the user all of them are searched.
        """
        options = tuple(map(str, self._list_names(self.scene)))
        high = max(len(options) - 1.0, 0.0)
        return replace(
            parameter,
            options=options,
            default=options[0],
            high=high,
            search=(0.0, high),
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


@cache_per_scene
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
    # (4, 4) from the world of the photograph to that of the scene
    carry = _compute_carry(view, scene)
    pose = carry @ camera_to_world(view)
    inputs = {
        PHOTOGRAPH_INPUT: torch.tensor(float(index)),
        "camera.to_world": torch.from_numpy(pose).float(),
        # in stops, relative to the first photograph
        "camera.exposure": torch.tensor(math.log2(view.gain / scene.gain)),
    }
    if scene.camera_model is not None:
        inputs["camera.lens"] = torch.tensor(_get_lens(view).numbers)
    else:
        inputs["camera.fov"] = torch.tensor([view.get_number("camera.fov")])
    if has_plane(scene):
        inputs["ground.to_world"] = _compute_plane_pose(view, carry)
    if scene.environment is not None:
        radiance = torch.from_numpy(scene.environment.radiance.copy())
        # the turn about the vertical axis, the only one that `carry` may have
        degrees = math.degrees(math.atan2(carry[1, 0], carry[0, 0]))
        inputs["environment.data"] = rotate_map(radiance, torch.tensor(degrees))
    return inputs


def _compute_carry(view: SceneDescription, first: SceneDescription) -> Float64Array:
    """Return the map (4, 4) by which an object in a view stands as in the first."""
    carry: Float64Array = object_to_world(first) @ np.linalg.inv(object_to_world(view))
    return carry


def _compute_plane_pose(view: SceneDescription, carry: Float64Array) -> Tensor:
    """Return the pose (4, 4) of the plane of a view, at the height to which it is
    carried.

    `carry` is as in `_compute_carry`. The plane is a square with a side of 2 before.
    """
    half_size = view.get_number("ground.size") / 2.0
    pose = torch.diag(torch.tensor([half_size, half_size, half_size, 1.0]))
    pose[2, 3] = view.get_number("ground.level") + float(carry[2, 3])
    return pose


def _get_lens(view: SceneDescription) -> CameraModel:
    """Return the camera model of a view, for a pinhole without one that of its angle."""
    if view.camera_model is not None:
        return view.camera_model
    return make_pinhole(view.get_number("camera.fov"), view.aspect)


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
            f"`controls` backdrop: {name} has a light of its own beside it; state one "
            "`environment` for all photographs, or sweep over them"
        )
    # (4, 4) from the world of this photograph to that of the first
    carry = _compute_carry(view, first)
    # Row 2 gives z in the first world: it has to be z here as well, but for a shift.
    up_change = carry[2, :3] - [0.0, 0.0, 1.0]
    is_upright = np.abs(up_change).max() <= PLANE_TOLERANCE and carry[2, 2] > 0.0
    same_surface = all(
        view.get_number(setting) == first.get_number(setting)
        for setting in PLANE_SURFACE
    )
    if not is_upright:
        reason = "the object stands with another side down"
    elif has_plane(view) != has_plane(first):
        reason = "the camera is on another side of the plane, or it has another size,"
    elif not same_surface:
        reason = f"the plane has another size or gloss ({', '.join(PLANE_SURFACE)})"
    else:
        return
    raise InputError(
        f"`controls` backdrop: in {name} {reason} than in the first photograph; leave "
        "it out of backdrop.which, or sweep over the photographs"
    )
