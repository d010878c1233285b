"""After ``warm_up`` nothing is left to compile in the loop, whatever the session and the gait."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from fes.estimation import warm_up

FOLDER = Path(__file__).resolve().parents[2] / "sim_inputs"
SCRIPT = """
import sys
from pathlib import Path
from fes.calibration.recording import calibrate_phase_sensors
from fes.config import load_session
from fes.control.controller import Controller
from fes.estimation.warm_up import GEOMETRY, warm_up
from fes.recording import read_recording
from fes.signals import StrideResult

def compiled():
    found = {}
    for name, module in list(sys.modules.items()):
        for part, value in list(vars(module).items()) if name.startswith("fes.") else ():
            if hasattr(value, "py_func") and hasattr(value, "signatures"):
                found[name, part] = len(value.signatures)
    return found

folder = Path(sys.argv[1])
plain = load_session(folder / "session.toml")
known = plain.model_copy(update={"geometry": {"left_foot": GEOMETRY, "right_foot": GEOMETRY}})
for trial in sys.argv[2:]:
    recording = read_recording(folder / trial)
    found = calibrate_phase_sensors(recording)
    warm_up()
    before = compiled()
    for session in (plain, known):
        controller = Controller(session, found.calibrations)
        outcomes = [outcome for sample in recording.samples() for outcome in controller.step(sample).outcomes]
        assert sum(isinstance(outcome, StrideResult) for outcome in outcomes) > 20, trial
    more = {key for key, count in compiled().items() if count > before.get(key, 0)}
    assert not more, (trial, more)
"""


def test_no_session_begins_where_code_does_not_stay_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = iter((200, 201))
    monkeypatch.setattr(warm_up, "signatures", lambda: next(counts))
    with pytest.raises(RuntimeError, match="no session may begin"):
        warm_up.warm_up()


def test_nothing_is_compiled_in_the_loop() -> None:
    trials = ("both_feet_200hz.parquet", "negard_patient2.parquet")
    done = subprocess.run([sys.executable, "-c", SCRIPT, str(FOLDER), *trials], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-1500:]
