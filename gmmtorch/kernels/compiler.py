"""FusedKernel: a loop in C++ that Warp compiles for the CPU (with its own LLVM) or for CUDA.

Each kernel is a Warp module of its own, compiled at its first use: a machine compiles only what it runs. The
result is cached in a folder; without a folder that can be written, in a temporary one, for this process.
"""

from __future__ import annotations

import functools
import itertools
import logging
import os
import re
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import GmmTorchError

logger = logging.getLogger(__name__)

_TYPES = {"int64": "int64", "double": "float64", "float": "float32", "bool": "bool"}
_POINTERS = {"int64": "int64_t", "int32": "int32_t", "uint8": "uint8_t"}
_LEAST_ITEMS = 1 << 10  # of a thread
_lock = threading.RLock()

_PRELUDE = """
#if defined(__CUDA_ARCH__)
#define GMM_ADD(place, value) atomicAdd(place, value)
#else
#define GMM_ADD(place, value) (*(place) += (value))
#endif
#define GMM_MIN(a, b) ((a) < (b) ? (a) : (b))
#define GMM_MAX(a, b) ((a) > (b) ? (a) : (b))
"""


class FusedKernel:
    """A C++ loop body, which runs once for each `item` (int64) from 0 up to the size of a launch.

    Args:
        name: a C++ identifier, unique among the kernels.
        parameters: C++ parameters of the types int64, double, float, bool, and pointers to these and to
            int32 and uint8, separated by commas. A pointer is a tensor, or None for a null pointer.
        body: C++ statements. GMM_ADD(pointer, value) adds so that items can meet in one place on CUDA.
        shares: whether items write to the same places. Such a launch uses one thread of a CPU.
        strided: parameters whose tensors need not be contiguous, because the body is given their strides.
        rounds_each: whether the compiler must round every product, as tensor operations do, and not contract
            a * b + c. Results of such a kernel can equal those of tensor operations to the bit.
    """

    def __init__(
        self,
        name: str,
        parameters: str,
        body: str,
        shares: bool = False,
        strided: tuple[str, ...] = (),
        rounds_each: bool = False,
    ) -> None:
        self.name, self.shares, self._strided, self._rounds_each = name, shares, strided, rounds_each
        self._labels: list[str] = []
        casts, names, types = [], [], []
        for parameter in parameters.split(","):
            match = re.fullmatch(r"\s*(const\s+)?(\w+)\s*(\*?)\s*(\w+)\s*", parameter)
            if match is None:
                raise ValueError(f"parameter {parameter!r} of kernel {name} is not `type name`.")
            const, kind, star, label = match.groups()
            self._labels.append(label)
            names.append(label + "_" if star else label)
            types.append("uint64" if star else _TYPES[kind])
            if star:
                cpp = f"{const or ''}{_POINTERS.get(kind, kind)}*"
                casts.append(f"{cpp} {label} = ({cpp}){label}_;")
        signature = ", ".join(f"{n}: wp.{t}" for n, t in zip(names, types, strict=True))
        self._body = _PRELUDE + "\n".join(casts) + body
        self._stub = f"def {name}_body(item: wp.int64, {signature}): ...\n"
        self._entry = (
            f"def {name}(begin: wp.int64, {signature}):\n"
            f"    {name}_body(begin + wp.int64(wp.tid()), {', '.join(names)})\n"
        )
        self._kernel: Any = None
        self._loaded: set[torch.device] = set()
        self._launches = threading.local()

    def __call__(self, n_items: int, *arguments: Tensor | float | None, device: torch.device) -> None:
        """Run the body for the items 0 … n_items − 1.

        Tensors must be on `device` and of the type of their pointers; this is not checked. Raises
        `GmmTorchError` for a tensor that is not contiguous, unless it is `strided`. On a CPU the items are
        split over `torch.get_num_threads()` threads, unless the kernel `shares`.
        """
        if n_items == 0:
            return
        values = [self._value(*pair) for pair in zip(self._labels, arguments, strict=True)]
        self.load(device)
        wp = _warp()
        if device.type == "cuda":
            stream = wp.stream_from_torch(torch.cuda.current_stream(device))
            wp.launch(self._kernel, dim=n_items, inputs=[0, *values], device=str(device), stream=stream)
            return
        n_threads = 1 if self.shares else min(torch.get_num_threads(), 1 + n_items // _LEAST_ITEMS)
        if n_threads == 1:
            self._launch_again(wp, n_items, [0, *values])
            return
        bounds = [n_items * part // n_threads for part in range(n_threads + 1)]
        jobs = [
            _threads(n_threads).submit(
                wp.launch, self._kernel, dim=stop - begin, inputs=[begin, *values], device="cpu"
            )
            for begin, stop in itertools.pairwise(bounds)
        ]
        for job in jobs:
            job.result()  # Warp releases the interpreter's lock during a launch

    def _launch_again(self, wp: Any, n_items: int, values: list[float]) -> None:
        """Repeat this thread's last launch on the CPU with other values: a new one takes twice as long."""
        launch = getattr(self._launches, "last", None)
        if launch is None:
            launch = wp.launch(self._kernel, dim=n_items, inputs=values, device="cpu", record_cmd=True)
            self._launches.last = launch
        else:
            launch.set_dim(n_items)
            launch.set_params_from_ctypes(values)
        launch.launch()

    def _value(self, label: str, argument: Tensor | float | None) -> float:
        """What is passed for an argument: the address of a tensor, 0 for None."""
        if not isinstance(argument, Tensor):
            return 0 if argument is None else argument
        if not argument.is_contiguous() and label not in self._strided:
            raise GmmTorchError(
                f"{label} of kernel {self.name} has shape {tuple(argument.shape)} and strides "
                f"{argument.stride()}, which are not contiguous; pass tensor.contiguous()."
            )
        return argument.data_ptr()

    def load(self, device: torch.device) -> None:
        """Compile the kernel for a device, or load it from the cache; nothing if that is done.

        Raises `GmmTorchError` if it does not compile.
        """
        if device in self._loaded:
            return
        with _lock:
            if device in self._loaded:
                return
            wp = _warp()
            if self._kernel is None:
                self._kernel = self._defined(wp)
            module, block = self._kernel.module, 1 if device.type == "cpu" else None
            if not (Path(wp.config.kernel_cache_dir) / module.get_module_identifier(block)).is_dir():
                _announce(str(device), wp.config.kernel_cache_dir)
            begin = time.perf_counter()
            try:
                loaded = module.load(wp.get_device(str(device)), block)
            except Exception as error:
                raise GmmTorchError(f"kernel {self.name} does not compile for {device} ({error})") from error
            if not loaded:
                raise GmmTorchError(f"kernel {self.name} does not compile for {device}")
            logger.debug("Kernel %s is ready after %.2f s.", self.name, time.perf_counter() - begin)
            self._loaded.add(device)

    def _defined(self, wp: Any) -> Any:
        """The kernel of Warp: the body and its entry, in a module of their own."""
        import linecache

        for part in (self._stub, self._entry):
            path = f"<gmmtorch kernel {self.name} {'stub' if part is self._stub else 'entry'}>"
            linecache.cache[path] = (len(part), None, part.splitlines(True), path)
        scope: dict[str, Any] = {"wp": wp, "__name__": f"gmmtorch_{self.name}"}
        exec(compile(self._stub, f"<gmmtorch kernel {self.name} stub>", "exec"), scope)
        body = f"{self.name}_body"
        scope[body] = wp.func_native(self._body)(scope[body])
        exec(compile(self._entry, f"<gmmtorch kernel {self.name} entry>", "exec"), scope)
        module = wp.get_module(scope["__name__"])
        wp.set_module_options({"fuse_fp": not self._rounds_each}, module)
        return wp.kernel(scope[self.name], enable_backward=False, module=module, grid_stride=False)


@functools.cache
def _announce(device: str, folder: str) -> None:
    """Logs, once for each device, that kernels are compiled."""
    logger.info(
        "Compiling fused kernels for %s, each at its first use (seconds in all); they are kept in %s.",
        device,
        folder,
    )


@functools.cache
def _threads(n: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(n, thread_name_prefix="gmmtorch-kernels")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)  # a child process has no threads


_PROBE = FusedKernel("probe", "int64* value", "value[item] = item + 1;")


@functools.cache
def compiler_failure() -> str | None:
    """Why the kernel compiler does not work, or None. The first call compiles a small kernel and runs it."""
    value = torch.zeros(1, dtype=torch.int64)
    try:
        _PROBE(1, value, device=value.device)
    except GmmTorchError as error:
        return str(error)
    return None if int(value) == 1 else "a kernel gives a wrong result"


@functools.cache
def _warp() -> Any:
    """The module warp, set up. Raises `GmmTorchError` if it does not load."""
    try:
        import warp as wp
    except Exception as error:  # a broken installation fails in many ways
        raise GmmTorchError(f"the package warp-lang does not load ({error})") from error
    from_user = wp.config.kernel_cache_dir or os.environ.get("WARP_CACHE_PATH")
    wp.config.log_level = max(wp.config.log_level, wp.LOG_ERROR)
    wp.config.kernel_cache_dir = str(_cache_folder(Path(from_user) if from_user else None))
    with _without_driver_warning():
        wp.init()
    return wp


@contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Without a GPU, discards what Warp's library writes to stderr: that it found no driver."""
    if torch.cuda.is_available():
        yield
        return
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _cache_folder(preferred: Path | None) -> Path:
    """The folder of compiled kernels: `preferred`, the user's cache, or a temporary folder."""
    home = os.environ.get("XDG_CACHE_HOME")
    for folder in (preferred, (Path(home) if home else Path.home() / ".cache") / "gmmtorch" / "kernels"):
        if folder is None:
            continue
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    logger.info("Compiled kernels are not kept, because no cache folder can be written.")
    return _temporary_folder()


@functools.cache
def _temporary_folder() -> Path:
    folder = tempfile.TemporaryDirectory(prefix="gmmtorch-kernels-")
    _kept.append(folder)
    return Path(folder.name)


_kept: list[object] = []  # removed when the process ends
