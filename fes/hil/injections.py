"""How each fault of the table is brought about, and how it is mended again."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from drivers.stimulator.can_codec import COMMAND_ID, OPEN_ID
from drivers.virtual.rogue import FRAMES_PER_S, Rogue, flipped, random_frames
from fes.hil.devices import SERIAL
from fes.hil.rig import CampaignBroken, Rig
from fes.hil.settings import CHANNEL

Inject = Callable[[Rig, int], int]
"""Brings the fault about for the n-th time; returns when, by CLOCK_MONOTONIC in ns."""
Heal = Callable[[Rig], None]

DELAYS_S: Final = (0.06, 0.1, 0.2, 0.5)
STOPS_S: Final = (0.2, 1.0, 5.0)
STARVED_S: Final = 1.0
HOGS: Final = 3
HOGS_S: Final = 4.0
CUT_S: Final = 0.5
SILENT_S: Final = 1.3  # longer than a line may be silent before it is opened again
STARVING_PRIORITY: Final = 60
RANDOM_FRAMES: Final = 6000  # each time: two seconds' worth
MANY: Final = 100_000


def _nothing(rig: Rig) -> None:
    """Nothing to mend."""


def _sensor(name: str, value: float = 1.0) -> tuple[Inject, Heal]:
    return lambda rig, n: rig.devices.imu.fault(name, value), lambda rig: rig.devices.imu.clear()


def _stimulator(name: str, value: float, healed: float) -> tuple[Inject, Heal]:
    def heal(rig: Rig) -> None:
        rig.devices.node.tell(name, healed)

    return lambda rig, n: rig.devices.node.tell(name, value), heal


# --- the sensor ------------------------------------------------------------------------------------------


def _unplug_sensor(rig: Rig, n: int) -> int:
    return rig.devices.imu.fault("unplug")


def _plug_sensor(rig: Rig) -> None:
    rig.watch(SILENT_S)
    rig.devices.sensor_replugged()


def _unmute_sensor(rig: Rig) -> None:
    rig.watch(SILENT_S)
    rig.devices.imu.clear()


def _delay_sensor(rig: Rig, n: int) -> int:
    return rig.devices.imu.fault("delay", DELAYS_S[n % len(DELAYS_S)])


def _undrift(rig: Rig) -> None:
    rig.devices.imu.fault("drift", 0.0)


# --- the controller --------------------------------------------------------------------------------------


def _kill(rig: Rig, n: int) -> int:
    t_ns = time.monotonic_ns()
    os.kill(rig.session().pid, signal.SIGKILL)
    rig.session().process.wait()
    return t_ns


def _stop(rig: Rig, n: int) -> int:
    t_ns = time.monotonic_ns()
    os.kill(rig.session().pid, signal.SIGSTOP)
    rig.watch(STOPS_S[n % len(STOPS_S)])
    os.kill(rig.session().pid, signal.SIGCONT)
    return t_ns


def _starve(rig: Rig, n: int) -> int:
    """A process of higher priority takes the controller's processor for a second; the devices have the other one."""
    pid = rig.session().pid
    before = os.sched_getaffinity(pid)
    mine = max(before)
    code = (
        f"import os, time; os.sched_setaffinity(0, {{{mine}}}); "
        f"os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({STARVING_PRIORITY})); "
        f"print(time.monotonic_ns(), flush=True); end = time.monotonic() + {STARVED_S}\n"
        "while time.monotonic() < end: pass"
    )
    others = rig.bench.processes()
    for other in others:
        os.sched_setaffinity(other, before - {mine})
    os.sched_setaffinity(pid, {mine})
    try:
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=True)
    except (subprocess.SubprocessError, OSError) as error:
        raise CampaignBroken(f"the processor cannot be taken away: {error}") from error
    finally:
        for each in (pid, *others):
            with suppress(OSError):
                os.sched_setaffinity(each, before)
    return int(done.stdout)


def _hogs(rig: Rig, n: int) -> int:
    code = f"import time; end = time.monotonic() + {HOGS_S}\nwhile time.monotonic() < end: pass"
    t_ns = time.monotonic_ns()
    for _ in range(HOGS):
        hog = subprocess.Popen([sys.executable, "-c", code], start_new_session=True)
        rig.stack.callback(hog.wait)
        rig.stack.callback(hog.kill)
    return t_ns


def _full_disk(rig: Rig, n: int) -> int:
    """The log's file may not grow any more: its next write is refused, as a full disk's is."""
    log = rig.session().log()
    if log is None:
        raise CampaignBroken("the session has no log")
    writer = rig.session().child("fes.live.log_process")
    t_ns = time.monotonic_ns()
    resource.prlimit(writer, resource.RLIMIT_FSIZE, (log.stat().st_size, resource.RLIM_INFINITY))
    return t_ns


def _kill_child(module: str) -> Inject:
    def inject(rig: Rig, n: int) -> int:
        child = rig.session().child(module)
        t_ns = time.monotonic_ns()
        os.kill(child, signal.SIGKILL)
        return t_ns

    return inject


# --- the operator ----------------------------------------------------------------------------------------


def _space(rig: Rig, n: int) -> int:
    t_ns = time.monotonic_ns()
    rig.session().key(b" ")
    return t_ns


def _stop_file(rig: Rig, n: int) -> int:
    t_ns = time.monotonic_ns()
    rig.session().stop_file.touch()
    return t_ns


def _no_stop_file(rig: Rig) -> None:
    rig.session().stop_file.unlink(missing_ok=True)


def _stop_order(rig: Rig, n: int) -> int:
    t_ns = time.monotonic_ns()
    rig.order("stop")
    return t_ns


# --- the stimulator and its line -------------------------------------------------------------------------


def _cut(rig: Rig, n: int) -> int:
    if rig.devices.transport in SERIAL:
        return rig.devices.node.tell("unplug")
    if rig.devices.link is None:
        raise CampaignBroken("there is no line to cut")
    return rig.devices.link.tell("cut")


def _mend(rig: Rig) -> None:
    rig.watch(CUT_S)
    if rig.devices.transport in SERIAL:
        rig.devices.stimulator_replugged()
    elif rig.devices.link is not None:
        rig.devices.link.tell("cut", 0.0)


def _unplug_adapter(rig: Rig, n: int) -> int:
    if rig.devices.link is None:
        raise CampaignBroken("there is no adapter to unplug")
    return rig.devices.link.tell("unplug")


def _plug_adapter(rig: Rig) -> None:
    rig.watch(CUT_S)
    if rig.devices.link is not None:
        rig.devices.link.tell("unplug", 0.0)


def _rogue(rig: Rig) -> Rogue:
    if rig.devices.back is None:
        raise CampaignBroken("there is no CAN bus")
    return Rogue(rig.devices.back)


def _flips(rig: Rig, n: int) -> int:
    with _rogue(rig) as rogue:
        commands = rogue.on_commands(0.1)
        t_ns = time.monotonic_ns()
        rig.sent = sum(rogue.send(flipped(command)) for command in commands[:1])
    return t_ns


def _repeats(rig: Rig, n: int) -> int:
    """The burst's newest commands once more, the newest first."""
    with _rogue(rig) as rogue:
        commands = rogue.on_commands(0.12)
        t_ns = time.monotonic_ns()
        rig.sent = rogue.send(commands[-3:][::-1])
    return t_ns


def _old_session(rig: Rig, n: int) -> int:
    """Commands of the present session, sent again in the next one, while its patient stands and it is armed."""
    with _rogue(rig) as rogue:
        commands = rogue.on_commands(0.25)
        rig.end_session()
        rig.prepare(rig.variant)
        t_ns = time.monotonic_ns()
        rig.sent = rogue.send([command for _ in range(20) for command in commands], 500.0)
    return t_ns


def _random(rig: Rig, n: int) -> int:
    """Half of them anything, half with the identifiers that a controller uses."""
    t_ns = time.monotonic_ns()
    with _rogue(rig) as rogue:
        rogue.send(random_frames(RANDOM_FRAMES // 2, 2 * n), FRAMES_PER_S)
        rig.sent = rogue.send(random_frames(RANDOM_FRAMES // 2, 2 * n + 1, (COMMAND_ID, OPEN_ID)), FRAMES_PER_S)
    return t_ns


def _by_itself(rig: Rig, n: int) -> int:
    """Nothing is done: the walk does it."""
    return time.monotonic_ns()


INJECTIONS: Final[dict[str, tuple[Inject, Heal]]] = {
    "imu_silent": (_sensor("mute")[0], _unmute_sensor),
    "imu_unplugged": (_unplug_sensor, _plug_sensor),
    "imu_frozen": _sensor("stuck"),
    "imu_nan": _sensor("nan", MANY),
    "imu_saturated": _sensor("full"),
    "imu_unit_deg": _sensor("unit", 57.2958),
    "imu_unit_g": _sensor("unit", 1 / 9.80665),
    "stamp_doubled_once": _sensor("doubled", 1),
    "stamp_order_once": _sensor("reorder", 1),
    "stamps_doubled": _sensor("doubled", MANY),
    "clock_jump": _sensor("jump", 0.5),
    "clock_drift": (_sensor("drift", 100.0)[0], _undrift),
    "stale_data": (_delay_sensor, lambda rig: rig.devices.imu.clear()),
    "cpu_hogs": (_hogs, lambda rig: rig.watch(HOGS_S - 3.0)),
    "controller_killed": (_kill, _nothing),
    "controller_stopped": (_stop, _nothing),
    "controller_starved": (_starve, _nothing),
    "link_lost": (_cut, _mend),
    "adapter_unplugged": (_unplug_adapter, _plug_adapter),
    "node_reboot": (lambda rig, n: rig.devices.node.tell("reboot", 0.0), _nothing),
    "ack_missing": _stimulator("mute", 1.0, 0.0),
    "ack_late": _stimulator("delay", 0.15, 0.0),
    "delivered_differs": _stimulator("weak", CHANNEL, -1.0),
    "electrode": _stimulator("electrode", CHANNEL, -1.0),
    "commands_flipped": (_flips, _nothing),
    "commands_repeated": (_repeats, _nothing),
    "commands_old_session": (_old_session, _nothing),
    "random_frames": (_random, _nothing),
    "stop_key": (_space, _nothing),
    "stop_file": (_stop_file, _no_stop_file),
    "stop_control": (_stop_order, _nothing),
    "view_killed": (_kill_child("fes.live.view"), _nothing),
    "phase_stuck": (_by_itself, _nothing),
    "dose": (_by_itself, _nothing),
    "disk_full": (_full_disk, _nothing),
    "log_writer_killed": (_kill_child("fes.live.log_process"), _nothing),
}
