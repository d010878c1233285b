"""What the tests of simulated sensors share: settings of one, and reading ports until something has come or a loss.

A busy machine may hold up this process or a sensor's at any moment. So nothing is taken to have come because time has
passed: tests wait for it, and tell by its own stamp when a sample was taken.
"""

from __future__ import annotations

import math
import select
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from drivers.imu.port import ImuLost, ImuPort
from drivers.simulated.imu.device import ImuSignal
from drivers.simulated.spawn import ImuHandle
from fes.config.session import ImuDevice
from fes.signals import NS_PER_S, RawSample


def settings(kind: str, port: str, sensor: str = "right_foot", rate_hz: float = 100.0, **options: object) -> ImuDevice:
    values = {"sensor": sensor, "device": kind, "port": port, "rate_hz": rate_hz, "options": options}
    return ImuDevice.model_validate(values | {"acc_range_g": 16.0, "gyr_range_dps": 2000.0})


@dataclass(frozen=True)
class Taken:
    """When a simulated sensor took a sample, by the host's clock: from its stamp and how its clock was set at start."""

    handle: ImuHandle
    offset_s: float = 0.0
    drift_ppm: float = 0.0

    def ns(self, sample: RawSample) -> int:
        own_ns = sample.t_device_ns - int(self.offset_s * NS_PER_S)
        return self.handle.t0_ns + round(own_ns / (1.0 + self.drift_ppm * 1e-6))

    def late_ns(self, sample: RawSample) -> int:
        """How long after that it was read."""
        return sample.t_host_ns - self.ns(sample)

    def as_played(self, sample: RawSample, signal: ImuSignal, acc: float = 1e-3, gyr: float = 1e-5) -> bool:
        """Whether it is what the sensor plays at that time of its clock, to within so many m/s² and rad/s."""
        number = round((sample.t_device_ns - int(self.offset_s * NS_PER_S)) * signal.rate_hz / NS_PER_S)
        acc_mps2, gyr_radps = signal.sample(number)
        return math.dist(sample.acc_mps2, acc_mps2) < acc and math.dist(sample.gyr_radps, gyr_radps) < gyr

    def since(self, port: ImuPort, told_ns: int, number: int) -> list[RawSample]:
        """So many samples that were taken at this instant or later; those from before it, still on their way, go."""
        found: list[RawSample] = []

        def enough() -> bool:
            return sum(self.ns(sample) >= told_ns for sample in found) >= number

        end_s = time.monotonic() + 10.0
        while not enough():
            assert time.monotonic() < end_s, f"{len(found)} samples came, too few of them were taken since then"
            found += collect([port], 0.01)
        return [sample for sample in found if self.ns(sample) >= told_ns]


def collect(ports: Sequence[ImuPort], seconds: float) -> list[RawSample]:
    """Wait on all descriptors, and read all ports after each wait, for so long; and once more when it is over.

    As in a session, a sample has arrived when the reading was over: no sooner than it was taken, whoever is held up.
    """
    found: list[RawSample] = []
    end_s = time.monotonic() + seconds
    over = False
    while not over:
        over = time.monotonic() >= end_s
        select.select([number for port in ports if (number := port.fileno()) is not None], [], [], 0 if over else 0.01)
        for port in ports:
            raw = port.read(time.monotonic_ns())
            read_ns = time.monotonic_ns()
            found += [replace(sample, t_host_ns=read_ns) for sample in raw]
    return found


def collect_until(ports: Sequence[ImuPort], what: Callable[[], bool], seconds: float = 10.0) -> list[RawSample]:
    """Read until something is so, however long a busy machine takes, and a moment longer: it may become too much."""
    found: list[RawSample] = []
    end_s = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end_s, "it did not come"
        found += collect(ports, 0.02)
    return found + collect(ports, 0.1)


def collect_samples(ports: Sequence[ImuPort], number: int, seconds: float = 15.0) -> list[RawSample]:
    """Read until so many samples of each sensor have come, counted from now."""
    counts = [counts for port in ports for counts in port.counts.values()]
    enough = [each.samples + number for each in counts]
    return collect_until(
        ports, lambda: all(each.samples >= most for each, most in zip(counts, enough, strict=True)), seconds
    )


def until_lost(port: ImuPort, seconds: float = 10.0) -> str:
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        try:
            collect([port], 0.05)
        except ImuLost as error:
            return str(error)
    return ""
