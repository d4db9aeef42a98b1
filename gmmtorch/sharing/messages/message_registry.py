"""All messages of a mission: an encoder for each kind, and one `decode`.

A datagram can be read without any other, has at most 1200 bytes, and is checked completely.
docs/messages.md has the format byte by byte.
"""

from __future__ import annotations

from collections.abc import Callable

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.sharing.messages import (
    component_messages,
    count_messages,
    point_messages,
    record_messages,
    view_messages,
)
from gmmtorch.sharing.messages.component_messages import ComponentsMessage, encode_components
from gmmtorch.sharing.messages.count_messages import CountsMessage, encode_counts
from gmmtorch.sharing.messages.envelope import CODECS, MAX_BYTES, Kind, parse_datagram
from gmmtorch.sharing.messages.fields import quantized_poses
from gmmtorch.sharing.messages.point_messages import PointsMessage, encode_points
from gmmtorch.sharing.messages.record_messages import (
    AnnouncementMessage,
    CorrectionMessage,
    CountersMessage,
    FrameMessage,
    SupersessionMessage,
)
from gmmtorch.sharing.messages.view_messages import PlanMessage, ViewsMessage, encode_plan, encode_views

__all__ = [
    "CODECS",
    "MAX_BYTES",
    "AnnouncementMessage",
    "ComponentsMessage",
    "CorrectionMessage",
    "CountersMessage",
    "CountsMessage",
    "FrameMessage",
    "Message",
    "PlanMessage",
    "PointsMessage",
    "SupersessionMessage",
    "ViewsMessage",
    "decode",
    "encode_components",
    "encode_counts",
    "encode_plan",
    "encode_points",
    "encode_views",
    "kind_of",
    "quantized_poses",
]

Message = (
    ComponentsMessage
    | CountsMessage
    | PointsMessage
    | ViewsMessage
    | PlanMessage
    | AnnouncementMessage
    | SupersessionMessage
    | CountersMessage
    | CorrectionMessage
    | FrameMessage
)

_READERS: dict[Kind, Callable[[bytes], Message]] = {
    Kind.COMPONENTS: component_messages.read_quantized,
    Kind.FLOAT_COMPONENTS: component_messages.read_float,
    Kind.THESIS_COMPONENTS: component_messages.read_thesis,
    Kind.COUNTS: count_messages.read_quantized_counts,
    Kind.FLOAT_COUNTS: count_messages.read_float_counts,
    Kind.THESIS_COUNTS: count_messages.read_thesis_counts,
    Kind.POINTS: point_messages.read_points,
    Kind.VIEWS: view_messages.read_views,
    Kind.PLAN: view_messages.read_plan,
    Kind.ANNOUNCEMENT: record_messages.read_announcement,
    Kind.SUPERSESSION: record_messages.read_supersession,
    Kind.COUNTERS: record_messages.read_counters,
    Kind.CORRECTION: record_messages.read_correction,
    Kind.FRAME: record_messages.read_frame,
}


_NAMES: dict[Kind, str] = {
    Kind.COMPONENTS: "components",
    Kind.FLOAT_COMPONENTS: "components",
    Kind.THESIS_COMPONENTS: "components",
    Kind.COUNTS: "counts",
    Kind.FLOAT_COUNTS: "counts",
    Kind.THESIS_COUNTS: "counts",
    Kind.COUNTERS: "counts",
    Kind.POINTS: "points",
    Kind.VIEWS: "views",
    Kind.PLAN: "plans",
    Kind.ANNOUNCEMENT: "announcements",
    Kind.SUPERSESSION: "supersessions",
    Kind.CORRECTION: "corrections",
    Kind.FRAME: "frames",
}


def kind_of(datagram: bytes) -> str:
    """The contents of a valid datagram, by a name for statistics."""
    return _NAMES[Kind(datagram[0] & 15)]


def decode(datagram: bytes) -> Message:
    """The message of a datagram, with tensors on the CPU.

    Raises `DataError`, and nothing else, for any bytes that no encoder of this version writes. `MAX_BYTES`
    bounds the memory.
    """
    kind, body = parse_datagram(datagram)
    try:
        return _READERS[kind](body)
    except DataError:
        raise
    except (GmmTorchError, ValueError, ArithmeticError, LookupError, RuntimeError) as error:
        # Readers raise errors of gmmtorch. The others are a safeguard, so that no datagram stops a robot.
        raise DataError(f"The datagram is damaged: {error}") from error
