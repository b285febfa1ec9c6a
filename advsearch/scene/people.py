"""People: a dressed body with phenotype and joints, evaluated in torch, so that
gradients reach every number.

    points = mean + sum_r c_r(gender, age, weight, height) b_r          a few shapes (MakeHuman's, CC0)
    posed  = sum_j w_j (A_j Z_j (p - h_j) + t_j)                        linear blend skinning, joint j at h_j

Z_j brings the arms of MakeHuman's rest pose down and the legs together: there all
angles are 0. A_j are the joints' turns about the body's own axes (x ahead, y to its
left, z up), from the pelvis outwards. The lowest point stands on the ground.
`scenes/person.py` makes the data.

Walking adds a gait's mean angles over its cycle, as measured of adults (Winter 1991,
"The Biomechanics and Motor Control of Human Gait", chapter 2), rounded, by a Fourier
series. Whoever has other proportions would hover with the foot that they stand on, or
drag the other through the ground. So a walker's legs are made a little longer or
shorter, between hip and ankle, until each foot in stance touches the ground.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from functools import lru_cache, partial
from importlib import resources
from types import MappingProxyType

import numpy as np
import torch
from torch import Tensor

from advsearch.options import Value
from advsearch.scene.settings import Parameter

AGES = (10.0, 25.0, 90.0)  # years of MakeHuman's child, young and old
_of_body = partial(Parameter.moving, Parameter.GEOMETRIC)


def _angle(name: str, low: float, high: float, text: str) -> Parameter:
    return _of_body(name, "degrees", low, high, 0.0, text)


PHENOTYPE = (
    _of_body(
        "height", "metres", 1.0, 2.1, 1.7, "Height without shoes and hair.", (1.5, 1.95)
    ),
    _of_body(
        "weight",
        "1",
        0.0,
        1.0,
        0.5,
        "0 is thin, 0.5 average, 1 heavy; `body.mass` says kilograms.",
        (0.2, 0.8),
    ),
    _of_body(
        "age",
        "years",
        10.0,
        90.0,
        35.0,
        "Age; children are smaller by `height` only.",
        (18.0, 75.0),
    ),
    _of_body(
        "gender",
        "1",
        0.0,
        1.0,
        1.0,
        "0 is a woman, 1 a man, between them a mixture.",
        (0.0, 1.0),
    ),
)
WALK = (
    _of_body("walk", "degrees", -3600.0, 3600.0, 0.0, "Phase of a walk: the left heel "
                                                      "strikes at 0, the right at 180.",
             (0.0, 360.0), periodic=True),
    _of_body("stride", "1", 0.0, 1.3, 0.0, "How far the walk swings: 0 stands, 1 is an "
                                           "ordinary step.", (0.0, 1.0)),
)  # fmt: skip
SPINE = (
    _angle("spine", -20.0, 60.0, "Bend of the back, ahead."),
    _angle("spine_side", -25.0, 25.0, "Bend of the back to the left."),
    _angle("spine_turn", -35.0, 35.0, "Turn of the chest to the left."),
    _angle("neck", -45.0, 45.0, "Nod of the head, ahead."),
    _angle("neck_turn", -70.0, 70.0, "Turn of the head to the left."),
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
"""Joints that are there twice, with their limits in degrees."""
_JOINTS = tuple(
    _angle(f"{side}_{name}", low, high, f"{side.capitalize()} {text}.")
    for side in ("left", "right")
    for name, low, high, text in LIMBS
)
# everything that a person can be asked for
PARAMETERS = (*PHENOTYPE, *WALK, *SPINE, *_JOINTS)
GAIT = {
    "hip": (21, 15, 7, -3, -12, -19, -15, 1, 16, 22),
    "knee": (4, 16, 15, 8, 4, 10, 36, 60, 50, 15),
    "ankle": (0, -5, 3, 7, 10, 7, -15, -10, 0, 2),
    "shoulder": (-20, -17, -8, 4, 14, 18, 15, 6, -6, -16),
    "elbow": (8, 10, 15, 22, 27, 30, 27, 22, 15, 10),
}
"""Mean angles in degrees at each tenth of a cycle from the heel strike of the same
side. The hip's are those of the thigh against the vertical: 9 degrees less than against
the pelvis, which is tilted ahead.
"""
STANCE = 216.0
LIFTED = 252.0
LOWERED = 324.0
"""Degrees of a cycle at which the toes of a foot leave the ground, from which it
swings, and from which it comes down; at 360 its heel strikes.
"""
# from which on both feet are put onto the ground; below, in proportion
FULL_CONTACT_STRIDE = 0.1
STRAIGHT = {
    "upperarm": ("lowerarm", (0.02, 0.15, -1.0)), "lowerarm": ("hand", (0.16, 0.05, -1.0)),
    "thigh": ("calf", (0.0, 0.03, -1.0)), "calf": ("foot", (-0.03, 0.0, -1.0)),
}  # fmt: skip
"""Where a bone points with all angles 0, on the left side, and the joint at its end."""


class Person:
    """A dressed body, as `scenes/person.py` has sewn it: a `MeshRig`, whose largest
    extent at its defaults is `size` metres, of the arrays of body.npz.
    """

    parameters = PARAMETERS
    clips = ()

    def __init__(
        self,
        data: Mapping[str, np.ndarray],
        defaults: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        usual = {parameter.name: float(parameter.default) for parameter in PARAMETERS}
        self.data = data
        self.defaults = usual | dict(defaults)
        self._bones = [str(bone) for bone in data["bones"]]
        self._parents = [int(parent) for parent in data["parents"]]
        self._held = {
            "mean": torch.from_numpy(data["mean"].astype(np.float32) * 1e-4),
            "basis": torch.from_numpy(data["basis"].astype(np.float32)),
            "weights": torch.from_numpy(
                data["weights"]
                / data["weights"].sum(axis=1, keepdims=True, dtype=np.float32)
            ),
            "index": torch.from_numpy(data["index"].astype(np.int64)),
        } | {
            name: torch.from_numpy(data[name]) for name in ("shares", "stature", "mass")
        }
        is_shoe = np.repeat(data["tags"], data["points"]) == "shoes"
        shoe_points = np.unique(data["index"][is_shoe].astype(np.int64))
        is_left = data["mean"][shoe_points, 1] > 0
        self._held["shoe_l"] = torch.from_numpy(shoe_points[is_left])
        self._held["shoe_r"] = torch.from_numpy(shoe_points[~is_left])
        self.standing = self.posed({})
        self.size = float((self.standing.amax(dim=0) - self.standing.amin(dim=0)).max())

    def offsets(self, values: Mapping[str, Tensor], clip: str | None = None) -> Tensor:
        posed = self.posed(values)
        return (posed - self.standing.to(posed.device)) / self.size

    def posed(self, values: Mapping[str, Tensor]) -> Tensor:
        """Return the vertices (V, 3) in metres, the pelvis above the origin and the
        lowest on z = 0, of numbers without dimensions by the names of `PARAMETERS`; its
        own default where one is missing.
        """
        number = self._numbers(values)
        device = number["height"].device
        mixed, factor = self._phenotype(number)
        shares = torch.einsum("gawh,gawhr->r", mixed, self._on("shares", device))
        points = self._on("mean", device) + torch.einsum(
            "r,rpc->pc", shares, self._on("basis", device)
        )
        joints = points[-len(self._bones) :]
        points = points[: -len(self._bones)]
        turns, shifts = self._skeleton(joints, walked(number))
        weights = self._on("weights", device)
        posed = skinned(points, weights, turns, shifts)
        if bool(number["stride"] > 0.0):
            raised = self._leg_corrections(points, joints, number)
            posed = self._with_legs_corrected(posed, turns, shifts, joints, raised)
        pelvis = shifts[0] + turns[0] @ joints[0]
        floor = torch.cat([pelvis[:2], posed[:, 2].amin()[None]])
        return (factor * (posed - floor)).index_select(0, self._on("index", device))

    def _leg_corrections(
        self, points: Tensor, joints: Tensor, number: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return by how much each foot has to rise, by its side, so that a foot in
        stance is on the ground.

        They are those of the walk alone: what else is asked of the joints is left as it
        is.
        """
        walk_alone = {
            **number,
            **{
                one.name: torch.zeros_like(number["walk"]) for one in (*SPINE, *_JOINTS)
            },
        }
        turns, shifts = self._skeleton(joints, walked(walk_alone))
        weights = self._on("weights", points.device)
        lowest = dict[str, Tensor]()
        contact = dict[str, Tensor]()
        for side, begin in (("l", 0.0), ("r", 180.0)):
            shoe = self._on(f"shoe_{side}", points.device)
            lowest[side] = skinned(points[shoe], weights[shoe], turns, shifts)[
                :, 2
            ].amin()
            contact[side] = contact_of(number["walk"] + begin)
        ground = (contact["l"] * lowest["l"] + contact["r"] * lowest["r"]) / (
            contact["l"] + contact["r"]
        )
        amount = (number["stride"] / FULL_CONTACT_STRIDE).clamp(max=1.0)
        raised = dict[str, Tensor]()
        for side, height in lowest.items():
            clearance = (height - ground).clamp(min=0.0) * (1.0 - contact[side])
            raised[side] = amount * (ground + clearance - height)
        return raised

    def _with_legs_corrected(
        self,
        posed: Tensor,
        turns: Tensor,
        shifts: Tensor,
        joints: Tensor,
        raised: Mapping[str, Tensor],
    ) -> Tensor:
        """Return posed points (P, 3) whose feet have risen, and what is between hip and
        ankle in proportion.
        """
        weights = self._on("weights", posed.device)
        rise = torch.zeros_like(posed[:, 2])
        for side, foot_rise in raised.items():
            thigh, calf, foot = (
                self._bones.index(f"{bone}_{side}")
                for bone in ("thigh", "calf", "foot")
            )
            hip_height = (turns[thigh] @ joints[thigh] + shifts[thigh])[2]
            ankle_height = (turns[foot] @ joints[foot] + shifts[foot])[2]
            below_hip = (
                (hip_height - posed[:, 2]) / (hip_height - ankle_height)
            ).clamp(0.0, 1.0)
            of_foot = sum(weights[:, index] for index in self._foot_bones(foot))
            rise = rise + foot_rise * (
                of_foot + (weights[:, thigh] + weights[:, calf]) * below_hip
            )
        return torch.cat([posed[:, :2], (posed[:, 2] + rise)[:, None]], dim=1)

    def _foot_bones(self, foot: int) -> list[int]:
        return [
            foot,
            *(index for index, parent in enumerate(self._parents) if parent == foot),
        ]

    def measured(
        self, values: Mapping[str, Tensor], clip: str | None = None
    ) -> Mapping[str, Value]:
        mixed, factor = self._phenotype(self._numbers(values))
        return {
            "mass": {
                "value": float(
                    (mixed * self._on("mass", mixed.device)).sum() * factor**3
                ),
                "unit": "kg",
            }
        }

    def _numbers(self, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
        some = next(iter(values.values()), torch.zeros(()))
        return {
            name: values.get(name, some.new_tensor(default))
            for name, default in self.defaults.items()
        }

    def _on(self, name: str, device: torch.device) -> Tensor:
        return self._held[name].to(device)

    def _phenotype(self, number: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """How much of each extreme (G, A, W, H) there is, and the factor that is left
        to the height asked for.
        """
        gender = torch.stack([1.0 - number["gender"], number["gender"]])
        age = hats(number["age"], number["age"].new_tensor(AGES))
        weight = hats(number["weight"], number["weight"].new_tensor([0.0, 0.5, 1.0]))
        mixed = torch.einsum("g,a,w->gaw", gender, age, weight)
        statures = torch.einsum("gaw,gawh->h", mixed, self._on("stature", mixed.device))
        asked = number["height"]
        height = hats(
            torch.minimum(torch.maximum(asked, statures[0]), statures[2]), statures
        )
        return mixed[..., None] * height, asked / (height * statures).sum()

    def _skeleton(
        self, joints: Tensor, angle: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Turn (J, 3, 3) and shift (J, 3) of each bone: p goes to `turn @ p +
        shift`.
        """
        straight = dict[str, Tensor]()
        own = turned(angle)
        # each bone that has a direction where all angles are 0
        for side, sign in (("l", 1.0), ("r", -1.0)):
            for bone, (end, (x, y, z)) in STRAIGHT.items():
                begin, stop = (
                    joints[self._bones.index(f"{name}_{side}")] for name in (bone, end)
                )
                straight[f"{bone}_{side}"] = least_turn(
                    stop - begin, joints.new_tensor([x, sign * y, z])
                )
            straight[f"hand_{side}"] = (
                about("z", joints.new_tensor(sign * 60.0))
                @ straight[f"lowerarm_{side}"]
            )
        same = torch.eye(3, device=joints.device, dtype=joints.dtype)
        carried = list[Tensor]()
        turns = list[Tensor]()
        places = list[Tensor]()
        for number, (bone, parent) in enumerate(
            zip(self._bones, self._parents, strict=True)
        ):
            turn = own.get(bone, same)
            carried.append(turn if parent < 0 else carried[parent] @ turn)
            turns.append(carried[-1] @ straight.get(bone, same))
            reach = joints[number] - joints[parent]
            places.append(
                joints[number] if parent < 0 else places[parent] + turns[parent] @ reach
            )
        stacked = torch.stack(turns)
        return stacked, torch.stack(places) - torch.einsum(
            "jik,jk->ji", stacked, joints
        )


@lru_cache(maxsize=1)
def body_data() -> Mapping[str, np.ndarray]:
    content = (
        resources.files("advsearch.bundled") / "data/objects/person/body.npz"
    ).read_bytes()
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        return dict(file)


def hats(value: Tensor, at: Tensor) -> Tensor:
    """Return how much of each of some rising places (n,) a number has, by linear
    interpolation between them; its sum is 1 from the first place to the last.
    """
    share = (value - at[:-1]) / (at[1:] - at[:-1])
    # at a place the derivative is that of one side, not the sum of both
    within = (share >= 0.0) & (share < 1.0)
    share = torch.where(within, share, (share >= 1.0).to(share.dtype))
    return torch.cat([torch.ones_like(share[:1]), share]) - torch.cat(
        [share, torch.zeros_like(share[:1])]
    )


def walked(number: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the angles with those of the walk added, within each joint's limits."""
    angle = dict(number)
    phase = torch.deg2rad(number["walk"])
    stride = number["stride"]
    for side, begin in (("left", 0.0), ("right", np.pi)):
        for joint, tenths in GAIT.items():
            waves = np.fft.rfft(tenths)[:5] / len(tenths)
            swing = phase.new_tensor(float(waves[0].real))
            for order, wave in enumerate(waves[1:], 1):
                at = order * (phase + begin)
                swing = swing + 2.0 * (
                    float(wave.real) * torch.cos(at) - float(wave.imag) * torch.sin(at)
                )
            angle[f"{side}_{joint}"] = angle[f"{side}_{joint}"] + stride * swing
    angle["spine_turn"] = angle["spine_turn"] + stride * 5.0 * torch.cos(phase)
    joints = (
        parameter
        for parameter in PARAMETERS
        if parameter.unit == "degrees" and not parameter.periodic
    )
    limits = {joint.name: (joint.low, joint.high) for joint in joints}
    return {
        name: value.clamp(*limits[name]) if name in limits else value
        for name, value in angle.items()
    }


def contact_of(phase: Tensor) -> Tensor:
    """Return how much a foot is held to the ground, 0 to 1, at degrees of its cycle
    from its heel strike.
    """
    degrees = torch.remainder(phase, 360.0)
    lifted = ((degrees - STANCE) / (LIFTED - STANCE)).clamp(0.0, 1.0)
    lowered = ((degrees - LOWERED) / (360.0 - LOWERED)).clamp(0.0, 1.0)
    return 0.5 + 0.5 * torch.cos(np.pi * (lifted - lowered))


def skinned(points: Tensor, weights: Tensor, turns: Tensor, shifts: Tensor) -> Tensor:
    """Return points (P, 3), moved with bones (J) in the proportions of their weights
    (P, J): linear blend skinning.
    """
    moved = torch.einsum(
        "pj,jk->pk", weights, torch.cat([turns.reshape(-1, 9), shifts], dim=1)
    )
    return (
        torch.einsum("pik,pk->pi", moved[:, :9].reshape(-1, 3, 3), points)
        + moved[:, 9:]
    )


def turned(angle: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return each bone's own turn (3, 3) of joint angles in degrees."""
    spine, side, turn = (
        angle[name] / 3.0 for name in ("spine", "spine_side", "spine_turn")
    )
    bend = about("y", spine) @ about("x", -side) @ about("z", turn)
    nod = about("z", angle["neck_turn"] / 2.0) @ about("y", angle["neck"] / 2.0)
    turns = {
        "spine_01": bend,
        "spine_02": bend,
        "spine_03": bend,
        "neck_01": nod,
        "head": nod,
    }
    for name, left in (("left", 1.0), ("right", -1.0)):
        limb = {joint: angle[f"{name}_{joint}"] for joint, *_ in LIMBS}
        end = name[0]
        raised = about("x", left * limb["shoulder_out"]) @ about("y", -limb["shoulder"])
        turns[f"upperarm_{end}"] = raised @ about("z", -left * limb["shoulder_turn"])
        turns[f"lowerarm_{end}"] = about("y", -limb["elbow"])
        turns[f"thigh_{end}"] = about("x", left * limb["hip_out"]) @ about(
            "y", -limb["hip"]
        )
        turns[f"calf_{end}"] = about("y", limb["knee"])
        turns[f"foot_{end}"] = about("y", -limb["ankle"])
    return turns


def about(axis: str, degrees: Tensor) -> Tensor:
    """Return the turn (3, 3) about an axis of the body, right-handed."""
    c = torch.cos(torch.deg2rad(degrees))
    s = torch.sin(torch.deg2rad(degrees))
    zero = torch.zeros_like(c)
    one = torch.ones_like(c)
    rows = {
        "x": (one, zero, zero, zero, c, -s, zero, s, c),
        "y": (c, zero, s, zero, one, zero, -s, zero, c),
        "z": (c, -s, zero, s, c, zero, zero, zero, one),
    }
    return torch.stack(rows[axis]).reshape(3, 3)


def least_turn(begin: Tensor, end: Tensor) -> Tensor:
    """Return the smallest turn (3, 3) from one direction to another, that is not
    opposite: `I + V + V^2 / (1 + c)`.
    """
    a = begin / begin.norm()
    b = end / end.norm()
    x, y, z = torch.linalg.cross(a, b)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    rotation: Tensor = torch.eye(3).to(a) + skew + skew @ skew / (1.0 + a @ b)
    return rotation
