"""LidarPackets: the points in messages with raw packets of a lidar, whatever its manufacturer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gmmtorch.datasets.packets import hesai, ouster
from gmmtorch.datasets.packets.sweeps import VELODYNE_BYTES
from gmmtorch.datasets.ros.bag_reader import BagReader
from gmmtorch.datasets.ros.sensor_messages import Reading, reading
from gmmtorch.datasets.trajectory import NANOSECONDS
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.optional_packages import needs_extra
from gmmtorch.scan import INTENSITY


class LidarPackets:
    """Decodes raw packets of one lidar of Velodyne, Hesai or Ouster, which their bytes show.

    Args:
        calibration: what the manufacturer states about this unit: the metadata (.json) of an Ouster, the
            correction file (.csv) of a Hesai. None: a Hesai has its nominal angles, and the metadata of an
            Ouster are searched in the recording and beside it.
        recording: with the packets.
    """

    def __init__(self, calibration: str | Path | None = None, recording: BagReader | None = None) -> None:
        self._path = None if calibration is None else _checked(Path(calibration).expanduser())
        self._recording = recording
        self._angles: hesai.Angles | None = None
        self._metadata: ouster.Metadata | None = None
        self._decoder: Callable[[list[tuple[float, bytes]]], np.ndarray] | None = None

    def points(self, message: dict[str, Any], wanted: Sequence[str] = ()) -> Reading:
        """The points of a message with packets, with times in ns on the clock of the packets' stamps.

        Those of a Velodyne have times in seconds from the stamp of the message. wanted: channels, of which
        there is "intensity". Raises `DataError`.
        """
        packets = [bytes(packet["data"][: packet.get("size")]) for packet in message["packets"]]
        if not packets:
            return reading(np.empty((0, 3)))
        model = hesai.model_of(packets[0])
        if len(packets[0]) == VELODYNE_BYTES:
            return self._velodyne(message, packets, wanted)
        if model is not None:
            if self._path is not None and self._angles is None:
                self._angles = hesai.read_angles(self._path)
            found = hesai.returns_of(packets, model, self._angles)
        elif ouster.is_packet(packets[0]) or self._path is not None:
            found = ouster.returns_of(packets, self._ouster(len(packets[0])))
        else:
            raise DataError(f"packets of {len(packets[0]):,} bytes are of no lidar that is read")
        stamp = message["packets"][0]["stamp"]
        first = int(stamp["sec"]) * NANOSECONDS + int(stamp["nanosec"])
        return _reading(found.points, found.times + first, found.reflectivity, wanted)

    def _velodyne(self, message: dict[str, Any], packets: Sequence[bytes], wanted: Sequence[str]) -> Reading:
        self._decoder = self._decoder or _velodyne_decoder()
        if any(len(data) != VELODYNE_BYTES for data in packets):
            raise DataError(f"not all packets have {VELODYNE_BYTES} bytes")
        stamps = [
            int(one["stamp"]["sec"]) + int(one["stamp"]["nanosec"]) * 1e-9 for one in message["packets"]
        ]
        table = self._decoder(list(zip(stamps, packets, strict=True)))
        points = np.stack([table[axis].astype(np.float64) for axis in "xyz"], 1)
        return _reading(points, table["time"], table["intensity"], wanted)

    def _ouster(self, n_bytes: int) -> ouster.Metadata:
        """The metadata of the lidar, whose packets have a size."""
        if self._metadata is None and self._path is not None:
            self._metadata = ouster.read_metadata(self._path.read_bytes(), str(self._path))
        if self._metadata is None and self._recording is not None:
            self._metadata = _stated_metadata(self._recording, n_bytes)
        if self._metadata is None:
            raise DataError(
                "the recording lacks the metadata of the Ouster lidar, which state its angles: give the file "
                "(.json) that was recorded with it, ‹calibration›=FILE"
            )
        return self._metadata


def _reading(points: np.ndarray, times: np.ndarray, intensity: np.ndarray, wanted: Sequence[str]) -> Reading:
    channel = torch.from_numpy(intensity.astype(np.float64))
    return reading(points, None, times, {INTENSITY: channel} if INTENSITY in wanted else {})


def _checked(path: Path) -> Path:
    if not path.is_file() or path.stat().st_size > hesai.MOST_CALIBRATION_BYTES:
        raise InvalidArgumentError(
            f"‹calibration›={path} is not a calibration of a lidar; give the file that its manufacturer "
            "delivers with it: .json of an Ouster, .csv of a Hesai."
        )
    return path


def _velodyne_decoder() -> Callable[[list[tuple[float, bytes]]], np.ndarray]:
    """A function that decodes (time in s, packet) of a sweep with the package velodyne-decoder."""
    with needs_extra("Velodyne packets need", "velodyne-decoder", "packets"):
        import velodyne_decoder
    decoder = velodyne_decoder.ScanDecoder(velodyne_decoder.Config())

    def decode(packets: list[tuple[float, bytes]]) -> np.ndarray:
        try:
            given = [velodyne_decoder.VelodynePacket(time, list(data)) for time, data in packets]
            table: np.ndarray = decoder.decode(given, as_pcl_structs=True)[1]
        except (RuntimeError, TypeError, ValueError) as error:
            raise DataError(f"the packets cannot be decoded: {str(error).splitlines()[0]}") from error
        return table

    return decode


_STRING = "std_msgs/msg/String"
_MOST_FILES = 200


def _stated_metadata(recording: BagReader, n_bytes: int) -> ouster.Metadata | None:
    """The metadata of the Ouster lidar with packets of a size that a bag or a file beside it states.

    Those with the name of the recording come first. Raises `DataError` if there are several.
    """
    path = recording.path
    found = {}
    for topic in recording.topics:
        if topic.type == _STRING and topic.n_messages:
            message = next(recording.messages([topic.name]), None)
            if message is not None and ouster.is_metadata(message.data):
                text = str(recording.decode(message).get("data", ""))
                found[topic.name] = ouster.read_metadata(text, f"{path}, topic {topic.name}")
    folder = path if path.is_dir() else path.parent
    for file in sorted(folder.glob("*.json"))[:_MOST_FILES] if not found else ():
        is_small = file.is_file() and file.stat().st_size <= hesai.MOST_CALIBRATION_BYTES
        if is_small and ouster.is_metadata(file.read_bytes()):
            with suppress(DataError):  # of another lidar
                found[str(file)] = ouster.read_metadata(file.read_bytes(), str(file))
    fitting = {name: one for name, one in found.items() if one.n_bytes == n_bytes}
    own = {name: one for name, one in fitting.items() if Path(name).name.startswith(path.stem)}
    chosen = own or fitting
    if len(chosen) > 1:
        raise DataError(
            f"the metadata of {len(chosen)} lidars fit the packets, {', '.join(chosen)}; choose one file: "
            "‹calibration›=FILE"
        )
    return next(iter(chosen.values()), None)
