"""ZenohTransport: datagrams over Zenoh, across routers and networks; encrypted if the team has a key."""

from __future__ import annotations

import atexit
import re
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.sharing.transport.frames import MAX_WAITING, FramedTransport
from gmmtorch.sharing.transport.security import TeamKey
from gmmtorch.sharing.transport.simulated_network import Traffic
from gmmtorch.sharing.transport.zenoh_session import load_zenoh, open_session

SOON_REPEATED = frozenset({"announcements", "plans"})
"""Kinds of datagrams that the next one replaces. A lost one need not be repeated."""
_TEAM = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_QUEUED = 256  # samples between Zenoh's threads and this one; when it is full, Zenoh's links wait
_LONGEST_SOURCE = 100


class ZenohTransport(FramedTransport):
    """One robot's end of a Zenoh network; see `Transport`. Close it, or use it as a context manager.

    Robot i publishes at the key 'gmmtorch/<team>/<i>' and subscribes to 'gmmtorch/<team>/*'. Kinds in
    `SOON_REPEATED` are sent best-effort, all others reliably from hop to hop. On a congested link Zenoh drops
    both. All have one priority: a datagram that a thousand others overtake is refused as replayed.

    A network that is down is no error; Zenoh connects again. A thread reads frames, as in `UdpTransport`.
    `sent` counts a frame once, however many robots receive it.
    """

    def __init__(
        self,
        robot: int,
        team: str = "team",
        *,
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
        scouting: bool | None = None,
        config: str | Path | None = None,
        key: TeamKey | None = None,
        insecure: bool = False,
        max_waiting: int = MAX_WAITING,
    ) -> None:
        """Args:
        robot: id of this robot, 0 … 65535; unique in the team.
        team: name of the team in keys: 1 to 64 letters, digits, and _ . -.
        listen: endpoints where others may connect, such as 'tcp/0.0.0.0:7447'.
        connect: endpoints of other robots, or of routers; they may start later.
        scouting: whether to look for robots by multicast; None: as `config` says, else not.
        config: a file of Zenoh's own settings (TLS, access control, …); the arguments here override it.
        key: the team's. Without one all endpoints must be on loopback, unless `insecure`.
        max_waiting: largest number of datagrams in the queue.

        Raises as `open_session` does, and `GmmTorchError` if eclipse-zenoh is not installed.
        """
        if not isinstance(team, str) or _TEAM.fullmatch(team) is None:
            raise InvalidArgumentError(f"team={team!r} must be 1 to 64 letters, digits, '_', '.' or '-'.")
        super().__init__(robot, key, max_waiting)
        zenoh = load_zenoh()
        self._session = open_session(listen, connect, scouting, config, key is None and not insecure)
        self._error = zenoh.ZError
        try:
            self._declare(zenoh, team)
        except BaseException:
            self._session.close()
            raise
        self._thread = threading.Thread(target=self._listen, name=f"zenoh-{self.robot}", daemon=True)
        self._thread.start()
        atexit.register(self.close)  # Python cannot end a thread that is blocked in Zenoh

    @property
    def n_neighbours(self) -> int:
        """Robots and routers that are connected now; routers may have more behind them. 0 after `close`."""
        if self._closing.is_set():
            return 0
        info = self._session.info
        return len(info.peers_zid()) + len(info.routers_zid())

    # -- inside --------------------------------------------------------------------------------------------

    def _declare(self, zenoh: Any, team: str) -> None:
        """Declare the publishers and the subscriber."""
        own, team_keys = f"gmmtorch/{team}/{self.robot}", f"gmmtorch/{team}/*"
        try:
            self._best_effort, self._reliable = (
                self._session.declare_publisher(
                    own,
                    congestion_control=zenoh.CongestionControl.DROP,
                    reliability=reliability,
                    allowed_destination=zenoh.Locality.REMOTE,
                )
                for reliability in (zenoh.Reliability.BEST_EFFORT, zenoh.Reliability.RELIABLE)
            )
            self._subscriber = self._session.declare_subscriber(
                team_keys, zenoh.handlers.FifoChannel(_QUEUED), allowed_origin=zenoh.Locality.REMOTE
            )
        except zenoh.ZError as error:
            raise GmmTorchError(
                f"Zenoh does not let robot {self.robot} publish at {own} and subscribe to {team_keys}: "
                f"{error}. See what config allows."
            ) from error

    def _carry(self, frame: bytes, kind: str) -> Traffic:
        publisher = self._best_effort if kind in SOON_REPEATED else self._reliable
        try:
            publisher.put(frame)
        except self._error as error:
            self._count_failure("ZError", str(error), "to Zenoh")
            return Traffic()
        return Traffic(1, len(frame))

    def _shut(self) -> None:
        atexit.unregister(self.close)
        self._session.close()
        self._thread.join()

    def _listen(self) -> None:
        """Read frames until the session is closed."""
        for sample in self._subscriber:
            self._take(sample.payload.to_bytes(), ascii(str(sample.key_expr))[:_LONGEST_SOURCE])
