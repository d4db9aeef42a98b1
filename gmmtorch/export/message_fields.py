"""Contents of ROS messages: nested fields for the bags that `BagWriter` writes, and for live topics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gmmtorch.datasets import NANOSECONDS
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.scan import ArrayLike

_BASE, _NAME, _ARRAY = 1, 2, 3
_POINT_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def built_message(store: Any, name: str, fields: Mapping[str, Any], stamp: int) -> Any:
    """An object of message type `name` of a type store of rosbags.

    A header without a stamp gets `stamp` (ns). Fields that are not given are zero or empty.
    """
    values: dict[str, Any] = {}
    for field, (kind, content) in store.fielddefs[name][1]:
        given = fields.get(field)
        if kind == _NAME:
            if content == "builtin_interfaces/msg/Time" and given is None and name.endswith("/Header"):
                given = time_fields(stamp)
            values[field] = built_message(store, content, given or {}, stamp)
        elif kind == _BASE:
            values[field] = given if given is not None else "" if content[0] == "string" else 0
        elif content[0][0] == _NAME:
            values[field] = [built_message(store, content[0][1], item, stamp) for item in given or []]
        elif content[0][1][0] == "string":
            values[field] = list(given or [])
        else:
            code = {"bool": "u1", "byte": "u1", "char": "u1", "octet": "u1"}.get(content[0][1][0])
            size = content[1] if kind == _ARRAY else 0
            array = np.zeros(size) if given is None else given
            values[field] = np.asarray(array, dtype=np.dtype(code or content[0][1][0]))
    return store.types[name](**values)


def time_fields(stamp: int) -> dict[str, int]:
    """A Time from nanoseconds."""
    return {"sec": stamp // NANOSECONDS, "nanosec": stamp % NANOSECONDS}


def pose_fields(matrix: ArrayLike) -> tuple[dict[str, float], dict[str, float]]:
    """Translation and rotation of a pose (4, 4) as fields of messages."""
    from scipy.spatial.transform import Rotation

    pose = np.asarray(matrix, dtype=np.float64)
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return dict(zip("xyz", pose[:3, 3].tolist(), strict=True)), dict(zip("xyzw", turn.tolist(), strict=True))


def transform_fields(edges: Mapping[tuple[str, str], ArrayLike]) -> dict[str, Any]:
    """A TFMessage from transforms (parent, child) → parent ← child, (4, 4)."""
    entries = [
        {
            "header": {"frame_id": parent},
            "child_frame_id": child,
            "transform": dict(zip(("translation", "rotation"), pose_fields(matrix), strict=True)),
        }
        for (parent, child), matrix in edges.items()
    ]
    return {"transforms": entries}


def odometry_fields(frame: str, child: str, matrix: ArrayLike) -> dict[str, Any]:
    """An Odometry message: the pose (4, 4) of `child` in `frame`."""
    position, orientation = pose_fields(matrix)
    pose = {"pose": {"position": position, "orientation": orientation}}
    return {"header": {"frame_id": frame}, "child_frame_id": child, "pose": pose}


def cloud_fields(frame: str, table: np.ndarray) -> dict[str, Any]:
    """A PointCloud2 from a structured array (N,) or (H, W): its fields, in its byte order.

    Raises `InvalidArgumentError` for other arrays, and for types of fields that PointCloud2 does not have.
    """
    dtypes = {name: (entry[0], entry[1]) for name, entry in (table.dtype.fields or {}).items()}
    unknown = [f"{name} {dtype}" for name, (dtype, _) in dtypes.items() if dtype.str[1:] not in _POINT_TYPES]
    if unknown or not dtypes or table.ndim not in (1, 2):
        raise InvalidArgumentError(
            f"table of shape {table.shape} with fields {', '.join(unknown or dtypes) or 'none'} cannot be a "
            "PointCloud2; give a structured array (N,) or (H, W) whose fields are float32, float64, or whole "
            "numbers of at most 32 bits."
        )
    is_big = any(dtype.str[0] == ">" for dtype, _ in dtypes.values())
    rows = np.atleast_2d(table.astype(table.dtype.newbyteorder(">" if is_big else "<"), copy=False))
    point_fields = [
        {"name": name, "offset": offset, "datatype": _POINT_TYPES[dtype.str[1:]], "count": 1}
        for name, (dtype, offset) in dtypes.items()
    ]
    step = table.dtype.itemsize
    return {
        "header": {"frame_id": frame},
        "height": rows.shape[0],
        "width": rows.shape[1],
        "fields": point_fields,
        "is_bigendian": is_big,
        "point_step": step,
        "row_step": step * rows.shape[1],
        "is_dense": True,
        "data": np.frombuffer(rows.tobytes(), np.uint8),
    }
