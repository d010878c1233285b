"""What the fault campaign requires where the sensor's samples come by radio."""

from __future__ import annotations

import pytest

from fes import limits
from fes.hil.scenarios import BY_NAME, SCENARIOS, by_radio

SILENT_MS = limits.RADIO.max_data_age_ms + 50.0


@pytest.mark.parametrize("name", ["imu_silent", "imu_unplugged", "imu_frozen"])
def test_a_sensors_fault_may_last_as_long_as_its_data_may_be_old(name: str) -> None:
    assert BY_NAME[name].deadline_ms < by_radio(BY_NAME[name]).deadline_ms == SILENT_MS


def test_the_lease_is_the_radios() -> None:
    assert by_radio(BY_NAME["controller_killed"]).deadline_ms < BY_NAME["controller_killed"].deadline_ms


def test_a_sample_late_by_less_than_latches_is_no_row_by_radio() -> None:
    assert min(by_radio(BY_NAME["imu_backlog"]).values) > 0.25 > min(BY_NAME["imu_backlog"].values)


def test_what_is_required_stays_but_for_the_time_it_may_take() -> None:
    for row in SCENARIOS:
        changed = by_radio(row)
        assert (changed.name, changed.effect, changed.response) == (row.name, row.effect, row.response)
        assert set(changed.values) <= set(row.values)
        assert changed.values or not row.values
