"""Frames and mappers for the tests of GmmMapper."""

from __future__ import annotations

import pytest
import torch
from exploration.mapped_room import BOX, PLACES, frame, mapper

from gmmtorch.exploration.robot.gmm_mapper import GmmMapper
from gmmtorch.mapping.components import Components
from gmmtorch.sharing.messages.message_registry import (
    ComponentsMessage,
    CountsMessage,
    decode,
)


def by_kind(datagrams: list[bytes]) -> tuple[list[bytes], list[bytes]]:
    """Datagrams of components, and all others."""
    are = [isinstance(decode(datagram), ComponentsMessage) for datagram in datagrams]
    parts = [
        [d for d, is_one in zip(datagrams, are, strict=True) if is_one == kind] for kind in (True, False)
    ]
    return parts[0], parts[1]


def rebuilt(one: GmmMapper) -> GmmMapper:
    """A new mapper with all components of another, cast at once."""
    other = mapper(9)
    if len(one.components()):
        other._enter(one.components())
    return other


def assert_same_components(one: Components, other: Components, exact: bool = True) -> None:
    for name in ("ids", "means", "covariances", "max_range", "seen_by"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name
    for name in ("support", "seen_count"):
        tolerance = {} if exact else {"rtol": 1e-12, "atol": 0.0}
        torch.testing.assert_close(getattr(one, name), getattr(other, name), **tolerance)
    assert torch.equal(one.origins[one.seen_from], other.origins[other.seen_from])


def assert_same_evidence(one: GmmMapper, other: GmmMapper) -> None:
    for a, b in zip(one.belief.grid.dense(BOX), other.belief.grid.dense(BOX), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-4)
    for a, b in zip(one.local.evidence(), other.local.evidence(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-4)
    assert other.belief.entropy_bits == pytest.approx(one.belief.entropy_bits, abs=0.1)
    assert other.belief.n_observed == one.belief.n_observed


def counts_in(components: list[bytes], counts: list[bytes]) -> dict[tuple[int, int], float]:
    """The points of each component, by id, summed over datagrams."""
    total: dict[tuple[int, int], float] = {}
    for data in components:
        message = decode(data)
        assert isinstance(message, ComponentsMessage)
        for key, support in zip(message.components.ids.tolist(), message.components.support, strict=True):
            assert tuple(key) not in total
            total[tuple(key)] = float(support)
    for data in counts:
        message = decode(data)
        assert isinstance(message, CountsMessage)
        for key, count in message.counts.items():
            total[key] += count
    return total


def first_batch() -> tuple[GmmMapper, list[bytes]]:
    one = mapper(codec="float")
    one.sense(frame(*PLACES[0]))
    return one, one.shared.datagrams()
