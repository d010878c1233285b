"""Everything that a campaign runs: devices, the session under test, the scripted operator; and waiting for things."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Final

from drivers.simulated.record import RecordEntry
from fes.hil.baseline import Gap
from fes.hil.controller import Child, ControllerProcess, uninterrupted
from fes.hil.devices import Devices, Hardware
from fes.hil.results import MS, Output, Outputs, output_at, overlap_ms
from fes.hil.scenarios import Needs, Scenario
from fes.hil.settings import reversed_axis
from fes.live.operator import ASKED
from fes.live.status import Status
from fes.signals import NS_PER_S

LOOK_S: Final = 0.004
TAP_EVERY_S: Final = 1.5
COMMAND_EVERY_S: Final = 0.16  # intensity is raised at most every 150 ms
START_S: Final = 60.0
ALLOWED: Final = ("armed", "running")
LATCHED: Final = ("fault", "stopped")
LOST_TIME: Final = ("stalled for", "ms old", "ms late", "no answer", "unanswered", "no heartbeat", "lease expired")
KEPT_NS: Final = 600 * NS_PER_S
ARM_S: Final = 30.0
BURST_S: Final = 30.0
STOOD: Final = 0.95  # of the time: a stride's swing takes more of it
TRIGGER_EVERY_S: Final = 1.5  # a burst by hand lasts 1 s and falls


def _next_command(status: Status) -> str:
    return "up" if status.state in ALLOWED else "arm"


SAID_NOTHING: Final = "nothing said; a first start compiles (`fes compile` does that ahead), a busy machine is slow"


class CampaignBroken(RuntimeError):
    """The session under test does not come up, or does not stimulate though nothing is wrong."""


@dataclass(slots=True)
class CampaignBench:
    """Make one, :meth:`prepare` it for each row, :meth:`end_session`; the devices belong to whoever started them."""

    equipment: Devices | Hardware
    capabilities: frozenset[Needs]
    stack: ExitStack
    by_hand: bool = False  # nobody walks: bursts are triggered by hand
    variant: str = ""
    controller: ControllerProcess | None = None
    runs: int = 0
    unasked: list[str] = field(default_factory=list)  # reasons for which the session went off before any fault
    away: list[str] = field(default_factory=list)  # such reasons where this machine had taken the processor away
    gaps: Callable[[int], list[Gap]] = field(default=lambda since_ns: [])  # when that was, since then
    sent: int = 0  # by whoever else is on the bus, with identifiers that the stimulator listens to
    value: float = 0.0  # what the fault is brought about with this time
    orphans: list[Child] = field(default_factory=list)  # what a killed session leaves behind
    recorded: list[RecordEntry] | None = None  # the record's entries are kept here, when it is a list
    _outputs: Outputs = field(default_factory=Outputs)
    _trigger_s: float = 0.0
    _command_s: float = 0.0
    _tap_s: float = 0.0

    @property
    def devices(self) -> Devices:
        """The simulated ones. CampaignBroken: the devices are real."""
        if not isinstance(self.equipment, Devices):
            raise CampaignBroken("this fault needs simulated devices")
        return self.equipment

    # --- the session under test --------------------------------------------------------------------------

    def prepare(self, variant: str, *, walks: bool = True) -> None:
        """A session of this kind is running, armed by hand while the patient stands, and raised; they walk on, or not.

        CampaignBroken: it cannot be brought there.
        """
        self.start(variant)
        self.outputs()
        self._outputs.forget(time.monotonic_ns() - KEPT_NS)
        self.arm(walks=walks)

    def start(self, variant: str) -> None:
        """A session of this kind is running. CampaignBroken: it does not come up."""
        if self.controller is not None:
            if self.controller.alive and variant == self.variant:
                return
            self.end_session()
        self.runs, self.variant = self.runs + 1, variant
        settings = self.equipment.session_file(self.runs, variant)
        folder = self.equipment.folder / f"run{self.runs}"
        seen, calibration = variant == "seen", self.equipment.calibration
        if variant == "reversed":
            calibration = reversed_axis(calibration, self.equipment.folder)
        with uninterrupted():
            faults = self.equipment.imu.connect() if isinstance(self.equipment, Hardware) else None
            self.controller = ControllerProcess(settings, calibration, folder, view=seen, page=seen, faults=faults)
        self.stand(True)  # so that the patient is at rest when the session is ready
        if variant == "button":
            self.devices.stop_button()
        self.until(lambda status: status.state != "off", None, START_S, "the session does not come up")

    def arm(self, *, walks: bool = True) -> None:
        """By hand, as often as it takes until the patient stands still; then up to the campaign's intensity.

        CampaignBroken: the session refuses for too long.
        """
        if walks and self.ready():
            return
        try:
            self.stand(True)
            self.until(self._is_ready, _next_command, ARM_S, "it cannot be armed and raised")
        finally:
            if walks:
                self.stand(False)

    def go_on(self) -> list[str]:
        """Arm again when a fault is over, as a person must be able to; [why it cannot be], else [].

        Where that fails, the next row begins a new session.
        """
        try:
            self.arm()
        except CampaignBroken as error:
            self.end_session()
            return [f"cannot be armed again: {error}"]
        return []

    def keep_armed(self) -> None:
        """As :meth:`arm`, but without waiting: call it again and again while something else is being done."""
        status = self.status()
        if status is None or self.ready() or time.monotonic() < self._command_s:
            return
        self._command_s = time.monotonic() + COMMAND_EVERY_S
        self.stand(status.state not in ALLOWED)
        self.command(_next_command(status))

    def ready(self) -> bool:
        """Whether the session is armed and raised already."""
        return (status := self.status()) is not None and self._is_ready(status)

    def went_off(self, reason: str) -> None:
        """The session went off with no fault injected: put down why, and whether it was this machine."""
        now_ns = time.monotonic_ns()
        (self.away if self.was_away(reason, now_ns - NS_PER_S, now_ns) else self.unasked).append(reason)

    def was_away(self, reason: str, since_ns: int, until_ns: int) -> bool:
        """Whether this reason speaks of lost time, and an idle loop lost time as well between these moments."""
        if not any(word in reason for word in LOST_TIME):
            return False
        return any(due_ns + late_ms * MS >= since_ns and due_ns <= until_ns for due_ns, late_ms in self.gaps(0))

    def end_session(self) -> None:
        """Whatever state it is in."""
        if self.controller is not None:
            self.controller.end()
            self.controller = None

    def session(self) -> ControllerProcess:
        """The running one."""
        if self.controller is None:
            raise CampaignBroken("there is no session")
        return self.controller

    def _need_session(self) -> None:
        if not self.session().alive:
            raise CampaignBroken(f"the session has ended; it said: {self.session().printed()}")

    def command(self, ask: str) -> None:
        """As the operator: after a sensor's fault, arming goes with a tap on it, after a second's rest."""
        if self.controller is None:
            return
        status = self.status()
        if ask == "arm" and status is not None and any(ASKED in notice for notice in status.notices):
            if time.monotonic() < self._tap_s:
                return
            self._tap_s = time.monotonic() + TAP_EVERY_S
            self.equipment.imu.inject("tap")
        self.controller.operator.send_command(ask)

    # --- waiting -----------------------------------------------------------------------------------------

    def until(
        self, what: Callable[[Status], bool], command: Callable[[Status], str] | None, timeout_s: float, else_say: str
    ) -> Status:
        """Wait for a status, sending meanwhile what the one of the moment asks for.

        CampaignBroken: it did not come in time, or the session has ended.
        """
        end_s, next_s = time.monotonic() + timeout_s, 0.0
        while time.monotonic() < end_s:
            status = self.status()
            if status is not None and what(status):
                return status
            self._need_session()
            if command is not None and status is not None and time.monotonic() >= next_s:
                next_s = time.monotonic() + COMMAND_EVERY_S
                self.command(command(status))
            time.sleep(2 * LOOK_S)
        status = self.status()
        said = f"{status.state}: {status.message}" if status and status.message else self.session().printed()
        raise CampaignBroken(f"{else_say} for {timeout_s:g} s; last: {said or SAID_NOTHING}")

    def status(self) -> Status | None:
        """The newest; None as long as the session says nothing."""
        return None if self.controller is None else self.controller.operator.receive_status()

    def in_burst(self, since_on_ms: float) -> Output:
        """Wait until current has been on for this long, at the stimulator's end; that stretch of current.

        CampaignBroken: no burst in half a minute.
        """
        end_s = time.monotonic() + BURST_S
        while time.monotonic() < end_s:
            self._trigger()
            now_ns = time.monotonic_ns()
            output = output_at(self.outputs(now_ns - NS_PER_S), now_ns)
            if output is not None and now_ns - output.on_ns >= since_on_ms * MS:
                return output
            self._need_session()
            status = self.status()
            if status is not None and status.state in LATCHED:
                self.went_off(status.fault)
                self.arm()
                end_s = time.monotonic() + BURST_S
            time.sleep(LOOK_S)
        raise CampaignBroken(f"no burst for {BURST_S:g} s; last: {self.status()}")

    def out_of_burst(self) -> None:
        """Wait until no current flows any more."""
        end_s = time.monotonic() + BURST_S
        while time.monotonic() < end_s and output_at(self.outputs((now_ns := time.monotonic_ns()) - NS_PER_S), now_ns):
            time.sleep(LOOK_S)

    def wrong_phase_ms(self, stretches: Sequence[Output], since_ns: int) -> float | None:
        """For how long current flowed since then while the foot was in stance, in truth; None where nobody knows."""
        if not isinstance(self.equipment, Devices):
            return None
        now_ns = time.monotonic_ns()
        stances_ns = self.equipment.stances_ns(since_ns, now_ns)
        return None if stances_ns is None else overlap_ms(stretches, stances_ns, now_ns)

    def stood_since(self, since_ns: int) -> bool:
        """Whether the simulated patient has, in truth, stood all the time since then; False where nobody knows."""
        if not isinstance(self.equipment, Devices):
            return False
        now_ns = time.monotonic_ns()
        stances_ns = self.equipment.stances_ns(since_ns, now_ns) or []
        return sum(end_ns - begin_ns for begin_ns, end_ns in stances_ns) > STOOD * (now_ns - since_ns)

    def outputs(self, since_ns: int = 0) -> list[Output]:
        """What the stimulator has put out since then, as far as it is kept: ten minutes."""
        entries = self.equipment.new_entries()
        self._outputs.add(entries)
        if self.recorded is not None:
            self.recorded += entries
        return self._outputs.stretches(time.monotonic_ns(), since_ns)

    def observe(self, seconds: float, over: Callable[[], bool] = lambda: False) -> None:
        """Let time pass, keeping up with what the session says; where nobody walks, bursts are asked for meanwhile."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s and not over():
            self._trigger()
            self.status()
            time.sleep(2 * LOOK_S)

    def _is_ready(self, status: Status) -> bool:
        return status.state in ALLOWED and status.intensity >= self.equipment.intensity - 1e-6

    def stand(self, stands: bool) -> None:
        """The simulated patient stays standing once they stand, or walks on; nobody else can be made to."""
        if isinstance(self.equipment, Devices):
            self.equipment.stand(stands)

    def _trigger(self) -> None:
        if self.by_hand and time.monotonic() >= self._trigger_s:
            self._trigger_s = time.monotonic() + TRIGGER_EVERY_S
            self.command("trigger")


def stated_reason(bench: CampaignBench) -> str:
    """The session's reason; "" when it gives none."""
    status = bench.status() if bench.session().alive else None
    return status.fault if status else ""


def is_latched(bench: CampaignBench) -> bool:
    """Whether only a person leads on."""
    return (status := bench.status()) is not None and status.state in LATCHED


def reason_faults(named: str, scenario: Scenario) -> list[str]:
    """What is wrong with the reason, if anything."""
    if not scenario.expected_words or any(word in named for word in scenario.expected_words):
        return []
    return [f"the reason given is {named!r}, it should speak of {' or '.join(scenario.expected_words)}"]
