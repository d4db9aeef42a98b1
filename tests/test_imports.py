"""Which room may import from which, and which modules an import of the package loads."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

import gmmtorch

PACKAGE = Path(gmmtorch.__file__).parent
HOMES = ("team", "experiments")
"""Homes beside the map. A room is a package directly in gmmtorch/ or in a home."""
GROUND = [
    "errors",
    "declarations",
    "arrays",
    "linalg",
    "pose",
    "files",
    "scan",
    "pinhole",
    "optional_packages",
    "processes",
    "kernels",
]
ROOMS = [
    "simulation",
    "datasets",
    "mixture",
    "occupancy",
    "mapping",
    "localization",
    "export",
    "report",
    "live",
    "cli",
    "team.sharing",
    "team.exploration",
    "team.report",
    "team.cli",
    "experiments.baselines",
    "experiments.evaluation",
    "experiments.harness",
    "experiments.studies",
    "experiments.report",
    "experiments.cli",
]
"""The order of the rooms: each imports from earlier ones only. So the map imports no home, and teams do not
import experiments."""
OLD_NAMES = ["sharing", "baselines"]
"""Modules that lead to a home under the names of version 1.0."""
RANK = {**dict.fromkeys(GROUND, 0), **{room: i for i, room in enumerate(ROOMS, 1)}}
OWNERS = {"hydra": {"cli"}, "omegaconf": {"cli"}, "matplotlib": {"report"}, "tensorboard": {"report"}}
"""Heavy third-party packages, and the only rooms, in any home, that may import each."""


def room_of(name: str) -> str:
    """The room of a dotted name, without `gmmtorch`: mapping, or team.sharing."""
    parts = name.split(".")[1:]
    return ".".join(parts[: 2 if parts and parts[0] in HOMES else 1])


def modules() -> Iterator[tuple[Path, str]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        relative = path.relative_to(PACKAGE)
        name = ".".join(["gmmtorch", *relative.with_suffix("").parts]).removesuffix(".__init__")
        if name.removeprefix("gmmtorch.") not in ("gmmtorch", *OLD_NAMES, *HOMES):
            yield path, room_of(name)


def imported_names(path: Path) -> Iterator[tuple[str, int, bool]]:
    """(dotted name, line, whether inside a function) of every import, type-checking ones too."""

    def visit(node: ast.AST, inside: bool) -> Iterator[tuple[str, int, bool]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                for alias in child.names:
                    yield alias.name, child.lineno, inside
            elif isinstance(child, ast.ImportFrom):
                package = ["gmmtorch", *path.relative_to(PACKAGE).parts[:-1]]
                base = package[: len(package) - child.level + 1] if child.level else []
                module = ".".join([*base, *([child.module] if child.module else [])])
                for alias in child.names:
                    yield f"{module}.{alias.name}", child.lineno, inside
            deeper = inside or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            yield from visit(child, deeper)

    yield from visit(ast.parse(path.read_text(encoding="utf-8")), False)


@pytest.fixture(scope="module")
def imports() -> list[tuple[str, str, str, bool]]:
    """(file:line, room, dotted name, whether inside a function) of all imports of the package."""
    return [
        (f"{path.relative_to(PACKAGE)}:{line} imports {name}", room, name, inside)
        for path, room in modules()
        for name, line, inside in imported_names(path)
    ]


def test_every_room_has_a_rank():
    unknown = {room for _, room in modules()} - RANK.keys()
    assert not unknown, f"state the rank of {sorted(unknown)} in the order of rooms"


def test_a_room_imports_only_from_rooms_above_it(imports):
    violations = []
    for place, room, name, _ in imports:
        if name.split(".")[0] != "gmmtorch":
            continue
        target = room_of(name)
        if target not in RANK:
            # An import from the package itself hides the room: only commands may use it.
            if room.split(".")[-1] != "cli" and target != "__version__":
                violations.append(f"{place}, which names no room")
        elif target != room and RANK[target] > RANK[room]:
            violations.append(f"{place}: {room} stands above {target}")
    assert not violations, "\n".join(violations)


def test_rooms_import_from_each_other_only_what_their_doors_offer(imports):
    violations = []
    for place, room, name, _ in imports:
        target = room_of(name)
        if (
            name.split(".")[0] == "gmmtorch"
            and target in ROOMS
            and target != room
            and name != f"gmmtorch.{target}"
        ):
            offered = importlib.import_module(f"gmmtorch.{target}").__all__
            if name.removeprefix(f"gmmtorch.{target}.") not in offered:
                violations.append(f"{place}, past the door of {target}")
    assert not violations, "\n".join(violations)


@pytest.mark.parametrize("room", [*ROOMS, "kernels"])
def test_a_door_offers_names_that_exist_and_that_others_use(room):
    door = importlib.import_module(f"gmmtorch.{room}")
    folder = PACKAGE.joinpath(*room.split("."))
    readers = [path for path in PACKAGE.rglob("*.py") if folder not in path.parents]
    readers += [
        path
        for top in ("docs", "tests", "examples", "benchmarks")
        for path in (PACKAGE.parent / top).rglob("*.*")
    ]
    text = "\n".join(path.read_text("utf-8") for path in readers if path.suffix in (".py", ".md", ".rst"))
    for name in getattr(door, "__all__", []):
        is_type = isinstance(getattr(door, name), type)  # the result of a function of the door, perhaps
        assert is_type or re.search(rf"\b{name}\b", text), f"nothing outside gmmtorch.{room} uses {name}"


def test_imports_inside_functions_are_found(imports):
    assert any(name == "gmmtorch.errors.NumericalError" for _, room, name, _ in imports if room == "linalg")
    assert any(name.startswith("open3d") for _, _, name, inside in imports if inside)


def test_only_owner_rooms_import_heavy_third_party_packages(imports):
    violations = []
    for place, room, name, inside in imports:
        third_party = "tensorboard" if name.startswith("torch.utils.tensorboard") else name.split(".")[0]
        if room.split(".")[-1] not in OWNERS.get(third_party, {room.split(".")[-1]}):
            violations.append(f"{place}; only {', '.join(OWNERS[third_party])} may")
        if third_party == "open3d" and not inside:
            violations.append(f"{place} outside a function")
    assert not violations, "\n".join(violations)


def test_all_imported_packages_are_declared(imports):
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = [
        *project["dependencies"],
        *(entry for name in extras if name != "dev" for entry in extras[name]),
    ]
    declared = {re.split(r"[<>=\[]", entry)[0].lower() for entry in wanted} | {"omegaconf"}  # a part of Hydra
    homes = packages_distributions()
    missing = []
    for place, _, name, inside in imports:
        root = name.split(".")[0]
        if inside or root == "gmmtorch" or root in sys.stdlib_module_names:
            continue
        if not declared & {home.lower() for home in homes.get(root, [root])}:
            missing.append(place)
    assert not missing, "\n".join(missing)


def test_the_package_a_replica_and_the_public_names_load_only_what_they_use():
    code = """
import sys
import gmmtorch
print(*sys.modules)
from gmmtorch.team.sharing import Replica
print(*sys.modules)
for name in gmmtorch.__all__:
    getattr(gmmtorch, name)
print(*sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    package, replica, public = (set(line.split()) for line in done.stdout.splitlines())
    assert not {"torch", "sklearn", "open3d", "scipy", "matplotlib", "numpy", "hydra"} & package
    assert "gmmtorch.team.sharing.replica" in replica
    assert not {"sklearn", "scipy", "matplotlib", "open3d", "hydra", "tensorboard"} & replica
    assert "torch" in public
    assert not {"open3d", "hydra", "matplotlib"} & public


def test_every_public_name_resolves():
    for name in gmmtorch.__all__:
        assert getattr(gmmtorch, name).__name__.split(".")[-1] == name
        assert name in dir(gmmtorch)
    with pytest.raises(AttributeError, match="no_such_name"):
        gmmtorch.no_such_name  # noqa: B018


def test_the_names_that_modules_export_exist():
    missing = []
    for path, _ in modules():
        if "__all__" in path.read_text(encoding="utf-8"):
            parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
            module = importlib.import_module(".".join(parts).removesuffix(".__init__"))
            missing += [f"{path}: {name}" for name in module.__all__ if not hasattr(module, name)]
    assert not missing
