"""A piece of work, in whichever process, and what becomes of it; one recording of a cohort fetched, analysed, kept.

Whatever is wrong with it becomes a row.
"""

from __future__ import annotations

import math
import statistics
from abc import ABC, abstractmethod
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
Rows = dict[str, list[dict[str, Any]]]  # by table
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
    """How it went: the task's key, its name for people, ``done`` or ``failed`` with the reason."""

    identity: str
    url: str
    status: str
    reason: str = ""


@dataclass(frozen=True)
class Task(ABC):
    """One piece of work that keeps its own results in a store, wherever it is done: it must survive pickling."""

    store: Store

    @property
    @abstractmethod
    def key(self) -> str:
        """The name of its results; no two tasks have the same."""

    @property
    @abstractmethod
    def name(self) -> str:
        """For people."""

    @abstractmethod
    def tables(self) -> Rows:
        """Do it: rows by table."""

    @abstractmethod
    def row(self, status: str, reason: str = "") -> dict[str, Any]:
        """Of the store's last table, what is known whatever comes of it."""

    def done(self) -> Outcome:
        """Do it and keep its rows; what is wrong with it is kept as its reason.

        OSError: the results cannot be kept; it counts as not done.
        """
        try:
            tables = self.tables()
        except Exception as error:  # a bad recording or combination, however bad, must not stop the others
            return self.failed(reason_of(error))
        self.store.put(self.key, tables)
        return Outcome(self.key, self.name, DONE)

    def failed(self, reason: str) -> Outcome:
        """Note that it cannot be done, or that its process died again and again."""
        self.store.put(self.key, {self.store.last: [self.row(FAILED, reason[:LONGEST_REASON])]})
        return Outcome(self.key, self.name, FAILED, reason)


@dataclass(frozen=True)
class Analysis(Task):
    """One recording to be analysed."""

    source: Source
    settings: Settings

    @property
    def key(self) -> str:
        """The same for the same files, settings and program."""
        return self.source.identity(self.settings.text())

    @property
    def name(self) -> str:
        """Its address."""
        return self.source.url

    def row(self, status: str, reason: str = "", subject: str = "") -> dict[str, Any]:
        """What is known of any recording; ``subject``: the sidecar's, else by the pattern, else the folder's name."""
        subject = subject or self.source.subject(self.settings.subject_from) or self.source.path.parent.name
        known = {"recording": self.key, "source": self.source.url, "fes_version": __version__}
        return {**known, "status": status, "reason": reason, "subject": subject}

    def tables(self) -> Rows:
        """Its strides and events, and what it is on the whole."""
        from fes.analysis.hemiparetic.sync import synchronised
        from fes.analysis.parameters.gait import gait_parameters
        from fes.analysis.pipeline import analyse, calibrations_of  # numeric libraries load where the work is done
        from fes.config import Ground
        from fes.recording import read_recording
        from fes.recording.chunks import keep_freed_memory

        keep_freed_memory()
        with local_copy(self.source) as path:
            recording = read_recording(path)
            ground = recording.ground if self.settings.level else Ground(free=True)
            recording, found = calibrations_of(recording, incline=ground.incline)
            if self.settings.sync_clocks:
                recording, _ = synchronised(recording, found.calibrations)
            result = analyse(recording, found.calibrations, ground=ground)
        row = self.row(DONE, "; ".join(found.missing.values())[:LONGEST_REASON], recording.subject)
        of = {"recording": row["recording"], "subject": row["subject"]}
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
        return {
            STRIDES: strides,
            EVENTS: [{**of, **finite_or_none(r)} for r in result.event_table()],
            RECORDINGS: [row],
        }


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


def reason_of(error: Exception) -> str:
    """What went wrong in one line; the kind of an error that nobody foresaw."""
    first = str(error).split("\n", 1)[0]
    known = isinstance(error, CohortError | ValueError)
    return (first if known else f"{type(error).__name__}: {first}")[:LONGEST_REASON]
