"""Exponential, and the logarithm of `rigid`, against scipy, matrix exponentials and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from biresnerf.geometry.lie import hat, se3_exp, so3_exp
from biresnerf.geometry.rigid import rotation_vectors

# (type, what a rotation matrix's entries may be off by)
TYPES = [(torch.float64, 1e-14), (torch.float32, 1e-6)]
ANGLES = [
    0.0,
    1e-30,
    1e-12,
    1e-8,
    1e-4,
    1e-2,
    0.5,
    0.999999,
    1.000001,
    2.0,
    np.pi - 1e-3,
    np.pi - 1e-7,
    np.pi,
]
HUGE = [2 * np.pi - 1e-6, 2 * np.pi, 100.0, 1e4, 1e6]

unit_vectors = (
    st.tuples(*[st.floats(-1, 1)] * 3)
    .map(np.array)
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(lambda v: v / np.linalg.norm(v))
)


def axes(count: int = 20) -> np.ndarray:
    drawn = np.random.default_rng(0).normal(size=(count, 3))
    drawn = np.concatenate([np.eye(3), -np.eye(3), drawn])
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


@pytest.mark.parametrize(("dtype", "tolerance"), TYPES)
@pytest.mark.parametrize("angle", ANGLES + HUGE)
def test_so3_exp_equals_scipy(angle, dtype, tolerance):
    rotvec = torch.tensor(axes() * angle, dtype=dtype)
    expected = Rotation.from_rotvec(rotvec.double().numpy()).as_matrix()
    # A huge angle is only known to its own rounding.
    slack = tolerance + 4 * torch.finfo(dtype).eps * angle
    np.testing.assert_allclose(so3_exp(rotvec).double().numpy(), expected, atol=slack)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.3, 0.9999, 1.0001, 2.0, np.pi, 6.0, 20.0])
def test_se3_exp_equals_the_exponential_of_the_4x4_twist(angle):
    velocity = np.array([0.3, -2.0, 0.7])
    for axis in axes(5):
        twist = np.zeros((4, 4))
        twist[:3, :3] = np.cross(np.eye(3), axis * angle)
        twist[:3, 3] = velocity
        expected = expm(twist)
        rotation, translation = se3_exp(torch.tensor(axis * angle), torch.tensor(velocity))
        np.testing.assert_allclose(rotation.numpy(), expected[:3, :3], atol=1e-12)
        np.testing.assert_allclose(translation.numpy(), expected[:3, 3], atol=1e-12)


def test_se3_exp_follows_a_quarter_screw_worked_out_by_hand():
    # Turning a quarter about z while moving along x in the moving frame: a quarter circle of radius 2 / pi.
    rotation, translation = se3_exp(
        torch.tensor([0.0, 0.0, torch.pi / 2], dtype=torch.float64),
        torch.tensor([1.0, 0.0, 3.0], dtype=torch.float64),
    )
    np.testing.assert_allclose(rotation.numpy(), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(translation.numpy(), [2 / np.pi, 2 / np.pi, 3.0], atol=1e-15)


def test_hat_is_the_cross_product():
    v, x = torch.randn(7, 5, 3, dtype=torch.float64), torch.randn(7, 5, 3, dtype=torch.float64)
    torch.testing.assert_close((hat(v) @ x[..., None])[..., 0], torch.linalg.cross(v, x))


@settings(deadline=None)
@given(unit_vectors, st.floats(0.0, np.pi - 1e-6))
def test_log_inverts_exp(axis, angle):
    rotvec = torch.tensor(axis * angle, dtype=torch.float64)
    back = torch.from_numpy(rotation_vectors(so3_exp(rotvec).numpy()))
    torch.testing.assert_close(back, rotvec, atol=1e-9 * max(angle, 1e-6), rtol=1e-9)


@pytest.mark.parametrize(("dtype", "tolerance"), TYPES)
@pytest.mark.parametrize("below", [1e-3, 1e-5, 1e-7, 1e-9, 0.0])
def test_exp_inverts_log_near_pi(below, dtype, tolerance):
    rotation = so3_exp(torch.tensor(axes() * (np.pi - below), dtype=dtype))
    rotvec = torch.from_numpy(rotation_vectors(rotation.numpy())).to(dtype)
    assert (rotvec.norm(dim=-1) <= torch.pi + 10 * tolerance).all()
    torch.testing.assert_close(so3_exp(rotvec), rotation, atol=20 * tolerance, rtol=0)


@pytest.mark.parametrize(("dtype", "tolerance"), TYPES)
@pytest.mark.parametrize("angle", [*ANGLES, *HUGE, 1e10, 1e18])
def test_value_and_gradient_are_finite_everywhere(angle, dtype, tolerance):
    rotvec = torch.tensor(axes() * angle, dtype=dtype, requires_grad=True)
    velocity = torch.ones_like(rotvec, requires_grad=True)
    rotation, translation = se3_exp(rotvec, velocity)
    weights = torch.randn(3, 3, dtype=dtype, generator=torch.Generator().manual_seed(1))
    ((rotation * weights).sum() + (translation * weights[0]).sum()).backward()
    for tensor in (rotation, translation, rotvec.grad, velocity.grad):
        assert torch.isfinite(tensor).all()
    identity = torch.eye(3, dtype=dtype).expand_as(rotation)
    torch.testing.assert_close(rotation @ rotation.mT, identity, atol=20 * tolerance, rtol=0)


def test_gradient_at_zero_is_the_generator():
    jacobian = torch.autograd.functional.jacobian(so3_exp, torch.zeros(3, dtype=torch.float64))
    expected = torch.stack([hat(e) for e in torch.eye(3, dtype=torch.float64)], dim=-1)
    torch.testing.assert_close(jacobian, expected, atol=0, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.5, 0.9999999, 1.0000001, 3.0, 10.0])
def test_gradients_equal_finite_differences(angle):
    rotvec = torch.tensor(axes(3) * angle, requires_grad=True)
    velocity = torch.randn_like(rotvec).requires_grad_()
    assert torch.autograd.gradcheck(se3_exp, (rotvec, velocity), atol=1e-6)


def test_a_batch_equals_its_elements_and_may_be_empty():
    rotvec, velocity = torch.randn(2, 4, 3), torch.randn(2, 4, 3)
    rotation, translation = se3_exp(rotvec, velocity)
    assert rotation.shape == (2, 4, 3, 3)
    for i in range(2):
        for j in range(4):
            one = se3_exp(rotvec[i, j], velocity[i, j])
            torch.testing.assert_close(rotation[i, j], one[0])
            torch.testing.assert_close(translation[i, j], one[1])
    assert so3_exp(torch.zeros(0, 3)).shape == (0, 3, 3)


def test_wrong_shapes_and_types_are_refused():
    with pytest.raises(ValueError, match="rotvec must have shape"):
        so3_exp(torch.zeros(4))
    with pytest.raises(ValueError, match="float type"):
        so3_exp(torch.zeros(3, dtype=torch.int64))
