"""Quaternions and rigid transforms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l3ps.geometry import (
    apply,
    invert,
    is_rigid,
    matrix_to_quaternion,
    orthonormal,
    quaternion_to_matrix,
    transform,
)

NUMBER = st.floats(-1, 1).filter(lambda v: v == 0 or abs(v) > 1e-9)
QUATERNION = st.tuples(NUMBER, NUMBER, NUMBER, NUMBER).filter(lambda q: np.linalg.norm(q) > 1e-3)
PLACE = st.tuples(*[st.floats(-1e6, 1e6)] * 3)


@given(QUATERNION)
def test_quaternion_survives_the_matrix(q):
    unit = np.array(q) / np.linalg.norm(q)
    back = matrix_to_quaternion(quaternion_to_matrix(q))
    assert min(np.abs(back - unit).max(), np.abs(back + unit).max()) < 1e-9


@given(QUATERNION, st.floats(1e-6, 1e6))
def test_length_of_a_quaternion_does_not_matter(q, length):
    np.testing.assert_allclose(quaternion_to_matrix(np.array(q) * length), quaternion_to_matrix(q), atol=1e-9)


@given(QUATERNION, PLACE)
def test_inverse_takes_points_back(q, place):
    matrix = transform(q, place)
    points = np.array([[1.0, 2.0, 3.0], [-40.0, 0.5, 0.0]])
    np.testing.assert_allclose(apply(invert(matrix), apply(matrix, points)), points, atol=1e-6)


def test_quarter_turn_about_z():
    """w x y z order, right-handed: x becomes y."""
    half = np.sqrt(0.5)
    np.testing.assert_allclose(quaternion_to_matrix([half, 0, 0, half]) @ [1, 0, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize("q", [[0, 0, 0, 0], [1e-20, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1], [1, 0, 0], []])
def test_no_rotation_in_it(q):
    with pytest.raises(ValueError, match="rotation"):
        quaternion_to_matrix(q)


def test_quaternion_of_huge_numbers():
    np.testing.assert_allclose(quaternion_to_matrix([1e200, 0, 0, 0]), np.eye(3))


@pytest.mark.parametrize(
    "rotation", [np.diag([1, 1, -1]), np.zeros((3, 3)), 2 * np.eye(3), np.full((3, 3), np.nan), np.eye(3) * 1e300]
)
def test_reflections_scales_and_nan_are_no_rotation(rotation):
    with pytest.raises(ValueError, match="rotation"):
        transform(rotation, [0, 0, 0])


@pytest.mark.parametrize("translation", [[0, 0], [0, 0, np.nan], [0, 0, np.inf]])
def test_translation_of_three_finite_numbers(translation):
    with pytest.raises(ValueError):
        transform(np.eye(3), translation)


def test_rounded_rotation_becomes_exact():
    rounded = np.round(quaternion_to_matrix([0.3, 0.5, -0.1, 0.8]), 5)
    exact = orthonormal(rounded)
    assert np.abs(exact @ exact.T - np.eye(3)).max() < 1e-12
    assert np.abs(exact - rounded).max() < 1e-4
    assert is_rigid(transform(exact, [1, 2, 3]))
