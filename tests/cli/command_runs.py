"""Runs commands in the process of the test, and in a new process."""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import logging
import os
import resource
import subprocess
import sys
from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.defaults_list import DefaultsList, create_defaults_list
from hydra._internal.hydra import Hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig

from gmmtorch.cli import common, export, localize, map, view
from gmmtorch.experiments.cli import fit, occupancy
from gmmtorch.team.cli import explore, robot, ros, team

CHECKOUT = Path(__file__).resolve().parents[2]
CONF = Path(common.conf_dir())


# Tests compose a thousand configurations of some fifty choices of groups. Hydra copies the store of all
# schemas for each, and composes that of a run once more to see whether it sets `hydra.mode`. Here each choice
# is composed once, and options are applied to copies of it.
ConfigStore.__deepcopy__ = lambda store, memo: store
Hydra.get_mode = lambda hydra, config_name, overrides: None
_CHOSEN: dict[str, DefaultsList] = {}
_MERGED: dict[str, DictConfig] = {}
_merge = ConfigLoaderImpl._compose_config_from_defaults_list


def _chosen_once(repo: Any, config_name: str, overrides_list: list[Any], **how: Any) -> DefaultsList:
    given = [one for one in overrides_list if not one.is_sweep_override()]
    groups = [
        one for one in given if repo.group_exists(one.key_or_group) and not isinstance(one.value(), dict)
    ]
    key = repr((config_name, [one.input_line for one in groups], how, repo.get_sources()))
    if key not in _CHOSEN:
        _CHOSEN[key] = create_defaults_list(repo, config_name, groups, **how)
    return replace(_CHOSEN[key], config_overrides=[one for one in given if one not in groups])


def _merged_once(loader: ConfigLoaderImpl, defaults: list[Any], repo: Any) -> DictConfig:
    key = repr((defaults, repo.get_sources()))
    if key not in _MERGED:
        _MERGED[key] = _merge(loader, defaults, repo)
    return deepcopy(_MERGED[key])


config_loader_impl.create_defaults_list = _chosen_once
ConfigLoaderImpl._compose_config_from_defaults_list = _merged_once


def register_schemas() -> None:
    """Stores the options of all commands in Hydra's config store."""
    for command in COMMANDS.values():
        command.register()


COMMANDS = {
    "occupancy": occupancy,
    "fit": fit,
    "export": export,
    "explore": explore,
    "robot": robot,
    "team": team,
    "map": map,
    "localize": localize,
    "view": view,
    "ros": ros,
}
QUIET = ["report.progress=false", "report.figures=false", "report.tensorboard=false"]
TINY = {
    "occupancy": ["dataset.n_scans=10", "map.n_samples=20000"],
    "fit": ["max_points=400", "mixture.n_components=5", "mixture.max_iter=20"],
}


def composed(command: str, *overrides: str) -> DictConfig:
    """The configuration of a command, with these overrides."""
    register_schemas()
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        return compose(command, overrides=list(overrides))


def shrink(monkeypatch: pytest.MonkeyPatch, study: type, **values: Any) -> None:
    """Gives fields of a study that are no options other defaults."""
    made: Any = study.__init__
    names = [item.name for item in fields(study)]
    changed = {**dict(zip(names, made.__defaults__, strict=True)), **values}
    assert len(changed) == len(names)
    monkeypatch.setattr(made, "__defaults__", tuple(changed.values()))


def room_mesh(path: Path) -> Path:
    """Writes a mesh: the six walls of an empty room of 7 by 6 by 3 metres, two triangles each."""
    corners = [f"v {x} {y} {z}" for x, y, z in itertools.product((0.0, 7.0), (0.0, 6.0), (0.0, 3.0))]
    walls = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    faces = [f"f {a} {b} {c}\nf {a} {c} {d}" for a, b, c, d in walls]
    path.write_text("\n".join([*corners, *faces, ""]))
    return path


@dataclass
class Finished:
    """The exit status of a command, its output, and its run directory."""

    status: int
    stdout: str
    stderr: str
    folder: Path

    def results(self) -> dict[str, Any]:
        """results.json; NaN and infinity, which JSON does not have, are errors."""

        def refuse(text: str) -> float:
            raise ValueError(f"results.json contains {text}")

        found: dict[str, Any] = json.loads((self.folder / "results.json").read_text(), parse_constant=refuse)
        return found

    def files(self) -> set[str]:
        """Every file of the run directory, hidden files included."""
        return {str(path.relative_to(self.folder)) for path in self.folder.rglob("*") if path.is_file()}


def succeeded(done: Finished) -> Finished:
    assert done.status == 0, done.stderr
    return done


def refused(done: Finished) -> str:
    """The one-line error of a command that failed before it wrote results."""
    assert done.status == 1
    assert not (done.folder / "results.json").exists()
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr[-2000:]
    assert lines[0].startswith("gmmtorch: error: ")
    return lines[0]


@contextlib.contextmanager
def as_it_was() -> Iterator[None]:
    """Restores Hydra's global state and the loggers on exit."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    GlobalHydra.instance().clear()
    try:
        yield
    finally:
        GlobalHydra.instance().clear()
        for handler in set(root.handlers) - set(handlers):
            with contextlib.suppress(OSError):  # the disk may be full
                handler.close()
        root.handlers, root.level = handlers, level


def run_here(monkeypatch: pytest.MonkeyPatch, command: str, folder: Path, *options: str) -> Finished:
    """Run a command in this process, which is fast because torch is loaded."""
    flags = [option for option in options if option.startswith("-")]  # Hydra expects these first
    overrides = [option for option in options if option not in flags]
    monkeypatch.setattr(sys, "argv", [command, *flags, f"hydra.run.dir={folder}", *overrides])
    stdout, stderr = io.StringIO(), io.StringIO()
    status: Any = 0
    with as_it_was(), contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
        try:
            COMMANDS[command].main()
        except SystemExit as end:
            status = end.code
            if isinstance(status, str):  # as the interpreter does
                print(status, file=sys.stderr)
                status = 1
    return Finished(status or 0, stdout.getvalue(), stderr.getvalue(), folder)


class Disk:
    """Simulates a full disk for this process by a limit of the file size; removes the limit on exit."""

    def __init__(self) -> None:
        self._limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(self) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, self._limits[1]))

    def clear(self) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, self._limits)

    def __enter__(self) -> Disk:
        return self

    def __exit__(self, *_: object) -> None:
        self.clear()


def environment() -> dict[str, str]:
    """Environment of subprocesses: no display, and no PYTHONPATH, so scripts must find the checkout."""
    return {**os.environ, "MPLBACKEND": "agg", "OMP_NUM_THREADS": "1", "PYTHONPATH": ""}


def run_script(command: str, folder: Path, *options: str) -> Finished:
    """Run scripts/COMMAND.py of the checkout in a new process, from another directory."""
    arguments = [str(CHECKOUT / "scripts" / f"{command}.py"), f"hydra.run.dir={folder}", *options]
    done = run_python(arguments, cwd=folder.parent)
    return Finished(done.returncode, done.stdout, done.stderr, folder)


def run_python(arguments: Sequence[str], cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run Python with these arguments in a new process."""
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=environment(), capture_output=True, text=True, timeout=180
    )


def timeless(results: dict[str, Any]) -> dict[str, Any]:
    """results.json without times."""
    rows = [{k: v for k, v in row.items() if not k.endswith("seconds")} for row in results["rows"]]
    return {**results, "rows": rows}
