"""`fes run` as a process of its own between a simulated sensor and a simulated stimulator, each in theirs."""

from __future__ import annotations

import json
import os
import pty
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from replays import FES, MS, SETTINGS, cut, trial

from drivers.virtual.imu_spawn import ImuHandle, spawn_imu
from drivers.virtual.node_record import RecordEntry, read_record
from drivers.virtual.spawn import NodeHandle, spawn_node
from fes.calibrations import calibrate_drivers, save
from fes.live.status import Status
from fes.recording import Recording, Track, write_recording

STAND_S = 6
FOOT = "right_foot"
RATE_HZ = 500.0


def standing_first(recording: Recording, stand_s: int) -> Recording:
    """The recording with its first second, at rest, so many times before it."""

    def longer(track: Track) -> Track:
        n = int(track.rate_hz)
        rows = np.concatenate([np.tile(np.arange(n), stand_s), np.arange(n, len(track.t_ns))])
        t_ns = (np.arange(len(rows)) * 1e9 / track.rate_hz).astype(np.int64)
        return replace(
            track, t_ns=t_ns, t_sensor_ns=t_ns, acc_mps2=track.acc_mps2[rows], gyr_radps=track.gyr_radps[rows]
        )

    return replace(recording, tracks={name: longer(track) for name, track in recording.tracks.items()})


def prepare(folder: Path) -> tuple[Path, Path]:
    """A recording to play round and round (six seconds of standing, seven of walking), and its calibration."""
    whole = trial("negard_patient2")
    recording, calibration = folder / "loop.parquet", folder / "loop.calibration.json"
    write_recording(standing_first(cut(whole, 3.0, 11.0), STAND_S), recording)
    save(calibrate_drivers(whole), calibration)
    return recording, calibration


def session_text(node: NodeHandle, imu: ImuHandle) -> str:
    at_once = SETTINGS.read_text().replace("strides_before_start = 2", "strides_before_start = 0")
    return (
        f'{at_once}\n[bus]\ninterface = "{node.bus.interface}"\nchannel = "{node.bus.channel}"\n'
        f"[bus.options]\nport = {node.bus.options['port']}\n"
        f'[[sensors]]\nsensor = "{FOOT}"\ndevice = "xbus"\nport = "{imu.port}"\nrate_hz = {RATE_HZ}\n'
        "acc_range_g = 16\ngyr_range_dps = 2000\n[sensors.options]\nbaudrate = 921600\n"
    )


class LiveRun:
    """A running session; orders go over its control socket, statuses come back."""

    def __init__(self, process: subprocess.Popen[str], folder: Path, node: NodeHandle, imu: ImuHandle, keys: int):
        self.process = process
        self.folder = folder
        self.node = node
        self.imu = imu
        self.keys = keys
        self.link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.link.bind(str(folder / "me.sock"))
        self.link.settimeout(0.5)
        self.status: Status | None = None
        self.answers: list[dict[str, object]] = []

    @property
    def log(self) -> Path:
        return next(self.folder.glob("out/*/session.feslog"))

    def order(self, ask: str, **more: object) -> None:
        self.link.sendto(json.dumps({"ask": ask, **more}).encode(), str(self.folder / "c.sock"))

    def until(self, what: Callable[[Status], bool], repeat: str = "", timeout_s: float = 60.0) -> Status:
        """Wait for a status; with ``repeat`` order that again and again meanwhile."""
        end_s, next_s = time.monotonic() + timeout_s, 0.0
        while time.monotonic() < end_s:
            assert self.process.poll() is None, self.said()
            if time.monotonic() > next_s:
                next_s = time.monotonic() + 0.2
                try:
                    self.link.sendto(b"watch", str(self.folder / "c.sock"))
                    if repeat:
                        self.order(repeat, confirm=True)
                except OSError:
                    continue  # the socket is not there yet
            try:
                datagram = self.link.recv(65536)
            except TimeoutError:
                continue
            if b'"ok"' in datagram[:6]:
                self.answers.append(json.loads(datagram))
                continue
            self.status = Status.decode(datagram)
            if what(self.status):
                return self.status
        raise AssertionError(f"it did not come; last: {self.status}")

    def armed_at(self, intensity: float = 0.9) -> None:
        """Armed by hand, while the patient stands, and raised."""
        self.until(lambda status: status.state in ("armed", "running"), "arm")
        self.until(lambda status: status.intensity >= intensity, "up")

    def entries(self) -> list[RecordEntry]:
        assert self.node.record is not None
        return [entry for entry in read_record(self.node.record) if entry.channel == 0]

    def current_ma(self) -> float:
        entries = self.entries()
        return entries[-1].current_ma if entries else 0.0

    def in_mid_burst(self, timeout_s: float = 40.0) -> None:
        """Wait until the current is near its plateau."""
        end_s = time.monotonic() + timeout_s
        while self.current_ma() < 25.0:
            assert self.process.poll() is None, self.said()
            assert time.monotonic() < end_s, f"no burst; {self.status}"
            time.sleep(0.004)

    def off_after_ms(self, blow_ns: int, timeout_s: float = 5.0) -> float:
        """When the stimulator's output went off, ms after the blow, by the stimulator's own record."""
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            offs = [entry for entry in self.entries() if entry.t_ns >= blow_ns and entry.current_ma == 0.0]
            if offs:
                return (offs[0].t_ns - blow_ns) / MS
            time.sleep(0.004)
        raise AssertionError("it is still on")

    def stays_off(self, since_ns: int, seconds: float) -> bool:
        time.sleep(seconds)
        return not [entry for entry in self.entries() if entry.t_ns > since_ns and entry.current_ma > 0.0]

    def quit(self) -> str:
        self.order("quit")
        return self.end()

    def end(self) -> str:
        said, _ = self.process.communicate(timeout=30)
        return said

    def said(self) -> str:
        self.process.kill()
        return self.process.communicate(timeout=10)[0]


@contextmanager
def live_run(folder: Path, recording: Path, *options: str | Path, text: str = "") -> Iterator[LiveRun]:
    with (
        spawn_node(record=folder / "node.jsonl") as node,
        spawn_imu("xbus", sensor=FOOT, recording=recording, rate_hz=RATE_HZ) as imu,
    ):
        settings = folder / "live.toml"
        settings.write_text(session_text(node, imu) + text)
        master, slave = pty.openpty()
        process = subprocess.Popen(
            [*FES, "run", str(settings), "--out", str(folder / "out"), "--control", str(folder / "c.sock")]
            + [str(option) for option in options],
            stdin=slave,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        os.close(slave)
        run = LiveRun(process, folder, node, imu, master)
        try:
            yield run
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
                process.communicate(timeout=10)
            run.link.close()
            os.close(master)
