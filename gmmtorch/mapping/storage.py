"""A map's components as a file: float32 relative to a whole-metre frame, safetensors, no pickle.

What is written: means (D floats), covariance (D(D+1)/2), support, max-range flag; ids, as runs of
consecutive ones; the table of origins (D floats each); for each component the number of its
sightings, and for each sighting an origin index and a share in 255ths. See docs/formats.md.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.files import narrowest, pack_tensors, read_tensors, require, require_counts
from gmmtorch.linalg import pack_symmetric, unpack_symmetric
from gmmtorch.mapping.components import Components

FILE_KIND, FILE_VERSION = "gmmtorch.map", 1
_POSITION_STEP = 2.0**-16  # metres: 15 µm


def storable(components: Components, frame: Tensor) -> Components:
    """The components rounded to what the file holds, so that a loaded map answers as the saved one.

    Positions go to a multiple of 2⁻¹⁶ m from the frame and to float32 (exact within 256 m of it),
    covariances and support to float32, the shares of a component's sightings to 255ths of the
    largest. Sightings are put in order of their components.
    """
    order = torch.argsort(components.seen_by, stable=True)
    seen_by = components.seen_by[order]
    support = components.support.float().double()
    shares = _quantized_shares(components.seen_count[order], seen_by, len(components))

    def single(x: Tensor) -> Tensor:
        return x.float().double()

    def position(x: Tensor) -> Tensor:
        return frame + single(torch.round((x - frame) / _POSITION_STEP) * _POSITION_STEP)

    return replace(
        components,
        means=position(components.means),
        covariances=single(components.covariances),
        support=support,
        origins=position(components.origins),
        seen_by=seen_by,
        seen_from=components.seen_from[order],
        seen_count=_counts(shares, seen_by, support),
    )


def _quantized_shares(count: Tensor, seen_by: Tensor, n_components: int) -> Tensor:
    """Counts (E,) in 255ths of the largest of their component: whole numbers 1 … 255."""
    largest = count.new_zeros(n_components).scatter_reduce_(0, seen_by, count, "amax")
    return (count / largest[seen_by].clamp_min(1e-300) * 255).round().clamp(1, 255)


def _counts(shares: Tensor, seen_by: Tensor, support: Tensor) -> Tensor:
    """Counts (E,) in proportion to the shares, adding up to each component's support."""
    total = shares.new_zeros(support.shape[0]).index_add_(0, seen_by, shares)
    return shares * (support / total.clamp_min(1))[seen_by]


def to_bytes(components: Components, frame: Tensor, facts: dict[str, Any]) -> bytes:
    """The file's bytes. `frame` (D,) is in whole metres."""
    sightings = torch.bincount(components.seen_by, minlength=len(components))
    shares = _quantized_shares(components.seen_count, components.seen_by, len(components))
    tensors = {
        "frame": frame,
        "means": (components.means - frame).float(),
        "covariances": pack_symmetric(components.covariances).float(),
        "support": components.support.float(),
        "max_range": components.max_range.to(torch.uint8),
        "id_runs": _runs(components.ids),
        "origins": (components.origins - frame).float(),
        "sightings": narrowest(sightings),
        "seen_from": narrowest(components.seen_from),
        "seen_share": shares.to(torch.uint8),
    }
    return pack_tensors(tensors, FILE_KIND, FILE_VERSION, **facts)


def from_file(path: str | Path) -> tuple[Components, Tensor, dict[str, Any]]:
    """Components, frame and facts of a map file. Raises `DataError` when it is not sound."""
    tensors, facts = read_tensors(path, FILE_KIND, FILE_VERSION)
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
        components = Components(
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
    return components, frame, facts


def _runs(ids: Tensor) -> Tensor:
    """Ids (K, 2) as runs (robot, first sequence, length), int64."""
    if len(ids) == 0:
        return ids.new_empty(0, 3)
    breaks = (ids[1:, 0] != ids[:-1, 0]) | (ids[1:, 1] != ids[:-1, 1] + 1)
    first = torch.cat([breaks.new_ones(1), breaks]).nonzero().squeeze(1)
    length = torch.diff(first, append=first.new_tensor([len(ids)]))
    return torch.cat([ids[first], length[:, None]], 1)


def _ids(runs: Tensor, k: int, path: str | Path) -> Tensor:
    """Ids (K, 2) of runs."""
    length = runs[:, 2]
    if bool((length < 1).any()) or bool((length > k).any()) or int(length.sum()) != k:
        raise DataError(f"{path}: the id runs do not add up to {k} components; the file is damaged.")
    run = torch.repeat_interleave(length)
    within = torch.arange(k) - (torch.cumsum(length, 0) - length)[run]
    return torch.stack([runs[run, 0], runs[run, 1] + within], 1)
