"""Every file that the package writes and reads is refused after any single bit of it is flipped."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from gmmtorch import GaussianMap, Scan, baselines, mixture
from gmmtorch.errors import DataError
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.streaming import State, read_state, write_state

N_FLIPS = 200
Written = tuple[Path, Callable[[Path], object]]


def cloud() -> torch.Tensor:
    return torch.randn(60, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def written_map(codec: str, folder: Path) -> Written:
    made = GaussianMap.from_components(
        cloud()[:3], 0.1 * torch.eye(2).repeat(3, 1, 1), [9.0, 8.0, 7.0], cloud()[3:6], codec=codec
    )
    made.save(folder / "map.safetensors")
    return folder / "map.safetensors", GaussianMap.load


def written_mixture(kind: str, folder: Path) -> Written:
    estimator = getattr(mixture, kind)
    options = {} if "Hierarchical" in kind else {"n_components": 2, "max_iter": 2, "tol": 0.0}
    made = estimator(random_state=0, **options).fit(cloud())
    made.save(folder / "mixture.safetensors")
    return folder / "mixture.safetensors", estimator.load


def written_baseline(kind: str, folder: Path) -> Written:
    made = getattr(baselines, kind)(resolution=0.5)
    made.insert(Scan(cloud()[:20], [0.0, 5.0]))
    made.save(folder / "map.safetensors")
    return folder / "map.safetensors", type(made).load


def written_checkpoint(kind: str, folder: Path) -> Written:
    parameters = Parameters(torch.ones(1).double(), cloud()[:1], torch.eye(2).double()[None])
    write_state(
        folder / "state.safetensors", State(parameters, cloud()[1], [1.0, 2.0]), {"covariance_type": "full"}
    )
    return folder / "state.safetensors", read_state


FILES = [
    *((written_map, codec) for codec in ("quantized", "float")),
    *((written_mixture, f"{kind}GaussianMixture") for kind in ("", "Hierarchical", "Variational")),
    *((written_baseline, kind) for kind in ("OccupancyGrid", "NDTMap")),
    (written_checkpoint, "checkpoint"),
]


@pytest.mark.parametrize(("write", "kind"), FILES, ids=[kind for _, kind in FILES])
def test_file_with_a_flipped_bit_is_refused(tmp_path, write, kind):
    path, read = write(kind, tmp_path)
    data = path.read_bytes()
    read(path)
    for bit in np.random.default_rng(0).choice(8 * len(data), N_FLIPS, replace=False):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << int(bit % 8)
        path.write_bytes(flipped)
        with pytest.raises(DataError, match=path.name):
            read(path)
