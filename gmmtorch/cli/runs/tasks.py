"""Runs a task for each recording: in this process, or by Ray in processes of this machine or a cluster."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from gmmtorch.errors import GmmTorchError, check_whole
from gmmtorch.optional_packages import load_ray

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
