"""Poses in the plane against the same ones in space."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from calgraph.geometry import Array, se2, se3

coordinates = st.floats(-50, 50)
poses = st.builds(lambda x, y, a: se2.pose(a, np.array([x, y])), coordinates, coordinates, st.floats(-7, 7))
tangents = st.builds(lambda *v: np.array(v), coordinates, coordinates, st.floats(-3, 3))
FLAT = [0, 1, 5]  # x, y, rz among (x, y, z, rx, ry, rz)


def lifted(covariance: Array) -> Array:
    out = np.zeros((6, 6))
    out[np.ix_(FLAT, FLAT)] = covariance
    return out


@given(poses, poses)
def test_lifting_keeps_products(T_a_b: Array, T_b_c: Array) -> None:
    assert_allclose(se2.to_se3(T_a_b @ T_b_c), se2.to_se3(T_a_b) @ se2.to_se3(T_b_c), atol=1e-9)


@given(poses)
def test_inverse_is_that_in_space(T: Array) -> None:
    assert_allclose(se2.to_se3(se2.inverse(T)), se3.inverse(se2.to_se3(T)), atol=1e-9)


@given(poses, tangents)
def test_retract_is_that_in_space(T: Array, delta: Array) -> None:
    flat = np.zeros(6)
    flat[FLAT] = delta
    assert_allclose(se2.to_se3(se2.retract(T, delta)), se3.retract(se2.to_se3(T), flat), atol=1e-9)


@given(poses, tangents)
def test_difference_undoes_retract(T: Array, delta: Array) -> None:
    assert_allclose(se2.difference(se2.retract(T, delta), T), delta, atol=1e-9)


@given(poses)
def test_apply_is_that_in_space(T: Array) -> None:
    x = np.array([[1.0, 2.0], [-3.0, 0.5]])
    expected = se3.apply(se2.to_se3(T), np.column_stack([x, np.zeros(2)]))
    assert_allclose(se2.apply(T, x), expected[:, :2], atol=1e-9)


def test_poses_broadcast_over_leading_axes(rng: np.random.Generator) -> None:
    T = se2.pose(rng.normal(size=(4, 1)), rng.normal(size=(5, 2)))
    assert_allclose(se2.inverse(T) @ T, np.broadcast_to(np.eye(3), (4, 5, 3, 3)), atol=1e-12)


@given(poses, poses)
def test_covariance_of_a_product_is_that_in_space(T_a_b: Array, T_b_c: Array) -> None:
    A, B = np.random.default_rng(1).normal(size=(2, 3, 3))
    A, B = A @ A.T, B @ B.T
    t = np.append(T_b_c[:2, 2], 0.0)
    expected = se3.compose_covariance(se2.to_se3(T_a_b), lifted(A), lifted(B), t)
    assert_allclose(lifted(se2.compose_covariance(T_a_b, A, B, T_b_c[:2, 2])), expected, rtol=1e-6, atol=1e-6)


@given(poses)
def test_covariance_of_an_inverse_is_that_in_space(T: Array) -> None:
    A = np.random.default_rng(1).normal(size=(3, 3))
    expected = se3.inverse_covariance(se2.to_se3(T), lifted(A @ A.T))
    assert_allclose(lifted(se2.inverse_covariance(T, A @ A.T)), expected, rtol=1e-6, atol=1e-6)
