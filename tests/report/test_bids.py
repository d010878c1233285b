"""A session as a BIDS data set: its files keep the specification's rules, and what they say is what was logged."""

from __future__ import annotations

import csv
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import report_records as make
from click.testing import CliRunner, Result

from fes.cli.main import main
from fes.session_log import Note, SessionWriter, read_session
from fes.session_log.anonymise import anonymise
from fes.signals import (
    FootSwitchEvent,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimCommand,
    SystemFault,
    WireFrame,
)
from fes.walk_record import MARK

NAMES = ("Zoltan", "Quixley", "Wilhelmsbad", "Vollum", "ttyUSB7")
CREATED = "2026-03-01T10:00:00+00:00"
GAP_S = (4.0, 4.5)  # the left foot's last sample before it and the first one behind it
LATE_NS = 2 * make.MS
RIGHT_BEGINS_S, RIGHT_HZ = 0.005, 62.5
# channel, from, for (s), mA, trigger, phase
BURSTS = (
    (0, 0.79, 0.60, 18.0, "predicted onset", "stance"),
    (0, 2.25, 0.70, 20.0, "T1", "pre_swing"),
    (1, 7.00, 0.50, 12.0, "test_burst", "n/a"),
    (1, 9.00, 0.20, 15.0, "n/a", "n/a"),
)
REFUSED_S, REFUSALS = (5.0, 5.02, 5.04), "current would rise by {} mA, more than its limit"
ACTS = (
    (0.10, OperatorAction.ARM, 0.0),
    (0.20, OperatorAction.SET_INTENSITY, 0.8),
    (6.95, OperatorAction.TEST_BURST, 1.0),
    (9.50, OperatorAction.EMERGENCY_STOP, 0.0),
)
STRIDES = (make.stride(1, 0.5), make.stride(2, 1.9), make.stride(3, 4.0, valid=False, reason="samples were lost"))
PHASES = [change for stride in STRIDES[:2] for change in make.phases_of(stride)]


def left_samples() -> Iterator[tuple[float, tuple[float, ...]]]:
    """When (s) and what: 100 Hz, 10 s, none within GAP_S, one value not known; numbers that need all their digits."""
    for k in range(1000):
        if not GAP_S[0] < k / 100 < GAP_S[1]:
            yield k / 100, (0.1 * k, -2.0, 9.81, 0.25, math.nan if k == 50 else -0.5, math.sin(0.01 * k))


def right_samples() -> Iterator[tuple[float, tuple[float, ...]]]:
    """The same of the other foot, at another rate, in single precision."""
    for k in range(600):
        yield RIGHT_BEGINS_S + k / RIGHT_HZ, (0.25 * k, 1.0, 9.5, 0.5, -0.125, 2.0)


SAMPLES = {"left_foot": left_samples, "right_foot": right_samples}


def written(path: Path, **changes: Any) -> Path:
    """The log of all that."""
    channels = [
        make.channel(0, "left_foot", "TA left", onset="predicted", extension_s=0.3),
        make.channel(1, "right_foot", "TA right"),
    ]
    devices = [
        {"sensor": sensor, "device": "xbus", "port": f"/dev/{NAMES[4]}{sensor}", "rate_hz": rate_hz,
         "acc_range_g": 16.0, "gyr_range_dps": 2000.0}
        for sensor, rate_hz in (("left_foot", 100.0), ("right_foot", RIGHT_HZ))
    ]  # fmt: skip
    header = make.header(channels, name=f"{NAMES[2]} clinic", subject="P-07", sensors=devices)
    header["recording"]["name"] = f"/home/{NAMES[1].lower()}/walk"
    header |= {"kind": "live", "created": CREATED, "created_t_ns": make.at(-1.0), "operator": f"{NAMES[0]} {NAMES[3]}"}
    writer = SessionWriter(path, header | changes)
    events: list[tuple[int, Callable[[Any], None], Any]] = []
    for sensor, samples in SAMPLES.items():
        for t_s, values in samples():
            t_ns = make.at(t_s)
            x, y, z, p, q, r = values
            sample = ImuSample(t_ns + LATE_NS, sensor, t_ns, (x, y, z), (p, q, r))
            events.append((sample.t_ns, writer.event, sample))
    commands = [each for channel, at_s, for_s, ma, *_ in BURSTS for each in make.burst(channel, at_s, for_s, ma)]
    commands += [
        StimCommand(make.at(t_s), 1, False, 0.0, 0.0, 0.0, 60, REFUSALS.format(3 + k))
        for k, t_s in enumerate(REFUSED_S)
    ]
    for command in commands:
        events.append((command.t_ns, lambda one: writer.command(one, WireFrame(one.t_ns, 1, b"")), command))
    for answer in make.answers([command for command in commands if not command.refused]):
        events.append((answer.t_ns, writer.event, answer))
    acts = [OperatorAct(make.at(t_s), action, value) for t_s, action, value in ACTS]
    for event in (
        *acts,
        SystemFault(make.at(9.6), "the sensor is lost"),
        FootSwitchEvent(make.at(3.0), "left_foot", True),
    ):
        events.append((event.t_ns, writer.event, event))
    texts = [(3.2, MARK, "brace on"), (6.0, MARK, f"{NAMES[0]}\tturned"), (9.5, "session", "emergency stop (button)")]
    for t_s, source, text in [*texts, (0.3, "thresholds", "left_foot: rest 0.1"), (0.4, "realtime", "no SCHED_FIFO")]:
        events.append((make.at(t_s), writer.note, Note(make.at(t_s), "info", source, text)))
    events += [(change.t_ns, writer.phase, change) for change in PHASES]
    events += [(stride.t_end_ns, writer.stride, stride) for stride in STRIDES]
    for _, write, value in sorted(events, key=lambda event: event[0]):
        write(value)
    writer.close({"ended": "complete"})
    return path


def convert(log: Path, folder: Path, *options: str) -> Result:
    return CliRunner().invoke(main, ["convert", str(log), "--to", "bids", "--out", str(folder), *options])


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("bids") / "session.feslog")


def table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file, delimiter="\t"))


def only(folder: Path, pattern: str) -> Path:
    (found,) = folder.rglob(pattern)
    return found


def events_of(folder: Path, trial_type: str) -> list[dict[str, str]]:
    return [row for row in table(only(folder, "*_events.tsv")) if row["trial_type"] == trial_type]


# --- the specification's rules ---------------------------------------------------------------------------------

TYPES = {"ACCEL", "ANGACCEL", "GYRO", "JNTANG", "LATENCY", "MAGN", "MISC", "ORNT", "POS", "VEL"}
COMPONENTS = {"x", "y", "z", "quat_x", "quat_y", "quat_z", "quat_w", "n/a"}
LABEL = r"[0-9a-zA-Z]+"
ENTITIES = rf"(sub-{LABEL})(_ses-{LABEL})?"
PLACES = (
    r"dataset_description\.json|README|participants\.(tsv|json)",
    rf"sub-{LABEL}/(ses-{LABEL}/)?{ENTITIES}_scans\.tsv",
    rf"sub-{LABEL}/(ses-{LABEL}/)?motion/{ENTITIES}_task-{LABEL}_tracksys-{LABEL}_(motion|channels|events)\.(tsv|json)",
)
NUMBER = re.compile(r"-?\d+(\.\d+)?([eE][-+]?\d+)?")
DATE = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?Z?")


def places_and_names(folder: Path) -> None:
    for path in (each for each in folder.rglob("*") if each.is_file()):
        where = path.relative_to(folder).as_posix()
        assert any(re.fullmatch(pattern, where) for pattern in PLACES), where
        entities = re.findall(r"(?:^|_)(sub|ses)-([0-9a-zA-Z]+)", path.name)
        assert [f"{key}-{label}" for key, label in entities] == [
            part for part in path.relative_to(folder).parts[:-1] if part != "motion"
        ]


def data_set_is_described(folder: Path) -> None:
    about = json.loads((folder / "dataset_description.json").read_text(encoding="utf-8"))
    assert about["Name"]
    assert tuple(map(int, about["BIDSVersion"].split("."))) >= (1, 9, 0)
    assert about["DatasetType"] == "raw"
    assert (folder / "README").read_text(encoding="utf-8").strip()


def tables_are_whole(folder: Path) -> None:
    """A header of distinct names, in each row a value in each cell; of motion alone no header."""
    for path in folder.rglob("*.tsv"):
        rows = [line.split("\t") for line in path.read_text(encoding="utf-8").splitlines()]
        assert rows
        assert {len(row) for row in rows} == {len(rows[0])}, path
        assert all(cell.strip() for row in rows for cell in row), path
        if path.name.endswith("_motion.tsv"):
            assert all(cell == "n/a" or NUMBER.fullmatch(cell) for row in rows for cell in row), path
        else:
            assert all(re.fullmatch(r"[a-z][a-z0-9_]*", name) for name in rows[0]), path
            assert len(set(rows[0])) == len(rows[0])


def motion_fits_its_channels(folder: Path) -> None:
    motions = list(folder.rglob("*_motion.tsv"))
    assert len(motions) == len(SAMPLES)
    for motion in motions:
        channels = table(motion.with_name(motion.name.replace("_motion.tsv", "_channels.tsv")))
        assert list(channels[0])[:5] == ["name", "component", "type", "tracked_point", "units"]
        cells = list(zip(*(line.split("\t") for line in motion.read_text().splitlines()), strict=True))
        assert len(cells) == len(channels)
        assert len({channel["name"] for channel in channels}) == len(channels)
        for channel, column in zip(channels, cells, strict=True):
            assert channel["type"] in TYPES
            assert channel["component"] in COMPONENTS
            assert (channel["component"] in "xyz") == (channel["type"] in ("ACCEL", "GYRO"))
            units = {"ACCEL": "m/s^2", "GYRO": "rad/s", "LATENCY": "s", "MISC": "s"}
            assert channel["units"] == units[channel["type"]]
            if channel["type"] == "LATENCY":
                assert all(re.fullmatch(r"\d+(\.\d{1,6})?", cell) for cell in column)
        frames = json.loads(motion.with_name(motion.name.replace("_motion.tsv", "_channels.json")).read_text())
        named = {channel["reference_frame"] for channel in channels} - {"n/a"}
        assert named == set(frames["reference_frame"]["Levels"])


def motion_has_what_is_required(folder: Path) -> None:
    for path in folder.rglob("*_motion.json"):
        about = json.loads(path.read_text(encoding="utf-8"))
        task, system = re.findall(r"_(?:task|tracksys)-([0-9a-zA-Z]+)", path.name)
        assert re.sub(r"[^0-9a-zA-Z]", "", about["TaskName"]) == task
        assert about["TrackingSystemName"] == system
        assert about["SamplingFrequency"] > 0
        assert about["MissingValues"] == "n/a"
        channels = table(path.with_name(path.name.replace("_motion.json", "_channels.tsv")))
        assert about["MotionChannelCount"] == len(channels)
        assert about["TrackedPointsCount"] == len({channel["tracked_point"] for channel in channels})
        for kind, count in Counter(channel["type"] for channel in channels).items():
            assert about[f"{kind}ChannelCount"] == count


def events_are_in_order_and_described(folder: Path) -> None:
    path = only(folder, "*_events.tsv")
    assert path.with_name(path.name.replace("_events.tsv", "_motion.tsv")).is_file(), "an events file needs its data"
    rows, about = table(path), json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    assert list(rows[0])[:3] == ["onset", "duration", "trial_type"]
    onsets = [float(row["onset"]) for row in rows]
    assert onsets == sorted(onsets)
    assert all(row["duration"] == "n/a" or float(row["duration"]) >= 0.0 for row in rows)
    assert all(about[column]["Description"] for column in rows[0])
    assert {row["trial_type"] for row in rows} <= set(about["trial_type"]["Levels"])
    for column, unit in (("onset", "s"), ("duration", "s"), ("current_ma", "mA"), ("pulse_width_us", "us")):
        assert about[column]["Units"] == unit


def people_and_scans_are_listed(folder: Path) -> None:
    listed = [row["participant_id"] for row in table(folder / "participants.tsv")]
    assert sorted(listed) == sorted(path.name for path in folder.glob("sub-*"))
    assert "Description" in json.loads((folder / "participants.json").read_text())["participant_id"]
    for path in folder.rglob("*_scans.tsv"):
        rows = table(path)
        assert sorted(row["filename"] for row in rows) == sorted(
            each.relative_to(path.parent).as_posix() for each in path.parent.rglob("*_motion.tsv")
        )
        (acquired,) = {row["acq_time"] for row in rows}  # of one recording they must be the same
        assert acquired == "n/a" or DATE.fullmatch(acquired)


RULES = (
    places_and_names,
    data_set_is_described,
    tables_are_whole,
    motion_fits_its_channels,
    motion_has_what_is_required,
    events_are_in_order_and_described,
    people_and_scans_are_listed,
)
SETS: dict[str, tuple[str, ...]] = {
    "plain": (),
    "labelled": ("--subject", "A 1", "--session", "02", "--task", "stairs, up"),
    "anonymised": (),
    "replayed": (),
}


@pytest.fixture(scope="module", params=SETS)
def data_set(request: pytest.FixtureRequest, log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, source = tmp_path_factory.mktemp(request.param), log
    if request.param == "anonymised":
        source = folder / "new.feslog"
        anonymise(log, source)
    if request.param == "replayed":
        source = written(folder / "replay.feslog", kind="replay", created_t_ns=None)
    result = convert(source, folder / "set", *SETS[request.param])
    assert result.exit_code == 0, result.output
    return folder / "set"


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_the_specification_is_kept(data_set: Path, rule: Callable[[Path], None]) -> None:
    rule(data_set)


# --- what is in it ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plain(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plain") / "set"
    assert convert(log, folder).exit_code == 0
    return folder


@pytest.mark.parametrize(
    ("sensor", "point", "rate_hz"), [("left_foot", "LeftFoot", 100.0), ("right_foot", "RightFoot", RIGHT_HZ)]
)
def test_each_sample_is_a_row_with_its_time_and_nothing_is_filled_in(
    plain: Path, sensor: str, point: str, rate_hz: float
) -> None:
    truth = list(SAMPLES[sensor]())
    path = plain / f"sub-P07/motion/sub-P07_task-walking_tracksys-{point}_motion.tsv"
    rows = [[math.nan if cell == "n/a" else float(cell) for cell in line.split("\t")] for line in path.open()]
    assert len(rows) == len(truth)
    for (latency_s, arrival_s, *values), (t_s, expected) in zip(rows, truth, strict=True):
        assert latency_s == pytest.approx(t_s, abs=1e-6)
        assert arrival_s == pytest.approx(t_s + 1e-9 * LATE_NS, abs=2e-9)
        assert values == pytest.approx(list(expected), rel=0.0, abs=0.0, nan_ok=True)
    about = json.loads(path.with_suffix(".json").read_text())
    assert about["SamplingFrequency"] == rate_hz
    assert about["RecordingDuration"] == pytest.approx(truth[-1][0] - truth[0][0])
    assert about["SamplingFrequencyEffective"] == pytest.approx((len(truth) - 1) / (truth[-1][0] - truth[0][0]))


def test_a_gap_is_an_event(plain: Path) -> None:
    (gap,) = events_of(plain, "gap")
    assert gap["sensor"] == "left_foot"
    assert float(gap["onset"]) == pytest.approx(GAP_S[0])
    assert float(gap["duration"]) == pytest.approx(GAP_S[1] - GAP_S[0])
    assert int(gap["value"]) == 1000 - len(list(left_samples())) == 49


def test_each_burst_says_when_with_what_and_why(plain: Path) -> None:
    found = events_of(plain, "burst")
    assert len(found) == len(BURSTS)
    for row, (channel, at_s, for_s, current_ma, trigger, phase) in zip(found, BURSTS, strict=True):
        assert int(row["stim_channel"]) == channel
        assert float(row["onset"]) == pytest.approx(at_s, abs=1e-6)
        assert float(row["duration"]) == pytest.approx(for_s, abs=1e-6)
        assert float(row["current_ma"]) == current_ma
        assert (float(row["pulse_width_us"]), float(row["frequency_hz"])) == (250.0, 40.0)
        assert (row["trigger"], row["phase"]) == (trigger, phase)
        assert (row["reason"] == "n/a") == (trigger == "n/a")
        assert row["muscle"] == "tibialis anterior"
        assert row["sensor"] == ("left_foot", "right_foot")[channel]


def test_charge_and_pulses_are_those_that_the_stimulator_counted(plain: Path, log: Path) -> None:
    answers = read_session(log).statuses
    for channel in (0, 1):
        rows = [row for row in events_of(plain, "burst") if int(row["stim_channel"]) == channel]
        own = [answer for answer in answers if answer.channel == channel]
        assert sum(float(row["pulses"]) for row in rows) == sum(answer.pulses for answer in own) > 0
        charge_uc = sum(answer.charge_uc for answer in own)
        assert sum(float(row["charge_uc"]) for row in rows) == pytest.approx(charge_uc, rel=1e-5)


def test_refusals_acts_marks_faults_and_switches_are_told(plain: Path) -> None:
    (refusal,) = events_of(plain, "refusal")
    assert (float(refusal["onset"]), float(refusal["duration"])) == pytest.approx((REFUSED_S[0], 0.04), abs=1e-6)
    assert (refusal["value"], refusal["stim_channel"], refusal["reason"]) == ("3", "1", REFUSALS.format(3))
    for t_s, action, value in ACTS:
        (act,) = events_of(plain, str(action))
        assert float(act["onset"]) == pytest.approx(t_s, abs=1e-6)
        assert act["stim_channel"] == ("1" if action == OperatorAction.TEST_BURST else "n/a")
        assert act["value"] == (f"{value:g}" if action == OperatorAction.SET_INTENSITY else "n/a")
    assert [(row["onset"], row["value"]) for row in events_of(plain, "mark")] == [
        ("3.200000", "brace on"),
        ("6.000000", "(removed) turned"),
    ]
    assert [row["reason"] for row in events_of(plain, "note")] == ["emergency stop (button)"]
    assert [row["reason"] for row in events_of(plain, "system_fault")] == ["the sensor is lost"]
    assert [(row["sensor"], row["value"]) for row in events_of(plain, "foot_switch")] == [("left_foot", "pressed")]


def test_phases_last_until_the_next_and_strides_have_their_numbers(plain: Path) -> None:
    phases = events_of(plain, "phase")
    assert [(row["phase"], row["trigger"]) for row in phases] == [
        (change.destination.name.lower(), change.transition.name) for change in PHASES
    ]
    for row, change, then in zip(phases, PHASES, [*PHASES[1:], None], strict=True):
        assert float(row["onset"]) == pytest.approx(1e-9 * (change.t_ns - make.T0), abs=1e-6)
        lasted = "n/a" if then is None else pytest.approx(1e-9 * (then.t_ns - change.t_ns), abs=1e-6)
        assert (row["duration"] if then is None else float(row["duration"])) == lasted
    strides = events_of(plain, "stride")
    assert [row["value"] for row in strides] == ["1", "2", "3"]
    assert [row["reason"] for row in strides] == ["n/a", "n/a", "samples were lost"]
    assert [row["stride_length_m"] for row in strides] == ["0.63", "0.63", "n/a"]
    assert all(float(row["duration"]) == pytest.approx(make.PERIOD_S) for row in strides)


def test_no_name_is_written_but_the_subjects_label(plain: Path, log: Path, tmp_path: Path) -> None:
    anonymise(log, tmp_path / "new.feslog")
    assert convert(tmp_path / "new.feslog", tmp_path / "set").exit_code == 0
    for folder, secrets in ((plain, NAMES), (tmp_path / "set", (*NAMES, "P07", "P-07", "2026-"))):
        paths = [path for path in folder.rglob("*") if path.is_file()]
        text = "\n".join(f"{path.relative_to(folder)}\n{path.read_text(encoding='utf-8')}" for path in paths).casefold()
        assert [name for name in secrets if name.casefold() in text] == []
    assert (plain / "sub-P07").is_dir()
    (acquired,) = {row["acq_time"] for row in table(only(plain, "*_scans.tsv"))}
    assert acquired == "2026-03-01T10:00:01.000000Z"  # created at −1 s of the session's clock
    (shifted,) = {row["acq_time"] for row in table(only(tmp_path / "set", "*_scans.tsv"))}
    assert shifted.startswith("1925-01-01T"), "the specification's way to say that a date is not the true one"


def test_a_session_is_added_to_a_data_set_and_nothing_in_it_is_touched(plain: Path, log: Path, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    assert convert(log, folder, "--session", "01").exit_code == 0
    people = folder / "participants.tsv"
    people.write_text("participant_id\tage\nsub-P07\t61\n")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path != people}
    assert convert(log, folder, "--session", "02", "--add").exit_code == 0
    assert convert(log, folder, "--subject", "P08", "--add").exit_code == 0
    assert {path: path.read_bytes() for path in before} == before
    assert people.read_text() == "participant_id\tage\nsub-P07\t61\nsub-P08\tn/a\n"
    assert len(list(folder.rglob("*_motion.tsv"))) == 3 * len(SAMPLES)
    people_and_scans_are_listed(folder)


NOT_EMPTY, A_SET = "not_empty", "a_set"
REFUSED: tuple[tuple[str, tuple[str, ...], str], ...] = (
    (NOT_EMPTY, (), "is not overwritten; choose another with --out, or add this session"),
    (NOT_EMPTY, ("--add",), "no BIDS data set to add to"),
    (A_SET, (), "is not overwritten"),
    (A_SET, ("--add",), "use another --subject"),
    (A_SET, ("--add", "--session", "2"), "use another --subject"),
    ("new", ("--subject", "Ж"), "use --subject"),
    ("new", ("--task", "?"), "use --task"),
    ("a_file", (), "is not overwritten"),
)


@pytest.mark.parametrize(("where", "options", "message"), REFUSED)
def test_what_cannot_be_done_is_said_and_leaves_everything_as_it_was(
    log: Path, tmp_path: Path, where: str, options: tuple[str, ...], message: str
) -> None:
    folder = tmp_path / where
    if where == NOT_EMPTY:
        folder.mkdir()
        (folder / "mine.txt").write_text("mine")
    elif where == A_SET:
        assert convert(log, folder).exit_code == 0
    elif where == "a_file":
        folder.write_text("mine")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    result = convert(log, folder, *options)
    assert result.exit_code == 2
    assert message in result.output
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert not (tmp_path / "new").exists()


def test_a_log_without_samples_and_options_of_another_format_are_refused(log: Path, tmp_path: Path) -> None:
    writer = SessionWriter(tmp_path / "empty.feslog", make.header())
    writer.close({})
    result = convert(tmp_path / "empty.feslog", tmp_path / "set")
    assert result.exit_code == 2
    assert "no sensor's samples" in result.output
    assert not (tmp_path / "set").exists()
    result = CliRunner().invoke(main, ["convert", str(log), "--to", "csv", "--subject", "x"])
    assert result.exit_code == 2
    assert "for --to bids" in result.output
