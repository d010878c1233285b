"""What a person does on a treadmill: walk, no stride like the last, stand, shift weight, turn, sit, get up."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from sim_inputs.generator.foot import FootMotion
from sim_inputs.generator.gait import StridePlan, write_stride
from sim_inputs.generator.motion import Pulse, Ring, Step, evaluate, wander

HALF_WIDTH_M = 0.08  # half of the step width


@dataclass(frozen=True, slots=True)
class Style:
    """How one foot walks: means (s, m, m/s, m/s², degrees) and, in ``spread_*``, standard deviations.

    ``spread_pre_swing … spread_stance`` are fractions of the mean, ``spread_deg`` is in degrees and holds for all
    angles, ``spread_m`` for landing spots and ``spread_clearance`` is a fraction. For the rest see
    :class:`sim_inputs.generator.gait.StridePlan`. In a pair of feet the second one's stance is what its cycle leaves.
    """

    pre_swing_s: float
    swing_s: float
    loading_s: float
    stance_s: float
    push_deg: float
    strike_deg: float
    dangle_deg: float = 0.0
    invert_deg: float = 3.0
    swerve_deg: float = 3.0
    toe_out_deg: float = 7.0
    circumduction_m: float = 0.02
    lift_m: float = 0.048
    toe_clearance_m: float = 0.018
    fall_mps: float = 0.43
    forward_mps: float = 0.70
    stop_s: float = 0.018
    ring_mps2: float = 15.0
    drift_deg: float = 2.0
    creep_m: float = 0.0018
    slow_share: float = 0.4
    jolt_mps2: float = 1.8
    contact: str = "heel"
    spread_pre_swing: float = 0.03
    spread_swing: float = 0.02
    spread_loading: float = 0.10
    spread_stance: float = 0.04
    spread_deg: float = 1.2
    spread_m: float = 0.018
    spread_clearance: float = 0.15

    @property
    def cycle_s(self) -> float:
        """Mean stride time."""
        return self.pre_swing_s + self.swing_s + self.loading_s + self.stance_s


@dataclass(frozen=True, slots=True)
class Belt:
    """A treadmill that starts at ``start_s``, runs at ``speed_mps`` after ``ramp_s`` and brakes from ``stop_s`` on."""

    start_s: float
    ramp_s: float
    stop_s: float
    speed_mps: float

    @property
    def blocks(self) -> list[Pulse]:
        """The belt's travel."""
        return [Pulse(self.start_s, self.start_s + self.ramp_s, self.stop_s, self.stop_s + self.ramp_s, self.speed_mps)]

    def travel(self, t_s: float) -> tuple[float, float]:
        """How far the belt has gone (m) and how fast it goes (m/s) at one instant."""
        jet = evaluate(self.blocks, np.array([t_s]))
        return float(jet.value[0]), float(jet.rate[0])

    def steady(self, from_s: float, to_s: float) -> bool:
        """Whether the belt keeps its full speed throughout."""
        return from_s >= self.start_s + self.ramp_s and to_s <= self.stop_s


@dataclass(slots=True)
class Foot:
    """One foot of a walker: its motion so far and the strides planned, with where it stands."""

    name: str
    motion: FootMotion = field(default_factory=FootMotion)
    plans: list[StridePlan] = field(default_factory=list)
    along_m: float = 0.0
    across_m: float = 0.0
    yaw_rad: float = 0.0
    heading_rad: float = 0.0
    drift_rad: float = 0.0
    creep_m: float = 0.0

    @property
    def side(self) -> float:
        """+1 for the left foot, -1 for the right one: the sign of y and of outward rotation."""
        return 1.0 if self.name.startswith("left") else -1.0

    def place(self, toe_out_deg: float) -> None:
        """Stand the foot at its side of the walking frame's origin, before anything else happens."""
        self.across_m = self.side * HALF_WIDTH_M
        self.yaw_rad = self.side * math.radians(toe_out_deg)
        self.motion.add("across", Step(-2.0, -1.0, self.across_m))
        self.motion.add("yaw", Step(-2.0, -1.0, self.yaw_rad))


@dataclass(frozen=True, slots=True)
class _Times:
    heel_off: float
    toe_off: float
    contact: float
    flat: float


def _vary(rng: np.random.Generator, mean: float, fraction: float) -> float:
    """Normal, but never beyond 2.5 standard deviations: no stride is absurd."""
    return mean * (1.0 + fraction * float(np.clip(rng.normal(), -2.5, 2.5)))


def single_times(
    rng: np.random.Generator, style: Style, first_heel_off_s: float, count: int, belt: Belt
) -> list[_Times]:
    """Instants of ``count`` strides of one foot, each phase drawn on its own; slower while the belt speeds up."""
    times: list[_Times] = []
    heel_off = first_heel_off_s
    for _ in range(count):
        slow = 1.0 + 0.35 * (1.0 - belt.travel(heel_off)[1] / belt.speed_mps)
        toe_off = heel_off + slow * _vary(rng, style.pre_swing_s, style.spread_pre_swing)
        contact = toe_off + slow * _vary(rng, style.swing_s, style.spread_swing)
        flat = contact + slow * _vary(rng, style.loading_s, style.spread_loading)
        times.append(_Times(heel_off, toe_off, contact, flat))
        heel_off = flat + slow * _vary(rng, style.stance_s, style.spread_stance)
    return times


def other_times(rng: np.random.Generator, style: Style, leader: list[_Times], share: float) -> list[_Times]:
    """Instants of the other foot: contact at ``share`` of the leader's cycle, its own phases before and after."""
    times = []
    for number, lead in enumerate(leader):
        last = number + 1 == len(leader)
        cycle = lead.contact - leader[number - 1].contact if last else leader[number + 1].contact - lead.contact
        slow = cycle / style.cycle_s
        contact = lead.contact + share * cycle * (1.0 + 0.012 * float(rng.normal()))
        toe_off = contact - slow * _vary(rng, style.swing_s, style.spread_swing)
        heel_off = toe_off - slow * _vary(rng, style.pre_swing_s, style.spread_pre_swing)
        times.append(
            _Times(heel_off, toe_off, contact, contact + slow * _vary(rng, style.loading_s, style.spread_loading))
        )
    return times


def write_walk(
    rng: np.random.Generator,
    foot: Foot,
    style: Style,
    times: list[_Times],
    belt: Belt,
    end_s: float,
    end_along_m: float | None,
) -> None:
    """Plan and write all strides of one foot; the last one lands at ``end_along_m`` (walking frame) if given."""
    error = 0.0
    for number, instant in enumerate(times):
        last = number + 1 == len(times)
        travel, speed = belt.travel(instant.contact)
        error = 0.4 * error + style.spread_m * float(np.clip(rng.normal(), -2.0, 2.0))
        lead = 0.28 * style.cycle_s * speed * (0.5 if number == 0 or last else 1.0)
        landing = end_along_m if last and end_along_m is not None else travel + lead + error
        across = foot.side * HALF_WIDTH_M + float(rng.normal(0.0, 0.012))
        yaw = foot.heading_rad + foot.side * math.radians(style.toe_out_deg + float(rng.normal(0.0, 1.0)))
        following = times[number + 1].heel_off if not last else end_s
        plan = _draw(rng, style, foot, instant, following, landing, across, yaw)
        write_stride(foot.motion, plan, foot.drift_rad, foot.creep_m)
        foot.plans.append(plan)
        foot.along_m, foot.across_m, foot.yaw_rad = landing, across, yaw
        foot.drift_rad, foot.creep_m = plan.drift_rad, plan.creep_m


def _draw(
    rng: np.random.Generator,
    style: Style,
    foot: Foot,
    instant: _Times,
    following: float,
    landing: float,
    across: float,
    yaw: float,
) -> StridePlan:
    def angle(mean_deg: float, scale: float = 1.0) -> float:
        return math.radians(mean_deg + scale * style.spread_deg * float(np.clip(rng.normal(), -2.0, 2.0)))

    out = foot.side
    return StridePlan(
        heel_off_s=instant.heel_off,
        toe_off_s=instant.toe_off,
        contact_s=instant.contact,
        flat_s=instant.flat,
        next_heel_off_s=following,
        forward_m=landing - foot.along_m,
        sideways_m=across - foot.across_m,
        push_rad=angle(style.push_deg, 1.5),
        strike_rad=angle(style.strike_deg),
        dangle_rad=math.radians(style.dangle_deg),
        invert_rad=-out * angle(style.invert_deg),
        turn_rad=yaw - foot.yaw_rad,
        swerve_rad=out * angle(style.swerve_deg),
        circumduction_m=out * _vary(rng, style.circumduction_m, style.spread_clearance),
        lift_m=_vary(rng, style.lift_m, style.spread_clearance),
        toe_clearance_m=_vary(rng, style.toe_clearance_m, style.spread_clearance),
        fall_mps=_vary(rng, style.fall_mps, style.spread_clearance),
        forward_mps=_vary(rng, style.forward_mps, style.spread_clearance),
        stop_s=_vary(rng, style.stop_s, 0.1),
        ring_mps2=_vary(rng, style.ring_mps2, 0.25),
        drift_rad=angle(style.drift_deg, 0.15),
        creep_m=_vary(rng, style.creep_m, 0.25),
        slow_share=style.slow_share,
        jolt_mps2=_vary(rng, style.jolt_mps2, 0.2),
        contact=style.contact,
    )


def add_sway(rng: np.random.Generator, foot: Foot, start_s: float, end_s: float, size: float, shake_m: float) -> None:
    """Small movements that never stop: sway of the foot (``size`` degrees) and, on a running belt, its shaking."""
    for channel, share in (("pitch", 0.35), ("roll", 1.0), ("yaw", 0.5)):
        foot.motion.add(channel, wander(rng, start_s, end_s, 0.11, math.radians(share * size)))
    if shake_m > 0.0:
        foot.motion.add("bounce", wander(rng, start_s, end_s, 0.016, shake_m))
        foot.motion.add("shear", wander(rng, start_s, end_s, 0.016, 0.6 * shake_m))


def weight_shifts(rng: np.random.Generator, feet: list[Foot], start_s: float, count: int) -> float:
    """Lean from foot to foot: a degree or two of roll, less of pitch, flat on the ground. Returns when it ends."""
    t = start_s
    for number in range(count):
        length = float(rng.uniform(0.9, 1.4))
        lean = math.radians(float(rng.uniform(0.8, 1.8))) * (-1.0 if number % 2 else 1.0)
        sag = math.radians(float(rng.uniform(-0.5, 0.9)))
        for foot in feet:
            foot.motion.add("roll", Step(t, t + 0.5 * length, lean), Step(t + 0.5 * length, t + length, -lean))
            foot.motion.add("pitch", Step(t, t + 0.6 * length, sag), Step(t + 0.6 * length, t + length, -sag))
        t += length + 0.2
    return t


def turn_on_the_spot(rng: np.random.Generator, feet: list[Foot], start_s: float, turn_deg: float, steps: int) -> float:
    """Turn by ``turn_deg`` in ``steps`` small steps of each foot, one foot after the other. Returns when it ends."""
    t = start_s
    centre = sum(foot.along_m for foot in feet) / len(feet)
    for number in range(steps):
        for foot in feet:
            heading = foot.heading_rad + math.radians(turn_deg) * (number + 1) / steps
            heel_off = t
            toe_off = heel_off + float(rng.uniform(0.22, 0.28))
            contact = toe_off + float(rng.uniform(0.28, 0.36))
            flat = contact + float(rng.uniform(0.06, 0.10))
            along = centre - math.sin(heading) * foot.side * HALF_WIDTH_M
            across = math.cos(heading) * foot.side * HALF_WIDTH_M
            yaw = heading + foot.side * math.radians(7.0 + float(rng.normal(0.0, 2.0)))
            plan = StridePlan(
                heel_off_s=heel_off, toe_off_s=toe_off, contact_s=contact, flat_s=flat, next_heel_off_s=flat + 0.3,
                forward_m=along - foot.along_m, sideways_m=across - foot.across_m,
                push_rad=math.radians(float(rng.uniform(14.0, 22.0))),
                strike_rad=math.radians(float(rng.uniform(2.5, 6.0))), dangle_rad=0.0, invert_rad=math.radians(2.0),
                turn_rad=yaw - foot.yaw_rad, swerve_rad=0.0,
                circumduction_m=0.0, lift_m=0.03, toe_clearance_m=0.02, fall_mps=float(rng.uniform(0.15, 0.3)),
                forward_mps=0.0, stop_s=0.02, ring_mps2=6.0, drift_rad=0.0, creep_m=0.0,
                slow_share=0.4, jolt_mps2=0.0, contact="forefoot",
            )  # fmt: skip
            write_stride(foot.motion, plan, foot.drift_rad, foot.creep_m)
            foot.plans.append(plan)
            foot.along_m, foot.across_m, foot.yaw_rad = along, across, yaw
            foot.drift_rad, foot.creep_m = 0.0, 0.0
            t = flat + float(rng.uniform(0.10, 0.25))
    for foot in feet:
        foot.heading_rad += math.radians(turn_deg)
    return t


def heel_lift(foot: Foot, start_s: float, height_deg: float, up_s: float, hold_s: float, down_s: float) -> float:
    """Lift the heel with the toe on the ground and put it back; quick ones hit the ground. Returns when it ends."""
    height = math.radians(height_deg)
    top = start_s + up_s
    foot.motion.add("pitch", Step(start_s, top, height))
    if down_s > 0.5:
        foot.motion.add("pitch", Step(top + hold_s, top + hold_s + down_s, -height))
        return top + hold_s + down_s
    landing = top + hold_s + down_s
    unit = Pulse(top + hold_s, landing - 0.1 * down_s, landing, landing + 0.03, 1.0)
    foot.motion.add("pitch", Pulse(top + hold_s, landing - 0.1 * down_s, landing, landing + 0.03, -height / unit.total))
    foot.motion.add("bounce", Ring(landing, 8.0, 33.0, 0.016))
    return landing + 0.03


def sit_and_stand(
    rng: np.random.Generator, feet: list[Foot], start_s: float, seated_s: float
) -> tuple[float, float, float]:
    """Sit down, stay ``seated_s``, get up: feet slide, toes come up, heels come up. Returns the three ends.

    Whatever slid and tilted goes back, so the person stands as before.
    """
    down_end = start_s + 2.2
    up_start = down_end + seated_s
    up_end = up_start + 2.4
    for foot in feet:
        delay = float(rng.uniform(0.0, 0.25))
        slide = float(rng.uniform(0.05, 0.10))
        tip = math.radians(float(rng.uniform(6.0, 12.0)))
        rise = math.radians(float(rng.uniform(8.0, 15.0)))
        rest = math.radians(float(rng.uniform(-4.0, -2.0)))
        # lowering: toes come up while the weight goes back, the feet shuffle forward
        foot.motion.add("pitch", Step(start_s + 0.3 + delay, start_s + 1.2 + delay, -tip))
        foot.motion.add("pitch", Step(start_s + 1.3 + delay, start_s + 1.9 + delay, tip + rest))
        foot.motion.add("along", Step(start_s + 0.6 + delay, start_s + 1.5 + delay, slide))
        # seated: the legs are never quite still
        wag = start_s + 2.2 + float(rng.uniform(0.3, 0.5)) * seated_s
        foot.motion.add(
            "pitch", Step(wag, wag + 0.5, math.radians(5.0)), Step(wag + 0.6, wag + 1.3, math.radians(-5.0))
        )
        # getting up: the feet are drawn back, heels lift, then stand
        foot.motion.add("along", Step(up_start + delay, up_start + 0.7 + delay, -slide))
        foot.motion.add("pitch", Step(up_start + delay, up_start + 0.7 + delay, rise - rest))
        foot.motion.add("pitch", Step(up_start + 0.9 + delay, up_start + 1.8 + delay, -rise))
    return down_end, up_start, up_end
