"""Methods of an analysis that whoever replicates a paper may exchange; the defaults are those of every report.

Which zero-velocity detector, how a stride is integrated, whether the ZUPT-aided filter goes from sample to sample, and
the events as they would be known on-line (Kumar et al. 2015), beside those found off-line.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from fes.estimation.events.causal import Decision, OnlineEvent
from fes.estimation.events.offline import GaitEvents
from fes.estimation.strides.schema import Column
from fes.estimation.zupt.detectors import Detector
from fes.signals import NS_PER_S

FARTHEST_NS = 250_000_000  # an off-line event farther away is another one
CAUSAL_EVENT_COLUMNS = (
    Column("foot", str, "", "the foot's sensor"),
    Column("rule", str, "", "instants: ours; peaks: as printed; else a rule of your own", "Kumar et al. 2015"),
    Column("event", str, "", "IC, initial contact, or FO, foot off"),
    Column("t_known_s", float, "s", "when the decision was made"),
    Column("t_feature_s", float, "s", "when the feature was on which it rests, never later"),
    Column("t_offline_s", float, "s", "the event as found off-line"),
    Column("delay_s", float, "s", "from the off-line event to the decision; empty where none is within 0.25 s"),
)


@dataclass(frozen=True, slots=True)
class Methods:
    """What an analysis does it with.

    ``stride_method`` "constrained" is Negård et al.'s (2005) integration of each stride by itself, whose lengths are
    not fused with the path's.
    """

    # of zero velocity, for the path and the lengths fused with it (Skog et al. 2010)
    detector: Detector = Detector.SHOE
    stride_method: Literal["maximum_likelihood", "constrained"] = "maximum_likelihood"
    per_sample: bool = False  # the ZUPT-aided filter does not go over intervals of some hundredths of a second
    causal_events: bool = False  # also the events as they would be known on-line


def causal_event_rows(foot: str, decisions: Iterable[tuple[str, Decision]], events: GaitEvents) -> list[dict[str, Any]]:
    """One flat row per IC and FO decided, with the off-line event beside it; columns ``CAUSAL_EVENT_COLUMNS``."""
    offline = {OnlineEvent.IC: events.ic_ns, OnlineEvent.FO: events.fo_ns}
    rows = []
    for rule, decision in decisions:
        if decision.event in offline:
            known_ns, nearest_ns = offline[decision.event], None
            if len(known_ns):
                at_ns = int(known_ns[np.argmin(np.abs(known_ns - decision.t_feature_ns))])
                nearest_ns = at_ns if abs(at_ns - decision.t_feature_ns) <= FARTHEST_NS else None
            delay_ns = None if nearest_ns is None else decision.t_ns - nearest_ns
            times = (decision.t_ns, decision.t_feature_ns, nearest_ns, delay_ns)
            seconds = (None if t_ns is None else t_ns / NS_PER_S for t_ns in times)
            names = (column.name for column in CAUSAL_EVENT_COLUMNS)
            values = (foot, rule, decision.event.name, *seconds)
            rows.append(dict(zip(names, values, strict=True)))
    return sorted(rows, key=lambda row: (row["t_known_s"], row["rule"]))
