"""All messages of a mission: an encoder for each kind, and one `decode`.

A datagram can be read without any other, has at most 1200 bytes, and is checked completely.
docs/messages.md has the format byte by byte.
"""

from __future__ import annotations

from collections.abc import Callable

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.team.sharing.messages import (
    component_messages,
    count_messages,
    point_messages,
    record_messages,
    view_messages,
)
from gmmtorch.team.sharing.messages.component_messages import ComponentsMessage, encode_components
from gmmtorch.team.sharing.messages.count_messages import CountsMessage, encode_counts
from gmmtorch.team.sharing.messages.envelope import CODECS, MAX_BYTES, Kind, parse_datagram
from gmmtorch.team.sharing.messages.point_messages import PointsMessage, encode_points
from gmmtorch.team.sharing.messages.record_messages import (
    AnnouncementMessage,
    CalibrationMessage,
    CorrectionMessage,
    CountersMessage,
    FrameMessage,
    SupersessionMessage,
)
from gmmtorch.team.sharing.messages.view_messages import (
    PlanMessage,
    ViewsMessage,
    encode_plan,
    encode_views,
    quantized_poses,
)

__all__ = [
    "CODECS",
    "MAX_BYTES",
    "AnnouncementMessage",
    "CalibrationMessage",
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
    | CalibrationMessage
)

_KINDS: dict[Kind, tuple[str, Callable[[bytes], Message]]] = {
    Kind.COMPONENTS: ("components", component_messages.read_quantized),
    Kind.FLOAT_COMPONENTS: ("components", component_messages.read_float),
    Kind.THESIS_COMPONENTS: ("components", component_messages.read_thesis),
    Kind.COUNTS: ("counts", count_messages.read_quantized_counts),
    Kind.FLOAT_COUNTS: ("counts", count_messages.read_float_counts),
    Kind.THESIS_COUNTS: ("counts", count_messages.read_thesis_counts),
    Kind.POINTS: ("points", point_messages.read_points),
    Kind.VIEWS: ("views", view_messages.read_views),
    Kind.PLAN: ("plans", view_messages.read_plan),
    Kind.ANNOUNCEMENT: ("announcements", record_messages.read_announcement),
    Kind.SUPERSESSION: ("supersessions", record_messages.read_supersession),
    Kind.COUNTERS: ("counts", record_messages.read_counters),
    Kind.CORRECTION: ("corrections", record_messages.read_correction),
    Kind.FRAME: ("frames", record_messages.read_frame),
    Kind.CALIBRATION: ("calibrations", record_messages.read_calibration),
}
"""Name of the contents for statistics, and reader of the body."""


def kind_of(datagram: bytes) -> str:
    """The contents of a valid datagram, by a name for statistics."""
    return _KINDS[Kind(datagram[0] & 15)][0]


def decode(datagram: bytes) -> Message:
    """The message of a datagram, with tensors on the CPU.

    Raises `DataError`, and nothing else, for any bytes that no encoder of this version writes. `MAX_BYTES`
    bounds the memory.
    """
    kind, body = parse_datagram(datagram)
    try:
        return _KINDS[kind][1](body)
    except DataError:
        raise
    except (GmmTorchError, ValueError, ArithmeticError, LookupError, RuntimeError) as error:
        # Readers raise errors of gmmtorch. The others are a safeguard, so that no datagram stops a robot.
        raise DataError(f"The datagram is damaged: {error}") from error
