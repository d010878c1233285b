"""The dose ledger: what was delivered, per step, minute and session, and when the response per charge falls."""

from __future__ import annotations

import pytest

from fes.signals import StimStatus
from fes.stimulation.dose import LONGEST_HOLD_NS, SETTLING, WINDOW, DoseLedger, ElectrodeDose

SECOND = 1_000_000_000


def status(t_s: float, pulses: int = 1, charge_uc: float = 9.0, channel: int = 0, on: bool = True) -> StimStatus:
    return StimStatus(round(t_s * SECOND), channel, 0, on, 30.0, 300.0, 40.0, pulses, charge_uc)


def test_charge_is_booked_by_minute_and_session_and_channel() -> None:
    ledger = DoseLedger([0, 1])
    for t_s in (1.0, 59.0, 61.0):
        ledger.book(status(t_s))
    ledger.book(status(62.0, channel=1, charge_uc=4.0))
    ledger.book(status(63.0, channel=5, charge_uc=1.0))  # nobody's channel, and delivered all the same
    first = ledger.electrodes[0]
    assert first.session_uc == 27.0
    assert first.pulses == 3
    assert first.by_minute_uc == {0: 18.0, 1: 9.0}
    assert ledger.electrodes[1].session_uc == 4.0
    assert set(ledger.to_dict()) == {"0", "1", "5"}


def test_a_step_has_the_charge_between_its_ends() -> None:
    dose = ElectrodeDose(0)
    for t_s in (1.0, 1.5, 2.0, 2.5):
        dose.book(status(t_s))
    assert dose.close_step(SECOND, 2 * SECOND) == 18.0  # the answer at the very start belongs to the step before
    assert dose.close_step(2 * SECOND, 3 * SECOND) == 9.0
    summary = dose.to_dict()
    assert summary["steps"] == 2
    assert summary["median_step_uc"] == 13.5
    assert summary["greatest_step_uc"] == 18.0


def test_a_device_that_counts_nothing_is_estimated_from_what_it_says_it_delivers() -> None:
    """Its last answer holds until the next: a level that does not change is not said again."""
    dose = ElectrodeDose(0)
    uc_per_s = 30.0 * 300.0 * 1e-3 * 40.0
    dose.book(status(1.0, 0, 0.0))
    assert dose.session_uc == 0.0
    dose.book(status(1.5, 0, 0.0))
    assert dose.session_uc == pytest.approx(0.5 * uc_per_s)
    assert dose.estimated
    dose.book(status(1.6, 0, 0.0, on=False))
    dose.book(status(2.6, 0, 0.0))  # off until then
    assert dose.session_uc == pytest.approx(0.6 * uc_per_s)
    dose.book(status(60.0, 0, 0.0))  # no device holds that long
    assert dose.session_uc == pytest.approx((0.6 + 1e-9 * LONGEST_HOLD_NS) * uc_per_s)


@pytest.mark.parametrize("charge_uc", [float("nan"), -3.0, float("inf")])
def test_nonsense_is_not_booked(charge_uc: float) -> None:
    dose = ElectrodeDose(0)
    dose.book(status(1.0, 1, charge_uc))
    assert dose.session_uc == 0.0


def steps(dose: ElectrodeDose, response: float, charge_uc: float, number: int = WINDOW) -> list[str]:
    return [hint for _ in range(number) if (hint := dose.respond(response, charge_uc))]


def settled(response: float = 0.03, charge_uc: float = 200.0) -> ElectrodeDose:
    """After the first strides."""
    dose = ElectrodeDose(0)
    assert not steps(dose, response, charge_uc, SETTLING)
    return dose


def test_more_charge_for_the_same_response_is_hinted_once_a_level() -> None:
    dose = settled()
    assert not steps(dose, 0.03, 200.0)
    assert not steps(dose, 0.03, 240.0)
    hints = steps(dose, 0.03, 300.0, 30)
    assert len(hints) == 1
    assert "has fallen to 74%" in hints[0]
    assert "electrode" in hints[0]
    assert len(steps(dose, 0.01, 300.0, 40)) == 2  # on its way to 22 %


def test_more_charge_set_by_hand_that_gives_less_than_its_share_is_no_fatigue() -> None:
    dose = ElectrodeDose(0)
    assert not [hint for _ in range(2 * WINDOW) if (hint := dose.respond(0.025, 150.0, 0.5))]
    assert not [hint for _ in range(4 * WINDOW) if (hint := dose.respond(0.03, 300.0, 1.0))]
    assert [hint for _ in range(WINDOW) if (hint := dose.respond(0.02, 300.0, 1.0))]


def test_a_charge_that_is_still_being_raised_is_no_reference() -> None:
    """What a foot does of its own is not the charge's: at twice the charge half of it is no fatigue."""
    dose = settled(0.022, 100.0)
    raised = [100.0 + 8.0 * k for k in range(20)] + [260.0] * 20
    assert not [hint for charge_uc in raised if (hint := dose.respond(0.02 + 2e-5 * charge_uc, charge_uc))]
    assert len(steps(dose, 0.017, 260.0)) == 1


def test_a_leg_that_is_lifted_less_from_stride_to_stride_at_first_is_no_tired_muscle() -> None:
    """As all walks with a fixed setting begin: each of five fresh virtual patients was hinted at."""
    dose = ElectrodeDose(0)
    assert not steps(dose, 0.027, 290.0, 10)
    assert not steps(dose, 0.022, 290.0, 10)
    assert not steps(dose, 0.019, 290.0, 80)
    assert len(steps(dose, 0.012, 290.0)) == 1


def test_millimetres_are_no_tired_muscle() -> None:
    """A quarter of a toe's height near the ground is less than what is measured of it."""
    dose = settled(0.008)
    assert not steps(dose, 0.008, 200.0)
    assert not steps(dose, 0.005, 200.0, 40)
    assert len(steps(dose, 0.002, 200.0)) == 1


def test_the_minute_under_way_is_that_of_the_newest_answer() -> None:
    dose = ElectrodeDose(0)
    dose.book(status(50.0))
    assert dose.this_minute_uc == 9.0
    dose.book(status(61.0, 0, 0.0, on=False))
    assert dose.this_minute_uc == 0.0
    assert dose.session_uc == 9.0


def test_less_response_to_less_charge_is_no_fatigue() -> None:
    dose = settled()
    steps(dose, 0.03, 200.0)
    assert not steps(dose, 0.01, 120.0, 40)


def test_steps_without_charge_or_response_say_nothing() -> None:
    dose = settled()
    assert not steps(dose, float("nan"), 200.0)
    assert not steps(dose, 0.03, 0.0)
    assert not steps(dose, 0.001, 500.0)  # these are the first that count: the reference
