"""A stride's path by itself, and many as an analysis keeps them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fes.estimation.clearance.clearance import FootPaths
from fes.estimation.numerics.rotation import quaternions_of, rotate_all
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.signals import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class FootPath:
    """One stride's path at its own samples.

    ``position_m`` (N, 3): the sensor, z up, origin at the start, where the foot is flat; ``axes`` (N, 3, 3): columns
    are the foot's forward, left and up in the world; ``foot_off_ns`` and ``contact_ns``: the swing, None if unseen.
    """

    number: int
    t_ns: IntArray
    position_m: FloatArray
    axes: FloatArray
    foot_off_ns: int | None
    contact_ns: int | None


def each_path(paths: FootPaths) -> list[FootPath]:
    """The paths, one by one."""
    axes = np.stack([rotate_all(paths.quaternion, axis) for axis in paths.foot.T], axis=2)
    return [
        FootPath(
            number, paths.t_ns[a:b], paths.position_m[a:b], axes[a:b],
            None if off == UNSEEN_NS else off, None if contact == UNSEEN_NS else contact,
        )
        for number, (a, b), (off, contact) in zip(
            paths.numbers.tolist(), paths.spans.tolist(), paths.swings_ns.tolist(), strict=True
        )
    ]  # fmt: skip


def join_paths(paths: Sequence[FootPath]) -> FootPaths:
    """The same paths as one :class:`FootPaths`."""
    counts = np.array([len(path.t_ns) for path in paths], dtype=np.int64)
    ends = np.cumsum(counts)
    swings = [UNSEEN_NS if at is None else at for path in paths for at in (path.foot_off_ns, path.contact_ns)]
    return FootPaths(
        np.array([path.number for path in paths], dtype=np.int64),
        np.column_stack((ends - counts, ends)),
        np.array(swings, dtype=np.int64).reshape(len(paths), 2),
        np.concatenate([np.zeros(0, np.int64), *(path.t_ns for path in paths)]),
        np.concatenate([np.zeros((0, 3)), *(path.position_m for path in paths)]),
        quaternions_of(np.concatenate([np.zeros((0, 3, 3)), *(path.axes for path in paths)])),
        np.eye(3),
    )
