"""Arrays as arguments: tensors, NumPy arrays and nested lists of real numbers become tensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from gmmtorch.errors import InvalidArgumentError

ArrayLike = Tensor | np.ndarray | list | tuple

_REAL_KINDS = "biuf"  # NumPy's kinds of bool, int, unsigned and float
_SHARED_DTYPES = [np.dtype(code) for code in "?Bbhilqefd"]  # bool to float64, without uint16 and wider
_MISSING = (RuntimeError, AssertionError, NotImplementedError)  # of torch for a device that it does not have
_KEPT_DTYPES = (torch.float32, torch.float64)


def as_tensor(
    value: Any, name: str, dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Tensor:
    """`value` as a tensor of real numbers, of any shape. Gradients flow through tensors.

    Arrays can have any strides and byte order. Large arrays share memory with the result if they can.

    Args:
        value: a tensor, an array, anything that NumPy converts to an array of numbers, or a list of these.
        name: name of the argument, for errors.
        dtype: type of the result. None: float32 and float64 stay, all other types become float64.
        device: device of the result. None: that of a tensor, otherwise the CPU.

    Raises `InvalidArgumentError` for masked arrays, whose mask would be lost, for complex numbers, objects,
    strings, sparse arrays and tensors, and lists whose rows have different lengths.
    """
    if type(value) is Tensor and value.dtype is dtype and device is None and _is_plain(value):
        return value
    tensor = _tensor(value, name)
    if dtype is None:
        dtype = tensor.dtype if tensor.dtype in _KEPT_DTYPES else torch.float64
    if device is None:
        return tensor.to(dtype)
    with naming_device(device):
        return tensor.to(device, dtype)


def check_device(name: str, device: Any) -> None:
    """Raise `InvalidArgumentError`, which names the argument, unless torch can compute on the device."""
    try:
        torch.zeros(1, device=device).item()  # item() also refuses the device "meta"
    except _MISSING as error:
        reason = str(error).splitlines()[0].split(". ")[0]
        raise InvalidArgumentError(
            f"{name}={device} is not available ({reason}); use cpu, or install a torch build for this device."
        ) from error


@contextmanager
def naming_device(device: Any) -> Iterator[None]:
    """Errors of torch inside, if a device is the reason, become `InvalidArgumentError`s that name it."""
    try:
        yield
    except _MISSING:
        check_device("device", device)
        raise


class DeviceModule(nn.Module):
    """A module that moves between devices, but keeps the types of its buffers: positions need float64."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        super()._apply(lambda tensor: tensor.to(fn(tensor.new_empty(0)).device), recurse)
        return self

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """The module itself, on a device; see `torch.nn.Module.to`.

        Raises `InvalidArgumentError` for a device that torch does not have.
        """
        target = kwargs.get("device", args[0] if args else None)
        with naming_device("cpu" if target is None or isinstance(target, torch.dtype | Tensor) else target):
            return super().to(*args, **kwargs)

    def cuda(self, device: int | torch.device | None = None) -> Self:
        """The module itself, on a GPU; see `to`."""
        return self.to(torch.device("cuda", device) if isinstance(device, int) else device or "cuda")


def _is_plain(value: Tensor) -> bool:
    return value.layout is torch.strided and not value.is_quantized and not value.is_nested


def _tensor(value: Any, name: str) -> Tensor:
    if isinstance(value, Tensor):
        if not _is_plain(value):
            raise InvalidArgumentError(f"{name} is a {value.layout} tensor; give {name}.to_dense().")
        if value.is_complex():
            raise _complex(name, value.dtype)
        return value
    if isinstance(value, list | tuple) and any(isinstance(x, Tensor | np.ma.MaskedArray) for x in value):
        parts = [_tensor(part, f"{name}[{i}]") for i, part in enumerate(value)]
        if len({part.shape for part in parts}) > 1:
            raise InvalidArgumentError(
                f"{name} has parts of shapes {', '.join(str(tuple(part.shape)) for part in parts[:4])}; give "
                "parts of one shape."
            )
        return torch.stack([part.double() for part in parts])
    return torch.from_numpy(_array(value, name))


def _array(value: Any, name: str) -> np.ndarray:
    """An array of real numbers that torch can share."""
    check_dense(value, name)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InvalidArgumentError(
            f"{name} is a {type(value).__name__} that is not an array of numbers ({error}); give an array "
            "whose rows have the same length."
        ) from error
    if array.dtype.kind == "c":
        raise _complex(name, array.dtype)
    if array.dtype.kind not in _REAL_KINDS:
        raise InvalidArgumentError(
            f"{name} is a {type(value).__name__} of dtype {array.dtype}, not an array of numbers; convert it "
            f"first: np.asarray({name}, dtype=float)."
        )
    # torch takes neither negative strides nor another byte order, and warns of read-only memory.
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    if array.dtype not in _SHARED_DTYPES:
        return array.astype(np.int64 if array.dtype in (np.uint16, np.uint32) else np.float64)
    fits = array.flags.writeable and all(step >= 0 for step in array.strides)
    return array if fits else array.copy(order="C")


def is_floating(value: ArrayLike) -> bool:
    """Whether an array has a floating type."""
    return value.is_floating_point() if isinstance(value, Tensor) else np.asarray(value).dtype.kind == "f"


def check_dense(value: Any, name: str) -> None:
    """Raise `InvalidArgumentError` for a masked array, whose mask would be lost, and for a sparse one."""
    if isinstance(value, np.ma.MaskedArray):
        raise InvalidArgumentError(
            f"{name} is a masked array, and its mask would be lost; remove the masked rows first, "
            f"{name}.data[~np.ma.getmaskarray({name}).reshape(len({name}), -1).any(1)], or fill them with "
            f"{name}.filled(value)."
        )
    if hasattr(value, "toarray"):
        raise InvalidArgumentError(f"{name} is sparse, a {type(value).__name__}; give {name}.toarray().")


def _complex(name: str, dtype: object) -> InvalidArgumentError:
    return InvalidArgumentError(f"{name} is complex ({dtype}); give real numbers, such as {name}.real.")
