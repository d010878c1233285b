"""The CAN tests once more over genuine SocketCAN, in a guest kernel; skipped where that cannot be had."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from guest import NoGuest, run_in_guest

SUITE = [
    "tests/transports/test_can_transport.py",
    "tests/transports/test_socketcan.py",
]


def test_the_can_tests_pass_over_a_genuine_vcan0(tmp_path: Path) -> None:
    arguments = ["-m", "pytest", "-p", "no:cacheprovider", "--color=no", "-rA", *SUITE]
    try:
        status, output = run_in_guest(arguments, tmp_path, timeout_s=300)
    except NoGuest as reason:
        pytest.skip(str(reason))
    print(output)
    assert status == 0, output[-3000:]
    passed = re.findall(r"^PASSED (\S+)", output, re.MULTILINE)
    assert len(passed) >= 15, "the guest must really have run them"
    assert sum("test_socketcan.py" in name for name in passed) >= 4
