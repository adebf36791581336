"""Devices that tests run on."""

from __future__ import annotations

import pytest
import torch

from surgical_marl.runtime import prepare_warp

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
DEVICES = ("cpu", pytest.param("cuda", marks=needs_cuda))


def skip_where_warp_lacks(device: str) -> None:
    """Skip a test that runs Warp's kernels on a CPU, if this build of Warp has no compiler for CPUs."""
    if device == "cpu" and not prepare_warp().is_cpu_available():
        pytest.skip("this build of Warp has no compiler for CPUs")
