"""A sensor that dies in mid-burst, and a program that dies: the makers' example and this project on one simulated P24.

*Example* does what the makers' minimal example for Capture2Go and ScienceMode4 does (nextroundwinner, MIT, 2025-11):
mid level; an update where the crank's angle changes which muscles are on; where no angle comes within 0.5 s it goes on;
and every turn ends by asking for current data, which renews the device's watchdog of 2 s. *Gate* is this project's
gate and port, with the same sensor and a plan that asks for current all the time; so nothing but the gate ends it. The
device, its watchdog and its record of pulses are the simulated P24's, on its own clock. Deaths are spread evenly over
a period of the sensor, of the commands and of the pulses. "Still on" is after six seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import cos, sin, tau

from benchmarks.lib.channels import LIMITS, channel
from benchmarks.lib.command_line import parser_of, publish, table_of
from drivers.simulated.stimulator.in_process import DeviceLine
from drivers.simulated.stimulator.sciencemode4 import ScienceMode4Device
from drivers.stimulator import p24_port as codec
from drivers.stimulator.p24_port import WATCHDOG_S, Code, LowLevelStimulator, MidLevelStimulator, Train
from drivers.stimulator.sciencemode import Packet
from fes.config import Channel
from fes.gate import SafetyGate
from fes.signals import G_MPS2, NS_PER_S, ImuSample, OperatorAct, OperatorAction, StimRequest, Tick

MS = 1_000_000
NEVER_NS = 2**62
DIES_NS, WATCHED_NS = 2 * NS_PER_S, 6 * NS_PER_S
DEATHS, SPREAD_NS = 20, 40 * MS  # over 40 ms: two commands, four samples, one period of the pulses
SAMPLE_NS, COMMAND_NS = 10 * MS, 20 * MS
EXAMPLE_WAITS_NS = NS_PER_S // 2
CURRENT_MA, WIDTH_US, FREQUENCY_HZ = 20.0, 200.0, 50.0
ON_MA = 10.0  # the current is on, not only rising
CHANNEL = channel(
    "right_foot", electrode_area_cm2=50.0, current_ma=CURRENT_MA, pulse_width_us=WIDTH_US, frequency_hz=FREQUENCY_HZ
)


@dataclass(frozen=True)
class Death:
    """When the sensor falls silent, and when the program does no more."""

    sensor_ns: int = NEVER_NS
    program_ns: int = NEVER_NS


def example(death: Death) -> list[int]:
    """Times of the pulses of the makers' example's loop; the crank stands where one muscle is on when it dies."""
    line = DeviceLine(ScienceMode4Device(0))
    numbers = iter(range(1, 1 << 30))

    def ask(packet: Packet) -> None:
        line.write(codec.encode(packet))
        line.read()

    ask(Packet(0, Code.MID_INIT, b"\x01"))
    train = Train(codec.biphasic(CURRENT_MA, WIDTH_US), codec.period_steps(FREQUENCY_HZ))
    was_on: bool | None = None
    t_ns = 0
    while t_ns < min(death.program_ns, DIES_NS + WATCHED_NS):
        comes_ns = t_ns + SAMPLE_NS
        if comes_ns < death.sensor_ns:
            t_ns = comes_ns
            on = t_ns > NS_PER_S  # the angle that has come
            line.advance(t_ns)
            if on != was_on:
                was_on = on
                ask(codec.mid_update(next(numbers) % codec.NUMBERS, {0: train} if on else {}))
        else:  # nothing for half a second: passed over
            t_ns += EXAMPLE_WAITS_NS
            _pass_time(line, min(t_ns, death.program_ns))
            if t_ns >= death.program_ns:
                break
        ask(codec.mid_current_data(next(numbers) % codec.NUMBERS))
    return _pulses(line)


def gated(death: Death, *, mid_level: bool) -> list[int]:
    """Times of the pulses with this project's gate and port, in mid level or in low level."""
    line = DeviceLine(ScienceMode4Device(0))
    port: MidLevelStimulator | LowLevelStimulator
    port = MidLevelStimulator(line, 7, accept_watchdog_s=WATCHDOG_S) if mid_level else LowLevelStimulator(line, 7)
    handshake = port.open(0, clock_ns=line.clock_ns)
    gate = SafetyGate((Channel.model_validate(CHANNEL),), max_data_age_ms=40, validity_ms=60)
    for alive in handshake.alive:
        gate.observe(alive)
    command_ns, first_ns = 0, NS_PER_S
    for t_ns in range(MS, min(death.program_ns, DIES_NS + WATCHED_NS), MS):
        line.advance(t_ns)
        if t_ns % SAMPLE_NS == 0 and t_ns < death.sensor_ns:
            gate.observe(_sample(t_ns))
        for event in port.poll(t_ns):
            gate.observe(event)
        if t_ns == first_ns:
            gate.observe(OperatorAct(t_ns, OperatorAction.ARM))
        if t_ns - command_ns < COMMAND_NS:
            continue
        command_ns = t_ns
        gate.observe(Tick(t_ns))
        rising_ma = 0.5 * int(1 + (t_ns - first_ns - COMMAND_NS) / NS_PER_S * LIMITS["max_rise_ma_per_s"])
        wants = t_ns > first_ns  # from one step of the device on
        levels = (min(CURRENT_MA, rising_ma), WIDTH_US, FREQUENCY_HZ) if wants else (0.0, 0.0, 0.0)
        port.send(gate.judge(t_ns, StimRequest(0, wants, *levels)))
    return _pulses(line)


def _sample(t_ns: int) -> ImuSample:
    """A foot that swings once a second, as a sensor on it feels it."""
    phase = tau * t_ns / NS_PER_S
    noise = 1e-3 * (t_ns % 97 * MS % 89)
    return ImuSample(
        t_ns, "right_foot", t_ns, (sin(phase), noise, G_MPS2 + 0.5 * cos(phase)), (0.1, 2 * sin(phase), noise)
    )


def _pass_time(line: DeviceLine, until_ns: int) -> None:
    """From deadline to deadline, so that each pulse has its own time."""
    while line.t_ns < until_ns:
        line.wait((until_ns - line.t_ns) / NS_PER_S)
        line.read()


def _pulses(line: DeviceLine) -> list[int]:
    _pass_time(line, DIES_NS + WATCHED_NS)
    device = line.device
    assert isinstance(device, ScienceMode4Device)
    return [entry.t_ns for entry in device.take_record() if entry.event == "pulse" and entry.current_ma >= ON_MA]


ARMS: Sequence[tuple[str, Callable[[Death], list[int]]]] = (
    ("makers' example, mid level", example),
    ("gate, mid level", lambda death: gated(death, mid_level=True)),
    ("gate, low level", lambda death: gated(death, mid_level=False)),
)


def last_pulses_ms(run: Callable[[Death], list[int]], *, sensor: bool) -> list[float]:
    """For each moment of death, how long after it the last pulse came; infinite where it goes on to the end.

    Raises:
        ValueError: no current flowed when it died: nothing would be shown.
    """
    found = []
    for number in range(DEATHS):
        dies_ns = DIES_NS + number * SPREAD_NS // DEATHS
        pulses = run(Death(sensor_ns=dies_ns) if sensor else Death(program_ns=dies_ns))
        if not any(dies_ns - 2 * SPREAD_NS < t_ns <= dies_ns for t_ns in pulses):
            raise ValueError(f"no current flowed at {dies_ns / MS:g} ms")
        lasted_ns = max(pulses) - dies_ns
        still = lasted_ns > WATCHED_NS - NS_PER_S
        found.append(float("inf") if still else max(0.0, lasted_ns / MS))
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    options = parser_of(__doc__).parse_args(arguments)
    rows = []
    for name, run in ARMS:
        cells = []
        for sensor in (True, False):
            times_ms = last_pulses_ms(run, sensor=sensor)
            still = sum(each == float("inf") for each in times_ms)
            worst = f"{max(times_ms):.0f} ms at most" if not still else f"still on after {WATCHED_NS // NS_PER_S} s"
            cells.append(f"{worst}, {still or len(times_ms)} of {len(times_ms)}")
        rows.append([name, *cells])
    table = table_of("", ("last pulse after", "the sensor dies", "the program dies"), rows)
    publish([table], options)


if __name__ == "__main__":
    main()
