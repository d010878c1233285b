"""A sensor is qualified: at rest, struck, on its six sides, turned, shaken. Figures only; judging is apart.

Turns go about the vertical, so that gravity stays on one axis and the turned angle is exactly one turn, along a table's
edge. The delay from a movement to its sample is measured by striking the Enter key with the sensor itself: the blow is
in the samples, the key in the computer's time. A keyboard is 5 to 30 ms late itself, so that what is found is the least
that the delay can be.
"""

import os
import select
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any, Final, Protocol

import click
import numpy as np

from drivers.imu.port import ImuPort, LineCounts
from fes.config import ImuDevice
from fes.signals import G_MPS2, NS_PER_S, FloatArray, IntArray

LOOK_S: Final = 0.001  # between two looks at a line that nothing can be waited on for
STDIN: Final = 0


class NotQualified(RuntimeError):
    """It could not be gone through to the end; the message says why and what to do."""


class Clock(Protocol):
    """Time, and waiting for a line."""

    def now_ns(self) -> int:
        """Monotonic time in ns."""

    def wait(self, until_ns: int, descriptor: int | None) -> None:
        """Until then, or until something may have come."""


class Person(Protocol):
    """Who handles the device. ``key`` names a step or a reading, for a person who is simulated."""

    def does(self, key: str, instruction: str) -> None:
        """Show what is to be done; return when they are about to do it."""


class Striker(Person, Protocol):
    """Who handles a sensor, and strikes a key with it."""

    def struck_ns(self) -> int | None:
        """When they struck the key since the last call; None: not yet. Never waits."""


class Reader(Person, Protocol):
    """Who handles a stimulator, and reads an oscilloscope."""

    def reads(self, key: str, question: str, unit: str) -> float:
        """What they read."""


class RealTime:
    """The computer's own."""

    @staticmethod
    def now_ns() -> int:
        """CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def wait(self, until_ns: int, descriptor: int | None) -> None:
        """By select, where there is something to select."""
        left_s = max(0.0, (until_ns - self.now_ns()) / NS_PER_S)
        lines = [] if descriptor is None else [descriptor]
        select.select(lines, [], [], left_s if lines else min(left_s, LOOK_S))


@dataclass(eq=False)
class TerminalPerson:
    """A person at the terminal; lines come from the descriptor ``keys``."""

    keys: int = STDIN
    clock_ns: Callable[[], int] = time.monotonic_ns

    def does(self, key: str, instruction: str) -> None:
        """Wait for the Enter key."""
        click.echo(f"{instruction}\n  Enter when ready …", err=True)
        self._line()

    def reads(self, key: str, question: str, unit: str) -> float:
        """Ask until a number comes."""
        while True:
            click.echo(f"  {question} ({unit}): ", nl=False, err=True)
            try:
                return float(self._line().replace(",", "."))
            except ValueError:
                click.echo("  That is no number; once more.", err=True)

    def struck_ns(self) -> int | None:
        """The Enter key's time."""
        if not select.select([self.keys], [], [], 0)[0]:
            return None
        struck_ns = self.clock_ns()
        self._line()
        return struck_ns

    def _line(self) -> str:
        line = b""
        while not line.endswith(b"\n"):
            byte = os.read(self.keys, 1)
            if not byte:
                raise NotQualified("nobody is there any more who does the steps (stdin has ended)")
            line += byte
        return line.decode(errors="replace").strip()


Figures = dict[str, Any]
SETTLE_S: Final = 0.3  # what had queued up while the person got ready
REST_S, SIDE_S, TURN_S, SLOW_S, SHAKE_S, STRIKE_S = 20.0, 1.5, 10.0, 8.0, 6.0, 30.0
AFTER_STRIKE_S: Final = 0.5
BEFORE_KEY_S: Final = 0.05  # a keyboard may be so late
STRIKES: Final = 5
BLOW_MPS2: Final = 5.0  # beyond what the hand's own movement brings about
PLATEAU: Final = 1e-6  # relative: two peaks of a shaken hand are never so equal
PLATEAU_SAMPLES: Final = 5
STILL_SHARE: Final = 0.5  # of samples equal to the one before: noise in whole numbers repeats itself less often
AXES: Final = "xyz"


@dataclass(frozen=True, slots=True)
class Heard:
    """What came in a while: (N,) times in ns, (N, 3) specific force in m/s² and rate in rad/s, and what was counted."""

    host_ns: IntArray
    device_ns: IntArray
    acc_mps2: FloatArray
    gyr_radps: FloatArray
    counts: LineCounts

    @property
    def steps_s(self) -> FloatArray:
        """(N−1,) between samples by the sensor's own clock."""
        return np.asarray(np.diff(self.device_ns) / NS_PER_S)


@dataclass(eq=False)
class SensorBench:
    """One sensor's port, time and a person; :meth:`figures` goes through all steps. ImuLost: the line broke."""

    device: ImuDevice
    port: ImuPort
    clock: Clock
    person: Striker

    def figures(self) -> Figures:
        """All of them; what could not be told is None."""
        name = self.device.sensor
        serial = self.port.serials.get(name, "")
        found: Figures = {"serial": serial, "firmware": self.port.firmwares.get(name, "")}
        self.port.reopen()
        found["serial_again"] = self.port.serials.get(name, "")
        self.person.does("rest", f"Lay the sensor on a table where nothing shakes it, for {REST_S:g} s.")
        rest = self._listen(REST_S)
        found |= _at_rest(rest, self.device.rate_hz)
        found["knock_ms"] = self._knock_ms()
        bias_radps = rest.gyr_radps.mean(axis=0)
        sides: dict[str, FloatArray] = {}
        for axis, end in product(AXES, ("up", "down")):
            where = "points up" if end == "up" else "points down"
            self.person.does(f"{axis}_{end}", f"Set it on the table so that its {axis} axis {where}; hands off.")
            sides[f"{axis}_{end}"] = self._listen(SIDE_S).acc_mps2.mean(axis=0)
            if end == "up":
                asked = "Turn it once around, anticlockwise as seen from above, along an edge, back to where it lies."
                self.person.does(f"{axis}_turn", f"{asked} You have {TURN_S:g} s; a full turn takes 3 s or more.")
                turn = self._listen(TURN_S)
                rates = turn.gyr_radps - bias_radps
                angles = ((rates[1:] + rates[:-1]) / 2 * turn.steps_s[:, None]).sum(axis=0)
                found |= _along(f"gyr_{axis}", angles, 2 * np.pi)
        for axis in AXES:
            up, down = sides[f"{axis}_up"], sides[f"{axis}_down"]
            found |= _along(f"acc_{axis}", (up - down) / 2, G_MPS2)
            found[f"acc_{axis}_bias_mps2"] = float((up + down)[AXES.index(axis)] / 2)
        self.person.does("slow", f"Turn it as slowly as you can, all the time, for {SLOW_S:g} s.")
        found["dead_band_dps"] = _dead_band_dps(rest, self._listen(SLOW_S))
        self.person.does("shake", f"Hold it fast and shake and twist it as hard as you can, for {SHAKE_S:g} s.")
        found |= _shaken(self._listen(SHAKE_S))
        counts = self.port.counts[name]
        return found | {"bad_values": counts.bad_values + counts.unsound}  # in all steps

    def _listen(self, seconds: float, until: Callable[[int], bool] = lambda now_ns: False) -> Heard:
        """For so long, or until ``until`` says so, once what had queued up is read. NotQualified: hardly anything."""
        counts = self.port.counts[self.device.sensor]
        begin_ns = self.clock.now_ns()
        count_ns, end_ns = begin_ns + int(SETTLE_S * NS_PER_S), begin_ns + int((SETTLE_S + seconds) * NS_PER_S)
        before = asdict(counts)
        samples = []
        while (now_ns := self.clock.now_ns()) < end_ns and not until(now_ns):
            self.clock.wait(end_ns, self.port.fileno())
            came = self.port.read(self.clock.now_ns())
            if now_ns < count_ns:
                before = asdict(counts)
                continue
            samples += [sample for sample in came if sample.sensor == self.device.sensor]
        if len(samples) < 4:
            raise NotQualified(f"{self.device.sensor}: nothing is heard. Does it measure, and is the port its own?")
        gone = {name: value - before[name] for name, value in asdict(counts).items()}
        return Heard(
            np.array([sample.t_host_ns for sample in samples]),
            np.array([sample.t_device_ns for sample in samples]),
            np.array([sample.acc_mps2 for sample in samples]),
            np.array([sample.gyr_radps for sample in samples]),
            LineCounts(**gone),
        )

    def _knock_ms(self) -> float | None:
        """Median of the time from the key to the first sample that shows the blow."""
        delays_ms = []
        for number in range(STRIKES):
            again = f"{number + 1} of {STRIKES}"
            self.person.does(
                "strike", f"Hold it 1 cm over the Enter key, still; then strike the key with it ({again})."
            )
            struck_ns: list[int] = []

            def over(now_ns: int, struck_ns: list[int] = struck_ns) -> bool:
                if not struck_ns and (key_ns := self.person.struck_ns()) is not None:
                    struck_ns.append(key_ns)
                return bool(struck_ns) and now_ns > struck_ns[0] + AFTER_STRIKE_S * NS_PER_S

            heard = self._listen(STRIKE_S, over)
            force = np.linalg.norm(heard.acc_mps2, axis=1)
            sizes = np.abs(force - np.median(force))
            if not struck_ns:
                continue
            sizes[heard.host_ns < struck_ns[0] - BEFORE_KEY_S * NS_PER_S] = 0.0  # how the hand set off
            if (most := sizes.max()) > BLOW_MPS2:
                first = int(np.argmax(sizes > most / 2))
                delays_ms.append((int(heard.host_ns[first]) - struck_ns[0]) / 1e6)
        return float(np.median(delays_ms)) if delays_ms else None


def _at_rest(heard: Heard, rate_hz: float) -> Figures:
    counts, n = heard.counts, len(heard.host_ns)
    steps_s = heard.steps_s[heard.steps_s > 0]
    late_ns = (heard.host_ns - heard.device_ns).astype(float)
    quarter = -(-n // 4)  # the least late sample of either end: it waited for nobody
    first, last = int(np.argmin(late_ns[:quarter])), n - quarter + int(np.argmin(late_ns[-quarter:]))
    drift = (late_ns[last] - late_ns[first]) / (heard.host_ns[last] - heard.host_ns[first])
    late_ns -= drift * (heard.host_ns - heard.host_ns[0])
    same = np.diff(np.hstack([heard.acc_mps2, heard.gyr_radps]), axis=0) == 0.0
    return {
        "samples": n,
        "rate_hz": float(1.0 / np.median(steps_s)) if len(steps_s) else 0.0,
        "clock_ppm": float(-drift / (1.0 + drift) * 1e6) if drift > -1 else None,
        "late_p99_ms": float(np.quantile(late_ns - late_ns.min(), 0.99) / 1e6),
        "missing": counts.missing,
        "bad_stamps": counts.doubled + counts.backward,
        "bad_frames": counts.bad_frames,
        "repeats_share": float(same.all(axis=1).mean()),
        "acc_noise_mps2": float(heard.acc_mps2.std(axis=0).max()),
        "gyr_noise_dps": float(np.degrees(heard.gyr_radps.std(axis=0).max())),
    }


def _along(name: str, vector: FloatArray, expected: float) -> Figures:
    """Which axis answered, with its sign, and how much of what it should have shown."""
    if not np.isfinite(vector).all():  # it went beyond what the settings say that it can measure
        return {f"{name}_axis": None, f"{name}_gain": None}
    strongest = int(np.argmax(np.abs(vector)))
    sign = "+" if vector[strongest] > 0 else "-"
    return {f"{name}_axis": f"{sign}{AXES[strongest]}", f"{name}_gain": float(abs(vector[strongest]) / expected)}


def _dead_band_dps(rest: Heard, slow: Heard) -> float | None:
    """The least rate that is shown, where it shows the same at rest all the time; 0 where it does not; None: none."""
    still = (np.diff(rest.gyr_radps, axis=0) == 0.0).all(axis=1).mean()
    if still < STILL_SHARE:
        return 0.0
    moved = np.abs(slow.gyr_radps - np.median(rest.gyr_radps, axis=0)).max(axis=1)
    moved = moved[moved > 0]
    return float(np.degrees(moved.min())) if len(moved) else None


def _shaken(heard: Heard) -> Figures:
    """The highest values; and where several samples of an axis end at the very same one, that is its range's end."""
    found: Figures = {}
    triads = (("acc", "g", heard.acc_mps2 / G_MPS2), ("gyr", "dps", np.degrees(heard.gyr_radps)))
    for name, unit, values in triads:
        sizes = np.abs(values)
        most = np.nanmax(sizes, axis=0)
        ends = [
            float(top)
            for axis, top in enumerate(most)
            if (sizes[:, axis] >= top * (1 - PLATEAU)).sum() >= PLATEAU_SAMPLES
        ]
        found |= {f"{name}_peak_{unit}": float(most.max()), f"{name}_ends_at_{unit}": min(ends, default=None)}
    return found | {"clipped": heard.counts.clipped}
