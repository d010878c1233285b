"""A report of every kind of session: by which sensors it was driven, how many channels, tuned, torn, cut in a burst."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import report_records as make
from replays import SETTINGS, TRIALS, Replays, both_feet, bursts, cut, replay, trial
from rich.console import Console
from shank_walks import shank_walk
from test_one_process import run

from fes.analysis.pipeline import analyse, analyse_chunks, calibrations_of
from fes.cli.common import latched
from fes.recording import Recording, write_recording
from fes.recording.arrays import recording_from_arrays
from fes.recording.chunks import Chunk, cut_into_chunks
from fes.report.findings import findings, front_page
from fes.report.page import render_report
from fes.report.summary import SessionSummary, summarise
from fes.report.tables import stride_table, summary_block
from fes.session_log import Note, SessionRecord, read_session
from fes.signals import NS_PER_S, StimCommand


def texts(summary: SessionSummary, *levels: str) -> list[str]:
    return [finding.text for finding in findings(summary) if not levels or finding.level in levels]


def two_channels(text: str, foot: str) -> str:
    """The bundled settings with a second channel on the same foot, which it is never on with."""
    second = both_feet(text).split("[[channels]]")[2].replace("left_foot", foot).replace('"pre_swing"', '"swing"')
    return f"{text}\n[[channels]]{second}"


def shanks(*sides: str, strides: int = 30) -> Recording:
    walks = {
        f"{side}_shank": shank_walk(strides=strides, standing_s=3.0, noise=0.02, seed=k) for k, side in enumerate(sides)
    }
    length = min(len(walk.acc) for walk in walks.values())
    forces, rates = ({name: getattr(walk, of)[:length] for name, walk in walks.items()} for of in ("acc", "gyr"))
    return recording_from_arrays(forces, rates, 100.0, name="shanks")


def mixed() -> Recording:
    """The left foot by its own sensor, the right one by its shank's."""
    shank, foot = shanks("right"), trial("both_feet_100hz")
    track = foot.tracks["left_foot"]
    begin_ns = int(track.t_ns[0])
    own = shank.tracks["right_shank"]
    own = replace(own, t_ns=own.t_ns + begin_ns, t_sensor_ns=own.t_sensor_ns + int(track.t_sensor_ns[0]))
    return cut(replace(foot, tracks={"left_foot": track, "right_shank": own}), 0.0, 36.0)


def replayed(folder: Path, recording: Recording, settings: str) -> SessionRecord:
    path, session = folder / "walk.parquet", folder / "session.toml"
    write_recording(recording, path)
    session.write_text(settings)
    return replay(path, folder / "out", session)


@pytest.mark.parametrize("kind", ["shank", "mixed", "one foot", "two channels on one foot"])
def test_every_channel_is_judged_by_the_phases_that_drove_it(kind: str, tmp_path: Path) -> None:
    text = SETTINGS.read_text()
    recording, settings, sensors = {
        "shank": lambda: (shanks("left", "right"), both_feet(text), {0: "right_shank", 1: "left_shank"}),
        "mixed": lambda: (mixed(), both_feet(text), {0: "right_shank", 1: "left_foot"}),
        "one foot": lambda: (cut(trial("negard_patient2"), 0.0, 40.0), text, {0: "right_foot"}),
        "two channels on one foot": lambda: (
            *(cut(trial("negard_patient2"), 0.0, 40.0), two_channels(text, "right_foot")),
            {0: "right_foot", 1: "right_foot"},
        ),
    }[kind]()
    record = replayed(tmp_path, recording, settings)
    summary = summarise(record)
    assert list(summary.feet) == [name for name in make_order(sensors.values()) if name in summary.feet]
    assert set(summary.feet) == set(sensors.values())
    for channel in summary.channels:
        driven = {row.number: row for row in summary.strides if row.foot == sensors[channel.channel]}
        stimulated = [row for row in driven.values() if any(i.channel == channel.channel for i in row.stimulation)]
        commanded = bursts(record.commands, channel.channel)
        assert channel.bursts == len(commanded) > 5, "the log's commands, counted by themselves"
        assert channel.outside_s == 0.0
        assert channel.longest_outside_s <= summary.command_period_s
        assert len(stimulated) >= len(commanded) - 1, "each burst stands with its stride"
        assert channel.onset_after_pre_swing_ms.n == len(stimulated)
        assert 0.0 <= channel.onset_after_pre_swing_ms.mean < 500.0
        assert all(item.charge_uc > 0.0 for row in stimulated for item in row.stimulation)
        assert f"{channel.name}: stimulated {len(commanded)} times, never outside" in " ".join(texts(summary, "good"))
    assert not texts(summary, "alert")
    page = render_report(record)
    assert "Onset" in page
    assert not re.search(r"\bnan\b|\bNone\b", page.split('<script type="application/json"')[0].split("</style>")[1])


def make_order(names: Iterable[str]) -> list[str]:
    return sorted(set(names), key=("left_foot", "right_foot", "left_shank", "right_shank").index)


def test_a_shanks_strides_are_held_against_its_swings() -> None:
    record = analyse(shanks("left")).walk_record()
    whole = summarise(record).feet["left_shank"]
    assert whole.swings >= 25
    cut_short = replace(record, strides=[stride for stride in record.strides if stride.number not in (9, 10)])
    assert summarise(cut_short).feet["left_shank"].unexplained == whole.unexplained + 2


def test_the_dose_of_a_shanks_channel_is_by_step(tmp_path: Path) -> None:
    record = replayed(tmp_path, shanks("right"), SETTINGS.read_text())
    record.statuses = make.answers(record.commands)
    (dose,) = summarise(record).dose
    assert dose.steps > 5
    assert dose.median_step_uc > 10.0


@pytest.fixture(scope="module")
def ended_in_a_burst(tmp_path_factory: pytest.TempPathFactory, replays: Replays) -> SessionRecord:
    folder = tmp_path_factory.mktemp("ended")
    whole = replays.of("negard_patient2")
    burst = bursts(whole.commands)[4]
    return replayed(
        folder,
        cut(trial("negard_patient2"), 0.0, (burst.t_on_ns + burst.t_off_ns) / 2 / NS_PER_S),
        SETTINGS.read_text(),
    )


def test_a_recording_that_ends_in_a_burst_is_no_fault(ended_in_a_burst: SessionRecord) -> None:
    assert any(note.severity == "fault" for note in ended_in_a_burst.notes), "the gate did switch off"
    summary = summarise(ended_in_a_burst)
    assert not summary.faults
    assert not summary.refusals
    assert latched(summary.notices) == ""
    assert not texts(summary, "alert")
    assert any("the recording ends in a burst" in notice.text for notice in summary.notices)


def test_a_silence_before_the_end_and_a_live_session_stay_faults(ended_in_a_burst: SessionRecord) -> None:
    live = replace(ended_in_a_burst, header={**ended_in_a_burst.header, "kind": "run"})
    assert summarise(live).faults
    (foot,) = ended_in_a_burst.samples
    samples = ended_in_a_burst.samples[foot]
    later = samples.t_ns.copy()
    later[-1] += NS_PER_S  # one more sample, a second after the gate had switched off
    silence = replace(ended_in_a_burst, samples={foot: replace(samples, t_ns=later)})
    assert summarise(silence).faults


def test_tuning_has_its_place_and_a_stumble_is_not_nothing(tmp_path: Path) -> None:
    walker, log = run(tmp_path, "tuned.feslog", 40.0)
    record = read_session(log)
    summary = summarise(record)
    (channel,) = summary.channels
    peaks = [item.peak_current_ma for row in summary.strides for item in row.stimulation]
    changes = sum(row.changes for row in summary.tuning)
    (told,) = [text for text in texts(summary, "info") if text.startswith(f"{channel.name}: ")]
    assert told.startswith(f"{channel.name}: {peaks[0]:.1f} → {peaks[-1]:.1f} mA between strides ")
    assert "toe clearance" in told.split(": ", 2)[2]
    assert f"({changes} changes, " in told
    first = [finding.text for finding in front_page(summary)["first"]]
    warnings = texts(summary, "alert", "warning")
    assert first.index(told) == len(warnings) < len(first), "on the first page, after what must be looked at"
    stumbled = [stride.number for stride in walker.strides if stride.stumbled and stride.foot == channel.foot]
    assert stumbled, "this patient stumbles before it is tuned"
    toe = [text for text in texts(summary) if "toe came to the ground" in text or "whether it touched" in text]
    named = {
        int(number) for text in toe for listed in re.findall(r"\(([\d, ]+)\)", text) for number in listed.split(",")
    }
    assert set(stumbled) <= named, "the very strides of the patient's own account"


def test_a_toe_that_only_seems_to_touch_is_no_warning(replays: Replays) -> None:
    summary = summarise(replays.of("negard_patient2"))
    with (TRIALS / "negard_patient2.strides.csv").open() as file:
        truth_cm = [100.0 * float(row["toe_clearance_m"]) for row in csv.DictReader(file) if row["steady"] == "yes"]
    assert 0.0 < min(truth_cm) < 0.1, "its toe never touches"
    measured = [row for row in summary.strides if row.toe_clearance_cm <= 0.0]
    assert measured, "but for some strides that is what is measured"
    assert not any("toe" in text for text in texts(summary, "alert", "warning"))
    (told,) = [text for text in texts(summary, "info") if "the toe passed within 0.6 cm" in text]
    assert f"({', '.join(str(row.number) for row in measured)})" in told


def test_a_foot_that_stopped_answering_is_a_warning() -> None:
    for more in (" and goes back: current 30.0 → 28.0 mA", ""):  # the tuning acts, or only suggests
        why = f"toe clearance 1 mm: the foot does not answer, look at the electrodes; tuning has stopped{more}"
        still = Note(make.at(9.0), "warning", "tuning", "channel 0: still going back: current 28.0 → 26.0 mA")
        record = replace(make.walk(4), notes=[Note(make.at(8.0), "warning", "tuning", f"channel 0: {why}"), still])
        assert f"TA left: tuning stopped at 8.0 s: {why}." in texts(summarise(record), "warning")
        assert "No fault found" not in render_report(record)


@pytest.mark.parametrize("more", ["", ". identified: threshold 14 ± 3 mA"])
def test_an_electrode_that_slipped_is_a_warning_that_says_when(more: str) -> None:
    why = f"stride 5: something has changed that stimulation did not: most likely the electrodes; look at it{more}"
    record = replace(make.walk(6), notes=[Note(make.at(8.0), "warning", "tuning", f"channel 0: {why}")])
    said = f"TA left: tuning noticed a change at 8.0 s: {why.removesuffix(more)}."
    assert said in texts(summarise(record), "warning"), "what was done about it stands elsewhere"
    raised = "toe clearance 9 mm (target 20–50) in this stride, more is needed: current 28.0 → 30.0 mA"
    change = Note(make.at(6.0), "info", "tuning", f"channel 0: {raised}")
    record = replace(record, notes=[change, *record.notes])
    (told,) = [text for text in texts(summarise(record), "info") if text.startswith("TA left: ") and "change" in text]
    assert "at first toe clearance 9 mm (target 20–50); noticed at 8.0 s: the electrodes had changed" in told


def test_a_torn_log_is_judged_as_far_as_it_goes(tmp_path: Path, replays: Replays) -> None:
    replays.of("negard_patient2")
    (whole,) = sorted(replays.folder.glob("negard_patient2*/session.feslog"))[:1]
    torn = tmp_path / "torn.feslog"
    torn.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    summary = summarise(read_session(torn))
    (alert,) = texts(summary, "alert")
    assert "no proper end" in alert
    (channel,) = summary.channels
    assert channel.bursts > 3
    assert channel.outside_s == 0.0
    assert "never outside" in " ".join(texts(summary, "good"))


def test_seconds_of_walking_that_no_stride_explains() -> None:
    recording = Recording("walk", None, {"right_foot": trial("negard_patient2").tracks["right_foot"]})
    record = analyse(recording).walk_record()
    whole = summarise(record)
    foot = whole.feet["right_foot"]
    usual_s = np.median([row.duration_s for row in whole.strides])
    assert foot.walking_s == pytest.approx(foot.swings * usual_s, rel=0.05)
    assert foot.unexplained_s == 0.0
    assert any("s of walking explained" in text for text in texts(whole))
    gone = [stride for stride in record.strides if stride.number not in (10, 11, 20)]
    less = summarise(replace(record, strides=gone))
    lost_s = sum(row.duration_s for row in whole.strides if row.number in (10, 11, 20))
    assert less.feet["right_foot"].unexplained_s == pytest.approx(lost_s, rel=0.1)
    said = f"no stride explains {less.feet['right_foot'].unexplained_s:.1f} s of {foot.walking_s:.1f} s of walking"
    assert any(said in text for text in texts(less))


def test_two_swings_in_one_stride_are_one_too_many() -> None:
    record = analyse(trial("negard_patient2")).walk_record()
    joined = list(record.strides)
    k = next(k for k, stride in enumerate(joined) if stride.number == 15)
    joined[k : k + 2] = [replace(joined[k], t_end_ns=joined[k + 1].t_end_ns)]
    assert summarise(replace(record, strides=joined)).feet["right_foot"].unexplained == 1


def test_what_a_part_of_a_long_recording_has_around_it_is_not_unexplained() -> None:
    recording = Recording("walk", None, {"right_foot": trial("negard_patient2").tracks["right_foot"]})
    track = recording.tracks["right_foot"]
    half = len(track.t_ns) // 2
    halves = [replace(recording, tracks={"right_foot": track.part(rows)}) for rows in (slice(half), slice(half, None))]
    chunks = list(cut_into_chunks(halves, around_s=12.0))
    assert [chunk.whole for chunk in chunks] == [False, False]
    _, found = calibrations_of(recording)
    parts = [summarise(each.walk_record()).feet["right_foot"] for each in analyse_chunks(chunks, found.calibrations)]
    whole = summarise(analyse(recording, found.calibrations).walk_record()).feet["right_foot"]
    assert [part.unexplained for part in parts] == [0, 0]
    assert sum(part.strides for part in parts) == whole.strides
    assert whole.swings - 3 <= sum(part.swings for part in parts) <= whole.swings


@pytest.mark.parametrize("name", ["both_feet_200hz", "negard_patient2"])
def test_off_line_phases_are_the_off_line_instants(name: str) -> None:
    result = analyse(trial(name))
    live = summarise(replace(result.walk_record(), phases=result.phases, strides=result.strides, live=None))
    off_line = summarise(result.walk_record())
    with (TRIALS / f"{name}.strides.csv").open() as file:
        truth = [row for row in csv.DictReader(file) if row["steady"] == "yes"]
    for foot, own in off_line.feet.items():
        for key, begin, end in (
            ("loading_response_s", "t_loading_response_s", "t_stance_s"),
            ("pre_swing_s", "t_pre_swing_s", "t_swing_s"),
        ):
            true_s = np.mean([float(row[end]) - float(row[begin]) for row in truth if row["foot"] == foot])
            off_s, live_s = (getattr(each.feet[foot], key).mean for each in (off_line, live))
            assert off_s != live_s
            assert abs(off_s - true_s) < 0.02
        assert own.four_phases == live.feet[foot].four_phases
        beside = {name: getattr(live.feet[foot], name.replace("_live_s", "_s")) for name in own.live}
        assert own.live == beside
        assert set(own.live) == {f"{phase}_live_s" for phase in ("pre_swing", "swing", "loading_response", "stance")}
    assert [row.path for row in off_line.strides] == [row.path for row in live.strides]
    assert not live.strides[0].live
    page, first = render_report(result.walk_record()), next(iter(off_line.feet.values()))
    assert f'<span class="live">{first.live["loading_response_live_s"].mean:.2f} s' in page
    console = Console(width=110, file=StringIO(), record=True)
    console.print(summary_block(off_line))
    printed = console.export_text()
    assert f"loading {first.loading_response_s.mean:.2f} s" in printed.split("off-line: ")[1].split("\n")[0]
    assert f"loading {first.live['loading_response_live_s'].mean:.2f} s" in printed.split(" live: ")[1].split("\n")[0]
    assert isinstance(result.chunk, Chunk)


def test_an_analysis_has_no_empty_sections_of_stimulation() -> None:
    record = analyse(cut(trial("negard_patient2"), 0.0, 40.0)).walk_record()
    page = re.sub(r"<(script|style).*?</\1>", "", render_report(record), flags=re.DOTALL)
    shown = page.split("<main>")[1].split('id="words"')[0]
    assert "timulat" not in shown
    assert "refused" not in shown
    assert "µC" not in shown
    assert "No fault found in the data" in shown or summarise(record).faults
    assert not [text for text in texts(summarise(record)) if "timulat" in text]


# --- The terminal's tables: every number is there, the width is kept ---


def shown(renderable, width: int = 100) -> list[str]:
    console = Console(width=width, file=io.StringIO(), color_system=None)
    console.print(renderable)
    return console.file.getvalue().splitlines()


def test_a_row_per_stride_with_its_numbers():
    lines = shown(stride_table(summarise(make.walk(5))))
    rows = [line.split() for line in lines if line.startswith(("L ", "R "))]
    assert len(rows) == 10
    assert rows[-1][:2] == ["R", "4"]
    by_name = dict(zip(("foot", "no", "start", "length", "clear"), rows[0], strict=False))
    stride = make.walk(5).strides[0]
    assert by_name["length"] == f"{stride.stride_length_m:.2f}"
    assert by_name["clear"] == f"{stride.clearance_m * 100:.1f}"
    assert rows[-1][-4] == "4"  # onset, ms
    assert rows[-1][-2] == "20.0"  # peak, mA


@pytest.mark.parametrize(("count", "number", "width"), [(0, 0, 80), (3, 0, 80), (120, 0, 80), (3, 20_000, 100)])
def test_no_number_is_cut_in_80_columns_nor_a_long_session_in_100(count, number, width):
    record = make.walk(count)
    record.strides = [replace(stride, number=stride.number + number, reason="slow") for stride in record.strides]
    record.strides[:1] = [replace(stride, valid=False) for stride in record.strides[:1]]
    lines = shown(stride_table(summarise(record)), width)
    assert all(len(line) <= width for line in lines)
    assert not any("…" in line for line in lines)


def test_reasons_are_told_below_the_table_and_are_not_markup():
    record = make.walk(4)
    record.strides[2] = replace(record.strides[2], valid=False, reason="[red]turned[/red] by 50°")
    record.commands.append(StimCommand(record.strides[-1].t_start_ns + 5, 1, False, 0, 0, 0, 60, "not armed [/]"))
    record.notes.append(Note(make.at(1), "fault", "gate", "[bold]latched"))
    record.header["session"]["name"] = "[link=x]trial"
    summary = summarise(record)
    text = "\n".join(shown(stride_table(summary)))
    assert "note 1: left out: [red]turned[/red] by 50°" in text
    assert "note 2: gate: not armed [/]" in text
    block = "\n".join(shown(summary_block(summary)))
    assert "[bold]latched" in block
    assert "[link=x]trial" in block


def test_summary_is_about_a_dozen_lines_and_says_what_matters():
    lines = shown(summary_block(summarise(make.walk(20))))
    text = "\n".join(lines)
    assert len(lines) <= 14
    assert "40 of 40 swings passed all four phases" in text
    assert "never outside pre-swing … loading response" in text
    assert "belt 0.45 m/s" in text
    assert "99 % within" in text


def test_an_empty_session_still_has_a_summary():
    text = "\n".join(shown(summary_block(summarise(SessionRecord({})))))
    assert "no proper end" in text
    assert "No stride was found" in text
