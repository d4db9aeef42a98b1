"""What a simulated second of exploration costs: by stage, early and late, in any world, for any team.

    python benchmarks/exploration.py                                  # the 50 x 40 m warehouse, 3 robots
    python benchmarks/exploration.py --size 200 160 8                 # 16 times its area
    python benchmarks/exploration.py --mesh mine.ply                  # any mesh
    python benchmarks/exploration.py --robots 16 --duration 60

Milliseconds of one core (CPU time) for each robot and simulated second, in the first and the second half of
the mission; megabytes that the process, a fresh one for each team, has grown by in each half, and kilobytes
of that for each robot and simulated second. Memory is what is resident at that moment; where the system
does not tell (it has no /proc), the most that ever was, and what a half takes of memory that was let go does
not show.
"""

from __future__ import annotations

import argparse
import gc
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import torch

from gmmtorch.report.text import format_table
from gmmtorch.team.exploration.mission.driver import Stopwatch
from gmmtorch.team.exploration.mission.mission import Mission
from gmmtorch.team.exploration.mission.options import TeamOptions
from gmmtorch.team.exploration.mission.trials import assemble
from gmmtorch.team.exploration.world.world import World, open_world


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--size", type=float, nargs=3, default=(50.0, 40.0, 8.0))
    parser.add_argument("--mesh", default=None)
    parser.add_argument("--team", nargs="+", default=["gmm_shared", "grid_shared", "grid_isolated"])
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--duration", type=float, default=120.0)
    options = parser.parse_args()
    world = _world(options)  # now in the cache, so that no team's process has to work it out
    print(f"{world.name}, {' x '.join(map(str, world.box.shape))} cells, {options.robots} robots", flush=True)
    del world
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as fresh:
        rows = [row for team in options.team for row in fresh.submit(_fly, options, team).result()]
    print(format_table(rows, list(rows[0])))


def _world(options: argparse.Namespace) -> World:
    if options.mesh is not None:
        return open_world("mesh", path=options.mesh)
    return open_world("warehouse", size=tuple(options.size))


def _fly(options: argparse.Namespace, team: str) -> list[dict[str, object]]:
    """The rows of a mission: its halves."""
    torch.set_num_threads(1)
    about = TeamOptions(framework=team, size=options.robots, duration=options.duration)
    mission = assemble(_world(options), about, Stopwatch(time.process_time))
    rows = []
    for half in (1, 2):
        before, memory = dict(mission.watch.seconds), _resident_bytes()
        begin, stop = time.process_time(), half * options.duration / 2
        while mission.elapsed < stop - 1e-9:
            mission.tick(mission.elapsed)
        row = _row(mission, half, before, time.process_time() - begin, options.duration / 2)
        grown = _resident_bytes() - memory
        row["grown_mb"] = grown / 1e6
        row["kb_per_robot_second"] = grown / 1e3 / (len(mission.robots) * options.duration / 2)
        rows.append(row)
    return rows


def _row(
    mission: Mission, half: int, before: dict[str, float], seconds: float, simulated: float
) -> dict[str, object]:
    """Milliseconds of each stage for a robot and a simulated second."""
    scale = 1e3 / (simulated * len(mission.robots))
    spent = {name: (total - before.get(name, 0.0)) * scale for name, total in mission.watch.seconds.items()}
    return {
        "team": mission.options.framework,
        "half": half,
        "entropy_left": mission.score.union.entropy_bits / mission.score.union.observable_bits,
        **spent,
        "all": seconds * scale,
        "simulated_per_core_second": simulated / seconds,
    }


def _resident_bytes() -> int:
    """Memory of this process: now, or the most that it ever was."""
    gc.collect()
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text().split()[1]) * resource.getpagesize()
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024


if __name__ == "__main__":
    main()
