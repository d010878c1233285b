"""The walk: at every event of a leg, decide when and where the feet go next; note events and strides as they were, and
count what harm stimulation did in them.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from fes.signals import FOOT_SENSORS, NS_PER_S, FloatArray
from fes.simulation.forward import gait_patterns as normative
from fes.simulation.forward.dynamics import BELT, CONTACT, FLAT, LEG, PRE_SWING, STUMBLE, TRACE
from fes.simulation.forward.gait_patterns import PATTERNS, Pattern, stride_time_s
from fes.simulation.forward.integration import to_rest_m, travel_m
from fes.simulation.forward.leg import (
    CLEARANCE_M,
    HALF_WIDTH_M,
    LOST_REACH_M,
    PRE_SWING_SHARE,
    Planner,
    Swing,
    body_of,
    muscle_of,
)
from fes.simulation.forward.settings import MUSCLE_GROUPS, PatientSettings

Rows: TypeAlias = Callable[[int, float, float], FloatArray]  # of a side's trace between two times in s
EVENTS = ("initial_contact", "foot_flat", "heel_off", "foot_off", "stumble")


@dataclass(frozen=True, slots=True)
class FootEvent:
    """Something true of a foot: ``kind`` is one of :data:`EVENTS`."""

    t_ns: int
    foot: str
    kind: str


@dataclass(frozen=True, slots=True)
class VirtualStride:
    """One stride of one foot, complete when its foot lies flat again."""

    foot: str  # sensor name
    number: int  # 1, 2, … per foot
    t_heel_off_ns: int  # pre-swing begins
    t_foot_off_ns: int  # swing begins
    t_contact_ns: int  # loading response begins
    t_flat_ns: int  # stance begins
    stride_length_m: float  # distance between the places where the foot stood, in the belt's frame
    speed_mps: float  # the belt's speed at contact
    toe_clearance_m: float  # least height of toe or ball over 30–80 % of the swing; a dragged toe is at about 0
    heel_clearance_m: float  # greatest height of the heel
    pitch_at_contact_rad: float  # sole against the ground, toe-up positive
    ankle_at_contact_rad: float  # dorsiflexion positive
    inversion_at_contact_rad: float  # sole turned inward, positive
    drag_s: float  # how long the forefoot touched the ground in swing
    dragged: bool  # it did so between 25 % and 90 % of the swing, for over 20 ms
    stumbled: bool  # it caught, and the step was cut short
    charge_uc: float  # charge delivered on the patient's channels since the contact before
    peak_torque_nm: float  # greatest torque of the stimulated muscle in this swing
    walking: bool  # false for the last step into standing
    pitch_at_foot_off_rad: (
        float  # sole against the ground as the foot leaves it, toe-up positive: how far it pushed off
    )
    push_off_j: float  # work of the calf in pre-swing, its own and the stimulated
    opposed_j: float  # of it, taken up by the stimulated dorsiflexors: a burst too early
    spasm: float  # how strong a spasm of the calf became in swing, 0–1
    co_contraction_nms: float  # impulse of stimulated dorsiflexors and calf, reflex and all, pulling against each other


@dataclass(slots=True)
class OpenStride:
    """A stride under way: what the walker notes of it (s, m, rad), and when the foot is to leave and land next."""

    t_heel_off_s: float = math.nan
    t_foot_off_s: float = math.nan
    t_contact_s: float = math.nan
    from_x: float = 0.0
    stumbled: bool = False
    rows: FloatArray | None = None
    pitch: float = 0.0
    ankle: float = 0.0
    roll: float = 0.0
    speed_mps: float = 0.0
    drag_s: float = 0.0
    off_pitch: float = 0.0
    due_s: float = math.nan  # when this swing is to end
    next_off_s: float = math.inf
    next_contact_s: float = math.inf
    number: int = 0  # of the next contact
    last_step: bool = False


TIME_SPREAD = 0.022  # of the stride time: Hausdorff, *J NeuroEng Rehab* 2 (2005), healthy 1–3 %, after stroke more
MEMORY = 0.45  # neighbouring strides resemble each other


class Rhythm:
    """Initial contacts of the leading leg as far as they are settled; the other lands in between.

    A contact's time is settled when it is first asked for, with the speed of that moment.
    """

    def __init__(self, rng: np.random.Generator, pattern: Pattern, height_m: float, variability: float) -> None:
        self._rng = rng
        self._pattern = pattern
        self._height_m = height_m
        self._spread = variability * pattern.variation * TIME_SPREAD
        self._error = 0.0
        self._times: list[float] = []

    def start(self, first_s: float) -> None:
        """Begin a walk: the leading leg first lands at ``first_s``."""
        self._times = [first_s]

    def leader(self, number: int, speed_mps: float) -> float:
        """When the leading leg lands for the ``number``-th time, s."""
        while len(self._times) <= number:
            draw = float(np.clip(self._rng.normal(), -2.5, 2.5))
            self._error = MEMORY * self._error + (1.0 - MEMORY**2) ** 0.5 * self._spread * draw
            self._times.append(self._times[-1] + self.cycle_s(speed_mps) * (1.0 + self._error))
        return self._times[number]

    def follower(self, number: int, speed_mps: float) -> float:
        """When the other leg lands for the ``number``-th time."""
        here, there = self.leader(number, speed_mps), self.leader(number + 1, speed_mps)
        draw = float(np.clip(self._rng.normal(), -2.5, 2.5))
        return here + (0.5 + 0.5 * self._spread * draw) * (there - here)

    def cycle_s(self, speed_mps: float) -> float:
        """Mean stride time at a speed."""
        return self._pattern.cycle_factor * stride_time_s(speed_mps, self._height_m)


BEGIN_S = 1.2  # from the belt's start to the first contact
LANDING_SPREAD_M = 0.012
CLEARANCE_SPREAD_M = 0.0035  # Winter (1992): 4.5 mm from stride to stride
RELAX, BUILD = 0.35, 0.25  # how fast the habit of lifting the leg goes and comes, per stride
COMFORTABLE_M = 0.02
FELT = 0.3  # of a stride in how high the foot seems to pass
LEVEL_DEG = 2.0  # inversion in swing of a foot that does not hang
HALF_A_FOOT_M = 0.1  # nearer than this to where it is to stand, a foot takes no further step
SHORT_M = 0.05  # steps that land less than this short of their place only vary
STROLL_MPS = 0.1
CARRIES = 0.4  # of a double support: by then the other leg carries a third of the weight
_PITCH, _ROLL, _TOE, _HEEL, _TORQUE = (
    TRACE.index(n) for n in ("pitch_rad", "roll_rad", "toe_m", "heel_m", "torque_nm")
)


class Walker:
    """Two legs, their rhythm and their plans; owns the records the compiled loop works on."""

    def __init__(self, settings: PatientSettings) -> None:
        self.settings = settings
        self.pattern = PATTERNS[settings.pattern]
        self.legs = np.zeros(2, LEG)
        self.belt = np.zeros(1, BELT)
        self.affected = 0 if settings.side == "left" else 1
        for side in range(2):
            self.legs[side] = body_of(settings, affected=side == self.affected)
        self.muscles = np.array([muscle_of(getattr(settings, name)) for name in MUSCLE_GROUPS])  # of the affected leg
        self.planners = [Planner(settings, self.pattern, self.legs, self.belt, side) for side in range(2)]
        self._rng = np.random.default_rng((settings.seed, 10))
        rhythm_rng = np.random.default_rng((settings.seed, 11))
        self._rhythm = Rhythm(rhythm_rng, self.pattern, settings.height_m, settings.variability)
        self.speed_mps = settings.speed_mps
        self.events: list[FootEvent] = []
        self.strides: list[VirtualStride] = []
        self._pulses: list[tuple[int, float]] = []  # time and charge, not yet counted
        self.walks: list[tuple[float, float]] = []  # begin and end, s
        self._open = [OpenStride(), OpenStride()]
        self._habit = settings.compensation  # see Swing.habit; given up when the foot clears
        self._felt_m = math.nan  # toe clearance on the whole
        self._scare_m = 0.0  # after a stumble, for a stride or two
        self._counts = [0, 0]
        self._turn_rad = [0.0, 0.0]
        self.walking = False
        self._stopping = False

    # --- what a person or a test asks for ---------------------------------------------------------------

    def walk(self, t_s: float) -> None:
        """The belt starts; the unaffected leg leads."""
        if self.walking:
            return
        self.walking, self._stopping = True, False
        self.walks.append((t_s, math.inf))
        self.belt["goal"][0] = self.speed_mps
        self._rhythm.start(t_s + BEGIN_S)
        for side, open_ in enumerate(self._open):
            open_.number, open_.last_step = 0, False
            planner = self.planners[side]
            if math.isfinite(planner.leg["load_t"]):  # stands from an earlier walk, with all its weight
                planner.leg["load_share"] = 1.0
            planner.leg["load_t"] = math.inf
            self._plan_next(side, t_s, first=True)

    def set_speed(self, speed_mps: float) -> None:
        """The belt goes to another speed; the steps follow as they are planned."""
        self.speed_mps = speed_mps
        if self.walking and not self._stopping:
            self.belt["goal"][0] = speed_mps
        for planner in self.planners:
            planner.set_speed(speed_mps)

    def stop(self) -> None:
        """The belt brakes; each leg finishes its step and stands."""
        if self.walking:
            self._stopping = True
            self.belt["goal"][0] = 0.0

    def turn(self, turn_rad: float) -> None:
        """Turn by this much over the next strides, at most 30° a stride."""
        self._turn_rad = [remaining + turn_rad for remaining in self._turn_rad]

    # --- events of the compiled loop --------------------------------------------------------------------

    def on_event(self, side: int, what: int, t_s: float, trace: Rows) -> None:
        """Plan on after an event; ``trace`` gives the affected swing's rows: ``trace(side, from_s, to_s)``."""
        leg, open_ = self.legs[side], self._open[side]
        if what == CONTACT:
            self._contact(side, t_s, trace)
        elif what == STUMBLE:
            self._note(side, t_s, "stumble")
            open_.stumbled, open_.last_step = True, False
            short = (0.10 + 0.08 * self._rng.uniform()) * self._stride_m()
            self.planners[side].trip(t_s, short)
        elif what == FLAT:
            leg["flat"], leg["flat_t"] = 1, t_s
            self._note(side, t_s, "foot_flat")
            self._finish(side, t_s)
        elif leg["mode"] == PRE_SWING:
            self._foot_off(side, t_s)
        else:
            self._heel_off(side, t_s)

    def _heel_off(self, side: int, t_s: float) -> None:
        open_ = self._open[side]
        apart_m = abs(float(self.legs["stand_x"][0] - self.legs["stand_x"][1]))
        if self._stopping and (open_.last_step or apart_m < HALF_A_FOOT_M):
            self.planners[side].stand(t_s)
            if math.isinf(self.legs[1 - side]["due_s"]) and self.legs[1 - side]["mode"] == 0:
                self.walking = False
                self.walks[-1] = (self.walks[-1][0], t_s)
            return
        if self.legs[side]["flat"] == 0:  # it never lay flat: a toe walker's stance ends all the same
            self.legs[side]["flat_t"] = t_s
            self._finish(side, t_s)
        open_.t_heel_off_s, open_.from_x = t_s, float(self.legs[side]["stand_x"])
        self._note(side, t_s, "heel_off")
        share = self._stride_share()
        if self._stopping:  # the slower the belt, the less there is to push off for
            share *= min(float(self.belt["v"][0]) / self.speed_mps, 1.0)
        self.planners[side].rise(t_s, max(open_.next_off_s, t_s + 0.12), share, self._support_s())

    def _foot_off(self, side: int, t_s: float) -> None:
        open_, planner = self._open[side], self.planners[side]
        affected = side == self.affected
        open_.t_foot_off_s, open_.stumbled = t_s, False
        self._note(side, t_s, "foot_off")
        end = open_.due_s = max(self._contact_time(side, open_.number), t_s + 0.22)
        vary = self.settings.variability * planner.pattern.variation
        draw = np.clip(self._rng.normal(size=5), -2.5, 2.5)
        reach = float(draw[0]) * LANDING_SPREAD_M * vary * (0.6 + 0.4 * min(self._stride_share(), 1.2))
        if self._stopping:
            # down below the hip, where that will be when the belt has come to rest
            belt = self.belt[0]
            now_m = float(belt["x"])
            beside = planner.reach(end, now_m + travel_m(belt, end - t_s), now_m + to_rest_m(belt))
            open_.last_step = beside < reach + HALF_A_FOOT_M
            reach = beside if open_.last_step else reach
        # dorsiflexors stimulated before the foot has left take from the push-off (Kesar et al., *Stroke* 40, 2009)
        lost = min(float(planner.leg["opposed_j"]) / max(float(planner.leg["pushed_j"]), 0.5), 1.0)
        turn = float(np.clip(self._turn_rad[side], -math.radians(30), math.radians(30)))
        self._turn_rad[side] -= turn
        circle = planner.pattern.circumduction_m * (1.0 + 0.25 * float(draw[3]) * vary)
        y = planner.sign * HALF_WIDTH_M + 0.012 * vary * float(draw[2])
        # inward roll in the air: a foot that hangs inverts, one that is held is nearly level
        invert_deg = LEVEL_DEG + 0.8 * self.settings.variability * float(draw[4])
        planner.leg["roll_goal"] = -planner.sign * math.radians(invert_deg)
        planner.leg["hang_rad"] = math.radians(max(planner.pattern.invert_deg - LEVEL_DEG, 0.0))
        open_.off_pitch = float(planner.leg["pitch"])
        planner.swing(
            Swing(
                begin_s=t_s, end_s=end,
                clearance_m=max(CLEARANCE_M + CLEARANCE_SPREAD_M * vary * float(draw[1]), 0.004),
                extra_lift_m=planner.pattern.hike_m + self._scare_m * affected, habit=self._habit * affected,
                reach_m=reach - LOST_REACH_M * lost, turn_rad=turn,
                swerve_rad=math.radians(planner.pattern.swerve_deg), circle_m=circle,
                shift_m=y - float(planner.leg["y"]), lost=lost,
            )
        )  # fmt: skip

    def _contact(self, side: int, t_s: float, trace: Rows) -> None:
        leg, open_ = self.legs[side], self._open[side]
        self._note(side, t_s, "initial_contact")
        open_.t_contact_s = t_s
        open_.pitch, open_.ankle = float(leg["pitch"]), float(leg["pitch"] - leg["shank"])
        open_.roll, open_.drag_s = float(leg["roll"]), float(leg["drag_s"])
        open_.speed_mps = float(self.belt["v"][0])
        open_.rows = trace(side, open_.t_foot_off_s, t_s)
        leg["roll_goal"] = 0.0
        open_.number += 1
        self._plan_next(side, t_s)

    def _plan_next(self, side: int, t_s: float, *, first: bool = False) -> None:
        """When this leg's heel rises, its foot leaves and lands again; begin its stance unless it stands already."""
        open_, planner = self._open[side], self.planners[side]
        contact = self._contact_time(side, open_.number)
        cycle = self._rhythm.cycle_s(self.speed_mps)
        longer = self.settings.asymmetry + self.pattern.stance_shift  # share of the cycle, of the affected leg's swing
        longer = longer if side == self.affected else -longer
        swing = (1.0 - normative.stance_share(self.speed_mps) + longer) * cycle
        off = max(contact - swing - self._sooner_s(side, t_s, contact - swing), t_s + 0.30)
        rise = max(off - PRE_SWING_SHARE * cycle, t_s + 0.15)
        open_.next_off_s, open_.next_contact_s = off, contact
        if first:
            planner.leg["due_s"] = planner.leg["rise_t"] = rise
            planner.leg["flat_t"] = t_s
        else:
            planner.stance(t_s, rise, off, self._support_s())

    def _sooner_s(self, side: int, t_s: float, off_s: float) -> float:
        """How much sooner than at ``off_s`` the foot leaves since it has landed early and short, as after a stumble.

        A stance ends when the leg is far enough behind and the other one takes the weight (Pang & Yang, *J Physiol*
        528, 2000), not by a clock.
        """
        open_, speed_mps = self._open[side], float(self.belt["v"][0])
        if not open_.due_s > t_s or speed_mps < STROLL_MPS:
            return 0.0
        belt_m = float(self.belt["x"][0]) + speed_mps * (open_.due_s - t_s)
        short_m = -self.planners[side].reach(open_.due_s, belt_m, float(self.legs[side]["x"]))
        carried_s = self._open[1 - side].next_contact_s + CARRIES * self._support_s()
        return max(min((short_m - SHORT_M) / speed_mps, off_s - carried_s), 0.0)

    def _finish(self, side: int, t_s: float) -> None:
        """The stride that ended with this stance is complete: write it down, and learn from it."""
        open_ = self._open[side]
        rows, open_.rows = open_.rows, None
        if rows is None or not len(rows):
            return
        self._counts[side] += 1
        leg, count = self.legs[side], len(rows)
        middle = rows[int(0.30 * count) : max(int(0.80 * count), 1)]
        late = rows[int(0.25 * count) : int(0.90 * count)]
        affected = side == self.affected
        stride = VirtualStride(
            foot=FOOT_SENSORS[side], number=self._counts[side], t_heel_off_ns=_ns(open_.t_heel_off_s),
            t_foot_off_ns=_ns(open_.t_foot_off_s), t_contact_ns=_ns(open_.t_contact_s), t_flat_ns=_ns(t_s),
            stride_length_m=float(self.legs[side]["stand_x"]) - open_.from_x, speed_mps=open_.speed_mps,
            toe_clearance_m=float(middle[:, _TOE].min()), heel_clearance_m=float(rows[:, _HEEL].max()),
            pitch_at_contact_rad=open_.pitch, ankle_at_contact_rad=open_.ankle,
            inversion_at_contact_rad=-self.planners[side].sign * open_.roll, drag_s=open_.drag_s,
            dragged=bool((late[:, _TOE] < 0.0).sum() * 0.005 > 0.02), stumbled=open_.stumbled,
            charge_uc=self._charge_until(_ns(open_.t_contact_s)) if affected else 0.0,
            peak_torque_nm=float(rows[:, _TORQUE].max()),
            walking=not open_.last_step, pitch_at_foot_off_rad=open_.off_pitch,
            push_off_j=float(leg["pushed_j"]), opposed_j=float(leg["opposed_j"]), spasm=float(leg["spasm_most"]),
            co_contraction_nms=float(leg["co_nms"]),
        )  # fmt: skip
        leg["pushed_j"] = leg["opposed_j"] = leg["co_nms"] = leg["spasm_most"] = 0.0
        self.strides.append(stride)
        if affected:
            self._learn(stride)

    def _learn(self, stride: VirtualStride) -> None:
        """People lift the leg while the toe drags and give that up when it clears on the whole (as orthoses show)."""
        clear_m = stride.toe_clearance_m
        self._felt_m = clear_m if math.isnan(self._felt_m) else self._felt_m + FELT * (clear_m - self._felt_m)
        self._scare_m *= 0.4
        if stride.stumbled:
            self._scare_m += 0.015
        if stride.dragged or clear_m < 0.004:
            self._habit += BUILD * (self.settings.compensation - self._habit)
        elif self._felt_m > COMFORTABLE_M:
            too_high_m = self._felt_m - CLEARANCE_M
            self._habit -= min(RELAX * too_high_m / max(self.planners[self.affected].need_m, 0.01), self._habit)

    def add_charge(self, t_ns: int, charge_uc: float) -> None:
        """A pulse went into the affected leg at ``t_ns``."""
        self._pulses.append((t_ns, charge_uc))

    def _charge_until(self, t_ns: int) -> float:
        """Charge delivered up to ``t_ns`` and not yet counted, by the pulses' own times."""
        total = sum(charge for at, charge in self._pulses if at <= t_ns)
        self._pulses = [(at, charge) for at, charge in self._pulses if at > t_ns]
        return total

    def _note(self, side: int, t_s: float, kind: str) -> None:
        self.events.append(FootEvent(_ns(t_s), FOOT_SENSORS[side], kind))

    def _contact_time(self, side: int, number: int) -> float:
        lands = self._rhythm.follower if side == self.affected else self._rhythm.leader
        return lands(number, self.speed_mps)

    def _stride_m(self) -> float:
        return self.speed_mps * self._rhythm.cycle_s(self.speed_mps)

    def _stride_share(self) -> float:
        return self._stride_m() / normative.stride_length_m(normative.REFERENCE_SPEED_MPS, self.settings.height_m)

    def _support_s(self) -> float:
        """Length of one double support."""
        return (normative.stance_share(self.speed_mps) - 0.5) * self._rhythm.cycle_s(self.speed_mps)


def _ns(t_s: float) -> int:
    return round(t_s * NS_PER_S)


EARLY_SHARE: Final = 0.1  # of the push-off's work, taken up by the stimulated dorsiflexors: the burst came too early
INVERTED_RAD: Final = math.radians(5.0)  # at contact: the outer edge is landed on, the ankle may be sprained
SPASM: Final = 0.5  # of the greatest spasm


@dataclass(frozen=True, slots=True)
class Harm:
    """Counts of strides, and means over them; what of it is the patient's own only a walk without stimulation tells."""

    strides: int
    stumbles: int  # the toe caught, and the step was cut short
    drags: int  # the forefoot touched the ground between 25 % and 90 % of the swing, for over 20 ms
    early_bursts: int  # stimulation took more than EARLY_SHARE of the push-off's work
    inverted_contacts: int  # inverted by more than INVERTED_RAD
    spasms: int  # the calf answered with a spasm to being stretched in swing, as by a burst that rises too fast
    push_off_lost: float  # share of the calf's work in all push-offs that stimulation took
    co_contraction_nms: float  # mean impulse a stride of dorsiflexors and calf against each other, N·m·s
    charge_uc: float  # mean a stride


def harm_of(strides: Sequence[VirtualStride]) -> Harm:
    """Count over one foot's strides; all zero for none."""
    count = len(strides)
    pushed_j = sum(one.push_off_j for one in strides)
    return Harm(
        strides=count,
        stumbles=sum(one.stumbled for one in strides),
        drags=sum(one.dragged for one in strides),
        early_bursts=sum(one.opposed_j > EARLY_SHARE * one.push_off_j for one in strides),
        inverted_contacts=sum(one.inversion_at_contact_rad > INVERTED_RAD for one in strides),
        spasms=sum(one.spasm > SPASM for one in strides),
        push_off_lost=sum(one.opposed_j for one in strides) / pushed_j if pushed_j > 0.0 else 0.0,
        co_contraction_nms=sum(one.co_contraction_nms for one in strides) / max(count, 1),
        charge_uc=sum(one.charge_uc for one in strides) / max(count, 1),
    )
