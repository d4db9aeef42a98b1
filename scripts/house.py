#!/usr/bin/env python3
"""Prints the size of the package: lines, files and classes of each home, its largest parts, and its doors.

Run it before and after a change of structure: python scripts/house.py
"""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "gmmtorch"
HOMES = ("team", "experiments")


def home_of(path: Path) -> str:
    """The home of a file of the package."""
    first = path.relative_to(PACKAGE).parts[0]
    return first if first in HOMES else "map"


def n_lines(path: Path) -> int:
    return path.read_text(encoding="utf-8").count("\n")


def n_classes(path: Path) -> int:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return sum(isinstance(node, ast.ClassDef) for node in ast.walk(tree))


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
    tests = list((ROOT / "tests").rglob("*.py"))
    print(f"tests           {sum(map(n_lines, tests)):,} lines in {len(tests)} files")


if __name__ == "__main__":
    main()
