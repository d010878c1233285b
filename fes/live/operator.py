"""Orders become events, where the session's state allows them; faults and walking move the state on. No clock, no I/O.

The state is a view for people and a lock on orders. What stimulates is decided by controller and gate alone, from
events; so everything that an order changes goes through an event, is logged, and comes out the same in a replay.

What an operator can order of the tuning: freeze, go on, accept a suggestion, roll back. Pure: no clock, no I/O.

An accepted suggestion and a roll-back change the next burst, so a key must be pressed twice: the first time says what
would change, the second one within five seconds does it, unless something else is suggested by then. Over the control
socket the message's confirmation stands for the second key.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from fes.config import Session
from fes.control.controller import Controller
from fes.gate import SafetyGate
from fes.live.commands import CONTROL, CURRENT_ALLOWED, Ask, Cause, Order, SessionMachine, State
from fes.live.sensor_monitor import SensorMonitor
from fes.session_log import Note
from fes.signals import NS_PER_S, Event, OperatorAct, OperatorAction, Tick
from fes.stimulation.parameters import BurstParameters
from fes.stimulation.tuning.reports import difference
from fes.stimulation.tuning.tuner import Tuner

AGAIN_NS: Final = 5 * NS_PER_S
ACTIONS: Final = {
    Ask.FREEZE_TUNING: OperatorAction.FREEZE_TUNING,
    Ask.RESUME_TUNING: OperatorAction.RESUME_TUNING,
    Ask.ACCEPT_SUGGESTION: OperatorAction.ACCEPT_SUGGESTION,
    Ask.ROLL_BACK: OperatorAction.ROLL_BACK,
}
_KEY_OF: Final = {Ask.ACCEPT_SUGGESTION: "y", Ask.ROLL_BACK: "r"}


class Refusal(ValueError):
    """The order cannot be carried out now; the text says why."""


class TuningOrders:
    """Of one session; ``message`` says what came of the last order."""

    def __init__(self, controller: Controller) -> None:
        self._tuning = controller.tuning
        self._asked: tuple[Ask, int, BurstParameters] | None = None  # pressed once: what would come of it
        self._asked_ns = 0
        self.message = ""

    def take(self, order: Order, channel: int, t_ns: int) -> list[OperatorAct]:
        """The events that carry the order out; none where a key must be pressed again.

        Args:
            order: one of :data:`ACTIONS`.
            channel: the selected one; for a suggestion and a roll-back.
            t_ns: now.

        Raises:
            Refusal: nothing tunes itself, nothing is suggested, or it is so already.
        """
        tuners = self._tuning.tuners
        if not tuners:
            raise Refusal('no channel of this session tunes itself (tuning.mode is "off")')
        if order.ask is Ask.FREEZE_TUNING:
            if all(tuner.frozen for tuner in tuners.values()):
                raise Refusal("tuning is frozen already")
            return self._act(order, t_ns, 0, "tuning frozen; the settings stay as they are")
        if order.ask is Ask.RESUME_TUNING:
            if not any(tuner.frozen for tuner in tuners.values()):
                raise Refusal("tuning is not frozen")
            return self._act(order, t_ns, 0, "tuning goes on")
        tuner = tuners.get(channel)
        if tuner is None:
            raise Refusal(f"channel {channel} does not tune itself")
        return self._change(order, channel, t_ns, tuner)

    def _change(self, order: Order, channel: int, t_ns: int, tuner: Tuner) -> list[OperatorAct]:
        after = tuner.pending if order.ask is Ask.ACCEPT_SUGGESTION else tuner.start
        if order.ask is Ask.ACCEPT_SUGGESTION and tuner.frozen:
            raise Refusal(f"tuning is frozen ({tuner.frozen}); nothing is accepted")
        if after is None:
            raise Refusal(f"nothing is suggested for channel {channel}")
        said = difference(tuner.parameters, after) or "nothing changes"
        what = "accept" if order.ask is Ask.ACCEPT_SUGGESTION else "roll back and freeze"
        asked, now = self._asked, (order.ask, channel, after)
        if order.origin == "key" and (asked != now or t_ns - self._asked_ns > AGAIN_NS):
            self._asked, self._asked_ns = now, t_ns
            self.message = f"channel {channel}, {what}: {said}? {_KEY_OF[order.ask]} again"
            return []
        return self._act(order, t_ns, channel, f"channel {channel}, {what}: {said}, from the next burst on")

    def _act(self, order: Order, t_ns: int, channel: int, message: str) -> list[OperatorAct]:
        self._asked = None
        self.message = message
        return [OperatorAct(t_ns, ACTIONS[order.ask], float(channel))]


INTENSITY_STEP: Final = 0.05
RAISE_PAUSE_NS: Final = 150_000_000  # a key held down must not run through the whole range
STOP_STANDS_NS: Final = NS_PER_S // 2  # an arming that was on its way when somebody stopped must not undo it
BELT_STEP_MPS: Final = 0.1
BELT_MOST_MPS: Final = 5.0
TEST_REST_NS: Final = NS_PER_S // 2
NO_STOP: Final = "the keyboard is gone, and there is no other stop"
WARM_NS: Final = 2 * NS_PER_S  # the orientation filter's own settling
ANSWER_NS: Final = NS_PER_S // 2  # the stimulator's heartbeat comes every 100 ms


class Operator:
    """The session's state and the way from an order to events.

    Args:
        watches: by sensor.
        drivers: by foot, the sensor that tells its phases.
        note: where remarks go.
        answered_ns: when the stimulator last said anything; None: never yet.
        checks: further reasons against arming, each "" when there is none (log, stop file, free disk …).
        unknown: what the stimulator cannot tell yet; said when armed.
    """

    def __init__(
        self,
        session: Session,
        controller: Controller,
        gate: SafetyGate,
        watches: Mapping[str, SensorMonitor],
        drivers: Mapping[str, str],
        note: Callable[[Note], None],
        answered_ns: Callable[[], int | None],
        checks: Callable[[], list[str]] = list,
        unknown: Callable[[], str] = str,
    ) -> None:
        self.machine = SessionMachine()
        self.message = "warming up"
        self.belt_speed_mps = session.treadmill.belt_speed_mps if session.treadmill else None
        self.channel = session.channels[0].number if session.channels else 0
        self.quitting = False
        self._session = session
        self._controller = controller
        self._gate = gate
        self._watches = watches
        self._drivers = drivers
        self._note = note
        self._answered_ns = answered_ns
        self._checks = checks
        self._unknown = unknown
        self._feet = sorted({str(channel.foot) for channel in session.channels} & drivers.keys())
        self._began_ns: int | None = None
        self._raised_ns = -RAISE_PAUSE_NS
        self.stops = 0
        self._stopped_ns = -STOP_STANDS_NS
        self._intensity = 0.0
        self._tuning = TuningOrders(controller)
        self._moved = ""  # why the measured heights cannot be trusted, found by the arming under way

    @property
    def state(self) -> State:
        """Where the session stands."""
        return self.machine.state

    def order(self, order: Order, t_ns: int) -> list[Event]:
        """The events that carry the order out; none, and a message, where the state does not allow it."""
        handler = {
            Ask.STOP: self._stop,
            Ask.ARM: self._arm,
            Ask.DISARM: self._disarm,
            Ask.PAUSE: self._pause,
            Ask.UP: self._up,
            Ask.DOWN: self._down,
            Ask.TEST: self._test,
            Ask.TRIGGER: self._trigger,
            Ask.CHANNEL: self._select,
            Ask.BELT: self._belt,
            Ask.BELT_UP: self._belt,
            Ask.BELT_DOWN: self._belt,
            Ask.QUIT: self._quit,
            Ask.FREEZE_TUNING: self._tune,
            Ask.RESUME_TUNING: self._tune,
            Ask.ACCEPT_SUGGESTION: self._tune,
            Ask.ROLL_BACK: self._tune,
        }[order.ask]
        return handler(order, t_ns)

    def after(self, event: Event) -> None:
        """An event has been dealt with: follow what came of it."""
        t_ns = event.t_ns
        if self._began_ns is None:
            self._began_ns = t_ns
        if self.quitting:
            return
        if isinstance(event, OperatorAct) and event.action is OperatorAction.ARM:
            self._armed(t_ns)
        if self._gate.latched:
            stopped = self._gate.latched == "emergency stop"
            self._move(t_ns, Cause.STOP if stopped else Cause.FAULT, self._gate.latched)
        elif isinstance(event, Tick) or self.state is State.OFF:
            pass
        elif self.state in CURRENT_ALLOWED:
            walks = any(self._controller.walking(foot) for foot in self._feet)
            self._move(t_ns, Cause.WALK if walks else Cause.STAND)
        if self.state is State.OFF and t_ns - self._began_ns >= WARM_NS:
            self._move(t_ns, Cause.READY, "ready; a arms")

    def doubts(self, t_ns: int, *, at_rest: bool = True) -> list[str]:
        """All that speaks against arming now."""
        doubts = [] if self._began_ns is not None and t_ns - self._began_ns >= WARM_NS else ["still warming up"]
        for sensor, watch in self._watches.items():
            fault = watch.not_alive(t_ns)
            if not fault and at_rest and sensor in self._drivers.values():
                fault = watch.not_at_rest(t_ns) or watch.not_upright(t_ns)
            doubts.append(fault)
        doubts += [
            f"{channel.name}: the {channel.foot} is not calibrated"
            for channel in self._session.channels
            if channel.foot not in self._drivers
        ]
        answered_ns = self._answered_ns()
        if answered_ns is None or t_ns - answered_ns > ANSWER_NS:
            doubts.append("the stimulator does not answer")
        return [doubt for doubt in (*doubts, *self._checks()) if doubt]

    def keys_gone(self, t_ns: int, others: list[str]) -> list[Event]:
        """The stop key is not there any more; ``others``: what else stops. A stop, where nothing does."""
        if not others:
            return self._stop(Order(Ask.STOP, origin=NO_STOP), t_ns)
        *first, last = others
        which = f"{', '.join(first)} or {last}" if first else last
        self._say(t_ns, "warning", f"the keyboard is gone; stop by {which}")
        return []

    # --- orders ------------------------------------------------------------------------------------------

    def _stop(self, order: Order, t_ns: int) -> list[Event]:
        self.stops += 1
        self._stopped_ns = t_ns
        self._say(t_ns, "fault", f"emergency stop ({order.origin})")
        self._move(t_ns, Cause.STOP, self.message)
        return [OperatorAct(t_ns, OperatorAction.EMERGENCY_STOP)]

    def _arm(self, order: Order, t_ns: int) -> list[Event]:
        if not self.machine.may(Cause.ARM):
            return self._refuse(t_ns, f"cannot arm: the session is {self.state}")
        if t_ns - self._stopped_ns < STOP_STANDS_NS:
            return self._refuse(t_ns, "cannot arm: stopped just now")
        resumes = self.state is State.PAUSED
        if doubts := self.doubts(t_ns, at_rest=not resumes):
            return self._refuse(t_ns, "cannot arm: " + "; ".join(doubts))
        arm = OperatorAct(t_ns, OperatorAction.ARM)
        self._moved = ""
        if resumes:  # nobody rests, so nothing is known of zeros; and tuning may go on by a person's own word
            return [arm]
        self._intensity = 0.0  # whatever it was: from nothing, by hand
        return [OperatorAct(t_ns, OperatorAction.SET_INTENSITY, 0.0), arm, *self._without_heights(t_ns)]

    def _without_heights(self, t_ns: int) -> list[Event]:
        """Where the measured foot cannot be trusted to the centimetre, nothing is tuned by it; a person may resume."""
        tuners = self._controller.tuning.tuners
        feet = {str(channel.foot) for channel in self._session.channels if channel.number in tuners}
        moved = [self._watches[self._drivers[foot]].zero_moved(t_ns) for foot in sorted(feet & self._drivers.keys())]
        if not any(moved):
            return []
        why = "; ".join(filter(None, moved))
        self._moved = f"{why}; tuning is frozen"
        frozen = all(tuner.frozen for tuner in tuners.values())
        return [] if frozen else [OperatorAct(t_ns, OperatorAction.FREEZE_TUNING, why=why)]

    def _armed(self, t_ns: int) -> None:
        if self._gate.armed:
            unknown = self._unknown()
            said = filter(None, ("armed; + raises the intensity", self._moved, unknown))
            self._move(t_ns, Cause.ARM, "; ".join(said))
            if unknown:
                self._note(Note(t_ns, "info", "session", unknown))
            if self._moved:
                self._note(Note(t_ns, "warning", "session", self._moved))
        else:
            self._refuse(t_ns, f"cannot arm: {self._gate.arming_refused}")

    def _disarm(self, order: Order, t_ns: int) -> list[Event]:
        self._move(t_ns, Cause.DISARM, "disarmed")
        return [OperatorAct(t_ns, OperatorAction.DISARM)]

    def _pause(self, order: Order, t_ns: int) -> list[Event]:
        if self.state is State.PAUSED:
            if order.origin == CONTROL:  # a script's pause that came twice must not go on; its arm is confirmed
                return self._refuse(t_ns, "paused already; arm goes on")
            return self._arm(order, t_ns)
        if not self.machine.may(Cause.PAUSE):
            return self._refuse(t_ns, f"nothing to pause: the session is {self.state}")
        self._move(t_ns, Cause.PAUSE, "paused; p goes on")
        return [OperatorAct(t_ns, OperatorAction.DISARM)]

    def _up(self, order: Order, t_ns: int) -> list[Event]:
        if self.state not in (State.SHADOW, *CURRENT_ALLOWED):
            return self._refuse(t_ns, f"intensity cannot be raised: the session is {self.state}")
        if t_ns - self._raised_ns < RAISE_PAUSE_NS:
            return []
        self._raised_ns = t_ns
        return self._set_intensity(t_ns, min(self._intensity + INTENSITY_STEP, self._session.stimulation.intensity))

    def _down(self, order: Order, t_ns: int) -> list[Event]:
        return self._set_intensity(t_ns, max(self._intensity - INTENSITY_STEP, 0.0))

    def _set_intensity(self, t_ns: int, intensity: float) -> list[Event]:
        self._intensity = round(intensity, 6)
        self.message = f"intensity {self._intensity:.0%}"
        return [OperatorAct(t_ns, OperatorAction.SET_INTENSITY, self._intensity)]

    def _test(self, order: Order, t_ns: int) -> list[Event]:
        foot = next((str(c.foot) for c in self._session.channels if c.number == self.channel), "")
        watch = self._watches.get(self._drivers.get(foot, ""))
        if self.state is not State.ARMED:
            return self._refuse(t_ns, f"no test burst: the session is {self.state}, it must be armed and standing")
        moves = watch.not_at_rest(t_ns, TEST_REST_NS) if watch else f"no sensor tells of the {foot}"
        if moves:
            return self._refuse(t_ns, f"no test burst: {moves}")
        return self._by_hand(t_ns, OperatorAction.TEST_BURST)

    def _trigger(self, order: Order, t_ns: int) -> list[Event]:
        if self.state not in CURRENT_ALLOWED:
            return self._refuse(t_ns, f"no burst by hand: the session is {self.state}")
        return self._by_hand(t_ns, OperatorAction.TRIGGER)

    def _by_hand(self, t_ns: int, action: OperatorAction) -> list[Event]:
        self.message = f"{action.replace('_', ' ')} on channel {self.channel} at {self._intensity:.0%}"
        return [OperatorAct(t_ns, action, float(self.channel))]

    def _select(self, order: Order, t_ns: int) -> list[Event]:
        if order.value not in [channel.number for channel in self._session.channels]:
            return self._refuse(t_ns, f"there is no channel {order.value:g}")
        self.channel = int(order.value)
        self.message = f"channel {self.channel} for test and trigger"
        return []

    def _belt(self, order: Order, t_ns: int) -> list[Event]:
        step = {Ask.BELT_UP: BELT_STEP_MPS, Ask.BELT_DOWN: -BELT_STEP_MPS}.get(order.ask)
        asked = order.value if step is None else (self.belt_speed_mps or 0.0) + step
        self.belt_speed_mps = round(min(max(asked, 0.0), BELT_MOST_MPS), 3)
        return [OperatorAct(t_ns, OperatorAction.SET_BELT_SPEED, self.belt_speed_mps)]

    def _tune(self, order: Order, t_ns: int) -> list[Event]:
        try:
            events = self._tuning.take(order, self.channel, t_ns)
        except Refusal as refusal:
            return self._refuse(t_ns, str(refusal))
        self.message = self._tuning.message
        return list(events)

    def _quit(self, order: Order, t_ns: int) -> list[Event]:
        self.quitting = True
        self._move(t_ns, Cause.QUIT, "ending")
        return [OperatorAct(t_ns, OperatorAction.DISARM)]

    def _refuse(self, t_ns: int, why: str) -> list[Event]:
        self._say(t_ns, "warning", why)
        return []

    def _move(self, t_ns: int, cause: Cause, message: str = "") -> None:
        before = self.state
        if self.machine.move(cause):
            self._say(t_ns, "info", f"state {before} → {self.state} ({cause})", message or f"{self.state}")

    def _say(self, t_ns: int, severity: str, text: str, message: str = "") -> None:
        self.message = message or text
        self._note(Note(t_ns, severity, "session", text))
