"""A walk out of a recording in the place of the simulated patient's: the bundled one, whose true phases are known."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from drivers.simulated.imu.device import recorded_signal
from fes.calibration.recording import SensorCalibrations, load
from fes.cli import main
from fes.cli.replay.command import prepared
from fes.config import StimulatorDevice, load_session
from fes.hil.devices import WALKS_S, recorded_walker
from fes.hil.settings import STANDS_S, session_text
from fes.recording import Recording, RecordingError, read_recording
from fes.signals import NS_PER_S
from statemachine.phases import Phase

PROJECT = Path(__file__).resolve().parents[2]
RECORDING = PROJECT / "sim_inputs" / "negard_patient2.parquet"
FOOT = "right_foot"
EVENTS_S = 0.1  # of foot flat and heel rise; the most at the end of the stand, of which no heel rise is looked for


@pytest.fixture(scope="module")
def read() -> tuple[Recording, SensorCalibrations]:
    found = prepared(RECORDING, None, None)
    return found.recording, found.found


def test_a_recordings_walk_stands_walks_and_knows_its_stance(
    read: tuple[Recording, SensorCalibrations], tmp_path: Path
) -> None:
    walked = recorded_walker(*read, tmp_path)
    assert (walked.foot, walked.rate_hz) == (FOOT, 500.0)
    signal = recorded_signal(walked.recording, walked.foot, walked.rate_hz)
    assert abs(signal.size - len(walked.in_stance)) <= 1
    assert STANDS_S + 3.0 < signal.size / walked.rate_hz < STANDS_S + WALKS_S + 1.0
    stands = slice(0, round(STANDS_S * walked.rate_hz))
    assert np.linalg.norm(signal.gyr_radps[stands], axis=1).max() < 0.2
    truth = pq.read_table(RECORDING.with_suffix(".truth.parquet"))
    begin_ns = int(read_recording(walked.recording).tracks[FOOT].t_sensor_ns[0])
    t_ns = begin_ns + np.arange(len(walked.in_stance)) * NS_PER_S / walked.rate_hz
    at = np.searchsorted(truth["t_ns"].to_numpy(), t_ns)
    true_stance = truth[f"{FOOT}_phase"].to_numpy()[at] == Phase.STANCE
    assert walked.in_stance[stands].all()
    wrong = walked.in_stance != true_stance
    borders = np.flatnonzero(np.diff(true_stance.astype(int)))
    nearest_s = np.abs(np.flatnonzero(wrong)[:, None] - borders).min(axis=1) / walked.rate_hz
    assert nearest_s.max() < EVENTS_S, f"stance is off by {nearest_s.max():.3f} s"


def test_its_session_has_the_recordings_sensor(read: tuple[Recording, SensorCalibrations], tmp_path: Path) -> None:
    walked = recorded_walker(*read, tmp_path)
    path = tmp_path / "session.toml"
    stimulator = StimulatorDevice.model_validate({"device": "rehastim2", "port": "/dev/y"})
    path.write_text(session_text("", "/dev/x", None, stimulator, walked))
    session = load_session(path)
    (sensor,) = session.sensors
    assert (sensor.sensor, sensor.rate_hz, sensor.gyr_range_dps) == (FOOT, 500.0, 500.0)
    assert session.channels[0].foot == FOOT
    assert load(walked.calibration).calibrations.keys() == {FOOT}


def test_without_a_stand_before_a_walk_it_is_refused(
    read: tuple[Recording, SensorCalibrations], tmp_path: Path
) -> None:
    recording, found = read
    track = recording.tracks[FOOT]
    walks = Recording("walks", None, {FOOT: track.part(slice(5000, 12000))})
    with pytest.raises(RecordingError, match=r"stands for 2\.5 s"):
        recorded_walker(walks, found, tmp_path)


@pytest.mark.parametrize(
    ("others", "says"),
    [
        (["--closed-loop"], "--recording and --closed-loop"),
        (["--hardware", "real.toml"], "--recording and --hardware"),
        (["--calibration", "none.json"], "none.json: cannot be read"),
    ],
)
def test_what_does_not_go_with_it_is_refused(
    others: list[str], says: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["hil", "--recording", str(RECORDING), "--out", str(tmp_path), *others], prog_name="fes")
    assert ended.value.code == 2
    assert says in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
