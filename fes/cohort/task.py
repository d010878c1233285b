"""One recording of a cohort, in whichever process: fetched, analysed, kept. Whatever is wrong with it becomes a row."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

from fes import __version__
from fes.cohort.sources import CohortError, Source, local_copy
from fes.cohort.store import EVENTS, RECORDINGS, STRIDES, Store

DONE: Final = "done"
FAILED: Final = "failed"
LONGEST_REASON: Final = 500
_MEANS: Final = ("stride_length_m", "speed_mps", "clearance_m")


@dataclass(frozen=True, slots=True)
class Settings:
    """What holds for every recording.

    Attributes:
        level: the ground is level.
        subject_from: a pattern that finds the subject in the address, where the sidecar names none.
    """

    level: bool = True
    subject_from: str = ""

    def text(self) -> str:
        """For the identity of results."""
        return repr(sorted(asdict(self).items()))


@dataclass(frozen=True, slots=True)
class Outcome:
    """How it went: the recording's identity, ``done`` or ``failed`` with the reason."""

    identity: str
    url: str
    status: str
    reason: str = ""


def analyse_one(source: Source, store: Store, settings: Settings) -> Outcome:
    """Analyse a recording and keep its rows; what is wrong with the recording is kept as its reason.

    Raises:
        OSError: the results cannot be kept; the recording counts as not done.
    """
    identity = source.identity(settings.text())
    base = {"recording": identity, "source": source.url, "fes_version": __version__}
    try:
        tables = _tables(source, identity, settings)
    except Exception as error:  # one bad recording, however bad, must not stop the others
        reason = reason_of(error)
        row = {**base, "status": FAILED, "reason": reason, "subject": _subject(source, "", settings)}
        store.put(identity, {RECORDINGS: [row]})
        return Outcome(identity, source.url, FAILED, reason)
    tables[RECORDINGS] = [{**base, "status": DONE, **row} for row in tables[RECORDINGS]]
    store.put(identity, tables)
    return Outcome(identity, source.url, DONE)


def keep_failure(source: Source, store: Store, settings: Settings, reason: str) -> Outcome:
    """Note of a recording that could not even be tried to its end, as when its process died again and again."""
    identity = source.identity(settings.text())
    subject = _subject(source, "", settings)
    row = {"recording": identity, "source": source.url, "fes_version": __version__, "status": FAILED}
    store.put(identity, {RECORDINGS: [{**row, "reason": reason[:LONGEST_REASON], "subject": subject}]})
    return Outcome(identity, source.url, FAILED, reason)


def drop_replaced(store: Store, sources: Iterable[Source], settings: Settings) -> int:
    """Take away what earlier files, settings or programs left of recordings that are finished anew; how many.

    Else whoever reads the folder as one table would find these recordings twice.

    Raises:
        OSError: the storage does not let it.
    """
    finished = store.finished()
    now = {source.url: source.identity(settings.text()) for source in sources}
    others = finished - set(now.values())
    told = store.table(RECORDINGS, others, ("recording", "source")).to_pylist() if others else []
    replaced = {row["recording"] for row in told if now.get(row["source"]) in finished}
    store.remove(replaced)
    return len(replaced)


def _tables(source: Source, identity: str, settings: Settings) -> dict[str, list[dict[str, Any]]]:
    from fes.analysis.pipeline import analyse, calibrations_of  # the numeric libraries load where the work is done
    from fes.memory import keep_freed_memory
    from fes.recording import read_recording

    keep_freed_memory()
    with local_copy(source) as path:
        recording, found = calibrations_of(read_recording(path), level=settings.level)
        result = analyse(recording, found.calibrations, level=settings.level)
    subject = _subject(source, recording.subject, settings)
    of = {"recording": identity, "subject": subject}
    strides = [{**of, **_known(row)} for row in result.stride_rows()]
    valid = [row for row in strides if row["valid"]]
    qualities = [track.quality for track in recording.tracks.values()]
    row: dict[str, Any] = {
        "name": recording.name,
        "subject": subject,
        "reason": "; ".join(found.missing.values())[:LONGEST_REASON],
        "samples": sum(quality.samples for quality in qualities),
        "missing": sum(quality.missing for quality in qualities),
        "clipped": sum(quality.clipped for quality in qualities),
        "irregular": sum(quality.irregular for quality in qualities),
        "strides": len(strides),
        "valid_strides": len(valid),
        "duration_s": max(track.duration_s for track in recording.tracks.values()),
        "belt_speed_mps": recording.belt_speed_mps,
        "stride_time_s": _median([r["t_end_s"] - r["t_start_s"] for r in valid]),
    }
    row |= {name: _median([r[name] for r in valid if r[name] is not None]) for name in _MEANS}
    return {STRIDES: strides, EVENTS: [{**of, **_known(r)} for r in result.event_rows()], RECORDINGS: [row]}


def _subject(source: Source, stated: str, settings: Settings) -> str:
    """The sidecar's, else what the pattern finds, else the folder's name."""
    return stated or source.subject(settings.subject_from) or source.path.parent.name


def _known(row: Mapping[str, Any]) -> dict[str, Any]:
    return {key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in row.items()}


def _median(values: list[float]) -> float | None:
    return statistics.median(values) if values else None


def reason_of(error: Exception) -> str:
    """What went wrong in one line; the kind of an error that nobody foresaw."""
    first = str(error).split("\n", 1)[0]
    known = isinstance(error, CohortError | ValueError)
    return (first if known else f"{type(error).__name__}: {first}")[:LONGEST_REASON]
