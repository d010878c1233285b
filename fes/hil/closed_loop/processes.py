"""A closed-loop run in real time: patient, stimulator and ``fes run`` each in a process of its own.

What happens in a closed-loop run, by the patient's own time: the same list for separate processes and for one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from fes.hil.campaign_bench import LATCHED, CampaignBroken
from fes.hil.closed_loop.bench import PatientBench
from fes.hil.controller import ControllerProcess, ScriptedOperator, uninterrupted
from fes.live.status import Status
from fes.simulation.forward import VirtualStride
from fes.simulation.forward.closed_loop import INTERVENTIONS

ORDERS: Final = ("arm", "full", "freeze_tuning", "resume_tuning", "accept_suggestion", "roll_back")
ARM_S: Final = 4.0
FULL_S: Final = 4.5  # intensity to the session's; by hand that takes four seconds
WALK_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class Happening:
    """At ``t_s`` of the patient's time: an order of the operator (:data:`ORDERS`) or a deed to the patient."""

    t_s: float
    what: str
    value: float = 0.0

    def __post_init__(self) -> None:
        if self.what not in (*ORDERS, *INTERVENTIONS):
            raise ValueError(f"{self.what!r}: must be one of {', '.join((*ORDERS, *INTERVENTIONS))}")


@dataclass(frozen=True, slots=True)
class Protocol:
    """A whole run: it lasts ``seconds``; the patient begins to walk at :data:`WALK_S`."""

    seconds: float
    happenings: tuple[Happening, ...]


def course(seconds: float, further: Sequence[Happening] = ()) -> Protocol:
    """Armed and raised to full while the patient stands, then whatever else, by time."""
    first = (Happening(ARM_S, "arm"), Happening(FULL_S, "full"))
    return Protocol(seconds, tuple(sorted((*first, *further), key=lambda one: one.t_s)))


LOOK_S: Final = 0.01
START_S: Final = 120.0  # it may have to compile first
ORDER_EVERY_S: Final = 0.16
WATCH_EVERY_S: Final = 1.0
END_S: Final = 20.0
ARM_AGAIN_S: Final = 30.0  # the patient finishes a step, and rests
TOO_LATE_MS: Final = 15.0
ARMED: Final = ("armed", "running")


@dataclass(frozen=True, slots=True)
class Ran:
    """What a run left: the session log, the patient's strides of the affected foot, how punctual the patient was.

    ``interruptions``: why the session switched off meanwhile, each time it did.
    """

    log: Path
    strides: tuple[VirtualStride, ...]
    punctuality: dict[str, Any]
    interruptions: tuple[str, ...] = ()


def run_between_processes(
    bench: PatientBench,
    course: Protocol,
    *,
    on_stride: Callable[[VirtualStride], None] = lambda stride: None,
    on_status: Callable[[Status], None] = lambda status: None,
    look: Callable[[], None] = lambda: None,
    go_on: int = 0,
) -> Ran:
    """Run a course with a bench whose patient was started ``held``.

    A session that latches, as on a computer that is too busy, ends the run, or is gone on with as a person would: the
    patient stands still, is armed for again by hand, and walks on.

    Args:
        bench: patient and stimulator.
        course: what happens when, by the patient's time.
        on_stride: told every stride of the affected foot.
        on_status: told what the session says, ten times a second.
        look: called every 10 ms; may raise to end the run.
        go_on: how many times to go on.

    Raises:
        SwitchedOff: the session latched, once more than ``go_on``.
        CampaignBroken: the session does not come up, is not armed in time, or ends early.
        ImuLost: the patient is gone.
    """
    with ExitStack() as stack:
        with uninterrupted():
            controller = ControllerProcess(bench.session, bench.calibration, bench.folder)
            stack.callback(controller.end)
        operator = ScriptedOperator(controller.control, bench.folder / "operator")
        stack.callback(operator.close)
        run = _Run(bench, controller, operator, on_stride, on_status, look, go_on)
        run.until_ready()
        bench.patient.begin()
        run.through(course)
        log = run.to_the_end()
        return Ran(log, tuple(run.strides), bench.patient.punctuality(), tuple(run.interruptions))


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


class _Run:
    def __init__(
        self,
        bench: PatientBench,
        controller: ControllerProcess,
        operator: ScriptedOperator,
        on_stride: Callable[[VirtualStride], None],
        on_status: Callable[[Status], None],
        look: Callable[[], None],
        go_on: int,
    ) -> None:
        self._go_on = go_on
        self._patient = bench.patient
        self._controller = controller
        self._operator = operator
        self._on_stride = on_stride
        self._on_status = on_status
        self._look = look
        self._watched_s = self._ordered_s = 0.0
        self._status: Status | None = None
        self._wanted: list[str] = []
        self._channel = bench.settings.channel
        self._armed_by_s = WALK_S
        self.strides: list[VirtualStride] = []
        self.interruptions: list[str] = []

    def until_ready(self) -> None:
        """The session has come up and warmed up; nobody moves yet."""
        end_s = time.monotonic() + START_S
        while self._status is None or self._status.state == "off":
            if time.monotonic() > end_s:
                raise CampaignBroken(f"the session does not come up within {START_S:g} s; {self._controller.said()}")
            self._turn()

    def through(self, course: Protocol) -> None:
        """All that is to happen, at its time."""
        due = list(course.happenings)
        while (now_s := self._patient.now_s) < course.seconds:
            while due and due[0].t_s <= now_s:
                self._happen(due.pop(0))
            self._press_on(now_s)
            self._turn()
            if self._status is not None and self._status.state in LATCHED:
                self._latched(self._status.fault or self._status.message, now_s)

    def to_the_end(self) -> Path:
        """Quit; where the log is."""
        self._operator.order("quit")
        status = self._controller.wait(END_S)
        log = self._controller.log()
        if status != 0 or log is None:
            raise CampaignBroken(f"the session ended with exit code {status}; it said: {self._controller.said()}")
        return log

    def _latched(self, reason: str, now_s: float) -> None:
        if self._wanted and self._wanted[0] == "arm":
            return  # known; it is being armed again
        if len(self.interruptions) >= self._go_on:
            raise SwitchedOff(reason, float(self._patient.punctuality()["latest_ms"]))
        self.interruptions.append(reason)
        self._patient.do("stand")
        self._wanted = ["arm", "full", "walk"]
        self._armed_by_s = now_s + ARM_AGAIN_S

    def _happen(self, one: Happening) -> None:
        if one.what in INTERVENTIONS:
            self._patient.do(one.what, one.value)
        elif one.what in ("arm", "full"):
            self._wanted.append(one.what)
        else:
            self._operator.order(one.what, one.value)

    def _press_on(self, now_s: float) -> None:
        """Arm, then raise, a key press at a time, until the session says that it is so."""
        if not self._wanted or time.monotonic() - self._ordered_s < ORDER_EVERY_S or self._status is None:
            return
        self._ordered_s = time.monotonic()
        if self._wanted[0] == "arm":
            if self._status.state in ARMED:
                self._wanted.pop(0)
            elif now_s > self._armed_by_s:
                raise CampaignBroken(f"the session could not be armed in time: {self._status.message}")
            else:
                self._operator.order("arm")
        elif self._wanted[0] == "walk":
            self._patient.do(self._wanted.pop(0))
        elif self._status.intensity >= 1.0 - 1e-6:
            self._wanted.pop(0)
        else:
            self._operator.order("up")

    def _turn(self) -> None:
        if not self._controller.alive:
            raise CampaignBroken(f"the session has ended; it said: {self._controller.said()}")
        if time.monotonic() - self._watched_s > WATCH_EVERY_S:
            self._watched_s = time.monotonic()
            self._operator.watch()
        for stride in self._patient.new_strides():
            self.strides.append(stride)
            self._on_stride(stride)
        status = self._operator.listen()
        if status is not None and status is not self._status:
            self._status = status
            self._on_status(status)
        self._look()
        time.sleep(LOOK_S)
