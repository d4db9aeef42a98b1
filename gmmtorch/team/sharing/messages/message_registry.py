"""All messages of a mission, and one `decode`.

A datagram can be read without any other, has at most 1200 bytes, and is checked completely.
docs/messages.md has the format byte by byte.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.team.sharing.messages import component_messages, mission_messages, record_messages
from gmmtorch.team.sharing.messages.component_messages import ComponentsMessage, CountsMessage
from gmmtorch.team.sharing.messages.datagrams import Kind, parse_datagram
from gmmtorch.team.sharing.messages.mission_messages import PlanMessage, PointsMessage, ViewsMessage
from gmmtorch.team.sharing.messages.record_messages import AnnouncementMessage, RecordMessage, read_record

Message = (
    ComponentsMessage
    | CountsMessage
    | PointsMessage
    | ViewsMessage
    | PlanMessage
    | AnnouncementMessage
    | RecordMessage
)

_KINDS: dict[Kind, tuple[str, Callable[[bytes], Message]]] = {
    Kind.COMPONENTS: ("components", component_messages.read_quantized),
    Kind.FLOAT_COMPONENTS: ("components", component_messages.read_float),
    Kind.THESIS_COMPONENTS: ("components", component_messages.read_thesis),
    Kind.COUNTS: ("counts", component_messages.read_quantized_counts),
    Kind.FLOAT_COUNTS: ("counts", component_messages.read_float_counts),
    Kind.THESIS_COUNTS: ("counts", component_messages.read_thesis_counts),
    Kind.POINTS: ("points", mission_messages.read_points),
    Kind.VIEWS: ("views", mission_messages.read_views),
    Kind.PLAN: ("plans", mission_messages.read_plan),
    Kind.ANNOUNCEMENT: ("announcements", record_messages.read_announcement),
    Kind.SUPERSESSION: ("supersessions", partial(read_record, Kind.SUPERSESSION)),
    Kind.COUNTERS: ("counts", partial(read_record, Kind.COUNTERS)),
    Kind.CORRECTION: ("corrections", partial(read_record, Kind.CORRECTION)),
    Kind.FRAME: ("frames", partial(read_record, Kind.FRAME)),
    Kind.CALIBRATION: ("calibrations", partial(read_record, Kind.CALIBRATION)),
}
"""Name of the contents for statistics, and reader of the body."""


def kind_of(datagram: bytes) -> str:
    """The contents of a valid datagram, by a name for statistics."""
    return _KINDS[Kind(datagram[0] & 15)][0]


def decode(datagram: bytes) -> Message:
    """The message of a datagram, with tensors on the CPU. Raises `DataError`, and nothing else, for any bytes
    that no encoder of this version writes. `MAX_BYTES` bounds the memory."""
    kind, body = parse_datagram(datagram)
    try:
        return _KINDS[kind][1](body)
    except DataError:
        raise
    except (GmmTorchError, ValueError, ArithmeticError, LookupError, RuntimeError) as error:
        # Readers raise errors of gmmtorch. The others are a safeguard, so that no datagram stops a robot.
        raise DataError(f"The datagram is damaged: {error}") from error
