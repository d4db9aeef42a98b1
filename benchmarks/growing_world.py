"""What a scan costs to learn as the world grows, and what a query after each scan costs.

    python benchmarks/growing_world.py [--halls 1 4 16]
    OMP_NUM_THREADS=1 python benchmarks/growing_world.py --data $GMMTORCH_DATA

Without data, embedded halls side by side. With data, the scans of the folder `street`: after each one the map
is asked about 500 points on its beams. Writes the table `growing-map` of BENCHMARKS.md.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import torch
from tables import hardware, markdown, publish

from gmmtorch import GaussianMap, IncrementalRule, Scan, datasets
from gmmtorch.datasets.base import Dataset
from gmmtorch.kernels import kernels
from gmmtorch.mapping.map_builder import resident_bytes

N_SCANS, APART = 24, 40.0  # scans of a hall; metres from one hall to the next
N_POINTS = 500  # of a query after a scan
PER_HALL = 1000  # components, where there is a budget


def milliseconds(scans: list[Scan], n_halls: int, rule: IncrementalRule) -> tuple[float, int]:
    """CPU milliseconds a scan, and components, of a map of so many halls."""
    side = math.isqrt(n_halls)
    built = GaussianMap(rule)
    begin = time.process_time()
    for hall in range(n_halls):
        shift = torch.tensor([APART * (hall % side), APART * (hall // side), 0.0], dtype=torch.float64)
        for scan in scans:
            built.insert(Scan(scan.points + shift, scan.origin + shift, scan.no_return + shift))
    built.finish()
    return 1e3 * (time.process_time() - begin) / (n_halls * len(scans)), built.n_components


def asked_after_each_scan(scans: Dataset, choice: str) -> list[list[object]]:
    """Rows of the table, for every sixth of the scans."""
    built, rows, spent = GaussianMap(), [], []
    generator = torch.Generator().manual_seed(0)
    before = resident_bytes()
    with kernels(choice):
        for number, scan in enumerate(scans, 1):
            chosen = torch.randint(len(scan.points), (N_POINTS,), generator=generator)
            share = torch.rand(N_POINTS, 1, generator=generator, dtype=torch.float64)
            points = scan.origin + share * (scan.points[chosen] - scan.origin)
            begin = time.process_time()
            built.insert(scan)
            built.finish()
            learned = time.process_time()
            built.occupancy(points)
            spent.append((learned - begin, time.process_time() - learned))
            if number % -(-len(scans) // 6) == 0 or number == len(scans):
                part = 1e3 * torch.tensor(spent)
                memory = (resident_bytes() - before) / 1e6
                worst = [f"{value:.0f}" for value in (*part.mean(0).tolist(), float(part[:, 1].max()))]
                rows.append([choice, number, built.n_components, *worst, f"{memory:.0f}"])
                spent = []
    return rows


def growing_map(data: Path) -> str:
    scans = datasets.load("scan_folder", data / "street")
    rows = [row for choice in ("fused", "torch") for row in asked_after_each_scan(scans, choice)]
    built = GaussianMap()
    for scan in scans:
        built.insert(scan)
    built.finish()
    points = torch.cat([0.5 * (s.origin + s.points[:: len(s.points) // 88][:88]) for s in scans])[:20_000]
    times = []
    for _ in range(2):
        begin = time.process_time()
        built.occupancy(points)
        times.append(f"{time.process_time() - begin:.2f}")
    header = ["kernels", "scans", "components", "learning, ms a scan", "query, ms", "longest query, ms", "MB"]
    about = f"First query of {len(points):,} points over the whole map: {times[0]} s; again: {times[1]} s."
    return f"{hardware()}\n\n{markdown(header, rows)}\n\n{about}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--halls", type=int, nargs="+", default=[1, 4, 16], help="square numbers")
    parser.add_argument("--data", type=Path, help="folder with the folder street")
    options = parser.parse_args()
    halls = options.halls
    torch.set_num_threads(1)
    if options.data:
        publish("growing-map", growing_map(options.data))
        return
    scans = list(datasets.load("synthetic_building", n_scans=N_SCANS))
    milliseconds(scans, 1, IncrementalRule())  # what is loaded but once
    rows = []
    for n_halls in halls:
        free, n_components = milliseconds(scans, n_halls, IncrementalRule())
        held, _ = milliseconds(scans, n_halls, IncrementalRule(n_components=PER_HALL * n_halls))
        rows.append([n_halls, n_components, f"{free:.0f}", f"{held:.0f}"])
    header = ["halls", "components", "no budget, ms a scan", f"{PER_HALL} components a hall, ms a scan"]
    print(f"{hardware()}\n\n{markdown(header, rows)}")


if __name__ == "__main__":
    main()
