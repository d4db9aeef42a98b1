"""Map files of version 1: float32 relative to a whole-metre frame. They are read, and written no more.

Tensors: frame (D, float64); means, origins (float32, relative to it); covariances (K, D(D+1)/2, float32,
upper triangle by rows); support (float32); max_range (uint8); id_runs (R, 3, int64: robot, first sequence,
length); for each component the number of its sightings, and for each sighting, by component, seen_from and
seen_share (uint8, in 255ths of the component's largest).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.files import require, require_counts
from gmmtorch.linalg import unpack_symmetric
from gmmtorch.mapping.components import Components


def components(tensors: Mapping[str, Tensor], path: str | Path) -> Components:
    """The components that the tensors of a file hold. Raises `DataError` when they are not sound."""
    single = torch.float32
    means = require(tensors, "means", (None, None), single, path)
    k, dim = means.shape
    if dim not in (2, 3):
        raise DataError(f"{path}: the components are {dim}-dimensional; a map has 2 or 3 dimensions.")
    frame = require(tensors, "frame", (dim,), torch.float64, path)
    packed = require(tensors, "covariances", (k, dim * (dim + 1) // 2), single, path)
    origins = require(tensors, "origins", (None, dim), single, path)
    sightings = require_counts(tensors, "sightings", (k,), path)
    seen_from = require_counts(tensors, "seen_from", (None,), path)
    share = require(tensors, "seen_share", (seen_from.shape[0],), torch.uint8, path).double()
    if bool((share < 1).any()):
        raise DataError(f"{path}: seen_share holds zeros; the file is damaged.")
    support = require(tensors, "support", (k,), single, path).double()
    runs = require(tensors, "id_runs", (None, 3), torch.int64, path)
    if int(sightings.sum()) != seen_from.shape[0]:
        raise DataError(
            f"{path}: {int(sightings.sum())} sightings are announced, {seen_from.shape[0]} follow."
        )
    seen_by = torch.repeat_interleave(sightings)
    try:
        return Components(
            means=means.double() + frame,
            covariances=unpack_symmetric(packed, dim).double(),
            support=support,
            max_range=require(tensors, "max_range", (k,), torch.uint8, path).bool(),
            ids=_ids(runs, k, path),
            origins=origins.double() + frame,
            seen_by=seen_by,
            seen_from=seen_from,
            seen_count=_counts(share, seen_by, support),
        ).checked()
    except GmmTorchError as error:
        raise DataError(f"{path}: {error}") from error


def settings(facts: dict[str, Any]) -> dict[str, Any]:
    """The settings as files hold them now: maps were windowed ones, and answered from rays."""
    learning = facts.get("learning")
    if not isinstance(learning, dict):
        return facts
    rule = {"kind": "windowed", "window": facts.get("window", 20), **learning}
    others = {name: value for name, value in facts.items() if name not in ("window", "learning")}
    return {"method": "monte_carlo", "n_numbered": 0, **others, "learning": rule}


def _counts(shares: Tensor, seen_by: Tensor, support: Tensor) -> Tensor:
    """Counts (E,) in proportion to the shares, adding up to each component's support."""
    total = shares.new_zeros(support.shape[0]).index_add_(0, seen_by, shares)
    return shares * (support / total.clamp_min(1))[seen_by]


def _ids(runs: Tensor, k: int, path: str | Path) -> Tensor:
    """Ids (K, 2) of runs."""
    length = runs[:, 2]
    if bool((length < 1).any()) or bool((length > k).any()) or int(length.sum()) != k:
        raise DataError(f"{path}: the id runs do not add up to {k} components; the file is damaged.")
    run = torch.repeat_interleave(length)
    within = torch.arange(k) - (torch.cumsum(length, 0) - length)[run]
    return torch.stack([runs[run, 0], runs[run, 1] + within], 1)
