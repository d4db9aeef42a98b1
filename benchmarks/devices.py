"""The work of `public_work.py` on a CPU and on a GPU, in the same run.

    python benchmarks/devices.py --data $GMMTORCH_DATA [--threads 16] [--devices cpu cuda] [--only NAME ...]

Seconds until the device has ended the work, the least of three runs. On a GPU also the number of operations
and launches, and of those that wait for the device. Writes the table `devices` of BENCHMARKS.md.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
from public_work import Work, counted, large_works, prepare, works
from tables import hardware, markdown, publish

from gmmtorch.kernels import kernels


def seconds(work: Work, repeats: int, device: str) -> float:
    """The least of several runs."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        if device != "cpu":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - begin)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--devices", nargs="+", default=["cpu", "cuda"])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="of the CPU")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", nargs="*", help="parts of names")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    prepare(options.data)
    columns = [(device, choice) for device in options.devices for choice in ("torch", "fused")]
    columns = [column for column in columns if column != ("cpu", "torch")]
    rows: dict[str, list[str]] = {}
    for device, choice in columns:
        listed = {**works(options.data, device), **large_works(options.data, device)}
        for name, prepared in listed.items():
            if options.only and not any(part in name for part in options.only):
                continue
            with kernels(choice):
                work = prepared()
                counts = counted(work)  # and what is compiled or loaded once
                cell = f"{seconds(work, options.repeats, device):.3g}"
            if (device, choice) == ("cuda", "fused"):
                cell += " ({:,}, {:,})".format(*counts)
            rows.setdefault(name, []).append(cell)
            print(device, choice, name, rows[name][-1], flush=True)
    names = {
        ("cpu", "fused"): "CPU",
        ("cuda", "torch"): "GPU, tensor operations",
        ("cuda", "fused"): "GPU, fused kernels (operations, waits)",
    }
    header = ["seconds", *(names[column] for column in columns)]
    table = markdown(header, [[name, *cells] for name, cells in rows.items()])
    publish("devices", f"{hardware(options.devices[-1])}\n\n{table}")


if __name__ == "__main__":
    main()
