"""The ScienceMode codecs against the vendor's frames, and against everything that a bad line can do to them."""

from __future__ import annotations

import random
from itertools import combinations

import pytest
from replays import Burst, bursts, replay, write_cut
from test_sciencemode_ports import KINDS, MS, Bench

from drivers.simulated.record import RecordEntry
from drivers.stimulator import p24_port as sm4
from drivers.stimulator import rehastim2_port as sm2
from drivers.stimulator.p24_port import Point, Train, biphasic
from drivers.stimulator.sciencemode import FrameDecoder, FrameRejected, Packet, stuff, unstuff
from fes.signals import StimCommand, StimStatus
from fes.stimulation.dose import DoseLedger

PULSE = biphasic(20.0, 200.0)
GOLDEN4 = [
    (sm4.low_pulse(5, 1, PULSE), "f08155814c815881631402a20c8550000644b0000c8410000f"),
    (
        sm4.mid_update(7, {0: Train(PULSE, sm4.period_steps(40.0), 3)}),
        "f081558149810281a21c20012300640c8550000644b0000c8410000f",
    ),
    (Packet(1, 30, b"\0"), "f08155815881a981e9041e000f"),
    (Packet(2, 34), "f08155815981d881dc08220f"),
    (sm4.mid_current_data(9), "f081558158818581f52424040f"),
]
GOLDEN2 = [
    (Packet(1, 4), "f0815c815701040f"),
    (sm2.list_start(2, [sm2.pulse(20.0, 300.0)]), "f081368153022000012c140f"),
]


@pytest.mark.parametrize(("packet", "frame"), GOLDEN4)
def test_sciencemode4_golden_frames(packet: Packet, frame: str) -> None:
    assert sm4.encode(packet).hex() == frame
    assert sm4.Decoder().feed(bytes.fromhex(frame)) == [packet]


@pytest.mark.parametrize(("packet", "frame"), GOLDEN2)
def test_sciencemode2_golden_frames(packet: Packet, frame: str) -> None:
    assert sm2.encode(packet).hex() == frame
    assert sm2.Decoder().feed(bytes.fromhex(frame)) == [packet]


GOLDEN = [(sm4.Decoder, p, bytes.fromhex(f)) for p, f in GOLDEN4] + [
    (sm2.Decoder, p, bytes.fromhex(f)) for p, f in GOLDEN2
]


@pytest.mark.parametrize(("make", "packet", "frame"), GOLDEN)
def test_a_frame_comes_out_whole_however_it_is_cut(make: type[FrameDecoder], packet: Packet, frame: bytes) -> None:
    decoder = make(200)
    assert [decoder.feed(bytes((byte,))) for byte in frame] == [[]] * (len(frame) - 1) + [[packet]]
    for cut in range(1, len(frame)):
        assert decoder.feed(b"\x0f\x81\x00" + frame[:cut]) == []
        assert decoder.feed(frame[cut:] + frame) == [packet, packet]


@pytest.mark.parametrize(("make", "packet", "frame"), GOLDEN)
def test_a_torn_frame_costs_no_more_than_itself(make: type[FrameDecoder], packet: Packet, frame: bytes) -> None:
    for length in range(len(frame)):
        decoder = make(200)
        got = decoder.feed(frame[:length] + frame)
        assert got == [packet], length
    for lost in range(len(frame)):
        decoder = make(200)
        assert decoder.feed(frame[:lost] + frame[lost + 1 :] + frame) == [packet], lost


@pytest.mark.parametrize(("make", "packet", "frame"), GOLDEN)
def test_no_one_or_two_flipped_bits_are_taken_for_a_frame(
    make: type[FrameDecoder], packet: Packet, frame: bytes
) -> None:
    bits = range(8 * len(frame))
    for flips in [*((one,) for one in bits), *combinations(bits, 2)]:
        bad = bytearray(frame)
        for bit in flips:
            bad[bit // 8] ^= 1 << bit % 8
        decoder = make(200)
        assert decoder.feed(bytes(bad)) == [], (flips, bytes(bad).hex())


@pytest.mark.parametrize(("make", "packet", "frame"), GOLDEN)
def test_after_a_flipped_bit_the_stream_goes_on(make: type[FrameDecoder], packet: Packet, frame: bytes) -> None:
    """A wrong length may cost the frame behind it, but never a third one."""
    for bit in range(8 * len(frame)):
        bad = bytearray(frame)
        bad[bit // 8] ^= 1 << bit % 8
        decoder = make(200)
        got = decoder.feed(bytes(bad) + frame + frame)
        assert got in ([packet], [packet, packet]), bit
        assert got == [packet, packet] or bit // 8 < 9, bit


def test_a_body_that_needs_no_stuffing_has_none() -> None:
    every = bytes(range(256))
    assert unstuff(stuff(every)) == every
    for wrong in (b"\xf0", b"\x0f", b"\x81", b"\x81\x00", b"\x01\x81"):
        with pytest.raises(FrameRejected):
            unstuff(wrong)


def test_header_bytes_that_read_like_start_and_stop() -> None:
    """0x5A and 0xA5 in a header are 0F and F0 on the wire."""
    seen = set()
    for number in range(64):
        for value in range(64):
            packet = Packet(number, 3, bytes((value,)))
            frame = sm4.encode(packet)
            seen |= set(frame[1:9])
            assert sm4.Decoder().feed(frame) == [packet]
    assert {0x0F, 0xF0} <= seen


def test_the_buffer_is_bounded() -> None:
    decoder = sm4.Decoder(64)
    for _ in range(200):
        decoder.feed(b"\xf0\x81\x55\x81\x6a" * 100)
    assert len(decoder._buffer) <= 64
    assert decoder.rejected > 0
    assert decoder.feed(b"\x0f" + sm4.encode(Packet(1, 2))) == [Packet(1, 2)]


def test_an_unbalanced_pulse_cannot_be_encoded() -> None:
    with pytest.raises(ValueError, match="not charge-balanced"):
        sm4.low_pulse(0, 0, (Point(200, 40), Point(200, -39)))
    with pytest.raises(ValueError, match="not charge-balanced"):
        sm4.mid_update(0, {0: Train((Point(200, 40),), 50)})
    balanced = (Point(100, 40), Point(400, -10))
    assert sm4.low_pulse(0, 0, balanced).data


def test_nothing_is_rounded_up() -> None:
    assert biphasic(19.99, 200.9) == (Point(200, 39), Point(100, 0), Point(200, -39))
    assert biphasic(0.49, 200) == biphasic(10, 0.9) == ()
    assert sm2.pulse(19.99, 300.9) == (300, 19)
    assert sm2.pulse(0.99, 300) == sm2.pulse(20, 19.9) == sm2.NO_PULSE
    assert sm4.period_steps(40.0) == 50
    assert sm4.period_steps(30.0) == 67  # 33.5 ms, not 33.0


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1.0, 131.0])
def test_currents_that_the_devices_cannot_deliver(bad: float) -> None:
    with pytest.raises(ValueError, match="current_ma"):
        biphasic(bad, 200)
    with pytest.raises(ValueError, match="current_ma"):
        sm2.pulse(bad, 200)


@pytest.mark.parametrize(
    "make",
    [
        lambda: sm4.low_pulse(0, 8, PULSE),
        lambda: sm4.low_pulse(0, -1, PULSE),
        lambda: sm4.low_pulse(0, 0, ()),
        lambda: sm4.low_pulse(0, 0, PULSE * 6),
        lambda: sm4.mid_update(0, {8: Train(PULSE, 50)}),
        lambda: sm4.mid_update(0, {0: Train(PULSE, 0)}),
        lambda: sm4.mid_update(0, {0: Train(PULSE, 50, 16)}),
        lambda: sm4.period_steps(0.0),
        lambda: sm4.period_steps(0.01),
        lambda: sm4.encode(Packet(64, 2)),
        lambda: sm4.encode(Packet(0, 1024)),
        lambda: Point(4096, 0).encode(),
        lambda: Point(10, 261).encode(),
        lambda: biphasic(10, 5000),
        lambda: sm2.list_init(0, ()),
        lambda: sm2.list_init(0, (8,)),
        lambda: sm2.list_start(0, ()),
        lambda: sm2.list_start(0, [(501, 10)]),
        lambda: sm2.pulse(20, 501),
        lambda: sm2.encode(Packet(256, 1)),
        lambda: sm2.encode(Packet(0, 1, bytes(200))),
    ],
)
def test_what_does_not_fit_is_refused(make: object) -> None:
    assert callable(make)
    with pytest.raises(ValueError):
        make()


def test_every_result_has_words() -> None:
    assert sm4.result_text(0) == sm2.result_text(0) == ""
    assert "15 mA" in sm4.result_text(10)
    assert sm4.result_text(99) == "stimulator error 99"
    assert "emergency switch" in sm2.error_text(-1)
    assert sm2.error_text(-9) == "stimulation error -9"
    assert sm2.signed(b"\xfd") == -3


# --- A walking session's own commands through the ScienceMode ports to the simulated devices ---


DELIVERED_WITHIN_NS = {"low": 0, "mid": 0, "rehastim2": 12 * MS}
SILENT_WITHIN_NS = {"low": 0, "mid": 2000 * MS, "rehastim2": 12 * MS}


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> list[StimCommand]:
    """All of channel 0 in thirty seconds of a bundled trial, on a clock that begins at one second."""
    folder = tmp_path_factory.mktemp("session")
    made = [one for one in replay(write_cut(folder, end_s=30.0), folder).commands if one.channel == 0]
    first_ns = made[0].t_ns - 1000 * MS
    return [
        StimCommand(
            one.t_ns - first_ns,
            0,
            one.on,
            one.current_ma,
            one.pulse_width_us,
            one.frequency_hz,
            one.validity_ms,
        )
        for one in made
    ]


def deliver(
    kind: str, commands: list[StimCommand], then_ns: int = 0
) -> tuple[list[RecordEntry], list[StimStatus], list[str]]:
    """The pulses, the statuses and the faults; after the last command only time passes."""
    bench = Bench(kind, (0,), commands[0].t_ns - 1000 * MS)
    for command in commands:
        while bench.t_ns + 2 * MS < command.t_ns:  # the loop polls at every sample
            bench.turn(for_ms=2)
        bench.line.advance(command.t_ns)
        bench.port.send(command)
    bench.line.advance(bench.t_ns + then_ns)
    bench.record += bench.device.take_record()
    assert bench.lost == ""
    return bench.pulses, bench.statuses, bench.faults


def burst_of(pulse: RecordEntry, made: list[Burst], slack_ns: int) -> Burst | None:
    return next((b for b in made if b.t_on_ns <= pulse.t_ns < b.t_off_ns + slack_ns), None)


@pytest.mark.parametrize("kind", KINDS)
def test_a_session_is_delivered_as_the_controller_commanded(kind: str, commands: list[StimCommand]) -> None:
    pulses, statuses, faults = deliver(kind, commands, 500 * MS)
    made = bursts(commands)
    assert len(made) >= 5
    assert faults == []
    slack_ns = max(DELIVERED_WITHIN_NS[kind], 1)
    for pulse in pulses:
        burst = burst_of(pulse, made, slack_ns)
        assert burst is not None, f"a pulse at {pulse.t_ns / 1e9:.3f} s outside of every burst"
        newest = max(c.current_ma for c in commands if -60 * MS <= c.t_ns - pulse.t_ns <= 0)
        assert pulse.current_ma <= newest
        assert pulse.detail == ""
    on_s = sum(burst.t_off_ns - burst.t_on_ns for burst in made) * 1e-9
    # 40 Hz while it is on, less the first steps of each rise, which are below the device's finest step
    assert 40.0 * on_s - 4 * len(made) <= len(pulses) <= 40.0 * on_s + 1.5 * len(made)
    if kind != "mid":
        assert sum(status.pulses for status in statuses) == len(pulses)
    peaks = {burst: max(p.current_ma for p in pulses if burst_of(p, [burst], slack_ns)) for burst in made}
    step_ma = 1.0 if kind == "rehastim2" else 0.5
    assert all(burst.peak_ma - peak < step_ma for burst, peak in peaks.items())


@pytest.mark.parametrize("kind", KINDS)
def test_a_controller_that_dies_anywhere_in_a_session(kind: str, commands: list[StimCommand]) -> None:
    """Cut the commands off at forty places within bursts: no pulse later than the device's own rule."""
    chosen = random.Random(4)
    inside = [at for at, command in enumerate(commands) if command.on]
    worst_ns = 0
    for at in chosen.sample(inside, 40):
        pulses, _, _ = deliver(kind, commands[max(0, at - 60) : at + 1], 3000 * MS)
        if pulses:
            worst_ns = max(worst_ns, pulses[-1].t_ns - commands[at].t_ns)
    print(f"{kind}: last pulse at most {worst_ns / MS:.1f} ms after the last command")
    assert worst_ns <= SILENT_WITHIN_NS[kind]
    assert kind != "mid" or worst_ns > 1500 * MS


@pytest.mark.parametrize("kind", KINDS)
def test_the_dose_ledger_books_the_charge_that_the_device_delivered(kind: str, commands: list[StimCommand]) -> None:
    """Against the sum over the device's own pulses, one phase each; only mid level must estimate."""
    pulses, statuses, _ = deliver(kind, commands, 500 * MS)
    ledger = DoseLedger([0])
    for status in statuses:
        ledger.book(status)
    delivered_uc = sum(1e-3 * pulse.current_ma * pulse.pulse_width_us for pulse in pulses)
    booked = ledger.electrodes[0]
    assert booked.estimated == (kind == "mid")
    assert booked.session_uc == pytest.approx(delivered_uc, rel=0.1 if kind == "mid" else 1e-9)
