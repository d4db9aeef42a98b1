"""Progress bars of whatever reports what it is doing."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any


class ProgressBars:
    """Turns events (stage, done, total) into progress bars on standard error.

    A bar opens at the first event of a stage and closes, leaving no trace, when done reaches total;
    what is still open closes with the context. A stage that begins again opens a bar again.

        with ProgressBars() as progress:
            progress("fit", 3, 10)

    Args:
        enabled: False ignores all events.
    """

    def __init__(self, enabled: bool = True) -> None:
        self.enabled = enabled
        self._bars: dict[str, Any] = {}

    def __call__(self, stage: str, done: int, total: int | None = None) -> None:
        """`done` of `total` (None: how many there will be is not known) steps of `stage` are done."""
        if not self.enabled:
            return
        bar = self._bars.get(stage)
        if bar is None:
            bar = self._bars[stage] = _open(stage, total)
        elif done < bar.n:
            bar.reset(total)
        bar.total = total
        bar.update(done - bar.n)
        if total is not None and done >= total:
            self._bars.pop(stage).close()

    def note(self, stage: str, text: str) -> None:
        """Text beside the bar of a stage that is open."""
        if stage in self._bars:
            self._bars[stage].set_postfix_str(text)

    @property
    def stages(self) -> tuple[str, ...]:
        """Stages whose bars are open."""
        return tuple(self._bars)

    def close(self) -> None:
        """Close every bar."""
        while self._bars:
            self._bars.popitem()[1].close()

    def __enter__(self) -> ProgressBars:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def _open(stage: str, total: int | None) -> Any:
    from tqdm import tqdm

    return tqdm(desc=stage, total=total, file=sys.stderr, leave=False, dynamic_ncols=True)
