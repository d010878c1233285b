"""The virtual patient: pulses in, samples of worn sensors out, and the truth of it all.

Sensors that deliver as they go: the faults of :class:`fes.simulation.sensor.ImuModel`, sample by sample.

The same numbers come out however the samples are cut into blocks. The low-pass before sampling is causal here and part
of the compiled loop, so the signal is late by about half a sampling interval, as a real sensor's is.
"""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from fes.config import FootGeometry
from fes.estimation.numerics.jit import inlined, jit
from fes.estimation.numerics.records import Mat, Vec
from fes.signals import FOOT_SENSORS, NS_PER_S, SENSORS, FloatArray, ImuSample
from fes.simulation.forward.dynamics import CALF, DORSIFLEXORS, EVERTORS, NO_EVENT, TRACE
from fes.simulation.forward.integration import run
from fes.simulation.forward.leg import calf_of
from fes.simulation.forward.settings import STEP_NS, DeliveredPulse, PatientSettings
from fes.simulation.forward.walker import FootEvent, VirtualStride, Walker
from fes.simulation.sensor import ImuModel, Placement, draw_sensitivity, mounting

BUFFER: Final = 512  # rows of random numbers drawn at once


def butterworth(model: ImuModel, rate_hz: float) -> FloatArray:
    """(3,) b0, a1, a2 of the second-order low-pass at ``bandwidth · rate_hz``; wide open where that is 0."""
    internal_hz = 1e9 / STEP_NS
    cut_off_hz = min(model.bandwidth * rate_hz or 0.45 * internal_hz, 0.45 * internal_hz)
    k = math.tan(math.pi * cut_off_hz / internal_hz)
    norm = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    return np.array([k * k * norm, 2.0 * (k * k - 1.0) * norm, (1.0 - math.sqrt(2.0) * k + k * k) * norm])


@inlined
def distort(
    ideal: Vec, matrix: Mat, offset: Mat, drift: Mat, walk: Vec, white: Vec, random: Mat, full: Vec, lsb: Vec
) -> None:
    """One sample (6,) of one sensor, in place: axes and scale (2, 3, 3), bias, its walk, noise, range, resolution.

    ``random`` (12,): six numbers for the noise, six for the walk. ``full`` 0 is unlimited, ``lsb`` 0 continuous.
    """
    for part in range(2):
        base = 3 * part
        x, y, z = ideal[base], ideal[base + 1], ideal[base + 2]
        for axis in range(3):
            k = base + axis
            drift[k] += walk[k] * random[6 + k]
            value = x * matrix[part, 0, axis] + y * matrix[part, 1, axis] + z * matrix[part, 2, axis]
            value += offset[k] + drift[k] + white[k] * random[k]
            if full[part] > 0.0:
                value = min(max(value, -full[part]), full[part])
            if lsb[part] > 0.0:
                value = min(max(round(value / lsb[part]) * lsb[part], -full[part]), full[part] - lsb[part])
            ideal[k] = value


@jit
def distort_all(
    rows: Mat, first: int, matrix: Mat, offset: Mat, drift: Mat, walk: Vec, white: Vec, random: Mat, full: Vec, lsb: Vec
) -> None:
    """Samples (N, 4, 6) of four sensors, in place; ``random`` (BUFFER, 4, 12) from row ``first`` on."""
    for number in range(rows.shape[0]):
        for sensor in range(rows.shape[1]):
            distort(
                rows[number, sensor], matrix[sensor], offset[sensor], drift[sensor], walk, white,
                random[first + number, sensor], full, lsb,
            )  # fmt: skip


class SensorBank:
    """The errors of all four sensors; each draws from its own generators, in the order of its samples."""

    def __init__(self, seed: int, model: ImuModel, placements: Mapping[str, Placement], rate_hz: float) -> None:
        self._noise = [np.random.default_rng((seed, 20 + k, 1)) for k in range(len(SENSORS))]
        self._chance = [np.random.default_rng((seed, 20 + k, 2)) for k in range(len(SENSORS))]
        self._matrix = np.empty((4, 2, 3, 3))
        self._offset = np.empty((4, 6))
        for k, name in enumerate(SENSORS):
            rng = np.random.default_rng((seed, 20 + k))
            mount = mounting(*placements[name].angles_deg) if name in placements else np.eye(3)
            for part, bias in enumerate((model.acc_bias_mps2, model.gyr_bias_radps)):
                self._matrix[k, part] = mount @ draw_sensitivity(rng, model).T
                self._offset[k, 3 * part : 3 * part + 3] = bias * rng.uniform(-1.0, 1.0, 3)
        half_band = math.sqrt(0.5 * rate_hz)
        self._white = np.repeat([model.acc_noise_mps2_rthz * half_band, model.gyr_noise_radps_rthz * half_band], 3)
        self._walk = np.repeat([model.acc_walk_mps2_rts, model.gyr_walk_radps_rts], 3) / math.sqrt(rate_hz)
        self._drift = np.zeros((4, 6))
        self._full = np.array([model.acc_range_mps2 or 0.0, model.gyr_range_radps or 0.0])
        self._lsb = self._full / 2.0 ** (model.bits - 1) if model.bits else np.zeros(2)
        self._lost, self._doubled = model.lost, model.doubled
        self._random = np.empty((BUFFER, 4, 12))
        self._arrives = np.ones((BUFFER, 4), np.int64)
        self._row = BUFFER

    def deliver(self, rows: FloatArray) -> list[list[int]] | None:
        """Turn ideal (N, 4, 6) into what is delivered, in place; how often each arrives, None for once each."""
        times: list[list[int]] = []
        done = 0
        while done < len(rows):
            if self._row == BUFFER:
                self._draw()
            count = min(len(rows) - done, BUFFER - self._row)
            distort_all(
                rows[done : done + count], self._row, self._matrix, self._offset, self._drift, self._walk, self._white,
                self._random, self._full, self._lsb,
            )  # fmt: skip
            times += self._arrives[self._row : self._row + count].tolist()
            self._row += count
            done += count
        return times if self._lost or self._doubled else None

    def _draw(self) -> None:
        for k in range(4):
            self._random[:, k] = self._noise[k].normal(size=(BUFFER, 12))
            if self._lost or self._doubled:
                chance = self._chance[k].uniform(size=BUFFER)
                self._arrives[:, k] = np.where(chance < self._lost, 0, np.where(chance > 1.0 - self._doubled, 2, 1))
        self._row = 0


TRACE_EVERY: Final = 10  # internal steps: 200 Hz
TRACE_S: Final = TRACE_EVERY * STEP_NS / NS_PER_S
SETTLE_STEPS: Final = 2000  # the feet settle on the ground before time 0


def _share(what: str, share: float) -> float:
    if not 0.0 <= share <= 1.0:
        raise ValueError(f"{what} {share!r}: must be from 0 to 1")
    return share


class VirtualPatient:
    """Stands for ``settings.stand_s``, then walks on a belt until told otherwise; time begins at 0.

    The same settings and the same pulses give the same samples to the last bit, however the time is cut into steps.

    ``remember_s`` is how much of its own :meth:`trace` it keeps, at least 10 s; None: all of it.
    """

    def __init__(self, settings: PatientSettings, *, remember_s: float | None = None) -> None:
        self.settings = settings
        self._walker = Walker(settings)
        self._step = -SETTLE_STEPS
        self._every = round(NS_PER_S / STEP_NS / settings.rate_hz)
        self._bank = SensorBank(settings.seed, settings.imu, settings.placements, settings.rate_hz)
        self._worn = [(k, name) for k, name in enumerate(SENSORS) if name in settings.sensors]
        # the sensors from the ankle in their segments' axes; a foot's placement is from the sole below the ankle
        bodies = {name: placement.body_m for name, placement in settings.placements.items()}
        self._places = np.array([bodies.get(name, (0.0, 0.0, 0.0)) for name in SENSORS])
        self._places[[name in FOOT_SENSORS and name in bodies for name in SENSORS], 2] -= self.sole_m
        self._taps = butterworth(settings.imu, settings.rate_hz)
        self._straps = np.zeros((4, 3, 2))
        self._filters = np.zeros((4, 6, 2))
        self._values = np.zeros((4, 6))
        self._pulse_step = np.zeros(0, np.int64)
        self._pulse_uc = np.zeros(0)
        self._pulse_of = np.zeros(0, np.int64)
        self._trace: deque[FloatArray] = deque()
        self._kept_rows, self._most_rows = 0, None if remember_s is None else round(max(remember_s, 10.0) / TRACE_S)
        self._trace_rows = 0
        self._quality = settings.electrode_quality
        self._starts_at = round(settings.stand_s * NS_PER_S / STEP_NS)
        self._to(0)

    @property
    def now_ns(self) -> int:
        """How far it has come."""
        return self._step * STEP_NS

    @property
    def strides(self) -> list[VirtualStride]:
        """All strides of both feet that are complete."""
        return self._walker.strides

    @property
    def events(self) -> list[FootEvent]:
        """All events of both feet so far."""
        return self._walker.events

    def advance(self, until_ns: int, pulses: Sequence[DeliveredPulse] = ()) -> list[ImuSample]:
        """Live on to ``until_ns``; what the sensors delivered meanwhile, by time.

        ``until_ns`` is taken down to a whole internal step (0.5 ms). Of the pulses, delivered since the last call, one
        that is late by no more than the muscle's delay has the same effect as in time; a later one acts at once.

        Raises:
            ValueError: time would run backward.
        """
        end = until_ns // STEP_NS
        if end < self._step:
            raise ValueError(f"the patient is at {self.now_ns} ns already; it cannot go back to {until_ns} ns")
        if pulses:
            self._queue(pulses)
        return self._to(end)

    # --- what happens to the patient --------------------------------------------------------------------

    def walk(self) -> None:
        """Start the belt now (it starts by itself after ``stand_s``)."""
        self._walker.walk(self._step * STEP_NS / NS_PER_S)

    def stay(self) -> None:
        """Do not start by itself: stand until :meth:`walk`."""
        self._starts_at = 1 << 60

    def set_speed(self, speed_mps: float) -> None:
        """Change the belt's speed.

        Raises:
            ValueError: not 0.1–2 m/s.
        """
        if not 0.1 <= speed_mps <= 2.0:
            raise ValueError(f"speed_mps = {speed_mps!r}: must be from 0.1 to 2 m/s; to stand, use stop()")
        self._walker.set_speed(speed_mps)

    def stop(self) -> None:
        """Brake the belt: each leg finishes its step and stands. :meth:`walk` goes on."""
        self._walker.stop()

    def turn(self, turn_rad: float) -> None:
        """Turn the feet by this much (to the left positive) over the next strides, at most 30° each."""
        self._walker.turn(turn_rad)

    def set_electrode_quality(self, share: float) -> None:
        """From now on only this share (0–1) of the charge reaches the nerve: an electrode came loose."""
        self._quality = _share("electrode quality", share)

    def set_fitness(self, share: float) -> None:
        """The stimulated muscles have only this share (0–1) of its fresh force left: sudden fatigue."""
        self._walker.muscles["fit"] = _share("fitness", share)

    def set_spasticity(self, share: float) -> None:
        """From now on the affected calf is as spastic as this (0–1), as :attr:`PatientSettings.spasticity` has it."""
        leg = self._walker.legs[self._walker.affected]
        for name, value in calf_of(_share("spasticity", share)).items():
            leg[name] = value

    # --- what is true of it -----------------------------------------------------------------------------

    @property
    def fitness(self) -> float:
        """Share of the fresh force that the stimulated dorsiflexors have left."""
        return float(self._walker.muscles["fit"][DORSIFLEXORS])

    @property
    def sole_m(self) -> float:
        """Height of the ankle over the sole."""
        return float(self._walker.legs["sole_m"][0])

    @property
    def speed_mps(self) -> float:
        """The speed that the belt is set to."""
        return self._walker.speed_mps

    @property
    def walking(self) -> bool:
        """Whether it walks now; until both feet stand again."""
        return self._walker.walking

    @property
    def walks(self) -> list[tuple[float, float]]:
        """When the patient walked: begin and end in s, the last one's end ``inf`` while it goes on."""
        return self._walker.walks

    def trace(self, foot: str) -> dict[str, FloatArray]:
        """One foot's truth at 200 Hz, as far as it is kept; (N,) ``t_s``, ``layout.TRACE``'s entries, ``ankle_rad``."""
        side = FOOT_SENSORS.index(foot)
        rows = self._rows(0, self._trace_rows)[:, side]
        out = {name: rows[:, k] for k, name in enumerate(TRACE)}
        out["t_s"] = TRACE_S * np.arange(self._trace_rows - len(rows) + 1, self._trace_rows + 1, dtype=np.float64)
        out["ankle_rad"] = out["pitch_rad"] - out["shank_rad"]
        return out

    @property
    def geometry(self) -> dict[str, FootGeometry]:
        """Where toe and heel are, seen from each foot's sensor with the foot flat: for a session's settings."""
        geometry = {}
        for side, foot in enumerate(FOOT_SENSORS):
            leg = self._walker.legs[side]
            x, y, z = self._places[side]
            geometry[foot] = FootGeometry(
                toe_forward_m=round(float(leg["ball_x"] + leg["toe_m"]) - x, 4), toe_up_m=round(-leg["sole_m"] - z, 4),
                heel_forward_m=round(float(leg["heel_x"]) - x, 4), heel_up_m=round(-leg["sole_m"] - z, 4),
                toe_left_m=round(-y, 4), heel_left_m=round(-y, 4),
            )  # fmt: skip
        return geometry

    # --- inside -----------------------------------------------------------------------------------------

    def _queue(self, pulses: Sequence[DeliveredPulse]) -> None:
        settings, found = self.settings, []
        groups = {
            settings.channel: (DORSIFLEXORS, settings.muscle),
            settings.evertor_channel: (EVERTORS, settings.evertors),
            settings.calf_channel: (CALF, settings.calf),
        }
        for pulse in pulses:
            if pulse.channel in groups:
                number, muscle = groups[pulse.channel]
                delay_ns = round(muscle.delay_s * NS_PER_S)
                felt_uc = self._quality * muscle.equivalent_uc(pulse.charge_uc, pulse.pulse_width_us)
                found.append((-((pulse.t_ns + delay_ns) // -STEP_NS), felt_uc, number))
                self._walker.add_charge(pulse.t_ns, pulse.charge_uc)
        if not found:
            return
        taken = int(self._walker.belt["pulse"][0])
        self._walker.belt["pulse"][0] = 0
        steps = np.concatenate([self._pulse_step[taken:], np.array([one[0] for one in found], np.int64)])
        order = np.argsort(steps, kind="stable")
        self._pulse_step = steps[order]
        self._pulse_uc = np.concatenate([self._pulse_uc[taken:], [one[1] for one in found]])[order]
        self._pulse_of = np.concatenate([self._pulse_of[taken:], np.array([one[2] for one in found], np.int64)])[order]

    def _to(self, end: int) -> list[ImuSample]:
        blocks: list[tuple[int, FloatArray]] = []
        while self._step < end:
            if self._step >= self._starts_at:
                self._starts_at = 1 << 60
                self.walk()
            stop = min(end, self._starts_at) if self._step < self._starts_at else end
            self._run(stop, blocks)
        return self._deliver(blocks) if blocks else []

    def _run(self, stop: int, blocks: list[tuple[int, FloatArray]]) -> None:
        begin, walker = self._step, self._walker
        samples = np.empty((stop // self._every - begin // self._every, 4, 6))
        trace = np.empty((stop // TRACE_EVERY - begin // TRACE_EVERY, 2, len(TRACE)))
        self._step, side, what = run(
            walker.legs, walker.belt, begin, stop, STEP_NS / NS_PER_S, self._pulse_step, self._pulse_uc,
            self._pulse_of, walker.muscles, walker.affected, self._places, self._straps, self._filters, self._taps,
            self._values, self._every, samples, TRACE_EVERY, trace,
        )  # fmt: skip
        if self._step <= 0:
            return
        count = self._step // self._every - begin // self._every
        if count:
            blocks.append((begin // self._every + 1, samples[:count]))
        rows = self._step // TRACE_EVERY - begin // TRACE_EVERY
        if rows:
            self._trace.append(trace[:rows])
            self._trace_rows += rows
            self._kept_rows += rows
            while self._most_rows is not None and self._kept_rows - len(self._trace[0]) >= self._most_rows:
                self._kept_rows -= len(self._trace.popleft())
        if what != NO_EVENT:
            walker.on_event(
                side,
                what,
                self._step * STEP_NS / NS_PER_S,
                lambda side, from_s, to_s: self._rows(int(from_s / TRACE_S), int(to_s / TRACE_S))[:, side],
            )

    def _rows(self, first: int, last: int) -> FloatArray:
        """Rows ``first`` … ``last`` of the trace, walking back from its newest block."""
        parts: list[FloatArray] = []
        end = self._trace_rows
        for block in reversed(self._trace):
            begin = end - len(block)
            if begin < last and end > first:
                parts.append(block[max(first - begin, 0) : last - begin])
            if begin <= first:
                break
            end = begin
        return np.concatenate(parts[::-1]) if parts else np.zeros((0, 2, len(TRACE)))

    def _deliver(self, blocks: list[tuple[int, FloatArray]]) -> list[ImuSample]:
        out: list[ImuSample] = []
        for first, rows in blocks:
            times = self._bank.deliver(rows)
            for i, row in enumerate(rows.tolist()):
                t_ns = (first + i) * self._every * STEP_NS
                for k, name in self._worn:
                    ax, ay, az, gx, gy, gz = row[k]
                    sample = ImuSample(t_ns, name, t_ns, (ax, ay, az), (gx, gy, gz))
                    if times is None:
                        out.append(sample)
                    else:
                        out += [sample] * times[i][k]
        return out
