"""The faults of a campaign as a table: one row, one fault; how each is brought about is in ``injections``."""

from dataclasses import KW_ONLY, dataclass, replace
from enum import StrEnum
from typing import Final

from fes import limits


class Effect(StrEnum):
    """What a fault must do to the session."""

    LATCHED = "off until armed by hand"
    ENDED = "off, the session ends"
    NONE = "no effect"
    HARMLESS = "no effect, or off until armed by hand"
    SILENT = "no burst begins any more"
    UNSEEN = "named in passing, no burst begins any more"
    NOT_EXECUTED = "nothing executed"
    BOUNDED = "the burst ends by itself"
    DOSED = "the charge of a minute ends it"


class Moment(StrEnum):
    """When a fault is brought about."""

    SWING = "in swing, current on"
    STANCE = "in stance"
    REST = "at rest, before they set off"


class Needs(StrEnum):
    """What a row asks of the devices and the machine."""

    SIMULATED = "simulated devices"
    SENSOR = "a sensor that can be given faults"
    MOVES = "a sensor that moves: at rest this fault does not show (--walking)"
    HEARD = "a stimulator that others than the session hear (CAN)"
    CAN = "a simulated stimulator on CAN"
    LINK = "a line that can be cut"
    SLCAN = "a serial CAN adapter"
    BUTTON = "a CAN bus that a stop button can be on"
    SERIAL = "a simulated stimulator on a serial line"
    LONG_STAND = "the simulated patient, who stands for longer than a burst may last"
    CABLE = "a sensor by cable: by radio each burst falls by prediction, long before its longest on-time"
    REALS = "a sensor that sends floating point: whole numbers have no NaN, and end at the range"
    UNSOUND = "a sensor with a flag for samples whose processing failed"
    FIFO = "fixed priorities (SCHED_FIFO) and a second processor"
    PROC = "/proc (Linux)"


_NONE = frozenset[Needs]()
_SIM = frozenset((Needs.SIMULATED,))
_IMU = frozenset((Needs.SENSOR,))
_MOVING = _IMU | {Needs.MOVES}
_CAN, _LINK, _SLCAN = _SIM | {Needs.CAN}, _SIM | {Needs.LINK}, _SIM | {Needs.SLCAN}
_REALS = _IMU | {Needs.REALS}
_FIFO, _PROC = frozenset((Needs.FIFO,)), frozenset((Needs.PROC,))
_HEARD = frozenset((Needs.HEARD,))


@dataclass(frozen=True, slots=True)
class Scenario:
    """One row.

    Attributes:
        deadline_ms: by when the stimulator's output must be off; None where nothing has to go off.
        reasons: the reason that the session states must hold one of these, separated by ``|``; "": any.
        needs: without these the row is left out, with that reason.
        variant: which of the campaign's sessions it needs; "" is the usual one.
        restart: no session can go on afterwards, and another is started.
        watch_s: how long it must stay off (or go on) after the deadline; a stride and more.
        values: what the fault is brought about with, by turns; however few repeats are asked for, each comes once.
        unit: of the values.
        moment: in stance no current flows, and what is asked for is that none does by the deadline and that it is
            latched; at rest the deadline counts from when the patient sets off.
    """

    name: str
    fault: str
    deadline_ms: float | None
    reasons: str = ""
    _: KW_ONLY
    response: str = "off, latched, named"
    effect: Effect = Effect.LATCHED
    needs: frozenset[Needs] = _IMU
    variant: str = ""
    restart: bool = False
    watch_s: float = 1.5
    values: tuple[float, ...] = ()
    unit: str = ""
    moment: Moment = Moment.SWING

    @property
    def expected_words(self) -> tuple[str, ...]:
        """The reason that the session states must hold one of these; empty: any."""
        return tuple(filter(None, self.reasons.split("|")))

    @property
    def injected(self) -> str:
        """What is brought about: the same at every moment."""
        return self.name if self.moment is Moment.SWING else self.name.removesuffix(f"_{self.moment.name.lower()}")

    def attempts(self, repeat: int) -> int:
        """How many are made when ``repeat`` are asked for."""
        return max(repeat, len(self.values), 1)

    def value(self, n: int) -> float:
        """For the n-th attempt; 0 where there are none."""
        return self.values[n % len(self.values)] if self.values else 0.0


def _harmless(
    name: str, fault: str, response: str = "no effect", needs: frozenset[Needs] = _IMU, variant: str = ""
) -> Scenario:
    return Scenario(name, fault, None, response=response, effect=Effect.NONE, needs=needs, variant=variant)


def _refused(name: str, fault: str, needs: frozenset[Needs] = _CAN) -> Scenario:
    effect = Effect.NOT_EXECUTED
    return Scenario(name, fault, None, response="none executed", effect=effect, needs=needs, watch_s=0.3)


def _stop(name: str, by: str, needs: frozenset[Needs] = _NONE, variant: str = "") -> Scenario:
    fault, response = f"emergency stop: {by}", "off, latched"
    return Scenario(name, fault, 50, "emergency stop", response=response, needs=needs, variant=variant)


def _ends(name: str, fault: str) -> Scenario:
    response = "session ends with an alarm; the log is readable, at most 250 ms lost"
    needs = _PROC | _HEARD
    return Scenario(name, fault, 1000, response=response, effect=Effect.ENDED, needs=needs, restart=True, watch_s=0.5)


_LEASE = "the stimulator's lease"
_STAYS = "the stimulator's lease; notices the gap itself, stays off"
_BACK = "off; reconnects by itself, is never armed by itself"
_OPENED = "off by lease; opened again; armed by hand"
_RETRY = "one retry, then off"
_CONTRADICTS = "feel it|do not fit|gravity|dangle|stuck"
_LATE = "silent|late|old|data"
_HELD_UP = "stalled|late|old|lease expired"  # stopped between looking up and hearing the stimulator, that speaks first

# fmt: off
_ROWS: Final[tuple[Scenario, ...]] = (
    Scenario("imu_silent", "sensor silent", 100, "old|lost|no data", response=_BACK),
    Scenario("imu_unplugged", "sensor unplugged, plugged in again", 100, "old|lost|no data", response=_BACK),
    Scenario("imu_frozen", "sensor repeats one value", 100, "frozen"),
    Scenario("imu_force_frozen", "accelerometer frozen, gyroscope not", 100, "accelerometer is frozen"),
    Scenario("imu_rate_frozen", "gyroscope frozen, accelerometer not", 100, "gyroscope is frozen"),
    Scenario("imu_force_dead", "accelerometer holds one value, with noise", 1500, "feel it|do not fit|gravity",
             needs=_MOVING),
    Scenario("imu_rate_stuck", "gyroscope holds one value, with noise", 1500, "feel it|do not fit|dangle",
             needs=_MOVING),
    Scenario("imu_force_axis_stuck", "accelerometer's axis 1, 2, 3 holds one value, with noise", 1500, _CONTRADICTS,
             values=(1.0, 2.0, 3.0), needs=_MOVING),
    Scenario("imu_rate_axis_stuck", "gyroscope's axis 1, 2, 3 holds one value, with noise", 1500, _CONTRADICTS,
             values=(1.0, 2.0, 3.0), needs=_MOVING),
    Scenario("imu_force_scaled", "accelerometer × 0.5, 0.8, 1.25, 2", 1500, _CONTRADICTS + "|unit|take",
             values=(0.5, 0.8, 1.25, 2.0), needs=_MOVING),
    Scenario("imu_rate_scaled", "gyroscope × 0.5, 2", 1500, _CONTRADICTS + "|unit|take", values=(0.5, 2.0),
             needs=_MOVING),
    Scenario("imu_dangling", "sensor hangs from its cable and swings", 1500, _CONTRADICTS + "|remounted"),
    Scenario("imu_late", "samples late by 0.3, 0.6 s, their stamps shifted by as much", 100, _LATE,
             values=(0.3, 0.6), unit="s"),
    Scenario("imu_backlog", "samples held back for 0.1, 0.3, 1 s, then all at once", 100, "old|lost|no data|late",
             response=_BACK, values=(0.1, 0.3, 1.0), unit="s"),
    Scenario("imu_nan", "NaN in the sensor's values", 100, "non-finite", needs=_REALS),
    Scenario("imu_inf", "infinite values", 100, "non-finite", needs=_REALS),
    Scenario("imu_unsound", "sensor says that its processing failed", 100, "non-finite",
             needs=_IMU | {Needs.UNSOUND}),
    Scenario("imu_saturated", "sensor at the end of its range", 100, "saturated|frozen|foot can take|unit|feel it"),
    Scenario("imu_unit_deg", "wrong unit (°/s for rad/s)", 100, "unit|non-finite|take", needs=_MOVING),
    Scenario("imu_unit_g", "wrong unit (g for m/s²)", 100, "unit"),
    Scenario("imu_remounted", "sensor remounted, axes exchanged: while standing, armed", None, "remounted|calibration",
             response="no burst begins; arming refused, with the reason", effect=Effect.SILENT, watch_s=3.0),
    Scenario("axis_reversed", "calibration with its axis reversed", None, "in disorder", variant="reversed", needs=_SIM,
             response="named within five strides; from then on no burst begins", effect=Effect.UNSEEN, watch_s=5.0),
    Scenario("imu_remounted_in_swing", "sensor's axes exchanged in mid-swing", 100,
             "remounted|calibration|unit|frozen"),
    _harmless("stamp_doubled_once", "one time stamp doubled", "counted, no effect"),
    _harmless("stamp_order_once", "two samples out of order, once", "counted, no effect"),
    Scenario("stamps_doubled", "more than 5 % of the stamps doubled", 1100, "stamps|clock"),
    Scenario("stamps_order", "more than 5 % of the stamps out of order", 1100, "stamps|clock"),
    Scenario("stamps_jumping", "more than 5 % of the stamps ahead by 0.2 s", 1100, "stamps|clock"),
    Scenario("clock_jump", "sensor's clock set ahead by 0.5 s, once", None,
             response="counted, no effect; or off, and can be armed again", effect=Effect.HARMLESS),
    _harmless("clock_drift", "sensor's clock runs 100 ppm fast"),
    Scenario("stale_data", "samples delayed by 60, 100, 200, 500 ms", 100, "old|stamps|clock|data",
             values=(0.06, 0.1, 0.2, 0.5), unit="s"),
    _harmless("cpu_hogs", "three busy processes", "no effect under SCHED_FIFO", _FIFO),
    Scenario("controller_killed", "controller kill -9", 65, response=_LEASE + "; its other processes end within 3 s",
             needs=_HEARD, variant="seen", restart=True, watch_s=1.3),
    Scenario("controller_stopped", "controller SIGSTOP for 0.2, 1, 5 s", 65, _HELD_UP, response=_STAYS, needs=_HEARD,
             values=(0.2, 1.0, 5.0), unit="s"),
    Scenario("controller_starved", "controller without processor for 1 s", 65, _HELD_UP, response=_STAYS,
             needs=_FIFO | _HEARD),
    Scenario("supervisor_killed", "supervisor kill -9", 65, "supervisor",
             response=_LEASE + "; only a new session goes on", needs=_PROC | _HEARD, restart=True),
    Scenario("supervisor_stopped", "supervisor SIGSTOP for 0.2, 1, 5 s", 65, "supervisor",
             response=_OPENED, needs=_PROC | _HEARD, values=(0.2, 1.0, 5.0), unit="s"),
    Scenario("link_lost", "line to the stimulator lost and back", 65, response=_OPENED, needs=_LINK),
    Scenario("adapter_unplugged", "CAN adapter unplugged, plugged in again", 65, "lost|stimulator", response=_OPENED,
             needs=_SLCAN),
    Scenario("bus_off", "CAN adapter goes bus-off, and comes back", 65, "bus-off|answer|lost", response=_OPENED,
             needs=_CAN | _LINK),
    Scenario("adapter_full", "CAN adapter takes nothing more, its buffer is full", 65,
             "stalled|late|answer|lost|old|lease expired",
             response="off by lease; latched when it takes commands again", needs=_SLCAN),
    Scenario("node_reboot", "stimulator restarts", 100, "restart|session|initial|stimulator",
             response="comes up off; off", needs=_SIM),
    Scenario("ack_missing", "stimulator's answers missing", 100, "answer|heartbeat", response=_RETRY, needs=_SIM),
    Scenario("ack_late", "stimulator's answers 150 ms late", 100, "answer|heartbeat", response=_RETRY, needs=_SIM),
    Scenario("delivered_differs", "delivers half of what it is told", 100, "delivered", needs=_CAN),
    Scenario("electrode", "electrode or lead open", 100, "electrode|output|lead", needs=_SIM),
    _refused("commands_flipped", "a valid command with every 1 and 2 bits flipped"),
    _refused("commands_repeated", "valid commands repeated, 0 to 40 commands late"),
    _refused("commands_reordered", "ten pairs of commands exchanged on the way", _CAN | _LINK),
    _refused("commands_old_session", "valid commands of an earlier session"),
    _refused("random_frames", "random frames on the bus, 62,500 each time"),
    _stop("stop_key", "space bar"),
    _stop("stop_file", "stop file"),
    _stop("stop_control", "control socket"),
    _stop("stop_page", "live page", _SIM, "seen"),
    _stop("stop_button", "hardware button (a bit on CAN)", _SIM | {Needs.BUTTON}, "button"),
    _harmless("view_killed", "terminal view kill -9", needs=_PROC, variant="seen"),
    _harmless("page_killed", "live page kill -9", needs=_PROC, variant="seen"),
    _harmless("view_frozen", "terminal view SIGSTOP for 2 s", needs=_PROC, variant="seen"),
    _harmless("page_frozen", "live page SIGSTOP for 2 s", needs=_PROC, variant="seen"),
    Scenario("phase_stuck", "phase stuck: stance without end", 3020, effect=Effect.BOUNDED, variant="stance",
             needs=_SIM | {Needs.LONG_STAND, Needs.CABLE},
             response="the burst ends soon after its usual length, at most 3 s"),
    Scenario("dose", "more charge a minute than allowed", None, "mC within a minute", effect=Effect.DOSED,
             variant="dose", needs=_SIM, response="no more than the limit a minute, off, latched"),
    _ends("disk_full", "disk full"),
    _ends("log_writer_killed", "log writer kill -9"),
    _ends("log_removed", "log file removed"),
)
# fmt: on
_LIES: Final = (
    "imu_frozen",
    "imu_force_frozen",
    "imu_rate_frozen",
    "imu_force_dead",
    "imu_rate_stuck",
    "imu_force_axis_stuck",
    "imu_rate_axis_stuck",
    "imu_force_scaled",
    "imu_rate_scaled",
    "imu_dangling",
    "imu_late",
)  # fmt: skip


def _at(row: Scenario, moment: Moment) -> Scenario:
    """The same lie of a sensor, where no current flows: told within a stride of the foot's moving."""
    name = f"{row.name}_{moment.name.lower()}"
    needs = row.needs | _SIM  # a wearer who does as told
    return replace(row, name=name, fault=f"{row.fault}, {moment}", deadline_ms=1500, moment=moment, needs=needs)


SCENARIOS: Final = _ROWS + tuple(
    _at(row, moment) for moment in (Moment.STANCE, Moment.REST) for row in _ROWS if row.name in _LIES
)
BY_NAME: Final = {scenario.name: scenario for scenario in SCENARIOS}


_RADIO_DEADLINES_MS: Final = {
    100.0: limits.RADIO.max_data_age_ms + 50.0,  # of a sensor's faults: until its data are too old, and a lease
    65.0: limits.RADIO.max_validity_ms + 5.0,  # the lease
}
_RADIO_LATCHES_S: Final = 0.25  # what is late by less ends a burst and latches nothing


def by_radio(row: Scenario) -> Scenario:
    """What is required where the sensor's samples come by radio, within the limits of that class."""
    deadline_ms, fault, values = row.deadline_ms, row.fault, row.values
    if deadline_ms == 65 or (deadline_ms == 100 and Needs.SENSOR in row.needs):
        deadline_ms = _RADIO_DEADLINES_MS[deadline_ms]
    if Needs.SENSOR in row.needs and row.unit == "s" and min(values) <= _RADIO_LATCHES_S:
        values = tuple(value for value in values if value > _RADIO_LATCHES_S)
        fault += f": those over {1e3 * _RADIO_LATCHES_S:g} ms"
    return replace(row, deadline_ms=deadline_ms, fault=fault, values=values)
