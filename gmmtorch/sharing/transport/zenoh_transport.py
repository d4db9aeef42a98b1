"""Datagrams over Zenoh: among machines, across routers and networks; sealed, where the team has a key."""

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
"""Kinds of datagrams whose next one says it all again: not worth a repetition."""
_TEAM = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_QUEUED = 256  # samples between Zenoh's threads and ours; when it is full, Zenoh's links wait
_LONGEST_SOURCE = 100


class ZenohTransport(FramedTransport):
    """One robot's end of a network of Zenoh; see `Transport`. To be closed, or used as a context manager.

    Robot i publishes at the key 'gmmtorch/<team>/<i>' and subscribes to 'gmmtorch/<team>/*'. What is lost
    on a link is Zenoh's affair: kinds in `SOON_REPEATED` are sent best-effort, all others reliably, from hop
    to hop. Where a link is congested, Zenoh drops what it has no room for, of either. All have one priority:
    those overtaken by a thousand others would be refused as replays.

    A network that is down is no error, and tried again. A thread takes in what comes, as in `UdpTransport`.
    `sent` counts a frame once, however many hear it.
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
        robot: this robot's number, 0 … 65535, which no other has.
        team: its name in keys: 1 to 64 letters, digits, and _ . -.
        listen: endpoints where others may connect, such as 'tcp/0.0.0.0:7447'.
        connect: endpoints of other robots, or of routers, which need not be there yet.
        scouting: whether robots are looked for by multicast; None: as `config` says, else not.
        config: a file of Zenoh's own settings (TLS, access control, …); what is given here goes above it.
        key: the team's. Without one all endpoints must be on loopback, unless `insecure`.
        max_waiting: how many datagrams may wait to be delivered.

        Raises as `open_session` does, and `GmmTorchError` where eclipse-zenoh is not installed.
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
        atexit.register(self.close)  # Python cannot end a thread that waits inside Zenoh

    @property
    def n_neighbours(self) -> int:
        """Robots and routers that it is connected to now; behind routers there may be more. 0 once closed."""
        if self._closing.is_set():
            return 0
        info = self._session.info
        return len(info.peers_zid()) + len(info.routers_zid())

    # -- inside --------------------------------------------------------------------------------------------

    def _declare(self, zenoh: Any, team: str) -> None:
        """Where it publishes, and what it subscribes to."""
        own, all_of_team = f"gmmtorch/{team}/{self.robot}", f"gmmtorch/{team}/*"
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
                all_of_team, zenoh.handlers.FifoChannel(_QUEUED), allowed_origin=zenoh.Locality.REMOTE
            )
        except zenoh.ZError as error:
            raise GmmTorchError(
                f"Zenoh does not let robot {self.robot} publish at {own} and subscribe to {all_of_team}: "
                f"{error}. See what config allows."
            ) from error

    def _carry(self, frame: bytes, kind: str) -> Traffic:
        publisher = self._best_effort if kind in SOON_REPEATED else self._reliable
        try:
            publisher.put(frame)
        except self._error as error:
            self._fails("ZError", str(error), "to Zenoh")
            return Traffic()
        return Traffic(1, len(frame))

    def _shut(self) -> None:
        atexit.unregister(self.close)
        self._session.close()
        self._thread.join()

    def _listen(self) -> None:
        """Until the session is closed: take in what comes."""
        for sample in self._subscriber:
            self._take(sample.payload.to_bytes(), ascii(str(sample.key_expr))[:_LONGEST_SOURCE])
