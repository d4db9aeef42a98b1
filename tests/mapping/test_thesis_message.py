"""Thesis messages: size, bytes by hand, and damaged messages."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from mapping.random_components import random_components

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping import decode_thesis, decode_thesis_updates, encode_thesis, encode_thesis_updates

dims = pytest.mark.parametrize("dim", [2, 3])


@pytest.mark.parametrize(("dim", "size"), [(2, 37), (3, 57)])
def test_a_thesis_message_has_the_size_of_the_thesis(dim, size):
    components = random_components(dim)
    assert len(encode_thesis(components)) == size * len(components.seen_by)
    assert len(encode_thesis_updates(components.ids, components.support)) == 8 * len(components)


def test_a_thesis_message_equals_bytes_by_hand():
    components = random_components(3, k=1, max_sightings=1, robot=2)
    components = replace(components, ids=torch.tensor([[2, 5]]), max_range=torch.tensor([True]))
    number, count, *floats = struct.unpack("<If12fB", encode_thesis(components))
    upper = components.covariances[0][np.triu_indices(3)]
    assert number == 2 * 2**24 + 5
    assert count == pytest.approx(float(components.support))
    expected = [*components.origins[components.seen_from[0]], *components.means[0], *upper, 1]
    assert floats == pytest.approx([float(x) for x in expected])


@dims
def test_decoded_thesis_components_equal_the_sent_ones(dim):
    components = random_components(dim)
    found = decode_thesis(encode_thesis(components), dim)
    for name in ("means", "covariances", "support", "seen_count"):
        torch.testing.assert_close(getattr(found, name), getattr(components, name), rtol=1e-5, atol=1e-5)
    assert torch.equal(found.ids, components.ids)
    assert torch.equal(found.max_range, components.max_range)
    assert torch.equal(found.seen_by, components.seen_by)
    torch.testing.assert_close(
        found.origins[found.seen_from], components.origins[components.seen_from], rtol=0, atol=1e-5
    )


def test_support_updates_are_decoded():
    ids = torch.tensor([[0, 1], [255, 2**24 - 1]])
    found, counts = decode_thesis_updates(encode_thesis_updates(ids, torch.tensor([1.5, 7.0])))
    assert torch.equal(found, ids)
    assert counts.tolist() == [1.5, 7.0]


@dims
def test_zero_components_are_an_empty_message(dim):
    components = random_components(dim, k=0)
    assert encode_thesis(components) == b""
    assert len(decode_thesis(b"", dim)) == 0


@pytest.mark.parametrize("ids", [[256, 0], [0, 2**24], [-1, 0], [0, -1]])
def test_ids_outside_the_field_width_are_refused(ids):
    components = replace(random_components(2, k=1), ids=torch.tensor([ids]))
    with pytest.raises(InvalidArgumentError, match=r"id \["):
        encode_thesis(components)


def test_positions_that_float32_rounds_too_much_are_refused():
    with pytest.raises(InvalidArgumentError, match="millimetre"):
        encode_thesis(random_components(3, center=5e5))


def test_damaged_messages_are_refused():
    data = encode_thesis(random_components(3, k=4))
    with pytest.raises(DataError, match="whole messages"):
        decode_thesis(data[:-1], 3)
    with pytest.raises(DataError, match="damaged"):
        decode_thesis(b"\xff" * 57, 3)
    with pytest.raises(DataError, match="damaged"):
        decode_thesis_updates(struct.pack("<If", 1, -1.0))
