"""Makes the tables of the pages from benchmarks/results/*.json.

    python benchmarks/pages.py            # writes them
    python benchmarks/pages.py --check    # exits with status 1 if a page has other tables

A table is between `<!-- NAME -->` and `<!-- /NAME -->` in a page.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from gmmtorch.experiments.harness import Table
from gmmtorch.files import write_bytes

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
SHOWN: dict[str, dict[str, tuple[str, ...]]] = {
    "accuracy": {"cell (m)": ("0.1", "0.2", "0.05"), "beams kept": ("10%",)},
    "against": {
        "work": (
            "EM, 20,000 points, K = 1,000",
            "112 frames to a map, default rule",
            "a frame of 20,000 points inserted",
            "20,000 point queries, kinect in 8 kB",
            "registration of two scans of hall",
        )
    },
    "attributes": {"result": ("20.28 dB", "20.27 dB", "20.47 dB", "20.64 dB")},
    "calibration-peers": {"cell (m)": ("0.2",)},
    "changing-world": {
        "map": (
            "incremental, off",
            "incremental, contradiction",
            "incremental, half-life 30 s",
            "incremental, 16 kB, contradiction",
            "count grid",
            "log-odds grid, no clamp",
            "OctoMap (log-odds with clamping)",
        )
    },
    "dimensions-1": {
        "points": (
            *("2,000 × 64", "2,000 × 384", "50,000 × 384", "1,000,000 × 3"),
            *("1,477 × 284", "1,797 × 64", "150 × 4"),
        )
    },
    "exploration": {
        "": (
            "entropy taken away (kbit)",
            "t90 (s)",
            "AUC, all observable cells",
            "cells on which two robots differ (%)",
            "sent (kB)",
            "novel points, 12 B each (kB)",
            "the same by Draco (kB)",
            "the same as an octree, zstd (kB)",
            "the same as an octree, contexts (kB)",
            "on the wire, with headers (kB)",
        )
    },
    "growth": {"scans": ("228", "168", "2008")},
    "kernels": {
        "work": (
            "rays through 0.2 m, counted, dense",
            "rays through 0.05 m, counted, sparse",
            "point queries, kinect, 8 kB, 1486 cones, cutoff 3",
            "flux, kinect, 8 kB, 222,345 cells, tolerance 10⁻³",
        )
    },
    "learning-1": {"method": ("gmmtorch", "scikit-learn", "torchgmm")},
    "mesh": {"cells": ("0.05 m",)},
    "mission-costs": {
        "three robots, 120 s": (
            "E0, warehouse 50×40 m",
            "E1",
            "E0, 16 times the area (`--size 200 160 8`) *",
            "E0, 16 robots (`--robots 16 --duration 40`) *",
        )
    },
    "networks": {
        "": (
            "entropy taken away (kbit)",
            "t90 (s)",
            "on the wire, with headers (kB)",
            "bytes on the wire, lossless = 1",
            "maps equal seconds after the end (s)",
        )
    },
    "point-queries": {"cutoff": ("3",)},
    "recordings": {"how": ("one recording, one process", "16 recordings, two workers, one killed")},
    "registration-hall": {
        "": (
            "mixtures",
            "mixtures, `coarsest=0.25`",
            "ICP, point to point",
            "ICP, point to plane",
            "point to plane, voxels of 0.2 m",
        )
    },
    "rate-distortion": {"quality": ("PSNR2", "AUC")},
    "ros": {"middleware, map": ("dds, no budget", "zenoh, no budget")},
}
"""Of tables that pages show in part: the values that the columns of the shown rows have."""


def filled(page: str) -> str:
    """A page with the tables of the results."""

    def table(found: re.Match[str]) -> str:
        path = RESULTS / f"{found[1]}.json"
        if not path.exists():
            return found[0]
        return f"<!-- {found[1]} -->\n{Table.load(path).markdown(SHOWN.get(found[1]))}\n<!-- /{found[1]} -->"

    return re.sub(r"<!-- ([\w-]+) -->\n.*?<!-- /\1 -->", table, page, flags=re.DOTALL)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing")
    is_check, changed = parser.parse_args().check, []
    for path in (ROOT / "README.md", ROOT / "BENCHMARKS.md", *sorted((ROOT / "docs").rglob("*.md"))):
        page = path.read_text(encoding="utf-8")
        if (new := filled(page)) != page:
            changed.append(path.relative_to(ROOT))
            if not is_check:
                write_bytes(path, new.encode())
    print(*(f"{'differs from' if is_check else 'has new'} tables: {path}" for path in changed), sep="\n")
    return int(is_check and bool(changed))


if __name__ == "__main__":
    sys.exit(main())
