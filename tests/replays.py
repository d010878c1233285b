"""Replaying recordings in this process, cutting and spoiling them, and reading what came of it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fes.cli.replay.command import Options, replay_recording
from fes.recording import Recording, Track, read_recording, write_recording
from fes.session_log import SessionRecord, read_session
from fes.session_log.codec import SampleRun, samples_of
from fes.session_log.framing import MAGIC, LogScan, RecordType, framed
from fes.signals import NS_PER_S, ImuSample, StimCommand

TRIALS = Path(__file__).resolve().parents[1] / "sim_inputs"
SETTINGS = TRIALS / "session.toml"
FES = (sys.executable, "-c", "from fes.cli import main; main(prog_name='fes')")
MS = 1_000_000


@dataclass(frozen=True)
class Burst:
    """Commands of one channel from the first that says on to the first that says off."""

    t_on_ns: int
    t_off_ns: int
    peak_ma: float


def bursts(commands: list[StimCommand], channel: int = 0) -> list[Burst]:
    found: list[Burst] = []
    began_ns, peak_ma = None, 0.0
    for command in commands:
        if command.channel != channel:
            continue
        if command.on:
            began_ns = command.t_ns if began_ns is None else began_ns
            peak_ma = max(peak_ma, command.current_ma)
        elif began_ns is not None:
            found.append(Burst(began_ns, command.t_ns, peak_ma))
            began_ns, peak_ma = None, 0.0
    assert began_ns is None, "a session ended with a channel on"
    return found


def edit(recording: Recording, change: Callable[[Track], Track]) -> Recording:
    """The recording with every track changed."""
    return replace(recording, tracks={name: change(track) for name, track in recording.tracks.items()})


def keep(track: Track, rows: Any) -> Track:
    """The track with these rows (indices or a mask) only."""
    return replace(
        track,
        t_ns=track.t_ns[rows],
        t_sensor_ns=track.t_sensor_ns[rows],
        acc_mps2=track.acc_mps2[rows],
        gyr_radps=track.gyr_radps[rows],
    )


def cut(recording: Recording, begin_s: float, end_s: float) -> Recording:
    """The samples that arrived from begin to end."""
    return edit(
        recording,
        lambda track: keep(track, (track.t_ns >= begin_s * NS_PER_S) & (track.t_ns < end_s * NS_PER_S)),
    )


def trial(name: str) -> Recording:
    path = TRIALS / f"{name}.parquet"
    return read_recording(path if path.is_file() else path.with_suffix(".csv"))


def write_cut(folder: Path, end_s: float = 15.0, begin_s: float = 0.0) -> Path:
    """Some seconds of a bundled trial as a recording of its own."""
    path = folder / "cut.parquet"
    write_recording(cut(trial("negard_patient2"), begin_s, end_s), path)
    return path


def replay(path: Path, out: Path, settings: Path = SETTINGS, **options: Any) -> SessionRecord:
    """What the session log holds after a replay in this process without a stimulator."""
    chosen: dict[str, Any] = {"stimulator": "none", "report": False, "as_json": True} | options
    return read_session(replay_recording(path, Options(session=settings, out=out, **chosen)))


class Replays:
    """Replays of bundled trials, each made when first asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._records: dict[str, SessionRecord] = {}

    def of(self, name: str) -> SessionRecord:
        if name not in self._records:
            path = TRIALS / f"{name}.parquet"
            path = path if path.is_file() else path.with_suffix(".csv")
            settings = self.folder / "both.toml"
            settings.write_text(both_feet(SETTINGS.read_text()))
            left_too = len(read_recording(path).tracks) == 2
            self._records[name] = replay(path, self.folder, settings if left_too else SETTINGS)
        return self._records[name]


def both_feet(text: str) -> str:
    """The bundled settings with the same channel on the left foot too, as number 1."""
    head, channel = text.split("[[channels]]")
    left = channel.replace("right", "left").replace("number = 0", "number = 1")
    return f"{head}[[channels]]{channel}\n[[channels]]{left}"


def run_fes(
    *arguments: str | Path, timeout_s: float = 60.0, env: dict[str, str] | None = None, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run the command as a user does, in a process of its own."""
    return subprocess.run(
        [*FES, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        env=os.environ | (env or {}),
        check=False,
        **options,
    )


def same_outputs(one: SessionRecord, other: SessionRecord) -> bool:
    """Whether two sessions sent the same frames at the same times and found the same phases and strides."""
    return (
        one.frames == other.frames
        and one.phases == other.phases
        and len(one.strides) == len(other.strides)
        and all(
            np.array_equal(a.trajectory_m, b.trajectory_m) and a.t_end_ns == b.t_end_ns
            for a, b in zip(one.strides, other.strides, strict=True)
        )
    )


def rewritten(log: Path, target: Path, change: Callable[[int, bytes], bytes]) -> Path:
    """The log with records changed and their checksums made right again."""
    records = [framed(kind, change(kind, bytes(payload))) for kind, payload in LogScan(log)]
    target.write_bytes(MAGIC + b"".join(records))
    return target


def one_sample_changed(change: Callable[[ImuSample], ImuSample], at_ns: int) -> Callable[[int, bytes], bytes]:
    def changed(kind: int, payload: bytes) -> bytes:
        if kind != RecordType.SAMPLES:
            return payload
        run = SampleRun()
        for sample in samples_of(memoryview(payload)):
            assert run.add(change(sample) if sample.t_ns == at_ns else sample)
        return run.close()

    return changed
