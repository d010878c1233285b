"""Everything that a campaign runs: devices, the session under test, the scripted operator; and waiting for things."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol

from drivers.virtual.node_record import RecordEntry
from fes.hil.control import ScriptedOperator
from fes.hil.controller import ControllerProcess
from fes.hil.devices import Devices
from fes.hil.judge import MS, Output, on_at, outputs
from fes.hil.scenarios import Needs
from fes.live.status import Status

LOOK_S: Final = 0.004
ORDER_EVERY_S: Final = 0.16  # intensity is raised at most every 150 ms
START_S: Final = 60.0
LATCHED: Final = ("fault", "stopped")
ARM_S: Final = 30.0
BURST_S: Final = 30.0
TRIGGER_EVERY_S: Final = 1.5  # a burst by hand lasts 1 s and falls


class Bench(Protocol):
    """What a session under test is run against: simulated devices, or real ones."""

    @property
    def folder(self) -> Path:
        """For all files of the campaign."""
        ...

    @property
    def calibration(self) -> Path:
        """Of the sensors."""
        ...

    @property
    def intensity(self) -> float:
        """That the operator raises to."""
        ...

    def session_file(self, number: int, variant: str) -> Path:
        """Settings for the campaign's ``number``-th session."""
        ...

    def entries(self) -> list[RecordEntry]:
        """What the stimulator's end of the line says."""
        ...

    def processes(self) -> list[int]:
        """Ids of those that must keep their time whatever happens to the controller."""
        ...


class CampaignBroken(RuntimeError):
    """The session under test does not come up, or does not stimulate though nothing is wrong."""


@dataclass(slots=True)
class Rig:
    """See the module; make one, :meth:`prepare` it for each row, :meth:`close` it."""

    bench: Bench
    can_do: frozenset[Needs]
    stack: ExitStack
    by_hand: bool = False  # nobody walks: bursts are triggered by hand
    variant: str = ""
    controller: ControllerProcess | None = None
    operator: ScriptedOperator | None = None
    runs: int = 0
    unasked: list[str] = field(default_factory=list)  # reasons for which the session went off before any fault
    sent: int = 0  # by whoever else is on the bus, with identifiers that the stimulator listens to
    _watched_s: float = field(default=0.0)
    _trigger_s: float = field(default=0.0)

    @property
    def devices(self) -> Devices:
        """The simulated ones.

        Raises:
            CampaignBroken: the devices are real.
        """
        if not isinstance(self.bench, Devices):
            raise CampaignBroken("this fault needs simulated devices")
        return self.bench

    # --- the session under test --------------------------------------------------------------------------

    def prepare(self, variant: str) -> None:
        """A session of this kind is running, armed by hand while the patient stands, and raised.

        Raises:
            CampaignBroken: it cannot be brought there.
        """
        if self.controller is not None and (not self.controller.alive or variant != self.variant):
            self.end_session()
        if self.controller is None:
            self._start(variant)
        self.arm()

    def arm(self) -> None:
        """By hand, as often as it takes until the patient stands still; then up to the campaign's intensity.

        Raises:
            CampaignBroken: the session refuses for too long.
        """
        allowed = ("armed", "running")
        self.until(lambda status: status.state in allowed, "arm", ARM_S, "arming is refused")
        self.until(
            lambda status: status.intensity >= self.bench.intensity - 1e-6, "up", ARM_S, "intensity does not rise"
        )

    def end_session(self) -> None:
        """Whatever state it is in."""
        if self.controller is not None:
            self.controller.end()
            self.controller = None
        if self.operator is not None:
            self.operator.close()
            self.operator = None

    def close(self) -> None:
        """End the session; the devices belong to whoever started them."""
        self.end_session()

    def session(self) -> ControllerProcess:
        """The running one."""
        if self.controller is None:
            raise CampaignBroken("there is no session")
        return self.controller

    def order(self, ask: str) -> None:
        """As the operator."""
        if self.operator is not None:
            self.operator.order(ask)

    # --- waiting -----------------------------------------------------------------------------------------

    def until(self, what: Callable[[Status], bool], order: str, timeout_s: float, else_say: str) -> Status:
        """Wait for a status, ordering meanwhile.

        Raises:
            CampaignBroken: it did not come in time, or the session has ended.
        """
        end_s, next_s = time.monotonic() + timeout_s, 0.0
        while time.monotonic() < end_s:
            status = self.status()
            if status is not None and what(status):
                return status
            if not self.session().alive:
                raise CampaignBroken(f"the session has ended; it said: {self.session().said()}")
            if order and status is not None and time.monotonic() >= next_s:
                next_s = time.monotonic() + ORDER_EVERY_S
                self.order(order)
            time.sleep(2 * LOOK_S)
        status = self.status()
        last = f"{status.state}: {status.message}" if status else self.session().said()
        raise CampaignBroken(f"{else_say} for {timeout_s:g} s; last: {last}")

    def status(self) -> Status | None:
        """The newest; None as long as the session says nothing."""
        if self.operator is None:
            return None
        if time.monotonic() - self._watched_s > 1.0:
            self._watched_s = time.monotonic()
            self.operator.watch()
        return self.operator.listen()

    def in_burst(self, since_on_ms: float) -> Output:
        """Wait until current has been on for this long, at the stimulator's end; that stretch of current.

        Raises:
            CampaignBroken: no burst in half a minute.
        """
        end_s = time.monotonic() + BURST_S
        while time.monotonic() < end_s:
            self._trigger()
            now_ns = time.monotonic_ns()
            output = on_at(self.outputs(), now_ns)
            if output is not None and now_ns - output.on_ns >= since_on_ms * MS:
                return output
            if not self.session().alive:
                raise CampaignBroken(f"the session has ended; it said: {self.session().said()}")
            status = self.status()
            if status is not None and status.state in LATCHED:
                self.unasked.append(status.fault)
                self.arm()
                end_s = time.monotonic() + BURST_S
            time.sleep(LOOK_S)
        status = self.status()
        raise CampaignBroken(f"no burst for {BURST_S:g} s; last: {status}")

    def outputs(self) -> list[Output]:
        """All that the stimulator has put out so far."""
        return outputs(self.bench.entries(), time.monotonic_ns())

    def watch(self, seconds: float, over: Callable[[], bool] = lambda: False) -> None:
        """Let time pass, keeping up with what the session says; where nobody walks, bursts are asked for meanwhile."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s and not over():
            self._trigger()
            self.status()
            time.sleep(2 * LOOK_S)

    def _trigger(self) -> None:
        if self.by_hand and time.monotonic() >= self._trigger_s:
            self._trigger_s = time.monotonic() + TRIGGER_EVERY_S
            self.order("trigger")

    def _start(self, variant: str) -> None:
        self.runs += 1
        self.variant = variant
        settings = self.bench.session_file(self.runs, variant)
        folder = self.bench.folder / f"run{self.runs}"
        self.controller = ControllerProcess(settings, self.bench.calibration, folder, view=variant == "view")
        self.operator = ScriptedOperator(self.controller.control, folder / "operator")
        self._watched_s = 0.0
        self.until(lambda status: status.state != "off", "", START_S, "the session does not come up")
