"""What several test files share."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from examples import NIGHTLY
from hypothesis import HealthCheck, settings
from replays import Replays

from drivers.simulated import spawn as can_node_spawn
from fes.config import Bus

# "interface:channel": the bus that CAN tests use instead of multicast, see tests/drivers/test_socketcan_guest.py
if TEST_BUS := os.environ.get("FES_TEST_BUS", ""):
    plain_free_bus = can_node_spawn.free_bus

    def free_bus(interface: str = "") -> Bus:
        named, channel = TEST_BUS.split(":", 1)
        return plain_free_bus(interface) if interface else Bus(interface=named, channel=channel)

    can_node_spawn.free_bus = free_bus

# how long one example takes tells of the machine and what else runs on it, not of what is tested; the same examples
# each time, so that a change is judged by what it changed: new ones are for `make nightly`
settings.register_profile(
    "any machine", derandomize=not NIGHTLY, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("any machine")

if "MUTANT_UNDER_TEST" in os.environ:  # a busy machine must not look like a test that noticed the mutant
    settings.register_profile("mutants", derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
    settings.load_profile("mutants")


# their verdict depends on when the machine schedules a process: deadlines between processes, a killed one's end
LIVE = ("transports/", "live/test_live_log.py", "live/test_page_server.py")
LIVE += (
    "report/test_report_moments.py",  # a browser that a busy machine lets wait
    "live/test_live_source.py",
    "live/test_page_browser.py",
    "live/test_supervisor_process.py",
    "hil/test_hil_killed.py",
    "drivers/test_canopen_stimulator.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        if item.path.relative_to(here).as_posix().startswith(LIVE):
            item.add_marker("live")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--update-golden", action="store_true", help="accept today's results as the golden ones")


@pytest.fixture(scope="session")
def replays(tmp_path_factory: pytest.TempPathFactory) -> Replays:
    """Bundled trials replayed without a stimulator, each once for all tests."""
    return Replays(tmp_path_factory.mktemp("replays"))


@pytest.fixture
def collected() -> Iterator[None]:
    """For who makes a Dask client that finds no scheduler: it is closed when it is collected, and that waits for the
    lock under which a later one starts, for ever when it happens there."""
    yield
    gc.collect()
