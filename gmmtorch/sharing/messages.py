"""All that robots say during a mission: one `decode`, and an encoder for each kind of message.

A datagram stands alone, has at most 1200 bytes, and is checked before it is believed: see
docs/messages.md, which has the format byte by byte.
"""

from __future__ import annotations

from collections.abc import Callable

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.sharing import announce_messages, component_messages, point_messages, view_messages
from gmmtorch.sharing.announce_messages import (
    AnnouncementMessage,
    CorrectionMessage,
    SupersessionMessage,
    TotalsMessage,
)
from gmmtorch.sharing.component_messages import (
    ComponentsMessage,
    CountsMessage,
    encode_components,
    encode_counts,
)
from gmmtorch.sharing.envelope import CODECS, MAX_BYTES, Kind, opened
from gmmtorch.sharing.fields import quantized_poses
from gmmtorch.sharing.point_messages import PointsMessage, encode_points
from gmmtorch.sharing.view_messages import PlanMessage, ViewsMessage, encode_plan, encode_views

__all__ = [
    "CODECS",
    "MAX_BYTES",
    "AnnouncementMessage",
    "ComponentsMessage",
    "CorrectionMessage",
    "CountsMessage",
    "Message",
    "PlanMessage",
    "PointsMessage",
    "SupersessionMessage",
    "TotalsMessage",
    "ViewsMessage",
    "decode",
    "encode_components",
    "encode_counts",
    "encode_plan",
    "encode_points",
    "encode_views",
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
    | TotalsMessage
    | CorrectionMessage
)

_READERS: dict[Kind, Callable[[bytes], Message]] = {
    Kind.COMPONENTS: component_messages.read_quantized,
    Kind.FLOAT_COMPONENTS: component_messages.read_float,
    Kind.THESIS_COMPONENTS: component_messages.read_thesis,
    Kind.COUNTS: component_messages.read_quantized_counts,
    Kind.FLOAT_COUNTS: component_messages.read_float_counts,
    Kind.THESIS_COUNTS: component_messages.read_thesis_counts,
    Kind.POINTS: point_messages.read_points,
    Kind.VIEWS: view_messages.read_views,
    Kind.PLAN: view_messages.read_plan,
    Kind.ANNOUNCEMENT: announce_messages.read_announcement,
    Kind.SUPERSESSION: announce_messages.read_supersession,
    Kind.TOTALS: announce_messages.read_totals,
    Kind.CORRECTION: announce_messages.read_correction,
}


def decode(datagram: bytes) -> Message:
    """What a datagram says; tensors on the CPU.

    Raises `DataError` for anything that no encoder of this version wrote, whatever it may be, and takes
    memory in proportion to the datagram.
    """
    kind, body = opened(datagram)
    try:
        return _READERS[kind](body)
    except DataError:
        raise
    except GmmTorchError as error:
        raise DataError(f"The datagram is damaged: {error}") from error
