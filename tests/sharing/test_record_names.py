"""keys_in: what a datagram holds, without what it says of it, against the decoder."""

from __future__ import annotations

import random

import pytest
import torch
from mapping.random_components import random_components
from sharing.message_examples import examples
from sharing.schedules import act

from gmmtorch.errors import DataError
from gmmtorch.sharing.messages.message_registry import ComponentsMessage, decode, encode_components
from gmmtorch.sharing.replica.intervals import Intervals
from gmmtorch.sharing.replica.record_keys import RECORD_KINDS, keys_in, keys_of
from gmmtorch.sharing.replica.replica import Replica


def decoded_names(datagram: bytes) -> Intervals:
    message = decode(datagram)
    if isinstance(message, ComponentsMessage):
        return Intervals.of(keys_of(message.components.ids))
    return Intervals.span(message.key, message.key + 1)


def test_names_are_those_that_the_decoder_finds():
    rng, replica = random.Random(3), Replica(5)
    datagrams: list[bytes] = []
    for _ in range(40):
        act(rng, replica)
        datagrams += replica.datagrams()
    for dim in (2, 3):
        for k in (1, 2, 150):
            made = random_components(dim, k=k, robot=1023)
            made.ids[:, 1] = torch.randperm(1 << 20)[:k] << 32
            datagrams += encode_components(made)
    assert {datagram[0] & 15 for datagram in datagrams} == RECORD_KINDS
    for datagram in datagrams:
        assert keys_in(datagram) == decoded_names(datagram)


def test_what_is_no_record_is_refused():
    components = encode_components(random_components(3, k=20))[0]
    others = [datagram for datagram in examples() if datagram[0] & 15 not in RECORD_KINDS]
    assert len(others) >= 8
    for datagram in [b"", b"\x11", components[:9], b"\x1b" + components[1:], *others]:
        with pytest.raises(DataError):
            keys_in(datagram)
