"""DDS types made at run time from message definitions. Their samples carry encoded messages."""

from __future__ import annotations

from typing import Any

from gmmtorch.datasets.recordings.ros.message_decoder import ARRAY, BASE, NAME
from gmmtorch.live.ros.message_types import dds_type


class IdlTypes:
    """Types of cyclonedds for ROS messages.

    Cyclone DDS needs the structure of a type to check what it receives and to tell others. The conversion
    from and to fields is `MessageTypes`'s: a sample has one attribute, `cdr`, the encoded message.
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
