"""LinkConditions: latency, loss, bandwidth and partitions of a simulated network's links."""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from gmmtorch.declarations import option
from gmmtorch.errors import InvalidArgumentError, check_number

if TYPE_CHECKING:
    import torch


class Partition(NamedTuple):
    """From `begin` until before `end` (s), robots of different groups do not receive each other's datagrams.

    groups: robot numbers. Robots that no group contains form one more group.
    """

    begin: float
    end: float
    groups: tuple[tuple[int, ...], ...]

    def divides(self, robot: int, other: int) -> bool:
        """Whether two robots are in different groups."""
        return self._group(robot) != self._group(other)

    def _group(self, robot: int) -> int:
        return next((number for number, group in enumerate(self.groups) if robot in group), -1)


@dataclass(frozen=True, kw_only=True)
class LinkConditions:
    """Conditions of all links of a network. Raises `InvalidArgumentError` for values out of range."""

    latency: float = option(
        0.05, "seconds from the end of transmission to arrival, at least", "network.delay"
    )
    jitter: float = option(
        0.0,
        "mean (s) of an exponential delay that is added for each receiver and each copy; reorders datagrams",
        "network.jitter",
    )
    bandwidth: float | None = option(
        None, "bytes per second that each robot can send; null: no limit", "network.bandwidth"
    )
    loss: float = option(0.0, "share of the datagrams that each receiver loses, [0, 1)", "network.loss")
    duplication: float = option(
        0.0, "share of the received datagrams that arrive twice, [0, 1]", "network.duplication"
    )
    reach: float | None = option(
        None, "largest distance (m) between two robots that communicate; null: any", "network.reach"
    )
    partitions: tuple[Partition, ...] = option(
        (),
        "as in [{begin: 60, end: 120, groups: [[0], [1, 2]]}]; simulated seconds, robots by id",
        "network.partitions",
    )

    def __post_init__(self) -> None:
        for field, largest in _LARGEST.items():
            value = getattr(self, field)
            if value is not None or field not in _OPTIONAL:
                checked = check_number(field, value, largest, above=field in _OPTIONAL)
                object.__setattr__(self, field, checked)
        if not isinstance(self.partitions, Sequence):
            raise InvalidArgumentError(f"partitions={self.partitions!r} must be a list of partitions.")
        partitions = tuple(_partition(f"partitions[{i}]", value) for i, value in enumerate(self.partitions))
        object.__setattr__(self, "partitions", partitions)

    def check_team(self, n_robots: int) -> None:
        """Raise `InvalidArgumentError` unless the partitions fit a team of `n_robots`."""
        for i, partition in enumerate(self.partitions):
            named = [robot for group in partition.groups for robot in group]
            if max(named) >= n_robots:
                raise InvalidArgumentError(
                    f"partitions[{i}].groups={partition.groups} names robot {max(named)}; there are "
                    f"{n_robots}, numbered from 0."
                )
            if len(partition.groups) + (len(named) < n_robots) < 2:
                raise InvalidArgumentError(
                    f"partitions[{i}].groups={partition.groups} puts all {n_robots} robots into one "
                    "group, and so divides nothing; leave it out, or give two groups."
                )

    def cut(self, sender: int, receiver: int, begin: float, end: float) -> bool:
        """Whether a partition divides sender and receiver at any time from `begin` to `end` (s) inclusive."""
        return any(
            partition.begin <= end and begin < partition.end and partition.divides(sender, receiver)
            for partition in self.partitions
        )

    def draw_losses(self, n: int, generator: torch.Generator) -> list[bool]:
        """Which of n receivers lose a datagram."""
        import torch  # options are shown without it

        if self.loss == 0:
            return [False] * n
        drawn = torch.rand(n, generator=generator, dtype=torch.float64) < self.loss
        return [bool(lost) for lost in drawn]

    def draw_delays(self, n: int, generator: torch.Generator) -> list[list[float]]:
        """For each of n receivers, the delays (s) of the one or two copies of a datagram."""
        import torch

        if self.jitter == self.duplication == 0:
            return [[self.latency]] * n
        first, second, chance = torch.rand(3, n, generator=generator, dtype=torch.float64).tolist()
        return [
            [self.latency - self.jitter * math.log1p(-u) for u in ((a, b) if c < self.duplication else (a,))]
            for a, b, c in zip(first, second, chance, strict=True)
        ]


_OPTIONAL = ("bandwidth", "reach")  # None: no limit
_LARGEST = dict.fromkeys(("latency", "jitter", *_OPTIONAL), math.inf)
_LARGEST |= {"loss": math.nextafter(1, 0), "duplication": 1.0}  # a network that loses all is none


def _partition(name: str, value: Any) -> Partition:
    """The checked partition of a user's mapping or triple."""
    if isinstance(value, Mapping) and set(value) == set(Partition._fields):
        fields = [value[field] for field in Partition._fields]
    else:
        fields = list(value) if _is_list(value) else []
    if (
        len(fields) != 3
        or not (_is_number(fields[0]) and _is_number(fields[1]))
        or not -math.inf < fields[0] < fields[1] < math.inf
        or not _are_groups(fields[2])
    ):
        raise InvalidArgumentError(
            f"{name}={value!r} must have begin and end, finite seconds, the first before the second, and "
            "groups, lists of robots that are each in one: {begin: 60, end: 120, groups: [[0], [1, 2]]}."
        )
    begin, end, groups = fields
    return Partition(
        float(begin), float(end), tuple(tuple(int(robot) for robot in group) for group in groups)
    )


def _are_groups(value: Any) -> bool:
    if not (_is_list(value) and value and all(_is_list(group) and group for group in value)):
        return False
    robots: list[Any] = [robot for group in value for robot in group]
    are_ids = all(_is_number(one) and isinstance(one, numbers.Integral) and int(one) >= 0 for one in robots)
    return are_ids and len(set(robots)) == len(robots)


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)
