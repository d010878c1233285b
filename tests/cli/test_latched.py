"""A replay whose gate latched says so at its end; its exit code says whether it went through."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from replays import SETTINGS, cut, edit, trial

from fes.cli.common import OK
from fes.cli.main import main
from fes.cli.show import latched
from fes.recording import Track, write_recording
from fes.report.quality import Notice


def gate(t_s: float, text: str) -> Notice:
    return Notice(t_s, "info" if text == "armed again" else "fault", "gate", text)


def test_what_is_said_of_latches() -> None:
    assert latched([]) == ""
    assert latched([Notice(1.0, "warning", "gate", "channel 0 refused: not armed"), gate(0.5, "armed again")]) == ""
    first = gate(1.25, "off until armed again: emergency stop")
    assert latched([first]) == (
        "The gate latched once at 1.250 s: emergency stop. Nothing was stimulated from 1.250 s to the end."
    )
    assert latched([first, gate(2.0, "armed again")]) == (
        "The gate latched once at 1.250 s: emergency stop. It was last armed again at 2.000 s."
    )
    again = [first, gate(2.0, "armed again"), gate(3.0, "off until armed again: x")]
    assert latched(again) == (
        "The gate latched 2 times, first at 1.250 s: emergency stop. Nothing was stimulated from 3.000 s to the end."
    )


def test_a_replay_and_its_logs_replay_say_it_last(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def spoilt(track: Track) -> Track:
        acc_mps2, gyr_radps = track.acc_mps2.copy(), track.gyr_radps.copy()
        acc_mps2[3000:3060], gyr_radps[3000:3060] = acc_mps2[3000], gyr_radps[3000]
        return replace(track, acc_mps2=acc_mps2, gyr_radps=gyr_radps)

    recording = tmp_path / "spoilt.parquet"
    write_recording(edit(cut(trial("negard_patient2"), 0.0, 12.0), spoilt), recording)
    common = ["--json"]
    for target in (recording, None):
        path = target or next(tmp_path.glob("out/*/session.feslog"))
        more = ["--out", str(tmp_path / "out"), "--session", str(SETTINGS), "--stimulator", "none", "--no-report"]
        with pytest.raises(SystemExit) as ended:
            main(["replay", str(path), *common, *(more if target else [])], prog_name="fes")
        assert ended.value.code == OK
        said = capsys.readouterr().err
        assert "The gate latched once at 6.0" in said
        assert "right_foot is frozen: the same values for 60 ms, limit 60 ms. Nothing was stimulated from 6.0" in said
