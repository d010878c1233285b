"""One whole replay held against what it gave when it was last looked at; ``pytest --update-golden`` accepts a change.

Held against it is what every command frame says on the wire, to the last step of its fields, and when. The session's
number, and the checksum over it, are left out: they follow from the recording's and the settings' own bytes. Commands
are made of 0.5 mA and of samples 2 ms apart, so the last bit of a floating-point library does not reach them unless a
threshold is met to the last bit; another hash is another thing that the patient feels.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from replays import MS, SETTINGS, Replays, bursts, write_cut

from drivers.stimulator.can_codec import COMMAND_ID, PROTOCOL_VERSION, Command, decode
from fes.cli.replay.command import Options, repeat, replay_recording
from fes.session_log import SessionRecord
from fes.signals import WireFrame

TRIAL = "negard_patient2"
GOLDEN = Path(__file__).with_name(f"{TRIAL}.json")
LISTED = 8


def said(frame: WireFrame) -> str:
    """What a command frame says, and when."""
    command = decode(frame.identifier, frame.data)
    assert isinstance(command, Command)
    levels = f"{command.current_ma:g} mA {command.pulse_width_us:g} us {command.frequency_hz:g} Hz"
    return (
        f"{frame.t_ns / MS:g} ms: channel {command.channel} {f'on {levels}' if command.on else 'off'}"
        f", issued at {command.issued_ms} ms, count {command.counter}"
    )


def result_of(record: SessionRecord) -> dict[str, Any]:
    """Readable numbers, every burst as [on ms, off ms, peak mA], and the hash of what every command frame says."""
    frames = [frame for frame in record.frames if frame.identifier == COMMAND_ID]
    begin = next(n for n, command in enumerate(record.commands) if command.on)
    return {
        "commands": len(frames),
        "strides": len(record.strides),
        "phase_changes": len(record.phases),
        "first_burst_frames": [said(frame) for frame in frames[begin : begin + 5]],
        "bursts": [[burst.t_on_ns // MS, burst.t_off_ns // MS, burst.peak_ma] for burst in bursts(record.commands)],
        "commands_sha256": hashlib.sha256("\n".join(map(said, frames)).encode()).hexdigest(),
    }


def differences(golden: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """What has changed, in words."""
    found = [
        f"{key.replace('_', ' ')}: golden {golden[key]}, now {now[key]}"
        for key in ("commands", "strides", "phase_changes")
        if golden[key] != now[key]
    ]
    before, after = golden["bursts"], now["bursts"]
    if len(before) != len(after):
        found.append(f"bursts: golden {len(before)}, now {len(after)}")
    for number, (was, is_now) in enumerate(zip(before, after, strict=False), start=1):
        what = [
            f"{name} {new - old:+g} {unit}"
            for name, old, new, unit in zip(("on", "off", "peak"), was, is_now, ("ms", "ms", "mA"), strict=True)
            if old != new
        ]
        if what:
            found.append(f"burst {number} at {was[0]} ms: {', '.join(what)}")
    if not found and golden["commands_sha256"] != now["commands_sha256"]:
        found.append("the same bursts, but other commands within them: the ramps' levels, or when they are sent")
    return found


@pytest.mark.requirement("SR-20")
def test_the_trial_gives_the_golden_frames(replays: Replays, request: pytest.FixtureRequest) -> None:
    now = result_of(replays.of(TRIAL))
    if request.config.getoption("--update-golden"):
        GOLDEN.write_text(as_text(now), encoding="utf-8")
    golden = json.loads(GOLDEN.read_text(encoding="utf-8"))
    found = differences(golden, now)
    more = [f"… and {len(found) - LISTED} more"] if len(found) > LISTED else []
    assert not found, "\n".join(
        [
            f"{TRIAL} does not give the golden frames:",
            *found[:LISTED],
            *more,
            "If that is meant: pytest --update-golden",
        ]
    )
    assert golden == now


@pytest.mark.slow
def test_plain_python_gives_the_golden_frames() -> None:
    test = f"{Path(__file__)}::{test_the_trial_gives_the_golden_frames.__name__}"
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", test],
        cwd=Path(__file__).parents[2],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-3000:]
    assert "1 passed" in done.stdout


def as_text(result: dict[str, Any]) -> str:
    """JSON with a burst a line, so that a change reads well in a review."""
    rows = ",\n    ".join(json.dumps(burst) for burst in result["bursts"])
    text = json.dumps({**result, "bursts": "BURSTS"}, indent=2)
    return text.replace('"BURSTS"', f"[\n    {rows}\n  ]") + "\n"


def test_differences_are_said_in_words() -> None:
    golden = {
        "commands": 10,  "strides": 3, "phase_changes": 12, "first_burst_frames": [], "commands_sha256": "a",
        "bursts": [[100, 200, 30.0], [300, 400, 30.0]],
    }  # fmt: skip
    assert differences(golden, golden) == []
    assert "other commands" in differences(golden, {**golden, "commands_sha256": "b"})[0]
    moved = {**golden, "commands_sha256": "b", "commands": 9, "bursts": [[120, 200, 29.5]]}
    assert differences(golden, moved) == [
        "commands: golden 10, now 9",
        "bursts: golden 2, now 1",
        "burst 1 at 100 ms: on +20 ms, peak -0.5 mA",
    ]


def test_a_log_of_another_protocol_version_is_told_as_such(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not as a difference in the first command's bytes, which says nothing."""
    options = Options(session=SETTINGS, out=tmp_path, stimulator="none", report=False, as_json=True)
    log = replay_recording(write_cut(tmp_path), options)
    assert repeat(log).difference == ""
    monkeypatch.setattr("fes.cli.replay.command.PROTOCOL_VERSION", PROTOCOL_VERSION + 1)
    words = f"version {PROTOCOL_VERSION}, this program speaks {PROTOCOL_VERSION + 1}"
    assert repeat(log).difference.endswith(words)
