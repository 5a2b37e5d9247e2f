"""Which device is taken, and what is said where it cannot be had."""

from __future__ import annotations

import importlib.util
import logging

import pytest
import torch

from biresnerf.errors import InputError
from biresnerf.field.backends import choose_device


def pretend(monkeypatch, *, cuda: bool = True, triton: bool = True, capability: tuple[int, int] = (9, 0)):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: capability)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if triton else None)


def test_auto_takes_cuda_where_it_can_be_used(monkeypatch):
    pretend(monkeypatch)
    assert choose_device("auto").type == choose_device("cuda").type == "cuda"
    assert choose_device("cpu").type == "cpu"


@pytest.mark.parametrize(
    ("lacking", "said"),
    [({"cuda": False}, "no CUDA device"), ({"triton": False}, "Triton"), ({"capability": (7, 5)}, "7.5")],
)
def test_cuda_that_cannot_be_used_is_refused_by_name_and_left_with_a_reason(
    monkeypatch, caplog, lacking, said
):
    pretend(monkeypatch, **lacking)
    with pytest.raises(InputError, match=said):
        choose_device("cuda")
    with caplog.at_level(logging.WARNING):
        assert choose_device("auto").type == "cpu"
    assert (said in caplog.text) == ("cuda" not in lacking)
