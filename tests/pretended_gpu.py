"""A pretended GPU: tensors that say they are on cuda:0 and compute on the CPU.

As on a GPU, an operation refuses tensors of both devices (except CPU tensors without dimensions), and
`numpy()` needs `cpu()` first. `with pretended_gpu() as gpu:` runs code with `device="cuda"`. `gpu.waits`
counts the operations after which Python waits for the device. An operation whose result is a new tensor of
more than `gpu.most_bytes` is out of memory.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

GPU = torch.device("cuda", 0)
_WAITING = {
    "_local_scalar_dense",
    "nonzero",
    "_unique2",
    "unique_consecutive",
    "masked_select",
    "equal",
    "bincount",
}
_INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index"}


class GPUTensor(Tensor):
    """A tensor of the pretended GPU; `held` has its values."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> GPUTensor:
        made = Tensor._make_wrapper_subclass(
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device="meta",
            requires_grad=held.requires_grad,
        )
        made.held = held
        return made

    device = property(lambda self: GPU)
    is_cuda = property(lambda self: True)
    is_meta = property(lambda self: False)

    def data_ptr(self) -> int:
        return self.held.data_ptr()

    def __repr__(self, **options: Any) -> str:
        return f"GPUTensor({self.held})"

    def numpy(self, *args: Any, **options: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy; use Tensor.cpu() first.")

    __array__ = numpy

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        return _run(func, args, kwargs or {}, Counter())


def _is_gpu(device: Any) -> bool:
    return device is not None and torch.device(device).type in (
        "cuda",
        "meta",
    )  # torch takes a wrapper for meta


def _held(tree: Any) -> Any:
    return tree_map_only(GPUTensor, lambda tensor: tensor.held, tree)


def _moved_to_gpu(tree: Any) -> Any:
    return tree_map_only(Tensor, lambda t: t if isinstance(t, GPUTensor) else GPUTensor(t), tree)


def _run(func: Any, args: Any, kwargs: dict[str, Any], waits: Counter[str]) -> Any:
    name = func.overloadpacket.__name__
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    from_gpu = any(isinstance(tensor, GPUTensor) for tensor in tensors)
    device = kwargs.get("device")
    to_gpu = from_gpu if device is None else _is_gpu(device)
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if name not in ("_to_copy", "copy_") and from_gpu:
        _check_devices(func, name, args, tensors)
    if name in _WAITING or (from_gpu and not to_gpu):
        waits[name] += 1
    if name == "repeat_interleave" and kwargs.get("output_size") is None:
        waits[name] += 1
    result = func(*_held(args), **_held(kwargs))
    if func._schema.is_mutable and name.endswith("_"):
        return args[0]
    if func._schema.is_mutable and "out" in kwargs:
        return kwargs["out"]
    return _moved_to_gpu(result) if to_gpu else result


def _check_devices(func: Any, name: str, args: Any, tensors: list[Tensor]) -> None:
    indices = {id(i) for i in args[1]} if name in _INDEXING and isinstance(args[0], GPUTensor) else set()
    for tensor in tensors:
        if not isinstance(tensor, GPUTensor) and tensor.dim() > 0 and id(tensor) not in indices:
            raise RuntimeError(f"{func}: expected all tensors on the same device, but found cuda:0 and cpu.")


def _check_memory(result: Any, arguments: Any, most_bytes: float) -> None:
    """Raises as CUDA does if a new tensor is larger than `most_bytes`."""
    given = {t.held.data_ptr() for t in tree_leaves(arguments) if isinstance(t, GPUTensor)}
    for made in tree_leaves(result):
        if isinstance(made, GPUTensor) and made.held.data_ptr() not in given:
            asked = made.held.numel() * made.held.element_size()
            if asked > most_bytes and made.held.is_contiguous():
                asked_for = f"Tried to allocate {asked / 2**20:.2f} MiB. GPU 0 has a total capacity"
                raise torch.OutOfMemoryError(f"CUDA out of memory. {asked_for}")


class _Dispatch(TorchDispatchMode):
    def __init__(self, gpu: PretendedGPU) -> None:
        super().__init__()
        self.gpu = gpu

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        kwargs = kwargs or {}
        if _is_gpu(kwargs.get("device")) or any(
            isinstance(t, GPUTensor) for t in tree_leaves((args, kwargs))
        ):
            result = _run(func, args, kwargs, self.gpu.waits)
            _check_memory(result, (args, kwargs), self.gpu.most_bytes)
            return result
        return func(*args, **kwargs)


class _Functions(TorchFunctionMode):
    """Data become tensors on the CPU and move; tensors move by `_Move`, which has a gradient."""

    def __init__(self, gpu: PretendedGPU) -> None:
        super().__init__()
        self.gpu = gpu

    def __torch_function__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        kwargs = dict(kwargs or {})
        if func in (torch.tensor, torch.as_tensor):
            if isinstance(args[0], GPUTensor):
                return _move(args[0], list(args[1:]), kwargs)
            device = kwargs.pop("device", None)
            return _move(func(*args, **kwargs), [device], {})
        if func is Tensor.new_tensor and isinstance(args[0], GPUTensor):
            kwargs.setdefault("dtype", args[0].dtype)
            return _move(torch.tensor(*args[1:], **kwargs), [GPU], {})
        if func in (Tensor.__getitem__, Tensor.__setitem__) and isinstance(args[0], GPUTensor):
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            index = tuple(torch.tensor(part) if isinstance(part, list) else part for part in index)
            return func(args[0], index, *args[2:])
        if func is Tensor.tolist and isinstance(args[0], GPUTensor):
            self.gpu.waits["tolist"] += 1
            return args[0].held.tolist()
        if func in (Tensor.to, Tensor.cuda, Tensor.cpu):
            rest = list(args[1:]) if func is Tensor.to else ["cuda" if func is Tensor.cuda else "cpu"]
            moved = _move(args[0], rest, kwargs)
            self.gpu.waits["to cpu"] += isinstance(args[0], GPUTensor) and not isinstance(moved, GPUTensor)
            return moved
        return func(*args, **kwargs)


def _move(tensor: Tensor, rest: list[Any], kwargs: dict[str, Any]) -> Tensor:
    device, dtype = kwargs.get("device"), kwargs.get("dtype")
    for argument in rest:
        if isinstance(argument, Tensor):
            device, dtype = argument.device, argument.dtype
        elif isinstance(argument, torch.dtype):
            dtype = argument
        elif isinstance(argument, str | torch.device):
            device = argument
    dtype = tensor.dtype if dtype is None else dtype
    to_gpu = isinstance(tensor, GPUTensor) if device is None else _is_gpu(device)
    if to_gpu == isinstance(tensor, GPUTensor) and dtype == tensor.dtype and not kwargs.get("copy"):
        return tensor
    return _Move.apply(tensor, to_gpu, dtype)


class _Move(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor, to_gpu, dtype):  # type: ignore[no-untyped-def]
        ctx.was_gpu, ctx.dtype = isinstance(tensor, GPUTensor), tensor.dtype
        copied = _held(tensor).detach().to(dtype, copy=True)
        return GPUTensor(copied) if to_gpu else copied

    @staticmethod
    def backward(ctx, gradient):  # type: ignore[no-untyped-def]
        return _Move.apply(gradient, ctx.was_gpu, ctx.dtype), None, None


class PretendedGPU:
    """`waits`: operations after which Python waited for the device, by name. `most_bytes` of a new tensor."""

    def __init__(self) -> None:
        self.waits: Counter[str] = Counter()
        self.most_bytes = float("inf")


@contextmanager
def pretended_gpu() -> Iterator[PretendedGPU]:
    """Tensors of the device "cuda" exist while the block runs.

    Skips the test where there is a real GPU: the tables that are kept for it would meet pretended tensors.
    """
    if torch.cuda.is_available():
        pytest.skip("a real GPU is there")
    gpu = PretendedGPU()
    with ExitStack() as stack:
        # A wrapper cannot be an inference tensor.
        stack.enter_context(mock.patch.object(torch, "inference_mode", torch.no_grad))
        for name, value in (("is_available", True), ("device_count", 1), ("_lazy_init", None)):
            stack.enter_context(mock.patch.object(torch.cuda, name, lambda value=value: value))
        properties = SimpleNamespace(total_memory=1 << 36, multi_processor_count=1)
        stack.enter_context(mock.patch.object(torch.cuda, "get_device_properties", return_value=properties))
        stack.enter_context(_Dispatch(gpu))
        stack.enter_context(_Functions(gpu))
        yield gpu
