"""The space of a run: its controls composed into one unit box, each a contiguous slice
of u.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from advsearch.controls.base import NOTHING, Control, Group, Moved, Value, file_name
from advsearch.copies import is_ours
from advsearch.errors import InputError
from advsearch.scene.description import ENVIRONMENT, OWN_MAP, SceneDescription
from advsearch.scene.grounds import CameraView, past, place_of, surroundings_of, view_of
from advsearch.scene.things import camera_remarks

# configurations of a camera, a power of two, by which is found how far it goes
VIEWS = 256


@dataclass(frozen=True, eq=False)
class Space:
    """Bound controls in the order of their slices. InputError: two instances have one
    name.
    """

    # at least none; an empty space renders the scene as it is
    controls: tuple[Control, ...]
    # with everything in it that the controls need; None leaves it to the caller
    scene: SceneDescription | None = None
    # values of the clean scene that the start has not, as a control leaves them out
    moved: tuple[Moved, ...] = ()
    # what lights the clean scene in the place of its own environment; None if nothing
    environment: str | None = None

    def __post_init__(self) -> None:
        names = [control.name for control in self.controls]
        if len(set(names)) != len(names):
            raise InputError(
                "controls: every instance needs a name of its own, got "
                f"{', '.join(names)}"
            )

    @property
    def start(self) -> Tensor:
        """(d,) float32 in [0, 1]: the configuration that leaves the scene as it is."""
        return (
            torch.cat([control.start for control in self.controls])
            if self.controls
            else torch.zeros(0)
        )

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """Every group of coordinates in the order of u, without an estimator yet.

        The material form knows neither a medium nor a backdrop nor a lens nor the edges
        of cut-outs, nor where a normal of a normal map turns away from the camera, nor
        meshes that emit light, so that it is not valid beside these.
        """
        scene = self.scene
        unknown = scene is not None and (
            any(
                (
                    scene.backdrop,
                    scene.thin_lens,
                    scene.camera_model,
                    scene.cut_out,
                    scene.normal_mapped,
                    scene.emits,
                )
            )
            or any(part.volumetric for part in scene.parts)
        )
        groups = []
        begin = 0
        for control in self.controls:
            for group in control.groups:
                valid = tuple(
                    name for name in group.valid if not (unknown and name == "material")
                )
                groups.append(
                    replace(group, control=control.name, begin=begin, valid=valid)
                )
                begin += group.size
        return tuple(groups)

    @cached_property
    def sizes(self) -> list[int]:
        """How many coordinates each control has."""
        return [len(control.start) for control in self.controls]

    def slices(self, u: Tensor) -> list[tuple[Control, Tensor]]:
        """Return each control with its slice of u."""
        return list(zip(self.controls, u.split(self.sizes), strict=True))

    @cached_property
    def _turns(self) -> tuple[int, ...]:
        """The numbers of the controls: those later that refine what others set, and
        last those that lie on top.
        """
        kinds = [(bool(control.refines), control.on_top) for control in self.controls]
        return tuple(sorted(range(len(kinds)), key=kinds.__getitem__))

    def inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Map u to scene inputs, by differentiable torch operations. Controls that
        refine what others set come later, and those that lie on top last, whatever the
        order in which they were asked for. Raises InputError: two controls set one
        input.
        """
        parts = u.split(self.sizes)
        merged = dict[str, Tensor]()
        set_by = dict[str, str]()
        for number in self._turns:
            control = self.controls[number]
            more = control.inputs(parts[number], merged)
            if not is_ours(type(control)):
                _check_inputs(control.name, more)
            for name in more:
                if name in merged and name not in control.refines:
                    both = f"{set_by[name]} and {control.name}"
                    hint = (
                        "; one `texture` takes several materials"
                        if name.endswith(".base_color")
                        else ""
                    )
                    raise InputError(
                        f"controls: two controls set {name}, {both}; "
                        f"leave one of them out{hint}"
                    )
                set_by.setdefault(name, control.name)
            merged = {**merged, **more}
        return merged

    def _among_others(
        self, u: Tensor
    ) -> list[tuple[Control, Tensor, Mapping[str, Tensor]]]:
        """Each control with its slice of u and the inputs of those before it, if it
        takes any.
        """
        parts = u.detach().split(self.sizes)
        so_far = NOTHING
        inputs_before = dict[int, Mapping[str, Tensor]]()
        last = max(
            (
                turn
                for turn, number in enumerate(self._turns)
                if self.controls[number].refines
            ),
            default=0,
        )
        for turn, number in enumerate(self._turns):
            control = self.controls[number]
            inputs_before[number] = so_far if control.refines else NOTHING
            if turn < last:
                so_far = {**so_far, **control.inputs(parts[number], so_far)}
        return [
            (control, parts[number], inputs_before[number])
            for number, control in enumerate(self.controls)
        ]

    def picture(self, u: Tensor, image: Tensor) -> Tensor:
        """Apply what controls do to the finished picture (H, W, 3) sRGB, in their
        order; differentiable in both.
        """
        for control, part in zip(self.controls, u.split(self.sizes), strict=True):
            image = control.picture(part, image)
        return image

    def describe(
        self, u: Tensor, controls: Sequence[Control] | None = None
    ) -> dict[str, Value]:
        """Say a configuration in a few named values with units: what some of the
        controls say of it, or else all.
        """
        return {
            name: value
            for control, part, so_far in self._among_others(u)
            if controls is None or control in controls
            for name, value in control.describe(part, so_far).items()
        }

    def printed(self, u: Tensor) -> dict[str, Tensor]:
        """Return the searched colours that a printer would print, by control; see
        `Control.printed`.
        """
        printed = (
            (control.name, control.printed(part)) for control, part in self.slices(u)
        )
        return {name: colors for name, colors in printed if colors is not None}

    def numbers(self, u: Tensor) -> dict[str, Tensor]:
        """Return the numbers of a configuration by parameter ("pose.yaw"); see
        `Control.numbers`.
        """
        return {
            f"{control.name}.{parameter}": value
            for control, part in self.slices(u)
            for parameter, value in control.numbers(part).items()
        }

    @property
    def exposure(self) -> tuple[float, float]:
        """Seconds that the shutter is open, and that rows are read in, below 0 from the
        bottom.
        """
        exposures = (control.exposure for control in self.controls)
        return max(
            exposures,
            key=lambda exposure: tuple(map(abs, exposure)),
            default=(0.0, 0.0),
        )

    def later(self, seconds: float) -> Space:
        """Return the space so many seconds later, where a control knows a time."""
        return replace(
            self, controls=tuple(control.later(seconds) for control in self.controls)
        )

    def holding(self, u: Tensor) -> Space:
        """Return the space whose first controls stay where a configuration u (d,) of as
        many has them, so that the others vary. Raises InputError: no number of controls
        has so many coordinates.
        """
        sizes = self.sizes
        count = next(
            (k for k in range(len(sizes) + 1) if sum(sizes[:k]) == len(u)), None
        )
        if count is None:
            raise InputError(
                "controls: expected the coordinates of whole controls, "
                f"of {sizes} each, got {len(u)}"
            )
        held = [
            _Held(control, part)
            for control, part in zip(
                self.controls, u.split(sizes[:count]), strict=False
            )
        ]
        chosen = Space(self.controls[:count], self.scene)
        lit_by = chosen.lit_by(chosen.describe(u)) or self.environment
        return replace(
            self, controls=(*held, *self.controls[count:]), environment=lit_by
        )

    def lit_by(self, values: Mapping[str, Value]) -> str | None:
        """Return what lights a configuration, by the values that describe it, in the
        place of the scene's environment; None if nothing does.
        """
        for group in self.groups:
            if group.setting == ENVIRONMENT:
                chosen = str(values[group.name]["value"])
                return None if chosen == OWN_MAP else chosen
        return self.environment

    def notes(self, scene: SceneDescription) -> tuple[str, ...]:
        """Return what a user should know of the scene (without one of its own, of
        `scene`), and of how far the camera goes in it: see `advsearch.scene.grounds`.
        """
        scene = self.scene or scene
        views = list[CameraView]()
        turns = any(group.setting == "environment.rotation" for group in self.groups)
        has_solids = any(part.solids for part in scene.around.values())
        if has_solids or surroundings_of(scene) is not None:
            views = [view_of(scene)]
            for control, start in self.slices(self.start):
                if not (
                    control.slots or isinstance(control, _Held)
                ) or "camera.to_world" not in control.inputs(start):
                    continue
                size = len(start)
                spread = SobolEngine(size).draw(VIEWS) if size else torch.zeros(1, 0)
                # of each coordinate
                ends = [
                    torch.where(torch.eye(size) > 0.0, end, 0.5) for end in (0.0, 1.0)
                ]
                inputs = [control.inputs(u) for u in torch.cat([spread, *ends])]
                views = [
                    view_of(
                        scene,
                        seen["camera.to_world"].detach().double().numpy(),
                        float(seen["camera.fov"]) if "camera.fov" in seen else None,
                    )
                    for seen in inputs
                ]
                break
        eyes = [place_of(view) for view in views] if has_solids else []
        return (
            *scene.notes,
            *past(scene, views, turns=turns),
            *camera_remarks(scene, eyes),
        )

    def artifacts(self, u: Tensor) -> dict[str, Tensor]:
        """Return the pictures worth keeping of a configuration, by file stem."""
        kept = (
            control.artifacts(part, so_far)
            for control, part, so_far in self._among_others(u)
        )
        return {
            file_name(name): image
            for pictures in kept
            for name, image in pictures.items()
        }

    def files(self, u: Tensor) -> dict[str, bytes]:
        """Return the other files worth keeping of a configuration, by name."""
        kept = (
            control.files(part, so_far)
            for control, part, so_far in self._among_others(u)
        )
        return {file_name(name): data for files in kept for name, data in files.items()}


class _Held(Control):
    """A bound control that stays at one configuration, and takes no coordinates."""

    def __init__(self, control: Control, at: Tensor) -> None:
        self._control = control
        self._at = at
        self.name = control.name
        self.moved = control.moved
        self.on_top = control.on_top
        self.exposure = control.exposure
        self.flashes = control.flashes
        self.fit()

    def fit(self) -> None:
        self.start = torch.zeros(0)
        self.groups = ()

    @property
    def refines(self) -> frozenset[str]:
        return self._control.refines

    def inputs(
        self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING
    ) -> dict[str, Tensor]:
        return self._control.inputs(self._at, so_far)

    def later(self, seconds: float) -> Control:
        return _Held(self._control.later(seconds), self._at)

    def picture(self, u: Tensor, image: Tensor) -> Tensor:
        return self._control.picture(self._at, image)

    def describe(
        self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING
    ) -> dict[str, Value]:
        return self._control.describe(self._at, so_far)

    def numbers(self, u: Tensor) -> Mapping[str, Tensor]:
        return self._control.numbers(self._at)


COLOR = (None, None, 3)
EXPECTED: Mapping[str, tuple[tuple[int | None, ...] | None, float, float]] = {
    "base_color": (COLOR, 0.0, 1.0),
    "color": ((3,), 0.0, 1.0),
    "data": (COLOR, 0.0, math.inf),
    "to_world": ((4, 4), -math.inf, math.inf),
    "offsets": ((None, 3), -math.inf, math.inf),
    "exposure": ((), -math.inf, math.inf),
    "shift": ((2,), -math.inf, math.inf),
    **dict.fromkeys(
        ("roughness", "metallic", "specular", "clearcoat"), (None, 0.0, 1.0)
    ),
}
"""Shape and range of the inputs that a control of another package may set, by the last
part of their names; None for any number or any shape.
"""

SLACK = 1e-4  # how far past its range rounding may put a colour


def _check_inputs(control: str, inputs: object) -> None:
    """Refuse what a control of another package sets, where that can't be."""
    if not isinstance(inputs, Mapping):
        raise InputError(
            f"`controls` {control}: expected scene inputs by name, got "
            f"{type(inputs).__name__}"
        )
    for name, value in inputs.items():
        if not (isinstance(value, Tensor) and value.is_floating_point()):
            got = value.dtype if isinstance(value, Tensor) else type(value).__name__
            raise InputError(
                f"`controls` {control}: {name}: expected a tensor of real "
                f"numbers, got {got}"
            )
        shape, low, high = EXPECTED.get(
            name.rpartition(".")[2], (None, -math.inf, math.inf)
        )
        if shape is not None and not (
            value.ndim == len(shape)
            and all(
                want in (None, side)
                for want, side in zip(shape, value.shape, strict=True)
            )
        ):
            wanted = ", ".join("N" if one is None else str(one) for one in shape) + (
                "," if len(shape) == 1 else ""
            )
            raise InputError(
                f"`controls` {control}: {name}: expected shape "
                f"({wanted}), got {tuple(value.shape)}"
            )
        least, most = (
            (float(one) for one in value.detach().aminmax())
            if value.numel()
            else (low, high)
        )
        if not (low - SLACK <= least and most <= high + SLACK):
            wanted = (
                f"values from {low:g} to {high:g}" if high < math.inf else "numbers"
            )
            hint = (
                f"; keep it inside, as by .clamp({low:g}, {high:g})"
                if high < math.inf
                else ""
            )
            raise InputError(
                f"`controls` {control}: {name}: expected {wanted} (linear, for a "
                f"colour), got {least:.4g} to {most:.4g}"
                f"{hint}"
            )
