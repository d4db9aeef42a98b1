"""Chunks: the parts in which large batches are computed, and what happens where a device's memory ends."""

from __future__ import annotations

import functools
import logging
import re
from collections.abc import Callable, Iterator
from typing import TypeVar

import torch

from gmmtorch.errors import MemoryLimitError

CHUNK_ELEMENTS = 1 << 17
"""Entries of a block on a CPU: small enough for the cache of a core."""

DEVICE_ELEMENTS = 1 << 25
"""Most entries of a block on another device: each launch costs microseconds, so blocks are large."""

_SHARE = 64  # of a GPU's memory for one tensor of a chunk, of which a computation holds several

T = TypeVar("T")
logger = logging.getLogger(__name__)


def chunk_elements(device: torch.device) -> int:
    """Entries (of eight bytes) of the largest tensor of a chunk on this device."""
    return CHUNK_ELEMENTS if device.type == "cpu" else _elements_of_device(device)


@functools.cache
def _elements_of_device(device: torch.device) -> int:
    if device.type != "cuda" or not torch.cuda.is_available():
        return DEVICE_ELEMENTS
    return min(DEVICE_ELEMENTS, torch.cuda.get_device_properties(device).total_memory // (8 * _SHARE))


def chunked(n: int, size: int, compute: Callable[[slice], T]) -> Iterator[T]:
    """compute(part) for parts of at most `size` (1 or more) of n rows, in order.

    A part for which the device has no memory is computed again in halves, and so are all later parts, so
    `compute` must not change anything but its result. Raises `MemoryLimitError` if a single row is too large.
    """
    begin = 0
    while begin < n:
        part = slice(begin, min(begin + size, n))
        try:
            found = compute(part)
        except torch.OutOfMemoryError as error:
            if part.stop - begin == 1:
                raise memory_error(error) from error
            size = (part.stop - begin) // 2
            logger.info("%s The work continues in chunks of %d rows.", _asked(error), size)
        else:
            begin = part.stop
            yield found
            continue
        torch.cuda.empty_cache()  # after the error, whose traceback holds the tensors of the part


def memory_error(error: torch.OutOfMemoryError) -> MemoryLimitError:
    """The error of the package for a device without memory: the bytes asked for, and what needs fewer."""
    return MemoryLimitError(
        f"{_asked(error)} Reduce n_components, max_cells or the resolution of the grid, free memory that "
        "other programs hold on the device, or choose ‹device›=cpu."
    )


def _asked(error: torch.OutOfMemoryError) -> str:
    found = re.search(r"allocate ([\d.]+ \w+)", str(error))
    device = re.search(r"GPU (\d+)", str(error))
    name = f"GPU {device[1]}" if device else "The device"
    amount = found[1] if found else "an unknown number of bytes"
    return f"{name} is out of memory: {amount} were asked for."
