"""The witness of a session's foot sensors, a process of its own: ``… witness_process SOCKET_FD PARENT_PID LOG``.

It reads the log as it grows and hears each foot's sensor again after its strides (:mod:`fes.witness.verdict`). What has
changed is sent as one datagram of JSON: the sensor, its lies and why they are not known, in words. It decides nothing,
runs when nobody else wants the processor, and rests five times as long as it has worked.
"""

import json
import os
import select
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from fes.live.processes import end_with, joined, orphaned
from fes.session_log.codec import SampleParts, decode_json, decode_many
from fes.session_log.framing import LogScan, RecordType, SessionLogError
from fes.signals import FOOT_SENSORS, FloatArray, IntArray

if TYPE_CHECKING:
    from fes.witness.verdict import Hearing

POLL_S: Final = 0.5
RESTS: Final = 5.0  # times as long as it has worked
NICE: Final = 19
New = tuple[dict[str, tuple[IntArray, FloatArray]], dict[str, list[tuple[int, int]]]]


class Growing:
    """A session log while it is written: what is new of its foot sensors each time it is asked."""

    def __init__(self, path: Path) -> None:
        self.rates_hz: dict[str, float] = {}
        self._path, self._read = path, 0

    def read_new(self) -> New:
        """Samples and strides by sensor; nothing as long as no log is there."""
        scan, parts = LogScan(self._path, self._read), SampleParts()
        found: dict[int, list[memoryview]] = {RecordType.SAMPLES: [], RecordType.STRIDE: [], RecordType.HEADER: []}
        with suppress(SessionLogError):  # nothing is stored yet
            for kind, payload in scan:
                found.get(kind, []).append(payload)
        self._read = scan.good_bytes
        for payload in found[RecordType.HEADER]:
            self.rates_hz = decode_json(payload)["recording"]["rates_hz"]
        parts.add(found[RecordType.SAMPLES])
        samples = {
            sensor: (own.t_sensor_ns, np.hstack((own.acc_mps2, own.gyr_radps)))
            for sensor, own in parts.arrays().items() if sensor in FOOT_SENSORS
        }  # fmt: skip
        strides: dict[str, list[tuple[int, int]]] = {}
        for stride in decode_many(RecordType.STRIDE, found[RecordType.STRIDE]):
            strides.setdefault(stride.foot, []).append((stride.t_start_ns, stride.t_end_ns))
        return samples, strides


def new_hearing(sensor: str, rate_hz: float) -> "Hearing":
    """Loads compiled code, so not before there are samples."""
    from fes.witness.verdict import Hearing

    return Hearing(sensor, rate_hz)


def main() -> None:
    """Until the session says that it is over, or is gone."""
    link, parent, (path,) = joined()
    log = Growing(Path(path))
    end_with(parent)
    os.nice(NICE)
    hearings: dict[str, Hearing] = {}
    rest_s = POLL_S
    while not (orphaned(parent) or select.select([link], [], [], rest_s)[0]):
        begin_s = time.process_time()
        samples, strides = log.read_new()
        for sensor, (t_ns, values) in samples.items():
            hearing = hearings.get(sensor) or new_hearing(sensor, log.rates_hz.get(sensor, 100.0))
            hearings[sensor] = hearing
            hearing.add(t_ns, values, strides.get(sensor, []))
            if hearing.hear():
                said = {"sensor": sensor, "lies": hearing.lies, "unknown": hearing.unknown}
                with suppress(OSError):  # the session does not read: it is busy, or over
                    link.send(json.dumps(said).encode())
        rest_s = max(POLL_S, RESTS * (time.process_time() - begin_s))


if __name__ == "__main__":
    main()
