"""A second virtual patient, that judges the tuning and that nobody tunes on: another body, another muscle, another IMU.

It shares no code and no constant with :mod:`fes.simulation.forward`, which the tuning was developed with. What differs:

- *Body*: one foot only, overground. Pivots of heel and ball in stance are prescribed; in swing the ankle goes along
  polynomials, and the foot turns about it as a pendulum on a stiffening spring, which stimulation lifts.
- *Muscle*: Lapicque's law (threshold current ``rheobase / (1 - exp(-width / tau))``), recruitment as a logistic of the
  current, a critically damped second-order twitch, torque that falls with the muscle's length, and a capacity that is
  used up with the square of the activation. The first patient has Weiss's law, a ramp over charge, calcium and
  first-order activation, and a linear tiring.
- *Sensor*: coloured noise of shoe and strap after every contact instead of a resonance, coarser and noisier axes.

Ranges are chosen by what adults show, before any tuning was run on it; each has its unit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from random import Random
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from fes.config import FootGeometry
from fes.estimation.numerics.jit import jit
from fes.signals import NS_PER_S, FloatArray, ImuSample
from fes.simulation.forward import DeliveredPulse, VirtualStride

G: Final = 9.81  # m/s²
STEP_S: Final = 0.001
RATE_STEPS: Final = 10  # 100 Hz
FOOT: Final = "right_foot"
MIDDLE, LATE = (0.30, 0.80), (0.25, 0.90)  # shares of the swing: where clearance counts, where a drag does
STOPS: Final = 0.3  # a sample: heel pad and shoe stop the foot within some 30 ms
RETURNS: Final = 0.3  # of the rattle: leaves two thirds of the power below 5 Hz, as real feet have (0.66)
STAND, PIVOT_HEEL, FLAT, PIVOT_BALL, SWING = range(5)


@dataclass(frozen=True, slots=True)
class SecondSettings:
    """One person; SI units, angles in degrees where the name says so."""

    seed: int
    speed_mps: float
    stride_s: float
    stance_share: float
    toe_m: float  # from the ankle forward
    heel_m: float  # from the ankle back
    sole_m: float  # ankle over the sole
    drop_deg: float  # where the relaxed foot hangs in mid-swing, toe-down positive
    swing_hz: float  # natural frequency of the hanging foot
    lift_m: float  # how much higher than needed for a level foot the ankle passes
    habit: float  # share of a dropped foot's lack that hip and knee make up
    spread_m: float  # standard deviation of the ankle's height from stride to stride
    time_spread: float  # of the stride time
    push_deg: float  # foot pitch as it leaves the ground, toe-down positive
    rheobase_ma: float  # current that recruits half, of a pulse without end
    tau_s: float  # of Lapicque's law
    slope: float  # of the logistic, as a share of rheobase
    strength_deg: float  # by how much full recruitment would lift the foot against its spring
    twitch_s: float  # contraction time
    delay_s: float
    tiring_s: float
    recovery_s: float
    cocontraction: float  # share of a stimulated torque in pre-swing that takes from the push-off
    rattle_mps2: float  # of shoe and strap after a contact
    mount_deg: tuple[float, float, float]
    place_m: tuple[float, float, float]  # sensor from the ankle
    invert_deg: float  # at contact without stimulation
    stand_s: float = 3.5
    rate_hz: float = 100.0
    affected_foot: str = FOOT
    sensors: tuple[str, ...] = (FOOT,)
    evertor_channel: int | None = None


def draw_second(seed: int) -> SecondSettings:
    """The person of this seed."""
    r = Random(f"second/{seed}")
    speed_mps = r.triangular(0.25, 1.25, 0.6)
    cadence = math.sqrt(60.0 * speed_mps / r.uniform(0.0052, 0.0066))  # steps a minute, by the walk ratio
    toe_m = r.uniform(0.165, 0.215)
    return SecondSettings(
        seed=seed, speed_mps=speed_mps, stride_s=min(120.0 / cadence, 2.3),
        stance_share=min(0.60 + 0.10 * (1.0 - speed_mps) + r.gauss(0.0, 0.01), 0.70),
        toe_m=toe_m, heel_m=r.uniform(0.045, 0.065), sole_m=r.uniform(0.085, 0.115),
        drop_deg=r.uniform(13.0, 24.0), swing_hz=r.uniform(2.6, 3.6), lift_m=r.uniform(0.004, 0.014),
        habit=r.uniform(0.1, 0.6), spread_m=r.uniform(0.003, 0.0065), time_spread=r.uniform(0.015, 0.04),
        push_deg=r.uniform(38.0, 56.0) * min(0.7 + 0.3 * speed_mps, 1.0),
        rheobase_ma=r.uniform(11.0, 20.0), tau_s=r.uniform(150e-6, 350e-6), slope=r.uniform(0.12, 0.25),
        strength_deg=r.uniform(24.0, 40.0), twitch_s=r.uniform(0.055, 0.085), delay_s=r.uniform(0.012, 0.040),
        tiring_s=r.uniform(80.0, 500.0), recovery_s=r.uniform(90.0, 600.0), cocontraction=r.uniform(0.5, 1.0),
        rattle_mps2=r.uniform(12.0, 22.0),
        mount_deg=(r.gauss(0.0, 5.0), r.uniform(10.0, 24.0), r.gauss(0.0, 5.0)),
        place_m=(r.uniform(0.05, 0.09), r.gauss(0.0, 0.006), r.uniform(-0.04, -0.01)),
        invert_deg=r.gauss(4.0, 3.0),
    )  # fmt: skip


@jit
def _run(
    state: FloatArray, plan: FloatArray, body: FloatArray, count: int, recruited: FloatArray, out: FloatArray
) -> int:
    """Live on for ``count`` steps or until the phase ends; how many were lived.

    ``state`` (6,): time in the phase, pitch, its rate, activation, its rate, capacity. ``plan`` (23,): phase, its
    duration, a pivot's x, where that is on the foot (x, z), and the coefficients of pitch (6), ankle's x (6) and z (6).
    ``out`` (N, 9): pitch, its rate and acceleration, the ankle's acceleration (x, z), toe's height, activation, share.
    """
    hang, stiff, damp, lift, twitch, tiring, recovery, toe, heel, sole = body
    swings, duration = plan[0] == 4.0, plan[1]
    for k in range(count):
        t, pitch, rate, act, act_rate, fit = state
        act_acc = (recruited[k] - act) / (twitch * twitch) - 2.0 * act_rate / twitch
        fit += STEP_S * ((1.0 - fit) / recovery - fit * act * act / tiring)
        act_rate += STEP_S * act_acc
        act = min(max(act + STEP_S * act_rate, 0.0), 1.0)
        t += STEP_S
        share = t / duration
        if swings:
            x_acc = z = z_acc = 0.0
            for n in range(6):
                z += plan[17 + n] * t**n
                if n > 1:
                    x_acc += n * (n - 1) * plan[11 + n] * t ** (n - 2)
                    z_acc += n * (n - 1) * plan[17 + n] * t ** (n - 2)
            hump = plan[3]  # the extra height in mid-swing: a bump of (4 s (1 - s))**3
            bow = 4.0 * share * (1.0 - share)
            if 0.0 < share < 1.0:
                z += hump * bow**3
                slope = 4.0 * (1.0 - 2.0 * share) / duration
                z_acc += hump * (6.0 * bow * slope * slope - 24.0 * bow * bow / (duration * duration))
            tilt = -0.44 * (1.0 - min(share, 1.0)) ** 2 + 0.21 * min(share, 1.0) ** 2  # of the shank, from its middle
            away = pitch - hang - tilt
            end = max(pitch - tilt - 0.10, 0.0)  # the calf's
            acc = stiff * (lift * act * fit * math.exp(-((away / 1.1) ** 2)) - away - 4.0 * end) - damp * rate
            toe_z = z + toe * math.sin(pitch) - sole * math.cos(pitch)
            if toe_z < 0.0:  # the ground holds the toe up
                acc += 9000.0 * (-toe_z) - 40.0 * min(rate, 0.0)
            rate += STEP_S * acc
            pitch += STEP_S * rate
            toe_z = z + toe * math.sin(pitch) - sole * math.cos(pitch)
            lowest = min(toe_z, z - heel * math.sin(pitch) - sole * math.cos(pitch))
            over = (share > 0.85 and lowest <= 0.0) or share > 1.4
        else:
            pitch = rate = acc = 0.0
            for n in range(6):
                pitch += plan[5 + n] * t**n
                if n > 0:
                    rate += n * plan[5 + n] * t ** (n - 1)
                if n > 1:
                    acc += n * (n - 1) * plan[5 + n] * t ** (n - 2)
            # the ankle about the pivot: minus what the pivot would do about the ankle
            px = -plan[3] * math.cos(pitch) + plan[4] * math.sin(pitch)
            pz = -plan[3] * math.sin(pitch) - plan[4] * math.cos(pitch)
            x_acc = -acc * pz - rate * rate * px
            z_acc = acc * px - rate * rate * pz
            toe_z, over = 0.0, t >= duration
        state[0], state[1], state[2], state[3], state[4], state[5] = t, pitch, rate, act, act_rate, fit
        out[k, 0], out[k, 1], out[k, 2], out[k, 3], out[k, 4] = pitch, rate, acc, x_acc, z_acc
        out[k, 5], out[k, 6], out[k, 7] = toe_z, act * fit, share
        if over:
            return k + 1
    return count


def _quintic(duration: float, begin: Sequence[float], end: Sequence[float]) -> FloatArray:
    """(6,) coefficients from value, rate and acceleration at both ends."""
    t = duration
    rows = [
        [1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 2, 0, 0, 0],
        [1, t, t**2, t**3, t**4, t**5], [0, 1, 2 * t, 3 * t**2, 4 * t**3, 5 * t**4],
        [0, 0, 2, 6 * t, 12 * t**2, 20 * t**3],
    ]  # fmt: skip
    return np.linalg.solve(np.array(rows, dtype=np.float64), np.array([*begin, *end], dtype=np.float64))


class SecondPatient:
    """Stands, then walks on; as :class:`fes.simulation.forward.VirtualPatient`, as far as the benchmark asks."""

    def __init__(self, settings: SecondSettings) -> None:
        self.settings = s = settings
        self.strides: list[VirtualStride] = []
        self.walking = True
        self._rng = np.random.default_rng((s.seed, 77))
        self._quality, self._fit_cap = 1.0, 1.0
        self._hang = -math.radians(s.drop_deg)
        stiff = (2.0 * math.pi * s.swing_hz) ** 2
        lift = math.radians(s.strength_deg)
        self._body = np.array([
            self._hang, stiff, 1.1 * math.sqrt(stiff), lift, 0.5 * s.twitch_s, s.tiring_s, s.recovery_s,
            s.toe_m, s.heel_m, s.sole_m,
        ])  # fmt: skip
        self._state = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        self._plan = np.zeros(23)
        self._phase, self._step, self._habit = STAND, 0, s.habit
        self._plan[:2] = STAND, s.stand_s
        self._drive = np.zeros(1_000_000)
        self._charges: list[tuple[int, float]] = []
        self._mount = Rotation.from_euler("xyz", s.mount_deg, degrees=True).as_matrix().T
        self._bias = self._rng.uniform(-1.0, 1.0, 6) * np.repeat([0.06, 0.006], 3)
        self._scale = 1.0 + 0.008 * self._rng.normal(size=6)
        self._pose = (0.0, s.sole_m)  # of the ankle
        self._stride_s, self._contact_step, self._felt_m = s.stride_s, 0, math.nan
        self._rattles = np.zeros((3, 3))  # the newest sample's and the two before it
        self._rattle_of, self._roll, self._error = np.zeros(3), 0.0, 0.0
        self._stop_mps = np.zeros(2)  # of the ankle, taken by the ground at contact and not yet felt
        self._marks: dict[str, float] = {}
        self._swing: list[FloatArray] = []
        self._push: list[float] = []
        self._rows: list[FloatArray] = []

    @property
    def geometry(self) -> dict[str, FootGeometry]:
        """Where toe and heel are, from the sensor."""
        s, (x, y, z) = self.settings, self.settings.place_m
        toe, heel, up = round(s.toe_m - x, 4), round(-s.heel_m - x, 4), round(-s.sole_m - z, 4)
        side = round(-y, 4)
        return {
            FOOT: FootGeometry(
                toe_forward_m=toe, toe_up_m=up, heel_forward_m=heel, heel_up_m=up, toe_left_m=side, heel_left_m=side
            )
        }

    def set_electrode_quality(self, share: float) -> None:
        """From now on only this share of the current reaches the nerve."""
        self._quality = share

    def advance(self, until_ns: int, pulses: Sequence[DeliveredPulse] = ()) -> list[ImuSample]:
        """Live on to a time; what the sensor delivered meanwhile."""
        s = self.settings
        for pulse in pulses:
            reached_ma = self._quality * pulse.current_ma * (1.0 - math.exp(-1e-6 * pulse.pulse_width_us / s.tau_s))
            share = 1.0 / (1.0 + math.exp(-(reached_ma / s.rheobase_ma - 1.0) / s.slope)) if pulse.current_ma else 0.0
            at = max(round(1e-6 * pulse.t_ns + 1e3 * s.delay_s), self._step)
            self._drive[at : at + 30] = max(share - 1.0 / (1.0 + math.exp(1.0 / s.slope)), 0.0)
            self._charges.append((pulse.t_ns, pulse.charge_uc))
        samples: list[ImuSample] = []
        end = until_ns // 1_000_000
        while self._step < end:
            count = min(end, (self._step // RATE_STEPS + 1) * RATE_STEPS) - self._step
            out = np.zeros((count, 9))
            lived = _run(self._state, self._plan, self._body, count, self._drive[self._step : self._step + count], out)
            self._step += lived
            self._note(out[:lived])
            if lived < count or self._over():
                self._next()
            if self._step % RATE_STEPS == 0:
                samples.append(self._sample())
        return samples

    # --- inside -----------------------------------------------------------------------------------------

    def _over(self) -> bool:
        t, plan = self._state[0], self._plan
        return bool(t >= plan[1] - 1e-9) if self._phase != SWING else bool(self._landed)

    _landed = False

    def _note(self, out: FloatArray) -> None:
        self._rows.append(out)
        if self._phase == SWING:
            self._swing.append(out)
            last = out[-1]
            low = min(last[5], self._heel_m(float(last[0]), float(self._state[0])))
            self._landed = bool((last[7] > 0.85 and low <= 0.0) or last[7] > 1.4)
        elif self._phase == PIVOT_BALL:
            self._push.append(float(out[:, 6].mean()))

    def _height_m(self, t: float) -> float:
        plan = self._plan
        share = t / plan[1]
        bow = 4.0 * share * (1.0 - share)
        return float(sum(plan[17 + n] * t**n for n in range(6)) + (plan[3] * bow**3 if 0.0 < share < 1.0 else 0.0))

    def _heel_m(self, pitch: float, t: float) -> float:
        s = self.settings
        return self._height_m(t) - s.heel_m * math.sin(pitch) - s.sole_m * math.cos(pitch)

    def _begin(self, phase: int, duration: float) -> None:
        self._phase, self._landed = phase, False
        self._plan[:] = 0.0
        self._plan[:2] = phase, duration
        self._state[0] = 0.0

    def _pivot(self, on_foot_m: float, duration: float, to_rad: float, rate_radps: float) -> None:
        """Turn about a point of the sole to a pitch."""
        s, pitch, rate = self.settings, float(self._state[1]), float(self._state[2])
        phase = PIVOT_BALL if to_rad < 0.0 else PIVOT_HEEL
        self._begin(phase, duration)
        self._plan[3:5] = on_foot_m, -s.sole_m
        self._plan[5:11] = _quintic(duration, (pitch, rate, 0.0), (to_rad, rate_radps, 0.0))

    def _next(self) -> None:
        """The phase is over: note it, and begin the next."""
        s = self.settings
        now_s = STEP_S * self._step
        if self._phase in (STAND, FLAT):
            self._marks = {"heel_off": now_s}
            self._push = []
            if self._phase == STAND:
                self._contact_step = self._step
            self._error = 0.5 * self._error + 0.87 * s.time_spread * float(np.clip(self._rng.normal(), -2.5, 2.5))
            self._stride_s = s.stride_s * (1.0 + self._error)
            push = math.radians(s.push_deg) * (1.0 + 0.05 * self._rng.normal())
            self._pivot(s.toe_m, 0.17 * self._stride_s, -push, -1.2)
        elif self._phase == PIVOT_BALL:
            self._marks["foot_off"] = now_s
            self._fly(float(self._rows[-1][-1][3]), float(self._rows[-1][-1][4]))
        elif self._phase == SWING:
            self._land(now_s)
        else:
            stride_end_s = self._marks["contact"] + (s.stance_share - 0.17) * self._stride_s
            self._finish(now_s)
            self._begin(FLAT, max(stride_end_s - now_s, 0.15))
            self._state[1] = self._state[2] = 0.0
            self._roll = 0.0

    def _fly(self, x_acc: float, z_acc: float) -> None:
        s = self.settings
        pitch, rate = float(self._state[1]), float(self._state[2])
        dx, dz = (
            -s.toe_m * math.cos(pitch) - s.sole_m * math.sin(pitch),
            -s.toe_m * math.sin(pitch) + s.sole_m * math.cos(pitch),
        )
        lost = s.cocontraction * min(sum(self._push) / max(len(self._push), 1), 1.0)
        duration = (1.0 - s.stance_share) * self._stride_s
        length = s.speed_mps * s.stride_s * (1.0 + 0.03 * self._rng.normal()) * (1.0 - 0.08 * lost)
        self._marks |= {"lost": lost, "length": length}
        self._begin(SWING, duration)
        x_end = length + s.toe_m
        end_z = s.sole_m + 0.010
        self._plan[11:17] = _quintic(
            duration, (dx + s.toe_m, -rate * dz, x_acc), (x_end - s.toe_m, 0.12 * s.speed_mps, 0.0)
        )
        self._plan[17:23] = _quintic(duration, (dz, rate * dx, z_acc), (end_z, -0.16, 0.0))
        lack_m = s.toe_m * math.sin(-self._hang)
        wanted_m = (
            s.sole_m
            + 0.018
            + s.lift_m
            + self._habit * lack_m
            + s.spread_m * float(np.clip(self._rng.normal(), -2.5, 2.5))
        )
        bow = (4.0 * 0.62 * 0.38) ** 3
        self._plan[3] = (wanted_m - self._height_m(0.62 * duration)) / bow
        self._swing = []

    def _land(self, now_s: float) -> None:
        s, pitch = self.settings, float(self._state[1])
        self._marks |= {
            "contact": now_s,
            "pitch": pitch,
            "roll": math.radians(s.invert_deg) + 0.02 * self._rng.normal(),
        }
        impact = min(abs(0.16 + 0.05 * self._rng.normal()) / 0.16, 2.0)
        self._rattle_of = s.rattle_mps2 * impact * self._rng.normal(size=3)
        before = self._ankle_mps()
        self._pivot(-s.heel_m if pitch > 0.0 else s.toe_m, 0.07 + 0.05 * self._stride_s, 0.0, 0.0)
        self._phase = PIVOT_HEEL
        self._plan[0] = PIVOT_HEEL
        self._stop_mps += self._ankle_mps() - before

    def _ankle_mps(self) -> FloatArray:
        """The ankle's velocity forward and up, by the plan of the phase."""
        t, pitch, rate = (float(value) for value in self._state[:3])
        plan = self._plan
        if self._phase == SWING:
            rise = (self._height_m(t + 0.5 * STEP_S) - self._height_m(t - 0.5 * STEP_S)) / STEP_S
            return np.array([sum(n * plan[11 + n] * t ** (n - 1) for n in range(1, 6)), rise])
        px = -plan[3] * math.cos(pitch) + plan[4] * math.sin(pitch)
        pz = -plan[3] * math.sin(pitch) - plan[4] * math.cos(pitch)
        return np.array([-rate * pz, rate * px])

    def _finish(self, now_s: float) -> None:
        s, marks = self.settings, self._marks
        rows = np.concatenate(self._swing)
        toe, share = rows[:, 5], np.arange(len(rows)) / len(rows)
        middle = toe[(share >= MIDDLE[0]) & (share < MIDDLE[1])]
        late = toe[(share >= LATE[0]) & (share < LATE[1])]
        drag_s = STEP_S * float((late < 0.0005).sum())
        charge_uc = sum(uc for t_ns, uc in self._charges if t_ns <= marks["contact"] * NS_PER_S)
        self._charges = [one for one in self._charges if one[0] > marks["contact"] * NS_PER_S]
        clear_m = float(middle.min())
        self._felt_m = clear_m if math.isnan(self._felt_m) else 0.7 * self._felt_m + 0.3 * clear_m
        if drag_s > 0.02:
            self._habit += 0.15 * (s.habit - self._habit)
        elif self._felt_m > 0.022:
            self._habit *= 0.94
        self.strides.append(
            VirtualStride(
                foot=FOOT, number=len(self.strides) + 1, t_heel_off_ns=_ns(marks["heel_off"]),
                t_foot_off_ns=_ns(marks["foot_off"]), t_contact_ns=_ns(marks["contact"]), t_flat_ns=_ns(now_s),
                stride_length_m=marks["length"], speed_mps=s.speed_mps, toe_clearance_m=clear_m, heel_clearance_m=0.0,
                pitch_at_contact_rad=marks["pitch"], ankle_at_contact_rad=marks["pitch"],
                inversion_at_contact_rad=marks["roll"], drag_s=drag_s, dragged=drag_s > 0.02,
                stumbled=drag_s > 0.06 and float(self._rng.uniform()) < 0.2, charge_uc=charge_uc, peak_torque_nm=0.0,
                walking=True, pitch_at_foot_off_rad=-math.radians(s.push_deg), push_off_j=10.0,
                opposed_j=10.0 * marks["lost"], spasm=0.0, co_contraction_nms=0.0,
            )
        )  # fmt: skip

    def _sample(self) -> ImuSample:
        """The mean of the last ten milliseconds, as the sensor has it."""
        s, rng = self.settings, self._rng
        rows = np.concatenate(self._rows)
        self._rows = [rows[-1:]]
        pitch, rate, acc, x_acc, z_acc = (float(rows[-RATE_STEPS:, k].mean()) for k in range(5))
        cos, sin, (px, _, pz) = math.cos(pitch), math.sin(pitch), s.place_m
        ox, oz = px * cos - pz * sin, px * sin + pz * cos  # pitch turns the foot's x up
        stop = STOPS * self._stop_mps  # m/s, of what is left, in this sample
        self._stop_mps = self._stop_mps - stop
        x_acc, z_acc = np.array([x_acc, z_acc]) + stop / (STEP_S * RATE_STEPS)
        ax, az = x_acc - acc * oz - rate * rate * ox, z_acc + acc * ox - rate * rate * oz + G
        swing = self._phase == SWING
        target = math.radians(s.invert_deg) if swing else 0.0
        before, self._roll = self._roll, self._roll + 0.12 * (target - self._roll)
        force = np.array([ax * cos + az * sin, 0.0, -ax * sin + az * cos])
        force[1] += force[2] * math.sin(self._roll)
        rattle = 0.55 * self._rattles[0] + self._rattle_of + (0.5 if swing else 0.0) * rng.normal(size=3)
        self._rattle_of = -0.6 * self._rattle_of if np.abs(self._rattle_of).max() > 0.3 else np.zeros(3)
        self._rattles = np.vstack([rattle, self._rattles[:2]])
        # what moves on a foot comes back to where it was: its acceleration integrates to nothing, twice
        force += RETURNS * (self._rattles[0] - 2.0 * self._rattles[1] + self._rattles[2])
        rates = np.array([100.0 * (self._roll - before), -rate, 0.02 * rng.normal() if swing else 0.0])
        both = np.concatenate([self._mount @ force, self._mount @ rates]) * self._scale + self._bias
        both += rng.normal(size=6) * np.repeat([0.03, 0.003], 3)
        both = np.round(both / np.repeat([0.0048, 0.00106], 3)) * np.repeat([0.0048, 0.00106], 3)
        t_ns = self._step * 1_000_000
        a, b, c, d, e, f = both.tolist()
        return ImuSample(t_ns, FOOT, t_ns, (a, b, c), (d, e, f))


def _ns(t_s: float) -> int:
    return round(t_s * NS_PER_S)
