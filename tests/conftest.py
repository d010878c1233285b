"""What several test files share."""

from __future__ import annotations

import pytest
from replays import Replays


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--update-golden", action="store_true", help="accept today's results as the golden ones")


@pytest.fixture(scope="session")
def replays(tmp_path_factory: pytest.TempPathFactory) -> Replays:
    """Bundled trials replayed without a stimulator, each once for all tests."""
    return Replays(tmp_path_factory.mktemp("replays"))
