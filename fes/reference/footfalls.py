"""Footfalls of an instrumented mat or of measured footprints → events and strides.

A mat's stride length is the way between successive contacts of the same foot, whatever the direction (the distance of
heel to heel); that of a walk with turns is measured along straight lines as well.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from fes.reference.types import Reference, ReferenceError, ReferenceEvent, ReferenceStride
from fes.signals import FloatArray

LONGEST_STRIDE_S = 4.0  # beyond: the walker left the mat and came back


def footfalls(
    source: str,
    feet: list[str],
    contact_s: FloatArray,
    off_s: FloatArray | None,
    place_m: FloatArray | None,
    length_m: FloatArray | None = None,
) -> Reference:
    """Events and strides of K footfalls, in any order.

    Args:
        source: the file, for messages.
        feet: whose each is.
        contact_s: (K,) initial contact, or any one moment at which the foot stood there.
        off_s: (K,) foot off, if known.
        place_m: (K, 2) where each lies, if known.
        length_m: (K,) stride length that ends with this footfall, if the mat says so itself.

    Raises:
        ReferenceError: a contact's time is missing, or a foot leaves before it came.
    """
    if not np.isfinite(contact_s).all():
        raise ReferenceError(
            f"{source}: footfall {int(np.flatnonzero(~np.isfinite(contact_s))[0]) + 1} has no time of contact"
        )
    if off_s is not None and (off_s <= contact_s).any():
        raise ReferenceError(
            f"{source}: footfall {int(np.flatnonzero(off_s <= contact_s)[0]) + 1} leaves before it came"
        )
    events, strides = [], []
    whose = np.array(feet)
    for foot in dict.fromkeys(feet):
        mine = np.flatnonzero(whose == foot)
        mine = mine[np.argsort(contact_s[mine], kind="stable")]
        events += [ReferenceEvent(float(contact_s[k]), foot, "IC") for k in mine]
        if off_s is not None:
            events += [ReferenceEvent(float(off_s[k]), foot, "FO") for k in mine if np.isfinite(off_s[k])]
        for before, after in pairwise(mine.tolist()):
            if not 0.0 < contact_s[after] - contact_s[before] <= LONGEST_STRIDE_S:
                continue
            values = {}
            if length_m is not None and np.isfinite(length_m[after]):
                values["stride_length_m"] = float(length_m[after])
            elif place_m is not None:
                values["stride_length_m"] = float(np.hypot(*(place_m[after] - place_m[before])))
            strides.append(ReferenceStride(foot, float(contact_s[before]), float(contact_s[after]), values))
    strides.sort(key=lambda stride: stride.t_start_s)
    return Reference((source,), tuple(sorted(events)), tuple(strides))
