"""FusedKernel: a loop in C++ that Warp compiles for the CPU (with its own LLVM) or for CUDA.

Each kernel is a Warp module of its own, compiled at its first use: a machine compiles only what it runs. The
result is cached in a folder; without a folder that can be written, in a temporary one, for this process.
"""

from __future__ import annotations

import ctypes
import functools
import itertools
import linecache
import logging
import os
import re
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import GmmTorchError

logger = logging.getLogger(__name__)

_TYPES = {"int64": "int64", "double": "float64", "float": "float32", "bool": "bool"}
_PACKED = {"int64": "q", "double": "d", "float": "f4x", "bool": "?7x"}
"""Formats of `struct` that place each argument of a CPU in eight bytes."""
_POINTERS = {"int64": "int64_t", "int32": "int32_t", "uint8": "uint8_t"}
_LEAST_ITEMS = 1 << 10  # of a thread of a CPU
_BLOCK = 64
"""Items of a block on CUDA. Few, because many kernels have some thousand items, each with much work: they
spread over all multiprocessors."""
_lock = threading.RLock()

_PRELUDE = """
#if defined(__CUDA_ARCH__)
#define GMM_ADD(place, value) atomicAdd(place, value)
#define GMM_FETCH(place, n)
#else
#define GMM_ADD(place, value) (*(place) += (value))
#define GMM_FETCH(place, n) \\
    for (int byte = 0; byte < (n) * 8; byte += 64) __builtin_prefetch((const char*)(place) + byte)
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
        self._parameters = [_parsed(parameter, name) for parameter in parameters.split(",")]
        self._packed = struct.Struct(
            "=" + "".join("Q" if p.pointer else _PACKED[p.type] for p in self._parameters)
        )
        self._body = body
        self._kernels: dict[str, Any] = {}  # of Warp, by type of device
        self._loaded: set[torch.device] = set()
        self._threads = threading.local()

    def __call__(self, n_items: int, *arguments: Tensor | float | None, device: torch.device) -> None:
        """Run the body for the items 0 … n_items − 1.

        Tensors must be on `device` and of the type of their pointers; this is not checked. Raises
        `GmmTorchError` for a tensor that is not contiguous, unless it is `strided`. On a CPU the items are
        split over `torch.get_num_threads()` threads, unless the kernel `shares`.
        """
        if n_items == 0:
            return
        values = self._values(arguments)
        if device not in self._loaded:
            self.load(device)
        if device.type == "cuda":
            self._cuda_launch_of_thread(device)(n_items, values)
            return
        launch = self._launch_of_thread()
        self._packed.pack_into(launch.block, 0, *values)
        n_threads = 1 if self.shares else min(torch.get_num_threads(), 1 + n_items // _LEAST_ITEMS)
        if n_threads == 1:
            launch(0, n_items, launch.block)
            return
        bounds = [n_items * part // n_threads for part in range(n_threads + 1)]
        jobs = [
            _threads(n_threads).submit(
                lambda *part: self._launch_of_thread()(*part), begin, stop, launch.block
            )
            for begin, stop in itertools.pairwise(bounds)
        ]
        for job in jobs:
            job.result()  # Warp releases the interpreter's lock during a launch

    def _values(self, arguments: tuple[Tensor | float | None, ...]) -> list[float]:
        """What is passed for the arguments: the address of a tensor, 0 for None."""
        values: list[float] = []
        for parameter, argument in zip(self._parameters, arguments, strict=True):
            if isinstance(argument, Tensor):
                if not argument.is_contiguous() and parameter.label not in self._strided:
                    raise GmmTorchError(
                        f"{parameter.label} of kernel {self.name} has shape {tuple(argument.shape)} and "
                        f"strides {argument.stride()}, which are not contiguous; pass tensor.contiguous()."
                    )
                values.append(argument.data_ptr())
            else:
                values.append(0 if argument is None else argument)
        return values

    def _launch_of_thread(self) -> _CpuLaunch:
        """The launch of this thread, which is repeated with other values: a new one takes much longer."""
        launch: _CpuLaunch | None = getattr(self._threads, "launch", None)
        if launch is None:
            launch = self._threads.launch = _CpuLaunch(self._kernels["cpu"], self._packed.size)
        return launch

    def _cuda_launch_of_thread(self, device: torch.device) -> _CudaLaunch:
        """The launch of this thread on a GPU, which is repeated in the same way."""
        launches: dict[torch.device, _CudaLaunch] = self._threads.__dict__.setdefault("on_gpu", {})
        if device not in launches:
            launches[device] = _CudaLaunch(self._kernels["cuda"], device, len(self._parameters))
        return launches[device]

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
            module, block = self.defined(device.type).module, 1 if device.type == "cpu" else _BLOCK
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

    def defined(self, kind: str) -> Any:
        """The kernel of Warp for the type of device "cpu" or "cuda", in a module of its own."""
        if kind not in self._kernels:
            wp = _warp()
            native, stub, entry = self._for_cpu() if kind == "cpu" else self._for_cuda()
            scope: dict[str, Any] = {
                "wp": wp,
                "__name__": f"gmmtorch_{self.name}{'_cuda' * (kind == 'cuda')}",
            }
            for part, code in (("stub", stub), ("entry", entry)):
                path = f"<gmmtorch kernel {self.name} {kind} {part}>"
                linecache.cache[path] = (len(code), None, code.splitlines(True), path)
                exec(compile(code, path, "exec"), scope)
                if part == "stub":
                    scope["body"] = wp.func_native(_PRELUDE + native)(scope["body"])
            module = wp.get_module(scope["__name__"])
            wp.set_module_options({"fuse_fp": not self._rounds_each, "block_dim": _BLOCK}, module)
            self._kernels[kind] = wp.kernel(
                scope[self.name], enable_backward=False, module=module, grid_stride=False
            )
        return self._kernels[kind]

    def _for_cpu(self) -> tuple[str, str, str]:
        """C++ of a loop over items, and the stub and the entry in Python. The arguments come in one block of
        memory, because Warp takes microseconds for each argument."""
        read = [
            f"{p.cpp} {p.label} = *({p.cpp}*)(gmm_block + {8 * n});" for n, p in enumerate(self._parameters)
        ]
        native = [
            "const char* gmm_block = (const char*)gmm_block_;",
            *read,
            "auto gmm_run = [=](const int64_t item) {",
            self._body,
            "};",
            "for (int64_t item = gmm_begin; item < gmm_stop; ++item) gmm_run(item);",
        ]
        names = ("gmm_begin", "gmm_stop", "gmm_block_")
        signature = ", ".join(
            f"{n}: wp.{t}" for n, t in zip(names, ("int64", "int64", "uint64"), strict=True)
        )
        stub = f"def body({signature}): ...\n"
        return "\n".join(native), stub, f"def {self.name}({signature}):\n    body({', '.join(names)})\n"

    def _for_cuda(self) -> tuple[str, str, str]:
        """C++ of one item, and the stub and the entry in Python."""
        names = [p.label + "_" * p.pointer for p in self._parameters]
        types = ["uint64" if p.pointer else _TYPES[p.type] for p in self._parameters]
        casts = [f"{p.cpp} {p.label} = ({p.cpp}){p.label}_;" for p in self._parameters if p.pointer]
        signature = ", ".join(f"{n}: wp.{t}" for n, t in zip(names, types, strict=True))
        stub = f"def body(item: wp.int64, {signature}): ...\n"
        entry = f"def {self.name}({signature}):\n    body(wp.int64(wp.tid()), {', '.join(names)})\n"
        return "\n".join(casts) + self._body, stub, entry


class _Parameter(NamedTuple):
    """A parameter of a kernel: its name, the type of its values, its type in C++, whether it is a pointer."""

    label: str
    type: str
    cpp: str
    pointer: bool


def _parsed(parameter: str, kernel: str) -> _Parameter:
    match = re.fullmatch(r"\s*(const\s+)?(\w+)\s*(\*?)\s*(\w+)\s*", parameter)
    if match is None:
        raise ValueError(f"parameter {parameter!r} of kernel {kernel} is not `type name`.")
    const, kind, star, label = match.groups()
    cpp = f"{const or ''}{_POINTERS.get(kind, kind)}{star}"
    return _Parameter(label, kind, cpp, bool(star))


class _CpuLaunch:
    """A launch of a kernel on a CPU that can be repeated: (begin, stop, block of arguments).

    Attributes:
        block: memory for the arguments of one launch.
    """

    def __init__(self, kernel: Any, n_bytes: int) -> None:
        self.block = ctypes.create_string_buffer(n_bytes)
        values = [0, 0, ctypes.addressof(self.block)]
        self._launch = _warp().launch(kernel, dim=1, inputs=values, device="cpu", record_cmd=True)

    def __call__(self, begin: int, stop: int, block: ctypes.Array[ctypes.c_char]) -> None:
        self._launch.set_params_from_ctypes([begin, stop, ctypes.addressof(block)])
        self._launch.launch()


class _CudaLaunch:
    """A launch of a kernel on a GPU that can be repeated: (n_items, values of the arguments)."""

    def __init__(self, kernel: Any, device: torch.device, n_values: int) -> None:
        self._device = device
        self._streams: dict[int, Any] = {}
        self._launch = _warp().launch(
            kernel, 1, inputs=[0] * n_values, device=str(device), block_dim=_BLOCK, record_cmd=True
        )

    def __call__(self, n_items: int, values: list[float]) -> None:
        for place, value in zip(self._launch.params[1:], values, strict=True):
            place.value = value
        self._launch.set_dim(n_items)
        self._launch.launch(self._current_stream())

    def _current_stream(self) -> Any:
        """The stream of torch, as Warp's: an object is made for each only once."""
        stream = torch.cuda.current_stream(self._device)
        if stream.cuda_stream not in self._streams:
            self._streams[stream.cuda_stream] = _warp().stream_from_torch(stream)
        return self._streams[stream.cuda_stream]


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
