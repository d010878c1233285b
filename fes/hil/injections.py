"""How each fault of the table is brought about, and how it is mended again.

What a rogue on the CAN bus sends, no controller would; ``bench.sent`` is then how many frames with identifiers that the
stimulator listens to it must have refused.
"""

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final, TypeVar

from drivers.simulated.bus_guests import FRAMES_PER_S, Rogue, asks_for_current, flipped, random_frames
from drivers.simulated.spawn import NodeHandle
from drivers.stimulator.can_codec import COMMAND_ID, OPEN_ID, Frame
from fes.hil.campaign_bench import CampaignBench, CampaignBroken
from fes.hil.devices import SERIAL
from fes.hil.settings import CHANNEL
from fes.live.dashboard.process import press_stop
from fes.live.supervision import MODULE as SUPERVISOR

RANDOM_FRAMES: Final = 62_500  # each time: 21 seconds' worth, 1,000,000 in 16 attempts
TEND_EVERY: Final = 150
LATEST: Final = 40  # commands between one and its repetition: twice a count of 16 and more
REPEATS_S: Final = 3.0
ECHO_S: Final = 0.002  # what is sent to a multicast group comes back to its sender
PAIRS: Final = 10
STARVED_S: Final = 1.0
HOGS: Final = 3
HOGS_S: Final = 4.0
CUT_S: Final = 0.5
SILENT_S: Final = 1.3  # longer than a line may be silent before it is opened again
FROZEN_S: Final = 2.0
STARVING_PRIORITY: Final = 60
MANY: Final = 100_000

Found = TypeVar("Found")
Inject = Callable[[CampaignBench, int], int]
"""Brings the fault about for the n-th time; returns when, by CLOCK_MONOTONIC in ns."""
Heal = Callable[[CampaignBench], object]


def _needed(found: Found | None, what: str) -> Found:
    if found is None:
        raise CampaignBroken(f"there is no {what}")
    return found


def _rogue(bench: CampaignBench) -> Rogue:
    return Rogue(_needed(bench.devices.back, "CAN bus"))


def _link(bench: CampaignBench) -> NodeHandle:
    return _needed(bench.devices.link, "line between controller and stimulator")


def _log(bench: CampaignBench) -> Path:
    return _needed(bench.session().log(), "log of the session")


def flips(bench: CampaignBench, n: int) -> int:
    """One of the present session's commands, with every one and every two bits inverted."""
    with _rogue(bench) as rogue:
        commands = rogue.on_commands(0.1)
        t_ns = time.monotonic_ns()
        bench.sent = sum(rogue.send(flipped(command)) for command in commands[:1])
    return t_ns


def repeats(bench: CampaignBench, n: int) -> int:
    """After each command of the session an earlier one that asked for current: the newest itself, the one before …"""
    with _rogue(bench) as rogue:
        commands = [frame for frame in rogue.receive(0.1) if frame[0] == COMMAND_ID]
        lags = list(range(LATEST + 1))
        t_ns, end_s = time.monotonic_ns(), time.monotonic() + REPEATS_S
        while lags and time.monotonic() < end_s:
            heard = [frame for frame in rogue.receive(0.05, first_only=True) if frame[0] == COMMAND_ID]
            commands += heard
            lag = next((k for k in lags if k < len(commands) and asks_for_current(commands[-1 - k])), None)
            if heard and lag is not None:
                lags.remove(lag)
                bench.sent += rogue.send([commands[-1 - lag]])
                rogue.receive(ECHO_S)
    return t_ns


def exchange(bench: CampaignBench, n: int) -> int:
    """On the line between them, each pair of commands changes places."""
    t_ns = _link(bench).inject("reorder", PAIRS)
    bench.observe(1.0)
    bench.sent = PAIRS
    return t_ns


def old_session(bench: CampaignBench, n: int) -> int:
    """Commands of the present session, sent again in the next one, while its patient stands and it is armed."""
    with _rogue(bench) as rogue:
        commands = rogue.on_commands(0.25)
        bench.end_session()
        bench.prepare(bench.variant)
        t_ns = time.monotonic_ns()
        bench.sent = rogue.send([command for _ in range(20) for command in commands], 500.0)
    return t_ns


def random(bench: CampaignBench, n: int) -> int:
    """By turns one with any identifier and one with those that a controller uses; the patient walks on meanwhile."""

    def frames() -> Iterator[Frame]:
        anything = random_frames(RANDOM_FRAMES // 2, 2 * n)
        commands = random_frames(RANDOM_FRAMES // 2, 2 * n + 1, (COMMAND_ID, OPEN_ID))
        for number, pair in enumerate(zip(anything, commands, strict=True)):
            if number % TEND_EVERY == 0:
                bench.outputs()
                bench.keep_armed()
            yield from pair

    t_ns = time.monotonic_ns()
    with _rogue(bench) as rogue:
        bench.sent = rogue.send(frames(), FRAMES_PER_S) // 2
    return t_ns


def _nothing(bench: CampaignBench) -> None:
    """Nothing to mend; or the walk itself brings the fault about."""


def _after(seconds: float, heal: Heal) -> Heal:
    def wait_and_heal(bench: CampaignBench) -> None:
        bench.observe(seconds)
        heal(bench)

    return wait_and_heal


def _clear(bench: CampaignBench) -> None:
    """End the sensor's faults that last."""
    bench.equipment.imu.clear()


def _sensor(name: str, value: float = 1.0) -> Inject:
    return lambda bench, n: bench.equipment.imu.inject(name, value)


def _axis_stuck(first: int) -> Inject:
    """The axis that the attempt's value names holds its value, with noise: 1 is the triad's first."""
    return lambda bench, n: bench.equipment.imu.inject("held_alive", 1 << (first + round(bench.value) - 1))


def _late(bench: CampaignBench, n: int) -> int:
    """Samples come late, and say that they are not."""
    t_ns = bench.equipment.imu.inject("delay", bench.value)
    bench.equipment.imu.inject("jump", bench.value)
    return t_ns


def _backlog(bench: CampaignBench, n: int) -> int:
    """What the sensor's buffer has held back for the attempt's time comes all at once, as after bad reception."""
    t_ns = bench.equipment.imu.inject("backlog")
    bench.observe(bench.value)
    bench.equipment.imu.inject("backlog", 0.0)
    return t_ns


def _times(name: str) -> Inject:
    """One triad's values times the attempt's."""
    return lambda bench, n: bench.equipment.imu.inject(name, bench.value)


def _stimulator(name: str, value: float, off: float) -> tuple[Inject, Heal]:
    return lambda bench, n: bench.devices.node.inject(name, value), lambda bench: bench.devices.node.inject(name, off)


def _line(name: str) -> tuple[Inject, Heal]:
    """A fault of the line between controller and stimulator that ends after half a second."""
    heal = _after(CUT_S, lambda bench: _link(bench).inject(name, 0.0))
    return lambda bench, n: _link(bench).inject(name, 1.0), heal


# --- the controller --------------------------------------------------------------------------------------


def _kill(bench: CampaignBench, n: int) -> int:
    bench.orphans = bench.session().children()
    os.kill(bench.session().process.pid, signal.SIGKILL)
    t_ns = time.monotonic_ns()  # what holds this process up on its way to the kill is not the lease's delay
    bench.session().process.wait()
    return t_ns


def _stop(bench: CampaignBench, n: int) -> int:
    return _stopped(bench, bench.session().process.pid)


def _starve(bench: CampaignBench, n: int) -> int:
    """A process of higher priority takes the controller's processor for a second; the devices have the other one."""
    pid = bench.session().process.pid
    before = os.sched_getaffinity(pid)
    mine = max(before)
    code = (
        f"import os, time; os.sched_setaffinity(0, {{{mine}}}); "
        f"os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({STARVING_PRIORITY})); "
        f"print(time.monotonic_ns(), flush=True); end = time.monotonic() + {STARVED_S}\n"
        "while time.monotonic() < end: pass"
    )
    others = bench.equipment.processes()
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


def _hogs(bench: CampaignBench, n: int) -> int:
    code = f"import time; end = time.monotonic() + {HOGS_S}\nwhile time.monotonic() < end: pass"
    t_ns = time.monotonic_ns()
    for _ in range(HOGS):
        hog = subprocess.Popen([sys.executable, "-c", code], start_new_session=True)
        bench.stack.callback(hog.wait)
        bench.stack.callback(hog.kill)
    return t_ns


def _full_disk(bench: CampaignBench, n: int) -> int:
    """The log's file may not grow any more: its next write is refused, as a full disk's is."""
    log = _log(bench)
    writer = bench.session().child("fes.live.log_process")
    t_ns = time.monotonic_ns()
    resource.prlimit(writer, resource.RLIMIT_FSIZE, (log.stat().st_size, resource.RLIM_INFINITY))
    return t_ns


def _log_removed(bench: CampaignBench, n: int) -> int:
    """Somebody clears the folder: the file's name is gone, and what is written goes nowhere that can be found."""
    log, t_ns = _log(bench), time.monotonic_ns()
    log.unlink()
    return t_ns


def _to_child(module: str, do: Callable[[CampaignBench, int], int]) -> Inject:
    """Something happens to one of the session's processes; ``do`` returns when."""
    return lambda bench, n: do(bench, bench.session().child(module))


def _killed(bench: CampaignBench, pid: int) -> int:
    os.kill(pid, signal.SIGKILL)
    return time.monotonic_ns()


def _stopped(bench: CampaignBench, pid: int) -> int:
    """It reads nothing for a while, and everything that it is sent has to stay somewhere or be given up."""
    os.kill(pid, signal.SIGSTOP)
    t_ns = time.monotonic_ns()
    try:
        bench.observe(bench.value or FROZEN_S)
    finally:
        os.kill(pid, signal.SIGCONT)
    return t_ns


def _at_once(do: Callable[[CampaignBench], object]) -> Inject:
    """Something is done whose moment is the one just before it."""

    def inject(bench: CampaignBench, n: int) -> int:
        t_ns = time.monotonic_ns()
        do(bench)
        return t_ns

    return inject


def _stop_on_page(bench: CampaignBench, n: int) -> int:
    port = bench.session().page_port()
    return _at_once(lambda bench: press_stop(port))(bench, n)


# --- the stimulator's line -------------------------------------------------------------------------------


def _cut(bench: CampaignBench, n: int) -> int:
    if bench.devices.transport in SERIAL:
        return bench.devices.node.inject("unplug")
    return _link(bench).inject("cut")


def _mend(bench: CampaignBench) -> None:
    if bench.devices.transport in SERIAL:
        bench.devices.stimulator_replugged()
    else:
        _link(bench).inject("cut", 0.0)


INJECTIONS: Final[dict[str, tuple[Inject, Heal]]] = {
    "imu_silent": (_sensor("mute"), _after(SILENT_S, _clear)),
    "imu_unplugged": (_sensor("unplug"), _after(SILENT_S, lambda bench: bench.equipment.sensor_replugged())),
    "imu_frozen": (_sensor("stuck"), _clear),
    "imu_force_frozen": (_sensor("held", 7), _clear),
    "imu_rate_frozen": (_sensor("held", 56), _clear),
    "imu_force_dead": (_sensor("held_alive", 7), _clear),
    "imu_rate_stuck": (_sensor("held_alive", 56), _clear),
    "imu_force_axis_stuck": (_axis_stuck(0), _clear),
    "imu_rate_axis_stuck": (_axis_stuck(3), _clear),
    "imu_force_scaled": (_times("force_scaled"), _clear),
    "imu_rate_scaled": (_times("rate_scaled"), _clear),
    "imu_dangling": (_sensor("dangling"), _clear),
    "imu_late": (_late, _clear),
    "imu_backlog": (_backlog, _clear),
    "imu_nan": (_sensor("nan", MANY), _clear),
    "imu_inf": (_sensor("inf", MANY), _clear),
    "imu_unsound": (_sensor("unsound", MANY), lambda bench: bench.equipment.imu.inject("unsound", 0.0)),
    "imu_saturated": (_sensor("full"), _clear),
    "imu_remounted": (_sensor("axes"), _clear),
    "axis_reversed": (_at_once(_nothing), _nothing),
    "imu_remounted_in_swing": (_sensor("axes"), _clear),
    "imu_unit_deg": (_sensor("unit", 57.2958), _clear),
    "imu_unit_g": (_sensor("unit", 1 / 9.80665), _clear),
    "stamp_doubled_once": (_sensor("doubled", 1), _clear),
    "stamp_order_once": (_sensor("reorder", 1), _clear),
    "stamps_doubled": (_sensor("doubled", MANY), _clear),
    "stamps_order": (_sensor("reorder", MANY), _clear),
    "stamps_jumping": (_sensor("jumping", 0.2), _clear),
    "clock_jump": (_sensor("jump", 0.5), _clear),
    "clock_drift": (_sensor("drift", 100.0), lambda bench: bench.equipment.imu.inject("drift", 0.0)),
    "stale_data": (lambda bench, n: bench.equipment.imu.inject("delay", bench.value), _clear),
    "cpu_hogs": (_hogs, lambda bench: bench.observe(HOGS_S - 1.5)),
    "controller_killed": (_kill, _nothing),
    "controller_stopped": (_stop, _nothing),
    "controller_starved": (_starve, _nothing),
    "supervisor_killed": (_to_child(SUPERVISOR, _killed), CampaignBench.end_session),  # it takes no new supervisor
    "supervisor_stopped": (_to_child(SUPERVISOR, _stopped), _nothing),
    "link_lost": (_cut, _after(CUT_S, _mend)),
    "adapter_unplugged": _line("unplug"),
    "bus_off": _line("bus_off"),
    "adapter_full": _line("clog"),
    "node_reboot": (lambda bench, n: bench.devices.node.inject("reboot", 0.0), _nothing),
    "ack_missing": _stimulator("mute", 1.0, 0.0),
    "ack_late": _stimulator("delay", 0.15, 0.0),
    "delivered_differs": _stimulator("weak", CHANNEL, -1.0),
    "electrode": _stimulator("electrode", CHANNEL, -1.0),
    "commands_flipped": (flips, _nothing),
    "commands_repeated": (repeats, _nothing),
    "commands_reordered": (exchange, _nothing),
    "commands_old_session": (old_session, _nothing),
    "random_frames": (random, _nothing),
    "stop_key": (_at_once(lambda bench: bench.session().key(b" ")), _nothing),
    "stop_file": (
        _at_once(lambda bench: bench.session().stop_file.touch()),
        lambda bench: bench.session().stop_file.unlink(missing_ok=True),
    ),
    "stop_control": (_at_once(lambda bench: bench.command("stop")), _nothing),
    "stop_page": (_stop_on_page, _nothing),
    "stop_button": (
        _at_once(lambda bench: bench.devices.stop_button().press()),
        lambda bench: bench.devices.stop_button().press(False),
    ),
    "view_killed": (_to_child("fes.live.terminal_view", _killed), CampaignBench.end_session),
    "page_killed": (_to_child("fes.live.dashboard", _killed), CampaignBench.end_session),
    "view_frozen": (_to_child("fes.live.terminal_view", _stopped), _nothing),
    "page_frozen": (_to_child("fes.live.dashboard", _stopped), _nothing),
    "phase_stuck": (_at_once(_nothing), _nothing),
    "dose": (_at_once(_nothing), _nothing),
    "disk_full": (_full_disk, _nothing),
    "log_removed": (_log_removed, _nothing),
    "log_writer_killed": (_to_child("fes.live.log_process", _killed), _nothing),
}
