"""What a simulated second of exploration costs: by stage, early and late, in any world, for any team.

    python benchmarks/exploration.py                                  # the 50 x 40 m warehouse, 3 robots
    python benchmarks/exploration.py --size 200 160 8                 # 16 times its area
    python benchmarks/exploration.py --mesh mine.ply                  # any mesh
    python benchmarks/exploration.py --robots 16 --duration 60

Milliseconds of one core (CPU time) for each robot and simulated second, for the first and the second half of
the mission, and megabytes that the process has grown by since the mission began.
"""

from __future__ import annotations

import argparse
import resource
import time

import torch

from gmmtorch.exploration.mission import Mission
from gmmtorch.exploration.options import TeamOptions
from gmmtorch.exploration.stopwatch import Stopwatch
from gmmtorch.exploration.team import assemble
from gmmtorch.exploration.world import open_world
from gmmtorch.report.table import format_table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--size", type=float, nargs=3, default=(50.0, 40.0, 8.0))
    parser.add_argument("--mesh", default=None)
    parser.add_argument("--team", nargs="+", default=["gmm_shared", "grid_shared", "grid_isolated"])
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--duration", type=float, default=120.0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    world = (
        open_world("mesh", path=options.mesh)
        if options.mesh is not None
        else open_world("warehouse", size=tuple(options.size))
    )
    rows = []
    for team in options.team:
        about = TeamOptions(framework=team, size=options.robots, duration=options.duration)
        mission = assemble(world, about, Stopwatch(time.process_time))
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for half in (1, 2):
            before = dict(mission.stages)
            begin, stop = time.process_time(), half * options.duration / 2
            while mission.now < stop - 1e-9:
                mission.step()
            rows.append(_row(mission, half, before, time.process_time() - begin, options.duration / 2))
            rows[-1]["grown_mb"] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) / 1024
    cells = f"{world.name}, {' x '.join(map(str, world.box.shape))} cells, {options.robots} robots"
    print(f"{cells}\n{format_table(rows, list(rows[0]))}")


def _row(
    mission: Mission, half: int, before: dict[str, float], seconds: float, simulated: float
) -> dict[str, object]:
    """Milliseconds of each stage for a robot and a simulated second."""
    scale = 1e3 / (simulated * len(mission.robots))
    spent = {name: (total - before.get(name, 0.0)) * scale for name, total in mission.stages.items()}
    return {
        "team": mission.options.framework,
        "half": half,
        "entropy_left": mission.union.entropy_bits / mission.union.observable_bits,
        **spent,
        "all": seconds * scale,
        "simulated_per_core_second": simulated / seconds,
    }


if __name__ == "__main__":
    main()
