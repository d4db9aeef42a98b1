"""What a picture of the live view costs: bytes to a browser and processor time, by the size of the map.

python benchmarks/live_view.py
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from live.viser_client import Client, wait_until

from gmmtorch.live.live_view import LiveView, Moment, ViewedRobot
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.team.exploration.mission.robot_view import camera_rotation

_OFFERS = 1_000_000


def pictures(view: LiveView, shown: GaussianMap) -> tuple[int, float]:
    """Bytes of a picture to one browser, and seconds of the processor; the third picture counts."""
    path = torch.rand(200, 3, dtype=torch.float64) * 5
    robots = [ViewedRobot(n, path + n, camera_rotation(0.3), (1.5, 1.0), path[:10]) for n in range(3)]
    with Client(view.url) as client:
        wait_until(lambda: view.viewer.n_viewers == 1)
        for k in range(3):
            times = [float(t) for t in range(100 + k)]
            begin = time.process_time()
            view.finish(lambda t=times: Moment(shown, robots, t, {"entropy": {"team": t}}))
            seconds = time.process_time() - begin
            n_bytes = client.received(b"/slice", b"/robots/2-ahead")
            time.sleep(0.5)
    return n_bytes, seconds


def main() -> None:
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)
    view = LiveView(port=8460)
    begin = time.process_time()
    for _ in range(_OFFERS):
        view.offer(lambda: Moment(GaussianMap()))
    print(f"an offer without a browser: {1e6 * (time.process_time() - begin) / _OFFERS:.2f} us")
    for n in (300, 1000, 3000, 10_000):
        means = torch.rand(n, 3, generator=generator, dtype=torch.float64) * torch.tensor([20.0, 15.0, 3.0])
        axes = torch.randn(n, 3, 3, generator=generator, dtype=torch.float64) * 0.08
        shown = GaussianMap.of(_components(means, axes @ axes.mT + 1e-4 * torch.eye(3)))
        n_bytes, seconds = pictures(view, shown)
        print(f"{n:6,} components: {n_bytes / 1e3:6.0f} kB, {1e3 * seconds:5.0f} ms of the processor")
    view.stop()


def _components(means: torch.Tensor, covariances: torch.Tensor) -> Components:
    n = len(means)
    rows = torch.arange(n)
    return Components(
        means, covariances, torch.full((n,), 50.0), torch.zeros(n, dtype=torch.bool),
        torch.stack([torch.zeros_like(rows), rows], 1), torch.tensor([[10.0, 7.0, 1.5]]),
        rows, torch.zeros_like(rows), torch.full((n,), 50.0),
    )  # fmt: skip


if __name__ == "__main__":
    main()
