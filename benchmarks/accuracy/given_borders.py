"""A stride between borders that are given from elsewhere, solved as the trackers solve their own."""

from __future__ import annotations

import numpy as np

from fes.estimation.numerics.records import new_core
from fes.estimation.strides import segmentation
from fes.estimation.strides.boundaries import QUIET_WINDOW_S, UNSEEN_NS, quietest_of
from fes.estimation.strides.results import TRAJECTORY_POINTS, StrideMaker, StrideSettings
from fes.estimation.strides.segmentation import new_out
from fes.signals import FloatArray, IntArray, StrideResult
from statemachine.phases import Phase

NO_BIASES = np.zeros((2, 3))
NEAR_S = 0.05  # of a stance's instant given from elsewhere, the quietest is sought this far on either side
ENTRIES = [f"t_{phase.name.lower()}_ns" for phase in Phase]


def solve_stride(
    foot: str,
    number: int,
    times: dict[Phase, int],
    first: int,
    last: int,
    t_ns: IntArray,
    acc: FloatArray,
    gyr: FloatArray,
    start_quaternion: FloatArray,
    settings: StrideSettings,
    before_ns: int | None = None,
) -> StrideResult:
    """Integrate the samples ``first`` … ``last`` of a history into a stride's numbers.

    ``acc`` (N, 3) m/s² and ``gyr`` (N, 3) rad/s free of bias; ``start_quaternion`` (4,) the orientation at ``first``;
    ``times`` the entries into the phases; ``before_ns`` where the stride before ended, for the speed. Source: Negård
    et al. (2005), Eq. (14)–(20), see ``fes.estimation.strides.integration`` (method "constrained"), weighed as in
    ``fes.estimation.strides.maximum_likelihood`` (method "maximum_likelihood").
    """
    out = new_out(1, len(t_ns), TRAJECTORY_POINTS)
    row = out.strides[0]
    row["number"], row["t_start_ns"], row["t_end_ns"] = number, t_ns[first], t_ns[last]
    for name, phase in zip(ENTRIES, Phase, strict=True):
        row[name] = times.get(phase, UNSEEN_NS)
    out.filled[segmentation.STRIDES] = 1
    own = new_core(segmentation.STRIDE_STATE, settings=settings.compiled(foot))
    segmentation.restart(own, 0)
    own["state"]["before_ns"] = UNSEEN_NS if before_ns is None else before_ns
    segmentation.solve_rows(own, first, last, len(t_ns), t_ns, acc, gyr, start_quaternion, NO_BIASES, out)
    return StrideMaker(foot, settings).stride_in(out)


def quietest(t_ns: IntArray, gyr: FloatArray, earliest_ns: int, latest_ns: int) -> int:
    """Index of the middle of the tenth of a second with the least gyroscope energy between two times."""
    return int(quietest_of(t_ns, gyr, len(t_ns), 0.0, 0.0, 0.0, earliest_ns, latest_ns))


def quietest_near(t_ns: IntArray, gyr: FloatArray, at_ns: int) -> int:
    """Index of the quietest instant within ±50 ms of a stance's instant that is known from elsewhere."""
    reach_ns = int(1e9 * (NEAR_S + 0.5 * QUIET_WINDOW_S))
    return quietest(t_ns, gyr, at_ns - reach_ns, at_ns + reach_ns)
