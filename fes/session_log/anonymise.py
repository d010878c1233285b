"""A session log without names: what identifies a person, a place or a device is taken out, and times begin anew.

What is kept is listed, not what goes: of the header what settings and calibrations of this version are made of, each
free text in them replaced; of records their numbers and bytes. Texts of notes and faults are kept without the names
that the header had, without paths, and without what a person wrote.
"""

import os
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

from fes.config import Session, validate_session
from fes.config.session import Bus
from fes.session_log.codec import LatencyRun, SampleRun, encode, encode_json, latency_arrays, samples_of
from fes.session_log.framing import MAGIC, RecordType, SessionLogError, framed
from fes.session_log.repair import Damage, stretches
from fes.session_log.writer import create
from fes.signals import NS_PER_S, SENSORS, OperatorAct, StimAlive, StimCommand, StimStatus, StrideResult, SystemFault
from fes.walk_record import MARK, Note

NAMELESS: Final = "anonymous"
GONE: Final = "(removed)"
DATE: Final = "2000-01-01T00:00:00+00:00"  # of every anonymised log
BEGINS_NS: Final = NS_PER_S  # so does its clock: what had been sampled before it came is not before zero
KINDS: Final = ("live", "exercise", "replay", "simulated", "analysis")
ENDINGS: Final = ("complete", "different", "interrupted", "given up")
NUMBERS: Final = ("format", "stim_session_id", "current_step_ma", "polled_every_ns", "heard", "faults_injected")
QUOTING: Final = frozenset(("realtime", "log", "view", "dashboard", "runner", "recover"))  # what the system said
SHORTEST: Final = 4  # letters of a name that is looked for inside of words too
SHORTEST_PART: Final = 3  # and of a part of one
OWN_WORDS: Final = frozenset(
    "left right foot shank stance swing pre loading response channel bus live session sensor stimulator walk test "
    f"gait mark the and with from for {NAMELESS} removed".split()
)
PLACE: Final = re.compile(r"\S*[/\\]\S*")
UNIT: Final = re.compile(r"[(]?[\w°µ²³^.%·-]{1,6}/[\w²³^]{1,4}[.,;:)]*")  # m/s², rad/s: no path
FILE: Final = re.compile(r"\(file [^)]*\)|the stop file .*?(?= is there| cannot)")
LONG_NUMBER: Final = re.compile(r"\b(?=\w*\d)[0-9A-Fa-f]{8,}\b|\b(?:[0-9A-Fa-f]{2}[:-]){3,}[0-9A-Fa-f]{2}\b")


@dataclass(frozen=True, slots=True)
class Anonymised:
    """What was done: how many ``records``, ``texts`` changed, ``marks`` numbered; ``shift_ns`` was added to all times.

    ``left`` are names that still stand in the new log: words that it has of its own.
    """

    records: int
    texts: int
    marks: int
    shift_ns: int
    left: tuple[str, ...] = ()


def anonymise(
    source: Path, target: Path, *, names: Collection[str] = (), keep_marks: bool = False, refused: Sequence[str] = ()
) -> Anonymised:
    """Write ``target``, a new log like ``source`` without names; whole records only, as many as are whole.

    Args:
        source: only read.
        target: must not exist.
        names: to be taken out of all texts, beside those that the header has.
        keep_marks: keep what a person marked, without these names; else marks are numbered.
        refused: by command, why the gate refused it, as a replay of the new log says it.

    Raises:
        SessionLogError: ``source`` cannot be read or has no whole header; ``target`` exists or cannot be written.
        ConfigError: the header's settings are not of this version.
    """
    header, first_ns = _begin(source)
    shift_ns = BEGINS_NS - first_ns
    made = _header(header, source, shift_ns)
    secrets = _secrets(header, made, names)
    scrub = _Scrub(secrets)
    for channel in made["session"]["channels"]:
        channel["muscle"] = scrub(channel["muscle"])
    change = _Change(scrub, shift_ns, keep_marks, refused)
    descriptor = create(target)
    try:
        with os.fdopen(descriptor, "wb") as out:
            out.write(MAGIC)
            out.write(framed(RecordType.HEADER, encode_json(made)))
            count, said = 1, bytearray()
            for kind, payload in change.records(source):
                out.write(framed(kind, payload))
                count += 1
                if kind not in (RecordType.SAMPLES, RecordType.LATENCY, RecordType.FRAME, RecordType.RECEIVED):
                    said += payload + b"\n"
    except OSError as error:
        target.unlink(missing_ok=True)
        raise SessionLogError(
            f"{target}: cannot be written: {error.strerror or error}; choose another with --out"
        ) from error
    except BaseException:
        target.unlink(missing_ok=True)
        raise
    text = bytes(said).decode("utf-8", "replace").casefold()
    left = tuple(each for each in secrets if len(each) >= SHORTEST and each.casefold() in text)
    return Anonymised(count, scrub.changed, change.marks, shift_ns, left)


def scrubber(header: dict[str, Any], source: Path) -> Callable[[str], str]:
    """What takes out of a text the names that the log's header has, paths and long numbers, as :func:`anonymise` does.

    ConfigError: the header's settings are not of this version; ``source`` is for the message.
    """
    return _Scrub(_secrets(header, _header(header, source, 0), ()))


def _begin(source: Path) -> tuple[dict[str, Any], int]:
    """The header, and the first time of all (ns)."""
    header, first_ns = None, None
    for stretch in stretches(Path(source)):
        if isinstance(stretch, Damage):
            continue
        if stretch.kind == RecordType.HEADER and isinstance(stretch.value, dict):
            header = header or stretch.value
        elif stretch.begin_ns is not None:
            first_ns = stretch.begin_ns if first_ns is None else min(first_ns, stretch.begin_ns)
    if header is None:
        raise SessionLogError(f"{source}: has no whole header; `fes recover {source}` says what can be read")
    return header, first_ns or 0


# --- names ---------------------------------------------------------------------------------------------------


def _secrets(before: dict[str, Any], after: dict[str, Any], names: Collection[str]) -> tuple[str, ...]:
    """Every text that the header had and has no more, whole and by its words; the longest first.

    Of channels' names, which often are their muscles', the whole alone.
    """
    channels = _texts(before.get("session", {}).get("channels", []))
    muscles = " ".join(str(each["muscle"]) for each in after["session"]["channels"])
    outside = {**before, "session": {**before.get("session", {}), "channels": []}}
    kept = set(_texts(after))
    whole = (set(_texts(outside)) - kept) | {text.strip() for text in names}
    parts = {part for text in whole for part in re.split(r"[\W_]+", text) if len(part) >= SHORTEST_PART}
    whole |= {text for text in channels if text not in kept and text not in muscles}
    return tuple(sorted(filter(_is_secret, whole | parts), key=lambda each: (-len(each), each)))


def _texts(value: object) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for key, each in value.items():
            yield from (str(key), *_texts(each))
    elif isinstance(value, list):
        for each in value:
            yield from _texts(each)


def _is_secret(text: str) -> bool:
    words = {word.casefold() for word in re.split(r"[\W_\d]+", text) if word}
    return len(text) > 1 and not text.isdigit() and not words <= OWN_WORDS


class _Scrub:
    """Takes names, paths and long numbers out of a text; ``changed`` counts the texts."""

    def __init__(self, secrets: Sequence[str]) -> None:
        self.changed = 0
        inside = [re.escape(each) for each in secrets if len(each) >= SHORTEST]
        words = [rf"(?<!\w){re.escape(each)}(?!\w)" for each in secrets if len(each) < SHORTEST]
        self._names = re.compile("|".join([*inside, *words]), re.IGNORECASE) if secrets else None

    def __call__(self, text: str) -> str:
        scrubbed = self._names.sub(GONE, text) if self._names else text
        scrubbed = LONG_NUMBER.sub(GONE, FILE.sub(GONE, scrubbed))
        scrubbed = PLACE.sub(lambda found: found[0] if UNIT.fullmatch(found[0]) else GONE, scrubbed)
        self.changed += scrubbed != text
        return scrubbed


# --- header and summary --------------------------------------------------------------------------------------


def _header(header: dict[str, Any], source: Path, shift_ns: int) -> dict[str, Any]:
    recording = header.get("recording") if isinstance(header.get("recording"), dict) else {}
    session = _nameless(validate_session(header.get("session") or {}, source))
    kind = header.get("kind")
    made: dict[str, Any] = {name: header[name] for name in NUMBERS if isinstance(header.get(name), bool | int | float)}
    made |= {
        "fes_version": re.sub(r"[^\w.+]", "", str(header.get("fes_version", "")))[:20],
        "kind": kind if kind in KINDS else "live",
        "created": DATE,
        "recording": {"name": NAMELESS, "sha256": "", **_numbers(recording or {})},
        "session": session.model_dump(mode="json"),
        "calibration": {
            sensor: {name: value for name, value in data.items() if _is_number(value) or value in SENSORS}
            for sensor, data in (header.get("calibration") or {}).items()
            if sensor in SENSORS and isinstance(data, dict)
        },
        "anonymised": True,
    }
    if isinstance(since_ns := header.get("created_t_ns"), int):
        made["created_t_ns"] = since_ns + shift_ns
    return made


def _nameless(session: Session) -> Session:
    """The settings, with numbers for names and ports."""
    channels = [each.model_copy(update={"name": f"channel {each.number}"}) for each in session.channels]
    sensors = [
        each.model_copy(update={"port": each.port if each.port == "bus" else f"port {number}", "options": {}})
        for number, each in enumerate(session.sensors)
    ]
    switches = [
        each.model_copy(update={"port": each.port if each.port == "bus" else f"switch {number}"})
        for number, each in enumerate(session.foot_switches)
    ]
    options = {
        name: value
        for name, value in session.stimulator.options.items()
        if not isinstance(value, str) or name == "model"
    }
    port = "stimulator" if session.stimulator.port else ""
    return session.model_copy(
        update={
            "name": NAMELESS,
            "subject": "",
            "channels": tuple(channels),
            "sensors": tuple(sensors),
            "foot_switches": tuple(switches),
            "bus": Bus(),
            "stimulator": session.stimulator.model_copy(update={"port": port, "options": options}),
        }
    )


def _is_number(value: object) -> bool:
    if isinstance(value, list):
        return all(map(_is_number, value))
    return value is None or isinstance(value, bool | int | float)


def _numbers(values: dict[str, Any]) -> dict[str, Any]:
    """What is no text, also below; of keys those that the program gives."""
    kept: dict[str, Any] = {}
    for key, value in values.items():
        if not re.fullmatch(r"[a-z_]{1,40}|[\d.]{1,8}", key):
            continue
        if isinstance(value, dict):
            kept[key] = _numbers(value)
        elif _is_number(value):
            kept[key] = value
    return kept


# --- records -------------------------------------------------------------------------------------------------


class _Change:
    """A log's records, one by one, with their times shifted and their texts scrubbed."""

    def __init__(self, scrub: _Scrub, shift_ns: int, keep_marks: bool, refused: Sequence[str]) -> None:
        self._scrub, self._shift_ns, self._keep_marks, self._refused = scrub, shift_ns, keep_marks, refused
        self._commands = 0
        self.marks = 0

    def records(self, source: Path) -> Iterator[tuple[int, bytes]]:
        """Type and payload of all but the header."""
        for stretch in stretches(Path(source)):
            if isinstance(stretch, Damage) or stretch.kind == RecordType.HEADER:
                continue
            if stretch.kind == RecordType.SAMPLES:
                yield from self._samples(stretch.payload)
            elif stretch.kind == RecordType.LATENCY:
                yield from self._latencies(stretch.payload)
            elif stretch.kind == RecordType.SUMMARY:
                yield RecordType.SUMMARY, encode_json(self._summary(stretch.value))
            else:
                yield encode(self._single(stretch.value))

    def _samples(self, payload: memoryview) -> Iterator[tuple[int, bytes]]:
        run = SampleRun()
        for each in samples_of(payload):
            shifted = each._replace(t_ns=each.t_ns + self._shift_ns, t_sensor_ns=each.t_sensor_ns + self._shift_ns)
            if not run.add(shifted):
                yield RecordType.SAMPLES, run.close()
                run.add(shifted)
        if run:
            yield RecordType.SAMPLES, run.close()

    def _latencies(self, payload: memoryview) -> Iterator[tuple[int, bytes]]:
        run = LatencyRun()
        for t_ns, latency_ns in zip(*(column.tolist() for column in latency_arrays([payload])), strict=True):
            if not run.add(t_ns + self._shift_ns, latency_ns):
                yield RecordType.LATENCY, run.close()
                run.add(t_ns + self._shift_ns, latency_ns)
        if run:
            yield RecordType.LATENCY, run.close()

    def _single(self, value: Any) -> Any:
        shifts = {
            each.name: now + self._shift_ns
            for each in fields(value)
            if each.name.startswith("t_")
            and each.name.endswith("_ns")
            and (now := getattr(value, each.name)) is not None
        }
        value = replace(value, **shifts)
        match value:
            case OperatorAct():
                return replace(value, why=self._scrub(value.why))
            case StimStatus() | StimAlive():
                return replace(value, fault=self._scrub(value.fault))
            case SystemFault():
                return replace(value, text=self._scrub(value.text))
            case StrideResult():
                foot = value.foot if value.foot in SENSORS else NAMELESS
                return replace(value, foot=foot, reason=self._scrub(value.reason))
            case StimCommand():
                number, self._commands = self._commands, self._commands + 1
                if value.refused and number < len(self._refused):
                    return replace(value, refused=self._refused[number])
                return replace(value, refused=self._scrub(value.refused))
            case Note():
                return self._note(value)
        return value

    def _note(self, note: Note) -> Note:
        if note.source == MARK:
            self.marks += 1
            return replace(note, text=self._scrub(note.text) if self._keep_marks else f"mark {self.marks}")
        source = note.source if re.fullmatch(r"[a-z]{1,16}", note.source) else "session"
        return replace(note, source=source, text=GONE if source in QUOTING else self._scrub(note.text))

    def _summary(self, summary: object) -> dict[str, Any]:
        values = summary if isinstance(summary, dict) else {}
        ended = values.get("ended")
        return _numbers(values) | ({"ended": ended if ended in ENDINGS else NAMELESS} if "ended" in values else {})
