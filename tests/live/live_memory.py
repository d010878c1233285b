"""Is a live session's memory flat? An hour of it on a clock that runs as fast as the computer can follow.

Controller, gate, operator, monitor, runner, source and the log's encoder are the ones that `fes run` uses, garbage
collection is frozen as there. Sensors, stimulator, keys and the log's file are stand-ins; two feet at 500 Hz walk and
stand in turn, the operator arms once a minute, ends a pause, raises the intensity.

    PYTHONPATH=tests python tests/live/live_memory.py --minutes 60
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from live_parts import EverReadable, FakeStimulator, Lost, Raw, SameClock, SetClock

from drivers.simulated.imu.device import walking_signal
from fes.config import load_session
from fes.estimation.foot.calibration import calibrate_foot
from fes.estimation.warm_up import warm_up
from fes.live.processes import frozen_garbage
from fes.live.session import LiveSession, live_header
from fes.live.source import LiveStimulator, SensorStream
from fes.session_log.writer import RecordBuffer
from fes.signals import FOOT_SENSORS, NS_PER_S, StimAlive, StimCommand, StimStatus, WireFrame

RATE_HZ = 500.0
STEP_NS = int(NS_PER_S / RATE_HZ)
SETTLED_S = 120.0  # after so long every buffer has been filled once
MOST_GROWTH_MB = 8.0  # in an hour
SETTINGS = Path(__file__).resolve().parents[2] / "sim_inputs" / "session.toml"


class TwoFeet(EverReadable):
    """A sample of each foot whenever it is read; reading moves the clock on and presses keys."""

    def __init__(self, clock: SetClock, keys: int, script: dict[int, bytes]) -> None:
        super().__init__(*FOOT_SENSORS)
        self._clock, self._keys, self._script, self._number = clock, keys, script, 0
        self._signals = [walking_signal(sensor, RATE_HZ) for sensor in FOOT_SENSORS]

    def samples(self, t_ns: int) -> list[Raw]:
        self._number += 1
        self._clock.now_ns += STEP_NS
        if key := self._script.get(self._number % int(60 * RATE_HZ)):
            os.write(self._keys, key)
        samples = zip(self.sensors, (signal.sample(self._number) for signal in self._signals), strict=True)
        return [Raw(sensor, t_ns, t_ns, *sample) for sensor, sample in samples]


class Stimulator(FakeStimulator):
    """Answers every command, and every 100 ms unasked."""

    next_ns = on = 0

    def send(self, command: StimCommand) -> WireFrame:
        self.on += command.on
        levels = command.current_ma, command.pulse_width_us, command.frequency_hz
        self.answers.append(StimStatus(command.t_ns, command.channel, 0, command.on, *levels))
        return WireFrame(command.t_ns, 0x120, bytes([command.channel]))

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        if t_ns >= self.next_ns:
            self.next_ns = t_ns + NS_PER_S // 10
            self.answers.append(StimAlive(t_ns, 1, 0))
        return super().poll(t_ns)


class CountedLog(RecordBuffer):
    """Encodes as the session's log does; where that hands its bytes to a process, they are counted and forgotten."""

    healthy = warning = ""
    bytes = 0

    def _deliver(self, encoded: bytearray) -> None:
        self.bytes += len(encoded)


class Enough(Exception):
    """The time is over."""


def rss_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 1e6


def measure(minutes: float) -> dict[str, float]:
    session = load_session(SETTINGS)
    worn = {"device": "ximu3", "rate_hz": RATE_HZ, "acc_range_g": 16, "gyr_range_dps": 2000}
    devices = [{"sensor": sensor, "port": sensor, **worn} for sensor in FOOT_SENSORS]
    session = type(session).model_validate({**session.model_dump(), "sensors": devices})
    calibrations = {}
    for sensor in FOOT_SENSORS:
        signal = walking_signal(sensor, RATE_HZ)
        t_ns = np.arange(len(signal.acc_mps2), dtype=np.int64) * STEP_NS
        calibrations[sensor] = calibrate_foot(sensor, RATE_HZ, t_ns, signal.acc_mps2, signal.gyr_radps)
    clock, stimulator = SetClock(step_ns=0), Stimulator()
    begin_ns = clock()
    reading, keys = os.pipe()
    at = int(RATE_HZ)
    script = {15 * at + 100 * k: b"+" for k in range(20)}
    script |= {30 * at: b"p", 32 * at: b"p", 40 * at: b" "}
    script |= {second * at: b"a" for second in (*range(3, 15), *range(42, 59))}  # until the feet rest
    log = CountedLog(Path("session.feslog"), live_header(session, calibrations, 1, "", clock()))
    live = LiveSession(session, calibrations, log, LiveStimulator(stimulator, Lost, clock), clock)
    live.add_keys(reading)
    warm_up()
    frozen_garbage()
    sizes: list[tuple[float, float]] = []
    next_s, end_s = 0.0, 60.0 * minutes

    def check() -> None:
        nonlocal next_s
        t_s = (clock.now_ns - begin_ns) / NS_PER_S
        if t_s >= next_s:
            next_s = t_s + 10.0
            sizes.append((t_s, rss_mb()))
        if t_s >= end_s:
            raise Enough

    began_s = time.perf_counter()
    line = SensorStream(TwoFeet(clock, keys, script), SameClock, Lost, frozenset(FOOT_SENSORS))
    with suppress(Enough):
        live.run([line], [], [], [], check)
    settled_s = min(SETTLED_S, end_s / 2)
    first = next(size for t_s, size in sizes if t_s >= settled_s)
    growth = max(size for t_s, size in sizes if t_s >= settled_s) - first
    return {
        "minutes": minutes,
        "took_s": round(time.perf_counter() - began_s, 1),
        "samples": live.summary()["latency"]["count"],
        "commands_on": stimulator.on,
        "log_mb": round(log.bytes / 1e6, 2),
        "settled_mb": round(first, 1),
        "growth_mb": round(growth, 2),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    options = parser.parse_args()
    found = measure(options.minutes)
    print(json.dumps(found))
    return 0 if found["growth_mb"] <= MOST_GROWTH_MB and found["commands_on"] else 1


if __name__ == "__main__":
    sys.exit(main())
