"""Whatever the strides: within the bounds, no more than a step at a time, and never without permission."""

from __future__ import annotations

from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from tuning_plant import BOUNDS, Tuned, channel, stride, tuning

from fes.signals import StrideResult
from fes.stimulation.envelope import BurstParameters

EPSILON = 1e-6
EARLY = BOUNDS | {"extension_s": {"low": -0.1, "high": 0.2}}
STEPS = {"max_change_ma": 1.7, "max_change_us": 13.0, "max_change_s": 0.012}
NUMBERS = st.floats(-1.0, 1.0) | st.sampled_from([float("nan"), float("inf"), -float("inf"), 0.0, 0.02])
ACTS = st.sampled_from(["", "", "", "", "freeze", "resume", "accept"])


@st.composite
def anything(draw: st.DrawFn) -> tuple[dict[str, Any], float, float, str]:
    """A stride's fields, the charge, the intensity, and what a person does after it."""
    fields = {
        "toe_clearance_m": draw(NUMBERS),
        "pitch_deg": draw(st.floats(-60, 60)),
        "valid": draw(st.sampled_from([True, True, True, False])),
        "turn_rad": draw(st.sampled_from([0.0, 0.0, 0.0, 1.0])),
        "pre_swing_s": draw(st.floats(0.05, 0.45)),
        "swing_s": draw(st.floats(0.05, 0.45)),
        "stride_length_m": draw(st.sampled_from([0.8, 0.8, 0.1])),
        "t_loading_response_ns": draw(st.sampled_from([..., ..., None])),
    }
    return fields, draw(st.sampled_from([0.0, 100.0, 270.0])), draw(st.sampled_from([0.0, 0.3, 1.0])), draw(ACTS)


def made(number: int, fields: dict[str, Any]) -> StrideResult:
    return stride(number, **{name: value for name, value in fields.items() if value is not ...})


def values_of(parameters: BurstParameters) -> dict[str, tuple[float, ...]]:
    return {
        "current_ma": (parameters.current_ma,),
        "pulse_width_us": parameters.widths_us,
        "start_delay_s": (parameters.start_delay_s,),
        "extension_s": (parameters.extension_s,),
    }


STEP_OF = {
    "current_ma": STEPS["max_change_ma"],
    "pulse_width_us": STEPS["max_change_us"],
    "start_delay_s": STEPS["max_change_s"],
    "extension_s": STEPS["max_change_s"],
}


@settings(max_examples=80, deadline=None)
@given(
    st.lists(anything(), min_size=5, max_size=40),
    st.sampled_from(["run_to_run", "learning"]),
    st.sampled_from(["act", "suggest"]),
    st.sampled_from([BOUNDS, EARLY]),
)
def test_any_strides_leave_the_parameters_where_they_may_be(
    walked: list[tuple[dict[str, Any], float, float, str]], method: str, mode: str, bounds: dict[str, Any]
) -> None:
    asked: dict[str, Any] = {"timing": True, "pitch_at_contact_deg": {"low": -5.0, "high": 10.0}, "bounds": bounds}
    tuned = Tuned(channel(tuning(method=method, mode=mode, **asked, **STEPS)))
    tuner = tuned.tuner
    for number, (fields, charge_uc, intensity, act) in enumerate(walked):
        before, frozen = tuner.parameters, tuner.frozen
        reports = [
            report for report in tuned.walk(made(number, fields), charge_uc, intensity) if report.kind != "fault"
        ]
        report = next((report for report in reports if "response per charge" not in report.text), None)
        after = tuner.parameters
        for name, old in values_of(before).items():
            for was, now in zip(old, values_of(after)[name], strict=True):
                assert bounds[name]["low"] - EPSILON <= now <= bounds[name]["high"] + EPSILON
                at_once = name == "start_delay_s" and now == tuner.start.start_delay_s  # for another speed
                assert at_once or abs(now - was) <= STEP_OF[name] + EPSILON
        assert method == "learning" or max(after.widths_us) <= 300.0 + EPSILON  # the session's own width
        if not fields["valid"] or charge_uc == 0.0 or intensity == 0.0:
            assert tuner.frozen or (report is not None and report.skipped)
        if frozen == "on demand" or mode == "suggest":
            assert after == before
        if report is None or report.kind not in ("change", "roll_back", "skip"):
            assert after == before
        else:
            assert report.after == after
            assert report.text
        if act == "freeze":
            tuner.freeze(number)
        elif act == "resume":
            tuner.resume(number)
        elif act == "accept":
            pending, held = tuner.pending, tuner.parameters
            tuner.accept(number)
            assert tuner.parameters == (pending or held)
            for name, old in values_of(held).items():
                for was, now in zip(old, values_of(tuner.parameters)[name], strict=True):
                    at_once = name == "start_delay_s" and now == tuner.start.start_delay_s
                    assert at_once or abs(now - was) <= STEP_OF[name] + EPSILON
    tuner.roll_back(len(walked))
    assert tuner.parameters == tuner.start


@settings(max_examples=30, deadline=None)
@given(st.lists(anything(), min_size=5, max_size=30), st.sampled_from(["run_to_run", "learning"]))
def test_the_same_strides_give_the_same_words_and_changes(
    walked: list[tuple[dict[str, Any], float, float, str]], method: str
) -> None:
    def told() -> list[str]:
        tuned = Tuned(channel(tuning(method=method, timing=True)))
        for n, (fields, charge_uc, intensity, _) in enumerate(walked):
            tuned.walk(made(n, fields), charge_uc, intensity)
        return [repr(report) for report in tuned.said]

    assert told() == told()
