"""What a click in the report's signals tells of one instant: what the guards saw, and how gate and channels stood."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from itertools import count
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
from statemachine.terms import FLAG, Term, Terms, terms_of

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
    numbers, nothing = count(), Features._make([0.0] * len(Features._fields))
    return {
        "guards": [
            {
                "name": row.transition.name,
                "from": readable(row.source.name.lower()),
                "terms": _plain(terms_of(row.guard, nothing, Thresholds()), numbers),
            }
            for row in TABLE
        ]
        if traces
        else [],
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


def _plain(terms: Term | Terms, numbers: Iterator[int]) -> dict[str, Any]:
    """What of the terms is the same at every sample; each comparison has its number."""
    if isinstance(terms, Terms):
        return {"every": terms.every, "parts": [_plain(part, numbers) for part in terms.parts]}
    unit = "" if terms.unit in (FLAG, "–") else terms.unit
    return {"number": next(numbers), "what": terms.what, "sign": terms.sign, "unit": unit, "flag": terms.unit == FLAG}


def _foot(trace: GuardTrace, origin_ns: int) -> dict[str, Any]:
    """A foot's kept samples, packed: of each comparison what was seen, the limit, of what that is, and whether it held.

    The comparisons' ``columns`` (seen of all, then limits of all) are indices into ``values``, of which each has a
    number a sample, or, where that says the same, a number each time that thresholds change. ``holds`` has a bit for
    each comparison. ``limit_is``: from which row on, what differs from before.
    """
    begins, samples = [row for row, _ in trace.thresholds], len(trace.t_ns)
    blocks, limit_is, before = [], [], list[str]()
    for (row, thresholds), end in zip(trace.thresholds, [*begins[1:], samples], strict=True):
        x = Features(*trace.features[row:end].T)
        terms = [term for guard in TABLE for term in terms_of(guard.guard, x, thresholds).each()]
        kinds = [term.seen for term in terms], [term.limit for term in terms], [term.holds for term in terms]
        blocks.append(np.array([np.broadcast_to(each, end - row) for kind in kinds for each in kind]))
        now = [term.limit_is for term in terms]
        limit_is.append([row, {k: words for k, words in enumerate(now) if [words] != before[k : k + 1]}])
        before = now
    each = np.concatenate(blocks, axis=1).astype("<f4")
    values: dict[bytes, int] = {}
    columns = []
    for column in each[: 2 * len(before)]:
        few = column[begins]
        same = np.array_equal(np.repeat(few, np.diff([*begins, samples])), column)
        columns.append(values.setdefault((few if same else column).tobytes(), len(values)))
    return {
        "foot": readable(trace.foot),
        "t_s": _packed((trace.t_ns - origin_ns) / NS_PER_S, "<f8"),
        "phase": _packed(trace.phase, "<i1"),
        "fired": _packed(trace.fired, "<i1"),
        "columns": columns,
        "values": [base64.b64encode(value).decode("ascii") for value in values],
        "holds": _packed(np.packbits(each[2 * len(before) :].astype(bool), axis=0, bitorder="little").T, "u1"),
        "begins": begins,
        "limit_is": [each for each in limit_is if each[1]],
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
