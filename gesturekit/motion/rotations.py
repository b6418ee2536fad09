"""Rotations as arrays: quaternions, matrices, Euler angles, rotation vectors and 6D.

Quaternions have unit length and the order x, y, z, w of scipy; q and -q are the same rotation. All
functions work on the last axis and broadcast over the others.
"""

from __future__ import annotations

import warnings

import numpy as np

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
_TINY = 1e-12


def normalize_quaternions(q: np.ndarray) -> np.ndarray:
    """(..., 4) scaled to length 1; a zero quaternion becomes the identity."""
    q = np.asarray(q, dtype=np.float64)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(length > _TINY, q / np.maximum(length, _TINY), IDENTITY)


def multiply_quaternions(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(..., 4) Hamilton product of quaternions (..., 4): rotation by `b`, then by `a`."""
    a, b = (np.moveaxis(np.asarray(q, dtype=np.float64), -1, 0) for q in (a, b))
    return np.stack(product_components(a, b), axis=-1)


def product_components(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the four components (...) of `multiply_quaternions`, from components (4, ...)."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def invert_quaternions(q: np.ndarray) -> np.ndarray:
    """(..., 4) inverse rotations of `q` (..., 4)."""
    return np.asarray(q, dtype=np.float64) * np.array([-1.0, -1.0, -1.0, 1.0])


def rotate_vectors(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(..., 3) vectors `v` (..., 3) rotated by quaternions `q` (..., 4)."""
    q, v = (np.moveaxis(np.asarray(values, dtype=np.float64), -1, 0) for values in (q, v))
    return np.stack(rotated_components(q, v), axis=-1)


def rotated_components(q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the components (...) of `rotate_vectors`, from components (4, ...) and (3, ...)."""
    x, y, z, w = q
    a, b, c = v
    # v + w t + u x t with t = 2 u x v, u the vector part of q.
    s, t, u = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return a + w * s + (y * u - z * t), b + w * t + (z * s - x * u), c + w * u + (x * t - y * s)


def shortest_arc(a: np.ndarray, b: np.ndarray, spare: np.ndarray | None = None) -> np.ndarray:
    """(..., 4) smallest rotations from unit vectors `a` to unit vectors `b`.

    Args:
        a: (..., 3) unit vectors.
        b: (..., 3) unit vectors.
        spare: (..., 3) axis of rotation if they are opposite; by default the coordinate axis with
            the smallest component of `a`.
    """
    a, b = np.broadcast_arrays(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
    if spare is None:
        spare = np.eye(3)[np.abs(a).argmin(axis=-1)]
    spare = spare - (a * spare).sum(axis=-1, keepdims=True) * a
    cosine = (a * b).sum(axis=-1, keepdims=True)
    turn = np.concatenate([np.cross(a, b), 1 + cosine], axis=-1)
    half = np.concatenate([spare, np.zeros_like(cosine)], axis=-1)
    return normalize_quaternions(np.where(cosine < -1 + 1e-9, half, turn))


def rotation_angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(...) angle of the rotation from `a` to `b` (..., 4), radians in [0, pi].

    Small angles are exact.
    """
    turn = multiply_quaternions(invert_quaternions(a), b)
    return 2 * np.arctan2(np.linalg.norm(turn[..., :3], axis=-1), np.abs(turn[..., 3]))


def slerp(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(..., 4) spherical interpolation from `a` (weight 0) to `b` (weight 1), the shorter way.

    Args:
        a: (..., 4) unit quaternions.
        b: (..., 4) unit quaternions.
        weight: (...) numbers in [0, 1], broadcast against the leading axes.
    """
    b = np.where((a * b).sum(axis=-1, keepdims=True) < 0, -b, b)
    # From the chord: arccos of the dot product loses half its digits for small turns.
    angle = 2 * np.arctan2(np.linalg.norm(b - a, axis=-1), np.linalg.norm(b + a, axis=-1))
    weight = np.broadcast_to(weight, angle.shape)
    sine = np.sin(angle)
    small = sine < 1e-6  # here the arc is its chord
    sine = np.where(small, 1.0, sine)
    from_a = np.where(small, 1 - weight, np.sin((1 - weight) * angle) / sine)
    from_b = np.where(small, weight, np.sin(weight * angle) / sine)
    return normalize_quaternions(from_a[..., None] * a + from_b[..., None] * b)


def steady_signs(turns: np.ndarray) -> np.ndarray:
    """Return rotations (T, ..., 4) with continuous signs.

    q and -q are the same rotation; the nearer one in each frame can be interpolated.
    """
    along = (turns[1:] * turns[:-1]).sum(axis=-1)
    signs = np.cumprod(np.where(along < 0, -1.0, 1.0), axis=0)
    return np.concatenate([turns[:1], turns[1:] * signs[..., None]])


def mean_quaternion(q: np.ndarray) -> np.ndarray:
    """(4,) mean of (N, 4): the top eigenvector of the sum of q q^T (Markley et al. 2007)."""
    q = np.asarray(q, dtype=np.float64).reshape(-1, 4)
    mean = np.linalg.eigh(q.T @ q)[1][:, -1]
    return mean if mean[3] >= 0 else -mean


def matrix_from_quaternion(q: np.ndarray) -> np.ndarray:
    """(..., 3, 3) rotation matrices of unit quaternions (..., 4)."""
    x, y, z, w = np.moveaxis(np.asarray(q, dtype=np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_matrix(matrix: np.ndarray) -> np.ndarray:
    """(..., 4) unit quaternions of rotation matrices (..., 3, 3), w not negative."""
    m = np.asarray(matrix, dtype=np.float64)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    # Row i of this table is the quaternion times four times its i-th component; the row of the
    # largest component is the accurate one (Shepperd 1978).
    xy, xz, yz = (m[..., i, j] + m[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    wx, wy, wz = (m[..., i, j] - m[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    rows = [
        [1 + xx - yy - zz, xy, xz, wx],
        [xy, 1 - xx + yy - zz, yz, wy],
        [xz, yz, 1 - xx - yy + zz, wz],
        [wx, wy, wz, 1 + xx + yy + zz],
    ]
    table = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    best = np.argmax(np.stack([xx, yy, zz, xx + yy + zz], axis=-1), axis=-1)
    q = np.take_along_axis(table, best[..., None, None], axis=-2)[..., 0, :]
    return normalize_quaternions(np.where(q[..., 3:] < 0, -q, q))


def quaternion_from_euler(angles: np.ndarray, order: str) -> np.ndarray:
    """(..., 4) quaternions from intrinsic Euler angles (..., 3), degrees, columns as in `order`.

    "ZXY" rotates about Z, then about the new X, then about the newest Y, as in BVH.
    """
    a, b, c = ("XYZ".index(axis) for axis in order)
    parity = 1.0 if (b - a) % 3 == 1 else -1.0  # of the permutation
    half = np.moveaxis(np.radians(np.asarray(angles, dtype=np.float64)) / 2, -1, 0)
    (sa, sb, sc), (ca, cb, cc) = np.sin(half), np.cos(half)
    # The product of three quaternions of one axis each, written out.
    result = np.empty((*half.shape[1:], 4))
    result[..., a] = sa * cb * cc + parity * ca * sb * sc
    result[..., b] = ca * sb * cc - parity * sa * cb * sc
    result[..., c] = ca * cb * sc + parity * sa * sb * cc
    result[..., 3] = ca * cb * cc - parity * sa * sb * sc
    return result


def euler_from_quaternion(q: np.ndarray, order: str) -> np.ndarray:
    """(..., 3) intrinsic Euler angles of quaternions (..., 4), degrees, columns as in `order`.

    In gimbal lock the third angle is set to 0; the rotation is still correct.
    """
    from scipy.spatial.transform import Rotation

    q = np.asarray(q, dtype=np.float64)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Gimbal lock")
        angles = Rotation.from_quat(q.reshape(-1, 4)).as_euler(order.upper(), degrees=True)
    return angles.reshape(*q.shape[:-1], 3)


def quaternion_from_rotation_vector(vector: np.ndarray) -> np.ndarray:
    """(..., 4) quaternions from rotation vectors (..., 3): axis times angle, radians."""
    vector = np.asarray(vector, dtype=np.float64)
    half = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    # numpy's sinc is sin(pi x) / (pi x), finite at zero.
    return np.concatenate([vector * np.sinc(half / np.pi) / 2, np.cos(half)], axis=-1)


def rotation_vector_from_quaternion(q: np.ndarray) -> np.ndarray:
    """(..., 3) rotation vectors of quaternions (..., 4), radians, the angle in [0, pi]."""
    q = np.asarray(q, dtype=np.float64)
    q = np.where(q[..., 3:] < 0, -q, q)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., 3:])
    return q[..., :3] * np.where(sine > _TINY, angle / np.maximum(sine, _TINY), 2.0)


def sixd_from_quaternion(q: np.ndarray) -> np.ndarray:
    """(..., 6) first two matrix columns of quaternions (..., 4) (Zhou et al. 2019)."""
    matrix = matrix_from_quaternion(q)
    return np.concatenate([matrix[..., 0], matrix[..., 1]], axis=-1)


def quaternion_from_sixd(sixd: np.ndarray) -> np.ndarray:
    """(..., 4) quaternions from 6D (..., 6) by Gram-Schmidt; any finite values give a rotation.

    A column that is zero, or a second one parallel to the first, is replaced by an axis.
    """
    sixd = np.asarray(sixd, dtype=np.float64)
    first, second = sixd[..., :3], sixd[..., 3:]
    first = _unit_or(first, np.broadcast_to([1.0, 0.0, 0.0], first.shape))
    second = second - (first * second).sum(axis=-1, keepdims=True) * first
    # The axis that lies least along the first column is never parallel to it.
    spare = np.eye(3)[np.abs(first).argmin(axis=-1)]
    spare = spare - (first * spare).sum(axis=-1, keepdims=True) * first
    second = _unit_or(second, spare / np.linalg.norm(spare, axis=-1, keepdims=True))
    matrix = np.stack([first, second, np.cross(first, second)], axis=-1)
    return quaternion_from_matrix(matrix)


def _unit_or(v: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.where(length > 1e-8, v / np.maximum(length, 1e-8), otherwise)
