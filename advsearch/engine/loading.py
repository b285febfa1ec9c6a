"""A scene as a person uses it from Python: load it, and ask it for `render(u, seed,
spp)`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence, ValuesView
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch.calls import helped
from advsearch.controls import (
    CONTROLS,
    Control,
    Space,
    gathered,
    make_control,
    make_space,
    settings_by_name,
)
from advsearch.distributions import OwnQuantiles, as_setting
from advsearch.errors import InputError
from advsearch.options import things_as_text, told
from advsearch.scene import settings
from advsearch.scene.assembly import Assembly, Motion
from advsearch.scene.assets import EnvironmentAsset, Floats, ObjectAsset
from advsearch.scene.camera_model import bundled, pinhole
from advsearch.scene.description import (
    ENVIRONMENT,
    NO_MAP,
    SceneDescription,
    check_ground,
    check_meshes,
    check_one_environment,
    describe,
)
from advsearch.scene.formation import (
    A_PIXEL,
    EVERYTHING,
    FEWEST,
    MOST,
    SAMPLER,
    ImageFormation,
    Moment,
    moments_of,
)
from advsearch.scene.grounds import on_its_ground
from advsearch.scene.headlamps import with_lamps
from advsearch.scene.importing.pictures import read_picture
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.renderer import Renderer
from advsearch.scene.settings import ORBIT_CAMERA, Given
from advsearch.settings import as_python, read_controls
from advsearch.trust.code import names_code
from advsearch.trust.foreign_code import plainly

Controls = str | Control | Sequence[str | Control] | Mapping[str, object]
"""One control or several, by name or instance; a mapping gives each name its settings
or its instance, and ``mitsuba:KEY`` a range.
"""

Texture = str | Path | npt.ArrayLike | Tensor

DEFAULT_RESOLUTION = 128


@final
@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """An object under an environment, with some parameters fixed. Made by `load_scene`.

    Attributes:
        description: the scene as data.
        only_here: whether it was made of something that no file and no command can
            name.
    """

    description: SceneDescription
    only_here: bool = False

    @names_code
    def renderer(
        self, controls: Controls, *, resolution: int | tuple[int, int] = DEFAULT_RESOLUTION, denoise: str = "oidn",
        seed: int = 0, estimators: Mapping[str, str] | None = None, sampler: str = SAMPLER,
    ) -> Renderer:  # fmt: skip
        """Return `render(u, seed, spp)` for the space of these controls.

        Args:
            controls: what u varies.
            resolution: side, or (height, width), in pixels.
            denoise: "oidn" or "none".
            seed: root of the noise; the `seed` of each call counts on from it.
            estimators: how derivatives are obtained, by "control.parameter", "control"
                or "*"; see `advsearch check`.
            sampler: "multijitter", or "independent", which has more noise; the first
                rounds sample counts up to products of two near numbers.

        Raises:
            InputError: a control is unknown or impossible in this scene, or an argument
                is out of range.
        """
        resolution = as_python(resolution)
        description = framed(self.description, resolution)
        with plainly():
            space = make_space(as_controls(controls), description)
            return make_renderer(
                description,
                space,
                resolution,
                denoise,
                seed,
                estimators,
                sampler=sampler,
            )

    def lit_by(self, environment: EnvironmentAsset | None) -> Scene:
        """Return the scene under another environment that was asked for; None for no
        map. Raises InputError where its ground shows a photograph, and there is none.
        """
        name = NO_MAP if environment is None else environment.name
        own = self.description
        check_ground(own.given_values, name)
        if environment is not None:
            check_one_environment(own.parts, f"`environment={name}`")
        lit = replace(
            own,
            environment=environment,
            environment_spec=name,
            given=own.given | {ENVIRONMENT},
        )
        return Scene(with_lamps(on_its_ground(lit)), self.only_here)

    def __getattr__(self, name: str) -> Any:
        if name == "render":
            raise AttributeError(
                "a scene has no `render`: advsearch.render(scene) makes a picture and "
                "asks a model, and "
                "scene.renderer(controls) returns render(u, seed, spp), which is "
                "differentiable"
            )
        raise AttributeError(f"'Scene' object has no attribute {name!r}")

    def __repr__(self) -> str:
        described = self.description
        fixed = "".join(
            f", {name}={value!r}"
            for name, value in sorted(described.given_values.items())
        )
        return (
            f"Scene({described.object_name!r}, {described.environment_name!r}{fixed})"
        )

    def with_texture(self, texture: Texture) -> Scene:
        """Return the scene with another texture of the object; see `load_scene`. Raises
        FileFormatError (the file is no picture), or InputError: it is no (h, w, 3)
        picture in [0, 1].
        """
        if isinstance(texture, (str, Path)):
            texels = read_picture(Path(texture), None)
        else:
            array = np.asarray(
                texture.detach().cpu() if isinstance(texture, Tensor) else texture
            )
            numbers: Floats = array.astype(np.float32) / (
                255.0 if array.dtype == np.uint8 else 1.0
            )
            if numbers.ndim != 3 or numbers.shape[2] != 3 or not numbers.size:
                raise InputError(
                    "texture: expected a picture (h, w, 3), got an array "
                    f"of shape {array.shape}"
                )
            if not (
                np.isfinite(numbers).all()
                and numbers.min() >= 0.0
                and numbers.max() <= 1.0
            ):
                raise InputError(
                    "texture: expected sRGB in [0, 1], or 8 bits as uint8, got "
                    f"{array.dtype} from {array.min():g} to "
                    f"{array.max():g}"
                )
            texels = np.ascontiguousarray(numbers)
        painted = replace(self.description.object, base_color=texels)
        return Scene(replace(self.description, object=painted), only_here=True)

    def with_settings(self, given: Given) -> Scene:
        """Return the scene with some of its parameters fixed to other values. Raises
        InputError: a name is unknown or a value out of range.
        """
        resolved = settings.resolve(given)
        own = self.description
        check_meshes(own, given)
        if own.camera_model is not None:
            own.camera_model.check_given(given)
        values = {**own.values, **{name: resolved[name] for name in given}}
        if "camera.elevation" in given:
            values["camera.height"] = None
        changed = on_its_ground(
            replace(own, values=values, given=own.given | set(given))
        )
        return Scene(with_lamps(changed), self.only_here)


@helped
@plainly()
def load_scene(
    object: str | Path | ObjectAsset, environment: str | Path | EnvironmentAsset | None = None, *,
    scene: str | Path | Mapping[str, object] | None = None, up: str | None = None, facing: str | None = None,
    size: float | None = None, unit: str | None = None, settings: Given | None = None, camera: str | None = None,
    texture: Texture | None = None,
    things: str | Mapping[str, object] | Sequence[str | Mapping[str, object]] | None = None,
) -> Scene:  # fmt: skip
    """Load a scene.

    Args:
        object: a bundled name ("mug"), a path to a mesh (`advsearch.files.MESHES`), or
            an asset.
        environment: a bundled name, a path to an .hdr or .exr file or to the .yaml file
            of a place, an asset; default "studio".
        scene: the file or, of Mitsuba, the dictionary (`mi.cornell_box()`) in which
            `object` is a node or the id of a shape; a file may as well be written
            before it: "scene.glb#chair", "box.xml#large-box".
        up: the up axis of a mesh file, "y" or "z"; by default what its format or else
            its shape says.
        facing: the axis of a mesh file that its front faces, "+x", "-x", "+y", "-y",
            "+z" or "-z"; by default what its format says: +z of glTF and VRM 1, -z of
            VRM 0, and +x of others. It is turned towards +x.
        size: of the object, its longest side in metres, 1e-4 to 1e4. Distances of the
            camera, paths of files and the height of a photograph are in metres where
            the size of the object is known, and in object sizes elsewhere.
        unit: of the coordinates of the object's file, "mm", "cm", "m" or "in", which
            gives it its size; by default bundled objects and glTF have one, and of
            other files it is not known.
        settings: parameters to fix, e.g. ``{"camera.azimuth": 130.0}``. The size of a
            picture belongs to none of them but to what makes it: `resolution` of
            `attack`, `sweep`, `render` and `Scene.renderer`.
        camera: a camera file (docs/cameras.md), "fisheye" or "equirectangular", whose
            lens the camera around the object then has; "dashcam" or "robot", mounted at
            its height above the ground; the name of a camera of a scene file; "orbit"
            or None for a pinhole.
        texture: of the object in place of its own: a picture file, or (h, w, 3) sRGB in
            [0, 1] or of 8 bits, row 0 on top; `result.artifacts["texture"]`, say.
        things: what stands beside the object, in metres from it, x forwards and y to
            its left: a text such as "car@12,3.5,heading=180; person@6,-2", or a list of
            such texts or of mappings, {"object": "car", "x": 12, "y": 3.5, "heading":
            180}; `size` (metres), `name` and `label` may be said too.

    Raises:
        InputError: a name is unknown, a file cannot be used, or a value is out of
            range.
    """
    if scene is not None and not isinstance(object, str):
        raise InputError(
            f"object: expected the name of a node or shape of the scene, got {object!r}"
        )
    plugins = scene if isinstance(scene, Mapping) else None
    described = describe(
        object if scene is None or plugins is not None else f"{scene}#{object}", environment, up=up, facing=facing,
        size=size, given=None if settings is None else as_python(settings), unit=unit, plugins=plugins,
        things=things_as_text(things),
    )  # fmt: skip
    named = all(
        given is None or isinstance(given, (str, Path))
        for given in (object, environment)
    )
    only_here = plugins is not None or not named
    loaded = Scene(
        described if camera is None else described.seen_by(camera), only_here
    )
    return loaded if texture is None else loaded.with_texture(texture)


def scene_as_settings(scene: Scene) -> dict[str, Any]:
    own = scene.description
    model = own.camera_model
    turned = own.camera == ORBIT_CAMERA
    named = (
        own.preset
        or (model.name if model is not None else "")
        or (None if turned else own.camera)
    )
    return {
        "object": own.object_name,
        "environment": own.environment_name,
        **{name: getattr(own, name) for name in ("up", "facing", "size", "unit")},
        "camera": own.rig_spec if own.rig else named,
        "things": own.things_spec or None,
        "set": own.given_values,
    }


def framed(
    description: SceneDescription, resolution: int | tuple[int, int]
) -> SceneDescription:
    """Return the scene as it is seen in a picture of this size (side, or height and
    width).
    """
    height, width = (
        (resolution, resolution) if isinstance(resolution, int) else resolution
    )
    model = description.camera_model
    remarks = description.remarks
    if description.number("camera.drops") > 0.0:
        if description.rig:
            raise InputError(
                "`set` camera.drops: of one camera, not of several; leave it out"
            )
        # drops are before a camera whose rays are worked out one by one
        if model is None or not model.name:
            model = pinhole(description.number("camera.fov"), width / height)
    if model is not None:
        model = bundled(width / height).get(model.name, model)
        remarks = tuple(dict.fromkeys((*remarks, *model.scaling((height, width)))))
    return replace(
        description, aspect=width / height, camera_model=model, remarks=remarks
    )


def make_renderer(
    description: SceneDescription, space: Space, resolution: int | tuple[int, int], denoise: str, seed: int,
    estimators: Mapping[str, str] | None = None, leave_out: Collection[str] = EVERYTHING, sampler: str = SAMPLER, *,
    differentiated: bool = True,
) -> Renderer:  # fmt: skip
    """Put a described scene, with what the space's controls need in it, into Mitsuba at
    one size.

    How fast coordinates move outlines is measured only where pictures are
    differentiated with respect to them: it takes a third of the time in which a scene
    is loaded and a few small pictures are rendered.
    """
    size = (resolution, resolution) if isinstance(resolution, int) else resolution
    description = space.scene or description
    if not description.lit:
        raise InputError(
            "environment: the scene has neither a map nor a lamp, so that every "
            "picture is black; give it one of the "
            "two, such as `controls=light`"
        )
    exposure = description.number("camera.exposure")
    gain = description.gain
    formation = ImageFormation(
        denoiser=denoise, sampler=sampler, exposure=exposure, resolution=size, gain=gain
    )
    scene = MitsubaScene(
        description, size, filter=formation.filter, leave_out=leave_out, sampler=sampler
    )
    exposed = any(space.exposure)
    if any(mount.later for mount in description.rig):
        moved = any(
            now is not then
            for now, then in zip(space.controls, space.later(1.0).controls, strict=True)
        )
        if exposed or not moved:
            wrong = (
                "have motion blur or a rolling shutter"
                if exposed
                else "show the same: nothing knows a time"
            )
            raise InputError(
                f"camera: the pictures of {description.rig_spec} are taken one after "
                "the other, and "
                f"{'can not ' if exposed else ''}{wrong}; "
                f"{'leave that out' if exposed else 'add a `path`'}"
            )
    motion = (
        Motion(description, size, scene.assembly) if differentiated or exposed else None
    )
    moments = (
        exposed_in(space, motion, scene.assembly, size[0])
        if exposed and motion is not None
        else ()
    )
    measured = motion if differentiated else None
    return Renderer(
        scene,
        space,
        formation,
        seed,
        motion=measured,
        estimators=estimators,
        moments=moments,
    )


A_FLASH = 8  # moments of each flash of a light
# configurations in which it is measured how far points move in the picture while it is
# taken
LOOKS = 64


def exposed_in(
    space: Space, motion: Motion, assembly: Assembly, height: int
) -> tuple[Moment, ...]:
    """Return the moments of an exposure, so many that no point goes far in the picture
    between two of them, and that light which flashes is seen on and off.
    """
    shutter, rolling = space.exposure
    duration = shutter + abs(rolling)
    moving = replace(
        space,
        controls=tuple(control for control in space.controls if any(control.exposure)),
    )
    ends = [moving.later(side * duration / 2.0) for side in (-1.0, 1.0)]
    draws = torch.rand(
        LOOKS, len(moving.start), generator=torch.Generator().manual_seed(0)
    )
    travelled = 0.0
    for u in draws:
        (before, seen), (after, still) = (
            motion.pixels(assembly(end.inputs(u))) for end in ends
        )
        moved = (after - before)[seen & still].norm(dim=1)
        travelled = max(travelled, float(moved.max()) if len(moved) else 0.0)
    flashes = max(control.flashes for control in space.controls) * duration
    count = min(
        max(FEWEST, math.ceil(A_PIXEL * travelled), math.ceil(A_FLASH * flashes)), MOST
    )
    offsets, rows, samples = moments_of(shutter, rolling, height, count)
    return tuple(
        Moment(space.later(float(at)), own, samples)
        for at, own in zip(offsets, rows, strict=True)
    )


def settings_of(controls: Controls) -> dict[str, dict[str, object]]:
    """Return settings by name, as a file holds them, for controls in whatever form they
    were given.

    Of a control that was given by its name it is what was said about it; of an
    instance, all of it.
    """
    asked = controls_by_name(controls)
    if not isinstance(controls, Mapping):
        as_controls(asked)
    return {
        name: given.settings() if isinstance(given, Control) else dict(given)
        for name, given in asked.items()
    }


def as_controls(controls: Controls) -> tuple[Control, ...]:
    """Return control instances for whatever form they were given in, in the order in
    which they were given.
    """
    asked = controls_by_name(controls)
    ready = {name: given for name, given in asked.items() if isinstance(given, Control)}
    named = gathered(
        {
            name: {} if isinstance(given, Control) else given
            for name, given in asked.items()
        }
    )
    for name in ready:
        if named[name]:
            raise InputError(
                f"controls: {name} is given twice, by an instance and by "
                "name; say all of it in one"
            )
    return tuple(
        ready.get(name) or make_control(name, given) for name, given in named.items()
    )


def controls_by_name(controls: Controls) -> dict[str, Control | Mapping[str, object]]:
    """Return instances and settings by name, in the order in which they were given."""
    asked: dict[str, object] = {}
    if isinstance(controls, Mapping):
        for name, given in controls.items():
            if isinstance(given, type) or (
                isinstance(given, Control) and given.name != name
            ):
                got = (
                    f"one that is called {given.name}"
                    if isinstance(given, Control)
                    else told(given)
                )
                raise InputError(
                    f"`controls` {name}: expected settings, or an instance of that "
                    f"name, got {got}; instances stand in "
                    "a list as well, controls=[...]"
                )
            if isinstance(given, Mapping) and not given.keys() & {
                "distribution",
                "choices",
                "range",
            }:
                asked[name] = {key: as_setting(value) for key, value in given.items()}
            else:
                asked[name] = given if isinstance(given, Control) else as_setting(given)
    else:
        listed: Iterable[object] = (
            controls if isinstance(controls, Iterable) else [controls]
        )
        for control in [controls] if isinstance(controls, (str, Control)) else listed:
            if not isinstance(control, (str, Control)):
                raise InputError(
                    "controls: expected names or Control instances, got "
                    f"{told(control)}"
                )
            named = (
                read_controls([control], "controls")
                if isinstance(control, str)
                else {control.name: control}
            )
            for name in named:
                if name in asked:
                    raise InputError(
                        f"controls: every instance needs a name of its own, got {name} "
                        "twice; write KIND:NAME, such as "
                        "light:key,light:fill"
                    )
            asked |= named
    ready = {name: given for name, given in asked.items() if isinstance(given, Control)}
    settings = settings_by_name({**asked, **dict.fromkeys(ready)})
    return {name: ready.get(name, given) for name, given in settings.items()}


def instances_in(controls: object) -> list[Control]:
    listed = controls.values() if isinstance(controls, Mapping) else controls
    listed = listed if isinstance(listed, (list, tuple, ValuesView)) else [listed]
    return [control for control in listed if isinstance(control, Control)]


def only_here(controls: Controls) -> list[str]:
    """Return the classes of controls that have no name by which a file or another
    process could ask for them, and the parameters that functions from Python draw.
    """
    classes = [
        type(control).__name__
        for control in instances_in(controls)
        if CONTROLS.get(control.kind) is not type(control)
    ]
    drawn = [
        f"{name if '.' in name else f'{name}.{parameter}'} (drawn by {value['name']})"
        for name, given in settings_of(controls).items()
        for parameter, value in given.items()
        if isinstance(value, OwnQuantiles)
    ]
    return [*classes, *drawn]
