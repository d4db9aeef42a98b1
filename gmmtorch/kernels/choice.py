"""The choice between fused kernels and their twins in tensor operations: `use_kernels`."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from gmmtorch.errors import GmmTorchError, InvalidArgumentError

if TYPE_CHECKING:
    import torch
    from torch import Tensor

KERNELS = ("auto", "fused", "torch")
"""auto: fused if the kernel compiler works, otherwise torch. fused: an error if it does not. torch: twins."""

logger = logging.getLogger(__name__)
_chosen: list[str] = []  # empty until the first use, so that the environment is read late
_reported: set[str] = set()


def use_kernels(choice: str) -> None:
    """Choose the kernels of this process: one of `KERNELS`.

    The default is the environment variable GMMTORCH_KERNELS, or "auto". Raises `InvalidArgumentError` for
    another value, and `GmmTorchError` for "fused" if the kernel compiler is missing or broken.
    """
    _check(choice, "kernels")
    if choice == "fused":
        import torch

        _compiler_works(torch.device("cpu"), is_needed=True)
    _chosen[:] = [choice]


@contextmanager
def kernels(choice: str) -> Iterator[None]:
    """`use_kernels` for the time of a `with` block."""
    before = list(_chosen)
    use_kernels(choice)
    try:
        yield
    finally:
        _chosen[:] = before


def chosen_kernels() -> str:
    """The current choice."""
    if not _chosen:
        value = os.environ.get("GMMTORCH_KERNELS", "auto")
        _check(value, "GMMTORCH_KERNELS")
        _chosen.append(value)
    return _chosen[0]


def is_fused(*tensors: Tensor | None) -> bool:
    """Whether a fused kernel computes a function of these tensors; None counts as absent.

    Fused kernels have no gradients, run on the CPU and on CUDA, and read plain tensors of one device.
    Raises `GmmTorchError` if `fused` is chosen and the kernel compiler is missing or broken.
    """
    import torch

    choice = chosen_kernels()
    if choice == "torch":
        return False
    device = None
    for tensor in tensors:
        if tensor is None:
            continue
        if type(tensor) is not torch.Tensor and type(tensor) is not torch.nn.Parameter:
            return False
        if tensor.requires_grad and torch.is_grad_enabled():
            return False
        if device is not None and tensor.device != device:
            return False
        device = tensor.device
    if device is None or device.type not in ("cpu", "cuda"):
        return False
    return _compiler_works(device, choice == "fused")


def _check(choice: str, name: str) -> None:
    if choice not in KERNELS:
        raise InvalidArgumentError(f"{name}={choice!r} is not one of {', '.join(KERNELS)}.")


def _compiler_works(device: torch.device, is_needed: bool = False) -> bool:
    from gmmtorch.kernels.compiler import compiler_failure

    failure = compiler_failure(device)
    if failure is not None and is_needed:
        raise GmmTorchError(
            f"kernels=fused needs the kernel compiler, but {failure}; install it with "
            "pip install 'gmmtorch[fast]', or choose ‹kernels›=auto or ‹kernels›=torch."
        )
    if failure is not None and failure not in _reported:
        _reported.add(failure)
        logger.info("Tensor operations replace fused kernels, because %s.", failure)
    return failure is None
