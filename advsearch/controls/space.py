"""The space of a run: its controls, composed into one unit box.

Each control has a contiguous slice of the configuration u.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from advsearch.controls.base import (
    NO_INPUTS,
    AdjustedDefault,
    Control,
    Group,
    Value,
    to_file_name,
)
from advsearch.copies import is_package_class
from advsearch.errors import InputError
from advsearch.scene.description import ENVIRONMENT, SCENE_ENVIRONMENT, SceneDescription
from advsearch.scene.grounds import (
    CameraView,
    find_surroundings,
    get_camera_position,
    list_view_remarks,
    make_camera_view,
)
from advsearch.scene.things import list_camera_remarks

# number of views by which the range of a camera's positions is found; a power of two
N_CAMERA_VIEWS = 256


@dataclass(frozen=True, eq=False)
class Space:
    """Bound controls in the order of their slices of u.

    Attributes:
        controls: the controls. Without any, the scene is rendered unchanged.
        scene: the scene, with the parts that the controls need. None if the caller has
            it.
        adjusted_defaults: default values of the clean scene that controls exclude. The
            start has the nearest allowed values instead.
        environment_name: name of the environment that replaces that of the scene. None if
            the scene keeps its own.

    Raises:
        InputError: two controls have the same name.
    """

    controls: tuple[Control, ...]
    scene: SceneDescription | None = None
    adjusted_defaults: tuple[AdjustedDefault, ...] = ()
    environment_name: str | None = None

    def __post_init__(self) -> None:
        names = [control.name for control in self.controls]
        if len(set(names)) != len(names):
            raise InputError(
                "controls: every control needs a different name, got "
                f"{', '.join(names)}"
            )

    @property
    def start(self) -> Tensor:
        """(d,) float32 in [0, 1]: the configuration that leaves the scene as it is."""
        if not self.controls:
            return torch.zeros(0)
        return torch.cat([control.start for control in self.controls])

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """Groups of coordinates, one for each searched parameter, in the order of u.

        A group lists the gradient estimators that are valid for it (`valid`), of which
        one is chosen later. The estimator "material" is removed if the scene does not
        support it.
        """
        has_material_form = self._has_material_form()
        groups = []
        begin = 0
        for control in self.controls:
            for group in control.groups:
                valid = group.valid
                if not has_material_form:
                    valid = tuple(name for name in valid if name != "material")
                # A control does not know where its coordinates begin in u.
                positioned_group = replace(
                    group, control=control.name, begin=begin, valid=valid
                )
                groups.append(positioned_group)
                begin += group.size
        return tuple(groups)

    def _has_material_form(self) -> bool:
        """Return whether the gradient estimator "material" supports the scene.

        This adjoint follows the points of a moving surface (the material form of the
        derivative). It is not implemented for a medium, a backdrop, a lens, the edges of
        cut-out texels, normal maps, or meshes that emit light.
        """
        scene = self.scene
        if scene is None:
            return True
        unsupported_features = (  # false or None if the scene has none
            scene.backdrop,
            scene.thin_lens,
            scene.camera_model,
            scene.has_opacity,
            scene.has_normal_maps,
            scene.has_emission,
        )
        has_medium = any(part.volumetric for part in scene.parts)
        return not any(unsupported_features) and not has_medium

    @cached_property
    def coordinate_counts(self) -> list[int]:
        """Number of coordinates of each control."""
        return [len(control.start) for control in self.controls]

    def split_by_control(self, u: Tensor) -> list[tuple[Control, Tensor]]:
        """Return each control with its slice of u."""
        return list(zip(self.controls, u.split(self.coordinate_counts), strict=True))

    @cached_property
    def _evaluation_order(self) -> tuple[int, ...]:
        """Indices of the controls in the order in which they are evaluated.

        First come the controls that refine no inputs of others, then those that do;
        and in both groups, those with `on_top` come last. Otherwise they keep their
        order.
        """
        # False sorts before True, and `sorted` keeps the order of equal ranks.
        ranks = [(bool(control.refines), control.on_top) for control in self.controls]
        return tuple(sorted(range(len(ranks)), key=lambda index: ranks[index]))

    def inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Map u (d,) to scene inputs by name, by differentiable torch operations.

        Controls are evaluated in the order of `_evaluation_order`, in whatever order
        the user listed them.

        Raises:
            InputError: two controls set the same input, or one of another package sets
                an invalid one.
        """
        slices = u.split(self.coordinate_counts)
        merged = dict[str, Tensor]()
        first_setter = dict[str, str]()  # control that set each input first
        for index in self._evaluation_order:
            control = self.controls[index]
            new_inputs = control.inputs(slices[index], merged)
            # Only controls of users are checked: checks at every image take time, and
            # tests check the built-in ones.
            if not is_package_class(type(control)):
                _check_inputs(control.name, new_inputs)
            for name in new_inputs:
                _check_may_set(control, name, first_setter)
                first_setter.setdefault(name, control.name)
            merged = {**merged, **new_inputs}
        return merged

    def _with_previous_inputs(
        self, u: Tensor
    ) -> list[tuple[Control, Tensor, Mapping[str, Tensor]]]:
        """Return each control with its slice of u and the inputs of earlier controls.

        Controls are evaluated in another order than that of `controls`, in which they
        are returned. Only controls that refine inputs get those of earlier controls; the
        others get none. To save time, no inputs are computed after the last control that
        refines some.

        Args:
            u: (d,) the configuration.

        Returns:
            For each control: itself, its slice (k,) of u, and the inputs.
        """
        slices = u.detach().split(self.coordinate_counts)
        inputs_before = self._compute_inputs_before(slices)
        return [
            (control, slices[index], inputs_before[index])
            for index, control in enumerate(self.controls)
        ]

    def _compute_inputs_before(
        self, slices: Sequence[Tensor]
    ) -> dict[int, Mapping[str, Tensor]]:
        """Return the inputs of earlier controls, by the index of each control.

        Args:
            slices: slice (k,) of the configuration of each control.
        """
        last_refining = self._last_refining_position
        earlier_inputs = NO_INPUTS
        inputs_before = dict[int, Mapping[str, Tensor]]()
        for position, index in enumerate(self._evaluation_order):
            control = self.controls[index]
            inputs_before[index] = earlier_inputs if control.refines else NO_INPUTS
            if position < last_refining:  # a later control needs its inputs
                earlier_inputs = {
                    **earlier_inputs,
                    **control.inputs(slices[index], earlier_inputs),
                }
        return inputs_before

    @property
    def _last_refining_position(self) -> int:
        """The last position, in the order of evaluation, that refines inputs, or -1."""
        refining_positions = [
            position
            for position, index in enumerate(self._evaluation_order)
            if self.controls[index].refines
        ]
        return max(refining_positions, default=-1)

    def apply_to_image(self, u: Tensor, image: Tensor) -> Tensor:
        """Return the finished image (H, W, 3) sRGB as the controls change it.

        They change it one after the other, in the order of `controls`. The result is
        differentiable in u and the image.
        """
        for control, u_slice in self.split_by_control(u):
            image = control.apply_to_image(u_slice, image)
        return image

    def describe(
        self, u: Tensor, controls: Sequence[Control] | None = None
    ) -> dict[str, Value]:
        """Describe a configuration by a few named values with units.

        Args:
            u: (d,) the configuration.
            controls: only values of these controls are returned; None for all.
        """
        described = dict[str, Value]()
        for control, part, earlier_inputs in self._with_previous_inputs(u):
            if controls is None or control in controls:
                described |= control.describe(part, earlier_inputs)
        return described

    def get_printable_colors(self, u: Tensor) -> dict[str, Tensor]:
        """Return the searched colors that would have to be printed, by control.

        See `Control.get_printable_colors`; controls without any are left out.
        """
        colors_by_control = {}
        for control, part in self.split_by_control(u):
            colors = control.get_printable_colors(part)
            if colors is not None:
                colors_by_control[control.name] = colors
        return colors_by_control

    def get_numeric_values(self, u: Tensor) -> dict[str, Tensor]:
        """Return the numbers of a configuration by parameter ("pose.yaw").

        See `Control.get_numeric_values`.
        """
        return {
            f"{control.name}.{parameter}": value
            for control, part in self.split_by_control(u)
            for parameter, value in control.get_numeric_values(part).items()
        }

    @property
    def exposure(self) -> tuple[float, float]:
        """Seconds during which the shutter is open, and seconds to read out all rows.

        The latter is 0 without a rolling shutter, and negative if rows are read from
        the bottom. Both are those of the control with the longest exposure. Of equal
        exposures, the longest readout decides.
        """
        exposures = (control.exposure for control in self.controls)
        return max(
            exposures,
            key=lambda exposure: tuple(map(abs, exposure)),
            default=(0.0, 0.0),
        )

    def advance_time(self, seconds: float) -> Space:
        """Return the space at a time some seconds later.

        Controls that do not depend on time stay the same.
        """
        return replace(
            self,
            controls=tuple(control.advance_time(seconds) for control in self.controls),
        )

    def fix_first_controls(self, u: Tensor) -> Space:
        """Return the space with its first controls fixed at a configuration.

        Only the other controls have coordinates in it. If the fixed controls choose the
        environment, the space has its name.

        Args:
            u: (k,) coordinates of the first controls; k decides how many are fixed.

        Raises:
            InputError: no number of controls has k coordinates.
        """
        count = self._count_controls(u)
        first_controls = self.controls[:count]
        slices = u.split(self.coordinate_counts[:count])
        fixed = [
            _FixedControl(control, u_slice)
            for control, u_slice in zip(first_controls, slices, strict=True)
        ]
        chosen_environment = _find_chosen_environment(first_controls, self.scene, u)
        return replace(
            self,
            controls=(*fixed, *self.controls[count:]),
            environment_name=chosen_environment or self.environment_name,
        )

    def _count_controls(self, u: Tensor) -> int:
        """Return how many of the first controls have the coordinates (k,).

        Several counts may fit, as the next controls may have no coordinates. These are
        fixed anyway, so that the smallest count is enough.

        Raises:
            InputError: no number of controls has k coordinates.
        """
        sizes = self.coordinate_counts
        for count in range(len(sizes) + 1):
            if sum(sizes[:count]) == len(u):
                return count
        raise InputError(
            "controls: expected the coordinates of the first controls, which have "
            f"{sizes} coordinates, got {len(u)}"
        )

    def find_environment_name(self, values: Mapping[str, Value]) -> str | None:
        """Return the environment that replaces that of the scene in a configuration.

        Args:
            values: values that describe the configuration (`describe`).

        Returns:
            Name of the environment; None if the scene keeps its own.
        """
        for group in self.groups:
            if group.setting == ENVIRONMENT:  # the environment is searched
                name = str(values[group.name]["value"])
                return None if name == SCENE_ENVIRONMENT else name
        # It is the same in all configurations.
        return self.environment_name

    def list_notes(self, scene: SceneDescription) -> tuple[str, ...]:
        """Return notes for the user on the scene and on the views that are searched.

        A note says, for example, that the camera may enter a solid (see
        `advsearch.scene.grounds`).

        Args:
            scene: used if the space has no scene.
        """
        scene = self.scene or scene
        rotates_map = any(
            group.setting == "environment.rotation" for group in self.groups
        )
        has_solids = any(part.solids for part in scene.surrounding_meshes.values())
        views = self._find_noted_views(scene, has_solids)
        camera_positions = []
        if has_solids:
            camera_positions = [get_camera_position(view) for view in views]
        return (
            *scene.notes,
            *list_view_remarks(scene, views, rotates_map=rotates_map),
            *list_camera_remarks(scene, camera_positions),
        )

    def _find_noted_views(
        self, scene: SceneDescription, has_solids: bool
    ) -> list[CameraView]:
        """Return views of the camera if a note may depend on them, as they take time.

        `has_solids` states whether the surroundings have solids, such as walls.
        """
        has_limited_surroundings = find_surroundings(scene) is not None
        if has_solids or has_limited_surroundings:
            return self._sample_camera_views(scene)
        return []

    def _sample_camera_views(self, scene: SceneDescription) -> list[CameraView]:
        """Return views of the camera, spread over the range in which it may move.

        They are spread over the coordinates of the first control that sets the camera's
        pose. If none does, the only view is that of the scene.
        """
        for control, start in self.split_by_control(self.start):
            # To save time, inputs are not computed for controls without slots, such as a
            # texture: these do not move the camera. A fixed control has no slots either,
            # but the control that it wraps may move the camera.
            may_move_camera = bool(control.parameter_slots) or isinstance(
                control, _FixedControl
            )
            if may_move_camera and "camera.to_world" in control.inputs(start):
                return [
                    _view_of_inputs(scene, control.inputs(u))
                    for u in _spread_over_box(len(start))
                ]
        return [make_camera_view(scene)]

    def get_artifact_images(self, u: Tensor) -> dict[str, Tensor]:
        """Return the images to store with a configuration, by name without suffix."""
        artifacts = dict[str, Tensor]()
        for control, u_slice, earlier_inputs in self._with_previous_inputs(u):
            images = control.get_artifact_images(u_slice, earlier_inputs)
            for name, image in images.items():
                artifacts[to_file_name(name)] = image
        return artifacts

    def get_artifact_files(self, u: Tensor) -> dict[str, bytes]:
        """Return the other files to store with a configuration, by name."""
        artifacts = dict[str, bytes]()
        for control, u_slice, earlier_inputs in self._with_previous_inputs(u):
            files = control.get_artifact_files(u_slice, earlier_inputs)
            for name, content in files.items():
                artifacts[to_file_name(name)] = content
        return artifacts


def _check_may_set(
    control: Control, name: str, first_setter: Mapping[str, str]
) -> None:
    """Raise InputError if two controls set an input, and the later does not refine it.

    Args:
        control: the later control.
        name: name of the input.
        first_setter: control that set each input first, by the input's name.
    """
    if name not in first_setter or name in control.refines:
        return
    hint = ""
    if name.endswith(".base_color"):
        hint = "; one `texture` takes several materials"
    raise InputError(
        f"controls: two controls set {name}, {first_setter[name]} and "
        f"{control.name}; leave one of them out{hint}"
    )


def _spread_over_box(size: int) -> Tensor:
    """Return points (n, size) spread over the unit box, and the centers of its faces.

    A box without axes, of size 0, is a single point: the result is then (1, 0).
    """
    if not size:
        return torch.zeros(1, 0)
    spread = SobolEngine(size).draw(N_CAMERA_VIEWS)
    # In row i only axis i is at a bound: the center of a face.
    is_axis = torch.eye(size) > 0.0
    lower_face_centers = torch.where(is_axis, 0.0, 0.5)
    upper_face_centers = torch.where(is_axis, 1.0, 0.5)
    return torch.cat([spread, lower_face_centers, upper_face_centers])


def _view_of_inputs(
    scene: SceneDescription, inputs: Mapping[str, Tensor]
) -> CameraView:
    """Return the view of a scene by the camera in scene inputs."""
    to_world = inputs["camera.to_world"].detach().double().numpy()
    fov = float(inputs["camera.fov"]) if "camera.fov" in inputs else None
    return make_camera_view(scene, to_world, fov)


class _FixedControl(Control):
    """Wrap a bound control that is fixed at a configuration, and has no coordinates."""

    def __init__(self, control: Control, u: Tensor) -> None:
        """Fix a bound control.

        Args:
            control: control that is wrapped.
            u: (k,) coordinates of its configuration, which are passed to it.
        """
        self._control = control
        self._u = u
        # The attributes that a space reads, as those of the wrapped control. A fixed
        # control has no coordinates: see `bind_parameters`.
        self.name = control.name
        self.adjusted_defaults = control.adjusted_defaults
        self.on_top = control.on_top
        self.exposure = control.exposure
        self.flashes = control.flashes
        self.bind_parameters()

    def bind_parameters(self) -> None:
        self.start = torch.zeros(0)
        self.groups = ()

    @property
    def refines(self) -> frozenset[str]:
        return self._control.refines

    def inputs(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Tensor]:
        return self._control.inputs(self._u, earlier_inputs)

    def advance_time(self, seconds: float) -> Control:
        return _FixedControl(self._control.advance_time(seconds), self._u)

    def apply_to_image(self, u: Tensor, image: Tensor) -> Tensor:
        return self._control.apply_to_image(self._u, image)

    def describe(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Value]:
        return self._control.describe(self._u, earlier_inputs)

    def get_numeric_values(self, u: Tensor) -> Mapping[str, Tensor]:
        return self._control.get_numeric_values(self._u)


COLOR_MAP_SHAPE = (None, None, 3)
EXPECTED_INPUTS: Mapping[str, tuple[tuple[int | None, ...] | None, float, float]] = {
    "base_color": (COLOR_MAP_SHAPE, 0.0, 1.0),
    "color": ((3,), 0.0, 1.0),
    "data": (COLOR_MAP_SHAPE, 0.0, math.inf),
    "to_world": ((4, 4), -math.inf, math.inf),
    "offsets": ((None, 3), -math.inf, math.inf),
    "exposure": ((), -math.inf, math.inf),
    "shift": ((2,), -math.inf, math.inf),
    **dict.fromkeys(
        ("roughness", "metallic", "specular", "clearcoat"), (None, 0.0, 1.0)
    ),
}
"""Shape, lower and upper bound of scene inputs, by the last part of their names.

None stands for any size, or for any shape. The inputs of controls of other packages are
checked against it.
"""

# shape and bounds of inputs with other names
ANY_INPUT = (None, -math.inf, math.inf)
RANGE_TOLERANCE = 1e-4  # by how much rounding errors may exceed a bound


def _check_inputs(control: str, inputs: object) -> None:
    """Check the inputs that a control of another package sets.

    Args:
        control: name of the control.
        inputs: what it returned; it should be tensors by name, such as
            "object.base_color".

    Raises:
        InputError: it is something else, or a tensor has a wrong shape or range.
    """
    if not isinstance(inputs, Mapping):
        raise InputError(
            f"`controls` {control}: expected scene inputs by name, got "
            f"{type(inputs).__name__}"
        )
    for name, value in inputs.items():
        _check_input(f"`controls` {control}: {name}", name, value)


def _check_input(label: str, name: str, value: object) -> None:
    """Check one input that a control of another package sets.

    Args:
        label: how messages name the input.
        name: name of the input.
        value: what the control returned for it.

    Raises:
        InputError: it is no tensor, or has a wrong shape or range.
    """
    if not (isinstance(value, Tensor) and value.is_floating_point()):
        got = value.dtype if isinstance(value, Tensor) else type(value).__name__
        raise InputError(f"{label}: expected a tensor of real numbers, got {got}")
    # "base_color" for "object.base_color"
    last_part = name.rpartition(".")[2]
    shape, low, high = EXPECTED_INPUTS.get(last_part, ANY_INPUT)
    if shape is not None and not _has_shape(value, shape):
        raise InputError(
            f"{label}: expected shape "
            f"({_format_shape(shape)}), got {tuple(value.shape)}"
        )
    _check_range(label, value, low, high)


def _format_shape(shape: tuple[int | None, ...]) -> str:
    """Return the sides of a shape as Python writes them; N stands for any size."""
    sides = ", ".join("N" if side is None else str(side) for side in shape)
    if len(shape) == 1:
        sides += ","  # as Python writes a tuple of one
    return sides


def _has_shape(value: Tensor, shape: tuple[int | None, ...]) -> bool:
    """Return whether a tensor has a shape; None stands for any size."""
    if value.ndim != len(shape):
        return False
    return all(
        expected in (None, size)
        for expected, size in zip(shape, value.shape, strict=True)
    )


def _find_chosen_environment(
    controls: tuple[Control, ...], scene: SceneDescription | None, u: Tensor
) -> str | None:
    """Return the name of the environment that controls choose; None if they choose none.

    Args:
        controls: controls that are bound to the scene.
        scene: the scene.
        u: (d,) their configuration.
    """
    space = Space(controls, scene)
    return space.find_environment_name(space.describe(u))


def _check_range(label: str, value: Tensor, low: float, high: float) -> None:
    """Check that all elements of a tensor are in a range, but for rounding.

    Args:
        label: how the message names the tensor.
        value: tensor of any shape.
        low, high: bounds, perhaps infinite.

    Raises:
        InputError: an element is outside of the range, or NaN.
    """
    if not value.numel():
        return
    smallest, largest = (float(bound) for bound in value.detach().aminmax())
    # false if an element is NaN, because then both are NaN
    if low - RANGE_TOLERANCE <= smallest and largest <= high + RANGE_TOLERANCE:
        return
    # Without an upper bound, an element is NaN or below `low` (negative light).
    expected = "numbers"
    hint = ""
    if high < math.inf:
        expected = f"values from {low:g} to {high:g}"
        hint = f"; keep it inside, as by .clamp({low:g}, {high:g})"
    raise InputError(
        f"{label}: expected {expected} (colours are linear), got {smallest:.4g} to "
        f"{largest:.4g}{hint}"
    )
