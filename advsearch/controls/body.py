"""The `body` control: the joints and the animation of a rigged mesh, such as a person."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from torch import Tensor

from advsearch.extend import (
    Choice,
    Control,
    InputError,
    Parameter,
    Value,
    Values,
    assets,
    errors,
    geometry,
)


class BodyControl(Control):
    """A person's shape, pose and walk, or the joints and animations of a rigged file."""

    kind = "body"
    targets_mesh = True
    parameters = (*geometry.PERSON_PARAMETERS, geometry.TIME)
    choices = (
        Choice(
            "clip",
            None,
            "Name or number of the animation that `time` refers to; by default the "
            "first.",
        ),
    )

    @classmethod
    def declare_parameters(cls, settings: Iterable[str]) -> tuple[Parameter, ...]:
        """Return the parameters of the class, and those of a rig that are set.

        A name that no rig can have is left out here; `Control` rejects it.
        """
        known = {parameter.name for parameter in cls.parameters}
        declared = (
            geometry.find_rig_parameter(name) for name in settings if name not in known
        )
        return (
            *cls.parameters,
            *(parameter for parameter in declared if parameter is not None),
        )

    @property
    def rig(self) -> assets.MeshRig:
        """The rig of the mesh: its joints and animations.

        Raises:
            InputError: the mesh has no joints.
        """
        mesh = self.get_mesh(self.scene)
        if mesh.mesh.rig is None:
            raise InputError(
                f"`controls` {self.name}: {mesh.name} has no joints; use "
                "`object=person`, or a rigged file (.glb, "
                ".gltf, .vrm)"
            )
        return mesh.mesh.rig

    @property
    def clip(self) -> str | None:
        """The name of the animation that is played; None for no animation.

        The choice `clip` is the name or the index of an animation. Without it, the
        first animation is played if the user set its `time`, or no setting at all.

        Raises:
            UnknownNameError: the mesh has no animation of that name or number.
        """
        clips = self.rig.clips
        requested = self.choice_values["clip"]
        if requested is None:
            plays_time = geometry.TIME.name in self.specs or not self._settings
            return clips[0] if clips and plays_time else None
        return self._find_clip(requested)

    def _find_clip(self, requested: float | str) -> str:
        """Return the name of the animation that the choice `clip` states.

        Args:
            requested: name of an animation, or its index.

        Raises:
            UnknownNameError: the mesh has no animation of that name or number.
        """
        clips = self.rig.clips
        if requested in clips:
            return str(requested)
        index = _parse_clip_index(requested)
        if not 0 <= index < len(clips):
            raise errors.UnknownNameError(
                f"{self.name}.clip",
                str(requested),
                clips,
                f"Animations of {self.mesh_name}.",
            )
        return clips[index]

    def bind_parameters(self) -> None:
        """Check the parameters and the clip against the rig of the mesh.

        Raises:
            InputError: there is nothing to search.
            UnknownNameError: the rig has no such parameter, or no such clip.
        """
        known = [parameter.name for parameter in self.rig.parameters]
        self._check_parameters_exist(known)
        self._check_has_search(known)
        # The class has parameters of persons, which other rigs do not have.
        self.instance_parameters = tuple(
            parameter
            for parameter in self.instance_parameters
            if parameter.name in known
        )
        self.clip  # noqa: B018 - raises if there is no such animation
        super().bind_parameters()

    def _check_parameters_exist(self, known: Sequence[str]) -> None:
        """Raise UnknownNameError for a setting that is no parameter of the rig."""
        for name in self.specs:
            if name not in known:
                hint = f"It stands in `controls` {self.name}."
                raise errors.UnknownNameError(
                    f"parameter of {self.mesh_name}", name, known, hint
                )

    def _check_has_search(self, known: Sequence[str]) -> None:
        """Raise InputError if there are no settings, and no default range either.

        With settings, `make_space` reports if nothing is searched.
        """
        has_default_search = any(
            self.resolve_parameter(parameter).search for parameter in self.parameters
        )
        if not self._settings and not has_default_search:
            # for the message: a rotation of a joint about x, if the rig has one
            example = next((name for name in known if name.endswith(".x")), known[0])
            raise InputError(
                f"`controls` {self.name}: {self.mesh_name} has no animation to play; set "
                "ranges, as in "
                f"{self.name}={{{example}: [-20, 20]}}"
            )

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter with its default in the rig.

        A parameter that the rig does not have is not searched.
        """
        default = self.rig.defaults.get(parameter.name)
        if default is None:
            return replace(super().resolve_parameter(parameter), search=None)
        return replace(parameter, default=default)

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        return {f"{self.mesh_name}.offsets": self.rig.offsets(values, self.clip)}

    def compute_measurements(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        return dict(self.rig.get_measurements(values, self.clip))


def _parse_clip_index(requested: float | str) -> int:
    """Return the index of an animation that is a number, or -1 for a name.

    The index may be a string, such as "1".
    """
    if Parameter.is_number(requested) or str(requested).isdecimal():
        return int(requested)
    return -1
