"""Rotations as matrices, from angles and from rotation vectors; differentiable."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def euler(yaw: Tensor, pitch: Tensor, roll: Tensor) -> Tensor:
    """Return `Rz(yaw) Ry(pitch) Rx(roll)`, angles in degrees, as a (3, 3) matrix; differentiable."""
    zero, one = torch.zeros_like(yaw), torch.ones_like(yaw)
    (cz, sz), (cy, sy), (cx, sx) = ((torch.cos(a), torch.sin(a)) for a in map(torch.deg2rad, (yaw, pitch, roll)))
    about_z = torch.stack([cz, -sz, zero, sz, cz, zero, zero, zero, one]).reshape(3, 3)
    about_y = torch.stack([cy, zero, sy, zero, one, zero, -sy, zero, cy]).reshape(3, 3)
    about_x = torch.stack([one, zero, zero, zero, cx, -sx, zero, sx, cx]).reshape(3, 3)
    return about_z @ about_y @ about_x


def rotation_vector(degrees: Tensor) -> Tensor:
    """Return the rotation about the axis of a vector by its length in degrees, (3,) to (3, 3).

    Rodrigues' formula with guarded series, so that value and derivative are right at zero, where the plain formula is
    NaN.
    """
    vector = degrees * (math.pi / 180.0)
    square = vector.square().sum()
    small = square < 1e-6
    angle = torch.sqrt(torch.where(small, torch.ones_like(square), square))
    sine = torch.where(small, 1.0 - square / 6.0, torch.sin(angle) / angle)
    cosine = torch.where(small, 0.5 - square / 24.0, (1.0 - torch.cos(angle)) / angle.square())
    x, y, z = vector
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    return torch.eye(3).to(degrees) + sine * cross + cosine * (cross @ cross)
