"""Progress bars on standard error."""

from __future__ import annotations

import sys
from typing import Any


class ProgressBars:
    """Shows events (stage, done, total) as progress bars on standard error.

    The first event of a stage opens a bar. The bar disappears when done reaches total, or when the context
    ends. A stage that starts again opens a new bar.

        with ProgressBars() as progress:
            progress("fit", 3, 10)

    Args:
        enabled: False ignores all events.
    """

    def __init__(self, enabled: bool = True) -> None:
        self.enabled = enabled
        self._bars: dict[str, Any] = {}

    def __call__(self, stage: str, done: int, total: int | None = None) -> None:
        """Shows that `done` of `total` steps of `stage` are done; total None means unknown."""
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
        """Shows text next to the bar of a stage, if that bar is open."""
        if stage in self._bars:
            self._bars[stage].set_postfix_str(text, refresh=False)  # shown with the next step

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages whose bars are open."""
        return tuple(self._bars)

    def close(self) -> None:
        """Closes every bar."""
        while self._bars:
            self._bars.popitem()[1].close()

    def __enter__(self) -> ProgressBars:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _open(stage: str, total: int | None) -> Any:
    from tqdm import tqdm

    return tqdm(desc=stage, total=total, file=sys.stderr, leave=False, dynamic_ncols=True)
