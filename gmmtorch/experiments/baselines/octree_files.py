"""Octree files of OctoMap, `.ot` (log-odds) and `.bt` (occupied or free), checked before OctoMap reads them.

OctoMap recurses as deep as a file says and does not notice its end, so a damaged file could end the process.
"""

from __future__ import annotations

import struct
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError
from gmmtorch.occupancy import check_resolution
from gmmtorch.optional_packages import load_pyoctomap

_BINARY, _FULL = b"# Octomap OcTree binary file", b"# Octomap OcTree file"
_DEPTH = 16
_MAX_NODES = 1 << 25
_MAX_HEADER_BYTES = 1 << 16
_NODE = struct.Struct("<fB")  # log-odds, and a bit for each child
_INNER = 3  # two bits of a child in .bt; 1: free leaf, 2: occupied leaf


class _Header(NamedTuple):
    """binary: a `.bt` file. n_nodes: number of nodes. resolution: side of a cell (m). begin: of the nodes."""

    binary: bool
    n_nodes: int
    resolution: float
    begin: int


def read_octree_file(path: str | Path) -> bytes:
    """The content of a file. Raises `MissingDataError`, and `DataError` for more than 2²⁵ nodes take."""
    path = Path(path).expanduser()
    if not path.is_file():
        raise MissingDataError(f"{path} does not exist; expected an OctoMap file (.bt or .ot).")
    if path.stat().st_size > _MAX_HEADER_BYTES + _MAX_NODES * _NODE.size:
        raise DataError(f"{path} has {path.stat().st_size:,} bytes, more than {_MAX_NODES:,} nodes take.")
    return path.read_bytes()


def parsed_octree(data: bytes, path: str | Path) -> tuple[Any, float]:
    """OctoMap's octree in the content of a file, and the side of its cells (m).

    Raises `DataError` for files that are not an OcTree, are damaged, or have more than 2²⁵ nodes.
    """
    path = Path(path)
    header = _header(data, path)
    check = _count_binary if header.binary else _count_full
    n_nodes = check(data, header.begin, path) if len(data) > header.begin else 0
    if n_nodes != header.n_nodes:
        raise DataError(f"{path} announces {header.n_nodes:,} nodes, but has {n_nodes:,}; it is damaged.")
    return _parsed(data[header.begin :], header), header.resolution


def _header(data: bytes, path: Path) -> _Header:
    binary = data.startswith(_BINARY)
    if not (binary or data.startswith(_FULL)):
        raise DataError(f"{path} does not begin as OctoMap's .bt and .ot files do.")
    end = data.find(b"\ndata\n", 0, _MAX_HEADER_BYTES)
    lines = data[:end].decode("ascii", errors="replace").splitlines()
    fields = dict(
        line.split(maxsplit=1) for line in lines if not line.startswith("#") and " " in line.strip()
    )
    kind = fields.get("id")
    if end >= 0 and kind not in ("OcTree", "1", None):
        raise DataError(f"{path} contains a tree of type {kind}; only OcTree is read. Convert it to OcTree.")
    try:
        n_nodes, resolution = int(fields["size"]), check_resolution(float(fields["res"]))
    except (KeyError, ValueError, InvalidArgumentError) as error:
        raise DataError(f"{path}: its header is damaged ({error!r}).") from error
    if end < 0 or kind is None:
        raise DataError(f"{path}: its header is damaged: id or data is missing.")
    if not 0 <= n_nodes <= _MAX_NODES:
        raise DataError(f"{path} announces {n_nodes:,} nodes; at most {_MAX_NODES:,} are read.")
    return _Header(binary, n_nodes, resolution, end + len(b"\ndata\n"))


def _count_full(data: bytes, begin: int, path: Path) -> int:
    """Number of nodes of an .ot file, in depth-first order. Raises unless they end where the file ends."""
    n_bytes = len(data) - begin
    if n_bytes % _NODE.size:
        raise DataError(f"{path} ends within a node; it is cut off, so fetch it again.")
    nodes = np.frombuffer(data, np.dtype([("log_odds", "<f4"), ("children", "u1")]), offset=begin)
    if not np.isfinite(nodes["log_odds"]).all():
        raise DataError(f"{path} has nodes without a finite probability; it is damaged.")
    n_children = np.unpackbits(nodes["children"][:, None], axis=1).sum(1)
    _check_depths(n_children, path)
    return len(nodes)


def _count_binary(data: bytes, begin: int, path: Path) -> int:
    """Number of nodes of a .bt file, whose records are the nodes with children, in depth-first order."""
    if (len(data) - begin) % 2:
        raise DataError(f"{path} ends within a node; it is cut off, so fetch it again.")
    records = np.frombuffer(data, "<u2", offset=begin)
    kinds = (records[:, None] >> np.arange(0, 16, 2, dtype=np.uint16)) & 3
    _check_depths((kinds == _INNER).sum(1), path, deepest=_DEPTH - 1)
    return 1 + int((kinds != 0).sum())


def _check_depths(n_children: np.ndarray, path: Path, deepest: int = _DEPTH) -> None:
    """Raises unless records with these numbers of children, depth first, are one tree of limited depth."""
    waiting = [0]
    for place, n in enumerate(n_children.tolist()):
        if not waiting:
            raise DataError(f"{path} has {len(n_children) - place} nodes after its tree; it is damaged.")
        depth = waiting.pop()
        if n:
            if depth == deepest:
                raise DataError(f"{path} has nodes deeper than {_DEPTH} levels; it is damaged.")
            waiting += [depth + 1] * n
    if waiting:
        raise DataError(f"{path} ends before its tree does; it is cut off, so fetch it again.")


def _parsed(nodes: bytes, header: _Header) -> Any:
    """The octree of checked nodes, below a header of ours; OctoMap can only read from disk."""
    first = _BINARY if header.binary else _FULL
    text = f"\nid OcTree\nsize {header.n_nodes}\nres {header.resolution!r}\ndata\n".encode()
    tree = load_pyoctomap().OcTree(header.resolution)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "tree"
        file.write_bytes(first + text + nodes)
        if not header.binary:
            tree = tree.read(str(file))
        elif not tree.readBinary(str(file)):
            tree = None
    if tree is None:
        raise DataError("OctoMap does not read this octree.")
    return tree
