"""Kernels in their form for CUDA, compiled by the C++ compiler of this machine and run by its threads.

An item is a thread of a GPU, in a block of its own. The items of a team run at the same time, and so do the
threads of a squad, which are a block.
`with kernels_of_gpu():` inside of `with pretended_gpu():` runs what a GPU would run, Python and C++.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from pretended_gpu import GPU, GPUTensor
from torch import Tensor

from gmmtorch.kernels import choice
from gmmtorch.kernels.compiler import _BLOCK, FusedKernel, Team

N_THREADS = 3

_BEFORE = """
#include <atomic>
#include <climits>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <pthread.h>
#include <thread>
#include <vector>
using std::atan2, std::ceil, std::cos, std::exp, std::fabs, std::floor, std::fma, std::log, std::pow;
using std::rint, std::sin, std::sqrt;
struct Place { unsigned x; };
static thread_local Place threadIdx{0};
static Place gridDim{1}, blockDim{1};
static pthread_barrier_t of_block;
static bool has_squads = false;
static void __syncthreads() {
    if (has_squads) pthread_barrier_wait(&of_block);
}
static void __nanosleep(unsigned) { std::this_thread::yield(); }
static void __threadfence() { std::atomic_thread_fence(std::memory_order_seq_cst); }
template <typename Number>
static Number atomicAdd(Number* place, Number value) {
    Number old = *place, sum;
    do sum = old + value;
    while (!__atomic_compare_exchange(place, &old, &sum, false, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST));
    return old;
}
template <typename Number>
static Number atomicMin(Number* place, Number value) {
    Number old = *place;
    while (value < old)
        if (__atomic_compare_exchange(place, &old, &value, false, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST)) break;
    return old;
}
template <typename Number>
static Number atomicCAS(Number* place, Number expected, Number value) {
    __atomic_compare_exchange_n(place, &expected, value, false, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST);
    return expected;
}
#define CUDA_CALLABLE
#define __shared__ static
#define __CUDA_ARCH__ 900
"""

_AFTER = """
extern "C" void run(int64_t gmm_items, int64_t gmm_threads, bool gmm_squads, const char* gmm_block) {{
    gridDim.x = (unsigned)gmm_items;
    has_squads = gmm_squads;
    pthread_barrier_init(&of_block, nullptr, (unsigned)gmm_threads);
    {read}
    auto some = [=](int64_t gmm_first) {{
        if (gmm_squads) threadIdx.x = (unsigned)gmm_first;
        for (int64_t item = gmm_first; item < gmm_items; item += gmm_threads) {call}
    }};
    std::vector<std::thread> threads;
    for (int64_t t = 1; t < gmm_threads; ++t) threads.emplace_back(some, t);
    some(0);
    for (auto& thread : threads) thread.join();
}}
"""


@functools.cache
def _compiled(kernel: FusedKernel) -> Any:
    """The library of a kernel, kept among the temporary files under the hash of its source."""
    read = "\n".join(
        f"{p.cpp} {p.label} = *({p.cpp}*)(gmm_block + {8 * n});" for n, p in enumerate(kernel._parameters)
    )
    source = _BEFORE + kernel._text + _AFTER.format(read=read, call=kernel._signature[1])
    kept = Path(tempfile.gettempdir()) / f"gmmtorch-kernels-of-gpu-{os.getuid()}"
    kept.mkdir(mode=0o700, exist_ok=True)
    assert kept.stat().st_uid == os.getuid(), f"{kept} belongs to another user"
    library = kept / f"{hashlib.sha256(source.encode()).hexdigest()}.so"
    if not library.exists():
        flags = ["-std=c++17", "-O1", "-w", "-shared", "-fPIC", "-pthread", "-ffp-contract=off"]
        made = library.with_suffix(f".{os.getpid()}")
        command = ["c++", *flags, "-o", str(made), "-x", "c++", "-"]
        done = subprocess.run(command, input=source, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{kernel.name}: {done.stderr}"
        made.replace(library)
    return ctypes.CDLL(str(library)).run


def run_as_on_gpu(kernel: FusedKernel, n_items: int, *arguments: Tensor | float | None) -> None:
    """Launch a kernel as `kernel(n_items, ...)` would on a GPU."""
    if n_items == 0:
        return
    values, _tensors = kernel._values(arguments)
    block = ctypes.create_string_buffer(kernel._packed.pack(*values))
    is_team = any(parameter.label == "arrived" for parameter in kernel._parameters)
    n_threads = n_items if is_team else min(N_THREADS, n_items)
    has_squads = not is_team and "squad_of(item)" in kernel._text and n_items % _BLOCK == 0
    n_threads = _BLOCK if has_squads else n_threads
    _compiled(kernel)(ctypes.c_int64(n_items), ctypes.c_int64(n_threads), has_squads, block)


def _launch(self: FusedKernel, n_items: int, *arguments: Any) -> None:
    devices = {argument.device.type for argument in arguments if isinstance(argument, Tensor)}
    if len(devices) > 1:
        raise AssertionError(f"{self.name} gets tensors of {' and '.join(sorted(devices))}")
    if devices == {"cpu"}:
        _launch_on_cpu(self, n_items, *arguments)
        return
    run_as_on_gpu(self, n_items, *arguments)


_launch_on_cpu = FusedKernel.__call__


def _is_fused(*tensors: Tensor | None) -> bool:
    given = [tensor for tensor in tensors if tensor is not None]
    if any(isinstance(tensor, GPUTensor) for tensor in given):
        grows = any(tensor.requires_grad for tensor in given) and torch.is_grad_enabled()
        return not grows and choice.chosen_kernels() != "torch" and all(t.device == GPU for t in given)
    return choice.is_fused(*tensors)


def _team(device: torch.device, most: int | None = None) -> Team:
    if device.type == "cpu":
        return Team(1, None)
    n_threads = N_THREADS if most is None else min(N_THREADS, most)
    return Team(n_threads, torch.zeros(1, dtype=torch.int32, device=device))


@contextmanager
def kernels_of_gpu() -> Iterator[None]:
    """Tensors of the pretended GPU are computed by kernels in their form for CUDA."""
    if sys.platform != "linux" or not shutil.which("c++"):
        pytest.skip("needs a C++ compiler")
    with ExitStack() as stack:
        for module in list(sys.modules.values()):
            if getattr(module, "is_fused", None) is choice.is_fused and module is not choice:
                stack.enter_context(mock.patch.object(module, "is_fused", _is_fused))
        stack.enter_context(mock.patch.object(FusedKernel, "__call__", _launch))
        stack.enter_context(mock.patch.object(Team, "of", staticmethod(_team)))
        yield
