"""What a click in the report's signals tells of one instant: what the guards saw, and how gate and channels stood."""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from fes.live.remedies import with_remedy
from fes.report.stimulation import ChannelInfo
from fes.report.summary import ReportData
from fes.report.text import readable
from fes.signals import NS_PER_S, OperatorAction
from fes.walk_record import WalkRecord
from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase, Transition
from statemachine.table import TABLE
from statemachine.terms import FLAG, Comparison, Comparisons, comparisons_of

if TYPE_CHECKING:
    from fes.evaluation.guard_trace import GuardTrace

LATCHED: Final = "off until armed again: "  # as fes.control.runner notes it
MOST_SPANS: Final = 5000  # of one channel's refusals


def moment_data(data: ReportData) -> dict[str, Any]:
    """Plain values for the script; ``feet`` is empty where the session's guards cannot be asked again."""
    origin_ns = data.origin_ns
    traces: list[GuardTrace] = []
    if data.record.header.get("calibration") and data.settings is not None:
        from fes.evaluation.guard_trace import guard_traces  # here, for it takes a second to load

        traces = guard_traces(data.record)
    return {
        "guards": [
            {
                "name": row.transition.name,
                "from": readable(row.source.name.lower()),
                "terms": _plain(comparisons_of(row.guard)),
            }
            for row in TABLE
        ]
        if traces
        else [],
        "features": Features._fields,
        "transitions": [each.name for each in Transition],
        "phases": [readable(phase.name.lower()) for phase in Phase],
        "feet": {readable(trace.sensor): _foot(trace, origin_ns) for trace in traces},
        "gate": [[round((t_ns - origin_ns) / NS_PER_S, 4), text] for t_ns, text in _gate(data.record, origin_ns)],
        "intensity": [
            [round((act.t_ns - origin_ns) / NS_PER_S, 4), act.value]
            for act in data.record.acts
            if act.action is OperatorAction.SET_INTENSITY
        ],
        "channels": {info.name: _channel(info, data) for info in data.channels},
    }


def _plain(terms: Comparison | Comparisons) -> dict[str, Any]:
    if isinstance(terms, Comparisons):
        return {"every": terms.every, "parts": [_plain(part) for part in terms.parts]}
    unit = "" if terms.unit in (FLAG, "–") else terms.unit
    shown = {"what": terms.what, "sign": terms.sign, "of": terms.limit_is, "unit": unit, "flag": terms.unit == FLAG}
    return shown | {"seen": terms.seen, "limit": terms.limit}


def _foot(trace: GuardTrace, origin_ns: int) -> dict[str, Any]:
    """A foot's kept samples; times and features as base64 of little-endian numbers of 64 and 32 bits."""
    before: dict[str, Any] = {}
    limits = []
    for row, thresholds in trace.thresholds:  # all at first, then what has changed
        now = thresholds._asdict()
        limits.append([row, {name: value for name, value in now.items() if before.get(name) != value}])
        before = now
    assert set(before) == set(Thresholds._fields)
    return {
        "foot": readable(trace.foot),
        "t_s": _packed((trace.t_ns - origin_ns) / NS_PER_S, "<f8"),
        "phase": _packed(trace.phase, "<i1"),
        "fired": _packed(trace.fired, "<i1"),
        "features": _packed(trace.features, "<f4"),
        "thresholds": limits,
        "walking": trace.walking,
        "same": trace.same,
    }


def _packed(values: Any, kind: str) -> str:
    return base64.b64encode(np.asarray(values).astype(kind).tobytes()).decode("ascii")


def _gate(record: WalkRecord, origin_ns: int) -> list[tuple[int, str]]:
    """From when on the gate was how, in the words of ``fes explain``."""
    acts = [
        (act.t_ns, act.action is OperatorAction.ARM)
        for act in record.acts
        if act.action in (OperatorAction.ARM, OperatorAction.DISARM)
    ]
    refused = [(command.t_ns, command.refused) for command in record.commands if command.refused[:9] == "not armed"]
    at = [t_ns for t_ns, _ in refused]
    states = [(-(2**62), "The gate was not armed.")]
    for t_ns, arms in acts:
        # arming that was refused shows in what the gate said next
        after = int(np.searchsorted(at, t_ns))
        later = next((other for other, _ in acts if other > t_ns), 2**62)
        failed = arms and after < len(at) and at[after] < later and refused[after][1]
        told = with_remedy(f"The gate was {failed}") if failed else "The gate was armed."
        states.append((t_ns, told if arms else "The gate was not armed."))
    for note in record.notes:
        if note.text.startswith(LATCHED):
            fault = note.text.removeprefix(LATCHED)
            since_s = (note.t_ns - origin_ns) / NS_PER_S
            states.append((note.t_ns, with_remedy(f"The gate was latched since {since_s:.3f} s: {fault}")))
    return sorted(states, key=lambda each: each[0])


def _channel(info: ChannelInfo, data: ReportData) -> dict[str, Any]:
    """When the channel is stimulated, and where the gate refused it: from when to when, why, and what to do."""
    spans: list[list[Any]] = []
    for command in data.record.commands:
        if command.channel != info.number:
            continue
        t_s = round((command.t_ns - data.origin_ns) / NS_PER_S, 4)
        if spans and spans[-1][1] is None:
            if spans[-1][2] == command.refused:
                continue
            spans[-1][1] = t_s
        if command.refused and len(spans) < MOST_SPANS:
            spans.append([t_s, None, command.refused, with_remedy(command.refused)])
    return {
        "foot": readable(info.foot),
        "sensor": readable(info.phase_sensor),
        "phases": [int(phase) for phase in info.phases],
        "window": f"{readable(info.start_phase)} … {readable(info.stop_phase)}",
        "refused": spans,
    }
