"""People: dressed bodies with phenotype and joints, differentiable in torch.

A few shapes (MakeHuman's, CC0) are mixed, then posed by linear blend skinning, with
joint j at h_j:

    points = mean + sum_r c_r(gender, age, weight, height) b_r
    posed  = sum_j w_j (A_j Z_j (p - h_j) + t_j)

Z_j brings the arms of MakeHuman's rest pose down and the legs together: in this pose
all angles are 0. A_j are the rotations of joints about the body's axes (x ahead, y to
its left, z up), from the pelvis outwards. The lowest point stands on the ground.
`scenes/person.py` makes the data.

Walking adds the mean angles of a gait over its cycle, measured on adults (Winter 1991,
"The Biomechanics and Motor Control of Human Gait", chapter 2) and rounded, as a Fourier
series. With other body proportions the standing foot would hover, or the other foot
would go through the ground. So the legs are stretched or shortened a little, between
hip and ankle, until each foot in stance touches the ground.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from importlib import resources
from types import MappingProxyType

import numpy as np
import torch
from torch import Tensor

from advsearch.options import Value
from advsearch.scene.settings import Parameter

AGES = (10.0, 25.0, 90.0)  # years of MakeHuman's child, young and old
_make_body_parameter = partial(Parameter.moving, Parameter.GEOMETRIC)


def _make_joint_parameter(name: str, low: float, high: float, text: str) -> Parameter:
    """Return the parameter of a joint's angle, 0 by default."""
    return _make_body_parameter(
        name, unit="degrees", low=low, high=high, default=0.0, text=text
    )


PHENOTYPE = (
    _make_body_parameter(
        "height",
        unit="metres",
        low=1.0,
        high=2.1,
        default=1.7,
        text="Height without shoes and hair.",
        search=(1.5, 1.95),
    ),
    _make_body_parameter(
        "weight",
        unit="1",
        low=0.0,
        high=1.0,
        default=0.5,
        text="0 is thin, 0.5 average, 1 heavy; `body.mass` has the kilograms.",
        search=(0.2, 0.8),
    ),
    _make_body_parameter(
        "age",
        unit="years",
        low=10.0,
        high=90.0,
        default=35.0,
        text="Age; children are smaller by `height` only.",
        search=(18.0, 75.0),
    ),
    _make_body_parameter(
        "gender",
        unit="1",
        low=0.0,
        high=1.0,
        default=1.0,
        text="0 is a woman, 1 a man; values between are a mixture.",
        search=(0.0, 1.0),
    ),
)
WALK = (
    _make_body_parameter(
        "walk",
        unit="degrees",
        low=-3600.0,
        high=3600.0,
        default=0.0,
        text="Phase of a walk: the left heel strikes at 0, the right at 180.",
        search=(0.0, 360.0),
        periodic=True,
    ),
    _make_body_parameter(
        "stride",
        unit="1",
        low=0.0,
        high=1.3,
        default=0.0,
        text="Amplitude of the walk: 0 stands, 1 is an ordinary step.",
        search=(0.0, 1.0),
    ),
)
SPINE = (
    _make_joint_parameter(
        "spine", low=-20.0, high=60.0, text="Bend of the back, ahead."
    ),
    _make_joint_parameter(
        "spine_side", low=-25.0, high=25.0, text="Bend of the back to the left."
    ),
    _make_joint_parameter(
        "spine_turn", low=-35.0, high=35.0, text="Turn of the chest to the left."
    ),
    _make_joint_parameter("neck", low=-45.0, high=45.0, text="Nod of the head, ahead."),
    _make_joint_parameter(
        "neck_turn", low=-70.0, high=70.0, text="Turn of the head to the left."
    ),
)
LIMBS = (
    ("shoulder", -50.0, 170.0, "arm, raised ahead"),
    ("shoulder_out", -5.0, 160.0, "arm, raised to the side"),
    ("shoulder_turn", -60.0, 80.0, "arm, turned inwards about itself"),
    ("elbow", 0.0, 145.0, "forearm, bent"),
    ("hip", -25.0, 110.0, "thigh, raised ahead"),
    ("hip_out", -10.0, 40.0, "thigh, to the side"),
    ("knee", 0.0, 130.0, "calf, bent"),
    ("ankle", -35.0, 20.0, "foot, its toes up"),
)
"""Joints on both sides, with their limits in degrees."""
_JOINTS = tuple(
    _make_joint_parameter(
        f"{side}_{name}", low=low, high=high, text=f"{side.capitalize()} {text}."
    )
    for side in ("left", "right")
    for name, low, high, text in LIMBS
)
# All parameters of a person.
PARAMETERS = (*PHENOTYPE, *WALK, *SPINE, *_JOINTS)
GAIT = {
    "hip": (21, 15, 7, -3, -12, -19, -15, 1, 16, 22),
    "knee": (4, 16, 15, 8, 4, 10, 36, 60, 50, 15),
    "ankle": (0, -5, 3, 7, 10, 7, -15, -10, 0, 2),
    "shoulder": (-20, -17, -8, 4, 14, 18, 15, 6, -6, -16),
    "elbow": (8, 10, 15, 22, 27, 30, 27, 22, 15, 10),
}
"""Mean angles in degrees at each tenth of a cycle from the heel strike of the same
side.

The angle of the hip is that between the thigh and the vertical: 9 degrees less than
the angle to the pelvis, which is tilted ahead.
"""
STANCE = 216.0  # degrees of a cycle at which the toes of a foot leave the ground
LIFTED = 252.0  # degrees at which the foot is fully lifted
LOWERED = 324.0  # degrees at which it starts to come down; at 360 its heel strikes
# Stride from which on feet are fully corrected to touch the ground. For smaller strides
# the correction is proportional to the stride.
FULL_CONTACT_STRIDE = 0.1
STRAIGHT = {
    "upperarm": ("lowerarm", (0.02, 0.15, -1.0)),
    "lowerarm": ("hand", (0.16, 0.05, -1.0)),
    "thigh": ("calf", (0.0, 0.03, -1.0)),
    "calf": ("foot", (-0.03, 0.0, -1.0)),
}
"""For each bone the joint at its end, and its direction (x, y, z) on the left side if
all angles are 0.
"""


class Person:
    """A dressed person as a `MeshRig`.

    Attributes:
        data: the arrays of body.npz.
        defaults: default values of all parameters, by name.
        standing_points: (V, 3) the vertices at the defaults, meters.
        size: their largest extent, meters.
    """

    parameters = PARAMETERS
    clips = ()

    def __init__(
        self,
        data: Mapping[str, np.ndarray],
        defaults: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        """Convert the arrays to tensors, and pose the person at its defaults.

        Lengths become meters. Weights, which are stored as integers, are divided so
        that those of a point sum to 1.

        Args:
            data: arrays of body.npz by name, which `scenes/person.py` makes: `mean`
                (P, 3), points of the mean body in tenths of a millimeter; `basis`
                (R, P, 3), shapes that are added to it, in meters; `shares`
                (G, A, W, H, R), the factor of each shape in each extreme body;
                `stature` and `mass`, height and mass of each extreme body; `weights`
                (P, J), skinning weights; `index` (V,), the point of each vertex;
                `tags` and `points`, the name and the number of vertices of each piece
                of clothing; `bones` and `parents`.
            defaults: default values that replace those of `PARAMETERS`.
        """
        default_by_name = _get_defaults()
        self.data = data
        self.defaults = default_by_name | dict(defaults)
        self._bones = [str(bone) for bone in data["bones"]]
        self._parents = [int(parent) for parent in data["parents"]]
        self._tensors = _convert_body(data)
        left_points, right_points = _find_shoe_points(data)
        self._tensors["shoe_l"] = torch.from_numpy(left_points)
        self._tensors["shoe_r"] = torch.from_numpy(right_points)
        self.standing_points = self.pose({})
        self.size = float(
            (self.standing_points.amax(dim=0) - self.standing_points.amin(dim=0)).max()
        )

    def offsets(self, values: Mapping[str, Tensor], clip: str | None = None) -> Tensor:
        """Return how far vertices move from the standing person, (V, 3) in its size.

        Arguments are those of `pose`; there are no clips.
        """
        posed = self.pose(values)
        return (posed - self.standing_points.to(posed.device)) / self.size

    def pose(self, values: Mapping[str, Tensor]) -> Tensor:
        """Return the vertices (V, 3), in meters, of the person in a pose.

        The pelvis is above the origin, and the lowest vertex on z = 0.

        Args:
            values: scalar tensors by the names of `PARAMETERS`, such as "left_knee" in
                degrees. Those that are missing have this person's defaults.
        """
        number_by_name = self._complete_values(values)
        device = number_by_name["height"].device
        mixture, scale = self._mix_phenotype(number_by_name)
        points, joints = self._shape_body(mixture)
        rotations, translations = self._pose_bones(joints, add_walk(number_by_name))
        weights = self._get_tensor("weights", device)
        posed = skin_points(points, weights, rotations, translations)
        if bool(number_by_name["stride"] > 0.0):
            foot_rises = self._compute_leg_corrections(points, joints, number_by_name)
            posed = self._correct_legs(
                posed, rotations, translations, joints, foot_rises
            )
        pelvis = translations[0] + rotations[0] @ joints[0]  # of the first bone
        # below the pelvis, at the height of the lowest point
        origin = torch.cat([pelvis[:2], posed[:, 2].amin()[None]])
        point_of_vertex = self._get_tensor("index", device)
        return (scale * (posed - origin)).index_select(0, point_of_vertex)

    def _compute_leg_corrections(
        self, points: Tensor, joints: Tensor, number_by_name: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return by how many meters each foot has to rise to walk on the ground.

        With the correction, a foot in stance touches the ground. It is computed for the
        walk alone, without the joint angles that a user sets in addition. So a foot
        that the user raises stays raised.

        Args:
            points: (P, 3) points of the body in the rest pose.
            joints: (J, 3) positions of the joints in the rest pose.
            number_by_name: scalar tensors of all parameters.

        Returns:
            The rise of the left foot, "l", and of the right one, "r".
        """
        rotations, translations = self._pose_walk(joints, number_by_name)
        weights = self._get_tensor("weights", points.device)
        lowest_heights = dict[str, Tensor]()
        contacts = dict[str, Tensor]()
        # The right foot is half a cycle behind the left one. (`add_walk` has shifted
        # the joint angles already.)
        for side, phase_shift in (("l", 0.0), ("r", 180.0)):
            shoe = self._get_tensor(f"shoe_{side}", points.device)
            shoe_points = skin_points(
                points[shoe], weights[shoe], rotations, translations
            )
            lowest_heights[side] = shoe_points[:, 2].amin()
            contacts[side] = compute_contact(number_by_name["walk"] + phase_shift)
        # A small stride, with which a person almost stands, has a part of the
        # correction.
        fraction = (number_by_name["stride"] / FULL_CONTACT_STRIDE).clamp(max=1.0)
        return _compute_rises(lowest_heights, contacts, fraction)

    def _pose_walk(
        self, joints: Tensor, number_by_name: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return rotations (J, 3, 3) and translations (J, 3) of bones in a walk alone.

        The arguments are those of `_compute_leg_corrections`.
        """
        zero = torch.zeros_like(number_by_name["walk"])
        zero_angles = {parameter.name: zero for parameter in (*SPINE, *_JOINTS)}
        joint_angles = add_walk({**number_by_name, **zero_angles})
        return self._pose_bones(joints, joint_angles)

    def _correct_legs(
        self,
        posed: Tensor,
        rotations: Tensor,
        translations: Tensor,
        joints: Tensor,
        foot_rises: Mapping[str, Tensor],
    ) -> Tensor:
        """Return posed points (P, 3) with raised feet and legs stretched to them.

        A point of the foot rises by the foot's rise. A point of the leg rises by a
        fraction of it, from 0 at the hip to 1 at the ankle. Both are multiplied by the
        weight with which the bones of the foot, or of the leg, move the point. So the
        rest of the body does not move.

        Args:
            posed: (P, 3) points after skinning.
            rotations: (J, 3, 3) rotations of the bones.
            translations: (J, 3): a point p of a bone moves to rotation p + translation.
            joints: (J, 3) positions of the joints in the rest pose.
            foot_rises: meters by which the left ("l") and the right foot ("r") rise.
        """
        weights = self._get_tensor("weights", posed.device)
        rise = torch.zeros_like(posed[:, 2])
        for side, foot_rise in foot_rises.items():
            thigh, calf, foot = (
                self._bones.index(f"{bone}_{side}")
                for bone in ("thigh", "calf", "foot")
            )
            # heights of the joints at the upper ends of thigh and foot
            hip_height = _move_joint(thigh, rotations, translations, joints)[2]
            ankle_height = _move_joint(foot, rotations, translations, joints)[2]
            # 0 at the hip, 1 at the ankle
            below_hip = (hip_height - posed[:, 2]) / (hip_height - ankle_height)
            leg_weight = weights[:, thigh] + weights[:, calf]
            leg_weight = leg_weight * below_hip.clamp(0.0, 1.0)
            rise = rise + foot_rise * (self._weigh_foot(foot, weights) + leg_weight)
        return torch.cat([posed[:, :2], (posed[:, 2] + rise)[:, None]], dim=1)

    def _weigh_foot(self, foot: int, weights: Tensor) -> Tensor:
        """Return the weight (P,) with which all bones of a foot move each point.

        Args:
            foot: index of the foot's bone.
            weights: (P, J) weights of all bones.
        """
        foot_bones = self._find_foot_bones(foot)
        total = torch.zeros_like(weights[:, foot])
        for index in foot_bones:
            total = total + weights[:, index]
        return total

    def _find_foot_bones(self, foot: int) -> list[int]:
        """Return the bone of a foot and its children."""
        return [
            foot,
            *(index for index, parent in enumerate(self._parents) if parent == foot),
        ]

    def get_measurements(
        self, values: Mapping[str, Tensor], clip: str | None = None
    ) -> Mapping[str, Value]:
        """Return the mass of the person."""
        mixture, scale = self._mix_phenotype(self._complete_values(values))
        mass = (mixture * self._get_tensor("mass", mixture.device)).sum() * scale**3
        return {"mass": {"value": float(mass), "unit": "kg"}}

    def _complete_values(self, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the values of all parameters, defaults included."""
        reference = next(iter(values.values()), torch.zeros(()))
        return {
            name: values.get(name, reference.new_tensor(default))
            for name, default in self.defaults.items()
        }

    def _get_tensor(self, name: str, device: torch.device) -> Tensor:
        """Return one of the tensors on a device."""
        return self._tensors[name].to(device)

    def _mix_phenotype(
        self, number_by_name: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return the mixture of extreme bodies, and the scale to the requested height.

        Args:
            number_by_name: scalar tensors of the parameters; gender, age, weight and
                height are read.

        Returns:
            (G, A, W, H) weights of the extremes of gender, age, weight and height,
            which sum to 1; and the factor to the requested height.
        """
        gender = number_by_name["gender"]
        gender_weights = torch.stack([1.0 - gender, gender])
        age = number_by_name["age"]
        age_weights = compute_interpolation_weights(age, age.new_tensor(AGES))
        # The heaviness of a body is 0 if it is thin, 0.5 if average and 1 if heavy.
        heaviness = number_by_name["weight"]
        heaviness_weights = compute_interpolation_weights(
            heaviness, heaviness.new_tensor([0.0, 0.5, 1.0])
        )
        mixture = torch.einsum(
            "g,a,w->gaw", gender_weights, age_weights, heaviness_weights
        )
        return self._mix_heights(mixture, number_by_name["height"])

    def _mix_heights(
        self, mixture: Tensor, requested_height: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the mixture of extreme bodies, and the scale to the requested height.

        Args:
            mixture: (G, A, W) weights of the extremes of gender, age and weight.
            requested_height: scalar, meters.
        """
        # (H,) meters: the shortest, the average and the tallest body of the mixture
        statures = torch.einsum(
            "gaw,gawh->h", mixture, self._get_tensor("stature", mixture.device)
        )
        # A mixture has at least the height of the shortest extreme, and at most that of
        # the tallest. A body beyond these is scaled.
        clamped_height = torch.minimum(
            torch.maximum(requested_height, statures[0]), statures[2]
        )
        height_weights = compute_interpolation_weights(clamped_height, statures)
        mixed_height = (height_weights * statures).sum()
        return mixture[..., None] * height_weights, requested_height / mixed_height

    def _shape_body(self, mixture: Tensor) -> tuple[Tensor, Tensor]:
        """Return the points (P, 3) and the joints (J, 3) of a body at rest.

        Args:
            mixture: (G, A, W, H) weights of the extreme bodies of each gender, age,
                weight and height, which sum to 1.

        Returns:
            The points, and the joints in the order of bones.
        """
        device = mixture.device
        # A body is the mean body plus R displacements of all points, each times a
        # factor. Each extreme body has its R factors, "shares".
        shape_factors = torch.einsum(
            "gawh,gawhr->r", mixture, self._get_tensor("shares", device)
        )
        points = self._get_tensor("mean", device) + torch.einsum(
            "r,rpc->pc", shape_factors, self._get_tensor("basis", device)
        )
        n_joints = len(self._bones)  # they are the last points
        return points[:-n_joints], points[-n_joints:]

    def _pose_bones(
        self, joints: Tensor, angle_by_joint: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return the rotation (J, 3, 3) and translation (J, 3) of each bone.

        A point p moves to `rotation @ p + translation`. A bone is rotated first from
        the rest pose to the pose with all angles 0, in which limbs are straight; then
        by its own joint and by those of all its ancestors. Its joint goes where the
        parent bone moves it. Bones come after their parents, so that one pass is
        enough.

        Args:
            joints: (J, 3) positions of the joints in the rest pose.
            angle_by_joint: degrees by parameter, such as "left_knee".
        """
        straight_rotations = self._compute_straight_turns(joints)
        rotation_by_bone = compute_joint_turns(angle_by_joint)
        identity = torch.eye(3, device=joints.device, dtype=joints.dtype)
        joint_rotations = list[Tensor]()
        rotations = list[Tensor]()
        positions = list[Tensor]()
        for index, (bone, parent) in enumerate(
            zip(self._bones, self._parents, strict=True)
        ):
            rotation = rotation_by_bone.get(bone, identity)
            position = joints[index]
            if parent >= 0:  # the root has no parent
                rotation = joint_rotations[parent] @ rotation
                bone_vector = joints[index] - joints[parent]
                position = positions[parent] + rotations[parent] @ bone_vector
            joint_rotations.append(rotation)
            rotations.append(rotation @ straight_rotations.get(bone, identity))
            positions.append(position)
        # The translation is position - rotation joint, so that the joint itself moves
        # to its position.
        all_rotations = torch.stack(rotations)
        moved_joints = torch.einsum("jik,jk->ji", all_rotations, joints)
        return all_rotations, torch.stack(positions) - moved_joints

    def _compute_straight_turns(self, joints: Tensor) -> dict[str, Tensor]:
        """Return the rotations (3, 3) of limbs from the rest pose to all angles 0.

        A bone goes from its joint to the next one. Its rotation is the smallest that
        rotates it to its direction in `STRAIGHT`. Hands are rotated like the forearm,
        and then by 60 degrees about the vertical.

        Args:
            joints: (J, 3) positions in the rest pose.

        Returns:
            The rotations by bone, such as "thigh_l".
        """
        rotations = dict[str, Tensor]()
        for side, sign in (("l", 1.0), ("r", -1.0)):
            for bone, (end_joint, (x, y, z)) in STRAIGHT.items():
                start_point = joints[self._bones.index(f"{bone}_{side}")]
                end_point = joints[self._bones.index(f"{end_joint}_{side}")]
                # the right side is the mirror image of the left
                straight_direction = joints.new_tensor([x, sign * y, z])
                rotations[f"{bone}_{side}"] = compute_least_rotation(
                    end_point - start_point, straight_direction
                )
            hand_turn = make_axis_rotation("z", joints.new_tensor(sign * 60.0))
            rotations[f"hand_{side}"] = hand_turn @ rotations[f"lowerarm_{side}"]
        return rotations


def _get_defaults() -> dict[str, float]:
    """Return the defaults of `PARAMETERS` by name."""
    return {parameter.name: float(parameter.default) for parameter in PARAMETERS}


def _convert_body(data: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    """Return arrays of body.npz as tensors, in meters, with weights that sum to 1."""
    weight_sums = data["weights"].sum(axis=1, keepdims=True, dtype=np.float32)
    tensors = {
        "mean": torch.from_numpy(data["mean"].astype(np.float32) * 1e-4),
        "basis": torch.from_numpy(data["basis"].astype(np.float32)),
        "weights": torch.from_numpy(data["weights"] / weight_sums),
        "index": torch.from_numpy(data["index"].astype(np.int64)),
    }
    for name in ("shares", "stature", "mass"):
        tensors[name] = torch.from_numpy(data[name])
    return tensors


def _find_shoe_points(data: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the points of the left and of the right shoe."""
    tag_of_vertex = np.repeat(data["tags"], data["points"])
    is_shoe = tag_of_vertex == "shoes"
    shoe_points = np.unique(data["index"][is_shoe].astype(np.int64))
    is_left = data["mean"][shoe_points, 1] > 0  # y points to the person's left
    return shoe_points[is_left], shoe_points[~is_left]


def _move_joint(
    bone: int, rotations: Tensor, translations: Tensor, joints: Tensor
) -> Tensor:
    """Return the position (3,) of the joint at the upper end of a bone in a pose.

    The last three arguments are those of `Person._correct_legs`.
    """
    return rotations[bone] @ joints[bone] + translations[bone]


@lru_cache(maxsize=1)
def load_body() -> Mapping[str, np.ndarray]:
    """Load the arrays of body.npz."""
    content = (
        resources.files("advsearch.bundled") / "data/objects/person/body.npz"
    ).read_bytes()
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        return dict(file)


def compute_interpolation_weights(value: Tensor, nodes: Tensor) -> Tensor:
    """Return the weights (n,) of linear interpolation between rising nodes (n,).

    Between two nodes these have weights that sum to 1, and all others 0. Before the
    first and after the last node, that node has the weight 1.

    Args:
        value: () where to interpolate.
        nodes: (n,) rising positions of the nodes.
    """
    # how far the value is through each of the n - 1 intervals
    fraction = (value - nodes[:-1]) / (nodes[1:] - nodes[:-1])
    # 1 for intervals before the value, 0 for those after it. These constants, unlike
    # `clamp`, have no derivative at a node: there it is only that of the next interval.
    is_within = (fraction >= 0.0) & (fraction < 1.0)
    fraction = torch.where(is_within, fraction, (fraction >= 1.0).to(fraction.dtype))
    # for each node the fraction of the interval before it, and of that after it
    fraction_before = torch.cat([torch.ones_like(fraction[:1]), fraction])
    fraction_after = torch.cat([fraction, torch.zeros_like(fraction[:1])])
    return fraction_before - fraction_after


def add_walk(angle_by_name: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the angles of joints with those of a walk added, within their limits.

    `GAIT` has the angles of each joint over one cycle, which the stride multiplies. The
    right side is half a cycle behind the left.

    Args:
        angle_by_name: scalar tensors by parameter, degrees: "walk" is the phase of the
            cycle, and "stride" the factor. Other parameters, which are no angles, are
            returned as they are.
    """
    angle_by_joint = dict(angle_by_name)
    phase = torch.deg2rad(angle_by_name["walk"])
    stride = angle_by_name["stride"]
    for side, phase_shift in (("left", 0.0), ("right", np.pi)):
        for joint, angles_of_tenths in GAIT.items():
            swing = _compute_gait_angle(angles_of_tenths, phase, phase_shift)
            angle_by_joint[f"{side}_{joint}"] = (
                angle_by_joint[f"{side}_{joint}"] + stride * swing
            )
    # The chest turns against the pelvis by up to 5 degrees, to the left as the left
    # heel strikes.
    chest_turn = stride * 5.0 * torch.cos(phase)
    angle_by_joint["spine_turn"] = angle_by_joint["spine_turn"] + chest_turn
    return _limit_angles(angle_by_joint)


def _limit_angles(angle_by_joint: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the angles of joints within their limits, and other parameters as they
    are.
    """
    limits = {
        parameter.name: (parameter.low, parameter.high)
        for parameter in PARAMETERS
        if parameter.unit == "degrees" and not parameter.periodic
    }
    return {
        name: value.clamp(*limits[name]) if name in limits else value
        for name, value in angle_by_joint.items()
    }


def _compute_gait_angle(
    tenths: Sequence[int], phase: Tensor, phase_shift: float
) -> Tensor:
    """Return an angle of the gait, degrees, at a phase.

    The ten samples of a cycle are interpolated by their Fourier series, which is smooth
    and periodic. It has waves of the orders 0 to 5. The wave of the order 5 is left
    out, since ten samples do not determine its phase.

    Args:
        tenths: degrees at each tenth of the cycle.
        phase: () radians of the left side's cycle.
        phase_shift: radians, pi for the right side.
    """
    n_orders = 5  # 0 to 4
    waves = np.fft.rfft(tenths)[:n_orders] / len(tenths)
    swing = phase.new_tensor(float(waves[0].real))
    for order, wave in enumerate(waves[1:], 1):
        argument = order * (phase + phase_shift)
        # twice the real part: `rfft` has one of each pair of conjugate waves
        swing = swing + 2.0 * (
            float(wave.real) * torch.cos(argument)
            - float(wave.imag) * torch.sin(argument)
        )
    return swing


def compute_contact(phase: Tensor) -> Tensor:
    """Return the contact of a foot with the ground: 1 while it stands, 0 in its swing.

    Between these it is half a cosine wave. `phase` is in degrees of the foot's cycle
    from its heel strike: the foot stands up to `STANCE`, swings from `LIFTED` to
    `LOWERED`, and stands again at 360.
    """
    degrees = torch.remainder(phase, 360.0)
    # `lifted` rises from 0 to 1 while the foot is lifted, `lowered` while it is
    # lowered. Contact depends on their difference: 0 in stance, 1 in the swing, 0 at
    # 360.
    lifted = ((degrees - STANCE) / (LIFTED - STANCE)).clamp(0.0, 1.0)
    lowered = ((degrees - LOWERED) / (360.0 - LOWERED)).clamp(0.0, 1.0)
    return 0.5 + 0.5 * torch.cos(np.pi * (lifted - lowered))


def skin_points(
    points: Tensor, weights: Tensor, rotations: Tensor, translations: Tensor
) -> Tensor:
    """Return points (P, 3) moved with bones, by linear blend skinning.

    A bone moves a point p to `rotation @ p + translation`. The result is the weighted
    mean over all bones.

    Args:
        points: (P, 3) points at rest.
        weights: (P, J) weight of each bone; they sum to 1 for each point.
        rotations: (J, 3, 3) rotations of the bones.
        translations: (J, 3) translations of the bones.
    """
    # (P, 12): the weighted mean of the bones' rotations and translations
    blended = torch.einsum(
        "pj,jk->pk", weights, torch.cat([rotations.reshape(-1, 9), translations], dim=1)
    )
    return (
        torch.einsum("pik,pk->pi", blended[:, :9].reshape(-1, 3, 3), points)
        + blended[:, 9:]
    )


def _compute_rises(
    lowest: Mapping[str, Tensor], contact: Mapping[str, Tensor], fraction: Tensor
) -> dict[str, Tensor]:
    """Return by how many meters each foot has to rise to touch the ground.

    The ground is assumed at the mean height of both feet, weighted by contact. A foot
    with full contact is moved to the ground. A foot without contact stays at its
    height, or is moved up to the ground if it is below. With a partial contact, the
    foot keeps a proportional part of its height above the ground. A negative rise
    lowers the foot.

    Args:
        lowest: height in meters of the lowest point of each foot, "l" and "r".
        contact: contact of each foot with the ground, from 0 to 1. At least one foot
            has contact, since the feet are half a cycle apart.
        fraction: () fraction of the correction that is applied.
    """
    ground_height = (contact["l"] * lowest["l"] + contact["r"] * lowest["r"]) / (
        contact["l"] + contact["r"]
    )
    rises = dict[str, Tensor]()
    for side, height in lowest.items():
        height_above_ground = (height - ground_height).clamp(min=0.0)
        clearance = height_above_ground * (1.0 - contact[side])
        corrected_height = ground_height + clearance
        rises[side] = fraction * (corrected_height - height)
    return rises


def compute_joint_turns(angle: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return each bone's rotation (3, 3) against its parent, by the bone's name.

    Rotations are about the body's axes: x ahead, y to its left, z up. Bones that no
    parameter rotates are left out.

    Args:
        angle: degrees by parameter, such as "left_knee".
    """
    spine_rotation = _compute_spine_turn(angle)
    neck_turn = make_axis_rotation("z", angle["neck_turn"] / 2.0)
    neck_rotation = neck_turn @ make_axis_rotation("y", angle["neck"] / 2.0)
    rotations = {
        "spine_01": spine_rotation,
        "spine_02": spine_rotation,
        "spine_03": spine_rotation,
        "neck_01": neck_rotation,
        "head": neck_rotation,
    }
    rotations |= _compute_limb_turns(angle, "left", sign=1.0)
    rotations |= _compute_limb_turns(angle, "right", sign=-1.0)
    return rotations


def _compute_spine_turn(angle: Mapping[str, Tensor]) -> Tensor:
    """Return the rotation (3, 3) of each of three bones of the back.

    `angle` has degrees by parameter, of which each bone has a third.
    """
    spine, side, turn = (
        angle[name] / 3.0 for name in ("spine", "spine_side", "spine_turn")
    )
    return (
        make_axis_rotation("y", spine)
        @ make_axis_rotation("x", -side)  # "spine_side" bends to the left
        @ make_axis_rotation("z", turn)
    )


def _compute_limb_turns(
    angle_by_joint: Mapping[str, Tensor], side: str, sign: float
) -> dict[str, Tensor]:
    """Return the rotations (3, 3) of the bones of one arm and one leg, by bone.

    With all angles 0 a limb hangs down. A rotation about y (to the left) by a negative
    angle moves its lower end to the front. The knee bends to the back. A rotation about
    x (ahead) by a positive angle raises the left limb to its side.

    Args:
        angle_by_joint: degrees by parameter, such as "left_knee".
        side: "left" or "right".
        sign: 1 for the left, -1 for the right, which is its mirror image.
    """
    limb_angles = {joint: angle_by_joint[f"{side}_{joint}"] for joint, *_ in LIMBS}
    suffix = side[0]
    rotations = dict[str, Tensor]()
    shoulder_rotation = _make_swing_rotation(
        outwards=sign * limb_angles["shoulder_out"], forwards=limb_angles["shoulder"]
    )
    shoulder_turn = make_axis_rotation("z", -sign * limb_angles["shoulder_turn"])
    rotations[f"upperarm_{suffix}"] = shoulder_rotation @ shoulder_turn
    rotations[f"lowerarm_{suffix}"] = make_axis_rotation("y", -limb_angles["elbow"])
    rotations[f"thigh_{suffix}"] = _make_swing_rotation(
        outwards=sign * limb_angles["hip_out"], forwards=limb_angles["hip"]
    )
    rotations[f"calf_{suffix}"] = make_axis_rotation("y", limb_angles["knee"])
    rotations[f"foot_{suffix}"] = make_axis_rotation("y", -limb_angles["ankle"])
    return rotations


def _make_swing_rotation(outwards: Tensor, forwards: Tensor) -> Tensor:
    """Return the rotation (3, 3) of a hanging limb forwards, and then to the left.

    Args:
        outwards: degrees to the left side; negative to the right.
        forwards: degrees to the front.
    """
    return make_axis_rotation("x", outwards) @ make_axis_rotation("y", -forwards)


def make_axis_rotation(axis: str, degrees: Tensor) -> Tensor:
    """Return the right-handed rotation (3, 3) about an axis of the body."""
    cosine = torch.cos(torch.deg2rad(degrees))
    sine = torch.sin(torch.deg2rad(degrees))
    zeros = torch.zeros_like(cosine)
    ones = torch.ones_like(cosine)
    entries = {
        "x": (ones, zeros, zeros, zeros, cosine, -sine, zeros, sine, cosine),
        "y": (cosine, zeros, sine, zeros, ones, zeros, -sine, zeros, cosine),
        "z": (cosine, -sine, zeros, sine, cosine, zeros, zeros, zeros, ones),
    }
    return torch.stack(entries[axis]).reshape(3, 3)


def compute_least_rotation(begin: Tensor, end: Tensor) -> Tensor:
    """Return the smallest rotation (3, 3) from one direction to another.

    It is `I + V + V^2 / (1 + c)`, with V the matrix of the cross product with `a x b`,
    and c the dot product of the unit vectors a and b. They must not be opposite, and
    may have any length.
    """
    a = begin / begin.norm()
    b = end / end.norm()
    x, y, z = torch.linalg.cross(a, b)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    rotation: Tensor = torch.eye(3).to(a) + skew + skew @ skew / (1.0 + a @ b)
    return rotation
