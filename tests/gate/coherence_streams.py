"""Streams of samples of which the gate's judge of two triads is to say, to the sample, what it said before.

    python tests/gate/coherence_streams.py --write     # after a rule was changed on purpose: look at the difference

Strides of random people whose numbers begin to lie: each rule speaks in some of them, and the moment at which it does
depends on every sum it keeps. Rates are such that whole blocks add up to the rules' own times to the nanosecond.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

from judges import Coherence

from fes.signals import G_MPS2, NS_PER_S, ImuSample

SAID = Path(__file__).with_name("coherence_said.json")
SECONDS, FROM_S = 20.0, {"": (6.0, 15.0), "early": (2.0, 5.0), "always": (0.0, 0.0)}
RATES_HZ = (80, 100)
Values = list[float]
Lie = Callable[[Values, Values, Random], Values]
"""Of now's true values, and those of the moment in which it began."""


def person(draw: Random) -> Callable[[float], Values]:
    """Force and rate of a foot that rests, swings and strikes the ground, in a sensor mounted along any axes."""
    stride_s, share = draw.uniform(0.9, 1.6), draw.uniform(0.35, 0.6)
    swing_s = share * stride_s
    pitch_rad, roll_rad, yaw_rad = draw.uniform(0.5, 1.2), draw.uniform(0.05, 0.2), draw.uniform(0.05, 0.3)
    push_mps2, jolt_mps2 = draw.uniform(5.0, 12.0), draw.uniform(10.0, 40.0)
    forward, left = draw.sample((0, 1, 2), 2)
    up, sign = 3 - forward - left, draw.choice((-1.0, 1.0))
    handed = 1.0 if (left - forward) % 3 == 1 else -1.0
    noise = draw.choice((0.0, 1e-3, 0.05))
    lively = Random(draw.random())

    def values(t_s: float) -> Values:
        phase_s = t_s % stride_s - (stride_s - swing_s)
        x = y = p = q = r = pitch = roll = 0.0
        z = G_MPS2
        if phase_s > 0.0:
            angle = 2 * math.pi * phase_s / swing_s
            pitch, roll = 0.5 * pitch_rad * (1 - math.cos(angle)), roll_rad * math.sin(angle)
            p = roll_rad * 2 * math.pi / swing_s * math.cos(angle)
            q = pitch_rad * math.pi / swing_s * math.sin(angle)
            r = 4 * yaw_rad * math.sin(2 * angle)
            ahead = push_mps2 * math.sin(angle) + (jolt_mps2 if phase_s > swing_s - 0.03 else 0.0)
            x = ahead * math.cos(pitch) - G_MPS2 * math.sin(pitch)
            z = ahead * math.sin(pitch) + G_MPS2 * math.cos(pitch)
            y, z = z * math.sin(roll) + 2.0 * math.sin(3 * angle), z * math.cos(roll)
        found = [0.0] * 6
        for axis, way, force, rate in ((forward, sign, x, p), (left, sign, y, q), (up, handed, z, r)):
            found[axis], found[3 + axis] = way * force, way * rate
        return [each + noise * (lively.random() - 0.5) + 1e-9 * lively.random() for each in found]

    return values


def held(axes: tuple[int, ...], noise: float) -> Lie:
    return lambda now, then, draw: [
        then[k] + noise * (draw.random() - 0.5) if k in axes else each for k, each in enumerate(now)
    ]


def scaled(axes: tuple[int, ...], factor: float) -> Lie:
    return lambda now, then, draw: [factor * each if k in axes else each for k, each in enumerate(now)]


def turned(now: Values, then: Values, draw: Random) -> Values:
    """The gyroscope's axes exchanged: it turns the force where it does not go."""
    return [*now[:3], now[4], now[5], now[3]]


def knocked(now: Values, then: Values, draw: Random) -> Values:
    """Force that comes and goes without a turn."""
    return [each + draw.uniform(-2.0, 2.0) for each in now[:3]] + [0.05 * draw.random() for _ in range(3)]


def clipped(now: Values, then: Values, draw: Random) -> Values:
    return [max(min(each, most), -most) for each, most in zip(now, (9.0,) * 3 + (1.0,) * 3, strict=True)]


def leaning(now: Values, then: Values, draw: Random) -> Values:
    """At rest with another gravity, now and then turning a little."""
    size = then[0] if abs(then[0]) > 1.0 else 5.0
    return [0.3 * size + 0.01 * draw.random(), size, size, *(0.2 * draw.random() for _ in range(3))]


def slow(now: Values, then: Values, draw: Random) -> Values:
    """Another gravity while it turns slowly, about the axis that gravity comes along."""
    noisy = [0.01 * draw.random() for _ in range(6)]
    turns_radps = draw.choice((0.1, 0.3, 0.4))
    return [noisy[0], noisy[1], 7.9 + noisy[2], noisy[3], noisy[4], turns_radps + noisy[5]]


def leaping(axis: int) -> Lie:
    """One axis lies still while the others leap farther than they ever did."""
    return lambda now, then, draw: [
        then[k] + 0.02 * draw.random() if k == axis else each + draw.choice((-1.0, 1.0)) * (60.0 if k < 3 else 20.0)
        for k, each in enumerate(now)
    ]


def faint(force: float, rates: tuple[float, float, float], axis: int) -> Lie:
    """Nobody walks: forces about gravity and rates of these sizes; after some seconds one axis lies still."""
    sizes = (force, force, force, *rates)

    def values(now: Values, then: Values, draw: Random) -> Values:
        still = lies_by_now(then)
        return [
            G_MPS2 * (k == 2) + (0.01 * draw.random() if still and k == axis else size * draw.uniform(-1.0, 1.0))
            for k, size in enumerate(sizes)
        ]

    return values


def hardly(axis: int, share: float) -> Lie:
    """An axis that moves by a small share of what it should, and after some seconds lies still."""

    def values(now: Values, then: Values, draw: Random) -> Values:
        still = lies_by_now(then)
        return [(1e-3 * draw.random() if still else share * each) if k == axis else each for k, each in enumerate(now)]

    return values


def lies_by_now(then: Values) -> bool:
    """Counts the samples of a lie that begins later, by what it may keep."""
    then.append(0.0)
    return len(then) > 800


def jostled(now: Values, then: Values, draw: Random) -> Values:
    """It turns and turns, by a rate that changes; the force goes with it, and shakes too little for a contact."""
    then[0] += 0.02
    return [
        G_MPS2 * math.sin(then[0]), draw.choice((-0.8, 0.8)), G_MPS2 * math.cos(then[0]),
        draw.uniform(-0.4, 0.4), 2.0 + draw.uniform(-0.4, 0.4), draw.uniform(-0.4, 0.4),
    ]  # fmt: skip


def weak(now: Values, then: Values, draw: Random) -> Values:
    """A quarter of gravity that does not feel the turn."""
    return [0.01 * draw.random(), 0.01 * draw.random(), 2.5 + 0.01 * draw.random(), *now[3:]]


FORCE, RATE = (0, 1, 2), (3, 4, 5)
LIES: dict[str, Lie] = {
    "none": lambda now, then, draw: now,
    **{f"{name} {text}": held(axes, noise) for text, noise in (("frozen", 0.0), ("stuck", 0.08))
       for name, axes in (("force", FORCE), ("rate", RATE), *((f"axis {k}", (k,)) for k in range(6)))},
    **{f"{name} × {factor}": scaled(axes, factor) for name, axes in (("force", FORCE), ("rate", RATE))
       for factor in (0.5, 0.75, 1.3, 2.0, -1.0)},
    **{f"axis {k} × {factor}": scaled((k,), factor) for k in range(6) for factor in (0.05, -1.0)},
    "turned": turned, "knocked": knocked, "clipped": clipped, "leaning": leaning,
    "no number": lambda now, then, draw: [math.nan if draw.random() < 0.01 else each for each in now],
    **{f"early axis {k}": held((k,), 0.02) for k in range(6)},
    **{f"axis {k} murmurs": held((k,), 0.5 if k < 3 else 0.15) for k in range(6)},
    **{f"leaping, axis {k} still": leaping(k) for k in range(6)},
    "always faint in force": faint(1.5, (6.0, 6.0, 6.0), 4), "always faint in rate": faint(9.0, (0.3, 0.3, 0.3), 1),
    "always faint but one": faint(9.0, (6.0, 0.3, 0.3), 1),
    "always faint but gyroscope": faint(1.5, (6.0, 6.0, 6.0), 0),
    **{f"always hardly {k}": hardly(k, 0.03 if k < 3 else 0.02) for k in range(6)},
    "slow": slow, "jostled": jostled, "weak": weak,
}  # fmt: skip


def stream(name: str) -> Iterator[ImuSample]:
    """One person's walk at one of the rates: a pause, a gap, a stamp out of order, and a lie from some moment on."""
    draw = Random(name)
    step_ns = NS_PER_S // draw.choice(RATES_HZ)
    begins = FROM_S.get(name.partition(" ")[0], FROM_S[""])
    walk, from_s, pause_s = person(draw), draw.uniform(*begins), draw.uniform(0.0, 30.0)
    gap_at, gap_ns = draw.randrange(100, 2000), draw.choice((0, 20, 27, 28, 30, 500, 1990, 3000)) * 1_000_000
    lie, then, t_ns = LIES[name], list[float](), NS_PER_S
    rest = walk(0.0)
    for k in range(round(SECONDS * NS_PER_S / step_ns)):
        t_ns += step_ns + gap_ns * (k == gap_at)
        t_s = 1e-9 * t_ns
        now = walk(t_s)
        if pause_s < t_s < pause_s + 2.0:
            now = [each + 1e-3 * draw.random() for each in rest]
        if t_s >= from_s:
            then = then or list(now)
            now = lie(now, then, draw)
        x, y, z, p, q, r = now
        own_ns = t_ns - 2 * step_ns if k % 701 == 700 else t_ns
        yield ImuSample(t_ns, "left_foot", own_ns, (x, y, z), (p, q, r))


def verdicts(name: str) -> list[str]:
    """What the judge says of that stream: the sample's number and the words; and how often it was not ready."""
    judge, told, unready = Coherence("left_foot"), list[str](), 0
    for k, sample in enumerate(stream(name)):
        if words := judge.fault(sample):
            told.append(f"{k}: {words}")
        unready += bool(judge.not_ready)
    return [*told[:3], f"{len(told)} in all, not ready in {unready}"]


if __name__ == "__main__":
    found = {name: verdicts(name) for name in LIES}
    if "--write" in sys.argv:
        SAID.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    for name, each in found.items():
        print(name, *each[:1], each[-1], sep=" | ")
