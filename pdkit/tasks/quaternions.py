"""Quaternions (w, x, y, z) in float32, rounded at every step as ManiSkill 3 rounds them.

ManiSkill computes with batched torch tensors; for a single quaternion plain numpy numbers give the same bits in a twentieth
of the time. Square roots, sines, cosines and norms are torch's here too: theirs differ from numpy's in the last digit.
Source of the formulas: `mani_skill.utils.geometry.rotation_conversions`, `mani_skill.utils.structs.pose`.
"""
from __future__ import annotations

import numpy as np


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The rotation `b` followed by `a`, (4,)."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return np.array([
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ], np.float32)


def inverse(q: np.ndarray) -> np.ndarray:
    """The rotation back, (4,)."""
    return q * np.float32([1, -1, -1, -1])


def rotate(q: np.ndarray, point: np.ndarray) -> np.ndarray:
    """`point` (3,) turned by `q`."""
    return multiply(multiply(q, np.concatenate([[0], point], dtype=np.float32)), inverse(q))[1:]


def about_z(angle: np.float32) -> np.ndarray:
    """A turn by `angle`, radians, about the z axis, with w not negative."""
    import torch

    angle = torch.tensor([angle], dtype=torch.float32)
    cosine, sine = angle.cos(), angle.sin()
    # Half angles as ManiSkill's matrix_to_quaternion takes them, from the larger one: the roundings agree.
    if cosine >= 0:
        root = (1 + cosine + cosine + 1).sqrt()
        turn = (root**2 / (2 * root), 0, 0, (sine + sine) / (2 * root))
    else:
        root = (1 - cosine - cosine + 1).sqrt()
        turn = ((sine + sine).abs() / (2 * root), 0, 0, sine.sign() * root**2 / (2 * root))
    return np.array([float(part) for part in turn], np.float32)


def limited(turn: np.ndarray) -> np.ndarray:
    """A rotation vector (3,), shortened to length 1 where it is longer."""
    import torch

    length = torch.linalg.norm(torch.from_numpy(turn)[None], axis=1).numpy()[0]
    return turn * (np.float32(1) / length) if length > 1 else turn


def from_small_angles(angles: np.ndarray) -> np.ndarray:
    """Turns about the x, y and z axes by `angles` (3,) below a quarter turn, z first: Euler angles "XYZ", float32."""
    import torch

    angles = torch.from_numpy(angles)
    (cx, cy, cz), (sx, sy, sz) = torch.cos(angles).numpy(), torch.sin(angles).numpy()
    xy, yx = sx * sy, -cx * sy
    diagonal = cy * cz, xy * -sz + cx * cz, cx * cy
    w = torch.tensor([np.float32(1) + diagonal[0] + diagonal[1] + diagonal[2]]).sqrt().numpy()[0]
    x, y, z = (yx * -sz + sx * cz) + sx * cy, sy - (yx * cz + sx * sz), (xy * cz + cx * sz) - cy * -sz
    return np.array([w * w, x, y, z], np.float32) / (np.float32(2) * w)
