"""One recording of a cohort, in whichever process: fetched, analysed, kept. Whatever is wrong with it becomes a row."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

from fes import __version__
from fes.cohort.store import EVENTS, RECORDINGS, STRIDES, CohortError, Source, Store, local_copy
from fes.walk_record import finite_or_none

if TYPE_CHECKING:
    from fes.analysis.parameters.gait import GaitParameters

DONE: Final = "done"
FAILED: Final = "failed"
LONGEST_REASON: Final = 500
_MEANS: Final = ("stride_length_m", "speed_mps", "clearance_m")


@dataclass(frozen=True, slots=True)
class Settings:
    """What holds for every recording; ``level``: the ground is level; ``sync_clocks``: each foot has its own clock.

    ``subject_from``: a pattern that finds the subject in the address, where the sidecar names none.
    """

    level: bool = True
    subject_from: str = ""
    sync_clocks: bool = False

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

    OSError: the results cannot be kept; the recording counts as not done.
    """
    identity = source.identity(settings.text())
    try:
        tables = _tables(source, identity, settings)
    except Exception as error:  # one bad recording, however bad, must not stop the others
        return keep_failure(source, store, settings, reason_of(error))
    store.put(identity, tables)
    return Outcome(identity, source.url, DONE)


def keep_failure(source: Source, store: Store, settings: Settings, reason: str) -> Outcome:
    """Note a recording that cannot be analysed, or whose process died again and again."""
    row = _row(source, settings, FAILED, "", reason)
    store.put(row["recording"], {RECORDINGS: [row]})
    return Outcome(row["recording"], source.url, FAILED, reason)


def drop_replaced(store: Store, sources: Iterable[Source], settings: Settings) -> int:
    """Take away what earlier files, settings or programs left of recordings that are finished anew; how many.

    Else whoever reads the folder as one table would find these recordings twice.

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
    from fes.analysis.hemiparetic.sync import synchronised
    from fes.analysis.parameters.gait import gait_parameters
    from fes.analysis.pipeline import analyse, calibrations_of  # the numeric libraries load where the work is done
    from fes.config import Ground
    from fes.recording import read_recording
    from fes.recording.chunks import keep_freed_memory

    keep_freed_memory()
    with local_copy(source) as path:
        recording = read_recording(path)
        ground = recording.ground if settings.level else Ground(free=True)
        recording, found = calibrations_of(recording, incline=ground.incline)
        if settings.sync_clocks:
            recording, _ = synchronised(recording, found.calibrations)
        result = analyse(recording, found.calibrations, ground=ground)
    row = _row(source, settings, DONE, recording.subject, "; ".join(found.missing.values()))
    of = {"recording": identity, "subject": row["subject"]}
    strides = [{**of, **finite_or_none(row)} for row in result.stride_table()]
    valid = [row for row in strides if row["valid"]]
    qualities = [track.quality for track in recording.tracks.values()]
    counts = ("samples", "missing", "clipped", "irregular")
    row |= {name: sum(getattr(quality, name) for quality in qualities) for name in counts}
    row |= {
        "name": recording.name,
        "strides": len(strides),
        "valid_strides": len(valid),
        "duration_s": max(track.duration_s for track in recording.tracks.values()),
        "belt_speed_mps": recording.belt_speed_mps,
        "group": str(recording.extra.get("group", "")),
        "findings": " ".join(each.text for each in result.findings if each.level in ("warning", "alert")),
    }
    row |= finite_or_none(_of_both_feet(gait_parameters(result)))
    values = {name: [r[name] for r in valid if r[name] is not None] for name in _MEANS}
    values["stride_time_s"] = [r["t_end_s"] - r["t_start_s"] for r in valid]
    row |= {name: statistics.median(own) if own else None for name, own in values.items()}
    return {STRIDES: strides, EVENTS: [{**of, **finite_or_none(r)} for r in result.event_table()], RECORDINGS: [row]}


def _of_both_feet(gait: GaitParameters) -> dict[str, float]:
    """What takes both feet, and how much their strides vary: of the steady strides, NaN where it is not known.

    Symmetry is the size of Robinson's index, 0 where both feet do the same: which side is paretic is not known here.
    """
    steps = [value for own in gait.strides.values() for value in own["step_time_s"][own["steady"]].tolist()]
    steps = [value for value in steps if value == value]
    found = {"cadence_per_min": gait.walk.cadence_per_min, "step_time_s": statistics.median(steps or [math.nan])}
    for key in ("swing", "step_time"):
        both = gait.sides.get(f"{key}_s", None)
        found[f"{key}_symmetry_percent"] = abs(both.index_percent) if both is not None else math.nan
    for key, name in (("stride_time", "stride_time_s"), ("stride_length", "stride_length_common_m")):
        variations = [own[name].cv for own in gait.feet.values() if name in own and math.isfinite(own[name].cv)]
        found[f"{key}_cv_percent"] = 100.0 * statistics.fmean(variations) if variations else math.nan
    return found


def _row(source: Source, settings: Settings, status: str, subject: str, reason: str) -> dict[str, Any]:
    """What is known of any recording; ``subject``: the sidecar's, else by the pattern, else the folder's name."""
    subject = subject or source.subject(settings.subject_from) or source.path.parent.name
    known = {"recording": source.identity(settings.text()), "source": source.url, "fes_version": __version__}
    return {**known, "status": status, "reason": reason[:LONGEST_REASON], "subject": subject}


def reason_of(error: Exception) -> str:
    """What went wrong in one line; the kind of an error that nobody foresaw."""
    first = str(error).split("\n", 1)[0]
    known = isinstance(error, CohortError | ValueError)
    return (first if known else f"{type(error).__name__}: {first}")[:LONGEST_REASON]
