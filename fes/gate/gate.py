"""The gate itself: it distrusts the controller, starts silent, and refuses what it cannot vouch for.

The controller clips, the gate refuses: a request over any limit becomes *off*, and the fault is latched until a person
arms again. Every limit is the smaller of the absolute one (:mod:`fes.limits`) and the session's own for the channel
(:class:`fes.config.ChannelLimits`). The gate reads no clock and does no I/O; it knows what :meth:`SafetyGate.observe`
and :meth:`SafetyGate.judge` are told, in times that must never run backward.

Some refusals do not latch, because nothing is broken: not armed, too soon after the last burst, an antagonist still
on, a foot that rests (:mod:`fes.gate.movement`), a radio that is behind for a moment. A burst refused in this way, or
one whose command ran out before the next came, is *held back*: it may still start late with one step of the device, and
where it asks for more, it is refused in silence until the plan has asked for off.
"""

from collections.abc import Mapping
from typing import NamedTuple

from fes import limits
from fes.config import Channel, ImuDevice, Session
from fes.gate.channel import COARSEST_STEP_MA, RISE_STEP_MA, ChannelState
from fes.gate.electrical import is_number, no_number, over_a_cap, shown, wrongly_delivered
from fes.gate.freshness import Freshness, Stamps
from fes.gate.movement import BurstWatch, Movement
from fes.gate.plausibility import Plausibility
from fes.signals import (
    NS_PER_S,
    Event,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimRequest,
    StimStatus,
    SystemFault,
    Vector3,
)

STOPPED = "emergency stop"  # the reason of a latch that a person made
NO_CHANNEL = -1  # stands in a command for a channel number that is not even a number, or a huge one


class Flagged(NamedTuple):
    """Faulty samples of one sensor that drives no channel: how many so far; of the newest, what was wrong, and when."""

    samples: int
    fault: str
    t_ns: int


class SafetyGate:
    """Lets a request through unchanged or turns it into off, with the reason in ``StimCommand.refused``.

    Args:
        channels: the session's channels; a request for any other is refused.
        max_data_age_ms: how old the newest sample of a channel's foot may be; at most ``limits.MAX_DATA_AGE_MS``, by
            radio ``limits.RADIO.max_data_age_ms``.
        validity_ms: how long a command holds on the device; at most ``limits.MAX_VALIDITY_MS``. A channel whose
            last command is older counts as off, for the device has fallen silent.
        devices: the sensors' settings; without a sensor's ranges its saturation cannot be told.
        up: each sensor's upward direction at calibration; without it its mounting is not judged.
        shank_phase_sensors: for a foot whose phases another sensor tells (its shank's), that sensor.
        by_sensors: whether a sensor tells when to stimulate; without one, in exercise, no data are asked for.
        exercise_s: how long a burst of an exercise lasts until it falls.
        current_step_ma: the stimulator's step of current, at most ``COARSEST_STEP_MA``; a rise may be rounded to it.
        by_radio: the sensors whose samples come by radio; their channels have the limits of ``limits.RADIO``.

    Attributes:
        flagged: by sensor, what was wrong with samples that no channel's timing rests on.
        doubted: sensors that a channel follows, and of which a fault was seen; whoever has proof that it is gone takes
            them out.
        arming_refused: why the last attempt at arming failed; "" when it did not.
        latched_ns: when :attr:`latched` came about.
    """

    def __init__(
        self,
        channels: tuple[Channel, ...],
        *,
        max_data_age_ms: int,
        validity_ms: int,
        devices: tuple[ImuDevice, ...] = (),
        up: Mapping[str, Vector3] | None = None,
        shank_phase_sensors: Mapping[str, str] | None = None,
        by_sensors: bool = True,
        exercise_s: float = 0.0,
        current_step_ma: float = RISE_STEP_MA,
        by_radio: frozenset[str] = frozenset(),
    ) -> None:
        self._by_radio = by_radio
        self._validity_ms = min((limits.RADIO if by_radio else limits.CABLE).max_validity_ms, validity_ms)
        radio_age_ns = min(limits.RADIO.max_data_age_ms, max_data_age_ms) * 1_000_000
        self._freshness = Freshness(
            min(limits.MAX_DATA_AGE_MS, max_data_age_ms) * 1_000_000, dict.fromkeys(by_radio, radio_age_ns)
        )
        self._devices = {str(device.sensor): device for device in devices}
        self._up = dict(up or {})
        self._judges = {"": Plausibility("", None, None)}  # compiled now: a first sample must not wait for it
        self._stamps = Stamps(by_radio)
        self._channels: dict[int, ChannelState] = {}
        step_ma = min(max(RISE_STEP_MA, current_step_ma), COARSEST_STEP_MA)
        for channel in channels:
            sensor = (shank_phase_sensors or {}).get(channel.foot, channel.foot) if by_sensors else ""
            named_by = {other.number for other in channels if channel.number in other.never_with}
            partners = tuple(sorted(named_by | set(channel.never_with)))
            self._channels[channel.number] = ChannelState(
                channel,
                sensor,
                partners,
                self._validity_ms * 1_000_000,
                step_ma,
                limits.RADIO if sensor in by_radio else limits.CABLE,
            )
        self._relied_on = frozenset(filter(None, (state.sensor for state in self._channels.values())))
        self._movements = {sensor: Movement() for sensor in self._relied_on}
        exercise_ns = round(exercise_s * NS_PER_S)
        self._watches = {
            number: BurstWatch(state.channel, self._movements.get(state.sensor), exercise_ns)
            for number, state in self._channels.items()
        }
        self.flagged: dict[str, Flagged] = {}
        self.doubted: set[str] = set()
        self.arming_refused = ""
        self.latched_ns: int | None = None
        self._event_ns: int | None = None
        self._judged_ns: int | None = None
        self._boot_id: int | None = None
        self._armed = False
        self._latched = ""

    @property
    def armed(self) -> bool:
        """Whether a person has armed and nothing has gone wrong since."""
        return self._armed

    @property
    def latched(self) -> str:
        """The first reason that stopped everything since a person last armed; "" when there is none."""
        return self._latched

    def latch(self, t_ns: int, reason: str) -> None:
        """Stop everything until a person arms again; the first reason is kept."""
        self._armed = False
        if not self._latched:
            self._latched, self.latched_ns = reason or "fault of unknown reason", t_ns

    # --- what happens ------------------------------------------------------------------------------------

    def observe(self, event: Event) -> None:
        """Take note of an event; call it for every one, in order, before the controller sees it."""
        earlier_ns, self._event_ns = self._event_ns, event.t_ns
        if isinstance(event, ImuSample):
            silence = self._freshness.silence(event) if self._armed else ""
            # all three take it in, whatever one of them says; the gravest is named
            order, fault = self._stamps.fault(event), self._freshness.note(event)
            # a movement is judged by when it was, not by when a radio let it through
            felt = event._replace(t_ns=event.t_sensor_ns) if event.sensor in self._by_radio else event
            implausible = self._judge_of(event.sensor).fault(felt)
            if movement := self._movements.get(event.sensor):
                movement.observe(event)
            if fault := fault or implausible or order or silence:
                self._on_fault_of(event, fault)
        elif isinstance(event, OperatorAct):
            self._on_act(event)
        elif isinstance(event, StimStatus):
            self._on_status(event)
        elif isinstance(event, StimAlive):
            self._on_alive(event)
        elif isinstance(event, SystemFault):
            self.latch(event.t_ns, event.text)
            self.doubted.update(sensor for sensor in self._relied_on if sensor in event.text)
        # last, so that an act of arming that itself came from the past does not stand
        self._notice_backward(event.t_ns, earlier_ns)

    def _on_fault_of(self, sample: ImuSample, fault: str) -> None:
        """What drives a channel stops everything; what is only recorded must not stop the therapy of a sound foot."""
        if sample.sensor in self._relied_on:
            self.latch(sample.t_ns, fault)
            self.doubted.add(sample.sensor)
            return
        before = self.flagged[sample.sensor].samples if sample.sensor in self.flagged else 0
        self.flagged[sample.sensor] = Flagged(before + 1, fault, sample.t_ns)

    def _on_act(self, act: OperatorAct) -> None:
        for watch in self._watches.values():
            watch.observe(act)
        if act.action is OperatorAction.ARM:
            reasons = (self._reason_not_ready(sensor, act.t_ns) for sensor in sorted(self._relied_on))
            self.arming_refused = next(filter(None, reasons), "")
            self._armed = not self.arming_refused
            if self._armed:
                self._latched, self.latched_ns = "", None
        elif act.action is OperatorAction.DISARM:
            self._armed = False
        elif act.action is OperatorAction.EMERGENCY_STOP:
            self.latch(act.t_ns, STOPPED)

    def _on_status(self, status: StimStatus) -> None:
        if status.fault:
            self.latch(status.t_ns, f"stimulator fault on channel {status.channel}: {status.fault}")
        state = self._channels.get(status.channel)
        if state is None:
            return
        if status.on:
            over = wrongly_delivered(status, state.channel.electrode_area_cm2, state.caps)
            if over:
                self.latch(status.t_ns, f"{state.channel.name}: stimulator delivers {over}")
        if status.pulses > 0 and state.unasked(status.t_ns):
            self.latch(status.t_ns, f"{state.channel.name}: stimulator delivers pulses that nobody asked for")

    def _on_alive(self, alive: StimAlive) -> None:
        if alive.fault:
            self.latch(alive.t_ns, f"stimulator fault: {alive.fault}")
        if self._boot_id is not None and alive.boot_id != self._boot_id:
            self.latch(alive.t_ns, "stimulator restarted")
        self._boot_id = alive.boot_id

    def _notice_backward(self, t_ns: int, earlier_ns: int | None) -> None:
        if earlier_ns is not None and t_ns < earlier_ns:
            self.latch(t_ns, f"time ran backward by {(earlier_ns - t_ns) / 1e6:.3g} ms")

    # --- the last word -----------------------------------------------------------------------------------

    def judge(self, t_ns: int, request: StimRequest) -> StimCommand:
        """Turn a request into the command that goes out; never raises, whatever the request holds.

        Judge only what is then sent, at once and in this order, or what an *off* for the channel replaces, judged anew:
        the gate takes each channel's last answer for its state.
        """
        self._notice_backward(t_ns, self._event_ns)
        self._notice_backward(t_ns, self._judged_ns)
        self._judged_ns = t_ns
        for each in self._channels.values():
            each.let_lapse(t_ns)
        number = _channel_number(request.channel)
        state = self._channels.get(number)
        refused = "" if request.on is False else self._refusal(t_ns, state, request)
        if state is None or refused or not request.on:
            if state is not None:
                state.command_off(t_ns)
                state.held_back = bool(refused)
            return StimCommand(t_ns, number, False, 0.0, 0.0, 0.0, self._validity_ms, refused)
        current_ma, width_us = float(request.current_ma), float(request.pulse_width_us)
        frequency_hz = float(request.frequency_hz)
        state.command_on(t_ns, current_ma, limits.charge_per_phase_uc(current_ma, width_us) * frequency_hz)
        state.held_back = False
        return StimCommand(t_ns, number, True, current_ma, width_us, frequency_hz, self._validity_ms)

    def _reason_not_ready(self, sensor: str, t_ns: int) -> str:
        if not sensor:
            return ""
        return self._freshness.reason_not_ready(sensor, t_ns) or self._judge_of(sensor).not_ready

    def _judge_of(self, sensor: str) -> Plausibility:
        """Whether this sensor's numbers can be, as one that knows its ranges and its mounting judges them."""
        if sensor not in self._judges:
            self._judges[sensor] = Plausibility(sensor, self._devices.get(sensor), self._up.get(sensor))
        return self._judges[sensor]

    def _refusal(self, t_ns: int, state: ChannelState | None, request: StimRequest) -> str:
        """Why stimulation must not go out; "" when it may. Latches what is a fault."""
        if state is None:
            fault = f"the session has no channel {shown(request.channel)}"
            self.latch(t_ns, fault)
            return fault
        if self._latched:
            return self._latched
        if not self._armed:
            return f"not armed: {self.arming_refused}" if self.arming_refused else "not armed"
        if lags := self._freshness.lags(state.sensor, t_ns):
            return f"{state.channel.name}: {lags}"
        if fault := self._fault(t_ns, state, request):
            self.latch(t_ns, fault)
            return fault
        hold = state.off_too_short(t_ns) or self._antagonist_on(state)
        if not hold and state.held_back:  # of any other burst a rise too fast is a fault
            hold = state.rises_too_fast(t_ns, request.current_ma)
        if not hold:  # after all others: to a burst asked for by hand it is told that it begins
            hold = self._watches[state.channel.number].forbids(t_ns, begins=not state.on)
        return f"{state.channel.name}: {hold}" if hold else ""

    def _fault(self, t_ns: int, state: ChannelState, request: StimRequest) -> str:
        """What latches. The order matters: the later checks rely on the numbers being numbers."""
        if not_ready := self._reason_not_ready(state.sensor, t_ns):
            self.doubted.add(state.sensor)
            return not_ready
        fault = (
            _no_switch(request.on)
            or no_number(request)
            or over_a_cap(request, state.channel.electrode_area_cm2, state.caps)
            or state.on_too_long(t_ns)
            or state.too_much_charge(t_ns)
        )
        if not fault and not state.held_back:  # a burst held back has missed its ramp, which is nobody's fault
            fault = state.rises_too_fast(t_ns, request.current_ma)
        return f"{state.channel.name}: {fault}" if fault else ""

    def _antagonist_on(self, state: ChannelState) -> str:
        for number in state.partners:
            partner = self._channels.get(number)
            if partner is not None and partner.on:
                return f"never together with {partner.channel.name}, which is on"
        return ""


def _no_switch(value: object) -> str:
    return "" if isinstance(value, bool) else f"on is {shown(value)}, must be true or false"


def _channel_number(value: object) -> int:
    return value if isinstance(value, int) and is_number(value) else NO_CHANNEL


def gate_of(
    session: Session,
    up: Mapping[str, Vector3],
    shank_phase_sensors: Mapping[str, str] | None = None,
    current_step_ma: float = RISE_STEP_MA,
) -> SafetyGate:
    """The one way to make a session's gate, live and in replay; see :class:`SafetyGate` for the rest."""
    return SafetyGate(
        session.channels,
        max_data_age_ms=session.stimulation.max_data_age_ms,
        validity_ms=session.stimulation.validity_ms,
        devices=session.sensors,
        up=up,
        shank_phase_sensors=shank_phase_sensors,
        by_sensors=session.exercise is None,
        exercise_s=session.exercise.rise_s + session.exercise.on_s if session.exercise else 0.0,
        current_step_ma=current_step_ma,
        by_radio=session.by_radio,
    )
