"""What a picture of the live view costs: bytes to a browser and processor time, by the size of the map.

Between the last two pictures the map grows by a twentieth; before, all of its components change.

python benchmarks/live_view.py
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from gmmtorch.experiments.harness import Case, Row, cpu_seconds, run

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from live.viser_client import Client, wait_until

from gmmtorch.live.live_view import LiveView, Moment, ViewedRobot
from gmmtorch.live.viewer_scene import parts, surfaces
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.team.exploration.mission.robot_view import camera_rotation

_OFFERS = 1_000_000


def pictures(view: LiveView, maps: Sequence[GaussianMap]) -> tuple[list[int], float]:
    """Bytes of each picture of maps to one browser, and seconds of the processor of the last one."""
    path = torch.rand(200, 3, dtype=torch.float64) * 5
    robots = [ViewedRobot(n, path + n, camera_rotation(0.3), (1.5, 1.0), path[:10]) for n in range(3)]
    with Client(view.url) as client:
        wait_until(lambda: view.viewer.n_viewers == 1)
        sent = []
        for k, shown in enumerate(maps):
            times = [float(t) for t in range(100 + k)]
            begin = time.process_time()
            view.finish(lambda t=times, m=shown: Moment(m, robots, t, {"entropy": {"team": t}}))
            seconds = time.process_time() - begin
            sent.append(client.received(_last_part(shown), b"/robots/2-ahead"))
            time.sleep(1)
    return sent, seconds


def _last_part(shown: GaussianMap) -> bytes:
    """The name of the part that a picture sends last."""
    components = shown.components()
    return f"/{list(parts(components, surfaces(components)))[-1]}".encode()


def offer(view: LiveView) -> None:
    for _ in range(_OFFERS):
        view.offer(lambda: Moment(GaussianMap()))


def measure(options: Any) -> Iterator[Row]:
    generator = torch.Generator().manual_seed(0)
    view = LiveView(port=8460)
    seconds, _ = cpu_seconds(lambda: offer(view))
    options.about = f"An offer without a browser takes {1e6 * seconds / _OFFERS:.2f} µs."
    for n in (300, 1000, 3000, 10_000):
        means = torch.rand(n, 3, generator=generator, dtype=torch.float64) * torch.tensor([20.0, 15.0, 3.0])
        axes = torch.randn(n, 3, 3, generator=generator, dtype=torch.float64) * 0.08
        whole = _components(means, axes @ axes.mT + 1e-4 * torch.eye(3))
        most = torch.arange(round(0.95 * n))
        other = replace(whole, means=means + 0.01).selected(most)
        maps = [GaussianMap.of(part) for part in (other, whole.selected(most), whole)]
        (_, changed, grown), seconds = pictures(view, maps)
        yield n, changed / 1e3, grown / 1e3, 1e3 * seconds
    view.stop()


def _components(means: torch.Tensor, covariances: torch.Tensor) -> Components:
    n = len(means)
    rows = torch.arange(n)
    return Components(
        means, covariances, torch.full((n,), 50.0), torch.zeros(n, dtype=torch.bool),
        torch.stack([torch.zeros_like(rows), rows], 1), torch.tensor([[10.0, 7.0, 1.5]]),
        rows, torch.zeros_like(rows), torch.full((n,), 50.0),
    )  # fmt: skip


FORMATS = {"components": ",.0f", "all changed": "{:.0f} kB", "grown by 5 %": "{:.0f} kB"}
FORMATS |= {"processor, drawing": "{:.0f} ms"}
CASE = Case("live-view", measure, "CPU time of all threads; one browser.", FORMATS, needs_data=False)

if __name__ == "__main__":
    run(__doc__, CASE)
