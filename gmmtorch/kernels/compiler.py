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
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.errors import GmmTorchError

A = TypeVar("A")
Buffer = Tensor | NDArray[Any]
logger = logging.getLogger(__name__)

_TYPES = {
    "int64_t": ("int64", "q"),
    "double": ("float64", "d"),
    "float": ("float32", "f4x"),
    "bool": ("bool", "?7x"),
}
"""The type in Warp of a number in C++, and the format of `struct` that places it in eight bytes."""
_CPP = {torch.float64: "double", torch.float32: "float", torch.int32: "int32_t"}
_NUMPY: dict[torch.dtype, type] = {
    torch.float64: np.float64,
    torch.float32: np.float32,
    torch.int64: np.int64,
    torch.int32: np.int32,
}
_LEAST_ITEMS = 1 << 10  # of a thread of a CPU
_BLOCK = 64
"""Items of a block on CUDA. Few, because many kernels have some thousand items, each with much work: they
spread over all multiprocessors."""
_BLOCKS_OF_TEAM = 4
"""Blocks of a team on each multiprocessor. So many are there at a time with 255 registers a thread, so none
waits for a block that has not begun."""
_CPU = torch.device("cpu")
_lock = threading.RLock()

CPU_LANES = 8
"""Lanes of a vector on a CPU, as in `lanes.h`; CUDA has one lane in each thread."""


class FusedKernel:
    """A C++ function, which runs once for each `item` (int64_t) from 0 up to the size of a launch.

    Its other parameters are int64_t, double, float, bool, pointers, or structures of these, whose fields are
    passed one by one. A pointer is a tensor, an array on the CPU, or None for a null pointer.

    Args:
        source: the file with the function, relative to this one.
        call: its name, with the arguments of its template; unique among the kernels.
        shares: whether items write to the same places. Such a launch uses one thread of a CPU.
        rounds_each: whether the compiler must round every product, as tensor operations do, and not contract
            a * b + c. Results of such a kernel can equal those of tensor operations to the bit.
    """

    def __init__(self, source: str, call: str, shares: bool = False, rounds_each: bool = False) -> None:
        self.name = re.sub(r"\W+", "_", call).strip("_")
        self.shares, self._rounds_each = shares, rounds_each
        self._source, self._call = (Path(__file__).parent / source).resolve(), call
        self._kernels: dict[str, Any] = {}  # of Warp, by type of device
        self._loaded: set[torch.device] = set()
        self._threads = threading.local()

    def __call__(self, n_items: int, *arguments: Buffer | float | None) -> None:
        """Run the function for the items 0 … n_items − 1, on the device of the tensors.

        Tensors must be on one device and of the type of their pointers; this is not checked. One that is not
        contiguous is copied if the function only reads it, and raises `GmmTorchError` otherwise. On a CPU the
        items are split over `torch.get_num_threads()` threads, unless the kernel `shares`.
        """
        if n_items == 0:
            return
        values, tensors = self._values(arguments)
        device = tensors[0].device if tensors else _CPU
        if device not in self._loaded:
            self.load(device)
        if device.type == "cuda":
            launch = self._recorded(device)
            for place, value in zip(launch.params[1:], values, strict=True):
                place.value = value
            launch.set_dim(n_items)
            launch.launch(_warp_stream(torch.cuda.current_stream(device)))
            return
        block = self._block()
        self._packed.pack_into(block, 0, *values)
        n_threads = 1 if self.shares else min(torch.get_num_threads(), 1 + n_items // _LEAST_ITEMS)
        if n_threads == 1:
            self._run(block, 0, n_items)
            return
        bounds = [n_items * part // n_threads for part in range(n_threads + 1)]
        jobs = [_threads(n_threads).submit(self._run, block, *part) for part in itertools.pairwise(bounds)]
        for job in jobs:
            job.result()  # Warp releases the interpreter's lock during a launch

    def _run(self, block: ctypes.Array[ctypes.c_char], begin: int, stop: int) -> None:
        """Runs some items on a CPU, with the arguments in a block of memory."""
        launch = self._recorded(_CPU)
        numbers = (ctypes.c_int64 * 3)(begin, stop, ctypes.addressof(block))
        # What `launch.launch()` does, without building a structure by names: that takes ten times as long.
        launch.hooks.forward(ctypes.byref(launch.params[0]), ctypes.byref(numbers))

    def _block(self) -> ctypes.Array[ctypes.c_char]:
        """The memory for the arguments of this thread's launches."""
        own = self._threads.__dict__
        if "block" not in own:
            own["block"] = ctypes.create_string_buffer(self._packed.size)
        return own["block"]

    def _recorded(self, device: torch.device) -> Any:
        """The launch of this thread, which is repeated with other values: a new one takes much longer."""
        launches: dict[torch.device, Any] = self._threads.__dict__.setdefault("launches", {})
        if device not in launches:
            kernel, how = self._kernels[device.type], {"device": str(device), "record_cmd": True}
            if device.type == "cuda":
                how |= {"block_dim": _BLOCK}
            n_values = 3 if device.type == "cpu" else len(self._parameters)
            launches[device] = _warp().launch(kernel, 1, inputs=[0] * n_values, **how)
        return launches[device]

    @functools.cached_property
    def _text(self) -> str:
        return _with_includes(self._source, set())

    @functools.cached_property
    def _signature(self) -> tuple[list[_Parameter], str]:
        """The parameters, with the fields of structures, and the C++ of a call with these."""
        text = re.sub(r"//.*", "", self._text)
        name, *given = re.findall(r"\w+", self._call)
        match = re.search(rf"(template <[^>]*>\s*)?GMM_KERNEL {name}\(\s*int64_t(?: item)?, ([^)]*)\)", text)
        if match is None:
            raise ValueError(f"{self._source} has no kernel {name}.")
        values = dict(zip(re.findall(r"\w+ (\w+)", match[1] or ""), given, strict=True))
        found, passed = [], ["item"]
        for declared in match[2].split(","):
            *_, kind, label = re.findall(r"\w+", declared)
            fields = re.search(rf"struct {kind} {{(.*?)}};", text, re.S)
            own = _declared(fields[1].split(";")[:-1] if fields else [declared], values)
            found += own
            joined = ", ".join(parameter.label for parameter in own)
            passed.append(f"gmm::{kind}{{{joined}}}" if fields else label)
        return found, f"gmm::{self._call}({', '.join(passed)});"

    @property
    def _parameters(self) -> list[_Parameter]:
        return self._signature[0]

    @functools.cached_property
    def _packed(self) -> struct.Struct:
        return struct.Struct("=" + "".join("Q" if p.pointer else _TYPES[p.cpp][1] for p in self._parameters))

    def _values(self, arguments: tuple[Buffer | float | None, ...]) -> tuple[list[float], list[Tensor]]:
        """Numbers, with the address for a tensor or array and 0 for None; and the tensors, which a launch
        needs."""
        values: list[float] = []
        tensors = []
        for argument in arguments:
            if isinstance(argument, np.ndarray):
                if argument.flags.c_contiguous:
                    values.append(argument.ctypes.data)
                    continue
                argument = torch.from_numpy(argument)
            if isinstance(argument, Tensor):
                if not argument.is_contiguous():
                    parameter = self._parameters[len(values)]
                    if not parameter.cpp.startswith("const "):
                        raise GmmTorchError(
                            f"{parameter.label} of kernel {self.name} has shape {tuple(argument.shape)} and "
                            f"strides {argument.stride()}, which are not contiguous; pass "
                            "tensor.contiguous()."
                        )
                    argument = argument.contiguous()
                tensors.append(argument)
                values.append(argument.data_ptr())
            else:
                values.append(0 if argument is None else argument)
        return values, tensors

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
                    scope["body"] = wp.func_native(native)(scope["body"])
            module = wp.get_module(scope["__name__"])
            build = wp.ModuleBuildOptions(extra_cpu_preamble=self._text, extra_cuda_preamble=self._text)
            options = {"fuse_fp": not self._rounds_each, "block_dim": _BLOCK, "extra_build_options": build}
            wp.set_module_options(options, module)
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
            f"for (int64_t item = gmm_begin; item < gmm_stop; ++item) {self._signature[1]}",
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
        types = ["uint64" if p.pointer else _TYPES[p.cpp][0] for p in self._parameters]
        casts = [f"{p.cpp} {p.label} = ({p.cpp}){p.label}_;" for p in self._parameters if p.pointer]
        signature = ", ".join(f"{n}: wp.{t}" for n, t in zip(names, types, strict=True))
        stub = f"def body(item: wp.int64, {signature}): ...\n"
        entry = f"def {self.name}({signature}):\n    body(wp.int64(wp.tid()), {', '.join(names)})\n"
        return "\n".join([*casts, self._signature[1]]), stub, entry


def templated(
    source: str, name: str, arguments: Iterable[A], shares: bool = False, rounds_each: bool = False
) -> dict[A, FusedKernel]:
    """A kernel for each argument of a template: a number, a truth value, a type, or a tuple of these."""

    def text(argument: object) -> str:
        if isinstance(argument, tuple):
            return ", ".join(map(text, argument))
        return _CPP[argument] if isinstance(argument, torch.dtype) else str(argument).lower()

    return {a: FusedKernel(source, f"{name}<{text(a)}>", shares, rounds_each) for a in arguments}


class Team(NamedTuple):
    """The workers of a launch that wait for each other, in C++ `gmm::Team`; n is the size of the launch."""

    n: int
    arrived: Tensor | None
    rounds: int = 0

    @staticmethod
    def of(device: torch.device, most: int | None = None) -> Team:
        """One worker on a CPU; on a GPU as many as it runs at a time, or blocks of `most` items."""
        if device.type == "cpu":
            return Team(1, None)
        n_blocks = _BLOCKS_OF_TEAM * torch.cuda.get_device_properties(device).multi_processor_count
        if most is not None:
            n_blocks = min(n_blocks, -(-most // _BLOCK))
        return Team(n_blocks * _BLOCK, torch.zeros(1, dtype=torch.int32, device=device))


def buffers(
    device: torch.device, dtype: torch.dtype, sizes: Sequence[int], is_zero: bool = False
) -> Sequence[Buffer]:
    """Uninitialised numbers, or zeros, for a launch: an array of each size on a CPU, a tensor elsewhere. An
    array begins at a whole vector of `lanes.h`."""
    if device.type != "cpu":
        return (torch.zeros if is_zero else torch.empty)(sum(sizes), dtype=dtype, device=device).split(sizes)
    room, width = [size + -size % 16 for size in sizes], dtype.itemsize
    made: NDArray[Any] = (np.zeros if is_zero else np.empty)(sum(room) + 16, _NUMPY[dtype])
    begins = itertools.accumulate(room, initial=-made.ctypes.data % 64 // width)
    return [made[begin : begin + size] for begin, size in zip(begins, sizes, strict=False)]


def squad_size(device: torch.device) -> int:
    """Threads that share an item of a kernel that uses `gmm::Squad`: the launch is so many times larger."""
    return 1 if device.type == "cpu" else _BLOCK


def _with_includes(source: Path, seen: set[Path]) -> str:
    """The text of a source after that of the files that it includes, each once. Its hash identifies the
    compiled module in the cache."""
    if source in seen:
        return ""
    seen.add(source)
    text = source.read_text(encoding="utf-8")
    included = re.findall(r'^#include "(.+)"', text, re.M)
    before = [_with_includes((source.parent / name).resolve(), seen) for name in included]
    return "".join([*before, re.sub(r'^#(pragma once|include ").*\n', "", text, flags=re.M)])


class _Parameter(NamedTuple):
    """A parameter of a kernel: its name, its type in C++, whether it is a pointer."""

    label: str
    cpp: str
    pointer: bool


def _declared(declarations: list[str], values: dict[str, str]) -> list[_Parameter]:
    """The parameters that declarations name, one for each entry of an array.

    values: the arguments of the template, by name.
    """
    found = []
    for declaration in declarations:
        const, kind, star, label, size = re.findall(r"(const )?(\w+)(\*?) (\w+)(?:\[(\d)\])?", declaration)[0]
        cpp = f"{const}{values.get(kind, kind)}{star}"
        labels = [f"{label}{i}" for i in range(int(size))] if size else [label]
        found += [_Parameter(each, cpp, bool(star)) for each in labels]
    return found


@functools.cache
def _warp_stream(stream: torch.cuda.Stream) -> Any:
    """A stream of torch, as Warp's."""
    return _warp().stream_from_torch(stream)


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


_PROBE = FusedKernel("probe.h", "probe")


@functools.cache
def compiler_failure(device: torch.device = _CPU) -> str | None:
    """Why no kernel runs on the device, or None: no compiler works, or a GPU's driver is too old.

    The first call for a device compiles a small kernel and runs it.
    """
    value = torch.zeros(1, dtype=torch.int64, device=device)
    try:
        _PROBE(1, value)
    except GmmTorchError as error:
        return str(error)
    except Exception as error:  # Warp raises several types for a driver that it cannot use
        return f"no kernel runs on {device} ({error})"
    return None if int(value) == 1 else f"a kernel gives a wrong result on {device}"


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
    return Path(_temporary_folder().name)


@functools.cache
def _temporary_folder() -> tempfile.TemporaryDirectory[str]:
    """A folder that is removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="gmmtorch-kernels-")
