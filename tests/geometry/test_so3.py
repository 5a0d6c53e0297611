"""Rotations against scipy's, and the group's axioms for every angle, near zero and near π on purpose."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from calgraph.geometry import Array, so3

SHAPES = [(), (1,), (5,), (2, 3), (0,)]


def direction(azimuth: float, z: float) -> Array:
    """The unit vector at an azimuth, rad, and a height."""
    across = np.sqrt(1 - z**2)
    return np.array([across * np.cos(azimuth), across * np.sin(azimuth), z])


unit_vectors = st.builds(direction, st.floats(-np.pi, np.pi), st.floats(-1, 1))
tiny = st.floats(0, 1e-3)
boundaries = st.sampled_from([0.0, 1e-9, 1e-4, np.pi])
angles = st.one_of(st.floats(0, np.pi), tiny, tiny.map(lambda e: np.pi - e), boundaries)
rotation_vectors = st.builds(lambda axis, angle: angle * axis, unit_vectors, angles)


def random_rotations(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    count = int(np.prod(shape))
    if count == 0:
        return np.zeros((*shape, 3, 3))
    return np.asarray(Rotation.random(count, rng=rng).as_matrix().reshape(*shape, 3, 3))


def test_hat_is_the_cross_product(rng: np.random.Generator) -> None:
    v, x = rng.normal(size=(2, 7, 3))
    assert_allclose((so3.hat(v) @ x[..., None])[..., 0], np.cross(v, x), atol=1e-15)


@pytest.mark.parametrize("axes", [[1, 1, 1], [0, 0, 1], [1, 0, 0]])
@pytest.mark.parametrize("size", [0.0, 1e-6, 0.01, 2.0])
def test_vectors_are_rotated_as_by_the_matrix(axes: list[int], size: float, rng: np.random.Generator) -> None:
    phi, x = rng.normal(size=(2, 7, 3)) * [[[size]], [[1]]]
    phi *= axes
    assert_allclose(so3.rotate(phi, x), (so3.exp(phi) @ x[..., None])[..., 0], atol=1e-14)
    assert_allclose(so3.cross(phi, x), np.cross(phi, x), atol=1e-14)


@given(rotation_vectors)
def test_exp_agrees_with_scipy(phi: Array) -> None:
    assert_allclose(so3.exp(phi), Rotation.from_rotvec(phi).as_matrix(), atol=2e-15)


@pytest.mark.parametrize("angle", [0.9e-4, 1.1e-4, 2e-3, 9e-3])
def test_exp_and_log_are_exact_where_series_meet_closed_forms(angle: float) -> None:
    phi = angle * np.array([0.6, 0.0, -0.8])
    assert_allclose(so3.exp(phi), Rotation.from_rotvec(phi).as_matrix(), atol=1e-15)
    assert_allclose(so3.log(so3.exp(phi)), phi, rtol=1e-12)


def test_exp_goes_on_beyond_a_full_turn() -> None:
    assert_allclose(so3.exp(np.array([0, 0, 2 * np.pi + 0.3])), so3.exp(np.array([0, 0, 0.3])), atol=1e-14)


@given(rotation_vectors)
def test_exp_gives_proper_rotations(phi: Array) -> None:
    R = so3.exp(phi)
    assert_allclose(R @ R.T, np.eye(3), atol=2e-15)
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-14)


@given(rotation_vectors)
def test_log_keeps_every_digit_of_small_and_large_angles(phi: Array) -> None:
    angle = float(np.linalg.norm(phi))
    found = so3.log(so3.exp(phi))
    if angle > np.pi - 1e-9:  # both signs of the axis describe the half turn
        found = found * np.sign(found @ phi)
    assert_allclose(found, phi, rtol=0, atol=4e-15 + 1e-13 * angle)


@given(rotation_vectors)
def test_log_agrees_with_scipy(phi: Array) -> None:
    R = Rotation.from_rotvec(phi)
    expected = R.as_rotvec()
    found = so3.log(R.as_matrix())
    if np.linalg.norm(phi) > np.pi - 1e-7:
        found = found * np.sign(found @ expected)
    assert_allclose(found, expected, atol=1e-13)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3), [[0.6, -0.8, 0.0]]]))
def test_log_of_half_turns_has_the_length_pi(axis: Array) -> None:
    R = 2 * np.outer(axis, axis) - np.eye(3)
    phi = so3.log(R)
    assert np.linalg.norm(phi) == pytest.approx(np.pi, abs=1e-15)
    assert_allclose(so3.exp(phi), R, atol=1e-15)


@given(rotation_vectors, rotation_vectors)
def test_exp_of_a_conjugate_is_the_conjugate(phi: Array, theta: Array) -> None:
    R = so3.exp(theta)
    assert_allclose(so3.exp(R @ phi), R @ so3.exp(phi) @ R.T, atol=5e-15)


@given(rotation_vectors)
def test_quaternion_agrees_with_scipy(phi: Array) -> None:
    R = Rotation.from_rotvec(phi)
    assert_allclose(abs(so3.quaternion(R.as_matrix()) @ R.as_quat()), 1, atol=1e-15)


@given(rotation_vectors)
def test_quaternion_has_no_negative_w(phi: Array) -> None:
    assert so3.quaternion(so3.exp(phi))[3] >= 0


@given(rotation_vectors)
def test_quaternion_and_matrix_are_inverse_of_each_other(phi: Array) -> None:
    R = so3.exp(phi)
    assert_allclose(so3.from_quaternion(so3.quaternion(R)), R, atol=3e-15)


def test_quaternions_of_any_length_and_sign_are_accepted() -> None:
    q = np.array([0.1, -0.2, 0.3, 0.9])
    expected = Rotation.from_quat(q).as_matrix()
    assert_allclose(so3.from_quaternion(-7 * q), expected, atol=1e-15)


@given(rotation_vectors, unit_vectors)
def test_left_jacobian_is_the_derivative_of_exp(phi: Array, axis: Array) -> None:
    ahead, behind = (so3.exp(phi + d) @ so3.exp(phi).T for d in (1e-6 * axis, -1e-6 * axis))
    assert_allclose(so3.left_jacobian(phi) @ axis, (so3.log(ahead) - so3.log(behind)) / 2e-6, atol=2e-8)


@given(rotation_vectors)
def test_left_jacobian_and_its_inverse_multiply_to_one(phi: Array) -> None:
    assert_allclose(so3.left_jacobian(phi) @ so3.left_jacobian_inverse(phi), np.eye(3), atol=1e-13)


@pytest.mark.parametrize("angle", [0.9e-4, 1.1e-4, 2e-3, 0.5])
def test_left_jacobian_is_the_mean_of_partial_rotations(angle: float) -> None:
    """The integral of ``exp(s phi)`` for s from 0 to 1, by Gauss's quadrature."""
    phi = angle * np.array([0.6, 0.0, -0.8])
    places, weights = np.polynomial.legendre.leggauss(12)
    expected = np.einsum("s,sij->ij", weights / 2, so3.exp((places[:, None] + 1) / 2 * phi))
    assert_allclose(so3.left_jacobian(phi), expected, atol=1e-13)


@given(rotation_vectors.filter(lambda phi: np.linalg.norm(phi) < 3.1), unit_vectors)
def test_left_jacobian_inverse_is_the_derivative_of_log(phi: Array, axis: Array) -> None:
    step = 1e-6 * axis
    ahead, behind = (so3.log(so3.exp(d) @ so3.exp(phi)) for d in (step, -step))
    assert_allclose(so3.left_jacobian_inverse(phi) @ axis, (ahead - behind) / 2e-6, atol=2e-8)


def test_left_jacobian_inverse_stays_finite_at_half_a_turn() -> None:
    c = np.linalg.norm(so3.left_jacobian_inverse(np.array([np.pi, 0, 0])) @ [0, 1, 0])
    assert c == pytest.approx(np.pi / 2)  # |J⁻¹ y| = θ/2 / sin(θ/2) across the axis


@pytest.mark.parametrize("shape", SHAPES)
def test_every_function_works_on_any_leading_axes(shape: tuple[int, ...], rng: np.random.Generator) -> None:
    R = random_rotations(rng, shape)
    phi, q = so3.log(R), so3.quaternion(R)
    assert phi.shape == (*shape, 3)
    assert q.shape == (*shape, 4)
    for matrices in (so3.exp(phi), so3.from_quaternion(q)):
        assert_allclose(matrices, R, atol=1e-14)
    assert so3.left_jacobian(phi).shape == (*shape, 3, 3)
    assert so3.left_jacobian_inverse(phi).shape == so3.hat(phi).shape == (*shape, 3, 3)


def test_one_batch_may_mix_zero_small_and_half_turns() -> None:
    phi = np.array([[0, 0, 0], [1e-7, 0, 0], [0, 1.0, 0], [0, 0, np.pi - 1e-7]])
    assert_allclose(so3.log(so3.exp(phi)), phi, atol=1e-14)
