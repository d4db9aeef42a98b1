"""The work of `public_work.py` on a CPU and on a GPU, in the same run.

    python benchmarks/devices.py --data $GMMTORCH_DATA [--threads 16] [--device cuda] [--works NAME ...]

Seconds until the device has ended the work, the least of three runs; and the operations and launches on the
GPU, and how many of them wait for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from harness import Case, Row, least_seconds, run
from public_work import counted, large_works, prepare, works


def measure(options: Any) -> Iterator[Row]:
    prepare(options.data)
    devices = ("cpu", options.device)
    listed = {
        device: {**works(options.data, device), **large_works(options.data, device)} for device in devices
    }
    for name in listed["cpu"]:
        if options.works and not any(part in name for part in options.works):
            continue
        seconds, counts = [], (0, 0)
        for device in devices:
            work = listed[device][name]()
            counts = counted(work)  # and what is compiled or loaded once
            seconds.append(least_seconds(work, options.repeats, device))
        yield {
            "work": name,
            "s on the CPU": seconds[0],
            "s on the GPU": seconds[1],
            "times faster": seconds[0] / seconds[1],
            "operations (waits)": "{:,} ({:,})".format(*counts),
        }


CASE = Case(
    "devices",
    measure,
    "In parentheses: operations that wait for the device.",
    dict.fromkeys(("s on the CPU", "s on the GPU", "times faster"), "3"),
)

if __name__ == "__main__":
    run(
        __doc__,
        CASE,
        device={"default": "cuda", "help": "the GPU"},
        repeats={"type": int, "default": 3},
        works={"nargs": "*", "help": "parts of names of works"},
    )
