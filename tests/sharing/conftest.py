"""Fixtures of the transports."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from gmmtorch.team.sharing.transport.zenoh_transport import ZenohTransport


@pytest.fixture
def opening() -> Iterator[Callable[..., ZenohTransport]]:
    """Opens Zenoh transports, which are closed after the test."""
    with ExitStack() as stack:
        yield lambda robot, *a, **options: stack.enter_context(ZenohTransport(robot, *a, **options))
