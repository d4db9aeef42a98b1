"""Diagnostics: how a live mapper keeps up, as numbers and on the topic /diagnostics."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np

from gmmtorch.live.mapper.live_scans import LiveScans
from gmmtorch.live.ros import Node
from gmmtorch.mapping import resident_bytes

_PERIOD = 1.0  # s
_MOST = 10_000  # latencies that are kept
_OTHER_CLOCK = 60.0  # s of latency, which shows that stamps come from another clock
_OK, _WARN = 0, 1


class Diagnostics:
    """Counts scans and latencies of a mapper, and publishes them once a second."""

    def __init__(self, node: Node, scans: LiveScans, name: str = "gmmtorch mapping") -> None:
        self._node, self._scans, self._name = node, scans, name
        self._latencies: deque[float] = deque(maxlen=_MOST)
        self._send = node.publisher("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        self._begin = time.monotonic()
        self._last, self._n_last, self._n_dropped = self._begin, 0, 0
        self._nbytes = 0
        self._rate = 0.0

    def note_latency(self, seconds: float) -> None:
        """Notes the time from the stamp of a scan to the publication of a map with it."""
        if abs(seconds) > _OTHER_CLOCK:
            self._node.warn(
                "clock",
                f"stamps are {seconds:.0f} s away from the clock of this node. For a recording that is "
                "played set use_sim_time=true; for a sensor with a clock of its own "
                "clock=received.",
            )
            return
        self._latencies.append(seconds)

    def is_due(self) -> bool:
        """Whether a second has passed since the last publication."""
        return time.monotonic() - self._last >= _PERIOD

    def publish(self, n_scans: int, n_components: int, nbytes: int) -> None:
        """Publishes the numbers; nbytes: of the map."""
        now = time.monotonic()
        self._rate = (n_scans - self._n_last) / max(now - self._last, 1e-3)
        self._last, self._n_last = now, n_scans
        self._nbytes = nbytes
        dropped = self._scans.n_dropped
        is_late, self._n_dropped = dropped > self._n_dropped, dropped
        if is_late:
            self._node.warn("dropped", f"{dropped} scans were dropped: the sensor is faster than mapping.")
        numbers = self.numbers(n_scans, n_components)
        status = {
            "level": _WARN if is_late else _OK,
            "name": self._name,
            "message": "scans are dropped" if is_late else "keeps up",
            "hardware_id": self._scans.name,
            "values": [{"key": key, "value": f"{value:.6g}"} for key, value in numbers.items()],
        }
        self._send({"status": [status]})

    def numbers(self, n_scans: int, n_components: int) -> dict[str, float]:
        """All numbers by name; latencies in s are those of the last 10,000 scans."""
        latencies = np.array(self._latencies) if self._latencies else np.array([np.nan])
        counts: Any = self._node.counts
        return {
            "n_scans": n_scans,
            "scans_per_second": self._rate,
            "latency_median": float(np.median(latencies)),
            "latency_p99": float(np.percentile(latencies, 99)),
            "n_dropped": self._scans.n_dropped + counts.get(self._scans.name, {}).get("dropped", 0),
            "n_malformed": sum(c["malformed"] for c in counts.values()),
            "n_components": n_components,
            "nbytes": self._nbytes,
            "memory_bytes": resident_bytes(),
            "seconds": time.monotonic() - self._begin,
        }
