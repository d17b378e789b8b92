"""Rotations as quaternions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dirax.show.turns import after, attitudes, quaternions, rotated, turn

angles = st.floats(min_value=-3.0, max_value=3.0)


def matrix(quaternion):
    return rotated(np.asarray(quaternion)[None], np.eye(3)).T


def test_a_turn_is_right_handed():
    np.testing.assert_allclose(rotated(np.asarray(turn([0, 0, 2], np.pi / 2)), np.eye(3)[0]), [0, 1, 0], atol=1e-15)


@given(angles, angles, angles)
@pytest.mark.soak
def test_turns_multiply_as_matrices_do_and_come_back_from_them(a, b, c):
    parts = [turn([0, 0, 1], a), turn([1, 0, 0], b), turn([0, 1, 1], c)]
    whole = np.asarray(after(*parts))
    expected = matrix(parts[0]) @ matrix(parts[1]) @ matrix(parts[2])
    np.testing.assert_allclose(matrix(whole), expected, atol=1e-14)
    np.testing.assert_allclose(matrix(quaternions(expected[None])[0]), expected, atol=1e-14)


def test_attitudes_of_a_steady_rotation_are_exact_and_upright_ones_agree_with_the_vertical():
    t, omega = np.linspace(0, 3, 31), np.array([0.3, -0.2, 1.1])
    speed = np.linalg.norm(omega)
    found = attitudes(t, np.tile(omega, (31, 1)))
    np.testing.assert_allclose(matrix(found[-1]), matrix(turn(omega, 3 * speed)), atol=1e-13)
    upright = np.stack([np.sin(t), 0 * t, np.cos(t)], axis=1)
    tilted = attitudes(t, np.tile(omega, (31, 1)), upright=upright)
    np.testing.assert_allclose(rotated(tilted, upright), np.tile([0, 0, 1.0], (31, 1)), atol=1e-13)
