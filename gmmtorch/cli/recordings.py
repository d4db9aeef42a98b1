"""gmmtorch-map inputs=[…]: maps each recording as a task, and merges the maps tile by tile."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import logging
import os
import platform
import re
import socket
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from gmmtorch.cli import common, inputs
from gmmtorch.cli.reporting import map_outputs
from gmmtorch.errors import (
    DAMAGED_CONTENT,
    DataError,
    GmmTorchError,
    InvalidArgumentError,
    MissingDataError,
    check_whole,
)
from gmmtorch.files import write_bytes, write_json
from gmmtorch.mapping import MapBuilder, TiledMap, check_same_run, merge, resident_bytes, tile_files
from gmmtorch.optional_packages import load_ray
from gmmtorch.report import ProgressBars, Row

_STAGE = "recordings"
_DONE = "recording.json"  # written last: it says that a recording is complete
_SUMS = ("n_scans", "n_skipped", "n_points", "metres", "seconds", "cpu_seconds")
TABLE = "dataset n_recordings n_failed n_scans n_points metres n_tiles n_components nbytes cpu_seconds"


Mapped = tuple[dict[str, bytes], Row, str | None]
"""The files and the row of results.json of a recording; or its error."""


def run(config: DictConfig) -> None:
    """Run the command. Recordings that an earlier run in this folder has finished are kept."""
    begin, folder = time.monotonic(), common.run_dir()
    if config.view:
        raise InvalidArgumentError(
            "view=true shows one recording; with inputs, use gmmtorch-view afterwards."
        )
    if "path" not in config.dataset.keys() or not OmegaConf.is_missing(config.dataset, "path"):  # noqa: SIM118
        raise InvalidArgumentError(
            f"inputs are paths of dataset={config.dataset.name}: choose the data set whose files they are, "
            "such as dataset=rosbag, and leave dataset.path out."
        )
    # An invalid option fails before any work.
    inputs.map_factory(config, resolution=config.resolution, memory=None)
    found = find_recordings(config.inputs)
    facts = {name: _facts(config, address) for name, address in found.items()}
    with ProgressBars(enabled=config.report.progress) as bars:
        rows = _map_all(config, facts, folder / map_outputs.RECORDINGS, bars)
        failed = [row for row in rows if row["error"]]
        places = [folder / map_outputs.RECORDINGS / name for name in found]
        finished = [place for place in places if (place / _DONE).exists()]
        if finished:
            rows.append(_merge(config, finished, rows, folder, bars))
            rows[-1]["seconds_of_run"] = time.monotonic() - begin
        common.write_results("map", config, rows, folder)
        exported, errors = _show(config, finished, rows[-1], folder, bars) if finished else ([], [])
    if finished:
        common.print_table(rows[-1:], TABLE.split(), f"{len(found)} recordings")
        print("", f"map       {folder / 'tiles'}", *exported, sep="\n")
    common.print_files(folder)
    if failed:
        reasons = " ".join(f"{row['input']}: {row['error'].splitlines()[-1]}" for row in failed)
        raise GmmTorchError(
            f"{len(failed)} of {len(found)} recordings could not be mapped. {reasons} The same options with "
            f"hydra.run.dir={folder} try them again."
        )
    map_outputs.check_exported(config, errors)


def _facts(config: DictConfig, address: str) -> dict[str, Any]:
    """What the map of a recording depends on."""
    facts = map_outputs.run_facts(config, "dataset")
    del facts["dataset"]["path"]
    return {"input": address, **facts, "resolution": config.resolution, "tile": config.tile}


def _map_all(
    config: DictConfig, facts: dict[str, dict[str, Any]], folder: Path, bars: ProgressBars
) -> list[Row]:
    """Maps the recordings that are not finished; returns the rows of all, in the order of their names."""
    rows = {name: _finished(folder / name, known) for name, known in facts.items()}
    options = {"runtime": common.as_options(config.runtime)}
    arguments = {name: (facts[name], options) for name, row in rows.items() if row is None}
    n_done = len(facts) - len(arguments)
    if n_done:
        print(f"continues: {n_done} of {len(facts)} recordings are finished in {folder}")
    if arguments:
        bars(_STAGE, n_done, len(facts))
        for outcome in run_tasks(map_recording, arguments, config.workers, config.cluster):
            rows[outcome.name] = _keep(outcome, facts[outcome.name], folder / outcome.name)
            n_done += 1
            bars(_STAGE, n_done, len(facts))
    return [row for row in rows.values() if row is not None]


def _finished(folder: Path, facts: dict[str, Any]) -> Row | None:
    """The row of a recording that is finished. Raises an error if it was mapped with other options."""
    path = folder / _DONE
    if not path.exists():
        return None
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        run_facts, row = dict(stored["run"]), dict(stored["row"])
        if not all(isinstance(row[name], int | float) for name in _SUMS):
            raise TypeError("a count is not a number")
    except DAMAGED_CONTENT as error:
        raise DataError(f"{path} is damaged ({error!r}); delete {folder} to map it again.") from error
    check_same_run(path, run_facts, facts)
    return row


def _keep(outcome: Outcome, facts: dict[str, Any], folder: Path) -> Row:
    """Writes the files of a recording, and returns its row."""
    files, row, error = outcome.result or ({}, {}, outcome.error)
    row = {"input": facts["input"], "error": error, "n_lost": outcome.n_lost, **row}
    if error is None:
        for name, data in files.items():
            write_bytes(folder / name, data)
        write_json(folder / _DONE, {"run": facts, "row": row})
    return row


def map_recording(facts: dict[str, Any], options: dict[str, Any]) -> Mapped:
    """The map of one recording in tiles, its trajectory and its row. Runs in a worker; raises nothing."""
    config = OmegaConf.create({**facts, **options})
    config.runtime.dtype = facts["dtype"]
    try:
        with local_copy(facts["input"]) as path:
            return _mapped(config, path)
    except GmmTorchError as error:
        return {}, {}, str(error)
    except Exception as error:
        return {}, {}, f"{traceback.format_exc()}{type(error).__name__}: {error!s}"


def _mapped(config: DictConfig, path: Path) -> Mapped:
    begin = time.process_time()
    device = common.use_runtime(config.runtime)
    config.dataset.path = str(path)
    dataset, poses, odometry = inputs.open_with_trajectory(config.dataset)
    with tempfile.TemporaryDirectory(prefix="gmmtorch-") as name:
        folder = Path(name)
        built = inputs.new_map(config, dataset, folder / "growing", device)
        builder = MapBuilder(dataset, built, device)
        for _ in builder.insert_all():
            pass
        builder.finish()
        if isinstance(built, TiledMap):
            merge(folder, [built])
            files = {}
        else:
            files = tile_files(built.components(), built.settings, config.tile)
        map_outputs.write_trajectory(builder, folder)
        if poses is not None:
            map_outputs.write_estimated_poses(dataset, poses, folder)
        # The growing map and the lock of the merged one have no suffix.
        files |= {file.name: file.read_bytes() for file in folder.iterdir() if file.suffix}
        row = map_outputs.result_row(dataset.name, builder, config, odometry)
    row |= {"cpu_seconds": time.process_time() - begin, "worker": f"{platform.node()}:{os.getpid()}"}
    return files, row, None


def _merge(
    config: DictConfig, places: Sequence[Path], rows: Sequence[Row], folder: Path, bars: ProgressBars
) -> Row:
    """Merges the finished recordings into tiles/; returns the row of the merged map."""
    begin, memory = time.process_time(), [resident_bytes()]

    def note(stage: str, n_done: int, n_total: int | None) -> None:
        bars(stage, n_done, n_total)
        memory.append(resident_bytes())

    tiled = merge(folder / "tiles", [TiledMap(place) for place in places], on_event=note)
    mapped = [row for row in rows if not row["error"]]
    metres = sum(row["metres"] for row in mapped)
    return {
        "dataset": config.dataset.name,
        "input": None,
        "error": None,
        "n_recordings": len(mapped),
        "n_failed": len(rows) - len(mapped),
        "n_lost": sum(row["n_lost"] for row in rows),
        **{name: sum(row[name] for row in mapped) for name in _SUMS},
        "n_tiles": len(tiled.index),
        "n_components": tiled.n_components,
        "nbytes": tiled.nbytes,
        "bytes_per_metre": map_outputs.bytes_per_metre(tiled.nbytes, metres),
        "merge_cpu_seconds": time.process_time() - begin,
        "memory_bytes": max(memory),
    }


def _show(
    config: DictConfig, places: Sequence[Path], row: Row, folder: Path, bars: ProgressBars
) -> tuple[list[str], list[str]]:
    """Writes the exports and pictures of the merged map; returns messages, and errors of exports.

    A map that does not fit into `runtime.memory_limit` has no pictures.
    """
    tiled = TiledMap(folder / "tiles", config.runtime.device, memory_limit=config.runtime.memory_limit)
    built, exported, errors = map_outputs.write_exports(config, tiled, folder, bars)
    if built is None:
        return exported, errors
    paths = [map_outputs.positions(place / map_outputs.TRAJECTORY, tiled.dim) for place in places]
    map_outputs.draw(config, built, paths, row, folder)
    return exported, errors


_LONGEST_NAME = 60


def find_recordings(inputs: Sequence[str]) -> dict[str, str]:
    """The address of each recording by a name that is unique and a valid file name, sorted.

    inputs: files or folders, globs with *, ? and **, and URLs such as s3://bucket/drives/*.mcap. What two of
    them match is one recording.

    Raises `MissingDataError` for an input that matches nothing, and `DataError` for a URL that cannot be
    read.
    """
    found: dict[str, str] = {}
    for pattern in inputs:
        matches = _remote(pattern) if "://" in pattern else _local(pattern)
        if not matches:
            raise MissingDataError(
                f"inputs={pattern!r} matches no file or folder; give paths, globs or URLs of recordings."
            )
        found |= {_name(address): address for address in matches}
    return dict(sorted(found.items()))


def _local(pattern: str) -> list[str]:
    matches = glob.glob(str(Path(pattern).expanduser()), recursive=True)
    return [str(Path(match).resolve()) for match in matches]


def _remote(pattern: str) -> list[str]:
    with _errors_of(pattern):
        system, path = _file_system(pattern)
        matches = system.glob(path) if glob.has_magic(path) else [path] if system.exists(path) else []
        return [str(system.unstrip_protocol(match)) for match in matches]


def _name(address: str) -> str:
    """The last part of an address, and the start of its hash, because two folders can have equal names."""
    last = address.rstrip("/").split("/")[-1] if "://" in address else Path(address).name
    stem = re.sub(r"[^\w.-]+", "_", last)[:_LONGEST_NAME].strip(".")
    return f"{stem or 'recording'}-{hashlib.sha256(address.encode()).hexdigest()[:8]}"


@contextlib.contextmanager
def local_copy(address: str) -> Iterator[Path]:
    """A local path of a recording. A remote one is copied to a temporary folder, which is removed at the end.

    Raises `DataError` if it cannot be copied.
    """
    if "://" not in address:
        yield Path(address)
        return
    with tempfile.TemporaryDirectory(prefix="gmmtorch-") as folder:
        target = Path(folder) / address.rstrip("/").split("/")[-1]
        with _errors_of(address):
            system, path = _file_system(address)
            system.get(path, str(target), recursive=bool(system.isdir(path)))
        yield target


def _file_system(url: str) -> tuple[Any, str]:
    import fsspec  # a dependency of torch

    system, path = fsspec.core.url_to_fs(url)
    return system, str(path)


@contextlib.contextmanager
def _errors_of(url: str) -> Iterator[None]:
    """Errors of a file system become a `DataError` that names the URL."""
    try:
        yield
    except ImportError as error:
        protocol = url.partition("://")[0]
        raise DataError(
            f"inputs: {url} cannot be read: {error}. fsspec reads {protocol}:// with that package: install "
            "it with pip."
        ) from error
    except Exception as error:  # every file system has errors of its own
        raise DataError(
            f"inputs: {url} cannot be read ({type(error).__name__}: {error}); check the address and your "
            "access to it."
        ) from error


_TRIES = 3
_REACH_SECONDS = 10.0
_OBJECT_BYTES = 256 << 20  # memory that results of local tasks share until they are fetched


class Outcome(NamedTuple):
    """The result of a task, or its error. n_lost: workers that were lost while they ran it."""

    name: str
    result: Any
    n_lost: int
    error: str | None = None


def run_tasks(
    task: Callable[..., Any], arguments: Mapping[str, tuple[Any, ...]], workers: int, cluster: str | None
) -> Iterator[Outcome]:
    """Outcomes of `task(*arguments[name])` for each name, as they finish.

    Args:
        task: a function of a module that the workers can import. It raises nothing.
        workers: processes of this machine; with 1 the tasks run in this process, and Ray is not needed.
        cluster: address of a Ray cluster, such as ray://head:10001 or auto; then `workers` is not used.

    A task whose worker is killed, or runs out of memory, runs again, on another worker.
    Raises `GmmTorchError` if Ray is needed and does not load, or the cluster cannot be reached.
    """
    check_whole("workers", workers, 1)
    if workers == 1 and cluster is None:
        for name, values in arguments.items():
            yield Outcome(name, task(*values), 0)
        return
    ray = load_ray()
    if cluster is not None:
        _check_reachable(cluster)
    _start(ray, min(workers, len(arguments)), cluster)
    try:
        yield from _outcomes(ray, task, arguments)
    finally:
        ray.shutdown()


def _start(ray: Any, workers: int, cluster: str | None) -> None:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is reported to Ray's authors
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    if cluster is None:
        options |= {"num_cpus": workers, "include_dashboard": False, "object_store_memory": _OBJECT_BYTES}
    try:
        ray.init(address=cluster or "local", **options)
    except Exception as error:  # by the address: ConnectionError, ValueError, RuntimeError, errors of gRPC
        place = f"cluster={cluster}" if cluster else f"workers={workers}"
        raise GmmTorchError(
            f"{place}: Ray does not start ({type(error).__name__}: {error}); check the address of the "
            "cluster and that its Ray has this version, or use workers=1."
        ) from error


def _check_reachable(cluster: str) -> None:
    """Raises `GmmTorchError` if nobody listens at an address with a port: Ray would wait for minutes."""
    host, _, port = cluster.removeprefix("ray://").rpartition(":")
    if not (host and port.isdigit()):
        return
    try:
        socket.create_connection((host, int(port)), timeout=_REACH_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise GmmTorchError(
            f"cluster={cluster} cannot be reached ({error}); check the address of the cluster's "
            "head, or leave cluster out."
        ) from error


def _outcomes(
    ray: Any, task: Callable[..., Any], arguments: Mapping[str, tuple[Any, ...]]
) -> Iterator[Outcome]:
    remote = ray.remote(num_cpus=1, max_retries=0)(task)  # retries are counted here
    running = {remote.remote(*values): (name, 0) for name, values in arguments.items()}
    while running:
        (done,), _ = ray.wait(list(running), num_returns=1)
        name, n_lost = running.pop(done)
        try:
            yield Outcome(name, ray.get(done), n_lost)
        except ray.exceptions.RayTaskError as error:  # such as a worker that lacks gmmtorch
            yield Outcome(name, None, n_lost, f"its worker failed: {error}")
        except ray.exceptions.RayError as error:
            if n_lost + 1 < _TRIES:
                running[remote.remote(*arguments[name])] = (name, n_lost + 1)
            else:
                yield Outcome(name, None, n_lost + 1, f"its worker was lost {n_lost + 1} times: {error}")
