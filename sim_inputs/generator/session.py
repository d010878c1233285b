"""A whole recorded session: feet, belt, what is done when, and its rendering into a recording and its truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from fes.config import FootGeometry
from fes.recording import Recording, Track
from fes.signals import FOOT_SENSORS, FloatArray, Vector3
from fes.simulation.sensor import FINE_HZ, ImuModel, Placement, mounting
from fes.simulation.truth import Activity
from sim_inputs.generator.foot import FootPath, Rocker, Sole, stack
from sim_inputs.generator.measured import ideal_signals, measure
from sim_inputs.generator.motion import Jet, evaluate, zeros
from sim_inputs.generator.walk import Belt, Foot, Style, add_sway, other_times, single_times, write_walk

STANDING_SWAY_DEG = 0.05
WALKING_SWAY_DEG = 0.65
BELT_SHAKE_M = 14e-6
TOE_PITCH_RAD, HEEL_PITCH_RAD = 0.44, -0.35  # the toe is where the sole touches at 25° toe-down, the heel at 20° up


@dataclass(slots=True)
class Session:
    """A recorded session in the making: fill it with activities, then render it.

    ``now_s`` is how far it has come; the belt's incline is uphill positive. One generator feeds it all, so a seed fixes
    every number.
    """

    name: str
    seed: int
    feet: dict[str, Foot]
    placements: dict[str, Placement]
    rng: np.random.Generator = field(init=False)
    belt: Belt | None = None
    activities: list[Activity] = field(default_factory=list)
    now_s: float = 0.0
    incline_percent: float = 0.0
    rocker: Rocker = field(default_factory=lambda: Rocker(Sole()))

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    def do(self, activity: str, end_s: float, *, walking: bool = False) -> None:
        """The person has done ``activity`` until ``end_s``."""
        self.activities.append(Activity(self.now_s, end_s, activity, walking))
        self.now_s = end_s

    def stand(self, seconds: float) -> None:
        """Quiet standing."""
        self.do("standing", self.now_s + seconds)

    def walk(
        self, styles: dict[str, Style], count: int, speed_mps: float, *, ramp_s: float, early: bool, share: float = 0.5
    ) -> None:
        """The belt starts, each foot does ``count`` strides, the belt stops.

        The first heel lifts after the belt has reached its speed, or, ``early``, while it still speeds up. The first
        of ``styles`` leads; ``share`` of its cycle later the other foot follows.
        """
        names = list(styles)
        start = self.now_s
        belt = Belt(start, ramp_s, 1e6, speed_mps)
        first = start + (0.25 * ramp_s if early else ramp_s + 0.5)
        times = {names[0]: single_times(self.rng, styles[names[0]], first, count, belt)}
        for name in names[1:]:
            times[name] = other_times(self.rng, styles[name], times[names[0]], share)
        end_flat = max(instants[-1].flat for instants in times.values())
        belt = self.belt = Belt(start, ramp_s, end_flat + 0.45, speed_mps)
        landing = None
        for name in names:
            foot = self.feet[name]
            end = end_flat + 0.9
            write_walk(self.rng, foot, styles[name], times[name], belt, end, landing)
            landing = foot.along_m
            add_sway(self.rng, foot, start, belt.stop_s + ramp_s, WALKING_SWAY_DEG, BELT_SHAKE_M)
        self.do("treadmill_start", first)
        self.do("walking", end_flat, walking=True)
        self.do("treadmill_stop", belt.stop_s + ramp_s)

    def finish(self) -> None:
        """Nobody stands like a statue: small movements over the whole session."""
        for foot in self.feet.values():
            add_sway(self.rng, foot, 0.0, self.now_s, STANDING_SWAY_DEG, 0.0)

    def path(self, foot: str, t_s: FloatArray) -> FootPath:
        """One foot's channels at the ascending instants ``t_s`` (N,)."""
        return self.feet[foot].motion.at(t_s)

    @property
    def toe_m(self) -> Vector3:
        """The toe in the foot frame."""
        x, z = self.rocker.ground.contact(np.array([TOE_PITCH_RAD]))[0]
        return float(x), 0.0, float(z)

    @property
    def heel_m(self) -> Vector3:
        """The heel in the foot frame."""
        x, z = self.rocker.ground.contact(np.array([HEEL_PITCH_RAD]))[0]
        return float(x), 0.0, float(z)

    def geometry(self, foot: str) -> FootGeometry:
        """Where toe and heel are, seen from the sensor with the foot flat."""
        (tx, _, tz), (hx, _, hz), (x, _, z) = self.toe_m, self.heel_m, self.placements[foot].body_m
        return FootGeometry(
            toe_forward_m=round(tx - x, 4), toe_up_m=round(tz - z, 4),
            heel_forward_m=round(hx - x, 4), heel_up_m=round(hz - z, 4),
        )  # fmt: skip

    def belt_travel(self, t_s: FloatArray) -> Jet:
        """How far the belt has gone (m) at ``t_s`` (N,); the lab is the walking frame moved back by it."""
        return evaluate(self.belt.blocks, t_s) if self.belt else zeros(len(t_s))

    def ideal(self, foot: str, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Specific force (m/s²) and angular rate (rad/s) in sensor axes, (N, 3) each, of a faultless sensor."""
        path = self.path(foot, t_s)
        _, _, acceleration = stack(path.sensor(self.rocker, self.placements[foot].body_m))
        # the walking frame rides on the belt; what the sensor feels is its acceleration in the lab
        acceleration[:, 0] -= self.belt_travel(t_s).acceleration
        mount = mounting(*self.placements[foot].angles_deg)
        slope = math.atan(0.01 * self.incline_percent)
        up = np.array((math.sin(slope), 0.0, math.cos(slope)))  # seen from the belt
        return ideal_signals(acceleration, path.sensor_rotation(), path.sensor_rate(), mount, up)

    def track(self, foot: str, rate_hz: float, model: ImuModel) -> Track:
        """What the foot's sensor delivers, sampled at ``rate_hz``."""
        fine = np.arange(int(self.now_s * FINE_HZ) + 1) / FINE_HZ
        force, rate = self.ideal(foot, fine)
        return measure(self.rng, model, foot, rate_hz, fine, force, rate)

    def recording(self, rate_hz: float, model: ImuModel, description: str) -> Recording:
        """All feet's tracks; call once, after :meth:`finish`, for the generator goes on."""
        names = [name for name in FOOT_SENSORS if name in self.feet]
        return Recording(
            name=self.name,
            path=None,
            tracks={name: self.track(name, rate_hz, model) for name in names},
            belt_speed_mps=self.belt.speed_mps if self.belt else None,
            subject="simulated",
            description=description,
            geometry={name: self.geometry(name) for name in names},
            extra={"simulated": True, "seed": self.seed, "generator": "fes.simulation"},
        )


def new_session(name: str, seed: int, placements: dict[str, Placement], toe_out_deg: float = 7.0) -> Session:
    """An empty session with a foot standing at its place for each of ``placements``."""
    feet = {}
    for foot_name in placements:
        feet[foot_name] = Foot(foot_name)
        feet[foot_name].place(toe_out_deg)
    return Session(name, seed, feet, placements)
