#!/usr/bin/env python3
"""Prints the size of the package: lines, files and classes of each home, its largest parts, and its doors.

It also builds a small map, and counts what an option passes on its way from the command line to the map.
Run it before and after a change of structure: python scripts/house.py
"""

from __future__ import annotations

import ast
import contextlib
import io
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "gmmtorch"
HOMES = ("team", "experiments")
PRIOR = 0.4567891
"""A value of map.prior that no other option has."""


def home_of(path: Path) -> str:
    """The home of a file of the package."""
    first = path.relative_to(PACKAGE).parts[0]
    return first if first in HOMES else "map"


def n_lines(path: Path) -> int:
    return path.read_text(encoding="utf-8").count("\n")


def n_classes(path: Path) -> int:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return sum(isinstance(node, ast.ClassDef) for node in ast.walk(tree))


def holds_prior(value: Any, depth: int = 0) -> bool:
    """Whether an argument is `PRIOR`, or contains it, as a configuration or an object of the package may."""
    if isinstance(value, float):
        return value == PRIOR
    if isinstance(value, Mapping):
        parts = [value._get_node(key) for key in value] if hasattr(value, "_get_node") else value.values()
    elif type(value).__module__.startswith("gmmtorch"):
        parts = vars(value).values() if hasattr(value, "__dict__") else ()
    else:  # a node of a configuration, or what contains no option
        return type(value).__module__ == "omegaconf.nodes" and holds_prior(value._value(), depth + 1)
    return depth < 5 and any(holds_prior(part, depth + 1) for part in parts)


def stations_of_an_option() -> list[tuple[str, str]]:
    """File and name of each call to which gmmtorch-map hands map.prior, until the map is made."""
    sys.path.insert(0, str(ROOT))
    from gmmtorch.cli import map as command

    found: list[tuple[str, str]] = []

    def note(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(str(PACKAGE)) or code.co_name.startswith("<"):
            return
        sys.setprofile(None)
        arguments = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount + 2]
        if any(holds_prior(frame.f_locals.get(name)) for name in arguments):
            found.append((code.co_filename, code.co_qualname))
        sys.setprofile(None if code.co_qualname == "MapState.__init__" else note)

    quiet = [f"report.{name}=false" for name in ("progress", "figures", "tensorboard")]
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        options = ["dataset=synthetic_building_2d", "dataset.n_scans=2", f"hydra.run.dir={folder}", *quiet]
        sys.argv = ["gmmtorch-map", f"map.prior={PRIOR}", *options]
        sys.setprofile(note)
        command.main()
    return found


def main() -> None:
    files = sorted(PACKAGE.rglob("*.py"))
    for home in ("map", *HOMES, "all"):
        own = [path for path in files if home in (home_of(path), "all")]
        lines, classes = sum(map(n_lines, own)), sum(map(n_classes, own))
        print(f"{home:<12} {lines:>6,} lines {len(own):>4} files {classes:>4} classes")
    longest = max(files, key=n_lines)
    folder, entries = Counter(path.parent for path in files).most_common(1)[0]
    print(f"longest file    {longest.relative_to(ROOT)}: {n_lines(longest)} lines")
    print(f"largest folder  {folder.relative_to(ROOT)}: {entries} files")
    for door in sorted(PACKAGE.rglob("__init__.pyi")):
        names = door.read_text(encoding="utf-8").count(" as ")
        print(f"door            {'.'.join(door.parent.relative_to(ROOT).parts)}: {names} names")
    sources = [path for path in PACKAGE.rglob("*.h") if "build" not in path.parts]
    print(f"C++             {sum(map(n_lines, sources)):,} lines in {len(sources)} source files")
    stations = stations_of_an_option()
    entered = [file for i, (file, _) in enumerate(stations) if i == 0 or file != stations[i - 1][0]]
    n_files, turns = len(set(entered)), len(entered) - len(set(entered))
    print(f"map.prior       {len(set(stations))} stations in {n_files} files, turns back {turns} times")
    tests = list((ROOT / "tests").rglob("*.py"))
    print(f"tests           {sum(map(n_lines, tests)):,} lines in {len(tests)} files")


if __name__ == "__main__":
    main()
