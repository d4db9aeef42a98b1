"""The work of `public_work.py` on a CPU and on a GPU, in the same run.

    python benchmarks/devices.py --data $GMMTORCH_DATA [--threads 16] [--device cuda] [--only NAME ...]

Seconds until the device has ended the work, the least of three runs; and the operations and launches on the
GPU, and how many of them wait for it. Writes the table `devices` of BENCHMARKS.md.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from public_work import counted, large_works, least_seconds, prepare, works
from tables import hardware, markdown, publish, three_digits


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--device", default="cuda", help="the GPU")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="of the CPU")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", nargs="*", help="parts of names")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    prepare(options.data)
    rows: dict[str, list[float]] = {}
    counts: dict[str, tuple[int, int]] = {}
    for device in ("cpu", options.device):
        listed = {**works(options.data, device), **large_works(options.data, device)}
        for name, prepared in listed.items():
            if options.only and not any(part in name for part in options.only):
                continue
            work = prepared()
            counts[name] = counted(work)  # and what is compiled or loaded once
            rows.setdefault(name, []).append(least_seconds(work, options.repeats, device))
            print(device, name, f"{rows[name][-1]:.3g}", counts[name], flush=True)
    header = ["work", "s on the CPU", "s on the GPU", "times faster", "operations (waits)"]
    table = markdown(
        header,
        [
            [name, *map(three_digits, (cpu, gpu, cpu / gpu)), "{:,} ({:,})".format(*counts[name])]
            for name, (cpu, gpu) in rows.items()
        ],
    )
    publish("devices", f"{hardware(options.device)}\n\n{table}")


if __name__ == "__main__":
    main()
