"""Registration of real scans, whose poses are known."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

import gmmtorch as gt
from gmmtorch.localization.registration import register
from gmmtorch.mapping import Components, WindowedRule, learn_window
from gmmtorch.mapping.codec import component_batch as codec
from gmmtorch.pose import generators

pytestmark = [pytest.mark.slow, pytest.mark.real_data]

PAIRS = {"hall": (1, [(10, 14), (20, 23), (30, 36)]), "courtyard": (5, [(0, 12), (40, 52), (80, 92)])}
STARTS = ((0.1, 2.0), (0.5, 10.0), (1.0, 20.0), (2.0, 45.0))  # metres, degrees
DRAWS = 1  # BENCHMARKS.md has three


def mixtures(folder: Path, name: str) -> list[tuple[Components, Components, Tensor]]:
    """Target and source of each pair, as another robot receives them, and the source's sensor."""
    scans = gt.datasets.load("scan_folder", folder / name)
    rule = WindowedRule(noise=0.02, length=0.6)
    n, pairs = PAIRS[name]

    def sent(first: int) -> Components:
        window = [scans[i] for i in range(first, first + n)]
        return codec.decode(codec.encode(learn_window(window, rule, torch.Generator().manual_seed(0))))

    return [(sent(a), sent(b), scans[b + n // 2].origin) for a, b in pairs]


def perturbation(about: Tensor, metres: float, degrees: float, generator: torch.Generator) -> Tensor:
    """A shift and a turn about a point (3,), both in directions at random."""
    shift, axis = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    turn = torch.einsum("k,kij->ij", axis / axis.norm() * math.radians(degrees), generators(3))
    made = torch.eye(4, dtype=torch.float64)
    made[:3, :3] = torch.linalg.matrix_exp(turn)
    made[:3, 3] = about - made[:3, :3] @ about + metres * shift / shift.norm()
    return made


def is_right(transform: Tensor, at: Tensor) -> bool:
    """Whether a pose is within 0.2 m at a point and 2° of the identity."""
    moved = transform[:3, :3] @ at + transform[:3, 3] - at
    skew = torch.linalg.matrix_norm(transform[:3, :3] - torch.eye(3, dtype=torch.float64))
    return float(moved.norm()) < 0.2 and float(skew) / math.sqrt(2) < math.radians(2)


def test_the_basin_of_registration_holds_nearly_all_starts(real_data):
    n_right = 0
    for name in PAIRS:
        given = mixtures(real_data, name)
        for metres, degrees in STARTS:
            generator = torch.Generator().manual_seed(0)
            for target, source, sensor in given:
                for _ in range(DRAWS):
                    found = register(source, target, perturbation(sensor, metres, degrees, generator))
                    right = is_right(found.transform, sensor)
                    n_right += right
                    assert right or not found.reliable, (name, metres, degrees)
    assert n_right >= 22  # of 24
