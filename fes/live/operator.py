"""Commands become events where the session's state allows them; faults and walking move the state. No clock, no I/O.

The state informs people and locks commands. What stimulates is decided by controller and gate alone, from events; so
everything that a command changes goes through an event, is logged, and comes out the same in a replay.

Arming after a sensor's fault is a test: a tap on the sensor has to be seen when it happens. No clock, no I/O.

How late samples come is known against the least delayed one since a line was opened. A sensor that is opened again with
all its data late by the same time looks prompt; so does one that came back frozen, before it is moved. A person can
tell: they tap the sensor and press the key in the same moment, and both are stamped by the host's clock.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from fes.config import STEEPEST_PERCENT, Session
from fes.control.controller import Controller
from fes.gate import STOPPED, SafetyGate
from fes.limits import MAX_DATA_AGE_MS
from fes.live.commands import CONTROL, CURRENT_ALLOWED, Cause, CommandKind, OperatorCommand, SessionMachine, State
from fes.live.sensor_monitor import SensorMonitor
from fes.live.status import ground_text
from fes.session_log import Note
from fes.signals import FOOT_SENSORS, G_MPS2, NS_PER_S, Event, ImuSample, OperatorAct, OperatorAction, Tick
from fes.stimulation.envelope import BurstParameters, difference
from fes.walk_record import MARK

STILL_NS: Final = NS_PER_S  # before a tap: who taps again and again cannot meet a delay by chance
TAP_RADPS: Final = 0.5  # standing sways by less than 0.15
TAP_MPS2: Final = 3.0  # from gravity; a sensor that reads it off by 0.5 cannot be armed
MOST_STEP_NS: Final = 40_000_000  # between two samples; what a longer gap hides was perhaps no rest
LATE_NS: Final = MAX_DATA_AGE_MS * 1_000_000  # a tap may be seen after the key; by radio as late as data may be
EARLY_NS: Final = 100_000_000  # or before it: the other hand, and the page's way, take so long; a judgement
ASKED: Final = "then tap it"  # the words by which a program knows that it is asked for
WAITS_NS: Final = 2 * NS_PER_S  # for a tap that comes late, to say how late


class Proof:
    """What the sensors in ``doubted``, the gate's own set, have to show; each that has is taken out of it.

    ``late_ns``: by sensor by radio, how late a tap of it may be seen.
    """

    def __init__(
        self, doubted: set[str], note: Callable[[Note], None], late_ns: Mapping[str, int] = MappingProxyType({})
    ) -> None:
        self._doubted, self._note, self._late_ns = doubted, note, late_ns
        self._seen_ns: dict[str, int] = {}
        self._moved_ns: dict[str, int] = {}
        self._taps: dict[str, int] = {}
        self._key_ns: int | None = None

    def wanted(self) -> str:
        """What a person has to do before arming; "" when nothing."""
        if not self._doubted:
            return ""
        first = sorted(self._doubted)[0]
        return f"{first} had a fault: keep it still for a second, {ASKED} and press arm in the same moment"

    def press(self, t_ns: int) -> None:
        """The key, at the moment of the tap."""
        self._key_ns = t_ns

    def observe(self, sample: ImuSample) -> str:
        """Take in a sample; in words what came of the last key, once that is known."""
        sensor, t_ns = sample.sensor, sample.t_ns
        if sensor not in self._doubted:
            return ""
        known, self._seen_ns[sensor] = self._seen_ns.get(sensor), t_ns
        (x, y, z), (p, q, r) = sample.acc_mps2, sample.gyr_radps
        still = p * p + q * q + r * r < TAP_RADPS**2 and abs((x * x + y * y + z * z) ** 0.5 - G_MPS2) < TAP_MPS2
        if known is None or t_ns - known > self._late_ns.get(sensor, MOST_STEP_NS):
            self._moved_ns[sensor] = t_ns
            self._taps.pop(sensor, None)
        elif not still:
            if t_ns - self._moved_ns[sensor] >= STILL_NS:
                self._taps[sensor] = t_ns
            self._moved_ns[sensor] = t_ns
        return self._judge(sensor, t_ns)

    def _judge(self, sensor: str, t_ns: int) -> str:
        if self._key_ns is None:
            return ""
        late_ns = self._taps.get(sensor, -WAITS_NS) - self._key_ns
        most_ns = self._late_ns.get(sensor, LATE_NS)
        if -EARLY_NS <= late_ns <= most_ns:
            self._doubted.discard(sensor)
            self._key_ns = None
            self._note(Note(t_ns, "info", "session", f"{sensor}: a tap seen {late_ns / 1e6:+.0f} ms from the key"))
            return self.wanted() or f"{sensor}: the tap was seen; stand still, then arm"
        if late_ns > most_ns:
            self._key_ns = None
            said = f"{sensor}: a tap seen {late_ns / 1e6:.0f} ms after the key: its data come late, or you tapped late"
        elif t_ns - self._key_ns > WAITS_NS:
            self._key_ns = None
            said = f"no tap of {sensor} was seen with the key; {self.wanted()}"
        else:
            return ""
        self._note(Note(t_ns, "warning", "session", said))
        return said


AGAIN_NS: Final = 5 * NS_PER_S
TUNING: Final = ("freeze_tuning", "resume_tuning", "accept_suggestion", "roll_back")
ACTIONS: Final = {CommandKind(name): OperatorAction(name) for name in TUNING}


class Refusal(ValueError):
    """The command cannot be carried out now; the text says why."""


class TuningCommands:
    """Freezes and resumes a session's tuning, accepts a suggestion, rolls back; ``message``: the last one's outcome.

    An accepted suggestion and a roll-back change the next burst, so a key must be pressed twice: the first time says
    what would change, the second one within five seconds does it, unless something else is suggested by then. Over the
    control socket the message's confirmation stands for the second key.
    """

    def __init__(self, controller: Controller) -> None:
        self._tuning = controller.tuning
        self._offered: tuple[CommandKind, int, BurstParameters] | None = None  # pressed once: what would come of it
        self._offered_ns = 0
        self.message = ""

    def execute(self, command: OperatorCommand, channel: int, t_ns: int) -> list[OperatorAct]:
        """The events that the command, one of :data:`ACTIONS`, makes; none where a key must be pressed again.

        Refusal: nothing tunes itself, nothing is suggested, or it is so already.
        """
        tuners = self._tuning.tuners
        if not tuners:
            raise Refusal('no channel of this session tunes itself (tuning.mode is "off")')
        frozen = [bool(tuner.frozen) for tuner in tuners.values()]
        if command.kind is CommandKind.FREEZE_TUNING:
            if all(frozen):
                raise Refusal("tuning is frozen already")
            return self._act(command, t_ns, 0, "tuning frozen; the settings stay as they are")
        if command.kind is CommandKind.RESUME_TUNING:
            if not any(frozen):
                raise Refusal("tuning is not frozen")
            return self._act(command, t_ns, 0, "tuning goes on")
        tuner = tuners.get(channel)
        if tuner is None:
            raise Refusal(f"channel {channel} does not tune itself")
        accepts = command.kind is CommandKind.ACCEPT_SUGGESTION
        if accepts and tuner.frozen:
            raise Refusal(f"tuning is frozen ({tuner.frozen}); nothing is accepted")
        after = tuner.pending if accepts else tuner.start
        if after is None:
            raise Refusal(f"nothing is suggested for channel {channel}")
        what = f"channel {channel}, {'accept' if accepts else 'roll back and freeze'}: "
        what += difference(tuner.parameters, after) or "nothing changes"
        now = command.kind, channel, after
        if command.origin == "key" and (self._offered != now or t_ns - self._offered_ns > AGAIN_NS):
            self._offered, self._offered_ns = now, t_ns
            self.message = f"{what}? {'y' if accepts else 'r'} again"
            return []
        return self._act(command, t_ns, channel, f"{what}, from the next burst on")

    def _act(self, command: OperatorCommand, t_ns: int, channel: int, message: str) -> list[OperatorAct]:
        self._offered = None
        self.message = message
        return [OperatorAct(t_ns, ACTIONS[command.kind], float(channel))]


SIDE_NOTED: Final = "noted"
INTENSITY_STEP: Final = 0.05
RAISE_PAUSE_NS: Final = 150_000_000  # a key held down must not run through the whole range
STOP_STANDS_NS: Final = NS_PER_S // 2  # an arming that was on its way when somebody stopped must not undo it
BELT_STEP_MPS: Final = 0.1
BELT_MOST_MPS: Final = 5.0
TEST_REST_NS: Final = NS_PER_S // 2
NO_STOP: Final = "the keyboard is gone, and there is no other stop"
WARM_NS: Final = 2 * NS_PER_S  # the orientation filter's own settling
REFUSAL_SHOWN_NS: Final = 10 * NS_PER_S
MARK_SHOWN_NS: Final = 3 * NS_PER_S
MARKED: Final = "marked: "
MARK_PAUSE_NS: Final = NS_PER_S // 2  # a flood of them must fill neither the log nor the page
JUST_NS: Final = 100_000_000  # what the loop did once it was off, on purpose, moved the beginning of its absence
ANSWER_NS: Final = NS_PER_S // 2  # the stimulator's heartbeat comes every 100 ms


def unchecked_side(phase_sensor_of: Mapping[str, str]) -> str:
    """ "left", "right" or "both": whose sensors no movement tells from the other leg's.

    "" where two feet have sensors of their own, which :class:`fes.live.sensor_monitor.SideCheck` watches.
    """
    sides = {foot.split("_")[0] for foot in phase_sensor_of}
    if not sides or set(FOOT_SENSORS) <= set(phase_sensor_of.values()):
        return ""
    return sides.pop() if len(sides) == 1 else "both"


def sides_said(phase_sensor_of: Mapping[str, str]) -> str:
    """On which leg each sensor is, as its name says."""
    return " and ".join(f"{sensor} on the {sensor.split('_')[0]} leg" for sensor in phase_sensor_of.values())


def question_of_side(phase_sensor_of: Mapping[str, str]) -> str:
    """What is asked of a person before arming."""
    return f"Movement does not tell which leg each sensor is on: is {sides_said(phase_sensor_of)}?"


@dataclass(eq=False)
class Operator:
    """The session's state and the way from a command to events.

    ``monitors`` by sensor; ``phase_sensor_of``: by foot, the sensor that tells its phases; ``answered_ns``: when the
    stimulator last said anything; ``checks``: further reasons against arming, each "" when there is none (log, stop
    file, free disk …); ``unknown``: what the stimulator cannot tell yet, said when armed. ``side``: "left", "right"
    or "both", where a person has said already that the sensors of it are on their own legs; see :func:`unchecked_side`.
    """

    session: Session
    controller: Controller
    gate: SafetyGate
    monitors: Mapping[str, SensorMonitor]
    phase_sensor_of: Mapping[str, str]
    note: Callable[[Note], None]
    answered_ns: Callable[[], int | None]
    checks: Callable[[], list[str]] = list
    unknown: Callable[[], str] = str
    side: str = ""

    def __post_init__(self) -> None:
        self._unchecked = unchecked_side(self.phase_sensor_of) if self.session.exercise is None else ""
        self._side_by = "--side" if self.side and self.side == self._unchecked else ""
        self._side_asked_ns: int | None = None
        late_ns = dict.fromkeys(self.session.by_radio, self.session.stimulation.max_data_age_ms * 1_000_000)
        self.proof = Proof(self.gate.doubted, self.note, late_ns)
        self.machine = SessionMachine()
        self.message = "warming up"
        self.belt_speed_mps = self.session.treadmill.belt_speed_mps if self.session.treadmill else None
        self.channel = self.session.channels[0].number if self.session.channels else 0
        self.quitting = False
        self.stops = 0
        self._feet = sorted({str(channel.foot) for channel in self.session.channels} & self.phase_sensor_of.keys())
        self._began_ns: int | None = None
        self._raised_ns = -RAISE_PAUSE_NS
        self._stopped_ns = -STOP_STANDS_NS
        self._marks, self._marked_ns = 0, -MARK_PAUSE_NS
        self._intensity = 0.0
        self._tuning = TuningCommands(self.controller)
        self._passing: tuple[int, str, str] | None = None  # until when a refusal or mark is shown, it, what then
        self._explained = ("", "")  # what is latched, and what it came of
        self._zero_moved = ""  # why the measured heights cannot be trusted, found by the arming under way

    @property
    def state(self) -> State:
        """Where the session stands."""
        return self.machine.state

    @property
    def why_off(self) -> str:
        """What the session is off for, its first cause before what came of it; "" where nothing is latched."""
        if self.state is State.STOPPED:  # whatever had gone wrong by then: the stop is what holds
            return STOPPED
        latched, cause = self._explained
        return cause if latched and latched == self.gate.latched else self.gate.latched

    def explain_fault(self, t_ns: int, cause: str, since_ns: int) -> None:
        """What is found only now began ``since_ns`` before: what was latched meanwhile came of it."""
        latched, latched_ns = self.gate.latched, self.gate.latched_ns
        if latched and latched != STOPPED and latched_ns is not None and latched_ns >= t_ns - since_ns - JUST_NS:
            self._explained = latched, f"{cause}, then: {latched}"
            self.message = self.why_off

    def execute(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        """The events that the command makes; none, and a message, where the state does not allow it."""
        handlers = {
            CommandKind.STOP: self._stop,
            CommandKind.ARM: self._arm,
            CommandKind.DISARM: self._disarm,
            CommandKind.PAUSE: self._pause,
            CommandKind.UP: self._up,
            CommandKind.DOWN: self._down,
            CommandKind.TEST: self._test,
            CommandKind.TRIGGER: self._trigger,
            CommandKind.CHANNEL: self._select,
            **dict.fromkeys((CommandKind.BELT, CommandKind.BELT_UP, CommandKind.BELT_DOWN), self._belt),
            CommandKind.GROUND: self._ground,
            CommandKind.GROUND_FREE: self._ground,
            CommandKind.QUIT: self._quit,
            CommandKind.MARK: self._mark,
            **dict.fromkeys(ACTIONS, self._tune),
        }
        return handlers[command.kind](command, t_ns)

    def follow(self, event: Event) -> None:
        """Follow what came of an event that has been handled."""
        t_ns = event.t_ns
        if self._began_ns is None:
            self._began_ns = t_ns
        if self.quitting:
            return
        if self._passing is not None and t_ns >= self._passing[0]:
            if self.message == self._passing[1]:
                self.message = self._passing[2]
            self._passing = None
        if isinstance(event, OperatorAct) and event.action is OperatorAction.ARM:
            self._armed(t_ns)
        elif isinstance(event, ImuSample) and (said := self.proof.observe(event)):
            self.message = said
        if self.gate.latched:
            stopped = self.gate.latched == STOPPED
            self._move(t_ns, Cause.STOP if stopped else Cause.FAULT, self.gate.latched)
        elif self.state in CURRENT_ALLOWED and not isinstance(event, Tick):
            walks = any(self.controller.walking(foot) for foot in self._feet)
            self._move(t_ns, Cause.WALK if walks else Cause.STAND)
        if self.state is State.OFF and t_ns - self._began_ns >= WARM_NS:
            self._move(t_ns, Cause.READY, "ready; a arms")

    def reasons_not_ready(self, t_ns: int, *, at_rest: bool = True) -> list[str]:
        """All that speaks against arming now."""
        warm = self._began_ns is not None and t_ns - self._began_ns >= WARM_NS
        reasons = [] if warm else ["still warming up"]
        for sensor, monitor in self.monitors.items():
            fault = monitor.not_alive(t_ns)
            if not fault and at_rest and sensor in self.phase_sensor_of.values():
                tilted = monitor.not_upright(t_ns)
                if tilted or not self.proof.wanted():  # a tap is a movement
                    fault = monitor.not_at_rest(t_ns) or tilted
            reasons.append(fault)
        reasons += [
            f"{channel.name}: the {channel.foot} is not calibrated"
            for channel in self.session.channels
            if channel.foot not in self.phase_sensor_of and self.session.exercise is None
        ]
        answered_ns = self.answered_ns()
        if answered_ns is None or t_ns - answered_ns > ANSWER_NS:
            reasons.append("the stimulator does not answer")
        return [reason for reason in (*reasons, *self.checks()) if reason]

    def keys_gone(self, t_ns: int, others: list[str]) -> list[Event]:
        """The stop key is not there any more; ``others``: what else stops. A stop, where nothing does."""
        if not others:
            return self._stop(OperatorCommand(CommandKind.STOP, origin=NO_STOP), t_ns)
        *first, last = others
        which = f"{', '.join(first)} or {last}" if first else last
        self._report(t_ns, "warning", f"the keyboard is gone; stop by {which}")
        return []

    def give_up(self, t_ns: int, why: str) -> None:
        """The session ends by itself, with a fault that can be logged no more."""
        self.gate.latch(t_ns, why)
        self.machine.move(Cause.FAULT)
        self.message = why

    # --- commands ----------------------------------------------------------------------------------------

    def _stop(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        self.stops += 1
        self._stopped_ns = t_ns
        self._report(t_ns, "fault", f"emergency stop ({command.origin})")
        self._move(t_ns, Cause.STOP, self.message)
        return [OperatorAct(t_ns, OperatorAction.EMERGENCY_STOP)]

    def _arm(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        if not self.machine.may(Cause.ARM):
            return self._refuse(t_ns, f"cannot arm: the session is {self.state}")
        if t_ns - self._stopped_ns < STOP_STANDS_NS:
            return self._refuse(t_ns, "cannot arm: stopped just now")
        resumes, proof = self.state is State.PAUSED, self.proof.wanted()
        if reasons := self.reasons_not_ready(t_ns, at_rest=not resumes):
            return self._refuse(t_ns, "cannot arm: " + "; ".join(reasons))
        if proof:
            self.proof.press(t_ns)
            self.message = proof
            return []
        if self._unchecked and not self._is_side_confirmed(command, t_ns):
            return []
        arm = OperatorAct(t_ns, OperatorAction.ARM)
        self._zero_moved = ""
        if resumes:  # nobody rests, so nothing is known of zeros; and tuning may go on by a person's own word
            return [arm]
        self._intensity = 0.0  # whatever it was: from nothing, by hand
        return [OperatorAct(t_ns, OperatorAction.SET_INTENSITY, 0.0), arm, *self._without_heights(t_ns)]

    def _is_side_confirmed(self, command: OperatorCommand, t_ns: int) -> bool:
        """Whether a person has said that each sensor is on the leg stated; a key must be pressed twice.

        Once in a session, and noted. The confirmation of the page and of the control socket stands for the second key.
        """
        if self._side_by == SIDE_NOTED:
            return True
        asked_ns, self._side_asked_ns = self._side_asked_ns, t_ns
        if not self._side_by and command.origin == "key" and (asked_ns is None or t_ns - asked_ns > AGAIN_NS):
            self.message = f"{question_of_side(self.phase_sensor_of)} a again"
            return False
        by = self._side_by or command.origin
        self.note(Note(t_ns, "info", "session", f"{sides_said(self.phase_sensor_of)}, confirmed ({by})"))
        self._side_by = SIDE_NOTED
        return True

    def _without_heights(self, t_ns: int) -> list[Event]:
        """Where the measured foot cannot be trusted to the centimetre, nothing is tuned by it; a person may resume."""
        tuners = self.controller.tuning.tuners
        feet = {str(channel.foot) for channel in self.session.channels if channel.number in tuners}
        sensors = [self.phase_sensor_of[foot] for foot in sorted(feet & self.phase_sensor_of.keys())]
        why = "; ".join(filter(None, (self.monitors[sensor].zero_moved(t_ns) for sensor in sensors)))
        if not why:
            return []
        self._zero_moved = f"{why}; tuning is frozen"
        return self._frozen(t_ns, why)

    def distrust(self, t_ns: int, why: str) -> list[Event]:
        """The witness has found that a sensor lies: said, and nothing is tuned by it; a person may resume."""
        self.message = why
        self.note(Note(t_ns, "warning", "witness", f"{why}; lengths and clearance are wrong, nothing is tuned by them"))
        return self._frozen(t_ns, why)

    def _frozen(self, t_ns: int, why: str) -> list[Event]:
        frozen = all(tuner.frozen for tuner in self.controller.tuning.tuners.values())
        return [] if frozen else [OperatorAct(t_ns, OperatorAction.FREEZE_TUNING, why=why)]

    def _armed(self, t_ns: int) -> None:
        if not self.gate.armed:
            self._refuse(t_ns, f"cannot arm: {self.gate.arming_refused}")
            return
        unknown = self.unknown()
        message = "; ".join(filter(None, ("armed; + raises the intensity", self._zero_moved, unknown)))
        self._move(t_ns, Cause.ARM, message)
        for severity, text in (("info", unknown), ("warning", self._zero_moved)):
            if text:
                self.note(Note(t_ns, severity, "session", text))

    def _disarm(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        self._move(t_ns, Cause.DISARM, "disarmed")
        return [OperatorAct(t_ns, OperatorAction.DISARM)]

    def _pause(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        if self.state is State.PAUSED:
            if command.origin == CONTROL:  # a script's pause that came twice must not go on; its arm is confirmed
                return self._refuse(t_ns, "paused already; arm goes on")
            return self._arm(command, t_ns)
        if not self.machine.may(Cause.PAUSE):
            return self._refuse(t_ns, f"nothing to pause: the session is {self.state}")
        self._move(t_ns, Cause.PAUSE, "paused; p goes on")
        return [OperatorAct(t_ns, OperatorAction.DISARM)]

    def _up(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        if self.state not in (State.SHADOW, *CURRENT_ALLOWED):
            return self._refuse(t_ns, f"intensity cannot be raised: the session is {self.state}")
        if t_ns - self._raised_ns < RAISE_PAUSE_NS:
            return []
        self._raised_ns = t_ns
        return self._set_intensity(t_ns, min(self._intensity + INTENSITY_STEP, self.session.stimulation.intensity))

    def _down(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        return self._set_intensity(t_ns, max(self._intensity - INTENSITY_STEP, 0.0))

    def _set_intensity(self, t_ns: int, intensity: float) -> list[Event]:
        self._intensity = round(intensity, 6)
        self.message = f"intensity {self._intensity:.0%}"
        return [OperatorAct(t_ns, OperatorAction.SET_INTENSITY, self._intensity)]

    def _test(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        foot = next((str(c.foot) for c in self.session.channels if c.number == self.channel), "")
        monitor = self.monitors.get(self.phase_sensor_of.get(foot, ""))
        if self.state is not State.ARMED:
            return self._refuse(t_ns, f"no test burst: the session is {self.state}, it must be armed and standing")
        if self.session.exercise is not None:
            return self._by_hand(t_ns, OperatorAction.TEST_BURST)
        moves = monitor.not_at_rest(t_ns, TEST_REST_NS) if monitor else f"no sensor tells of the {foot}"
        if moves:
            return self._refuse(t_ns, f"no test burst: {moves}")
        return self._by_hand(t_ns, OperatorAction.TEST_BURST)

    def _trigger(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        if self.state not in CURRENT_ALLOWED:
            return self._refuse(t_ns, f"no burst by hand: the session is {self.state}")
        return self._by_hand(t_ns, OperatorAction.TRIGGER)

    def _by_hand(self, t_ns: int, action: OperatorAction) -> list[Event]:
        self.message = f"{action.replace('_', ' ')} on channel {self.channel} at {self._intensity:.0%}"
        return [OperatorAct(t_ns, action, float(self.channel))]

    def _select(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        if command.value not in [channel.number for channel in self.session.channels]:
            return self._refuse(t_ns, f"there is no channel {command.value:g}")
        self.channel = int(command.value)
        self.message = f"channel {self.channel} for test and trigger"
        return []

    def _belt(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        step = {CommandKind.BELT_UP: BELT_STEP_MPS, CommandKind.BELT_DOWN: -BELT_STEP_MPS}.get(command.kind)
        wanted_mps = command.value if step is None else (self.belt_speed_mps or 0.0) + step
        self.belt_speed_mps = round(min(max(wanted_mps, 0.0), BELT_MOST_MPS), 3)
        return [OperatorAct(t_ns, OperatorAction.SET_BELT_SPEED, self.belt_speed_mps)]

    def _ground(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        free = command.kind is CommandKind.GROUND_FREE
        if not free and not abs(command.value) <= STEEPEST_PERCENT:  # a slip of the finger must not be taken as meant
            most = f"{STEEPEST_PERCENT:.0f} %"
            return self._refuse(t_ns, f"no incline of {command.value:g} %: it lies between -{most} and {most}")
        act = OperatorAct(t_ns, OperatorAction.FREE_GROUND)
        if not free:
            act = OperatorAct(t_ns, OperatorAction.SET_INCLINE, 0.01 * command.value)
        ground = ground_text(None if free else command.value)
        self._report(t_ns, "info", f"the ground is {ground} from the next stride on ({command.origin})")
        return [act]

    def _tune(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        try:
            events = self._tuning.execute(command, self.channel, t_ns)
        except Refusal as refusal:
            return self._refuse(t_ns, str(refusal))
        self.message = self._tuning.message
        return list(events)

    def _quit(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        self.quitting = True
        self._move(t_ns, Cause.QUIT, "ending")
        return [OperatorAct(t_ns, OperatorAction.DISARM)]

    def _mark(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        """A note in the log. It is no event, so nothing that decides on stimulation can know of it."""
        if t_ns - self._marked_ns < MARK_PAUSE_NS:
            return []
        self._marks, self._marked_ns = self._marks + 1, t_ns
        text = command.text or f"mark {self._marks}"
        self.note(Note(t_ns, "info", MARK, text))
        if self._passing is None or self.message != self._passing[1] or self.message.startswith(MARKED):
            self._show(t_ns, MARK_SHOWN_NS, f"{MARKED}{text}")  # a refusal that is being read stays
        return []

    def _refuse(self, t_ns: int, why: str) -> list[Event]:
        self.note(Note(t_ns, "warning", "session", why))
        self._show(t_ns, REFUSAL_SHOWN_NS, why)
        return []

    def _show(self, t_ns: int, shown_ns: int, text: str) -> None:
        """For a while; then what stood there before comes back."""
        before = self.message
        if self._passing is not None and before == self._passing[1]:
            before = self._passing[2]
        self.message, self._passing = text, (t_ns + shown_ns, text, before)

    def _move(self, t_ns: int, cause: Cause, message: str = "") -> None:
        before = self.state
        if self.machine.move(cause):
            self._report(t_ns, "info", f"state {before} → {self.state} ({cause})", message or f"{self.state}")

    def _report(self, t_ns: int, severity: str, text: str, message: str = "") -> None:
        self.message = message or text
        self.note(Note(t_ns, severity, "session", text))
