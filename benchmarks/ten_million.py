"""Ten million points, ten thousand components: processor seconds and memory.

    python benchmarks/ten_million.py [--points 10_000_000] [--components 10_000] [--threads 1]

Writes its table into BENCHMARKS.md.
"""

from __future__ import annotations

import argparse
import resource
import time

import torch
from speed import noisy_room
from tables import hardware, markdown, publish

from gmmtorch import GaussianMixture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--components", type=int, default=10_000)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    parts = [noisy_room(1_000_000, seed).float() for seed in range(-(-options.points // 1_000_000))]
    points = torch.cat(parts)[: options.points]
    del parts
    held_out = noisy_room(20_000, 12345)
    rows = []
    for name, max_cells in (("points", None), ("cells only", options.points // 16)):
        begin = time.process_time()
        mixture = GaussianMixture(
            options.components, tol=2e-3, reg_covar=1e-5, max_cells=max_cells, random_state=0
        )
        mixture.fit(points)
        seconds = time.process_time() - begin
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        likelihood = f"{mixture.score(held_out):.4f}"
        row = [name, f"{seconds:.0f}", f"{mixture.n_iter_}", f"{peak:.1f} GiB", likelihood]
        rows.append(row)
        print(row, flush=True)
    header = ["EM ends on", "processor seconds", "iterations", "peak memory of the process", "held-out nats"]
    facts = f"{len(points):,} points, K = {options.components:,}."
    publish("ten-million", f"{facts} {hardware()}\n\n{markdown(header, rows)}")


if __name__ == "__main__":
    main()
