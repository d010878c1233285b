"""The compiled side of a foot's strides: from phase changes to where each begins and ends, and its numbers.

``fes.estimation.strides.results`` says what a stride is. What evolves is in one ``STRIDE_STATE`` record, so that live
(one sample) and analysis (many in one call) go the same way.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.closures import GAIN, RESIDUALS, SCALE, UPRIGHT_S, close_stride
from fes.estimation.numerics.jit import by_number, jit_ieee
from fes.estimation.numerics.records import core_type
from fes.estimation.numerics.rotation import to_world, without
from fes.estimation.strides.boundaries import (
    AROUND_S,
    NO_REST_RADPS,
    REST_RADPS,
    UNSEEN_NS,
    around_ends,
    index_at,
    mean_and_variance,
    quietest_of,
    stride_time_ns,
)
from fes.estimation.strides.integration import (
    BACKWARD,
    FREE_RISE,
    HEIGHT_CHANGE,
    LENGTH,
    LENGTH_SD,
    NO_REST,
    NUMBERS,
    PEAK_HEIGHT,
    RESIDUAL_RATE,
    SOLVED,
    TILT,
    TILTED,
    TURN,
    line_of,
    solve_span,
    stride_shape,
)
from fes.estimation.strides.schema import STRIDE
from fes.signals import MID_SWING_BEGIN, MID_SWING_END, NS_PER_S

STANCE_SEARCH_S = 1.0  # of a long stance only the second next to the swing is searched
STOPPED_SEARCH_S = 0.5  # of a stance that lasts longer than that the first half: a belt that stops carries the foot
STOPPED, LONGEST_STAND_S = 1.7, 3.5  # usual strides from a border to the heel rise: a foot that stopped; at most
LANDED_S = 0.1  # after contact the foot may be quiet
STANCE_LEAD_S = 0.03  # rest is known this late
DURATION_S = (0.4, 5.0)
LEAST_SAMPLES = 10
LONGEST_GAP_S = 0.04
TOE_LEAVES_BY = 0.1  # of the swing: a toe that has hardly gone by then left the ground later than foot off was seen
TOE_GONE = 0.02  # of its way: by so much forward it has left
TOE_LEFT = 0.1  # of its way still to go: it has as good as arrived
LEAST_TRAVEL_M = 0.1
NEVER_NS = 2**63 - 1
FORGOTTEN, NO_STRIDE_TIME, GAP = range(10, 13)  # what came of a stride that was not solved, beside the solution's words
STANCE, PRE_SWING, SWING, LOADING_RESPONSE = range(4)
_SEARCH_NS, _LEAD_NS = int(STANCE_SEARCH_S * NS_PER_S), int(STANCE_LEAD_S * NS_PER_S)
_AROUND_NS, _LANDED_NS = int(AROUND_S * NS_PER_S), int(LANDED_S * NS_PER_S)
_STOPPED_NS = int(STOPPED_SEARCH_S * NS_PER_S)
_SHORTEST_S, _LONGEST_S = DURATION_S
_stride_time_ns = jit_ieee(stride_time_ns)

STATE = np.dtype(
    [
        ("due_ns", np.int64),  # the stride under way is closed at this time at the latest
        ("start_ns", np.int64),  # where it begins: where the one before ended, unless the foot stopped
        ("before_ns", np.int64),  # the end of the stride before
        ("stance_ns", np.int64),
        ("times_ns", np.int64, 4),  # the entries into the phases since
        ("number", np.int64),
        ("chained_ns", np.int64),  # a border where gravity was not seen, …
        ("chained", np.float64, 4),  # … and the orientation there as the stride before ended in it
    ],
    align=True,
)


class SegmentationSettings(NamedTuple):
    """:class:`fes.estimation.strides.results.StrideSettings` for the compiler; ``known``: where toe and heel are."""

    forward_x: float
    forward_y: float
    forward_z: float
    up_x: float
    up_y: float
    up_z: float
    sensor_height_m: float
    constrained: bool
    incline: float  # of the stride under way
    next_incline: float  # in force from the next stride on
    known: bool
    toe_forward_m: float
    toe_up_m: float
    heel_forward_m: float
    heel_up_m: float
    toe_out_rad: float  # to the left positive


STRIDE_STATE = core_type(STATE, settings=SegmentationSettings)
STRIDES, ROWS, CHANGES = range(3)


class Out(NamedTuple):
    """What comes out: rows of strides, and what belongs to them; ``filled`` (3,) says how much of it is taken up."""

    strides: Any  # (S,) of ``STRIDE``
    shapes: (
        Any  # (S, K, 5) as :func:`fes.estimation.strides.integration.stride_shape` fills them; (0, K, 5): not wanted
    )
    t_ns: Any  # (R,) the strides' own samples, one stride after the other
    position: Any  # (R, 3) m from each stride's start
    quaternion: Any  # (R, 4)
    filled: Any  # STRIDES, ROWS, CHANGES (phase changes so far)


def new_out(strides: int, rows: int, points: int, *, shaped: bool = True) -> Out:
    """Room for so many strides of so many rows in all; to be emptied by setting ``filled`` to 0."""
    return Out(
        np.zeros(strides, np.dtype((np.record, STRIDE))),  # its fields as attributes without the compiler too
        np.empty((strides if shaped else 0, points, 5)),
        np.empty(rows, np.int64),
        np.empty((rows, 3)),
        np.empty((rows, 4)),
        np.zeros(3, np.int64),
    )


@jit_ieee
def _forget(times_ns: Any) -> None:
    """No phase has been entered."""
    for k in range(4):
        times_ns[k] = UNSEEN_NS


@jit_ieee
def restart(core: Any, t_ns: int) -> None:
    """Data were lost: forget the stride under way; stance from now on."""
    state = core[0].state
    state.due_ns, state.before_ns, state.start_ns, state.stance_ns = NEVER_NS, UNSEEN_NS, UNSEEN_NS, t_ns
    state.chained_ns = UNSEEN_NS
    _forget(state.times_ns)


@jit_ieee
def on_phase(core: Any, destination: int, t_ns: int) -> None:
    """Note a phase change, after :func:`close` and :func:`begin` for T1."""
    state = core[0].state
    if destination != STANCE:
        state.times_ns[destination] = t_ns
        return
    state.stance_ns = t_ns
    if state.times_ns[SWING] != UNSEEN_NS:
        state.times_ns[STANCE] = t_ns
        state.due_ns = t_ns + _SEARCH_NS
    else:  # the heel was lifted and put back: no stride
        _forget(state.times_ns)


@jit_ieee
def begin(core: Any, n: int, t_ns: Any, gyr: Any, biases: Any, stride_s: float) -> None:
    """T1: the next stride begins where the last one ended; after a stop at the quietest instant of the last second.

    Where that is hardly after the first sample since data were lost, and the foot turns there, it came out of a swing
    that nobody saw: no stride begins. ``stride_s`` is this person's usual stride time; else as for :func:`close`.
    """
    state, settings = core[0].state, core[0].settings
    settings.incline = settings.next_incline  # here alone, so that one stride knows one ground
    now = t_ns[n - 1]
    if state.start_ns == UNSEEN_NS or now - state.start_ns > _stop_ns(stride_s):
        earliest = max(state.stance_ns - _LEAD_NS, now - _SEARCH_NS)
        bx, by, bz = biases[1, 0], biases[1, 1], biases[1, 2]
        first = quietest_of(t_ns, gyr, n, bx, by, bz, earliest, now)
        turns = (gyr[first, 0] - bx) ** 2 + (gyr[first, 1] - by) ** 2 + (gyr[first, 2] - bz) ** 2 > REST_RADPS**2
        unseen = t_ns[first] - t_ns[0] < _AROUND_NS and turns
        state.start_ns = UNSEEN_NS if unseen else t_ns[first]
    _forget(state.times_ns)


@jit_ieee
def _stop_ns(stride_s: float) -> float:
    """A foot whose heel does not rise for so long after a border has stopped."""
    return 1e9 * min(STOPPED * stride_s, LONGEST_STAND_S)


@jit_ieee
def close(core: Any, n: int, t_ns: Any, gyr: Any, biases: Any, stride_s: float, out: Out) -> tuple[int, int]:
    """End the stride that ended with this stance, if there was one, with a row of ``out``; the next begins there.

    A stance in which the foot turns fast all the time is none: the stride goes on to the next.

    Args:
        core: (1,) of ``STRIDE_STATE``.
        n: how many rows of the history there are up to now.
        t_ns: its time stamps.
        gyr: (…, 3) rad/s.
        biases: (2, 3) of the accelerometer and of the gyroscope.
        stride_s: this person's usual stride time.
        out: where the stride goes.

    Returns:
        Its first and last row for :func:`solve_rows`, (0, 0) where there is nothing to solve.
    """
    state = core[0].state
    start_ns, stance_ns, contact_ns = state.start_ns, state.times_ns[STANCE], state.times_ns[LOADING_RESPONSE]
    state.due_ns = NEVER_NS
    if start_ns == UNSEEN_NS or stance_ns == UNSEEN_NS:
        _forget(state.times_ns)
        return 0, 0
    now = t_ns[n - 1]
    still_standing = now - state.stance_ns >= _SEARCH_NS
    latest = min(now, state.stance_ns + (_STOPPED_NS if still_standing else _SEARCH_NS))
    bx, by, bz = biases[1, 0], biases[1, 1], biases[1, 2]
    earliest = state.stance_ns - _LEAD_NS
    if contact_ns != UNSEEN_NS:
        earliest = max(min(earliest, contact_ns + _LANDED_NS), contact_ns)
    last = quietest_of(t_ns, gyr, n, bx, by, bz, earliest, latest)
    first = index_at(t_ns, 0, n, start_ns)
    if now - start_ns <= _stop_ns(stride_s) and first < last:
        around = around_ends(t_ns, first, last)
        x, y, z, _, _, _ = mean_and_variance(gyr, max(last - around, 0), min(last + around + 1, n))
        if math.sqrt((x - bx) ** 2 + (y - by) ** 2 + (z - bz) ** 2) > NO_REST_RADPS:
            _forget(state.times_ns)
            return 0, 0
    state.start_ns = t_ns[last]
    state.number += 1
    row = out.strides[out.filled[STRIDES]]
    row.number, row.t_start_ns, row.t_end_ns = state.number, start_ns, t_ns[last]
    row.t_pre_swing_ns, row.t_swing_ns = state.times_ns[PRE_SWING], state.times_ns[SWING]
    row.t_loading_response_ns, row.t_stance_ns = state.times_ns[LOADING_RESPONSE], stance_ns
    row.rows, row.changes = 0, out.filled[CHANGES]
    _forget(state.times_ns)
    out.filled[STRIDES] += 1
    if first >= last or t_ns[first] != start_ns:
        row.outcome = FORGOTTEN
        return 0, 0
    return first, last


@jit_ieee
def solve_rows(
    core: Any, first: int, last: int, n: int, t_ns: Any, acc: Any, gyr: Any, start: Any, biases: Any, out: Out
) -> None:
    """Integrate the samples ``first`` … ``last`` of a history into the newest row of ``out``.

    ``acc`` (…, 3) m/s²; ``start`` (4,) is the orientation at ``first``, unless it is known better (:func:`chain`); else
    as :func:`close`.
    """
    chained, known = core[0].state.chained_ns == t_ns[first], np.empty(4)
    for k in range(4):
        known[k] = core[0].state.chained[k] if chained else start[k]
    row, before_ns = out.strides[out.filled[STRIDES] - 1], core[0].state.before_ns
    core[0].state.before_ns = row.t_end_ns
    settings = core[0].settings
    fx, fy, fz = settings.forward_x, settings.forward_y, settings.forward_z
    count, most_ns = last + 1 - first, 0
    for i in range(first, last):
        most_ns = max(most_ns, t_ns[i + 1] - t_ns[i])
    row.gap_s = 1e-9 * most_ns
    duration_s = 1e-9 * (t_ns[last] - t_ns[first])
    if count < LEAST_SAMPLES or not _SHORTEST_S <= duration_s <= _LONGEST_S:
        row.outcome = NO_STRIDE_TIME
        return
    if row.gap_s > LONGEST_GAP_S and row.gap_s > 3.5e-9 * _usual_step(t_ns, first, last):
        row.outcome = GAP
        return
    k, at = out.filled[STRIDES] - 1, out.filled[ROWS]
    row.first, row.rows = at, count
    out.filled[ROWS] = at + count
    for i in range(count):  # not as slices: their check of shapes would take a second to compile
        out.t_ns[at + i] = t_ns[first + i]
    position, quaternion = out.position[at : at + count], out.quaternion[at : at + count]
    around = around_ends(t_ns, first, last)
    begin, end = max(first - around, 0), min(last + around + 1, n)
    if k < out.shapes.shape[0]:
        wide = 2 + int(UPRIGHT_S * (last - first) / duration_s)
        low, high = max(first - wide, 0), min(last + wide + 1, n)
        _left_over(row, t_ns[low:high], acc[low:high], gyr[low:high], first - low, last - low)
    numbers = np.empty(NUMBERS)
    for i in range(NUMBERS):
        numbers[i] = 0.0
    row.outcome = solve_span(
        t_ns[begin:end], without(acc[begin:end], biases[0]), without(gyr[begin:end], biases[1]),
        first - begin, last - begin, known, fx, fy, fz, settings.sensor_height_m, settings.constrained,
        settings.incline, quaternion, position, numbers,
    )  # fmt: skip
    row.tilt_rad, row.residual_rate_radps, row.stride_length_m = numbers[TILT], numbers[RESIDUAL_RATE], numbers[LENGTH]
    row.clearance_m, row.turn_rad, row.height_gained_m = numbers[PEAK_HEIGHT], numbers[TURN], numbers[HEIGHT_CHANGE]
    if row.outcome != SOLVED:
        return
    if k < out.shapes.shape[0]:
        ux, uy, uz = settings.up_x, settings.up_y, settings.up_z
        stride_shape(
            out.t_ns[at : at + count], quaternion, position, fx, fy, fz, ux, uy, uz, settings.toe_out_rad, out.shapes[k]
        )
    row.stride_length_sd_m, row.free_rise_m = numbers[LENGTH_SD], numbers[FREE_RISE]
    row.speed_mps = row.stride_length_m * NS_PER_S / _stride_time_ns(row.t_start_ns, row.t_end_ns, before_ns)
    row.toe_clearance_m = row.heel_clearance_m = math.nan
    if settings.known:
        _toe_and_heel(settings, row, out.t_ns[at : at + count], position, quaternion)


@jit_ieee
def _left_over(row: Any, t_ns: Any, acc: Any, gyr: Any, first: int, last: int) -> None:
    """What a sound sensor would have left over of the stride between two rows (:mod:`fes.estimation.closures`)."""
    n = t_ns.shape[0]
    t_s, sensor, axes, found = np.empty(n), np.empty(6), np.empty((3, 3)), np.empty(RESIDUALS)
    for i in range(n):
        t_s[i] = 1e-9 * (t_ns[i] - t_ns[0])
    for i in range(6):
        sensor[i] = 1.0 if i in (GAIN, SCALE) else 0.0
    for i in range(3):
        for k in range(3):
            axes[i, k] = 1.0 if i == k else 0.0
    close_stride(t_s, acc, gyr, first, last, sensor, axes, found)
    row.left_forward_mps, row.left_sideways_mps, row.left_up_mps = found[0], found[1], found[2]
    row.left_height_m, row.left_pitch, row.left_roll = found[3], found[4], found[5]


@jit_ieee
def chain(core: Any, out: Out) -> None:
    """The next stride begins with the orientation in which the newest one ended: no gravity was seen in its stance.

    What its solution found wrong would be lost otherwise, for the filter knows nothing of it.
    """
    row, state = out.strides[out.filled[STRIDES] - 1], core[0].state
    if row.outcome in (SOLVED, TILTED, NO_REST, BACKWARD):
        state.chained_ns = row.t_end_ns
        for k in range(4):
            state.chained[k] = out.quaternion[row.first + row.rows - 1, k]


@jit_ieee
def _usual_step(t_ns: Any, first: int, last: int) -> float:
    """The median time between the samples ``first`` … ``last``, in ns."""
    n = last - first
    steps = np.empty(n, np.int64)
    for i in range(n):  # by insertion: they hardly differ, and this is rare
        step, j = t_ns[first + i + 1] - t_ns[first + i], i
        while j > 0 and steps[j - 1] > step:
            steps[j] = steps[j - 1]
            j -= 1
        steps[j] = step
    usual: float = 0.5 * (steps[n // 2] + steps[(n - 1) // 2])
    return usual


@by_number
@jit_ieee
def _toe_and_heel(settings: Any, row: Any, t_ns: Any, position: Any, quaternion: Any) -> None:
    """Least height of the toe in mid-swing and greatest of the heel (m), above where they stood and over the line from
    stance to stance; NaN if unknown.

    Mid-swing is the middle of the time from foot off to contact: the toe leaves the ground and, after its first peak,
    passes low once more before it rises for the contact. Where the toe still stands a tenth of the swing after its
    entry, as of a slow foot whose push-off stimulation holds back, foot off is when it goes forward; where no contact
    was seen, contact is when it has as good as arrived.
    """
    off_ns = row.t_swing_ns
    contact_ns = row.t_stance_ns if row.t_loading_response_ns == UNSEEN_NS else row.t_loading_response_ns
    swung = off_ns != UNSEEN_NS and contact_ns != UNSEEN_NS
    last = t_ns.shape[0] - 1
    nx, ny = line_of(position, 0, last)
    lean = 0.0
    if settings.incline != 0.0:
        q = quaternion[0]
        ahead = to_world(q[0], q[1], q[2], q[3], settings.forward_x, settings.forward_y, settings.forward_z)[2]
        lean = math.atan2(position[last, 2], math.hypot(position[last, 0], position[last, 1])) - math.asin(ahead)
    c, s = math.cos(lean), math.sin(lean)  # calibrated on level ground or on the slope, the sole lies on the slope
    toe_forward, toe_up = (
        c * settings.toe_forward_m - s * settings.toe_up_m,
        c * settings.toe_up_m + s * settings.toe_forward_m,
    )
    heel_forward, heel_up = (
        c * settings.heel_forward_m - s * settings.heel_up_m,
        c * settings.heel_up_m + s * settings.heel_forward_m,
    )
    if swung:
        leaves_ns, arrives_ns = _toe_goes_ns(settings, t_ns, position, quaternion, toe_forward, toe_up)
        if row.t_loading_response_ns == UNSEEN_NS and arrives_ns > off_ns:
            contact_ns = arrives_ns
        if leaves_ns - off_ns > TOE_LEAVES_BY * (contact_ns - off_ns) and leaves_ns < contact_ns:
            off_ns = leaves_ns
    lasts_ns = contact_ns - off_ns
    begin, end = off_ns + MID_SWING_BEGIN * lasts_ns, off_ns + MID_SWING_END * lasts_ns
    toe_start = heel_start = 0.0
    least, most = math.inf, -math.inf
    for i in range(t_ns.shape[0]):
        w, x, y, z = quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3]
        fx, fy, fz = to_world(w, x, y, z, settings.forward_x, settings.forward_y, settings.forward_z)
        ux, uy, uz = to_world(w, x, y, z, settings.up_x, settings.up_y, settings.up_z)
        forward, up = fz + nx * fx + ny * fy, uz + nx * ux + ny * uy
        sensor = position[i, 2] + nx * position[i, 0] + ny * position[i, 1]
        toe = sensor + toe_forward * forward + toe_up * up
        heel = sensor + heel_forward * forward + heel_up * up
        if i == 0:
            toe_start, heel_start = toe, heel
        most = max(most, heel - heel_start)
        if swung and begin <= t_ns[i] < end:
            least = min(least, toe - toe_start)
    row.heel_clearance_m = most if most > -math.inf else math.nan
    if least < math.inf:
        row.toe_clearance_m = least


@jit_ieee
def _toe_goes_ns(settings: Any, t_ns: Any, position: Any, quaternion: Any, toe_forward: float, toe_up: float) -> Any:
    """When the toe has gone forward by ``TOE_GONE`` of its way for good, and when it has ``TOE_LEFT`` to go at most;
    the first sample for both where it hardly goes."""
    n = t_ns.shape[0]
    dx, dy = position[n - 1, 0], position[n - 1, 1]
    length = math.hypot(dx, dy)
    if length <= 0.0:
        return t_ns[0], t_ns[0]
    along = np.empty(n)
    for i in range(n):
        w, x, y, z = quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3]
        fx, fy, _ = to_world(w, x, y, z, settings.forward_x, settings.forward_y, settings.forward_z)
        ux, uy, _ = to_world(w, x, y, z, settings.up_x, settings.up_y, settings.up_z)
        forward = position[i, 0] + toe_forward * fx + toe_up * ux
        aside = position[i, 1] + toe_forward * fy + toe_up * uy
        along[i] = (dx * forward + dy * aside) / length
    way = along[n - 1] - along[0]
    if way <= LEAST_TRAVEL_M:
        return t_ns[0], t_ns[0]
    leaves, arrives = 0, n - 1
    for i in range(n):
        gone = along[i] - along[0]
        if gone <= TOE_GONE * way:
            leaves = i
        if arrives == n - 1 and gone >= (1.0 - TOE_LEFT) * way:
            arrives = i
    return t_ns[leaves], t_ns[arrives]
