"""Options of robots, and the type of the fixture that runs one."""

from __future__ import annotations

from collections.abc import Callable

from cli.command_runs import Finished

Run = Callable[..., Finished]

SMALL = ["sensor.width=48", "sensor.height=36"]
LOG = [
    "source=log",
    "dataset@log.dataset=synthetic_building_2d",
    "log.dataset.n_scans=12",
    "log.dataset.stride=2",
]
LOG += ["log.map={name: windowed, window: 3}", "settle=0"]
