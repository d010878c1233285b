"""A detector, a stride method or an event rule of somebody else, in a finished analysis.

A detector is ``detector(track, calibration)`` → ``{"FO": (K,), "IC": (L,)}``, foot off and initial contact in s from
the track's first sample. A stride method is ``method(track, calibration, t_start_s, t_end_s)`` → stride lengths (M,)
in m of the strides between these times (M,), NaN where it knows none. An event rule is ``rule(calibration)`` → a
function that gets sample after sample, ``(t_s, acc_mps2 (3,), gyr_radps (3,))``, and says "FO", "IC" or None: it cannot
look ahead.

``track`` and ``calibration`` are a
:class:`fes.recording.Track` and what :func:`fes.calibrate` found for its sensor.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fes.analysis.results import Analysis
from fes.estimation.events.causal import Decision, OnlineEvent
from fes.estimation.events.offline import GaitEvents
from fes.extensions import ExtensionError, load_extension
from fes.recording import Track
from fes.recording.chunks import NEVER_NS
from fes.recording.tracks import newer_samples
from fes.signals import NS_PER_S, FloatArray, IntArray, StrideResult

Detector = Callable[[Track, Any], Mapping[str, npt.ArrayLike]]
EventRule = Callable[[Any], Callable[[float, FloatArray, FloatArray], str | None]]
StrideMethod = Callable[[Track, Any, FloatArray, FloatArray], npt.ArrayLike]
UNKNOWN_LENGTH = "the stride method gave no length"


def with_own_methods(
    analyses: Iterable[Analysis],
    detector: str | Detector | None = None,
    stride_method: str | StrideMethod | None = None,
    event_rule: EventRule | None = None,
) -> Iterator[Analysis]:
    """The analyses with events and stride lengths by these functions, or entry points' names; None keeps our own.

    Phases, the path and clearance stay as they are: they do not rest on the events found off-line. What an event rule
    says is put beside those events, with its delay.

    Raises:
        ExtensionError: there is no such part, or what it gave is no such result.
    """
    find, found_by = _part("detector", detector)
    measure, measured_by = _part("stride method", stride_method)
    rules: dict[str, _RunningRule] = {}
    for analysis in analyses:
        found = analysis
        if find is not None:
            found = replace(found, events={foot: _events(found, foot, find, found_by) for foot in found.events})
        if measure is not None:
            found = replace(found, measured_strides=_strides(found, measure, measured_by))
        if event_rule is not None:
            for foot in found.events:
                rule = rules.setdefault(foot, _RunningRule(found, foot, event_rule))
                found.causal_events[foot] = [*found.causal_events.get(foot, []), *rule.decisions(found)]
        yield found


class _RunningRule:
    """One foot's event rule, which goes on from part to part of a long recording."""

    def __init__(self, analysis: Analysis, foot: str, make: EventRule) -> None:
        if not callable(make):
            raise ExtensionError(f"event rule must be a function, is {type(make).__name__}")
        self._foot, self._name = foot, getattr(make, "__name__", type(make).__name__)
        self._begin_ns = self._newest_ns = int(analysis.recording.tracks[foot].t_sensor_ns[0])
        self._step = _called(self._name, make, analysis.calibrations[foot])
        if not callable(self._step):
            raise ExtensionError(f"event rule {self._name!r} must give a function, gave {type(self._step).__name__}")

    def decisions(self, analysis: Analysis) -> Iterator[tuple[str, Decision]]:
        """What it says of the samples that are newer than those before, up to the end of the analysis' own part."""
        t_ns, acc_mps2, gyr_radps = newer_samples(analysis.recording.tracks[self._foot])
        end_ns = NEVER_NS if analysis.chunk is None else analysis.chunk.end_ns
        rows = np.flatnonzero((t_ns >= self._newest_ns) & (t_ns <= end_ns))
        for row in rows.tolist():
            at_ns = int(t_ns[row])
            said = _called(self._name, self._step, (at_ns - self._begin_ns) / NS_PER_S, acc_mps2[row], gyr_radps[row])
            if said is not None:
                if said not in ("FO", "IC"):
                    raise ExtensionError(f"event rule {self._name!r} must say 'FO', 'IC' or None, said {said!r}")
                yield self._name, Decision(at_ns, OnlineEvent[said], at_ns)
            self._newest_ns = at_ns + 1


def _part(kind: str, given: Any) -> tuple[Any, str]:
    """The function and its name; (None, "") of None."""
    if given is None or callable(given):
        return given, getattr(given, "__name__", type(given).__name__)
    if not isinstance(given, str):
        raise ExtensionError(f"{kind} must be a function or a name, is {type(given).__name__}")
    return load_extension(kind, given), given


def _events(analysis: Analysis, foot: str, find: Detector, name: str) -> GaitEvents:
    """Swings from each FO to the first IC after it, before the next FO; what has no partner is left out."""
    track = analysis.recording.tracks[foot]
    times = _called(name, find, track, analysis.calibrations[foot])
    if not isinstance(times, Mapping) or not {"FO", "IC"} <= set(times):
        raise ExtensionError(f"detector {name!r} must give a mapping with FO and IC, gave {type(times).__name__}")
    fo_ns, ic_ns = (_times_ns(times[what], track, f"detector {name!r}: {what}") for what in ("FO", "IC"))
    following = np.append(fo_ns[1:], np.iinfo(np.int64).max)
    position = np.searchsorted(ic_ns, fo_ns, side="right")
    has = position < len(ic_ns)
    has[has] = ic_ns[position[has]] <= following[has]
    fo_ns, ic_ns = fo_ns[has], ic_ns[position[has]]
    rate = np.linalg.norm(track.gyr_radps, axis=1)
    spans = np.searchsorted(track.t_sensor_ns, np.column_stack((fo_ns, ic_ns)))
    mids = np.array([first + int(np.argmax(rate[first : last + 1])) for first, last in spans.tolist()], np.int64)
    return GaitEvents(fo_ns, track.t_sensor_ns[mids], ic_ns, np.zeros(len(fo_ns), np.bool_))


def _times_ns(times_s: npt.ArrayLike, track: Track, what: str) -> IntArray:
    """Increasing times on the sensor's clock."""
    try:
        seconds = np.sort(np.asarray(times_s, np.float64).reshape(-1))
    except (TypeError, ValueError) as error:
        raise ExtensionError(f"{what} must be times in s: {error}") from None
    begin_ns, end_ns = int(track.t_sensor_ns[0]), int(track.t_sensor_ns[-1])
    if not np.isfinite(seconds).all() or (len(seconds) and not 0 <= seconds[0] <= seconds[-1] <= track.duration_s):
        raise ExtensionError(f"{what} must lie within the recording, 0 to {track.duration_s:.3f} s from its beginning")
    return np.clip(begin_ns + np.round(seconds * NS_PER_S).astype(np.int64), begin_ns, end_ns)


def _strides(analysis: Analysis, measure: StrideMethod, name: str) -> list[StrideResult]:
    """All strides, the valid ones of feet with the method's length; one without a length is not valid."""
    strides = list(analysis.strides)
    for foot in sorted({stride.foot for stride in strides if stride.valid}):
        mine = [k for k, stride in enumerate(strides) if stride.foot == foot and stride.valid]
        track = analysis.recording.tracks[foot]
        ends_ns = np.array([(strides[k].t_start_ns, strides[k].t_end_ns) for k in mine], np.int64)
        start_s, end_s = ((ends_ns - int(track.t_sensor_ns[0])) / NS_PER_S).T
        given = _called(name, measure, track, analysis.calibrations[foot], start_s, end_s)
        try:
            lengths_m = np.asarray(given, np.float64)
        except (TypeError, ValueError) as error:
            raise ExtensionError(f"stride method {name!r} must give lengths in m: {error}") from None
        if lengths_m.shape != (len(mine),) or np.isinf(lengths_m).any() or (lengths_m < 0).any():
            raise ExtensionError(
                f"stride method {name!r} must give {len(mine)} lengths in m for {foot}, none below 0 or infinite; "
                f"their shape is {lengths_m.shape}"
            )
        for k, length_m, seconds in zip(mine, lengths_m.tolist(), (end_s - start_s).tolist(), strict=True):
            known = length_m == length_m
            strides[k] = replace(
                strides[k], stride_length_m=length_m, speed_mps=length_m / seconds, stride_length_sd_m=np.nan,
                valid=known, reason="" if known else UNKNOWN_LENGTH,
            )  # fmt: skip
    return strides


def _called(name: str, part: Callable[..., Any], *arguments: object) -> Any:
    """What somebody else's function gives; whatever it raises is told with its name."""
    try:
        return part(*arguments)
    except Exception as error:  # another's code
        raise ExtensionError(f"{name!r} failed: {type(error).__name__}: {error}") from error
