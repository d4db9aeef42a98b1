"""Which room may import from which, and how light the package is to import."""

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
    "cli",
]
GROUND = ["errors", "lazy_names", "linalg", "files", "scan", "optional_packages"]
RANK = {**dict.fromkeys(GROUND, 0), **{room: i for i, room in enumerate(ROOMS, 1)}}
OWNERS = {"hydra": {"cli"}, "omegaconf": {"cli"}, "matplotlib": {"report"}, "tensorboard": {"report"}}
"""Heavy third parties, and the only room that may know each."""


def modules() -> Iterator[tuple[Path, str]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        relative = path.relative_to(PACKAGE)
        if relative.parts != ("__init__.py",):  # the front door knows every room
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


def test_every_room_has_its_place():
    unknown = {room for _, room in modules()} - RANK.keys()
    assert not unknown, f"say where {sorted(unknown)} stand(s) in the order of rooms"


def test_a_room_imports_only_from_rooms_above_it():
    violations = []
    for path, room in modules():
        for name, line, _ in imported_names(path):
            parts = name.split(".")
            if parts[0] != "gmmtorch":
                continue
            target = parts[1] if len(parts) > 1 else ""
            place = f"{path.relative_to(PACKAGE)}:{line} imports {name}"
            if target not in RANK:
                # The front door hides which room is meant: only the last room may use it.
                if room != "cli" and target != "__version__":
                    violations.append(f"{place}, which names no room")
            elif target != room and RANK[target] > RANK[room]:
                violations.append(f"{place}: {room} stands above {target}")
    assert not violations, "\n".join(violations)


def test_the_order_is_checked_inside_functions_too(tmp_path):
    source = PACKAGE / "linalg.py"
    names = [name for name, _, _ in imported_names(source)]
    assert "gmmtorch.errors.NumericalError" in names
    lazy = [n for path, _ in modules() for n, _, inside in imported_names(path) if inside]
    assert any(name.startswith("open3d") for name in lazy)  # so imports inside functions are seen


def test_third_parties_are_known_to_their_own_room_only():
    violations = []
    for path, room in modules():
        for name, line, inside in imported_names(path):
            third_party = "tensorboard" if name.startswith("torch.utils.tensorboard") else name.split(".")[0]
            place = f"{path.relative_to(PACKAGE)}:{line} imports {name}"
            if room not in OWNERS.get(third_party, {room}):
                violations.append(f"{place}; only {', '.join(OWNERS[third_party])} may")
            if third_party == "open3d" and not inside:
                violations.append(f"{place} outside a function")
    assert not violations, "\n".join(violations)


def test_what_modules_import_is_declared():
    """And not merely there because another package wants it."""
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = [
        *project["dependencies"],
        *(entry for name in extras if name != "dev" for entry in extras[name]),
    ]
    declared = {re.split(r"[<>=\[]", entry)[0].lower() for entry in wanted} | {"omegaconf"}  # a part of Hydra
    homes = packages_distributions()
    missing = []
    for path, _ in modules():
        for name, line, inside in imported_names(path):
            root = name.split(".")[0]
            if inside or root == "gmmtorch" or root in sys.stdlib_module_names:
                continue
            if not declared & {home.lower() for home in homes.get(root, [root])}:
                missing.append(f"{path.relative_to(PACKAGE)}:{line} imports {name}")
    assert not missing, "\n".join(missing)


def loaded_by(statement: str) -> set[str]:
    code = f"{statement}\nimport sys\nprint('\\n'.join(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_the_package_loads_nothing_heavy():
    heavy = {"torch", "sklearn", "open3d", "scipy", "matplotlib", "numpy", "hydra"}
    assert not heavy & loaded_by("import gmmtorch")


def test_learning_and_mapping_need_no_open3d():
    loaded = loaded_by("import gmmtorch\nfor name in gmmtorch.__all__: getattr(gmmtorch, name)")
    assert "torch" in loaded
    assert not {"open3d", "hydra", "matplotlib"} & loaded


@pytest.mark.parametrize("name", gmmtorch.__all__)
def test_every_public_name_resolves(name):
    assert getattr(gmmtorch, name).__name__ in (name, f"gmmtorch.{name}")
    assert name in dir(gmmtorch)


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="no_such_name"):
        gmmtorch.no_such_name  # noqa: B018


@pytest.mark.parametrize("path", [p for p, _ in modules()], ids=lambda p: str(p.relative_to(PACKAGE)))
def test_the_names_a_module_exports_exist(path):
    if "__all__" not in path.read_text(encoding="utf-8"):
        return
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    module = importlib.import_module(".".join(parts).removesuffix(".__init__"))
    missing = [name for name in module.__all__ if not hasattr(module, name)]
    assert not missing
