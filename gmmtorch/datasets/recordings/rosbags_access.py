"""What gmmtorch uses of the package rosbags, with limits on what a hostile bag can make it allocate."""

from __future__ import annotations

import bz2
import shutil
import tempfile
from types import SimpleNamespace
from typing import Any, BinaryIO

from gmmtorch.errors import DataError, GmmTorchError

MAX_CHUNK_BYTES = 1 << 28
"""Limit of an unpacked chunk or message; recorders write chunks of about a megabyte."""

MAX_BAG_BYTES = 1 << 35
"""Limit of a ROS 2 bag file that is compressed as a whole, unpacked. It also takes at most half of the free
space of the temporary folder."""

_ZSTD_HEADER_BYTES = 18


def load_rosbags() -> Any:
    """Readers `ros1` and `ros2`, and functions `unpack_zstd`, `definitions` and `parsed`.

    Raises `GmmTorchError` if rosbags does not load.
    """
    try:
        import lz4.frame
        from rosbags.rosbag1 import Reader as Ros1Reader
        from rosbags.rosbag1 import ReaderError
        from rosbags.rosbag1 import reader as ros1_module
        from rosbags.rosbag2 import Reader as Ros2Reader
        from rosbags.rosbag2 import reader as ros2_module
        from rosbags.rosbag2 import storage_mcap
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    except ImportError as error:
        raise GmmTorchError(
            f"ROS bags need the package rosbags, which does not load ({error}); install it: "
            "pip install 'gmmtorch[bags]'."
        ) from error

    def unpack_bz2(data: bytes, limit: int = MAX_CHUNK_BYTES) -> bytes:
        return _within(bz2.BZ2Decompressor().decompress(data, _more(limit)))

    def unpack_lz4(data: bytes, limit: int = MAX_CHUNK_BYTES) -> bytes:
        return _within(lz4.frame.LZ4FrameDecompressor().decompress(data, _more(limit)))

    def unpack_zstd(data: bytes, limit: int = MAX_CHUNK_BYTES) -> bytes:
        return _within(storage_mcap.zstd.ZstdDecompressor().decompress(data, _more(limit)))

    zstd: Any = storage_mcap.zstd
    folders: Any = ros2_module

    class BoundedZstdFile(zstd.ZstdFile):
        """A compressed file that is not read further than `_most_bag_bytes`."""

        def __init__(self, packed: BinaryIO, mode: str = "rb") -> None:
            announced = zstd.get_frame_info(packed.read(_ZSTD_HEADER_BYTES)).decompressed_size
            packed.seek(0)
            self._left = _most_bag_bytes()
            _check_bag(self._left - (announced or 0))
            super().__init__(packed, mode)

        def read(self, size: int | None = -1) -> bytes:
            found: bytes = super().read(size)
            self._left -= len(found)
            _check_bag(self._left)
            return found

    # rosbags takes its codecs from these names; its own unpack without a limit.
    ros1_module.decompressors.update(bz2=unpack_bz2, lz4=unpack_lz4)
    storage_mcap.DECOMPRESSORS.update(lz4=unpack_lz4, zstd=unpack_zstd)
    folders.zstd = SimpleNamespace(open=BoundedZstdFile, decompress=unpack_zstd)

    class BoundedRos1Reader(Ros1Reader):
        """Reads each byte of the index once: chunks that share an index would multiply it."""

        _index_bytes = 0

        def read_index_data(self, pos: int, indexes: Any) -> None:
            file: Any = self.bio
            before = file.tell()
            super().read_index_data(pos, indexes)
            self._index_bytes += file.tell() - before
            if self._index_bytes > self.path.stat().st_size:
                raise ReaderError("Bag index looks damaged: its parts overlap.")

    def definitions(is_ros1: bool) -> dict[str, Any]:
        return dict(get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY).fielddefs)

    def parsed(definition: Any, message_type: str) -> dict[str, Any]:
        """The types of a definition in a bag; empty if it is missing or cannot be parsed."""
        try:
            if definition.format.name == "MSG":
                return dict(get_types_from_msg(definition.data, message_type))
            return dict(get_types_from_idl(definition.data)) if definition.format.name == "IDL" else {}
        except Exception:  # the parser raises its own and many built-in errors
            return {}

    return SimpleNamespace(
        ros1=BoundedRos1Reader,
        ros2=Ros2Reader,
        unpack_zstd=unpack_zstd,
        definitions=definitions,
        parsed=parsed,
    )


def _most_bag_bytes() -> int:
    return min(MAX_BAG_BYTES, shutil.disk_usage(tempfile.gettempdir()).free // 2)


def _check_bag(bytes_left: int) -> None:
    if bytes_left < 0:
        raise DataError(
            f"The compressed bag unpacks to more than {MAX_BAG_BYTES:,} bytes, or to more than half of the "
            f"free space of {tempfile.gettempdir()}. If you trust it, unpack its files with 'zstd -d', "
            "and write its metadata.yaml again with 'ros2 bag reindex'."
        )


def _more(limit: int) -> int:
    return min(limit, MAX_CHUNK_BYTES) + 1


def _within(unpacked: bytes) -> bytes:
    if len(unpacked) > MAX_CHUNK_BYTES:
        raise DataError(f"A compressed chunk unpacks to more than {MAX_CHUNK_BYTES:,} bytes; it is damaged.")
    return unpacked
