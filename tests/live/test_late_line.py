"""The wrong phase that a line late from its opening gives; ``benchmarks/safety/late_line.py`` measures it."""

from __future__ import annotations

import pytest

from benchmarks.safety.late_line import armed_again


@pytest.mark.requirement("SR-27")
def test_a_line_that_comes_back_late_by_06_s_gives_no_current_in_stance() -> None:
    """As the audit had it: without the test, current flows through stances."""
    without, honest = armed_again(0.6, proves=False), armed_again(0.0, proves=True)
    assert without.armed
    assert without.longest_ms > 400
    assert honest.armed
    assert honest.longest_ms < 40
    late = armed_again(0.6, proves=True)
    assert not late.armed
    assert late.wrong_ms == 0
    assert "a tap seen 605 ms after the key" in late.said
