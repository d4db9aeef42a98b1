"""Maps for tests: drives towards a wall, given components, motions, and comparisons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch
from mapping.random_components import estimated_bytes
from occupancy.protocol_contract import RESOLUTION, move, open_scan, shifted, wall_scan
from torch import Tensor

from gmmtorch.mapping import Components, GaussianMap, IncrementalRule, LearningRule, WindowedRule
from gmmtorch.mapping.components import TENSORS
from gmmtorch.mapping.learning.merging import united
from gmmtorch.mapping.learning.windows import absorb
from gmmtorch.mixture import MergedInRounds, merge_components
from gmmtorch.scan import Scan

FINE = IncrementalRule(noise=0.01, length=0.1, cell=0.05, window=2)
"""Some twenty components a window: enough to merge."""


def sensor(x: float, dim: int = 2) -> tuple[float, ...]:
    return (x + 2**-9, 0.1875 + 2**-9, 0.3125 + 2**-9)[:dim]


def merged(components: Components, labels: Tensor) -> Components:
    """The components of each label (K,) as one; labels are 0, 1, … without gaps."""
    n = int(labels.max()) + 1
    parameters = merge_components(components.support, components.means, components.covariances, labels, n)
    first = torch.stack([(labels == label).nonzero()[0, 0] for label in range(n)])
    return united(components, MergedInRounds(parameters, labels, first, torch.bincount(labels)))


def drive(n: int, dim: int = 2) -> list[Scan]:
    """Scans of the wall from n positions on the way to it."""
    return [wall_scan(dim, seed, sensor(0.25 * seed, dim)) for seed in range(n)]


def open_drive(n: int, dim: int = 2) -> list[Scan]:
    """`drive` with some no-return beams."""
    return [replace(scan, no_return=open_scan(dim).no_return[i::10]) for i, scan in enumerate(drive(n, dim))]


def rooms(n: int, dim: int, apart: float) -> list[Scan]:
    """n scans of rooms, three of each, `apart` metres from one to the next."""
    near = open_drive(3, dim)
    places = [shifted(dim, (apart * (number // 3), 0.0, 0.0)) for number in range(n)]
    return [near[number % 3].transformed(place) for number, place in enumerate(places)]


def built(scans: list[Scan], learning: LearningRule | None = None, **options: Any) -> GaussianMap:
    """A map of these scans, by default windowed, with the float codec and few rays."""
    options = {"resolution": RESOLUTION, "n_samples": 20_000, "codec": "float", **options}
    made = GaussianMap(WindowedRule() if learning is None else learning, **options)
    for scan in scans:
        made.insert(scan)
    return made


def absorbed(components: Components, scans: Sequence[Scan], rule: IncrementalRule) -> Components:
    """The components with scans added."""
    return absorb(components, scans, rule, estimated_bytes)[0]


def given_parts(dim: int = 2, k: int = 4, seed: int = 0) -> dict[str, Tensor]:
    """Arguments of `from_components`."""
    generator = torch.Generator().manual_seed(seed)
    root = 0.2 * torch.randn(k, dim, dim, generator=generator, dtype=torch.float64)
    return {
        "means": 1.5 * torch.randn(k, dim, generator=generator, dtype=torch.float64),
        "covariances": root @ root.mT + 0.01 * torch.eye(dim).double(),
        "support": torch.arange(1.0, k + 1, dtype=torch.float64) * 10,
        "origins": torch.randn(k, dim, generator=generator, dtype=torch.float64),
    }


def moved_parts(parts: dict[str, Tensor], matrix: Tensor) -> dict[str, Tensor]:
    rotation = matrix[:-1, :-1]
    return {
        "means": move(matrix, parts["means"]),
        "covariances": rotation @ parts["covariances"] @ rotation.T,
        "support": parts["support"],
        "origins": move(matrix, parts["origins"]),
    }


def some_motion(dim: int) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    rotation = torch.linalg.qr(torch.randn(dim, dim, generator=generator, dtype=torch.float64))[0]
    rotation[:, 0] *= torch.linalg.det(rotation).sign()
    matrix = torch.eye(dim + 1, dtype=torch.float64)
    matrix[:dim, :dim], matrix[:dim, dim] = rotation, torch.tensor([1.5, -0.7, 0.2])[:dim]
    return matrix


def sightings(made: Components) -> list[dict[tuple[float, ...], float]]:
    """Origin → count of each component."""
    table: list[dict[tuple[float, ...], float]] = [{} for _ in range(len(made))]
    for k, s, count in zip(
        made.seen_by.tolist(), made.seen_from.tolist(), made.seen_count.tolist(), strict=True
    ):
        place = tuple(made.origins[s].tolist())
        assert place not in table[k]
        table[k][place] = count
    return table


def names(ids: Tensor) -> set[tuple[int, ...]]:
    """Ids (K, 2) as a set; asserts that they are distinct."""
    found = {tuple(row) for row in ids.tolist()}
    assert len(found) == len(ids)
    return found


def assert_same_components(one: Components, other: Components) -> None:
    """Bit by bit."""
    for name in TENSORS:
        assert torch.equal(getattr(one, name), getattr(other, name)), name


def assert_close_components(one: Components, other: Components, atol: float = 1e-9) -> None:
    """In the same order, with the same origins and counts."""
    for name in ("means", "covariances", "support"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=1e-9, atol=atol)
    assert torch.equal(one.max_range, other.max_range)
    for seen, expected in zip(sightings(one), sightings(other), strict=True):
        assert sorted(seen.values()) == pytest.approx(sorted(expected.values()))
        ours, theirs = (torch.tensor(sorted(s), dtype=torch.float64) for s in (seen, expected))
        torch.testing.assert_close(ours, theirs, rtol=0, atol=atol)
