"""A virtual patient as a device: the host's time and delivered pulses in, the messages of its worn sensors out.

No I/O and no clock. Each worn sensor is a simulated one with all the faults of :mod:`drivers.simulated.imu.device`;
what it measures is the patient's foot or shank at the moment of its sample. The patient is advanced by one sampling
interval at a time, so that the same pulses give the same samples however late the process was woken. In a campaign the
patient's foot sensor stands in the place of a simulated one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.simulated.imu.device import LASTING, ImuSignal, SimulatedImu
from drivers.simulated.imu.wire import XbusWire
from drivers.simulated.line_faults import LINE_FAULTS
from drivers.simulated.pulses import Pulse
from fes.calibration.recording import save
from fes.hil.closed_loop.bench import PatientHandle, spawn_patient
from fes.hil.closed_loop.session import patient_calibration
from fes.hil.settings import FOOT, RATE_HZ
from fes.signals import G_MPS2, NS_PER_S
from fes.simulation.forward import DeliveredPulse, PatientSettings, VirtualPatient, VirtualStride, settings_for

REMEMBERED_S: Final = 60.0
HELD: Final = 1 << 62
LATE_NS: Final = 5_000_000  # a sample that goes out later than this is counted
CYCLE_S: Final = (5.0, 3.5)  # walks and stands in turns; a stand is longer than a burst may last


class PatientSensor:
    """One end of the foot sensor's line; the patient's process goes on when it is stopped."""

    def __init__(self, patient: PatientHandle, port: str = "") -> None:
        self._patient = patient
        self._port = port

    @property
    def port(self) -> str:
        """What the host opens; a spare one is plugged in when it is first asked for."""
        if not self._port:
            self._port = self._patient.replug(FOOT)
        return self._port

    def inject(self, name: str, value: float = 1.0) -> int:
        """As a simulated sensor's; ``stand`` keeps the patient standing, 0 lets it walk on."""
        return self._patient.hold(bool(value)) if name == "stand" else self._patient.inject(name, value, FOOT)

    def clear(self) -> None:
        """End the faults that last."""
        for name in (*LASTING, *sorted(LINE_FAULTS)):
            self._patient.inject(name, 0.0, FOOT)

    def stop(self) -> int:
        """Nothing: whoever started the patient ends it."""
        return 0


def campaign_patient(folder: Path, pulses: Path) -> tuple[PatientHandle, Path]:
    """A patient who walks and stands in turns, and the calibration of its sensor.

    Args:
        folder: for the calibration.
        pulses: the socket that the stimulator sends its pulses to.

    Raises:
        ImuLost: it does not start.
    """
    settings: PatientSettings = settings_for("moderate", seed=11, sensors=(FOOT,), rate_hz=RATE_HZ, speed_mps=1.0)
    calibration = folder / "patient.calibration.json"
    save(patient_calibration(settings), calibration)
    return spawn_patient(pulses, settings, cycle_s=CYCLE_S), calibration


@dataclass(slots=True)
class Punctuality:
    """How well a patient kept real time, and what reached it.

    ``late_5ms``: intervals whose samples went out more than 5 ms after their moment. ``pulses_late``: pulses that came
    after the muscle should have answered, which acted at once instead.
    """

    intervals: int = 0
    latest_ms: float = 0.0
    late_5ms: int = 0
    pulses: int = 0
    pulses_late: int = 0
    charge_uc: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """For summaries."""
        return {**asdict(self), "latest_ms": round(self.latest_ms, 3), "charge_uc": round(self.charge_uc, 3)}


class PatientDevice:
    """Call :meth:`advance` at every deadline, and :meth:`receive` for bytes from the host to a sensor.

    Args:
        settings: who it is; every sensor of ``settings.sensors`` is worn.
        start_ns: the host's time at which the patient's own begins, and it with it; :data:`HELD`: with :meth:`begin`.
        cycle_s: walk and stand in turns, so many seconds each; None: walk on after ``settings.stand_s``.
        waits: stand until it is to walk.
    """

    def __init__(
        self,
        settings: PatientSettings,
        start_ns: int,
        *,
        cycle_s: tuple[float, float] | None = None,
        waits: bool = False,
    ) -> None:
        self.patient = VirtualPatient(settings, remember_s=REMEMBERED_S)
        self.counts = Punctuality()
        self._start_ns = start_ns
        self._step_ns = round(NS_PER_S / settings.rate_hz)
        self._delay_ns = round(settings.muscle.delay_s * NS_PER_S)
        self._interval = 0
        self._cycle_s = cycle_s
        self._walked, self._changed_ns = False, 0
        self._read_strides = 0
        self._held = False
        if waits or cycle_s:
            self.patient.stay()
        self._felt = {
            name: ImuSignal(settings.rate_hz, np.zeros((1, 3)), np.zeros((1, 3))) for name in settings.sensors
        }
        self._imus = {name: self._imu(settings, felt) for name, felt in self._felt.items()}

    def _imu(self, settings: PatientSettings, felt: ImuSignal) -> SimulatedImu:
        imu = settings.imu
        return SimulatedImu(
            XbusWire(settings.rate_hz),
            felt,
            self._start_ns + self._step_ns,
            acc_range_g=(imu.acc_range_mps2 or 16.0 * G_MPS2) / G_MPS2,
            gyr_range_dps=math.degrees(imu.gyr_range_radps or math.radians(2000.0)),
        )

    def begin(self, t_ns: int) -> None:
        """Let the patient's time begin now.

        Raises:
            ValueError: it has begun.
        """
        if self._start_ns != HELD:
            raise ValueError("the patient's time has begun already")
        self._start_ns = t_ns
        self._imus = {name: self._imu(self.patient.settings, felt) for name, felt in self._felt.items()}

    @property
    def now_s(self) -> float:
        """The patient's own time."""
        return self.patient.now_ns / NS_PER_S

    def next_deadline_ns(self) -> int:
        """When the next samples are due."""
        return self._start_ns + (self._interval + 1) * self._step_ns

    def advance(self, t_ns: int, pulses: Sequence[Pulse]) -> dict[str, list[bytes]]:
        """All samples due by ``t_ns``, by sensor; ``pulses`` are those sent since the last call."""
        out: dict[str, list[bytes]] = {name: [] for name in self._imus}
        felt = self._feel(pulses)
        while (due_ns := self.next_deadline_ns()) <= t_ns:
            self._interval += 1
            self._cycle()
            for sample in self.patient.advance(self._interval * self._step_ns, felt):
                self._felt[sample.sensor].acc_mps2[0] = sample.acc_mps2
                self._felt[sample.sensor].gyr_radps[0] = sample.gyr_radps
            felt = []
            for name, imu in self._imus.items():
                out[name] += imu.advance(due_ns)
            late_ns = t_ns - due_ns
            self.counts.intervals += 1
            self.counts.late_5ms += late_ns > LATE_NS
            self.counts.latest_ms = max(self.counts.latest_ms, late_ns * 1e-6)
        if felt:  # came between two deadlines
            self.patient.advance(self.patient.now_ns, felt)
        return out

    def receive(self, sensor: str, t_ns: int, data: bytes) -> list[bytes]:
        """Bytes from the host to a sensor; its answers."""
        return self._imus[sensor].receive(t_ns, data)

    def set_fault(self, sensor: str, t_ns: int, name: str, value: float) -> list[bytes]:
        """Bring a sensor's fault about; what it says.

        Raises:
            ValueError: no such fault or sensor.
        """
        if sensor not in self._imus:
            raise ValueError(f"no sensor {sensor!r} is worn; there are {', '.join(self._imus)}")
        return self._imus[sensor].set_fault(t_ns, name, value)

    def hold(self, held: bool) -> None:
        """Of a patient who walks in turns: stand, once the steps are finished, for as long as this holds."""
        self._held = held

    def new_strides(self) -> list[VirtualStride]:
        """The affected foot's strides, complete since the last call."""
        strides = self.patient.strides[self._read_strides :]
        self._read_strides = len(self.patient.strides)
        return [stride for stride in strides if stride.foot == self.patient.settings.affected_foot]

    # --- inside -----------------------------------------------------------------------------------------

    def _feel(self, pulses: Sequence[Pulse]) -> list[DeliveredPulse]:
        felt = []
        for pulse in pulses:
            t_ns = pulse.t_ns - self._start_ns
            if not (math.isfinite(pulse.current_ma) and math.isfinite(pulse.pulse_width_us)) or t_ns < 0:
                continue
            one = DeliveredPulse(t_ns, pulse.channel, pulse.current_ma, pulse.pulse_width_us)
            felt.append(one)
            self.counts.pulses += 1
            self.counts.charge_uc += one.charge_uc
            self.counts.pulses_late += t_ns + self._delay_ns < self.patient.now_ns
        return felt

    def _cycle(self) -> None:
        if self._cycle_s is None:
            return
        walk_s, stand_s = self._cycle_s
        if self.patient.walking != self._walked:
            self._walked, self._changed_ns = self.patient.walking, self.patient.now_ns
        since_s = (self.patient.now_ns - self._changed_ns) / NS_PER_S
        if self._held or (self._walked and since_s >= walk_s):
            self.patient.stop()
        elif not self._walked and since_s >= stand_s:
            self.patient.walk()
