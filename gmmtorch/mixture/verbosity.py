"""Progress of a fit on standard output, as scikit-learn's `verbose` prints it."""

from __future__ import annotations

import math
import time
from typing import Any

from gmmtorch.mixture.em.loop import EMResult, OnIteration


class Report:
    """Receives the bounds of one start, prints every `interval`-th iteration, and passes all bounds on.

    verbose: 0 prints nothing, 1 the iterations, 2 also the seconds and the change of the bound.
    """

    def __init__(self, start: int, verbose: int, interval: int, on_iteration: OnIteration | None) -> None:
        self._verbose, self._interval, self._pass_on = verbose, interval, on_iteration
        self._bound = -math.inf
        self._begin = self._last = time.monotonic()
        if verbose:
            print(f"Initialization {start}")

    def __call__(self, iteration: int, bound: float) -> None:
        change, self._bound = bound - self._bound, bound
        if self._verbose and iteration % self._interval == 0:
            now = time.monotonic()
            seconds, self._last = now - self._last, now
            details = f"\t time lapse {seconds:.5f}s\t ll change {change:.5f}" if self._verbose > 1 else ""
            print(f"  Iteration {iteration}{details}")
        if self._pass_on is not None:
            self._pass_on(iteration, bound)

    def end(self, found: EMResult[Any]) -> None:
        """Prints whether the start converged."""
        if not self._verbose:
            return
        seconds = time.monotonic() - self._begin
        details = (
            f" time lapse {seconds:.5f}s\t lower bound {found.lower_bound:.5f}." if self._verbose > 1 else ""
        )
        print(f"Initialization {'converged' if found.converged else 'did not converge'}.{details}")
