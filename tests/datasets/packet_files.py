"""Packets of lidars and captures of them, written by the manuals of their formats, for tests."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

# -- Hesai: packets of a model, block by block (user manuals, chapter "Point Cloud Data Packet") -------

TAILS = {  # bytes after the blocks, and the place of the µs
    "Pandar40P": (22, 10),
    "Pandar64": (22, 10),
    "PandarQT64": (28, 12),
    "QT128": (59, 42),
    "XT32": (28, 19),
    "XT16": (28, 19),
    "XT32M2X": (28, 19),
}
HEADS = {
    "Pandar40P": b"",
    "Pandar64": bytes([0xEE, 0xFF, 64, 6, 0, 4, 0, 0]),
    "PandarQT64": bytes([0xEE, 0xFF, 3, 1, 0, 0, 64, 4, 1, 4, 1, 0]),
    "QT128": bytes([0xEE, 0xFF, 3, 2, 0, 0, 128, 2, 1, 4, 1, 0]),
    "XT32": bytes([0xEE, 0xFF, 6, 1, 0, 0, 32, 8, 1, 4, 1, 0]),
    "XT16": bytes([0xEE, 0xFF, 6, 1, 0, 0, 16, 8, 1, 4, 1, 0]),
    "XT32M2X": bytes([0xEE, 0xFF, 6, 1, 0, 0, 32, 6, 1, 4, 1, 0]),
}
SHAPES = {  # blocks, channels, bytes of a return
    "Pandar40P": (10, 40, 3),
    "Pandar64": (6, 64, 3),
    "PandarQT64": (4, 64, 4),
    "QT128": (2, 128, 4),
    "XT32": (8, 32, 4),
    "XT16": (8, 16, 4),
    "XT32M2X": (6, 32, 4),
}


def hesai_packet(model: str, azimuths: Sequence[float], metres: np.ndarray, microseconds: int = 0) -> bytes:
    """A packet with ranges (blocks, channels) in metres; azimuths in degrees; reflectivity is the channel."""
    _, _, cell = SHAPES[model]
    blocks = b""
    for azimuth, ranges in zip(azimuths, metres, strict=True):
        blocks += b"\xff\xee" * (model == "Pandar40P") + struct.pack("<H", round(azimuth * 100))
        for channel, value in enumerate(ranges):
            blocks += struct.pack("<HB", round(value / 0.004), channel) + bytes(cell - 3)
    length, clock = TAILS[model]
    tail = bytearray(length)
    tail[clock : clock + 4] = struct.pack("<I", microseconds)
    return HEADS[model] + blocks + bytes(tail)


# -- Ouster (Firmware User Manual, chapter "Lidar Data Packet Format") ---------------------------------

PIXELS = {  # bytes of a pixel, and a function of ranges in mm and reflectivities of up to two returns
    "LEGACY": lambda r, s: struct.pack("<IHHHH", r[0] | 5 << 28, s[0], 7, 8, 0),
    "RNG19_RFL8_SIG16_NIR16": lambda r, s: struct.pack("<IBBHHH", r[0] | 3 << 19, s[0], 0, 7, 8, 0),
    "RNG19_RFL8_SIG16_NIR16_DUAL": lambda r, s: struct.pack(
        "<IIHHHH", r[0] | s[0] << 24, r[1] | s[1] << 24, 7, 8, 9, 0
    ),
    "RNG15_RFL8_NIR8": lambda r, s: struct.pack("<HBB", r[0] // 8 | 1 << 15, s[0], 9),
    "FUSA_RNG15_RFL8_NIR8_DUAL": lambda r, s: struct.pack("<HBBHBB", r[0] // 8, s[0], 9, r[1] // 8, s[1], 9),
}


def ouster_packet(
    profile: str, frame: int, first: int, ranges: np.ndarray, reflectivity: int, start: int, step: int
) -> bytes:
    """A packet with 16 columns from number `first`; ranges (2, 16, C) in mm, times in ns from `start`."""
    columns = b""
    for k in range(16):
        number, time = first + k, start + k * step
        if profile == "LEGACY":
            head = struct.pack("<QHHI", time, number, frame & 0xFFFF, number * 88)
        else:
            head = struct.pack("<QHH", time, number, 1)
        pixels = b"".join(
            PIXELS[profile]((int(a), int(b)), (reflectivity, reflectivity + 1)) for a, b in ranges[:, k].T
        )
        columns += head + pixels + (b"\xff\xff\xff\xff" if profile == "LEGACY" else b"")
    if profile == "LEGACY":
        return columns
    if profile.startswith("FUSA"):
        return struct.pack("<B3sI", 1, b"\x07\x08\x09", frame) + bytes(24) + columns + bytes(32)
    return struct.pack("<HH", 1, frame & 0xFFFF) + b"\x07\x08\x09" + bytes(25) + columns + bytes(32)


def ouster_metadata(profile: str, n_channels: int, n_columns: int, is_flat: bool = False) -> str:
    """The metadata of a lidar; before firmware 2.0 they are flat."""
    beams = {
        "beam_altitude_angles": np.linspace(20, -20, n_channels).tolist(),
        "beam_azimuth_angles": np.tile([3.0, -1.0, 1.0, -3.0], n_channels // 4).tolist(),
        "lidar_origin_to_beam_origin_mm": 15.8,
    }
    mount = {"lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1]}
    form = {
        "columns_per_frame": n_columns,
        "columns_per_packet": 16,
        "pixels_per_column": n_channels,
        "udp_profile_lidar": profile,
        "column_window": [0, n_columns - 1],
        "pixel_shift_by_row": [0] * n_channels,
        "udp_profile_imu": "LEGACY",
        "fps": 10,
    }
    mode = {"lidar_mode": f"{n_columns}x10"}
    if is_flat:
        return json.dumps({**beams, **mount, **mode, "data_format": form, "prod_line": "OS-1-32"})
    return json.dumps(
        {
            "beam_intrinsics": beams,
            "lidar_intrinsics": mount,
            "lidar_data_format": form,
            "imu_intrinsics": {"imu_to_sensor_transform": np.eye(4).ravel().tolist()},
            "calibration_status": {"reflectivity": {"valid": True}},
            "config_params": {**mode, "udp_profile_lidar": profile},
            "sensor_info": {"prod_line": "OS-1-32", "image_rev": "ousteros-image-prod-aries-v2.3.0"},
        }
    )


# -- captures ----------------------------------------------------------------------------------------


def frames(datagram: bytes, port: int, source: int = 201, mtu: int = 1480, number: int = 1) -> list[bytes]:
    """The Ethernet frames of a UDP datagram, in parts of at most `mtu` bytes (RFC 768, 791)."""
    udp = struct.pack(">HHHH", 40000, port, 8 + len(datagram), 0) + datagram
    found = []
    for at in range(0, len(udp), mtu):
        part = udp[at : at + mtu]
        flags = at // 8 | (0x2000 if at + mtu < len(udp) else 0)
        address = bytes([192, 168, 1, source]) + bytes([192, 168, 1, 10])
        ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(part), number & 0xFFFF, flags, 64, 17, 0) + address
        frame = bytes(12) + b"\x08\x00" + ip + part
        found.append(frame + bytes(max(0, 60 - len(frame))))
    return found


def write_capture(
    path: Path, packets: Sequence[tuple[float, bytes]], port: int = 2368, source: int = 201, mtu: int = 1480
) -> Path:
    """A capture of packets with times in seconds, written by dpkt, which velodyne-decoder installs."""
    import dpkt

    with path.open("wb") as file:
        kind = dpkt.pcapng.Writer if path.suffix == ".pcapng" else dpkt.pcap.Writer
        writer = kind(file)
        for number, (time, data) in enumerate(packets):
            for frame in frames(data, port, source, mtu, number):
                writer.writepkt(frame, ts=time)
    return path
