"""A virtual day of two feet, with truth: bouts of walking with turns, stairs and slopes among lying, sitting, standing,
cycling and driving. Nothing of the product is used, and no constant of it: a body goes along a path, footprints are set
beside it, a foot swings from print to print and rolls over heel and toe; what a sensor would show follows from that.

Figures of gait are textbook ones (Winter 2009; Perry & Burnfield 2010): stance 60 % of a stride, the foot 20° toe-up at
contact, 62° toe-down after foot off, a stair of 0.17 by 0.29 m; bicycle cranks of 0.17 m.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

RATE_HZ = 100
FINE = 4  # fine samples a sample
FINE_HZ = RATE_HZ * FINE
GRAVITY = 9.81
FEET = ("left_foot", "right_foot")
AXES = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")
# percent of the stride after contact, degrees of the foot, toe-up positive
ROLL = ((0, 20), (7, 4), (12, 0), (36, 0), (48, -14), (60, -52), (66, -62), (80, -12), (90, 14), (97, 21), (100, 20))
ANGLE = PchipInterpolator(*np.array(ROLL, float).T)
STANCE = 0.60
FROM_TOE, FROM_HEEL = (-0.13, 0.07), (0.11, 0.07)  # where the sensor is from the pivots, ahead and up, m
HALF_WIDTH_M = 0.09
TREAD_M, RISE_M = 0.29, 0.17


@dataclass(frozen=True)
class TrueTurn:
    begin_s: float
    end_s: float
    angle_rad: float


@dataclass(frozen=True)
class TrueBout:
    """``terrain``: (begin_s, end_s, kind) of each stretch."""

    begin_s: float
    end_s: float
    strides: dict[str, list[tuple[float, float, float]]]  # by foot: contact to contact, s, and length, m
    turns: list[TrueTurn]
    terrain: list[tuple[float, float, str]]


@dataclass
class TrueDay:
    hours: float = 0.0
    bouts: list[TrueBout] = field(default_factory=list)
    activities: list[tuple[float, float, str]] = field(default_factory=list)


Block = dict[str, np.ndarray]  # by foot: (N, 6) at RATE_HZ, acc m/s², gyr rad/s


def _sensed(place: np.ndarray, pitch: np.ndarray, yaw: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """(N, 6) of a foot that is at ``place`` (M, 3), turned by yaw, roll, pitch (toe-up positive), all at FINE_HZ."""
    dt = 1.0 / FINE_HZ
    smooth = [gaussian_filter1d(one, 8.0, axis=0, mode="nearest") for one in (place, pitch, yaw, roll)]
    place, pitch, yaw, roll = smooth
    acc = np.gradient(np.gradient(place, dt, axis=0), dt, axis=0) + np.array([0.0, 0.0, GRAVITY])
    cp, sp, cy, sy, cr, sr = (f(a) for a in (-pitch, yaw, roll) for f in (np.cos, np.sin))
    x = cy * acc[:, 0] + sy * acc[:, 1]
    y0 = -sy * acc[:, 0] + cy * acc[:, 1]
    y = cr * y0 + sr * acc[:, 2]
    z0 = -sr * y0 + cr * acc[:, 2]
    ahead, up = cp * x - sp * z0, sp * x + cp * z0
    rates = [np.gradient(a, dt) for a in (-pitch, yaw, roll)]
    # of R = Rz(yaw) Rx(roll) Ry(-pitch), in the foot's own frame
    gx = rates[2] * cp - rates[1] * cr * sp
    gy = rates[0] + rates[1] * sr
    gz = rates[2] * sp + rates[1] * cr * cp
    return np.column_stack((ahead, y, up, gx, gy, gz))[::FINE]


def _minimum_jerk(u: np.ndarray) -> np.ndarray:
    u = np.clip(u, 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


def walking(
    rng: np.random.Generator, legs: list[tuple[str, float, float]], stride_s: float, length_m: float
) -> tuple[Block, TrueBout]:
    """A bout along ``legs``: (kind, strides, turn of it in rad); kind: level, up, down (stairs), slope_up, slope_down.

    A leg that turns does so evenly. Begins and ends standing for a second.
    """
    lead_s = 1.0
    t, x, y, z, heading = lead_s, 0.0, 0.0, 0.0, 0.0
    steps: list[tuple[float, float, float, float, float, int]] = []  # swing's begin, contact, x, y, z, heading…
    half = 0.5 * stride_s
    turns, terrain, yaw_at = [], [], []
    number = 0
    for kind, strides, turn in legs:
        begin = t
        pace = {"up": 2 * TREAD_M / length_m, "down": 2 * TREAD_M / length_m}.get(kind, 1.0)
        count = max(round(2 * strides), 1)
        for _ in range(count):
            own = half * (1.0 + 0.02 * rng.normal()) * (1.1 if kind in ("up", "down") else 1.0)
            step = 0.5 * length_m * pace * (1.0 + 0.03 * rng.normal() * (pace == 1.0))
            heading += turn / count
            x, y = x + step * math.cos(heading), y + step * math.sin(heading)
            z += {"up": RISE_M, "down": -RISE_M, "slope_up": 0.08 * step, "slope_down": -0.08 * step}.get(kind, 0.0)
            t += own
            # contact of this step; its swing began 0.4 strides before
            steps.append((t - (1.0 - STANCE) * 2.0 * own, t, x, y, z, number % 2))
            yaw_at.append(heading)
            number += 1
        terrain.append((begin, t, kind))
        if abs(turn) > 0.3:
            turns.append(TrueTurn(begin, t, turn))
    last = steps[-1]
    steps.append((last[1] + 0.1, last[1] + 0.1 + 0.4 * stride_s, x, y, z, number % 2))  # the other foot closes up
    yaw_at.append(heading)
    end = steps[-1][1] + lead_s
    m = int(end * FINE_HZ) // FINE * FINE
    clock = np.arange(m) / FINE_HZ
    block, strides_of = {}, {}
    for side, foot in enumerate(FEET):
        lateral = HALF_WIDTH_M * (1 - 2 * side)
        place = np.zeros((m, 3))
        place[:, 1] = lateral
        pitch, yaw = np.zeros(m), np.zeros(m)
        before, before_yaw = np.array([0.0, lateral, 0.0]), 0.0
        contacts: list[tuple[float, np.ndarray]] = []
        for (off, contact, sx, sy, sz, which), now_yaw in zip(steps, yaw_at, strict=True):
            if which != side:
                continue
            to = np.array([sx - lateral * math.sin(now_yaw), sy + lateral * math.cos(now_yaw), sz])
            swing = contact - off
            own = swing / (1.0 - STANCE)
            rows = slice(int((off - 0.30 * own) * FINE_HZ), int((contact + 0.25 * own) * FINE_HZ))
            share = 100.0 * (1.0 + (clock[rows] - contact) / own)
            went = min(float(np.hypot(*(to - before)[:2])) / (0.8 * length_m), 1.0)
            angles = ANGLE(np.where(share < 100.0, share, share - 100.0))
            flat_before, flat_after = share < 36.0, share >= 112.0
            angles[flat_before | flat_after] = 0.0
            pitch[rows] = np.radians(angles) * (0.35 + 0.65 * went)
            u = _minimum_jerk((clock - off) / swing)[:, None]
            place = np.where(clock[:, None] >= off, before + u * (to - before), place)
            lift = np.clip((clock - off) / swing, 0.0, 1.0)
            climb = 0.12 if abs(to[2] - before[2]) > 0.15 else 0.03
            place[:, 2] += np.where((clock > off) & (clock < contact), climb * np.sin(np.pi * lift) ** 2, 0.0)
            yaw = np.where(clock >= off, before_yaw + u[:, 0] * (now_yaw - before_yaw), yaw)
            contacts.append((contact, to))
            before, before_yaw = to, now_yaw
        for k in range(2):
            lever = np.where((pitch < 0.0)[:, None], FROM_TOE, FROM_HEEL)
            if k == 0:
                along = lever[:, 0] * (np.cos(pitch) - 1.0) - lever[:, 1] * np.sin(pitch)
                upward = lever[:, 0] * np.sin(pitch) + lever[:, 1] * (np.cos(pitch) - 1.0)
                place[:, 0] += along * np.cos(yaw)
                place[:, 1] += along * np.sin(yaw)
                place[:, 2] += upward
        sensed = _sensed(place, pitch, yaw, np.zeros(m))
        for contact, _ in contacts:  # the shock of contact
            k = int(contact * RATE_HZ)
            ring = np.exp(-np.arange(6) / 1.5) * np.array([6, -5, 4, -3, 2, -1]) * rng.uniform(0.7, 1.3)
            room = min(6, len(sensed) - k)
            sensed[k : k + room, 2] += ring[:room]
            sensed[k : k + room, 0] -= 0.6 * ring[:room]
        block[foot] = sensed
        strides_of[foot] = [(a[0], b[0], float(np.hypot(*(b[1] - a[1])[:2]))) for a, b in pairwise(contacts)]
    return block, TrueBout(steps[0][0], steps[-1][1], strides_of, turns, terrain)


def resting(rng: np.random.Generator, kind: str, seconds: float) -> Block:
    """Something that is no walking: lying, sitting, fidgeting, standing, stepping aside, cycling, driving."""
    m = int(seconds * FINE_HZ) // FINE * FINE
    t = np.arange(m) / FINE_HZ
    block = {}
    cadence = rng.uniform(0.9, 1.5)
    for side, foot in enumerate(FEET):
        place, pitch, yaw, roll = np.zeros((m, 3)), np.zeros(m), np.zeros(m), np.zeros(m)
        if kind == "cycling":
            wheel = 2.0 * np.pi * cadence * t + np.pi * side + 0.15 * np.sin(2 * np.pi * t / 17.0)
            going = _minimum_jerk(t / 5.0) * _minimum_jerk((t[-1] - t) / 5.0)
            place[:, 0], place[:, 2] = 0.17 * going * np.cos(wheel), 0.17 * going * np.sin(wheel)
            pitch = -0.25 * going + 0.30 * going * np.sin(wheel + 0.8)
        elif kind == "driving":
            if side:  # pedals
                for at in np.arange(5.0, seconds - 5.0, 7.0) + rng.uniform(
                    -2, 2, len(np.arange(5.0, seconds - 5.0, 7.0))
                ):
                    pressed = _minimum_jerk((t - at) / 0.4) - _minimum_jerk((t - at - rng.uniform(1, 4)) / 0.4)
                    pitch += -0.25 * pressed
                    yaw += 0.3 * pressed
        elif kind == "lying":
            roll += 1.2 * (1 - 2 * side)
            pitch -= 0.5
            for at in rng.uniform(0, seconds, int(seconds / 400) + 1):
                turned = _minimum_jerk((t - at) / rng.uniform(0.8, 2.0))
                roll += rng.uniform(-1.5, 1.5) * turned
                place += rng.uniform(-0.2, 0.2, 3) * turned[:, None]
        elif kind in ("sitting", "fidgeting"):
            every = 90.0 if kind == "sitting" else 12.0
            for at in rng.uniform(3, max(seconds - 12, 4), int(seconds / every) + 1):
                what, lasts = rng.integers(4), rng.uniform(3.0, 9.0)
                on = _minimum_jerk((t - at) / 0.5) * _minimum_jerk((at + lasts - t) / 0.5)
                if what == 0:  # bouncing heel
                    pitch -= 0.12 * on * (1 + np.sin(2 * np.pi * rng.uniform(3.5, 6.0) * t))
                elif what == 1:  # swinging the crossed leg from the knee
                    angle = 0.35 * on * np.sin(2 * np.pi * rng.uniform(0.8, 1.4) * t)
                    pitch += angle
                    place[:, 0] += 0.42 * np.sin(angle)
                    place[:, 2] += 0.42 * (1 - np.cos(angle)) + 0.15 * on
                elif what == 2:  # put elsewhere
                    moved = _minimum_jerk((t - at) / rng.uniform(0.5, 1.0))
                    place += rng.uniform(-0.15, 0.15, 3) * [1, 1, 0] * moved[:, None]
                    place[:, 2] += 0.08 * np.exp(-(((t - at - 0.3) / 0.15) ** 2))
                    yaw += rng.uniform(-0.3, 0.3) * moved
                else:  # tapping toes
                    pitch += 0.2 * on * np.maximum(np.sin(2 * np.pi * rng.uniform(1.0, 2.5) * t), 0.0)
        elif kind == "standing":
            for at in rng.uniform(3, max(seconds - 5, 4), int(seconds / 20) + 1):
                roll += 0.03 * rng.normal() * np.exp(-(((t - at) / 0.6) ** 2))
                if rng.random() < 0.4:  # a step to one side by one foot
                    moved = _minimum_jerk((t - at) / 0.5)
                    place[:, 1] += rng.uniform(-0.2, 0.2) * moved
                    place[:, 2] += 0.05 * np.exp(-(((t - at - 0.25) / 0.12) ** 2))
                    yaw += rng.uniform(-0.4, 0.4) * moved
        sensed = _sensed(place, pitch, yaw, roll)
        if kind == "driving":
            sensed[:, :3] += rng.normal(0, 0.4, (len(sensed), 3))
        block[foot] = sensed
    return block


def plan(rng: np.random.Generator, hours: float) -> Iterator[tuple[str, float]]:
    """Activities of a day that begins in the night: kind and seconds (of walking: strides)."""
    total = hours * 3600.0
    sleep = 0.29 * total
    while sleep > 0:
        yield "lying", min(1800.0, sleep)
        sleep -= 1800.0
    gone = 0.29 * total
    while gone < total:
        kind = rng.choice(
            ["sitting", "fidgeting", "standing", "cycling", "driving", "lying"], p=[0.45, 0.1, 0.25, 0.06, 0.1, 0.04]
        )
        lasts = {"sitting": 900, "fidgeting": 240, "standing": 90, "cycling": 600, "driving": 900, "lying": 1200}[kind]
        lasts *= rng.uniform(0.4, 1.6)
        yield str(kind), lasts
        gone += lasts
        for _ in range(int(rng.integers(1, 4))):
            strides = float(np.exp(rng.normal(2.9, 1.0)).clip(4, 500))
            yield "walking", strides
            yield "standing", float(rng.uniform(6, 30))
            gone += 1.15 * strides + 18.0


def legs_of(rng: np.random.Generator, strides: float) -> list[tuple[str, float, float]]:
    """Cut a bout into straight legs, turns, and where it is long enough stairs or a slope."""
    legs: list[tuple[str, float, float]] = []
    left = strides
    while left > 0:
        straight = min(float(rng.uniform(4, 25)), left)
        legs.append(("level", max(straight, 3.0), 0.0))
        left -= straight
        if left < 8:
            break
        what = rng.random()
        if what < 0.15:
            legs.append((str(rng.choice(["up", "down"])), 6.0, 0.0))
            left -= 6
        elif what < 0.3:
            legs.append((str(rng.choice(["slope_up", "slope_down"])), 15.0, 0.0))
            left -= 15
        else:
            angle = math.radians(float(rng.choice([90, -90, 180, -180, 45, -60, 120]) + rng.uniform(-8, 8)))
            over = max(abs(angle) / math.radians(rng.uniform(40, 75)), 1.0)
            legs.append(("level", over, angle))
            left -= over
    return legs


def day(
    hours: float = 24.0, seed: int = 1, activities: list[tuple[str, float]] | None = None
) -> Iterator[tuple[float, Block, TrueDay]]:
    """Blocks of the day, one after the other, each with its begin (s); the truth grows with them.

    ``activities``: these instead of a day's, kind and seconds (of walking: strides).
    """
    rng = np.random.default_rng(seed)
    truth = TrueDay(hours)
    begin, heading = 0.0, {foot: _mounting(rng) for foot in FEET}
    bias = {foot: rng.normal(0, 0.004, 3) for foot in FEET}
    for kind, lasts in plan(rng, hours) if activities is None else activities:
        if kind == "walking":
            block, bout = walking(rng, legs_of(rng, lasts), rng.uniform(1.0, 1.35), rng.uniform(1.0, 1.5))
            truth.bouts.append(_shifted(bout, begin))
        else:
            block = resting(rng, kind, lasts)
        seconds = len(block[FEET[0]]) / RATE_HZ
        truth.activities.append((begin, begin + seconds, kind))
        for foot in FEET:
            turned = block[foot].reshape(-1, 2, 3) @ heading[foot]
            turned[:, 0] += rng.normal(0, 0.02, turned[:, 0].shape)
            turned[:, 1] += bias[foot] + rng.normal(0, 0.003, turned[:, 1].shape)
            block[foot] = turned.reshape(-1, 6)
        yield begin, block, truth
        begin += seconds


def _mounting(rng: np.random.Generator) -> np.ndarray:
    """How the sensor sits on the instep: down ahead by some 20°, and a little askew."""
    p, y = rng.normal(-0.35, 0.05), rng.normal(0, 0.08)
    about_y = np.array([[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]])
    about_z = np.array([[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1]])
    return about_z @ about_y


def _shifted(bout: TrueBout, by: float) -> TrueBout:
    return TrueBout(
        bout.begin_s + by,
        bout.end_s + by,
        {foot: [(a + by, b + by, m) for a, b, m in own] for foot, own in bout.strides.items()},
        [TrueTurn(turn.begin_s + by, turn.end_s + by, turn.angle_rad) for turn in bout.turns],
        [(a + by, b + by, kind) for a, b, kind in bout.terrain],
    )


def write_day(
    path: Path, hours: float = 24.0, seed: int = 1, activities: list[tuple[str, float]] | None = None
) -> TrueDay:
    """Write it as Parquet with its sidecar; memory does not grow with the hours."""
    names = [f"{foot}_{axis}" for foot in FEET for axis in AXES]
    schema = pa.schema([("t_ns", pa.int64()), *((name, pa.float32()) for name in names)])
    count, truth = 0, TrueDay()  # the truth grows with the blocks
    with pq.ParquetWriter(path, schema) as writer:
        for _, block, known in day(hours, seed, activities):
            truth, rows = known, len(block[FEET[0]])
            t = (np.arange(count, count + rows) * (1_000_000_000 // RATE_HZ)).astype(np.int64)
            columns = np.column_stack([block[foot] for foot in FEET]).astype(np.float32)
            writer.write_table(pa.Table.from_arrays([pa.array(t), *map(pa.array, columns.T.copy())], schema=schema))
            count += rows
    sensors = "".join(
        f"\n[sensors.{foot}]\nrate_hz = {RATE_HZ}\nacc = {[f'{foot}_{axis}' for axis in AXES[:3]]}\n"
        f"gyr = {[f'{foot}_{axis}' for axis in AXES[3:]]}\n"
        for foot in FEET
    )
    path.with_suffix(".toml").write_text(
        f'name = "{path.stem}"\nacc_unit = "m/s^2"\ngyr_unit = "rad/s"\n'
        f'time_column = "t_ns"\ntime_unit = "ns"\n{sensors}'
    )
    return truth
