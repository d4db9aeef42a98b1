"""LossyTransport: a real network made worse, to try what a team makes of it."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.sharing.network import Transport


class LossyTransport:
    """Another transport, of whose datagrams a share never arrives.

    Args:
        transport: what carries them.
        loss: share of those that come which are lost, [0, 1).
        seed: of what is drawn.
    """

    def __init__(self, transport: Transport, loss: float, seed: int = 0) -> None:
        if not 0 <= loss < 1:
            raise InvalidArgumentError(f"loss={loss} must be a share of the datagrams in [0, 1).")
        self._transport, self._loss = transport, loss
        self._generator = torch.Generator().manual_seed(seed)
        self.n_lost = 0
        """Datagrams that came, and were lost."""

    def send(self, sender: int, datagrams: Sequence[bytes], now: float, kind: str) -> None:
        """See `Transport`."""
        self._transport.send(sender, datagrams, now, kind)

    def deliver(self, robot: int, now: float) -> list[tuple[int, bytes]]:
        """See `Transport`."""
        come = self._transport.deliver(robot, now)
        if not come or self._loss == 0:
            return come
        kept = (torch.rand(len(come), generator=self._generator) >= self._loss).tolist()
        self.n_lost += len(come) - sum(kept)
        return [item for item, is_kept in zip(come, kept, strict=True) if is_kept]
