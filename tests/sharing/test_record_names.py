"""keys_in: the keys of a datagram without decoding its content, against the decoder."""

from __future__ import annotations

import random

import pytest
import torch
from mapping.random_components import random_components
from sharing.message_examples import examples
from sharing.schedules import act

from gmmtorch.errors import DataError
from gmmtorch.sharing.messages.message_registry import ComponentsMessage, decode, encode_components
from gmmtorch.sharing.replica.record_keys import RECORD_KINDS, Intervals, keys_in, keys_of
from gmmtorch.sharing.replica.replica import Replica


def decoded_keys(datagram: bytes) -> Intervals:
    message = decode(datagram)
    if isinstance(message, ComponentsMessage):
        return Intervals.of(keys_of(message.components.ids))
    return Intervals.span(message.key, message.key + 1)


def test_keys_in_datagrams_equal_the_decoded_keys():
    rng, replica = random.Random(3), Replica(5)
    datagrams: list[bytes] = []
    for _ in range(25):
        act(rng, replica)
        datagrams += replica.datagrams()
    for dim in (2, 3):
        for k in (1, 2, 150):
            made = random_components(dim, k=k, robot=1023)
            made.ids[:, 1] = torch.randperm(1 << 20)[:k] << 32
            datagrams += encode_components(made)
    datagrams += Replica(6, own_frame=True).datagrams()
    assert {datagram[0] & 15 for datagram in datagrams} == RECORD_KINDS
    for datagram in datagrams:
        assert keys_in(datagram) == decoded_keys(datagram)


def test_datagrams_without_records_are_refused():
    components = encode_components(random_components(3, k=20))[0]
    others = [datagram for datagram in examples() if datagram[0] & 15 not in RECORD_KINDS]
    assert len(others) >= 8
    for datagram in [b"", b"\x11", components[:9], b"\x1b" + components[1:], *others]:
        with pytest.raises(DataError):
            keys_in(datagram)
