"""Rigid motions in records. A pose in 2D is a translation with cos and sin of the yaw (4,); in 3D a
translation with a unit quaternion x, y, z, w (7,); metres.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import check_rigid
from gmmtorch.mapping.codec.bitstream import BitReader, BitWriter
from gmmtorch.sharing.messages.envelope import FARTHEST

_NUMBERS = {2: 4, 3: 7}
_UNIT = 1e-9


def motion_dim(pose: Tensor) -> int:
    """2 or 3."""
    return {n: dim for dim, n in _NUMBERS.items()}[len(pose)]


def is_motion(pose: Tensor) -> bool:
    """Whether it is a valid pose."""
    for dim, n in _NUMBERS.items():
        if pose.shape == (n,):
            near = bool((pose[:dim].abs() <= FARTHEST).all())
            return near and abs(float(pose[dim:].norm()) - 1) <= _UNIT
    return False


def pose_of(transform: Tensor) -> Tensor:
    """The pose of a rigid motion (3, 3) or (4, 4).

    Raises `InvalidArgumentError` if it is not rigid or moves too far.
    """
    if transform.shape not in ((3, 3), (4, 4)):
        raise InvalidArgumentError(f"transform has shape {tuple(transform.shape)}; give (3, 3) or (4, 4).")
    rotation, translation = check_rigid(transform.detach().cpu().double(), len(transform) - 1)
    if not bool((translation.abs() <= FARTHEST).all()):
        raise InvalidArgumentError(f"transform moves by {translation.tolist()}; {FARTHEST:g} m is the most.")
    if len(rotation) == 2:
        turn = rotation[:, 0] / rotation[:, 0].norm()
    else:
        from scipy.spatial.transform import Rotation

        turn = torch.from_numpy(Rotation.from_matrix(rotation.numpy()).as_quat(canonical=True))
    return torch.cat([translation, turn]) + 0.0  # no −0


def matrix_of(pose: Tensor) -> Tensor:
    """The motion (D+1, D+1) of a pose."""
    dim = motion_dim(pose)
    matrix = torch.eye(dim + 1, dtype=torch.float64)
    matrix[:-1, -1] = pose[:dim]
    if dim == 2:
        cos, sin = pose[2:].tolist()
        turn = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)
    else:
        from scipy.spatial.transform import Rotation

        turn = torch.from_numpy(Rotation.from_quat(pose[3:].numpy()).as_matrix())
    matrix[:-1, :-1] = turn
    return matrix


def write_motion(writer: BitWriter, pose: Tensor) -> None:
    """A bit for the dimension, then the numbers of a valid pose as float64."""
    writer.one(int(motion_dim(pose) == 3), 1)
    writer.fixed(pose.numpy().astype("<f8").view("<u4").astype(np.int64), 32)


def read_motion(reader: BitReader) -> Tensor:
    """What `write_motion` wrote; it may be no valid pose."""
    halves = reader.fixed(2 * _NUMBERS[2 + reader.one(1)], 32)
    return torch.from_numpy(halves.astype("<u4").view("<f8").astype(np.float64))
