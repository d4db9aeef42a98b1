"""What a figure or an event file shows."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator


def texts(axes: Axes) -> str:
    """The texts of a panel, without those of its axes."""
    return "\n".join(text.get_text() for text in axes.texts)


def read(directory: Path) -> EventAccumulator:
    """All events of a folder."""
    events = EventAccumulator(str(directory), size_guidance={"scalars": 0, "images": 0, "tensors": 0})
    return events.Reload()
