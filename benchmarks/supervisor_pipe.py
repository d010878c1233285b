"""What the gate and the port in a process of their own would cost: the time that the way through a pipe adds.

    python benchmarks/supervisor_pipe.py [--events N] [--period-ms MS] [--json FILE]

One process sends every sample, with a request, as a record of fixed size through a pipe. The
other one unpacks it, lets a gate observe the sample and judge the request, and writes the command into a line of its
own. The time from just before the sending to just after that writing, less what the same gate and the same writing
take in one process, is what is added. Both with the priority and the memory that a live session asks for, where the
machine grants them ("real time"), and without; on the machine as it is, and with every processor kept busy.
"""

from __future__ import annotations

import multiprocessing
import os
import struct
import sys
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection

import numpy as np
from command_line import console_of, parser_of, save
from rich.table import Table

from fes.config import Channel
from fes.gate import SafetyGate
from fes.live.realtime import become_real_time
from fes.signals import FloatArray, ImuSample, OperatorAct, OperatorAction, StimRequest

RECORD = struct.Struct("=qq6dd")  # sent, the sensor's time, force and rate, the current asked for
BOUND_MS = 0.5
FIRST = 200  # of either way, not counted
LIMITS = {
    "max_current_ma": 30.0, "max_pulse_width_us": 400.0, "max_frequency_hz": 50.0, "max_charge_per_phase_uc": 10.0,
    "max_charge_per_minute_mc": 100.0, "max_current_density_ma_per_cm2": 1.0, "max_rise_ma_per_s": 1000.0,
    "max_on_s": 3.0, "min_off_s": 0.1,
}  # fmt: skip
CHANNEL = Channel.model_validate(
    {"name": "x", "number": 0, "foot": "right_foot", "electrode_area_cm2": 25.0, "current_ma": 20.0,
     "pulse_width_us": 300.0, "frequency_hz": 40.0, "limits": LIMITS}
)  # fmt: skip


class Supervisor:
    """A gate and a line."""

    def __init__(self) -> None:
        self.gate = SafetyGate((CHANNEL,), max_data_age_ms=40, validity_ms=60)
        self.line = os.open(os.devnull, os.O_WRONLY)

    def take(self, record: bytes) -> int:
        """Judge and write; when that was done, ns."""
        sent_ns, sensor_ns, ax, ay, az, p, q, r, current_ma = RECORD.unpack(record)
        self.gate.observe(ImuSample(sent_ns, "right_foot", sensor_ns, (ax, ay, az), (p, q, r)))
        if self.gate.latched or not self.gate.armed:
            self.gate.observe(OperatorAct(sent_ns, OperatorAction.ARM))
        command = self.gate.judge(sent_ns, StimRequest(0, True, current_ma, 300.0, 40.0))
        os.write(self.line, f"{command.on}{command.current_ma}".encode())
        return time.monotonic_ns()


def serve(pipe: int, answers: Connection, real_time: bool) -> None:
    """The process of the supervisor; at the end, when each record was done."""
    supervisor, done = Supervisor(), list[int]()
    if real_time:
        become_real_time()
    answers.send(None)
    while len(record := os.read(pipe, RECORD.size)) == RECORD.size:
        done.append(supervisor.take(record))
    answers.send(done)


def record_of(number: int, rng: np.random.Generator) -> bytes:
    """A living sensor at rest about the vertical; stamped now."""
    noise, now_ns = rng.normal(0.0, 0.02, 6), time.monotonic_ns()
    turns = 1.0 if number % 75 == 0 else 0.0
    return RECORD.pack(now_ns, now_ns, *noise[:2], 9.81 + noise[2], *noise[3:5], turns + noise[5], 0.5)


def paced(events: int, period_ms: float, real_time: bool, apart: bool) -> FloatArray:
    """From sending to writing, ms."""
    rng, begin = np.random.default_rng(1), time.monotonic()
    sent = list[int]()
    if apart:
        context = multiprocessing.get_context("fork")
        reading, writing = os.pipe()
        here, there = context.Pipe()
        process = context.Process(target=_serve_alone, args=(reading, writing, there, real_time), daemon=True)
        process.start()
        os.close(reading)
        here.recv()
    supervisor, done = Supervisor(), list[int]()
    if real_time:
        become_real_time()
    for number in range(events):
        pause_s = begin + 1e-3 * period_ms * number - time.monotonic()
        if pause_s > 0.0:
            time.sleep(pause_s)
        record = record_of(number, rng)
        sent.append(time.monotonic_ns())
        if apart:
            os.write(writing, record)
        else:
            done.append(supervisor.take(record))
    if apart:
        os.close(writing)
        done = here.recv()
        process.join(5.0)
    took_ms = 1e-6 * (np.array(done) - np.array(sent))
    return np.asarray(took_ms[FIRST:])


def _serve_alone(reading: int, writing: int, answers: Connection, real_time: bool) -> None:
    os.close(writing)  # or the end of the pipe would never come
    serve(reading, answers, real_time)


def _measure(answers: Connection, *settings: object) -> None:
    answers.send(paced(*settings))  # type: ignore[arg-type]


def measured(events: int, period_ms: float, real_time: bool, apart: bool) -> FloatArray:
    """As :func:`paced`, in a process of its own, whose priority ends with it."""
    here, there = multiprocessing.Pipe()
    context = multiprocessing.get_context("fork")
    process = context.Process(target=_measure, args=(there, events, period_ms, real_time, apart))
    process.start()
    found = np.asarray(here.recv())
    process.join()
    return found


def spin() -> None:
    while True:
        pass


@dataclass
class Row:
    """ms at p50, p99 and p99.9: in one process, apart, and added at each."""

    machine: str
    real_time: bool
    one: list[float]
    apart: list[float]
    added: list[float]


def main() -> int:
    """Print the table; 1 where the pipe adds more than half a millisecond at p99 in real time."""
    parser = parser_of(__doc__)
    parser.add_argument("--events", type=int, default=10_000)
    parser.add_argument("--period-ms", type=float, default=2.0)
    asked = parser.parse_args()
    rows = list[Row]()
    for machine in ("as it is", "all processors busy"):
        count = 0 if machine == "as it is" else os.cpu_count() or 1
        busy = [multiprocessing.Process(target=spin, daemon=True) for _ in range(count)]
        for process in busy:
            process.start()
        for real_time in (True, False):
            one, apart = (
                np.percentile(measured(asked.events, asked.period_ms, real_time, each), (50, 99, 99.9), method="higher")
                for each in (False, True)
            )
            rows.append(Row(machine, real_time, one.tolist(), apart.tolist(), (apart - one).tolist()))
        for process in busy:
            process.kill()
    table = Table("machine", "real time", "one process, ms: p50, p99, p99.9", "through the pipe", "added")
    for row in rows:
        columns = [", ".join(f"{value:.3f}" for value in values) for values in (row.one, row.apart, row.added)]
        table.add_row(row.machine, "yes" if row.real_time else "no", *columns)
    console_of(130).print(table)
    save([vars(row) for row in rows], asked.json)
    return 1 if max(row.added[1] for row in rows if row.real_time) > BOUND_MS else 0


if __name__ == "__main__":
    sys.exit(main())
