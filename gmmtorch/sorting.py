"""Sorting where it is fastest: NumPy's vectorised sorts on the CPU, torch's elsewhere."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def argsort(keys: Tensor) -> Tensor:
    """Indices (N,) that sort keys (N,), equal ones in their order."""
    if keys.device.type != "cpu":
        return keys.argsort(stable=True)
    array = keys.numpy()
    if array.dtype == np.int64 and array.size and array.min() >= 0 and array.max() < 1 << 16:
        array = array.astype(np.uint16)  # radix sort
    return torch.from_numpy(np.argsort(array, kind="stable"))


def largest(scores: Tensor, k: int) -> Tensor:
    """Indices (N, k) of the k largest of each row of scores (N, M), in no order."""
    if scores.device.type != "cpu":
        return scores.topk(k, 1, sorted=False).indices
    return torch.from_numpy(np.argpartition(scores.numpy(), -k, axis=1)[:, -k:].astype(np.int64))


def count_distinct(keys: Tensor) -> int:
    """How many different keys (N,) there are."""
    if keys.numel() == 0:
        return 0
    ordered = torch.from_numpy(np.sort(keys.numpy())) if keys.device.type == "cpu" else keys.sort().values
    return 1 + int((ordered[1:] != ordered[:-1]).sum())


def number_distinct(keys: Tensor) -> tuple[Tensor, int]:
    """Keys (N,) replaced by numbers from 0, in the keys' order, and how many there are."""
    if keys.device.type != "cpu":
        unique, number = torch.unique(keys, return_inverse=True)
        return number, unique.numel()
    unique, number = np.unique(keys.numpy(), return_inverse=True)
    return torch.from_numpy(number.reshape(-1)), len(unique)
