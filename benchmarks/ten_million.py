"""Ten million points, ten thousand components: processor seconds and memory.

python benchmarks/ten_million.py [--points 10_000_000] [--components 10_000] [--threads 1]
"""

from __future__ import annotations

import resource
from collections.abc import Iterator
from typing import Any

import torch
from harness import Case, Row, cpu_seconds, run
from speed import noisy_room

from gmmtorch import GaussianMixture


def measure(options: Any) -> Iterator[Row]:
    parts = [noisy_room(1_000_000, seed).float() for seed in range(-(-options.points // 1_000_000))]
    points = torch.cat(parts)[: options.points]
    del parts
    held_out = noisy_room(20_000, 12345)
    options.about = f"{len(points):,} points, K = {options.components:,}."
    for name, max_cells in (("points", None), ("cells only", options.points // 16)):
        mixture = GaussianMixture(
            options.components, tol=2e-3, reg_covar=1e-5, max_cells=max_cells, random_state=0
        )
        seconds, _ = cpu_seconds(lambda mixture=mixture: mixture.fit(points))
        yield {
            "EM ends on": name,
            "CPU s": seconds,
            "iterations": mixture.n_iter_,
            "peak memory of the process": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
            "held-out nats": mixture.score(held_out),
        }


FORMATS = dict.fromkeys(("CPU s", "iterations"), ".0f")
FORMATS |= {"peak memory of the process": "{:.1f} GiB", "held-out nats": ".4f"}
CASE = Case("ten-million", measure, formats=FORMATS, needs_data=False)

if __name__ == "__main__":
    run(
        __doc__,
        CASE,
        points={"type": int, "default": 10_000_000},
        components={"type": int, "default": 10_000},
    )
