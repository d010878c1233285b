"""Foot flat and heel rise of feet that land on the heel, flat and on the toes, brisk and slow; refused ones count.

A generator of its own: it shares no code and no constant with ``sim_inputs/`` or :mod:`fes.simulation`. A stiff foot
turns about its toe until foot off, flies along polynomials, strikes with what is left of its speed, and turns about
what it landed on until it is flat; in stance it gives by a degree before its heel rises. Durations and pitch at contact
are drawn around what Perry and Burnfield (2010) give for adults, and around flat and forefoot contacts as they describe
them after stroke. The truth: foot flat is from when the pitch stays within 2° of standing until the heel rises, heel
rise is when the heel is 5 mm higher than before it rose. Bars, of each kind: T4 within 30 ms in the median and within
80 ms from 5 to 95 %, T1 at most 40 ms late in the median and 80 ms in 95 %, nobody refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from itertools import product
from math import radians

import numpy as np
from scipy.interpolate import BPoly
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from benchmarks.lib.command_line import parser_of, publish, spread, table_of, verdict
from benchmarks.lib.walkers import calibrate, causal
from fes.datasets.common import even_track
from fes.estimation.foot.calibration import CalibrationError
from fes.recording import Track
from fes.signals import FloatArray
from statemachine.phases import Transition

LANDINGS = {"heel": (11.0, 25.0), "flat": (-5.0, 5.0), "toe": (-18.0, -7.0)}  # pitch at contact, degrees, toe-up
PACES = {"brisk": (0.95, 1.25), "slow": (1.7, 2.8)}  # stride, s
STRIDES, STAND_S = 40, 3.0
FINE_HZ, RATE_HZ, G = 4000, 100, 9.81
FLAT_RAD, RISE_M = radians(2.0), 0.005
T4_MS, T4_SPREAD_MS, T1_MS, T1_LATEST_MS = 30.0, 80.0, 40.0, 80.0
LONGEST_MS = 500.0  # an instant further from the truth belongs to another stride


@dataclass
class Made:
    """A walk and its truth, s."""

    track: Track
    rise_s: list[float] = field(default_factory=list)
    contact_s: list[float] = field(default_factory=list)
    flat_s: list[float] = field(default_factory=list)


@dataclass
class Late:
    """Of the feet of one kind, ms."""

    feet: int = 0
    refused: int = 0
    strides: int = 0
    t1: list[float] = field(default_factory=list)
    t4: list[float] = field(default_factory=list)
    flat: list[float] = field(default_factory=list)
    left: list[float] = field(default_factory=list)

    def with_feet(self, other: Late) -> Late:
        return Late(*(getattr(self, each.name) + getattr(other, each.name) for each in fields(self)))


def walk(landing: str, pace: str, number: int) -> Made:
    """One foot's walk: x forward, z up, pitch toe-up."""
    random = np.random.default_rng([ord(landing[0]), ord(pace[0]), number])
    draw = random.uniform
    toe_m, heel_m = np.array([draw(0.10, 0.15), -0.07]), np.array([-draw(0.08, 0.12), -0.07])  # from the sensor
    cycle_s, lands, push = draw(*PACES[pace]), draw(*LANDINGS[landing]), draw(30.0, 55.0)
    swing_share, rise_share = draw(0.33, 0.42), draw(0.12, 0.20)
    loading_share = draw(0.07, 0.13) * (1.0 if landing == "heel" else 0.8)
    length_m, roll_on, strike = draw(0.5, 1.2) * min(1.2 / cycle_s, 1.0), draw(0.3, 1.5), draw(0.1, 0.5)
    lies_on = heel_m if lands > 0.0 else toe_m
    knots: list[tuple[float, list[float]]] = [(0.0, [0.0, 0.0, 0.0])]  # of the pitch: value, rate, acceleration
    rises, offs, contacts, flats, places = [], [], [], [], []
    now_s, x_m = STAND_S, 0.0
    for _ in range(STRIDES):
        vary = random.normal(1.0, 0.03, 6)
        rise_s, swing_s = cycle_s * rise_share * vary[0], cycle_s * swing_share * vary[1]
        loading_s, at_contact = cycle_s * loading_share * vary[2], radians(lands * vary[3] + random.normal(0.0, 0.8))
        stance_s = cycle_s * (1.0 - rise_share - swing_share - loading_share) * vary[4]
        pushed = radians(push * vary[5])
        knots.append((now_s, [-radians(roll_on), 0.0, 0.0]))
        knots.append((now_s + rise_s, [-pushed, -1.5 * pushed / rise_s, 0.0]))
        contact_s = now_s + rise_s + swing_s
        knots.append((contact_s, [at_contact, -0.7 * at_contact / loading_s, 0.0]))
        knots.append((contact_s + loading_s, [0.0, 0.0, 0.0]))
        rises.append(now_s)
        offs.append(now_s + rise_s)
        contacts.append(contact_s)
        flats.append(contact_s + loading_s)
        places.append(x_m)
        now_s, x_m = contact_s + loading_s + stance_s, x_m + length_m * random.normal(1.0, 0.03)
    knots.append((now_s, [0.0, 0.0, 0.0]))
    end_s = now_s + STAND_S
    knots.append((end_s, [0.0, 0.0, 0.0]))
    pitch_of = BPoly.from_derivatives([t for t, _ in knots], [value for _, value in knots])
    t_s = np.arange(0.0, end_s, 1.0 / FINE_HZ)
    pitch = pitch_of(t_s)

    def sensor(pivot: FloatArray, ground: FloatArray, at: FloatArray) -> FloatArray:
        """Where the sensor is while ``pivot`` of the foot is at ``ground`` (N, 2)."""
        c, s = np.cos(pitch_of(at)), np.sin(pitch_of(at))
        return ground - np.column_stack([c * pivot[0] - s * pivot[1], s * pivot[0] + c * pivot[1]])

    def ends(pivot: FloatArray, ground: FloatArray, at: float, drift: tuple[float, float]) -> FloatArray:
        """Place, speed and acceleration there (3, 2); the pivot itself moves by ``drift`` m/s."""
        near = at + np.array([-1e-3, 0.0, 1e-3])
        path = sensor(pivot, ground + np.outer(near - at, drift), near)
        return np.array([path[1], (path[2] - path[0]) / 2e-3, (path[2] - 2.0 * path[1] + path[0]) / 1e-6])

    def on_ground(x: float, pivot: FloatArray) -> FloatArray:
        return np.array([x + pivot[0], 0.0])

    path = np.empty((len(t_s), 2))
    x_now = 0.0
    stop_s = draw(0.012, 0.03)  # in which shoe and heel pad take up what is left of the speed
    spans = zip([0.0, *flats[:-1]], offs, contacts, [*flats[:-1], end_s], [*places[1:], x_m], strict=True)
    for flat_s, off, contact, until_s, x_next in spans:
        begin, first, last, end = (int(i) for i in np.searchsorted(t_s, (flat_s, off, contact, until_s)))
        path[begin:first] = sensor(toe_m, on_ground(x_now, toe_m), t_s[begin:first])
        left = ends(toe_m, on_ground(x_now, toe_m), off, (0.0, 0.0))
        drift = (strike * 0.5, -strike)
        land = on_ground(x_next, lies_on)
        sunk = land - 0.5 * stop_s * np.array(drift)
        right = ends(lies_on, sunk, contact, drift)
        high = 0.5 * (left[0] + right[0]) + [0.0, draw(0.02, 0.05)]
        speed = [1.6 * (right[0, 0] - left[0, 0]) / (contact - off), 0.0]
        for axis in (0, 1):
            flight = BPoly.from_derivatives(
                [off, 0.5 * (off + contact), contact], [left[:, axis], [high[axis], speed[axis]], right[:, axis]]
            )
            path[first:last, axis] = flight(t_s[first:last])
        after = t_s[last:end] - contact
        rest = np.minimum(after, stop_s)
        moved = np.outer(rest - 0.5 * rest**2 / stop_s, drift)
        path[last:end] = sensor(lies_on, sunk + moved, t_s[last:end])
        x_now = x_next
    made = Made(_track(random, t_s, path, pitch, contacts))
    flat = np.abs(pitch) <= FLAT_RAD
    for rise, off, contact, until in zip(rises, offs, contacts, [*rises[1:], end_s - STAND_S], strict=True):
        rising = slice(*np.searchsorted(t_s, (rise, off)).tolist())
        heel_up_m = (toe_m[0] - heel_m[0]) * np.sin(pitch[rising.start] - pitch[rising])
        made.rise_s.append(float(t_s[rising][np.argmax(heel_up_m >= RISE_M)]))
        made.contact_s.append(contact)
        landing_phase = slice(*np.searchsorted(t_s, (contact, until)).tolist())
        not_flat = np.flatnonzero(~flat[landing_phase])
        made.flat_s.append(float(t_s[landing_phase][not_flat[-1] + 1]) if len(not_flat) else contact)
    return made


def _track(
    random: np.random.Generator, t_s: FloatArray, path: FloatArray, pitch: FloatArray, contacts: list[float]
) -> Track:
    """What an IMU on it feels: strap and shoe ring after a contact, both axes are band-limited, noisy and biased."""
    dt = 1.0 / FINE_HZ
    force = np.column_stack([np.gradient(np.gradient(path[:, k], dt), dt) for k in (0, 1)])
    force[:, 1] += G
    c, s = np.cos(pitch), np.sin(pitch)
    acc = np.column_stack([c * force[:, 0] + s * force[:, 1], 0.0 * c, -s * force[:, 0] + c * force[:, 1]])
    ring_hz, fades_s, size = random.uniform(14.0, 28.0), random.uniform(0.015, 0.04), random.uniform(4.0, 20.0)
    for contact in contacts:
        after = np.clip(t_s - contact, 0.0, 12.0 * fades_s)
        here = (t_s >= contact) & (t_s < contact + 12.0 * fades_s)
        ring = np.exp(-after[here] / fades_s) * np.sin(2.0 * np.pi * ring_hz * after[here])
        acc[here] += size * np.outer(ring, random.normal(0.0, [0.4, 0.3, 0.8]))
    gyr = np.column_stack([0.0 * c, -np.gradient(pitch, dt), 0.0 * c])
    every = FINE_HZ // RATE_HZ
    acc, gyr = (gaussian_filter1d(each, 0.25 * every, axis=0)[::every] for each in (acc, gyr))
    mount = Rotation.from_euler("yxz", random.normal(0.0, [18.0, 8.0, 10.0]), degrees=True)
    acc = mount.inv().apply(acc) + random.normal(0.0, 0.15, 3) + random.normal(0.0, 0.05, acc.shape)
    gyr = mount.inv().apply(gyr) + random.normal(0.0, 0.005, 3) + random.normal(0.0, 0.008, gyr.shape)
    return even_track("right_foot", float(RATE_HZ), acc, gyr)


def judge(made: Made) -> Late:
    """One foot's delays; the first two strides, of a foot that nobody has seen walk, count as all others do."""
    late = Late(feet=1, strides=len(made.contact_s))
    try:
        changes, _ = causal(made.track, calibrate(made.track))
    except CalibrationError:
        late.refused = 1
        return late
    t_s = {
        which: np.array([1e-9 * (c.t_ns - made.track.t_ns[0]) for c in changes if c.transition is which] or [np.inf])
        for which in (Transition.T1, Transition.T4)
    }
    for name, which, true_s in (("t1", Transition.T1, made.rise_s), ("t4", Transition.T4, made.flat_s)):
        off = [1e3 * min(t_s[which] - true, key=abs) for true in true_s]
        getattr(late, name).extend(ms for ms in off if abs(ms) < LONGEST_MS)
        if name == "t4":
            late.flat += [min(max(ms, 0.0), LONGEST_MS) for ms in off]
            late.left += [min(max(-ms, 0.0), LONGEST_MS) for ms in off]
    return late


def holds(late: Late) -> bool:
    """All bars of one kind; an instant that was not found misses."""
    if late.refused or min(len(late.t1), len(late.t4)) < 0.95 * late.strides:
        return False
    low, middle, high = np.percentile(late.t4, (5, 50, 95))
    in_time = abs(middle) <= T4_MS and low >= -T4_SPREAD_MS and high <= T4_SPREAD_MS
    return bool(in_time and np.median(late.t1) <= T1_MS and np.percentile(late.t1, 95) <= T1_LATEST_MS)


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--feet", type=int, default=12, help="of each kind")
    options = parser.parse_args(arguments)
    rows, held = [], True
    for landing, pace in product(LANDINGS, PACES):
        late = Late()
        for number in range(options.feet):
            late = late.with_feet(judge(walk(landing, pace, number)))
        held &= holds(late)
        found = [f"{100.0 * len(each) / late.strides:.1f}" for each in (late.t1, late.t4)]
        cost = [f"{np.median(ms):.0f}, {np.percentile(ms, 95):.0f}" if ms else "–" for ms in (late.flat, late.left)]
        counts = (str(count) for count in (late.feet, late.refused, late.strides))
        times = spread(late.t1), found[0], spread(late.t4), found[1]
        rows.append([landing, pace, *counts, *times, *cost, "met" if holds(late) else "missed"])
    columns = (
        "landing", "pace", "feet", "refused", "strides", "T1 ms", "found %", "T4 ms", "found %",
        "flat foot stimulated, median, 95 % ms", "landing left, median, 95 % ms", "bars",
    )  # fmt: skip
    publish([table_of("", columns, rows)], options)
    return verdict(held)


if __name__ == "__main__":
    raise SystemExit(main())
