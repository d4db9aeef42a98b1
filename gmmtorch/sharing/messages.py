"""All that robots say during a mission: one `decode`, and an encoder for each kind of message.

A datagram stands alone, has at most 1200 bytes, and is checked before it is believed: see
docs/messages.md, which has the format byte by byte.
"""

from __future__ import annotations

from collections.abc import Callable

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.sharing import (
    announce_messages,
    component_messages,
    point_messages,
    view_announcements,
    view_messages,
)
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
from gmmtorch.sharing.view_announcements import ViewsHeldMessage
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
    "ViewsHeldMessage",
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
    | TotalsMessage
    | CorrectionMessage
    | ViewsHeldMessage
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
    Kind.VIEWS_HELD: view_announcements.read_views_held,
}


_NAMES: dict[Kind, str] = {
    Kind.COMPONENTS: "components",
    Kind.FLOAT_COMPONENTS: "components",
    Kind.THESIS_COMPONENTS: "components",
    Kind.COUNTS: "counts",
    Kind.FLOAT_COUNTS: "counts",
    Kind.THESIS_COUNTS: "counts",
    Kind.TOTALS: "counts",
    Kind.POINTS: "points",
    Kind.VIEWS: "views",
    Kind.PLAN: "plans",
    Kind.ANNOUNCEMENT: "announcements",
    Kind.VIEWS_HELD: "announcements",
    Kind.SUPERSESSION: "supersessions",
    Kind.CORRECTION: "corrections",
}


def kind_of(datagram: bytes) -> str:
    """What a datagram is of, for the books: of one that `decode` can read."""
    return _NAMES[Kind(datagram[0] & 15)]


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
