"""Example messages of every kind."""

from __future__ import annotations

import zlib
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from mapping.random_components import painted, random_components

from gmmtorch.mapping import Components, spatial_order
from gmmtorch.occupancy.calibrator import Calibration, Calibrator
from gmmtorch.team.sharing import ViewsMessage, encode_plan
from gmmtorch.team.sharing.messages.component_messages import encode_components, encode_counts
from gmmtorch.team.sharing.messages.datagrams import CODECS, pose_of
from gmmtorch.team.sharing.messages.mission_messages import (
    encode_points,
    encode_views,
    quantized_values,
    quantized_views,
)
from gmmtorch.team.sharing.messages.record_messages import (
    CalibrationMessage,
    CorrectionMessage,
    FrameMessage,
    RecordMessage,
    SupersessionMessage,
    counters_message,
    encode_announcements,
    encode_record,
)
from gmmtorch.team.sharing.replica.record_keys import CHANNELS, Intervals, first_key

codecs = pytest.mark.parametrize("codec", CODECS)
numbers = st.integers(0, 300) | st.integers(0, (1 << 60) - 1)
places = st.sampled_from([0.0, -37.25, 5e5])


def sealed(data: bytes) -> bytes:
    """The data with a valid checksum."""
    return data + zlib.crc32(data).to_bytes(4, "little")


def forged(datagram: bytes, body: bytes) -> bytes:
    """A datagram of the same kind with another body and valid checksums."""
    return datagram[:1] + sealed(body) if datagram[0] == 0x11 else sealed(datagram[:1] + body)


def assert_same(one: object, other: object) -> None:
    for field in fields(one):  # type: ignore[arg-type]
        a, b = getattr(one, field.name), getattr(other, field.name)
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b, field.name


def frame_of_components(k: int, **options) -> Components:
    """Components of one frame: near one another, with one origin, numbered in spatial order."""
    made = random_components(
        3, k=k, extent=6.0, n_origins=1, max_sightings=1, deviations=(5e-3, 0.5), **options
    )
    return replace(made.rearranged(spatial_order(made)), ids=made.ids)


def views(n: int, n_removed: int = 0, seed: int = 0, center: float = 0.0) -> ViewsMessage:
    generator = torch.Generator().manual_seed(seed)
    poses = torch.rand(n, 4, generator=generator, dtype=torch.float64) * 40 - 20
    return ViewsMessage(
        ids=torch.stack([torch.arange(n) % 3, torch.arange(n) * 2], 1),
        poses=quantized_views(poses + center),
        values=quantized_values(torch.rand(n, generator=generator) * 200),
        stamps=torch.arange(n, dtype=torch.float64),
        removed=Intervals.of(first_key(7) + 2 * np.arange(n_removed)),
    )


def span(robot: int, begin: int, end: int) -> Intervals:
    """Keys of a robot."""
    return Intervals.span(first_key(robot) + begin, first_key(robot) + end)


def records() -> list[RecordMessage]:
    """One record of every kind except components and calibrations."""
    return [
        SupersessionMessage(first_key(2, 5), span(2, 0, 3) | span(2, 7, 8), span(2, 30, 32)),
        counters_message(first_key(1, 9), {1: 5.0, 2: 0.0, first_key(4) + 3: 800.0}),
        CorrectionMessage(first_key(2, 9), 3, 1, span(2, 4, 6), pose_of(torch.eye(4))),
        FrameMessage(first_key(2, 9) + 1, 2 << 24 | 9, 2, 1 << 24 | 5, pose_of(torch.eye(3))),
    ]


def channel_examples() -> list[bytes]:
    """Valid datagrams of components with channels, and of an announcement of channels."""
    components = painted(frame_of_components(9), 1)
    held = span(0, 0, 70).shifted(CHANNELS)
    return [*encode_components(components), *encode_announcements(1, 2, held, lowest=CHANNELS)]


def examples() -> list[bytes]:
    """A valid datagram of every kind, in the order of the kinds, with kind 0 last."""
    calibration = Calibrator.continued(Calibration.prior(12.0)._replace(n_predicted=900), 3).calibration
    components, counts = frame_of_components(9), {(0, 3): 5.0, (0, 4): 7.5, (2, 900): 0.0}
    ends = torch.arange(30, dtype=torch.float64).reshape(10, 3)
    made = [encode_components(components, codec) for codec in CODECS]
    made += [encode_counts(1, counts, codec) for codec in CODECS]
    made += [encode_points(1, 2, ends[0], ends, ends[:, 0] > 9), encode_views(views(6, 3))]
    made += [encode_plan(2, 5, 12.0, 0.2, views(11).poses, views(3).poses)]
    made += [encode_announcements(1, 2, span(0, 0, 70) | span(3, 5, 7) | span(3, 900, 901))]
    made += [[encode_record(record)] for record in records()]
    made += [[encode_record(CalibrationMessage(first_key(2, 9) + 4, calibration))]]
    assert all(len(datagrams) == 1 for datagrams in made)
    return [datagrams[0] for datagrams in made]
