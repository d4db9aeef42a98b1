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
ROOMS = [
    "simulation",
    "datasets",
    "mixture",
    "occupancy",
    "mapping",
    "localization",
    "baselines",
    "export",
    "evaluation",
    "sharing",
    "exploration",
    "report",
    "live",
    "cli",
]
GROUND = [
    "errors",
    "lazy_names",
    "arrays",
    "linalg",
    "files",
    "scan",
    "pinhole",
    "optional_packages",
    "kernels",
]
RANK = {**dict.fromkeys(GROUND, 0), **{room: i for i, room in enumerate(ROOMS, 1)}}
OWNERS = {"hydra": {"cli"}, "omegaconf": {"cli"}, "matplotlib": {"report"}, "tensorboard": {"report"}}
"""Heavy third-party packages, and the only rooms that may import each."""


def modules() -> Iterator[tuple[Path, str]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        relative = path.relative_to(PACKAGE)
        if relative.parts != ("__init__.py",):  # the package itself imports from every room
            yield path, relative.parts[0].removesuffix(".py")


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
        parts = name.split(".")
        if parts[0] != "gmmtorch":
            continue
        target = parts[1] if len(parts) > 1 else ""
        if target not in RANK:
            # An import from the package itself hides the room: only the last room may use it.
            if room != "cli" and target != "__version__":
                violations.append(f"{place}, which names no room")
        elif target != room and RANK[target] > RANK[room]:
            violations.append(f"{place}: {room} stands above {target}")
    assert not violations, "\n".join(violations)


def test_imports_inside_functions_are_found(imports):
    assert any(name == "gmmtorch.errors.NumericalError" for _, room, name, _ in imports if room == "linalg")
    assert any(name.startswith("open3d") for _, _, name, inside in imports if inside)


def test_only_owner_rooms_import_heavy_third_party_packages(imports):
    violations = []
    for place, room, name, inside in imports:
        third_party = "tensorboard" if name.startswith("torch.utils.tensorboard") else name.split(".")[0]
        if room not in OWNERS.get(third_party, {room}):
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
        assert getattr(gmmtorch, name).__name__ in (name, f"gmmtorch.{name}")
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
