"""Topic names of a node: namespaces and remapping, by the rules of ROS 2."""

from __future__ import annotations

import re
from collections.abc import Mapping

from gmmtorch.errors import InvalidArgumentError

_TOKEN = r"[A-Za-z_][A-Za-z0-9_]*"
_TOPIC = re.compile(rf"(~/|/)?{_TOKEN}(/{_TOKEN})*|~")
_NODE = re.compile(_TOKEN)


class TopicNames:
    """Resolves the names that a node uses.

    Args:
        node: name of the node.
        namespace: of relative names, such as robot1; "" or "/": none.
        remap: name → other name. Both sides are resolved in the namespace before they are compared.

    Raises `InvalidArgumentError` for names that ROS 2 does not allow.
    """

    def __init__(self, node: str, namespace: str = "", remap: Mapping[str, str] | None = None) -> None:
        if _NODE.fullmatch(node) is None:
            raise InvalidArgumentError(f"name={node!r} is not a name of a node: use letters, digits and _.")
        path = namespace.strip("/")
        if path and _TOPIC.fullmatch(path) is None:
            raise InvalidArgumentError(
                f"namespace={namespace!r} is not one of ROS: use letters, digits, _ and /."
            )
        self.node = node
        self.namespace = f"/{path}"
        self._remap = {self._absolute(old): self._absolute(new) for old, new in (remap or {}).items()}

    def resolve(self, name: str) -> str:
        """The absolute, remapped name of a topic: /name, name in the namespace, or ~/name of the node."""
        whole = self._absolute(name)
        return self._remap.get(whole, whole)

    def _absolute(self, name: str) -> str:
        if _TOPIC.fullmatch(name) is None:
            raise InvalidArgumentError(
                f"topic={name!r} is not a name of ROS: letters, digits and _, in parts separated by /."
            )
        if name.startswith("/"):
            return name
        base = self.namespace.rstrip("/")
        return f"{base}/{self.node}{name[1:]}" if name.startswith("~") else f"{base}/{name}"
