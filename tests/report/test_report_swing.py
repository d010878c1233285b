"""Pitch and roll through the swing, in the report: which strides, which foot, which target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from report_records import channel, header, walk

from fes.report.figures import strides
from fes.report.figures.svg import Figure, Plot
from fes.report.page import render_report
from fes.report.summary import summarise_session
from fes.session_log import SessionRecord
from fes.signals import FloatArray, StrideResult

TUNED = {
    "mode": "act",
    "pitch_at_contact_deg": {"low": 4.0, "high": 25.0},
    "bounds": {
        "current_ma": {"low": 5.0, "high": 40.0},
        "pulse_width_us": {"low": 250.0, "high": 250.0},
        "start_delay_s": {"low": 0.0, "high": 0.0},
        "extension_s": {"low": 0.0, "high": 0.1},
    },
}


def session(roll_deg: Callable[[int], float] = lambda number: 0.0, count: int = 30) -> SessionRecord:
    """The left foot tuned and stimulated from stride 2 on, the right one not; a left stride rolls by so much."""
    record = walk(count)

    def rolled(stride: StrideResult) -> StrideResult:
        own = roll_deg(stride.number) if stride.foot == "left_foot" else 45.0
        return replace(stride, roll_rad=np.radians(np.full(len(stride.pitch_rad), own)))

    left = [command for command in record.commands if command.channel == 0]
    return replace(
        record,
        header=header([channel(0, "left_foot", "TA left", tuning=TUNED)]),
        strides=[rolled(stride) for stride in record.strides],
        commands=left,
        statuses=[status for status in record.statuses if status.channel == 0],
    )


def figures_of(record: SessionRecord) -> list[Figure]:
    return strides.swing_figures(summarise_session(record))


def test_pitch_and_roll_of_the_stimulated_foot_with_the_target_it_has() -> None:
    pitch, roll = figures_of(session())
    assert (pitch.title, roll.title) == ("Pitch through the swing, left foot", "Roll through the swing, left foot")
    for figure in (pitch, roll):
        assert "Dashed: the first 5 stimulated strides; solid: the last 10; mean ± SD." in figure.caption
    assert "Green: the target at contact, 4 to 25°." in pitch.caption
    assert "Green" not in roll.caption
    assert strides.BAND_COLOR in pitch.svg
    assert strides.BAND_COLOR not in roll.svg
    page = render_report(session())
    assert page.count("Roll through the swing, left foot") >= 1
    assert "through the swing, right foot" not in page


def test_the_evertors_target_is_drawn_as_inversion() -> None:
    bounds = TUNED["bounds"]
    everts = {"mode": "act", "eversion_at_contact_deg": {"low": -3.0, "high": 6.0}, "bounds": bounds}
    record = session()
    channels = [channel(0, "left_foot", "TA left", tuning=TUNED), channel(1, "left_foot", "Peronei", tuning=everts)]
    pitch, roll = figures_of(replace(record, header=header(channels)))
    assert "Green: the target at contact, -6 to 3°." in roll.caption
    assert "Green: the target at contact, 4 to 25°." in pitch.caption


def test_the_mean_is_of_the_first_five_and_of_the_last_ten(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[tuple[str, FloatArray, FloatArray]] = []

    class Seen(Plot):
        def line(self, x: FloatArray, y: FloatArray, color: str, **how: Any) -> None:
            drawn.append((self.label, x, y))

    monkeypatch.setattr(strides, "Plot", Seen)
    record = session(lambda number: 10.0 if number < 2 else float(number), count=30)  # stimulated: 2 … 29
    figures_of(record)
    first, last = (y for label, _, y in drawn if label.startswith("Roll"))
    assert first == pytest.approx(np.full(51, np.mean([2, 3, 4, 5, 6])))
    assert last == pytest.approx(np.full(51, np.mean(range(20, 30))))
    x = drawn[0][1]
    assert (x[0], x[-1]) == (0.0, 100.0)
    pitch = next(y for label, _, y in drawn if label.startswith("Pitch"))
    left = [stride for stride in record.strides if stride.foot == "left_foot"][2:7]
    for at, entry in ((0, "t_swing_ns"), (-1, "t_loading_response_ns")):
        shares = [(getattr(one, entry) - one.t_start_ns) / (one.t_end_ns - one.t_start_ns) for one in left]
        wanted = [
            np.interp(share, np.linspace(0, 1, 101), one.pitch_rad) for share, one in zip(shares, left, strict=True)
        ]
        assert pitch[at] == pytest.approx(np.degrees(np.mean(wanted)))


def test_what_is_not_there_is_not_drawn() -> None:
    record = session()
    old = [replace(stride, roll_rad=np.zeros(0)) for stride in record.strides]
    assert [figure.title for figure in figures_of(replace(record, strides=old))] == [
        "Pitch through the swing, left foot"
    ]
    bare = [replace(stride, pitch_rad=np.zeros(0), roll_rad=np.zeros(0)) for stride in record.strides]
    assert figures_of(replace(record, strides=bare)) == []
    assert figures_of(replace(record, commands=[], statuses=[])) == []
    dropped = [replace(stride, t_loading_response_ns=None) for stride in record.strides]
    assert figures_of(replace(record, strides=dropped)) == []
    few = replace(record, strides=[stride for stride in record.strides if stride.number < 5])
    assert "the first 3 stimulated strides; mean ± SD" in figures_of(few)[0].caption
