"""ZenohTransport: datagrams over Zenoh, across routers and networks; encrypted if the team has a key."""

from __future__ import annotations

import atexit
import ipaddress
import json
import re
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, MissingDataError
from gmmtorch.optional_packages import needs_extra
from gmmtorch.team.sharing.transport.frames import MAX_WAITING, FramedTransport
from gmmtorch.team.sharing.transport.security import TeamKey
from gmmtorch.team.sharing.transport.simulated_network import Traffic

if TYPE_CHECKING:
    import zenoh


_IP_PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws")
_ADDRESS = re.compile(r"(?:\[([0-9a-fA-F:.]+)\]|([^\s:\[\]]+)):([0-9]{1,5})")
_LARGEST_MESSAGE = 1 << 16
"""Bytes that Zenoh assembles from parts. Its default would accept a gigabyte from any stranger."""
_KEY_REMEDY = "give one; in Python, insecure=True lets anyone read and write."
_REMEDIES = {
    "in use": "another process has that port. Stop it (`ss -tulpn` shows it), or give another port.",
    "assign requested": "this machine has no such address, or not yet. `ip address` lists those it has; "
    "0.0.0.0 is all of them, later ones included.",
    "denied": "ports below 1024 are for the system. Give one above.",
}


def load_zenoh() -> Any:
    """The package zenoh; raises `GmmTorchError` if it is not installed."""
    with needs_extra("transport=zenoh needs", "eclipse-zenoh", "zenoh"):
        import zenoh
    return zenoh


def open_session(
    listen: Sequence[str],
    connect: Sequence[str],
    scouting: bool | None,
    config: str | Path | None,
    is_local: bool,
) -> zenoh.Session:
    """A session of Zenoh. While it is open, it keeps trying to connect to endpoints that are not reached.

    listen, connect: endpoints; empty: those of `config`. is_local: use only the given ones, which must be on
    loopback. The others are those of `ZenohTransport`.

    Raises `InvalidArgumentError` for endpoints that are invalid or cannot be listened on, `MissingDataError`
    if `config` does not exist, and `DataError` if it is no configuration.
    """
    if is_local and (scouting or config is not None):
        given = "scouting=True" if scouting else f"‹config›={str(config)!r}"
        raise InvalidArgumentError(
            f"{given} may reach other machines, and there is no key (‹key›=None): {_KEY_REMEDY}"
        )
    if not (listen or connect or scouting or config is not None):
        raise InvalidArgumentError(
            "No robot is reached with ‹listen›=[], ‹connect›=[], scouting=None, ‹config›=None: give one of "
            "them."
        )
    settings = _settings(
        _checked("listen", listen, 0, is_local), _checked("connect", connect, 1, is_local), scouting, config
    )
    if is_local:
        settings["scouting/gossip/enabled"] = False  # neighbours may know robots on other machines
    zenoh = load_zenoh()
    whole = zenoh.Config() if config is None else _read(zenoh, Path(config))
    try:
        for name, value in settings.items():
            whole.insert_json5(name, json.dumps(value))
        return zenoh.open(whole)
    except zenoh.ZError as error:
        cause = _cause(error)
        remedies = (remedy for sign, remedy in _REMEDIES.items() if sign in cause)
        raise InvalidArgumentError(
            f"listen={list(listen)}, ‹connect›={list(connect)}, ‹config›={str(config)!r} cannot be used by "
            f"Zenoh ({cause}): {next(remedies, 'see the documentation of Zenoh.')}"
        ) from error


def _settings(
    listen: list[str], connect: list[str], scouting: bool | None, config: str | Path | None
) -> dict[str, Any]:
    """Settings of Zenoh, by name, that override those of the file."""
    settings: dict[str, Any] = {
        "connect/exit_on_failure": False,
        "transport/link/rx/max_message_size": _LARGEST_MESSAGE,
        "transport/shared_memory/enabled": False,  # saves little with datagrams, and opens one more way in
    }
    if listen or (config is None and not scouting):  # else Zenoh listens everywhere
        settings["listen/endpoints"] = listen
    if connect:
        settings["connect/endpoints"] = connect
    if config is None or scouting is not None:
        settings["scouting/multicast/enabled"] = bool(scouting)
    return settings


def _read(zenoh: Any, path: Path) -> zenoh.Config:
    if not path.is_file():
        raise MissingDataError(f"config={str(path)!r} is no file; give a configuration of Zenoh, or None.")
    try:
        config = zenoh.Config.from_file(path)
        mode = json.loads(config.get_json("mode"))
    except (zenoh.ZError, ValueError) as error:
        raise DataError(f"config={str(path)!r} is no configuration of Zenoh: {_cause(error)}.") from error
    if mode == "client":
        raise DataError(
            f"config={str(path)!r} has mode 'client', which gives up if the router is absent at the start. "
            "Use mode: 'router', which waits for it, and relays other robots' datagrams."
        )
    return config


def _checked(name: str, endpoints: Sequence[str], least_port: int, is_local: bool) -> list[str]:
    """The endpoints, checked: Zenoh itself would try for ever to connect to an invalid one."""
    if isinstance(endpoints, str):
        raise InvalidArgumentError(f"{name}={endpoints!r} must be a list of endpoints: [{endpoints!r}].")
    for endpoint in endpoints:
        host = _host(name, endpoint, least_port)
        if is_local and not _is_loopback(host):
            raise InvalidArgumentError(
                f"{name}={endpoint!r} reaches other machines, and there is no key (‹key›=None): "
                f"take 127.0.0.1, {_KEY_REMEDY}"
            )
    return list(endpoints)


def _host(name: str, endpoint: str, least_port: int) -> str:
    """The host of an endpoint 'protocol/host:port?metadata#config'; '' if the protocol is not one of IP."""
    protocol, _, rest = endpoint.partition("/") if isinstance(endpoint, str) else ("", "", "")
    if protocol and rest and protocol not in _IP_PROTOCOLS:
        return ""
    found = _ADDRESS.fullmatch(re.split("[?#]", rest, maxsplit=1)[0])
    if found is None or not least_port <= int(found[3]) <= 65535:
        raise InvalidArgumentError(
            f"{name}={endpoint!r} must be an endpoint: a protocol ({', '.join(_IP_PROTOCOLS)}), a host, and "
            f"a port {least_port} … 65535, such as 'tcp/10.0.0.3:7447'."
        )
    return found[1] or found[2]


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _cause(error: Exception) -> str:
    """Zenoh's message in one line, without places in its source code."""
    return " ".join(re.sub(r" at /\S+", "", str(error)).split()).rstrip(" .")[:300]


SOON_REPEATED = frozenset({"announcements", "plans"})
"""Kinds of datagrams that the next one replaces. A lost one need not be repeated."""
_TEAM = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_QUEUED = 256  # samples between Zenoh's threads and this one; when it is full, Zenoh's links wait
_LONGEST_SOURCE = 100


class ZenohTransport(FramedTransport):
    """One robot's end of a Zenoh network; see `FramedTransport`.

    Robot i publishes at the key 'gmmtorch/<team>/<i>' and subscribes to 'gmmtorch/<team>/*'. Kinds in
    `SOON_REPEATED` are sent best-effort, all others reliably from hop to hop. On a congested link Zenoh drops
    both. All have one priority: a datagram that a thousand others overtake is refused as replayed. If the
    network is down, Zenoh connects again. `sent` counts a frame once, however many robots receive it.
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
