"""``fes replay --dashboard``: a recording, or a session log, played to a browser."""

import time
from collections import deque
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from fes.cli.common.exits import fail, interrupted
from fes.cli.common.progress import Interrupt
from fes.cli.replay.log import controller_and_gate
from fes.cli.replay.stimulators import LoggedSink
from fes.cli.run.devices import open_dashboard
from fes.config import ConfigError, Session
from fes.control.controller import CURRENT_STEP_MA, Controller
from fes.control.replay import settings_of
from fes.control.runner import Log, Runner, paced
from fes.estimation.sensor_choice import Calibration, phase_sensors
from fes.estimation.warm_up import warm_up
from fes.evaluation.log_replay import ReplayOutput
from fes.gate import SafetyGate
from fes.live.dashboard.replay import ReplayLog, StoppableClock
from fes.session_log import Note, SessionLogError, iter_events, read_session
from fes.signals import Event
from fes.walk_record import MARK


class ReplayDashboard:
    """The dashboard of a replay: ``log`` for its loop, ``clock`` to pace it by; :meth:`publish` after every event.

    Raises:
        Problem: it cannot be served.
    """

    def __init__(
        self,
        folder: Path,
        session: Session,
        calibrations: Mapping[str, Calibration],
        header: Mapping[str, Any],
        log: Log,
        controller: Controller,
        gate: SafetyGate,
        port: int,
    ) -> None:
        self._stack = ExitStack()
        self._process = open_dashboard(folder, session, "replay", port, self._stack)
        recording = header.get("recording", {})
        rates_hz = {name: rate for name, rate in recording.get("rates_hz", {}).items() if name in calibrations}
        belt_mps = session.treadmill.belt_speed_mps if session.treadmill else recording.get("belt_speed_mps")
        stream = self._process.stream
        self.log = ReplayLog(log, stream, controller, gate, rates_hz, phase_sensors(calibrations), belt_mps)
        self._t_ns = 0
        said = "warning", "dashboard", "stopped on the dashboard"
        self.clock = StoppableClock(stream, lambda: self.log.note(Note(self._t_ns, *said)))

    def publish(self, t_ns: int) -> None:
        """Show what there is to show at the recording's time ``t_ns``."""
        self._t_ns = t_ns
        self.log.publish(t_ns, time.monotonic_ns())

    def close(self, ended: str) -> None:
        """End the dashboard; ``ended`` says how the replay did."""
        self.log.publish(self._t_ns, time.monotonic_ns(), last=True)
        self._process.farewell = f"The replay has ended: {ended}."
        self._stack.close()


def play_log(path: Path, folder: Path, speed: float, port: int) -> None:
    """Play a session log's events to a dashboard, ``speed`` times as fast as they came; nothing is stimulated.

    Raises:
        Problem: the log cannot be read, or no dashboard can be served.
        SystemExit: stopped on the dashboard, or interrupted.
    """
    try:
        record = read_session(path)
        session, calibrations, session_id = settings_of(record.header, path)
    except (SessionLogError, ConfigError) as error:
        fail(error)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        fail(SessionLogError(f"{path}: its header is not one of this version: {error}"))
    step_ma = float(record.header.get("current_step_ma", CURRENT_STEP_MA))
    controller, gate = controller_and_gate(session, calibrations, step_ma)
    warm_up()
    shown = ReplayDashboard(folder, session, calibrations, record.header, ReplayOutput(), controller, gate, port)
    sink = LoggedSink(session_id, [])
    runner = Runner(controller, gate, sink, shown.log, time.perf_counter_ns)
    marks = deque(note for note in record.notes if note.source == MARK)
    ended = "interrupted"
    try:
        with Interrupt() as interrupt:

            def after(event: Event) -> None:
                while marks and marks[0].t_ns <= event.t_ns:
                    shown.log.note(marks.popleft())
                shown.publish(event.t_ns)
                interrupt.check()

            runner.run(sink.replay_events(paced(iter_events(path), shown.clock, speed)), after)
        ended = "complete"
    except KeyboardInterrupt:
        interrupted(": the log was not played to its end, and not checked.")
    finally:
        shown.close(ended)
