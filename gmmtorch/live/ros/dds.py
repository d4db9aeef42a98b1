"""DdsMiddleware: ROS 2 topics over DDS (RTPS), the protocol of rmw_fastrtps and rmw_cyclonedds."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Sequence
from typing import Any
from xml.sax.saxutils import quoteattr

from gmmtorch.datasets import ARRAY, BASE, NAME
from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.live.ros.topics import Endpoint, MessageTypes, Quality, dds_type, ros_type
from gmmtorch.optional_packages import needs_extra

LOOPBACK = "127.0.0.1"
MAX_DOMAIN = 232
_NO_WHEELS = (
    " On Linux for ARM (aarch64) and for Python 3.14 this does not install cyclonedds, which has no wheels "
    "there: choose middleware=zenoh, or build cyclonedds from its source."
)
_PARTICIPANTS = 60  # processes with a node on one machine, at most
_TOPIC_PREFIX = "rt"
_MOST_SAMPLES = 1000
_BLOCKED = 100_000_000  # ns that a reliable publisher waits for slow subscribers

_DOMAINS: weakref.WeakValueDictionary[int, Any] = weakref.WeakValueDictionary()
"""Open domains. Cyclone DDS has one of each number in a process; its nodes share it."""
_LOCK = threading.Lock()


class DdsMiddleware:
    """One participant of a DDS domain, 0 … 232, with Cyclone DDS.

    interface: name or address of the network interface; 127.0.0.1: only this machine, without multicast.
    peers: addresses of machines that are contacted besides this one.

    Callbacks run in its threads. `ZenohMiddleware` has the same methods.

    Raises `InvalidArgumentError` if the domain or interface cannot be used, and `GmmTorchError` if cyclonedds
    is not installed.
    """

    def __init__(
        self, types: MessageTypes, domain: int, interface: str = LOOPBACK, peers: Sequence[str] = ()
    ) -> None:
        with needs_extra("middleware=dds needs", "cyclonedds", "ros", note=_NO_WHEELS):
            from cyclonedds.builtin import (
                BuiltinDataReader,
                BuiltinTopicDcpsPublication,
                BuiltinTopicDcpsSubscription,
            )
            from cyclonedds.core import DDSException
            from cyclonedds.domain import DomainParticipant
        self._error = DDSException
        self._idl = IdlTypes(types.definitions)
        self._topics: dict[tuple[str, str], Any] = {}
        self._entities: list[Any] = []
        try:
            self._domain = _open_domain(domain, _settings(interface, peers))
            self._participant: Any = DomainParticipant(domain)
            kinds = (BuiltinTopicDcpsPublication, True), (BuiltinTopicDcpsSubscription, False)
            self._known = [(BuiltinDataReader(self._participant, kind), is_pub) for kind, is_pub in kinds]
        except DDSException as error:
            raise InvalidArgumentError(
                f"domain={domain}, interface={interface} cannot be used by DDS ({_text(error)}): "
                f"`ip address` lists the interfaces; {LOOPBACK} is this machine alone."
            ) from error

    def publisher(self, topic: str, message_type: str, quality: Quality) -> Callable[[bytes], None]:
        """Declares a publisher; the result sends a message in CDR."""
        from cyclonedds.pub import DataWriter

        qos = _policies(quality, encoded=True)
        writer = DataWriter(self._participant, self._topic(topic, message_type), qos=qos)
        self._entities.append(writer)

        def send(message: bytes) -> None:
            try:
                writer.write(self._idl.sample(message_type, message))
            except self._error as error:
                raise GmmTorchError(f"DDS did not send a message on {topic}: {_text(error)}.") from error

        return send

    def subscribe(
        self, topic: str, message_type: str, quality: Quality, on_message: Callable[[bytes], None]
    ) -> None:
        """Declares a subscriber, whose messages go to the callback."""
        from cyclonedds.core import Listener
        from cyclonedds.sub import DataReader

        qos = _policies(quality)
        reader: Any = DataReader(self._participant, self._topic(topic, message_type), qos=qos)

        class Receiver(Listener):
            def on_data_available(self, _: Any) -> None:
                for sample in reader.take(N=_MOST_SAMPLES):
                    cdr = getattr(sample, "cdr", None)  # absent if a publisher has ended
                    if cdr is not None:
                        on_message(cdr)

        listener = Receiver()
        reader.set_listener(listener)
        listener.on_data_available(reader)  # what came before the listener
        self._entities += [reader, listener]

    def endpoints(self) -> list[Endpoint]:
        """All known publishers and subscribers of ROS topics."""
        from cyclonedds.core import InstanceState

        found = []
        for reader, is_publisher in self._known:
            for sample in reader.read(N=10 * _MOST_SAMPLES):
                # Both are None for an endpoint of a process that was killed.
                name = getattr(sample, "topic_name", None) or ""
                kind = ros_type(getattr(sample, "type_name", None) or "")
                info = getattr(sample, "sample_info", None)
                is_alive = info is None or info.instance_state == InstanceState.Alive
                if name.startswith(f"{_TOPIC_PREFIX}/") and kind is not None and is_alive:
                    quality = _quality(sample.qos)
                    found.append(Endpoint(name[len(_TOPIC_PREFIX) :], kind, quality, is_publisher))
        return found

    def close(self) -> None:
        """Leaves the network."""
        for entity in self._entities:
            if hasattr(entity, "set_listener"):
                entity.set_listener(None)
        self._entities.clear()
        self._topics.clear()
        self._known.clear()
        self._participant = self._domain = None

    def _topic(self, topic: str, message_type: str) -> Any:
        from cyclonedds.topic import Topic

        key = topic, message_type
        if key not in self._topics:
            try:
                made = Topic(self._participant, _TOPIC_PREFIX + topic, self._idl.type(message_type))
            except self._error as error:
                raise InvalidArgumentError(
                    f"topic={topic} cannot have type={message_type} in DDS ({_text(error)}); a topic has one "
                    f"type, such as {dds_type(message_type)}."
                ) from error
            self._topics[key] = made
        return self._topics[key]


def _settings(interface: str, peers: Sequence[str]) -> str:
    """The configuration of Cyclone DDS."""
    kind = "address" if interface.replace(".", "").isdigit() else "name"
    local = interface.startswith("127.") or interface == "lo"
    multicast = "false" if local else "default"
    named = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in [LOOPBACK] * local + list(peers))
    return (
        "<CycloneDDS><Domain><General><Interfaces>"
        f"<NetworkInterface {kind}={quoteattr(interface)}/></Interfaces>"
        f"<AllowMulticast>{multicast}</AllowMulticast></General>"
        "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>{_PARTICIPANTS}</MaxAutoParticipantIndex>"
        f"<Peers>{named}</Peers></Discovery>"
        "</Domain></CycloneDDS>"
    )


def _open_domain(number: int, settings: str) -> Any:
    from cyclonedds.domain import Domain

    if not 0 <= number <= MAX_DOMAIN:
        raise InvalidArgumentError(f"domain={number} must be in 0 … {MAX_DOMAIN} (ROS_DOMAIN_ID).")
    with _LOCK:
        found: Any = _DOMAINS.get(number)
        if found is None:
            found = Domain(number, settings)
            found.settings = settings
            _DOMAINS[number] = found
        if found.settings != settings:
            raise InvalidArgumentError(
                f"domain={number} is open in this process with another interface or other peers; close its "
                "nodes, or use the same."
            )
    return found


def _policies(quality: Quality, encoded: bool = False) -> Any:
    from cyclonedds.core import Policy, Qos

    policies = [
        Policy.Reliability.Reliable(_BLOCKED) if quality.reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if quality.latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(quality.depth),
    ]
    if encoded:  # ROS 2 uses the first version of CDR
        policies.append(Policy.DataRepresentation(use_cdrv0_representation=True))
    return Qos(*policies)


def _quality(qos: Any) -> Quality:
    from cyclonedds.core import Policy

    return Quality(
        reliable=isinstance(qos[Policy.Reliability], Policy.Reliability.Reliable),
        latched=qos[Policy.Durability] != Policy.Durability.Volatile,
    )


def _text(error: Exception) -> str:
    return str(getattr(error, "msg", "") or error).strip(" .")


class IdlTypes:
    """Types of cyclonedds for ROS messages, whose structure Cyclone DDS checks and tells others.

    `MessageTypes` converts from and to fields: a sample has one attribute, `cdr`, the encoded message.
    """

    def __init__(self, definitions: dict[str, Any]) -> None:
        self._definitions = definitions
        self._made: dict[str, Any] = {}

    def type(self, name: str) -> Any:
        """The type of a message, pkg/msg/Name."""
        if name not in self._made:
            from cyclonedds.idl import make_idl_struct

            fields = {f"{field}_": self._field(kind) for field, kind in self._definitions[name][1]}
            made = make_idl_struct(name.rpartition("/")[2] + "_", dds_type(name), fields)
            made.serialize = _serialize
            made.deserialize = made.deserialize_key = classmethod(_deserialize)
            self._made[name] = made
        return self._made[name]

    def sample(self, name: str, cdr: bytes) -> Any:
        """A sample of a type from an encoded message."""
        return _deserialize(self.type(name), cdr)

    def _field(self, desc: Any) -> Any:
        from cyclonedds.idl import types

        kind, content = desc
        if kind == NAME:
            return self.type(content)
        if kind == BASE:
            name, bound = content
            if name == "string":
                return types.bounded_str[bound] if bound else str
            if name == "bool":
                return bool
            return getattr(types, {"byte": "uint8", "char": "uint8", "octet": "uint8"}.get(name, name))
        inner, size = content
        if kind == ARRAY:
            return types.array[self._field(inner), size]
        return types.sequence[self._field(inner), size] if size else types.sequence[self._field(inner)]


def _serialize(sample: Any, *_: Any, **__: Any) -> bytes:
    return bytes(sample.cdr)


def _deserialize(cls: Any, data: bytes, *_: Any, **__: Any) -> Any:
    sample = object.__new__(cls)
    sample.cdr = bytes(data)
    return sample
