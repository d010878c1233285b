"""A closed-loop run in real time: patient, stimulator and ``fes run`` each in a process of its own; and its protocol.

A protocol is what happens in a run, by the patient's own time: the same for separate processes and for one.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from fes.hil.campaign_bench import LATCHED, CampaignBroken
from fes.hil.closed_loop.bench import PatientBench, PatientHandle
from fes.hil.controller import ControllerProcess, ScriptedOperator, uninterrupted
from fes.live.status import Status
from fes.simulation.forward import VirtualStride
from fes.simulation.forward.closed_loop import INTERVENTIONS

COMMANDS: Final = ("arm", "full", "freeze_tuning", "resume_tuning", "accept_suggestion", "roll_back")
ARM_S: Final = 4.0
FULL_S: Final = 4.5  # intensity to the session's; by hand that takes four seconds
WALK_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class Happening:
    """At ``t_s`` of the patient's time: an operator's command (:data:`COMMANDS`) or an intervention on the patient."""

    t_s: float
    what: str
    value: float = 0.0

    def __post_init__(self) -> None:
        if self.what not in (*COMMANDS, *INTERVENTIONS):
            raise ValueError(f"{self.what!r}: must be one of {', '.join((*COMMANDS, *INTERVENTIONS))}")


@dataclass(frozen=True, slots=True)
class Protocol:
    """A whole run: it lasts ``seconds``; the patient begins to walk at :data:`WALK_S`."""

    seconds: float
    happenings: tuple[Happening, ...]


def armed_protocol(seconds: float, further: Sequence[Happening] = ()) -> Protocol:
    """Armed and raised to full while the patient stands, then whatever else, by time."""
    first = (Happening(ARM_S, "arm"), Happening(FULL_S, "full"))
    return Protocol(seconds, tuple(sorted((*first, *further), key=lambda one: one.t_s)))


TICK_S: Final = 0.01
START_S: Final = 120.0  # it may have to compile first
COMMAND_EVERY_S: Final = 0.16
END_S: Final = 20.0
ARM_AGAIN_S: Final = 30.0  # the patient finishes a step, and rests
TOO_LATE_MS: Final = 15.0
ARMED: Final = ("armed", "running")


@dataclass(frozen=True, slots=True)
class ClosedLoopRun:
    """What a run left: the session log, the patient's strides of the affected foot, how punctual the patient was.

    ``interruptions``: why the session switched off meanwhile, each time it did.
    """

    log: Path
    strides: tuple[VirtualStride, ...]
    punctuality: dict[str, Any]
    interruptions: tuple[str, ...] = ()


def run_between_processes(
    bench: PatientBench,
    protocol: Protocol,
    *,
    on_stride: Callable[[VirtualStride], None] = lambda stride: None,
    on_status: Callable[[Status], None] = lambda status: None,
    on_tick: Callable[[], None] = lambda: None,
    most_rearms: int = 0,
) -> ClosedLoopRun:
    """Run a protocol with a bench whose patient was started ``held``.

    A session that latches, as on a computer that is too busy, ends the run, or is gone on with as a person would: the
    patient stands still, is armed for again by hand, and walks on.

    That is done up to ``most_rearms`` times. ``on_stride`` is given the affected foot's strides, ``on_status`` what the
    session says, ten times a second; ``on_tick`` is called every 10 ms and may raise to end the run.

    Raises:
        SwitchedOff: the session latched, once more than ``most_rearms``.
        CampaignBroken: the session does not come up, is not armed in time, or ends early.
        ImuLost: the patient is gone.
    """
    with ExitStack() as stack:
        with uninterrupted():
            controller = ControllerProcess(bench.session, bench.calibration, bench.folder)
            stack.callback(controller.end)
        run = _LiveRun(bench.patient, controller, controller.operator, on_stride, on_status, on_tick, most_rearms)
        run.until_ready()
        bench.patient.begin()
        run.through(protocol)
        log = run.quit()
        return ClosedLoopRun(log, tuple(run.strides), bench.patient.punctuality(), tuple(run.interruptions))


class SwitchedOff(CampaignBroken):
    """The session latched though nothing was wrong with any device.

    Attributes:
        reason: the session's own.
        latest_ms: how late the patient's process was woken at most; tens of ms are the computer's doing.
    """

    def __init__(self, reason: str, latest_ms: float) -> None:
        self.reason, self.latest_ms = reason, latest_ms
        super().__init__(
            f"the session has switched off: {reason}. The patient's process was woken up to {latest_ms:.0f} ms late"
            + ("; this computer is too busy for real time." if latest_ms > TOO_LATE_MS else ".")
        )


@dataclass(slots=True)
class _LiveRun:
    _patient: PatientHandle
    _controller: ControllerProcess
    _operator: ScriptedOperator
    _on_stride: Callable[[VirtualStride], None]
    _on_status: Callable[[Status], None]
    _on_tick: Callable[[], None]
    _most_rearms: int
    _commanded_s: float = 0.0
    _status: Status | None = None
    _wanted: list[str] = field(default_factory=list)
    _armed_by_s: float = WALK_S
    strides: list[VirtualStride] = field(default_factory=list)
    interruptions: list[str] = field(default_factory=list)

    def until_ready(self) -> None:
        end_s = time.monotonic() + START_S
        while self._status is None or self._status.state == "off":
            if time.monotonic() > end_s:
                raise CampaignBroken(f"the session does not come up within {START_S:g} s; {self._controller.printed()}")
            self._turn()

    def through(self, protocol: Protocol) -> None:
        due = list(protocol.happenings)
        while (now_s := self._patient.now_s) < protocol.seconds:
            while due and due[0].t_s <= now_s:
                one = due.pop(0)
                if one.what in INTERVENTIONS:
                    self._patient.intervene(one.what, one.value)
                elif one.what in ("arm", "full"):
                    self._wanted.append(one.what)
                else:
                    self._operator.send_command(one.what, one.value)
            self._press_on(now_s)
            self._turn()
            if self._status is not None and self._status.state in LATCHED:
                self._latched(self._status.fault or self._status.message, now_s)

    def quit(self) -> Path:
        self._operator.send_command("quit")
        status = self._controller.wait(END_S)
        log = self._controller.log()
        if status != 0 or log is None:
            raise CampaignBroken(f"the session ended with exit code {status}; it said: {self._controller.printed()}")
        return log

    def _latched(self, reason: str, now_s: float) -> None:
        if self._wanted and self._wanted[0] == "arm":
            return  # known; it is being armed again
        if len(self.interruptions) >= self._most_rearms:
            raise SwitchedOff(reason, float(self._patient.punctuality()["latest_ms"]))
        self.interruptions.append(reason)
        self._patient.intervene("stand")
        self._wanted = ["arm", "full", "walk"]
        self._armed_by_s = now_s + ARM_AGAIN_S

    def _press_on(self, now_s: float) -> None:
        """Arm, then raise, a key press at a time, until the session says that it is so."""
        if not self._wanted or time.monotonic() - self._commanded_s < COMMAND_EVERY_S or self._status is None:
            return
        self._commanded_s = time.monotonic()
        if self._wanted[0] == "arm":
            if self._status.state in ARMED:
                self._wanted.pop(0)
            elif now_s > self._armed_by_s:
                raise CampaignBroken(f"the session could not be armed in time: {self._status.message}")
            else:
                self._operator.send_command("arm")
        elif self._wanted[0] == "walk":
            self._patient.intervene(self._wanted.pop(0))
        elif self._status.intensity < 1.0 - 1e-6:
            self._operator.send_command("up")
        else:
            self._wanted.pop(0)

    def _turn(self) -> None:
        if not self._controller.alive:
            raise CampaignBroken(f"the session has ended; it said: {self._controller.printed()}")
        for stride in self._patient.new_strides():
            self.strides.append(stride)
            self._on_stride(stride)
        status = self._operator.receive_status()
        if status is not None and status is not self._status:
            self._status = status
            self._on_status(status)
        self._on_tick()
        time.sleep(TICK_S)
