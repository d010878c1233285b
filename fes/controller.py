"""The controller: one event in, one decision out. Pure: no clock, no I/O, no threads.

Everything it knows came as an event, so the same events give the same decisions, live and in replay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fes.config import Session
from fes.estimation.calibration import FootCalibration
from fes.estimation.foot import FootTracker, Outcome
from fes.estimation.strides import SENSOR_HEIGHT_M, StrideMaker, StrideSettings
from fes.signals import (
    NS_PER_S,
    Event,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimRequest,
    StrideResult,
    Tick,
)
from fes.stimulation.plan import StimulationPlan
from fes.stimulation.walking import WalkingJudge
from statemachine.phases import Phase


@dataclass(frozen=True, slots=True)
class Decision:
    """What came of one event: ``requests`` to put before the gate now, ``outcomes`` to record, in order."""

    requests: tuple[StimRequest, ...] = ()
    outcomes: tuple[Outcome, ...] = ()


NOTHING = Decision()


class Controller:
    """From events to requests: tracker per foot, walking judge per foot, one plan.

    Args:
        session: the settings.
        calibrations: by sensor name; samples of other sensors change nothing.
    """

    def __init__(self, session: Session, calibrations: dict[str, FootCalibration]) -> None:
        self.trackers = {
            foot: FootTracker(
                calibration,
                StrideMaker(foot, stride_settings(session, calibration)),
                swing_at_reversal=session.phases.swing_begins == "reversal",
            )
            for foot, calibration in calibrations.items()
        }
        self._judges = {foot: WalkingJudge(session.stimulation) for foot in calibrations}
        self._plan = StimulationPlan(session.channels)
        self._period_ns = round(NS_PER_S / session.stimulation.command_rate_hz)
        self._next_command_ns: int | None = None
        self._on = False
        self.intensity = 0.0

    def phase(self, foot: str) -> Phase:
        """The gait phase of a foot now."""
        return self.trackers[foot].phase

    def step(self, event: Event) -> Decision:
        """Take in one event; times must not decrease."""
        outcomes: tuple[Outcome, ...] = ()
        if isinstance(event, ImuSample):
            tracker = self.trackers.get(event.sensor)
            if tracker is not None:
                outcomes = tuple(self._advance(tracker, event))
        elif isinstance(event, OperatorAct):
            self._on_act(event)
        # in a silence the gate must see how old the data have become, sooner than at the next command
        requests = self._due(event.t_ns, at_once=self._on and isinstance(event, Tick))
        return Decision(requests, outcomes) if requests or outcomes else NOTHING

    def _advance(self, tracker: FootTracker, sample: ImuSample) -> list[Outcome]:
        outcomes = tracker.advance(
            np.array([sample.t_sensor_ns]), np.array([sample.acc_mps2]), np.array([sample.gyr_radps])
        )
        judge = self._judges[tracker.foot]
        for outcome in outcomes:
            if isinstance(outcome, StrideResult):
                judge.on_stride(outcome)
            else:
                permitted = judge.on_phase(outcome)
                # stimulation keeps to the host's clock, whatever the sensor's does
                self._plan.on_phase(replace(outcome, t_ns=sample.t_ns), permitted=permitted)
        return outcomes

    def _on_act(self, act: OperatorAct) -> None:
        if act.action is OperatorAction.SET_INTENSITY:
            self.intensity = min(max(act.value, 0.0), 1.0)
        else:  # armed or stopped in mid-burst: whatever comes next is a new burst
            self._plan.cancel()

    def _due(self, t_ns: int, *, at_once: bool) -> tuple[StimRequest, ...]:
        """One request per channel each command period, and at once when a channel goes on or off."""
        if self._next_command_ns is None:
            self._next_command_ns = t_ns
        if t_ns < self._next_command_ns and not at_once and not self._plan.due(t_ns, self.intensity):
            return ()
        if t_ns >= self._next_command_ns:
            self._next_command_ns += self._period_ns * ((t_ns - self._next_command_ns) // self._period_ns + 1)
        requests = self._plan.requests(t_ns, self.intensity)
        self._on = any(request.on for request in requests)
        return requests


def stride_settings(session: Session, calibration: FootCalibration) -> StrideSettings:
    """How this session's strides are integrated, with the foot's geometry where the session gives it."""
    geometry = {str(foot): value for foot, value in session.geometry.items()}.get(calibration.sensor)
    height_m = SENSOR_HEIGHT_M
    if geometry is not None:
        height_m = max(-0.5 * (geometry.toe_up_m + geometry.heel_up_m), 0.0)
    return StrideSettings(
        forward=calibration.forward(),
        up=np.array(calibration.up),
        sensor_height_m=height_m,
        geometry=geometry,
    )
