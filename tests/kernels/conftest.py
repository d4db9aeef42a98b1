"""Every test of a kernel runs on the CPU, and once more on a GPU, or (slow) on the pretended one."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest
import torch
from kernels_of_gpu import kernels_of_gpu
from pretended_gpu import pretended_gpu
from torch.overrides import TorchFunctionMode

_MAKE_TENSORS = {
    getattr(torch, name)
    for name in (
        *("arange", "empty", "eye", "full", "linspace", "logspace", "ones", "tensor", "zeros"),
        *("rand", "randint", "randn", "randperm"),
    )
}


class _TensorsOnGPU(TorchFunctionMode):
    """Tensors of a test are made on the CPU, with the same random numbers as there, and move to the GPU."""

    def __torch_function__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        made: Any = func(*args, **(kwargs or {}))
        if func not in _MAKE_TENSORS or (kwargs or {}).get("device") is not None:
            return made
        from_a_test = not sys._getframe(1).f_globals["__name__"].startswith("gmmtorch.")
        return made.to("cuda") if from_a_test else made


_GPU = "cuda" if torch.cuda.is_available() else pytest.param("pretended", marks=pytest.mark.slow)


@pytest.fixture(autouse=True, params=["cpu", _GPU])
def device(request: pytest.FixtureRequest) -> Iterator[str]:
    """The device of tensors for which a test names none; tests marked `cpu_only` skip the GPU."""
    if request.param == "cpu":
        yield "cpu"
    elif request.node.get_closest_marker("cpu_only"):
        pytest.skip("computes on the CPU, or chooses its devices itself")
    else:
        with ExitStack() as stack:
            if request.param == "pretended":
                stack.enter_context(pretended_gpu())
                stack.enter_context(kernels_of_gpu())
            stack.enter_context(_TensorsOnGPU())
            yield "cuda"
