"""The virtual patient: pulses in, samples of worn sensors out, and the truth of it all."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from fes.config import FootGeometry
from fes.signals import FOOT_SENSORS, NS_PER_S, SENSORS, FloatArray, ImuSample
from fes.simulation.forward.dynamics import NO_EVENT, TRACE
from fes.simulation.forward.integration import run
from fes.simulation.forward.sensor import SensorBank, butterworth
from fes.simulation.forward.settings import STEP_NS, DeliveredPulse, PatientSettings
from fes.simulation.forward.walker import FootEvent, VirtualStride, Walker

TRACE_EVERY: Final = 10  # internal steps: 200 Hz
TRACE_S: Final = TRACE_EVERY * STEP_NS / NS_PER_S
SETTLE_STEPS: Final = 2000  # the feet settle on the ground before time 0


class VirtualPatient:
    """Stands for ``settings.stand_s``, then walks on a belt until told otherwise; time begins at 0.

    The same settings and the same pulses give the same samples to the last bit, however the time is cut into steps.

    Args:
        settings: who it is.
        remember_s: how much of its own :meth:`trace` it keeps, at least 10 s; None: all of it.
    """

    def __init__(self, settings: PatientSettings, *, remember_s: float | None = None) -> None:
        self.settings = settings
        self._walker = Walker(settings)
        self._step = -SETTLE_STEPS
        self._every = round(NS_PER_S / STEP_NS / settings.rate_hz)
        self._bank = SensorBank(settings.seed, settings.imu, settings.placements, settings.rate_hz)
        self._worn = [(k, name) for k, name in enumerate(SENSORS) if name in settings.sensors]
        self._places = np.array([self._place(name) for name in SENSORS])
        self._taps = butterworth(settings.imu, settings.rate_hz)
        self._filters = np.zeros((4, 6, 2))
        self._values = np.zeros((4, 6))
        self._pulse_step = np.zeros(0, np.int64)
        self._pulse_uc = np.zeros(0)
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

        Args:
            until_ns: not before :attr:`now_ns`; taken down to a whole internal step (0.5 ms).
            pulses: what the stimulator delivered since the last call. One that is late by no more than the muscle's
                delay has the same effect as in time; a later one acts at once.

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
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"electrode quality {share!r}: must be from 0 to 1")
        self._quality = share

    def set_fitness(self, share: float) -> None:
        """The stimulated muscle has only this share (0–1) of its fresh force left: sudden fatigue."""
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"fitness {share!r}: must be from 0 to 1")
        self._walker.legs["fit"][self._walker.affected] = share

    # --- what is true of it -----------------------------------------------------------------------------

    @property
    def fitness(self) -> float:
        """Share of the fresh force that the stimulated muscle has left."""
        return float(self._walker.legs["fit"][self._walker.affected])

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
        first = self._trace_rows - len(rows)
        out["t_s"] = TRACE_S * np.arange(first + 1, first + len(rows) + 1, dtype=np.float64)
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

    def _place(self, name: str) -> list[float]:
        """A sensor from the ankle in its segment's axes; a foot's placement is from the sole below the ankle."""
        placement = self.settings.placements.get(name)
        if placement is None:
            return [0.0, 0.0, 0.0]
        x, y, z = placement.body_m
        return [x, y, z - self.sole_m if name in FOOT_SENSORS else z]

    def _queue(self, pulses: Sequence[DeliveredPulse]) -> None:
        mine = [pulse for pulse in pulses if pulse.channel == self.settings.channel]
        if not mine:
            return
        delay = round(self.settings.muscle.delay_s * NS_PER_S)
        steps = np.array([-((pulse.t_ns + delay) // -STEP_NS) for pulse in mine], np.int64)
        charge = np.array([pulse.charge_uc * self._quality for pulse in mine])
        for pulse in mine:
            self._walker.add_charge(pulse.t_ns, pulse.charge_uc)
        taken = int(self._walker.belt["pulse"][0])
        self._walker.belt["pulse"][0] = 0
        steps = np.concatenate([self._pulse_step[taken:], steps])
        order = np.argsort(steps, kind="stable")
        self._pulse_step = steps[order]
        self._pulse_uc = np.concatenate([self._pulse_uc[taken:], charge])[order]

    def _to(self, end: int) -> list[ImuSample]:
        blocks: list[tuple[int, FloatArray]] = []
        while self._step < end:
            if self._starts_at is not None and self._step >= self._starts_at:
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
            walker.affected, self._places, self._filters, self._taps, self._values, self._every, samples, TRACE_EVERY,
            trace,
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
            walker.on_event(side, what, self._step * STEP_NS / NS_PER_S, self._swing_rows)

    def _swing_rows(self, side: int, from_s: float, to_s: float) -> FloatArray:
        first, last = int(from_s / TRACE_S), int(to_s / TRACE_S)
        return self._rows(first, last)[:, side]

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
