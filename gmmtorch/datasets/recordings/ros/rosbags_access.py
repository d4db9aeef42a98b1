"""What gmmtorch uses of the package rosbags, with limits on what a hostile bag can make it allocate."""

from __future__ import annotations

import bz2
import shutil
import tempfile
from types import SimpleNamespace
from typing import Any, BinaryIO

from gmmtorch.errors import DataError
from gmmtorch.optional_packages import needs_extra

MAX_CHUNK_BYTES = 1 << 28
"""Limit of an unpacked chunk or message; recorders write chunks of about a megabyte."""

MAX_BAG_BYTES = 1 << 35
"""Limit of a ROS 2 bag file that is compressed as a whole, unpacked. It also takes at most half of the free
space of the temporary folder."""

_ZSTD_HEADER_BYTES = 18
_MAGIC = {b"\x89MCAP0\r\n": ".mcap", b"SQLite f": ".db3"}


def reader_class(is_ros1: bool) -> Any:
    """The reader of ROS 1 or of ROS 2 bags, with limits. Raises `GmmTorchError` if rosbags does not load."""
    with needs_extra("ROS bags need", "rosbags", "bags"):
        import rosbags.rosbag1
        import rosbags.rosbag2
    ros1, ros2 = rosbags.rosbag1, rosbags.rosbag2
    _limit_codecs(ros1.reader, ros2.reader, ros2.storage_mcap)
    return _limited_ros1_reader(ros1) if is_ros1 else _reader_by_magic(ros2)


def standard_definitions(is_ros1: bool) -> dict[str, Any]:
    """The message types of ROS 1 Noetic or ROS 2 Jazzy."""
    from rosbags.typesys import Stores, get_typestore

    return dict(get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY).fielddefs)


def parsed_definitions(definition: Any, message_type: str) -> dict[str, Any]:
    """The types of a definition in a bag; empty if it is missing or cannot be parsed."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    try:
        if definition.format.name == "MSG":
            return dict(get_types_from_msg(definition.data, message_type))
        return dict(get_types_from_idl(definition.data)) if definition.format.name == "IDL" else {}
    except Exception:  # the parser raises its own and many built-in errors
        return {}


def unpack_zstd(data: bytes, limit: int = MAX_CHUNK_BYTES) -> bytes:
    """Unpack a compressed message or chunk. Raises `DataError` beyond `MAX_CHUNK_BYTES`."""
    from rosbags.rosbag2 import storage_mcap

    return _within(storage_mcap.zstd.ZstdDecompressor().decompress(data, _more(limit)))


def _unpack_bz2(data: bytes, limit: int = MAX_CHUNK_BYTES) -> bytes:
    return _within(bz2.BZ2Decompressor().decompress(data, _more(limit)))


def _unpack_lz4(data: bytes, limit: int = MAX_CHUNK_BYTES) -> bytes:
    import lz4.frame

    return _within(lz4.frame.LZ4FrameDecompressor().decompress(data, _more(limit)))


def _more(limit: int) -> int:
    return min(limit, MAX_CHUNK_BYTES) + 1


def _within(unpacked: bytes) -> bytes:
    if len(unpacked) > MAX_CHUNK_BYTES:
        raise DataError(f"A compressed chunk unpacks to more than {MAX_CHUNK_BYTES:,} bytes; it is damaged.")
    return unpacked


def _limit_codecs(ros1: Any, ros2: Any, mcap: Any) -> None:
    """Put codecs with limits in the places where three modules of rosbags look for theirs."""
    ros1.decompressors.update(bz2=_unpack_bz2, lz4=_unpack_lz4)
    mcap.DECOMPRESSORS.update(lz4=_unpack_lz4, zstd=unpack_zstd)
    ros2.zstd = SimpleNamespace(open=_limited_zstd_file(mcap.zstd), decompress=unpack_zstd)


def _limited_zstd_file(zstd: Any) -> Any:
    class LimitedZstdFile(zstd.ZstdFile):
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

    return LimitedZstdFile


def _most_bag_bytes() -> int:
    return min(MAX_BAG_BYTES, shutil.disk_usage(tempfile.gettempdir()).free // 2)


def _check_bag(bytes_left: int) -> None:
    if bytes_left < 0:
        raise DataError(
            f"The compressed bag unpacks to more than {MAX_BAG_BYTES:,} bytes, or to more than half of the "
            f"free space of {tempfile.gettempdir()}. If you trust it, unpack its files with 'zstd -d', "
            "and write its metadata.yaml again with 'ros2 bag reindex'."
        )


def _reader_by_magic(rosbag2: Any) -> Any:
    class ReaderByMagic(rosbag2.Reader):
        """Knows the storage of a file by its first bytes, whatever its name."""

        def __init__(self, path: Any) -> None:
            super().__init__(path)
            if not path.is_dir():
                with path.open("rb") as file:
                    suffix = _MAGIC.get(file.read(8), path.suffix)
                self.storage = self.STORAGE_PLUGINS[suffix](path)

    return ReaderByMagic


def _limited_ros1_reader(rosbag1: Any) -> Any:
    class LimitedRos1Reader(rosbag1.Reader):
        """Reads each byte of the index once: chunks that share an index would multiply it."""

        _index_bytes = 0

        def read_index_data(self, pos: int, indexes: Any) -> None:
            before = self.bio.tell()
            super().read_index_data(pos, indexes)
            self._index_bytes += self.bio.tell() - before
            if self._index_bytes > self.path.stat().st_size:
                raise rosbag1.ReaderError("Bag index looks damaged: its parts overlap.")

    return LimitedRos1Reader
