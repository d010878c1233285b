"""What a notebook prints of an object by itself: what it is and how much it holds, in a line."""

from __future__ import annotations

import pytest

import fes


@pytest.fixture(scope="module")
def objects() -> dict[str, object]:
    recording = fes.read(fes.bundled_file("example_csv.csv"))
    result = fes.analyse(recording)
    return {
        "Track": next(iter(recording.tracks.values())),
        "Recording": recording,
        "SensorCalibrations": fes.calibrate(recording),
        "Result": result,
        "GaitParameters": result.parameters,
        "Simulated": (simulated := fes.simulate(seconds=8.0)),
        "Truth": simulated.truth,
        "Analysis": (analysis := result.analysis()),
        "WalkRecord": analysis.walk_record(),
        "GaitEvents": next(iter(analysis.events.values())),
        "GroundPath": next(iter(analysis.paths.values())),
        "SessionRecord": fes.replay(recording).record,
    }


KINDS = (
    "Track", "Recording", "SensorCalibrations", "Result", "GaitParameters", "Simulated", "Truth", "Analysis",
    "WalkRecord", "GaitEvents", "GroundPath", "SessionRecord",
)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_an_object_tells_what_it_is_in_a_line(objects: dict[str, object], kind: str) -> None:
    text = repr(objects[kind])
    assert text.startswith(kind)
    assert "\n" not in text
    assert len(text) < 250


def test_a_recording_tells_its_sensors(objects: dict[str, object]) -> None:
    assert "_foot" in repr(objects["Recording"])
    assert " Hz" in repr(objects["Track"])
    assert "strides" in repr(objects["GaitParameters"])
