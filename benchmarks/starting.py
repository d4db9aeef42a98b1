"""What commands cost until their first line of output, and to the end. Needs Linux.

python benchmarks/starting.py [--repeats 5]
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gmmtorch.experiments.harness import Case, Row, run

PLAIN = "report.progress=false"
FIT = ("-m", "gmmtorch.experiments.cli.fit", "dataset=synthetic_building", "scans=[0,1,2]", PLAIN)
MAP = ("-m", "gmmtorch.cli.map", "dataset=synthetic_building_2d", PLAIN)
QUIET = ("report.figures=false", "report.tensorboard=false")
STARTED: dict[str, tuple[str, ...]] = {
    '`python -c "import torch"`': ("-c", "import torch; print()"),
    '`python -c "import hydra"`': ("-c", "import hydra; print()"),
    "`gmmtorch-fit --help`": (*FIT[:2], "--help"),
    "`gmmtorch-fit`, 12,000 points": FIT,
    "`gmmtorch-fit` without pictures": (*FIT, *QUIET),
    "`gmmtorch-map`, 120 scans in 2D": MAP,
    "`gmmtorch-map` without pictures": (*MAP, *QUIET),
}


def costs(arguments: tuple[str, ...]) -> tuple[float, float]:
    """CPU seconds of Python with these arguments: to the first line of output, and to the end."""
    with tempfile.TemporaryDirectory() as folder:
        child = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.PIPE, cwd=folder)
        assert child.stdout is not None
        child.stdout.readline()
        ticks = Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
        child.stdout.read()
        _, status, spent = os.wait4(child.pid, 0)
    if status:
        raise RuntimeError(f"{' '.join(arguments)} ended with status {status}.")
    return sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK"), spent.ru_utime + spent.ru_stime


def starting(options: Any) -> Iterator[Row]:
    repeats = [[costs(arguments) for arguments in STARTED.values()] for _ in range(options.repeats)]
    for name, measured in zip(STARTED, zip(*repeats, strict=True), strict=True):
        first, spent = (min(column) for column in zip(*measured, strict=True))
        yield name, first, spent


CASES = (
    Case(
        "starting",
        starting,
        "CPU seconds, the least of several runs.",
        {"command": "", "first line": ".1f", "whole": ".1f"},
        needs_data=False,
    ),
)

if __name__ == "__main__":
    run(__doc__, *CASES, repeats={"type": int, "default": 5, "help": "runs of each command"})
