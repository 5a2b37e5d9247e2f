"""The check of a GPU's kernels: right ones pass, wrong ones are named, and each machine is checked once."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip(
    "triton",
    minversion="3.2",
    reason="the CUDA backend's kernels need Triton, for Linux only; its interpreter runs them from 3.2 on",
)

from biresnerf.field import backends
from biresnerf.field.cuda import device_check
from biresnerf.field.cuda.check_batch import CutProduct, DefinedField
from biresnerf.field.cuda.field import CudaField
from biresnerf.geometry.camera.camera import directions_in_cam
from biresnerf.refinement.verdict import run_report
from tests.field.cuda.fields import DEVICE, HAS_GPU, SHAPES
from tests.refinement.tiny_scene import tiny_options

pytestmark = pytest.mark.slow


def test_kernels_that_compute_what_is_defined_have_no_faults(monkeypatch):
    if not HAS_GPU:
        monkeypatch.setattr(device_check, "RAYS", 6)  # Triton's interpreter takes its time
    assert device_check.faults(CudaField, DEVICE) == ()


def test_a_product_cuts_its_factors_and_those_of_its_gradients_to_ten_bits():
    def cut(x):  # towards zero, by another way than the bits
        mantissa, exponent = np.frexp(x.double().numpy())
        return torch.from_numpy(np.ldexp(np.trunc(mantissa * 2**11) / 2**11, exponent))

    draws = torch.Generator().manual_seed(1)
    a, b, g = (torch.randn(n, m, generator=draws) for n, m in ((5, 7), (7, 3), (5, 3)))
    a.requires_grad_(), b.requires_grad_()
    product = CutProduct.apply(a, b)
    product.backward(g)
    whole, other, back = (cut(x.detach()) for x in (a, b, g))
    assert not torch.allclose(product.double(), a.double() @ b.double(), rtol=1e-5, atol=1e-5)
    for found, expected in ((product, whole @ other), (a.grad, back @ other.T), (b.grad, whole.T @ back)):
        torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-6)


class WrongDensity(DefinedField):
    def density(self, position):
        return 1.1 * super().density(position)


class WrongTables(DefinedField):
    def _update_table(self, name, rates):
        super()._update_table(name, rates)
        self.moments[name][0].mul_(1.1)


class NaNDepth(DefinedField):
    def render(self, rays, marching, gradient):
        rendering = super().render(rays, marching, gradient)
        return replace(rendering, depth=rendering.depth * float("nan"))


@pytest.mark.parametrize(
    ("kind", "named"),
    [(WrongDensity, "density"), (WrongTables, "gradient by tables"), (NaNDepth, "depth")],
)
def test_a_wrong_result_is_named(kind, named):
    found = device_check.faults(kind, DEVICE)
    assert len(found) == 4  # in either stage, of either kind of scene
    assert all(fault.startswith(named) for fault in found)


def test_wrong_viewing_directions_are_named(monkeypatch):
    turned = lambda *pixels: directions_in_cam(*pixels) + 1e-4  # noqa: E731
    monkeypatch.setattr(device_check, "on_device", turned)
    assert device_check.faults(DefinedField, DEVICE) == ("viewing directions differ",)


def test_each_gpu_is_checked_once(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    checked = []
    monkeypatch.setattr(
        device_check, "_check_in_own_process", lambda: checked.append(1) or ["colour differs"]
    )
    for name, expected in (("one GPU", 1), ("one GPU", 1), ("another GPU", 2)):
        monkeypatch.setattr(device_check, "_installation", lambda name=name: name)
        device_check.remembered_faults.cache_clear()
        assert device_check.remembered_faults() == ("colour differs",)
        assert len(checked) == expected
    assert set(json.loads((tmp_path / "biresnerf/gpu-checks.json").read_text())) == {"one GPU", "another GPU"}
    device_check.remembered_faults.cache_clear()


def test_a_check_that_did_not_end_is_run_again(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(device_check, "_installation", lambda: "a busy GPU")
    for answer, expected in (
        ("the check failed: out of memory", ("the check failed: out of memory",)),
        ([], ()),
    ):
        monkeypatch.setattr(device_check, "_check_in_own_process", lambda answer=answer: answer)
        device_check.remembered_faults.cache_clear()
        assert device_check.remembered_faults() == expected
    device_check.remembered_faults.cache_clear()


def test_a_check_that_cannot_run_is_a_fault(monkeypatch):
    if torch.cuda.is_available():
        pytest.skip("there is a GPU, on which the check does not fail")
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    fault = device_check._check_in_own_process()
    assert fault.startswith("the check failed")
    assert "CUDA" in fault or "NVIDIA" in fault


def test_plain_torch_takes_the_place_of_kernels_that_fail(monkeypatch, caplog):
    monkeypatch.setattr(backends, "gpu_faults", lambda _device: ("colour differs by 30%",))
    monkeypatch.setattr(run_report, "gpu_faults", lambda _device: ("colour differs by 30%",))
    # Stands for a GPU: neither needs one to be made.
    field = backends.make_field(SHAPES[False], tiny_options(), torch.device("meta"), 1)
    assert field.backend == "reference"
    assert "colour differs by 30%" in caplog.text
    assert backends.directions_for(torch.device("cuda")) is directions_in_cam
    (warning,) = run_report.gpu_warnings(torch.device("cuda"))
    assert "colour differs by 30%" in warning


def test_the_cpu_is_not_checked():
    assert backends.gpu_faults(torch.device("cpu")) == ()
    assert run_report.gpu_warnings(torch.device("cpu")) == ()
