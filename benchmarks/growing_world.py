"""What a scan costs to learn as the world grows: embedded halls side by side.

python benchmarks/growing_world.py [--halls 1 4 16]
"""

from __future__ import annotations

import argparse
import math
import time

import torch
from tables import hardware, markdown

from gmmtorch import GaussianMap, IncrementalRule, Scan, datasets

N_SCANS, APART = 24, 40.0  # scans of a hall; metres from one hall to the next
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--halls", type=int, nargs="+", default=[1, 4, 16], help="square numbers")
    halls = parser.parse_args().halls
    torch.set_num_threads(1)
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
