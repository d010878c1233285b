"""IC and FO of feet that strong stimulation lifts: off-line and by the path, against the virtual patient's truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from fes.analysis.parameters.gait import gait_parameters
from fes.analysis.pipeline import analyse, calibrations_of
from fes.cli.simulate import command
from fes.recording import read_recording
from fes.signals import FOOT_SENSORS
from fes.simulation.truth import load_truth

NEAR_S = 0.07  # the off-line IC of a slow foot is up to 65 ms early; the path sets it right
PATH_S = 0.03
LIFTED_S = 0.05  # foot off by the path where a burst lifts the ball before the toe: at 0.6 m/s half of them 46 ms early


@pytest.mark.parametrize("speed", ["0.4", "0.6", "0.8"])
def test_every_stimulated_stride_has_one_foot_off_and_one_contact(speed: str, tmp_path: Path) -> None:
    asked = ("--speed", speed, "--seconds", "24", "--stimulate", "phase", "--name", "walk", "--json")
    result = CliRunner().invoke(command, [*asked, "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    recording, found = calibrations_of(read_recording(tmp_path / "walk.parquet"))
    analysis = analyse(recording, found.calibrations)
    parameters, truth = gait_parameters(analysis), load_truth(tmp_path / "walk.parquet")
    for foot in FOOT_SENSORS:
        events, strides = analysis.events[foot], truth.strides_of(foot)
        off = np.array([stride.t_swing_s for stride in strides])
        contact = np.array([stride.t_loading_response_s for stride in strides])
        found_off, found_contact = 1e-9 * events.fo_ns, 1e-9 * events.ic_ns
        # a swing that the recording cuts off may be in either
        inside = (off < recording.tracks[foot].duration_s - 2.0) & (contact < recording.tracks[foot].duration_s - 2.0)
        assert inside.sum() >= 7
        for found_s, true_s, near_s in ((found_off, off, PATH_S), (found_contact, contact, NEAR_S)):
            apart = np.abs(found_s[:, None] - true_s[inside][None, :])
            assert (apart.min(axis=0) < near_s).all()
            assert (np.count_nonzero(apart < 0.4, axis=0) == 1).all(), "one for every stride"
        mine = parameters.strides[foot]
        assert len(mine) >= inside.sum() - 1
        for stride in mine:  # NaN, no times, is not below
            assert np.abs(off - stride["t_foot_off_s"]).min() < LIFTED_S
            assert np.abs(contact - stride["t_contact_s"]).min() < PATH_S
