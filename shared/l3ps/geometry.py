"""Rotations and rigid transforms as plain arrays.

A quaternion is (w, x, y, z), the order of the nuScenes tables. A transform is a (4, 4) float64 homogeneous matrix whose
upper left block is a rotation; ``a_to_b`` takes coordinates in frame a to coordinates in frame b.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Matrix = NDArray[np.float64]

_RIGID_TOLERANCE = 1e-3
"""Largest deviation of R Rᵀ from identity that passes as a rotation; KITTI prints seven digits and stays below 1e-5."""


def quaternion_to_matrix(quaternion: ArrayLike) -> Matrix:
    """Rotation matrix of a quaternion.

    Args:
        quaternion: (4,) w, x, y, z; any length but zero, it is normalised.

    Returns:
        (3, 3) float64 rotation.

    Raises:
        ValueError: not four finite numbers, or all of them (almost) zero.
    """
    q = np.asarray(quaternion, dtype=np.float64)
    if q.shape != (4,) or not np.isfinite(q).all():
        raise ValueError("a rotation needs four finite numbers w, x, y, z")
    # Scaled first: the plain norm of a quaternion of 1e200s overflows.
    scale = float(np.abs(q).max())
    if scale < 1e-12:
        raise ValueError("the quaternion is zero and stands for no rotation")
    q = q / scale
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_to_quaternion(rotation: ArrayLike) -> Matrix:
    """Quaternion of a rotation with w ≥ 0, the inverse of :func:`quaternion_to_matrix`.

    The four products 4·q_i·q_j are rows of a symmetric matrix; the row with the largest diagonal entry is the
    numerically safe one to normalise (Shepperd 1978).

    Args:
        rotation: (3, 3) rotation matrix.

    Returns:
        (4,) float64 unit quaternion w, x, y, z.
    """
    r = np.asarray(rotation, dtype=np.float64)
    trace = float(np.trace(r))
    products = np.array(
        [
            [1 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], 1 + 2 * r[0, 0] - trace, r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], 1 + 2 * r[1, 1] - trace, r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 + 2 * r[2, 2] - trace],
        ]
    )
    q: Matrix = products[int(np.argmax(np.diag(products)))]
    q = q / np.linalg.norm(q)
    return -q if q[0] < 0 else q


def transform(rotation: ArrayLike, translation: ArrayLike) -> Matrix:
    """Homogeneous matrix of a rotation and a translation.

    Args:
        rotation: (3, 3) matrix, or (4,) quaternion w, x, y, z.
        translation: (3,) metres.

    Returns:
        (4, 4) float64.

    Raises:
        ValueError: wrong shapes, values that are not finite, or a matrix that is no rotation.
    """
    r = np.asarray(rotation, dtype=np.float64)
    t = np.asarray(translation, dtype=np.float64)
    if r.shape == (4,):
        r = quaternion_to_matrix(r)
    if r.shape != (3, 3) or t.shape != (3,):
        raise ValueError("a transform needs a 3x3 rotation or a quaternion, and a translation of three numbers")
    matrix = np.eye(4)
    matrix[:3, :3] = r
    matrix[:3, 3] = t
    if not is_rigid(matrix):
        raise ValueError("the values are not finite or the matrix is no rotation")
    return matrix


def is_rigid(matrix: ArrayLike) -> bool:
    """Whether a matrix is a finite (4, 4) rigid transform: a proper rotation, a translation, and 0 0 0 1."""
    m = np.asarray(matrix, dtype=np.float64)
    if m.shape != (4, 4) or not np.isfinite(m).all() or not np.array_equal(m[3], (0.0, 0.0, 0.0, 1.0)):
        return False
    r = m[:3, :3]
    if float(np.abs(r).max()) > 2:
        return False
    return bool(np.abs(r @ r.T - np.eye(3)).max() < _RIGID_TOLERANCE and np.linalg.det(r) > 0)


def invert(matrix: Matrix) -> Matrix:
    """Inverse of a rigid transform, exact and without a solver: (Rᵀ, -Rᵀ t)."""
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return inverse


def apply(matrix: Matrix, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Points in the transform's target frame.

    Args:
        matrix: (4, 4) transform a_to_b.
        points: (N, 3) in frame a, metres.

    Returns:
        (N, 3) float64 in frame b.
    """
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3], dtype=np.float64)


def orthonormal(rotation: ArrayLike) -> Matrix:
    """Nearest rotation to a (3, 3) matrix that rounding has bent a little, by singular value decomposition.

    Calibration files print four to twelve digits; :func:`invert` takes the transpose for the inverse and so needs the
    rotation to be one.
    """
    u, _, vt = np.linalg.svd(np.asarray(rotation, dtype=np.float64))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, dtype=np.float64)
