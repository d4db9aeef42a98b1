"""Tables of measurements, written between markers into BENCHMARKS.md.

If the environment variable GMMTORCH_TABLES names a folder, tables and logs go there and no page changes.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from pathlib import Path

import numpy
import sklearn
import torch

from gmmtorch.files import write_bytes

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "BENCHMARKS.md"
OUTPUTS = Path(os.environ.get("GMMTORCH_TABLES") or ROOT / "outputs")


def hardware(device: str = "cpu") -> str:
    """The machine and the versions, in a line; with the GPU, if `device` is one."""
    model = platform.processor() or platform.machine()
    cpu_info = Path("/proc/cpuinfo")
    if cpu_info.exists():
        lines = cpu_info.read_text().splitlines()
        names = [line.split(":")[1].strip() for line in lines if "model name" in line]
        model = names[0] if names else model
    gpu = "" if device == "cpu" else f"{torch.cuda.get_device_name(device)}; "
    return (
        f"{gpu}{model}, {os.cpu_count()} cores, {torch.get_num_threads()} thread(s) used; "
        f"torch {torch.__version__}, scikit-learn {sklearn.__version__}, "
        f"numpy {numpy.__version__}, Python {platform.python_version()}"
    )


def three_digits(value: float) -> str:
    """The value with three significant digits, never as a power of ten above 1."""
    return f"{value:.3g}" if abs(value) < 1000 else f"{float(f'{value:.3g}'):,.0f}"


def markdown(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    lines += ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows]
    return "\n".join(lines)


def publish(name: str, text: str, file: Path = PAGE) -> None:
    """Put `text` between the markers of `name` in a page, which must have them, or into GMMTORCH_TABLES."""
    if os.environ.get("GMMTORCH_TABLES"):
        write_bytes(OUTPUTS / f"{name}.md", f"{text}\n".encode())
        return
    page = file.read_text()
    begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    if begin not in page or end not in page:
        raise SystemExit(f"{file.name} has no place for {name!r}: add {begin} and {end}.")
    before, rest = page.split(begin)
    after = rest.split(end)[1]
    write_bytes(file, f"{before}{begin}\n{text}\n{end}{after}".encode())
    print(f"\n{name}\n{text}")
