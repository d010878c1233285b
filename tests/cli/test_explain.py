"""``fes explain``: of each refusal that docs/safety.md names, of guards, the walking judge and the tuner."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from replays import SETTINGS, bursts, cut, edit, keep, replay, trial
from test_one_process import run as closed_loop

from fes.cli import main
from fes.cli.replay import command as replayed_log
from fes.gate import SafetyGate
from fes.live.sensor_monitor import EXCHANGED
from fes.live.status import remedy
from fes.recording import Recording, Track, write_recording
from fes.session_log import SessionRecord, read_session
from fes.signals import (
    G_MPS2,
    NS_PER_S,
    Event,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimStatus,
    SystemFault,
    Vector3,
)
from statemachine.phases import Transition

LENGTH_S, FAULT_S = 24.0, 19.9  # in a burst of the bundled trial


def explained(log: Path, at_s: float, *more: str) -> dict[str, Any]:
    done = CliRunner().invoke(main, ["explain", str(log), "--at", f"{at_s:.3f}", "--json", "--no-page", *more])
    assert done.exit_code == 0, done.output
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def session_log(folder: Path, recording: Recording, settings: str = "", **options: Any) -> tuple[Path, SessionRecord]:
    path, session = folder / "walk.parquet", folder / "session.toml"
    write_recording(recording, path)
    session.write_text(settings or SETTINGS.read_text())
    record = replay(path, folder / "out", session, **options)
    (log,) = (folder / "out").glob("walk-*/session.feslog")
    return log, record


def origin_ns(record: SessionRecord) -> int:
    return min(int(samples.t_ns[0]) for samples in record.samples.values())


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SessionRecord]:
    return session_log(tmp_path_factory.mktemp("walked"), cut(trial("negard_patient2"), 0.0, LENGTH_S))


def spoilt(change: Callable[[Track, np.ndarray[Any, Any]], Track]) -> Recording:
    """The trial with what is changed from ``FAULT_S`` on."""

    def changed(track: Track) -> Track:
        return change(track, track.t_ns - track.t_ns[0] >= FAULT_S * NS_PER_S)

    return edit(cut(trial("negard_patient2"), 0.0, LENGTH_S), changed)


def scaled(acc: float) -> Recording:
    def change(track: Track, late: np.ndarray[Any, Any]) -> Track:
        return replace(track, acc_mps2=track.acc_mps2 * np.where(late, acc, 1.0)[:, None])

    return spoilt(change)


def turned(track: Track, late: np.ndarray[Any, Any]) -> Track:
    """As when the box is put another way round: two axes exchanged."""
    acc, gyr = track.acc_mps2.copy(), track.gyr_radps.copy()
    for values in (acc, gyr):
        values[late] = values[late][:, [2, 1, 0]] * [1.0, 1.0, -1.0]
    return replace(track, acc_mps2=acc, gyr_radps=gyr)


def saturated(track: Track, late: np.ndarray[Any, Any]) -> Track:
    """The force at the end of its range."""
    acc = track.acc_mps2.copy()
    acc[late, 0] = 4.0 * G_MPS2 - 1e-3 * (np.arange(late.sum()) % 7)
    return replace(track, acc_mps2=acc)


def frozen(track: Track, late: np.ndarray[Any, Any]) -> Track:
    first = int(np.argmax(late))
    acc, gyr = track.acc_mps2.copy(), track.gyr_radps.copy()
    acc[late], gyr[late] = acc[first], gyr[first]
    return replace(track, acc_mps2=acc, gyr_radps=gyr)


def silent(track: Track, late: np.ndarray[Any, Any]) -> Track:
    back = track.t_ns - track.t_ns[0] >= (FAULT_S + 0.3) * NS_PER_S
    return keep(track, ~late | back)


RANGES = """
[[sensors]]
sensor = "right_foot"
device = "xsens_can"
rate_hz = 500.0
acc_range_g = 4.0
gyr_range_dps = 2000.0
"""
SENSOR_FAULTS: dict[str, tuple[Callable[[], Recording], str]] = {
    "force in g": (lambda: scaled(acc=1 / G_MPS2), "unit"),
    "force scaled by g again": (lambda: scaled(acc=G_MPS2), "unit"),
    "force in mg": (lambda: scaled(acc=1000.0 / G_MPS2), "unit"),
    "axes exchanged": (lambda: spoilt(turned), "remounted"),
    "the same values again and again": (lambda: spoilt(frozen), "is frozen"),
    "at the end of its range": (lambda: spoilt(saturated), "is saturated"),
    "data too old": (lambda: spoilt(silent), "ms old"),
}


@pytest.mark.parametrize("kind", SENSOR_FAULTS)
def test_what_the_gate_tells_from_a_sensors_numbers(kind: str, tmp_path: Path) -> None:
    make, words = SENSOR_FAULTS[kind]
    log, record = session_log(tmp_path, make(), SETTINGS.read_text() + RANGES * ("range" in kind))
    (latch,) = [note for note in record.notes if note.severity == "fault"][:1]
    reason = latch.text.removeprefix("off until armed again: ")
    assert words in reason
    at_s = (latch.t_ns - origin_ns(record)) / NS_PER_S + 0.1
    found = explained(log, at_s)
    assert reason in found["gate"], "the very words of the log"
    assert remedy(reason) in found["gate"]
    assert remedy(reason), "something can be done about it"
    assert "since" in found["gate"]
    before = explained(log, at_s - 0.5)
    assert "The gate was armed" in before["gate"]


@dataclass
class Spoiler:
    """Events of a log, of which one thing is changed from an instant on; ``number`` counts its samples since."""

    change: Callable[[ImuSample, int], list[Event]]
    from_ns: int

    def __call__(self, events: Iterator[Event]) -> Iterator[Event]:
        number = 0
        for event in events:
            if isinstance(event, ImuSample) and event.t_ns >= self.from_ns:
                yield from self.change(event, number)
                number += 1
            else:
                yield event

    def into(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """What is run again from now on."""
        change = self

        class Spoilt(replayed_log.Reopened):
            def __init__(self, path: Path) -> None:
                super().__init__(path)
                self.events = change(self.events)

        monkeypatch.setattr(replayed_log, "Reopened", Spoilt)


def stamped(sample: ImuSample, by_ns: int) -> list[Event]:
    return [sample._replace(t_sensor_ns=sample.t_sensor_ns + by_ns)]


def told(status: StimStatus | StimAlive, sample: ImuSample, number: int) -> list[Event]:
    return [sample, replace(status, t_ns=sample.t_ns)] if number == 0 else [sample]


def status(**fields: Any) -> StimStatus:
    return StimStatus(
        0,
        **{"channel": 0, "counter": 0, "on": True, "current_ma": 1.0, "pulse_width_us": 100.0, "frequency_hz": 40.0}
        | fields,
    )


def restarted(sample: ImuSample, number: int) -> list[Event]:
    return [sample, StimAlive(sample.t_ns, 77 + (number > 0), 0)] if number < 2 else [sample]


def noisy(values: Vector3, number: int, size: float) -> Vector3:
    """Alive, and telling of nothing."""
    x, y, z = (value + size * math.sin(1.7 * number + axis) for axis, value in enumerate(values))
    return x, y, z


def once(number: int, *events: Event) -> list[Event]:
    return list(events) if number == 0 else list(events[:1])


def unasked(sample: ImuSample, number: int) -> list[Event]:
    """Pulses counted in stance, long after the burst."""
    more = replace(status(on=False, current_ma=0.0, pulses=12), t_ns=sample.t_ns)
    return [sample, more] if number == 800 else [sample]


def silent_in_stance(sample: ImuSample, number: int) -> list[Event]:
    return [] if 650 <= number < 830 else [sample]


def hanging(sample: ImuSample, number: int, *, felt: bool) -> list[Event]:
    """A pendulum of 0.7 rad; ``felt``: its accelerometer feels gravity go through it."""
    t_s = number / 500.0
    tilt, turn, alive = 0.7 * math.sin(6.0 * t_s), 4.2 * math.cos(6.0 * t_s), 0.02 * math.sin(9e4 * t_s)
    acc = (-G_MPS2 * math.sin(tilt) * felt + alive, alive, G_MPS2 * math.cos(tilt))
    return [sample._replace(acc_mps2=acc, gyr_radps=(alive, turn, -alive))]


def stuck(sample: ImuSample, number: int) -> list[Event]:
    """The accelerometer's x axis."""
    _, y, z = sample.acc_mps2
    return [sample._replace(acc_mps2=(1.0 + 0.1 * math.sin(1e5 * number), y, z))]


def larger(sample: ImuSample, number: int) -> list[Event]:
    x, y, z = (1.15 * value for value in sample.acc_mps2)
    return [sample._replace(acc_mps2=(x, y, z))]


def deaf_accelerometer(sample: ImuSample, number: int) -> list[Event]:
    return [sample._replace(acc_mps2=noisy((0.0, 0.0, G_MPS2), number, 0.02))]


def deaf_gyroscope(sample: ImuSample, number: int) -> list[Event]:
    return [sample._replace(gyr_radps=noisy((0.0, 0.0, 0.0), number, 0.002))]


def one_triad_frozen(sample: ImuSample, number: int) -> list[Event]:
    return [sample._replace(acc_mps2=(1.0, 2.0, 9.0))]


def degrees(gyr: Vector3) -> Vector3:
    x, y, z = map(math.degrees, gyr)
    return x, y, z


EVENT_FAULTS: dict[str, tuple[Callable[[ImuSample, int], list[Event]], str]] = {
    "a clock that jumps back": (lambda s, n: stamped(s, -NS_PER_S), "'s clock went back by"),
    "a clock that jumps ahead": (lambda s, n: stamped(s, NS_PER_S), "'s clock went ahead by"),
    "stamps out of order": (lambda s, n: stamped(s, -12_000_000 * (n % 5 == 0)), "time stamps are out of order"),
    "rate in degrees": (
        lambda s, n: [s._replace(gyr_radps=degrees(s.gyr_radps))],
        "is its unit °/s",
    ),
    "no numbers": (lambda s, n: [s._replace(gyr_radps=(float("nan"), 0.0, 0.0))], "non-finite sample"),
    "an accelerometer that feels nothing": (deaf_accelerometer, "its accelerometer does not feel it"),
    "a gyroscope that feels nothing": (deaf_gyroscope, "does not feel it"),
    "one triad frozen": (one_triad_frozen, "is frozen"),
    "one axis that feels no turn": (lambda s, n: hanging(s, n, felt=False), "x axis does not feel it: stuck?"),
    "one axis stuck": (stuck, "an axis stuck, scaled, its unit?"),
    "scaled at rest": (larger, "at rest, gravity is 9.8: is it scaled?"),
    "dangling": (lambda s, n: hanging(s, n, felt=True), "does it dangle?"),
    "silent in stance": (silent_in_stance, "what comes now may be late"),
    "late by radio": (lambda s, n: [s._replace(t_ns=s.t_ns + 60_000_000)], "old by the sensor's own clock"),
    "feet exchanged": (lambda s, n: once(n, s, SystemFault(s.t_ns, EXCHANGED)), "are their sensors exchanged?"),
    "a computer that stalled": (
        lambda s, n: once(n, s, SystemFault(s.t_ns, "controller stalled for 300 ms")), "controller stalled",
    ),
    "pulses that nobody asked for": (unasked, "pulses that nobody asked for"),
    "armed by an act from the past": (
        lambda s, n: once(n, s, OperatorAct(s.t_ns - 50_000_000, OperatorAction.ARM)), "are dated 50 ms ahead",
    ),
    "a stimulator's fault": (lambda s, n: told(StimAlive(0, 1, 0, "supply low"), s, n), "stimulator fault: supply low"),
    "a channel's fault": (
        lambda s, n: told(status(fault="electrode off"), s, n), "stimulator fault on channel 0: electrode off",
    ),
    "more than may be delivered": (lambda s, n: told(status(current_ma=99.0), s, n), "stimulator delivers"),
    "a stimulator that restarted": (restarted, "stimulator restarted"),
    "time that runs backward": (
        lambda s, n: [s._replace(t_ns=s.t_ns - NS_PER_S)] if n == 3 else [s], "time ran backward by",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", EVENT_FAULTS)
def test_what_the_gate_tells_from_stamps_sensors_and_stimulator(
    kind: str, walked: tuple[Path, SessionRecord], monkeypatch: pytest.MonkeyPatch
) -> None:
    log, record = walked
    change, words = EVENT_FAULTS[kind]
    burst_ns = next(b.t_on_ns for b in bursts(record.commands) if b.t_on_ns > origin_ns(record) + 15 * NS_PER_S)
    # what needs a rest of 0.3 s begins while the patient still stands
    begin_ns = origin_ns(record) + 3 * NS_PER_S if "at rest" in kind else burst_ns + 50_000_000
    spoiler = Spoiler(change, begin_ns)
    spoiler.into(monkeypatch)
    at_s = (spoiler.from_ns - origin_ns(record)) / NS_PER_S
    assert "The gate was armed" in explained(log, at_s - 0.02)["gate"]
    found = explained(log, at_s + 3.0)
    assert words in found["gate"]
    assert "since" in found["gate"]
    assert remedy(words) or remedy(found["gate"]), "something can be done about it"
    assert found["gate"].endswith(remedy(found["gate"].split(": ", 1)[1]))
    assert "?." not in found["gate"]
    assert not found["channels"][0]["on"]


LIMITS = (  # as fes.gate words them; the plan keeps within them, so a gate is made to say them
    "off for 0.05 s, at least 0.1 s",
    "on for 3.01 s, limit 3 s",
    "20.1 mC within a minute, limit 20 mC",
    "rise to 30 mA too fast, at most 4 mA by now",
    "current 41 mA, limit 40 mA",
    "never together with calf, which is on",
    "the foot rests",
    "on for more than 2 swings of the foot",
    "on for 1.52 s without a swing of the foot",
)


def test_any_refusal_of_a_channel_is_told_in_its_own_words(
    walked: tuple[Path, SessionRecord], monkeypatch: pytest.MonkeyPatch
) -> None:
    log, record = walked
    begin_ns = origin_ns(record)
    own = bursts(record.commands)
    for number, reason in enumerate(LIMITS):
        burst = own[number % len(own)]
        refused_ns = burst.t_on_ns + 100_000_000
        with monkeypatch.context() as patch:
            patch.setattr(
                SafetyGate, "_refusal", lambda gate, t_ns, *_, why=reason, at=refused_ns: why if t_ns >= at else ""
            )
            found = explained(log, (refused_ns - begin_ns) / NS_PER_S + 0.05)
        (channel,) = found["channels"]
        assert (channel["refused"], channel["on"]) == (reason, False)
        assert f"the gate refused it: {reason}" in channel["why"] == found["sentences"][0]
        assert remedy(reason)
        assert remedy(reason) in channel["why"]


def test_not_armed(tmp_path: Path) -> None:
    log, _ = session_log(tmp_path, cut(trial("negard_patient2"), 0.0, LENGTH_S), arm_after_s=20.5)
    assert explained(log, 19.9)["gate"] == "The gate was not armed."


def turned_over(sample: ImuSample, number: int) -> list[Event]:
    """The sensor slips round by 77° within 0.8 s; a person arms again once it rests."""
    share = min(number / 400.0, 1.0)
    angle = 0.675 * (1.0 - math.cos(math.pi * share))
    rate_radps = 0.675 * math.pi * math.sin(math.pi * share) / 0.8
    c, s = math.cos(angle), math.sin(angle)
    (ax, ay, az), (gx, gy, gz) = sample.acc_mps2, sample.gyr_radps
    acc, gyr = (c * ax - s * az, ay, s * ax + c * az), (c * gx - s * gz, gy + rate_radps, s * gx + c * gz)
    slipped = sample._replace(acc_mps2=acc, gyr_radps=gyr)
    return [slipped, OperatorAct(sample.t_ns, OperatorAction.ARM)] if number == 600 else [slipped]


NOT_READY: dict[str, tuple[Callable[[ImuSample, int], list[Event]], float, float, str]] = {
    "no sample yet": (lambda s, n: [], 0.0, 1.0, "no data from right_foot"),
    "turned over at rest": (turned_over, 3.0, 4.5, "right_foot shows turned by more than 65° from its calibration"),
}


@pytest.mark.parametrize("kind", NOT_READY)
def test_arming_refused(kind: str, walked: tuple[Path, SessionRecord], monkeypatch: pytest.MonkeyPatch) -> None:
    log, record = walked
    change, from_s, at_s, words = NOT_READY[kind]
    spoiler = Spoiler(change, origin_ns(record) + round(from_s * NS_PER_S))
    spoiler.into(monkeypatch)
    found = explained(log, at_s)
    assert found["gate"].startswith(f"The gate was not armed: {words}")
    assert remedy(found["gate"])
    assert found["gate"].endswith(remedy(found["gate"]))


def test_every_transition_is_explained_as_fired_at_its_sample_and_as_not_before(
    walked: tuple[Path, SessionRecord],
) -> None:
    log, record = walked
    begin_ns = origin_ns(record)
    for transition in (Transition.T1, Transition.T2, Transition.T3, Transition.T4):
        change = [each for each in record.phases if each.transition is transition][3]
        at_s = (change.t_ns - begin_ns) / NS_PER_S
        then = explained(log, at_s + 0.0004)
        rows = [row for row in then["guards"] if row["guard"] == transition.name]
        assert all(row["asked"] and row["fires"] for row in rows)
        assert f"{transition.name} fired at this sample." in then["sentences"]
        before = explained(log, at_s - 0.03)
        rows = [row for row in before["guards"] if row["guard"] == transition.name]
        assert all(row["asked"] and not row["fires"] for row in rows)
        (said,) = [text for text in before["sentences"] if text.startswith(f"{transition.name} did not fire: ")]
        assert any(not row["holds"] and row["what"] in said for row in rows)
        assert not before["differs"]


def test_the_walking_judge_says_why_it_held_back(walked: tuple[Path, SessionRecord]) -> None:
    log, record = walked
    begin_ns = origin_ns(record)
    first_on_ns = bursts(record.commands)[0].t_on_ns
    swing = next(each for each in record.phases if each.transition is Transition.T2)
    assert swing.t_ns < first_on_ns, "the first stride is walked without stimulation"
    found = explained(log, (swing.t_ns - begin_ns) / NS_PER_S + 0.05)
    (channel,) = found["channels"]
    assert "not known to walk" in channel["why"]
    assert "no stride yet" in channel["why"]
    later = explained(log, (bursts(record.commands)[3].t_on_ns - begin_ns) / NS_PER_S + 0.2)
    assert "on with" in later["channels"][0]["why"]
    assert any("walks:" in text for text in later["sentences"])
    stance = explained(log, 17.5)
    assert "it is stimulated in pre-swing … loading response" in stance["sentences"][0] or stance["channels"][0]["on"]


def test_why_the_tuner_went_where_it_went(tmp_path: Path) -> None:
    _, log = closed_loop(tmp_path, "tuned.feslog", 26.0)
    record = read_session(log)
    changes = [note for note in record.notes if note.source == "tuning" and " → " in note.text]
    (tuned,) = explained(log, 25.95)["tuning"]
    assert [text for _, text in tuned["changes"]] == [note.text.removeprefix("channel 0: ") for note in changes]
    currents = [re.search(r"current [\d.]+ → ([\d.]+) mA", note.text) for note in changes]
    last_ma = [found[1] for found in currents if found][-1]
    assert f"current 12.0 → {last_ma} mA" in tuned["why"]
    assert f" in {len(changes)} changes" in tuned["why"]
    assert "changed nothing" in explained(log, 11.0)["tuning"][0]["why"]


def test_words_table_and_page(walked: tuple[Path, SessionRecord], tmp_path: Path) -> None:
    log, _ = walked
    page = tmp_path / "page.html"
    done: Result = CliRunner().invoke(main, ["explain", str(log), "--at", "20", "--page", str(page)])
    assert done.exit_code == 0, done.output
    for words in ("What the guards saw", "T3", "The gate was armed", "in a row that carry the foot forward"):
        assert words in done.output
    text = page.read_text()
    assert text.count("<svg") == 1
    assert "default-src 'none'" in text
    assert "What every guard saw" in text
    assert "http://" not in text.replace("http://www.w3.org", "")


def test_what_it_refuses(walked: tuple[Path, SessionRecord], tmp_path: Path) -> None:
    log, _ = walked
    for at in ("-1", "1000"):
        done = CliRunner().invoke(main, ["explain", str(log), "--at", at])
        assert done.exit_code == 2
        assert "outside the session" in done.output
    assert CliRunner().invoke(main, ["explain", str(tmp_path / "none.feslog"), "--at", "1"]).exit_code == 2
