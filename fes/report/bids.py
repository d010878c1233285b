"""A session log → a data set of the Brain Imaging Data Structure (BIDS), with its extension for motion.

Sources: the BIDS specification from 1.9.0 on (https://bids-specification.readthedocs.io), *Motion*, *Events*, *Data
summary files*, *Common principles*; S. Jeung et al. (2024), Motion-BIDS, Scientific Data 11, 716.

Each sensor is a tracking system of its own, for it has its own rate, gaps and number of samples; nothing is
interpolated. One zero holds for all files: the first sample of any sensor, whose tracking system the events name. Of
names only the subject's label is written, as in :func:`fes.session_log.anonymise.anonymise`.
"""

import csv
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes import __version__
from fes.report.quality import GAP_FACTOR, THRESHOLDS, sample_times
from fes.report.stimulation import ChannelInfo
from fes.report.summary import ReportData, summarise_session
from fes.report.text import without_numbers
from fes.session_log import SessionLogError, SessionRecord, read_session
from fes.session_log.anonymise import QUOTING, scrubber
from fes.session_log.export import ANOTHER, Exported, epoch_offset_ns
from fes.signals import NS_PER_S, IntArray, OperatorAction
from fes.stimulation.plan import BY_HAND_NS, LATEST_NS
from fes.walk_record import MARK, SampleArrays
from statemachine.phases import Phase, Transition

BIDS_VERSION: Final = "1.9.0"  # the first with motion
SHIFTED_YEAR: Final = 1925  # by which the specification tells a date that is none
TASK: Final = "walking"
DESCRIPTION: Final = "dataset_description.json"
MISSING: Final = "n/a"
KINDS: Final = ("ACCEL", "ANGACCEL", "GYRO", "JNTANG", "LATENCY", "MAGN", "MISC", "ORNT", "POS", "VEL")  # of channels
OF_A_CHANNEL: Final = frozenset(
    (*BY_HAND_NS, OperatorAction.EXERCISE, OperatorAction.ACCEPT_SUGGESTION, OperatorAction.ROLL_BACK)
)
OF_A_SIZE: Final = {OperatorAction.SET_INTENSITY, OperatorAction.SET_BELT_SPEED, OperatorAction.SET_INCLINE}
Event = tuple[int, int | None, dict[str, object]]  # when it began and ended (ns; None: not known), and its columns

CHANNELS: Final = (  # what follows the sensor in its name; component, type, units, reference frame, description
    ("latency", MISSING, "LATENCY", "s", MISSING, "when the sample was taken, from the first sample of any sensor on"),
    ("arrival", MISSING, "MISC", "s", MISSING, "when the sample had reached the computer, from the same instant on"),
    *((f"acc_{axis}", axis, "ACCEL", "m/s^2", "sensor", "specific force: +9.81 upward at rest") for axis in "xyz"),
    *((f"gyr_{axis}", axis, "GYRO", "rad/s", "sensor", "angular rate") for axis in "xyz"),
)
FRAMES: Final = {
    "reference_frame": {
        "Description": "In which axes the channel's component is to be read.",
        "Levels": {"sensor": {"Description": "The sensor's own axes, as its device has them."}},
    }
}
TRIAL_TYPES: Final = {
    "burst": "a channel was commanded on, without a break",
    "refusal": "the safety gate turned commands of a channel off; reason says why",
    "phase": "a foot went into a phase of its gait, until it went into the next one",
    "stride": "a stride, from the quietest instant of a stance to that of the next",
    "gap": "samples of a sensor are missing between two that came",
    "mark": "a person marked the moment; value is what was marked",
    "note": "the program noted something; trigger is which part of it",
    "system_fault": "the session found in itself what forbids stimulation",
    "foot_switch": "a switch under the foot was pressed, released, or fell silent",
} | {str(action): f"a person acted: {action.replace('_', ' ')}" for action in OperatorAction}
COLUMNS: Final[dict[str, dict[str, Any]]] = {
    "onset": {"Description": "From the first sample of any sensor on.", "Units": "s"},
    "duration": {"Description": "How long it lasted.", "Units": "s"},
    "trial_type": {"Description": "What happened.", "Levels": TRIAL_TYPES},
    "sensor": {"Description": "The sensor that it is of, or that times the channel."},
    "stim_channel": {"Description": "Number of the stimulator's channel."},
    "muscle": {"Description": "What the channel stimulates."},
    "current_ma": {"Description": "The burst's greatest commanded current.", "Units": "mA"},
    "pulse_width_us": {"Description": "Commanded pulse width at that current.", "Units": "us"},
    "frequency_hz": {"Description": "Commanded frequency at that current.", "Units": "Hz"},
    "pulses": {"Description": "Pulses as the stimulator counted them, else as the commands make."},
    "charge_uc": {"Description": "Charge of one phase, summed over these pulses.", "Units": "uC"},
    "phase": {"Description": "The phase that began; of a burst, in which it began."},
    "trigger": {
        "Description": "What made it: transition of the phase machine (T1 to T6), act of a person, part of the "
        "program; of a burst, the last of these before it."
    },
    "stride_length_m": {"Description": "Of a valid stride.", "Units": "m"},
    "speed_mps": {"Description": "Of a valid stride.", "Units": "m/s"},
    "clearance_m": {"Description": "The sensor's greatest height in a valid stride.", "Units": "m"},
    "value": {
        "Description": "Mark's text; an act's size (intensity of 1, m/s, slope); number of the stride, of refused "
        "commands or of missing samples; state of a foot switch."
    },
    "reason": {"Description": "Why, as far as the log says it."},
}
README: Final = """\
Gait with functional electrical stimulation, recorded and stimulated by fes-gait; converted from its session log.

Each sensor is a tracking system of its own (tracksys). A row of a *_motion.tsv is a sample that came: nothing was
interpolated, and missing samples have no rows, so use the channel of type LATENCY as time, not row number over
SamplingFrequency. SamplingFrequencyEffective is the number of intervals by their total time, gaps included.
Latencies and onsets of events are counted from the same instant, the first sample of any sensor; acq_time is that
instant for every file of a session. Dates in 1925 are not the true ones.

The events tell each burst of stimulation and what made it, what the safety gate refused, phases and strides as they
were seen while walking, what people did and marked, faults, and gaps in the sensors' samples.
"""


def to_bids(
    log: Path, folder: Path, *, subject: str = "", session: str = "", task: str = TASK, add: bool = False
) -> Exported:
    """Write the data set ``folder``, or ``add`` the session to the one that is there. Nothing is overwritten.

    Args:
        log: the session log; of a torn one, what is whole.
        folder: new or empty; with ``add`` it may be a data set.
        subject: label of the subject; "": the log's, "01" where it has none.
        session: label of the session; "": no folder of its own.
        task: what was done, in words.
        add: see above.

    Raises:
        SessionLogError: the log cannot be read or holds no samples, a label has no letter or digit, ``folder`` holds
            something already, or cannot be written.
        ConfigError: the header's settings are not of this version.
    """
    record = read_session(log)
    times = {sensor: sample_times(arrays) for sensor, arrays in record.samples.items() if len(arrays.t_ns) > 1}
    times = {sensor: t_ns for sensor, t_ns in times.items() if (np.diff(t_ns) > 0).any()}
    if not times:
        raise SessionLogError(
            f"{log}: holds no sensor's samples, so there is no motion to write as BIDS; `--to csv` converts the rest"
        )
    data, scrub = summarise_session(record), scrubber(record.header, log)
    logged = data.settings.subject if data.settings else ""
    names = [f"sub-{_label(subject or logged or '01', 'subject')}"]
    names += [f"ses-{_label(session, 'session')}"] if session else []
    stem = "_".join((*names, f"task-{_label(task, 'task')}"))
    first = min(times, key=lambda sensor: int(times[sensor].min()))
    zero_ns = int(times[first].min())
    try:
        _refuse_what_is_there(folder, names, add)
        motion = folder.joinpath(*names, "motion")
        motion.mkdir(parents=True)
        rows = {f"motion {_point(sensor)}": len(t_ns) for sensor, t_ns in times.items()}
        for sensor, t_ns in times.items():
            about = {"TaskName": task, **_about(record, data, sensor, t_ns)}
            _tracking_system(
                motion / f"{stem}_tracksys-{_point(sensor)}", sensor, record.samples[sensor], about, zero_ns
            )
        events = sorted(_events(record, data, times, scrub), key=lambda event: event[0])
        rows["events"] = len(events)
        place = motion / f"{stem}_tracksys-{_point(first)}_events"
        _write_table(place.with_suffix(".tsv"), COLUMNS, (_event_row(event, zero_ns) for event in events))
        shown = {"SoftwareName": "fes-gait", "SoftwareVersion": str(record.header.get("fes_version", MISSING))}
        _write_json(place.with_suffix(".json"), COLUMNS | {"StimulusPresentation": shown})
        files = [f"motion/{stem}_tracksys-{_point(sensor)}_motion.tsv" for sensor in times]
        acquired = _acquired(record.header, zero_ns)
        scans = motion.parent / f"{'_'.join(names)}_scans.tsv"
        _write_table(scans, ("filename", "acq_time"), ([file, acquired] for file in files))
        _write_data_set(folder, names[0])
    except OSError as error:
        raise SessionLogError(
            f"{error.filename or folder}: cannot be written: {error.strerror or error}. What is in {folder} of this "
            f"session is not complete: remove it, make room, or {ANOTHER}"
        ) from error
    return Exported(record.header, record.summary, record.complete, rows=rows, begin_ns=zero_ns)


def _label(text: str, what: str) -> str:
    """A label as BIDS allows it: letters and digits of ASCII."""
    label = re.sub(r"[^0-9A-Za-z]", "", text)
    if not label:
        raise SessionLogError(
            f"{what} {text!r} has none of A–Z, a–z, 0–9, of which a label of BIDS is made; use --{what}"
        )
    return label


def _point(sensor: str) -> str:
    """``LeftFoot`` for ``left_foot``: the tracked point, and the tracking system that tracks it alone."""
    return sensor.title().replace("_", "")


def _refuse_what_is_there(folder: Path, names: list[str], add: bool) -> None:
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    if not add or not folder.is_dir():
        raise SessionLogError(
            f"{folder}: is there already, is not empty and is not overwritten; {ANOTHER}, or add this session to the "
            "data set that is there with --add"
        )
    if not (folder / DESCRIPTION).is_file():
        raise SessionLogError(f"{folder}: has no {DESCRIPTION}, so it is no BIDS data set to add to; {ANOTHER}")
    # a subject's sessions have either all a folder of their own, or there is one and it has none
    for taken in (folder.joinpath(*names), folder / names[0] / "motion"):
        if taken.exists():
            raise SessionLogError(
                f"{taken}: is there already and is not overwritten; use another --subject or --session"
            )


# --- samples -------------------------------------------------------------------------------------------------


def _about(record: SessionRecord, data: ReportData, sensor: str, t_ns: IntArray) -> dict[str, Any]:
    """What a tracking system's ``*_motion.json`` says beside the task."""
    span_s, steps_ns = float(np.ptp(t_ns)) / NS_PER_S, np.diff(t_ns)
    recording = record.header.get("recording")
    rates = recording.get("rates_hz") if isinstance(recording, dict) else None
    stated = [rates.get(sensor)] if isinstance(rates, dict) else []
    stated += [device.rate_hz for device in (data.settings.sensors if data.settings else ()) if device.sensor == sensor]
    usual_hz = NS_PER_S / float(np.median(steps_ns[steps_ns > 0]))
    counts = Counter(kind for _, _, kind, *_ in CHANNELS)
    return {
        "TaskDescription": "Gait; its phases, seen by these sensors, time functional electrical stimulation.",
        "TrackingSystemName": _point(sensor),
        "SamplingFrequency": next((rate for rate in stated if isinstance(rate, int | float) and rate > 0), usual_hz),
        "SamplingFrequencyEffective": (len(t_ns) - 1) / span_s,
        "RecordingDuration": span_s,
        "MissingValues": MISSING,
        "TrackedPointsCount": 1,
        "MotionChannelCount": len(CHANNELS),
        **{f"{kind}ChannelCount": counts[kind] for kind in KINDS},
    }


def _tracking_system(stem: Path, sensor: str, samples: SampleArrays, about: dict[str, Any], zero_ns: int) -> None:
    """``*_motion.tsv`` with its ``.json``, and what its columns are."""
    vectors = np.hstack([samples.acc_mps2, samples.gyr_radps])
    vectors[~np.isfinite(vectors)] = np.nan
    with np.errstate(over="ignore"):
        single = np.array_equal(vectors.astype(np.float32), vectors, equal_nan=True)
    form = "\t".join(["%.6f", "%.9f", *["%.9g" if single else "%.17g"] * 6]) + "\n"  # as much as brings it back whole
    columns = [((t_ns - zero_ns) / NS_PER_S).tolist() for t_ns in (sample_times(samples), samples.t_ns)]
    with Path(f"{stem}_motion.tsv").open("x", encoding="utf-8", newline="") as file:
        file.writelines((form % row).replace("nan", MISSING) for row in zip(*columns, *vectors.T.tolist(), strict=True))
    _write_json(Path(f"{stem}_motion.json"), about)
    names = ("name", "component", "type", "tracked_point", "units", "placement", "reference_frame", "description")
    point, place = _point(sensor), sensor.replace("_", " ")
    rows = ([f"{sensor}_{n}", c, kind, point, unit, place, frame, text] for n, c, kind, unit, frame, text in CHANNELS)
    _write_table(Path(f"{stem}_channels.tsv"), names, rows)
    _write_json(Path(f"{stem}_channels.json"), FRAMES)


def _acquired(header: Mapping[str, Any], zero_ns: int) -> str:
    """When the first sample was taken; not known of a replay. Of an anonymised log in a year that says it is not."""
    offset_ns, absolute = epoch_offset_ns(dict(header), zero_ns)
    if not absolute or not isinstance(header.get("created_t_ns"), int):
        return MISSING
    at = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=(zero_ns + offset_ns) // 1000)
    at = at.replace(year=SHIFTED_YEAR) if header.get("anonymised") else at
    return at.strftime("%Y-%m-%dT%H:%M:%S.%fZ")


# --- events --------------------------------------------------------------------------------------------------


def _events(
    record: SessionRecord, data: ReportData, times: Mapping[str, IntArray], scrub: Callable[[str], str]
) -> Iterator[Event]:
    """In no order, but of one instant causes first."""
    for foot in sorted({change.foot for change in record.phases}):
        own = [change for change in record.phases if change.foot == foot]
        for change, then in zip(own, [*own[1:], None], strict=True):
            entered = {"phase": change.destination.name.lower(), "trigger": _transition(change.transition)}
            yield change.t_ns, then.t_ns if then else None, {"trial_type": "phase", "sensor": foot, **entered}
    for stride in record.strides:
        columns: dict[str, object] = {"trial_type": "stride", "sensor": stride.foot, "value": stride.number}
        columns["reason"] = scrub(stride.reason)
        if stride.valid:  # else its numbers must not be used
            columns |= {name: getattr(stride, name) for name in ("stride_length_m", "speed_mps", "clearance_m")}
        yield stride.t_start_ns, stride.t_end_ns, columns
    for sensor, t_ns in times.items():
        steps_ns = np.diff(t_ns)
        usual_ns = float(np.median(steps_ns[steps_ns > 0]))
        for at in np.flatnonzero(steps_ns > GAP_FACTOR * usual_ns).tolist():
            missing = round(float(steps_ns[at]) / usual_ns) - 1
            yield int(t_ns[at]), int(t_ns[at + 1]), {"trial_type": "gap", "sensor": sensor, "value": missing}
    for act in record.acts:
        columns = {"trial_type": str(act.action), "reason": scrub(act.why)}
        if act.action in OF_A_CHANNEL:
            columns["stim_channel"] = int(act.value)
        elif act.action in OF_A_SIZE:
            columns["value"] = act.value
        yield act.t_ns, act.t_ns, columns
    for note in record.notes:
        if note.source == MARK:
            yield note.t_ns, note.t_ns, {"trial_type": "mark", "value": scrub(note.text)}
        elif note.source not in (THRESHOLDS, *QUOTING):
            yield note.t_ns, note.t_ns, {"trial_type": "note", "trigger": note.source, "reason": scrub(note.text)}
    for fault in record.faults:
        yield fault.t_ns, fault.t_ns, {"trial_type": "system_fault", "reason": scrub(fault.text)}
    states = {True: "pressed", False: "released", None: "silent"}
    for switch in record.switches:
        yield switch.t_ns, switch.t_ns, {
            "trial_type": "foot_switch", "sensor": switch.foot, "value": states[switch.pressed],
        }  # fmt: skip
    for info in data.channels:
        about: dict[str, object] = {
            "stim_channel": info.number,
            "muscle": scrub(info.muscle),
            "sensor": info.phase_sensor,
        }
        for event in (*_bursts(record, data, info), *_refusals(record, info, scrub)):
            yield event[0], event[1], about | event[2]


def _transition(transition: Transition) -> str:
    return "phase lost" if transition is Transition.NONE else transition.name


def _bursts(record: SessionRecord, data: ReportData, info: ChannelInfo) -> Iterator[Event]:
    commands, timeline = data.commands[info.number], data.timelines.get(info.phase_sensor)
    for burst, (why, reason) in zip(data.bursts[info.number], _whys(record, data, info), strict=True):
        low, high = np.searchsorted(commands.t_ns, [burst.t_start_ns, burst.t_end_ns])
        top = low + int(np.argmax(np.where(commands.on[low:high], commands.current_ma[low:high], -1.0)))
        columns: dict[str, object] = {"trial_type": "burst", "pulses": burst.pulses, "charge_uc": burst.charge_uc}
        columns |= {n: float(getattr(commands, n)[top]) for n in ("current_ma", "pulse_width_us", "frequency_hz")}
        if timeline is not None and timeline.change_ns.size:
            at = int(np.searchsorted(timeline.start_ns, burst.t_start_ns, side="right")) - 1
            columns["phase"] = Phase(int(timeline.phase[max(at, 0)])).name.lower()
        yield burst.t_start_ns, burst.t_end_ns, columns | {"trigger": why, "reason": reason}


def _whys(record: SessionRecord, data: ReportData, info: ChannelInfo) -> Iterator[tuple[str, str]]:
    """Of each burst of a channel what triggered it, and that in words; "" where the log does not say it."""
    delays_s = {channel.number: channel.start_delay_s for channel in (data.settings.channels if data.settings else ())}
    latest_ns = LATEST_NS + round(delays_s.get(info.number, 0.0) * NS_PER_S)
    asked = [act for act in record.acts if act.action in BY_HAND_NS and act.value == info.number]
    entries = [
        change
        for change in record.phases
        if change.foot == info.phase_sensor and change.destination.name.lower() == info.start_phase
    ]
    asked_ns, entered_ns = (np.array([each.t_ns for each in own], np.int64) for own in (asked, entries))
    for burst in data.bursts[info.number]:
        act, entry = (int(np.searchsorted(t_ns, burst.t_start_ns, side="right")) - 1 for t_ns in (asked_ns, entered_ns))
        if burst.by_hand:
            yield str(asked[act].action), "a person asked for it"
        elif burst.early:
            yield "predicted onset", f"the entry into {info.start_phase} was predicted"
        elif entry >= 0 and burst.t_start_ns - entered_ns[entry] <= latest_ns:
            after_s = (burst.t_start_ns - int(entered_ns[entry])) / NS_PER_S
            yield (
                _transition(entries[entry].transition),
                f"the foot went into {info.start_phase} {after_s:.3f} s before",
            )
        else:
            yield "", ""


def _refusals(record: SessionRecord, info: ChannelInfo, scrub: Callable[[str], str]) -> Iterator[Event]:
    """Commands that were refused one after the other for the same reason, numbers in it left aside, are one event."""
    own = [command for command in record.commands if command.channel == info.number]
    for reason, commands in groupby(own, key=lambda command: without_numbers(command.refused)):
        if reason:
            refused = list(commands)
            columns = {"trial_type": "refusal", "value": len(refused), "reason": scrub(refused[0].refused)}
            yield refused[0].t_ns, refused[-1].t_ns, columns


def _event_row(event: Event, zero_ns: int) -> list[object]:
    begin_ns, end_ns, columns = event
    lasted = "" if end_ns is None else f"{max(end_ns - begin_ns, 0) / NS_PER_S:.6f}"
    return [f"{(begin_ns - zero_ns) / NS_PER_S:.6f}", lasted, *(columns.get(name) for name in list(COLUMNS)[2:])]


# --- files ---------------------------------------------------------------------------------------------------


def _write_data_set(folder: Path, participant: str) -> None:
    """What the whole data set has, where it is not there yet, and the participant's row."""
    made = {"Name": "fes-gait", "Version": __version__, "Description": "fes convert --to bids"}
    name = "Gait with functional electrical stimulation"
    whole = {"Name": name, "BIDSVersion": BIDS_VERSION, "DatasetType": "raw", "GeneratedBy": [made]}
    people = folder / "participants.tsv"
    if not (folder / DESCRIPTION).exists():
        _write_json(folder / DESCRIPTION, whole)
        (folder / "README").write_text(README, encoding="utf-8")
        _write_json(folder / "participants.json", {"participant_id": {"Description": "Label of the participant."}})
        _write_table(people, ["participant_id"], [[participant]])
        return
    text = people.read_text(encoding="utf-8") if people.exists() else "participant_id\n"
    columns, *rows = csv.reader(text.splitlines(), delimiter="\t")
    if [participant] not in [row[:1] for row in rows]:
        row = "\t".join([participant, *[MISSING] * (len(columns) - 1)])
        people.write_text(f"{text.rstrip()}\n{row}\n", encoding="utf-8")


def _write_json(path: Path, values: Mapping[str, Any]) -> None:
    with path.open("x", encoding="utf-8") as file:
        file.write(json.dumps(values, indent=2, ensure_ascii=False) + "\n")


def _write_table(path: Path, names: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    with path.open("x", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, delimiter="\t", lineterminator="\n")
        writer.writerow(names)
        writer.writerows([_cell(value) for value in row] for row in rows)


def _cell(value: object) -> str:
    """Text in one line, numbers with six digits; what is not known is n/a."""
    if isinstance(value, float):
        return f"{value:.6g}" if np.isfinite(value) else MISSING
    return " ".join(str(value).split()) if value is not None and str(value).strip() else MISSING
