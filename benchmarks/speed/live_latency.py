"""The live road: a session's latency with two feet over two real transports, all ends in processes of their own.

The right foot's sensor is an Xsens on a pseudo-terminal, the left one's an x-IMU3 behind TCP, the stimulator is on CAN
(UDP multicast, or the loopback bus). `fes run` is armed by a scripted operator; the simulated patient walks and is
stimulated. Latency is from a sample's reading to the last byte written, by the clock in one pass, lost samples are
counted by the sensors' own stamps, and an idle loop measures beside it what this machine does to a process that does
nothing.

    python benchmarks/speed/live_latency.py [--minutes 1] [--rate 100] [--json FILE]
    python benchmarks/speed/live_latency.py --hogs 3                                     with busy processes beside it
    python benchmarks/speed/live_latency.py --python .venv-minimal/bin/python            the session in an environment
                                                                                         of its own, which is measured
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.lib.channels import channel, toml
from benchmarks.lib.command_line import parser_of
from benchmarks.speed.speed_row import Row, print_rows
from benchmarks.speed.speed_table import Spent, machine, result_of
from drivers.simulated.spawn import ImuKind, NodeHandle, free_bus, spawn_imu, spawn_node
from fes.calibration.recording import calibrate_phase_sensors, save
from fes.hil.baseline import Baseline
from fes.hil.controller import ControllerProcess, ScriptedOperator, uninterrupted
from fes.recording import Recording, write_recording
from fes.session_log import SessionRecord, read_session
from fes.signals import FOOT_SENSORS
from fes.simulation.sensor import ImuModel, Placement
from sim_inputs.generator.session import new_session
from sim_inputs.generator.trials import HEALTHY

LINES: tuple[tuple[str, ImuKind, Literal["pty", "tcp"]], ...] = (
    ("right_foot", "xbus", "pty"),
    ("left_foot", "ximu3", "tcp"),
)
GROUP, ALONE = "the live road", "the live road without extras"
MEAN_US, P99_US, P999_US = 60.0, 250.0, 3000.0
WITH_HOGS_P99_US = 2000.0
PLAIN_MEAN_US, PLAIN_P99_US, PLAIN_P999_US = 2000.0, 5000.0, 30000.0  # where numba is not installed
MOST_MB = 250.0  # of packages, for a session in the terminal
INSTALLERS = ("pip", "setuptools", "pkg_resources", "wheel", "_distutils_hack", "distutils-precedence")
ABOUT = """
import importlib.util, json, sysconfig
print(json.dumps([sysconfig.get_path("purelib"), importlib.util.find_spec("numba") is not None]))
"""
INTENSITY = 0.5

LIMITS = {
    "max_current_ma": 80.0, "max_charge_per_phase_uc": 24.0, "max_rise_ma_per_s": 800.0, "min_off_s": 0.05
}  # fmt: skip


def walk(before_s: float, strides: int, rate_hz: float) -> Recording:
    placements = {foot: Placement((0.07, 0.0, 0.068), (3.0, 21.0, -4.0)) for foot in FOOT_SENSORS}
    session = new_session("latency", 5, placements)
    session.stand(before_s)
    session.walk(dict.fromkeys(FOOT_SENSORS, HEALTHY), strides, 1.1, ramp_s=0.8, early=False)
    session.stand(1.5)
    return session.recording(rate_hz, ImuModel(), "simulated")


def settings(node: NodeHandle, ports: dict[str, str], rate_hz: float) -> str:
    """The session file."""
    text = toml("", {"name": "latency", "stimulation": {"intensity": INTENSITY, "strides_before_start": 1}})
    for number, foot in enumerate(FOOT_SENSORS):
        name = f"tibialis anterior {foot}"
        text += toml("[[channels]]", channel(foot, LIMITS, name=name, number=number, current_ma=40.0, rise_s=0.1))
        worn = {"sensor": foot, "device": "ximu3", "port": ports[foot], "rate_hz": rate_hz}
        worn |= {"acc_range_g": 16.0, "gyr_range_dps": 2000.0}
        if foot == "right_foot":
            worn |= {"device": "xbus", "options": {"baudrate": 921600}}
        text += toml("[[sensors]]", worn)
    bus = {"interface": node.bus.interface, "channel": node.bus.channel, "options": {"port": node.bus.options["port"]}}
    return text + toml("[bus]", bus)


def drive(operator: ScriptedOperator, controller: ControllerProcess, seconds: float) -> None:
    """Arm whenever it is not, raise, until the time is over or the session ends."""
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s and controller.alive:
        time.sleep(0.2)
        status = operator.receive_status()
        if status is None:
            continue
        if status.state in ("shadow", "fault"):
            operator.send_command("arm")
        elif status.intensity < INTENSITY:
            operator.send_command("up")
    operator.send_command("quit")
    controller.wait(20.0)


def environment(python: str) -> tuple[float, bool]:
    """How large an environment's packages are (MB), those that install apart; and whether it compiles."""
    told = subprocess.run([python, "-c", ABOUT], capture_output=True, text=True, check=True).stdout
    packages, compiles = json.loads(told)
    found = [each for each in Path(packages).iterdir() if not each.name.startswith(INSTALLERS)]
    files = [file for each in found for file in (each.rglob("*") if each.is_dir() else [each]) if file.is_file()]
    return sum(file.stat().st_size for file in files) * 1e-6, compiles


def rows_of(group: str, record: SessionRecord, hogs: int, rate_hz: float, compiled: bool) -> list[Row]:
    mean_us, p99_us, p999_us = (MEAN_US, P99_US, P999_US) if compiled else (PLAIN_MEAN_US, PLAIN_P99_US, PLAIN_P999_US)
    rows, us = [], np.asarray(record.latency_ns) * 1e-3
    for sensor, samples in record.samples.items():
        steps = np.diff(samples.t_sensor_ns) * 1e-9 * rate_hz
        lost = float(np.sum(np.maximum(np.round(steps) - 1, 0)))
        rows.append(Row(group, f"samples lost, {sensor}", lost, "", 0.0, note=f"of {len(samples.t_ns)}"))
    bursts = sum(command.on for command in record.commands)
    told = f"{len(us)} decisions, {bursts} commands with current, stalls {record.summary.get('stalls')}"
    p99, p999 = (float(value) for value in np.percentile(us, (99.0, 99.9)))
    of = f"2 × {rate_hz:g} Hz" + (f", {hogs} busy processes beside it" if hogs else "")
    rows.append(Row(group, f"latency, mean, {of}", float(us.mean()), "µs", None if hogs else mean_us, note=told))
    rows.append(Row(group, f"latency, 99 %, {of}", p99, "µs", WITH_HOGS_P99_US if hogs else p99_us))
    rows.append(Row(group, f"latency, 99.9 %, {of}", p999, "µs", None if hogs else p999_us))
    faults = [note.text for note in record.notes if note.severity == "fault"]
    rows.append(Row(group, "faults", float(len(faults)), "", None, note="; ".join(dict.fromkeys(faults))))
    return rows


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--rate", type=float, default=100.0, help="of each sensor, Hz")
    parser.add_argument("--hogs", type=int, default=0, help="busy processes beside it")
    parser.add_argument("--python", help="of the environment that the session runs in")
    options = parser.parse_args()
    size_mb, compiled = 0.0, True
    if options.python:
        size_mb, compiled = environment(options.python)
        os.environ["PYTHONSAFEPATH"] = "1"  # the session is what that environment has, not what lies in this folder
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        recording, calibration = folder / "walk.parquet", folder / "walk.calibration.json"
        write_recording(walk(4.0, 10, options.rate), recording)
        save(calibrate_phase_sensors(walk(4.0, 12, options.rate)), calibration)
        node = stack.enter_context(spawn_node(bus=free_bus(), record=folder / "node.jsonl"))
        ports = {}
        for foot, kind, line in LINES:
            imu = spawn_imu(kind, sensor=foot, recording=recording, rate_hz=options.rate, line=line)
            stack.callback(imu.stop)
            ports[foot] = imu.port
        path = folder / "session.toml"
        path.write_text(settings(node, ports, options.rate), encoding="utf-8")
        with uninterrupted():
            controller = ControllerProcess(path, calibration, folder / "run", python=options.python or sys.executable)
            stack.callback(controller.end)
        operator = controller.operator
        for _ in range(300):
            time.sleep(0.2)
            if (status := operator.receive_status()) is not None and status.state != "off":
                break
        baseline = Baseline()
        seconds = 60.0 * options.minutes
        code = f"import time\nend = time.monotonic() + {seconds}\nwhile time.monotonic() < end: pass"
        for _ in range(options.hogs):
            hog = subprocess.Popen([sys.executable, "-c", code])
            stack.callback(hog.wait)
            stack.callback(hog.kill)
        begin = Spent.now()
        drive(operator, controller, seconds)
        told = machine(begin.others_until(Spent.now()))
        print(f"baseline     {baseline.end()}")
        log = controller.log()
        if log is None:
            print(controller.printed())
            return 1
        group = ALONE if options.python else GROUP
        rows = rows_of(group, read_session(log), options.hogs, options.rate, compiled)
        if options.python:
            rows.append(Row(group, "packages of the session's environment", size_mb, "MB", MOST_MB))
    if options.json is not None:
        where = f" --python {options.python}" if options.python else ""
        result_of(f"speed/live_latency.py --minutes {options.minutes:g}{where}", rows, told).keep(options.json)
    return print_rows(rows, "The live road")


if __name__ == "__main__":
    sys.exit(main())
