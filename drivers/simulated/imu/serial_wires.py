"""The simulated sensors that speak over a line of bytes, by their names in a session's settings; no I/O, no clock.

They share no code and no constant with the drivers' codecs, so that the two check each other.

Movella DOT: messages are records of characteristic and length (two bytes each, the least significant first) and value;
one without a value asks for it. After a loss of power it does not measure, and its clock begins anew.

WitMotion: as shipped it sends no time. Registers are written for 10 s after the key, and kept over a loss of power once
they were saved. Its clock was never set: it begins with the power, on a day 0 of month 0. Its rates are exactly 0 once
they stay below register 6F (0.3 °/s, as shipped) for as long as register 6E says (0.5 s); here by the root mean square
of the last so many samples.

Capture2Go: silent until it was asked who it is; it streams when it is told to, and after a loss of power it is idle:
whoever wants samples begins anew. Every second it sends its status. The clock is set by the host, or comes from a
sender of the same ``air``. Its own faults: ``deaf`` (1: hears no sender, and its clock goes on alone), ``unsound`` (so
many of the next samples have the flag that their processing failed).
"""

import functools
import math
import operator
import struct
import zlib
from collections import deque
from dataclasses import dataclass, field
from typing import Final

from drivers.simulated.imu.device import Radio, SimulatedImu, record, records
from drivers.simulated.imu.wire import SERIAL, Reading, Wire, XbusWire, Ximu3Wire
from drivers.simulated.lines import FaultValues
from fes.signals import G_MPS2, NS_PER_S

MODES: Final = {1: 200, 2: 100, 3: 50, 4: 25}  # fullFixedMode: Hz
IDLE, STREAMING = 1, 2
TIME_GAP, CLIPPED, UNSOUND = 0x01, 0x06, 0x10  # CLIPPED: gyroscope or accelerometer, which is not told apart here
WRONG_STATE, PACKAGE_ERROR, UNKNOWN_COMMAND = 0xFB, 0xFC, 0xFD
SENDS, RECEIVES = 1, 2
HEAD: Final = 8
PER_G_MPS2: Final = 9.81  # of its scale: 2048 steps a g
MODE: Final = struct.Struct("<qBBBBBBBBHBQBBB")
SAMPLE: Final = struct.Struct("<q3h3hQhB")
PACKED: Final = struct.Struct("<q24h24hQhB")
PACKED_SAMPLES: Final = 8
WITH_MAGNETOMETER: Final = struct.Struct("<q3h3h3hQhB")


@dataclass
class Air:
    """What sensors hear of each other by radio: by a sender's number when it last spoke, in truth and by its clock."""

    heard_ns: dict[int, tuple[int, int]] = field(default_factory=dict)


class Capture2GoWire(Wire):
    """A sensor of this rate; ``air`` is shared by those that can hear each other. ``serial``: 6 characters count.

    ValueError: a rate that it has not.
    """

    carries_nan = False
    faults = frozenset(("deaf", "unsound"))

    def __init__(self, rate_hz: float, air: Air | None, serial: str) -> None:
        if rate_hz not in MODES.values():
            raise ValueError(f"{rate_hz:g} Hz: a Capture2Go has {', '.join(map(str, MODES.values()))}")
        self._rate_hz, self._air, self._serial = round(rate_hz), air or Air(), serial
        self._faults = FaultValues(dict.fromkeys(self.faults, 0.0))
        self._switched_on()

    def _switched_on(self) -> None:
        self._buffer = b""
        self._asked = self._streams = False
        self._mode = bytes(MODE.size)
        self._set_ns = 0  # what its clock was set ahead by
        self._status_ns: int | None = None
        self._due_ns: int | None = None
        self._packed: list[tuple[int, list[int], list[int], int]] = []

    def set_fault(self, name: str, value: float) -> None:
        """One of its own."""
        self._faults[name] = value

    def boot(self) -> list[bytes]:
        """Nothing, until it is asked."""
        part, number = self._sync
        if part == SENDS:
            self._air.heard_ns.pop(number, None)
        self._switched_on()
        return []

    @property
    def _sync(self) -> tuple[int, int]:
        """Its part (0, SENDS, RECEIVES), and the number that goes with it."""
        fields = MODE.unpack(self._mode)
        return fields[10], fields[11]

    def _keep_in_step(self, reading: Reading) -> None:
        """A sender says its time with every sample; a receiver sets its own clock by that."""
        part, number = self._sync
        if part == SENDS:
            self._air.heard_ns[number] = reading.t_true_ns, reading.t_device_ns + self._set_ns
        elif part == RECEIVES and self._in_step:
            then_ns, stamp_ns = self._air.heard_ns[number]
            self._set_ns = stamp_ns + reading.t_true_ns - then_ns - reading.t_device_ns

    @property
    def _in_step(self) -> bool:
        part, number = self._sync
        return part == SENDS or (part == RECEIVES and not self._faults["deaf"] and number in self._air.heard_ns)

    # --- samples ----------------------------------------------------------------------------------------

    def encode(self, reading: Reading) -> list[bytes]:
        """A package, or every eighth time one of eight; every second the status. Nothing while it does not stream."""
        fixed, packed = MODE.unpack(self._mode)[2:4]
        if not self._streams or self._rate_hz not in (MODES.get(fixed), MODES.get(packed)) or not reading.finite:
            return []
        self._keep_in_step(reading)
        t_ns = reading.t_device_ns + self._set_ns
        gap = self._due_ns is not None and abs(t_ns - self._due_ns) > NS_PER_S // self._rate_hz // 2
        self._due_ns = t_ns + NS_PER_S // self._rate_hz
        flags = TIME_GAP * gap | CLIPPED * reading.clipped | UNSOUND * self._faults.use_up("unsound")
        gyr = _steps([math.degrees(rate) * 32768 / 2000 for rate in reading.gyr_radps])
        acc = _steps([force * 2048 / PER_G_MPS2 for force in reading.acc_mps2])
        if MODES.get(packed) == self._rate_hz:
            self._packed.append((t_ns, list(gyr), list(acc), flags))
            out = self._eight(packed) if len(self._packed) == PACKED_SAMPLES else []
        elif self._mode[-1]:
            out = [package(0x0250 + fixed, SAMPLE.pack(t_ns, *gyr, *acc, 0, 0, flags))]
        else:
            out = [package(0x0240 + fixed, WITH_MAGNETOMETER.pack(t_ns, *gyr, *acc, 0, 0, 0, 0, 0, flags))]
        every_s = MODE.unpack(self._mode)[7]
        if self._status_ns is None or not 0 <= t_ns - self._status_ns < every_s * NS_PER_S:
            self._status_ns = t_ns
            out += [self._status(reading.t_device_ns)] if every_s else []
        return out

    def _eight(self, mode: int) -> list[bytes]:
        """The eight that are kept, without magnetometer, by the stamp of the first and the flags of all."""
        rates = [step for _, gyr, _, _ in self._packed for step in gyr]
        forces = [step for _, _, acc, _ in self._packed for step in acc]
        flags = functools.reduce(operator.or_, (flags for *_, flags in self._packed))
        t_ns, self._packed = self._packed[0][0], []
        return [package(0x0230 + mode, PACKED.pack(t_ns, *rates, *forces, 0, 0, flags))]

    def _status(self, t_device_ns: int) -> bytes:
        state, usb = STREAMING if self._streams else IDLE, 3
        fields = (t_device_ns + self._set_ns, state, usb, 0, 0, 0, self._in_step, 0x80 | 93, 88)
        return package(0x0201, struct.pack("<qBB3hBBB", *fields))

    # --- commands ---------------------------------------------------------------------------------------

    def answer(self, data: bytes, t_device_ns: int) -> list[bytes]:
        """What its firmware answers; to nothing before it was asked who it is."""
        self._buffer += data
        out: list[bytes] = []
        while (start := self._buffer.find(b"\x02")) >= 0:
            self._buffer = self._buffer[start:]
            if len(self._buffer) < HEAD or len(self._buffer) < HEAD + self._buffer[5]:
                break
            end = HEAD + self._buffer[5]
            body, crc = self._buffer[6:end], self._buffer[1:5]
            if zlib.crc32(body) != int.from_bytes(crc, "little"):
                out += [package(0xFFFF, struct.pack("<BH", PACKAGE_ERROR, 0xFFFF))] if self._asked else []
                self._buffer = self._buffer[1:]
                continue
            self._buffer = self._buffer[end:]
            header, payload = int.from_bytes(body[:2], "little"), body[2:]
            self._asked = self._asked or header == 0x0070
            out += self._answers(header, payload, t_device_ns) if self._asked else []
        return out

    def _answers(self, header: int, payload: bytes, t_device_ns: int) -> list[bytes]:
        match header:
            case 0x0070:
                texts = (self._serial, "sim", "1", "1.0.1", "2026-04-02")
                info = struct.pack("<H6s8s8s12s11s", 1, *(text.encode("ascii") for text in texts))
                return [package(0x0071, info), self._status(t_device_ns)]
            case 0x0120 if len(payload) == MODE.size:
                self._mode = payload
                return [package(0x0122, payload)]
            case 0x0170 if len(payload) == 8:
                self._set_ns = int.from_bytes(payload, "little", signed=True) - t_device_ns
                return [package(0x0171, payload)]
            case 0x0150:
                if self._streams:
                    return [_error(WRONG_STATE, header)]
                self._streams, self._due_ns, self._packed = True, None, []
                return [package(0x0151)]
            case 0x0152 | 0x0158:
                self._streams = False
                return [package(header + 1)]
            case 0x0121:
                return [package(0x0122, self._mode)]
            case 0x0200:
                return [self._status(t_device_ns)]
        return [_error(UNKNOWN_COMMAND, header)]


def package(header: int, payload: bytes = b"") -> bytes:
    """Start byte, checksum, size, header, payload."""
    body = header.to_bytes(2, "little") + payload
    return b"\x02" + zlib.crc32(body).to_bytes(4, "little") + bytes((len(payload),)) + body


def _error(code: int, header: int) -> bytes:
    return package(0xFFFF, struct.pack("<BH", code, header))


def _steps(values: list[float]) -> tuple[int, ...]:
    return tuple(round(min(max(value, -32768), 32767)) for value in values)


SHIPPED: Final = {0x02: 0x1E, 0x03: 0x06, 0x04: 0x06, 0x1F: 0x04, 0x20: 0x03, 0x6E: 500, 0x6F: 300}
WITMOTION_HZ: Final = {0x08: 50, 0x09: 100, 0x0B: 200}
OPEN_NS: Final = 10 * NS_PER_S
DAY_MS: Final = 86_400_000


class WitmotionWire(Wire):
    """A sensor that measures at this rate; it sends nothing while another one is set. ValueError: it has it not."""

    carries_nan = False

    def __init__(self, rate_hz: float) -> None:
        if rate_hz not in WITMOTION_HZ.values():
            raise ValueError(f"{rate_hz:g} Hz: a WitMotion sensor has {', '.join(map(str, WITMOTION_HZ.values()))}")
        self._rate_hz = rate_hz
        self._saved = dict(SHIPPED)
        self.boot()

    def boot(self) -> list[bytes]:
        """With the registers that were saved; it says nothing of it."""
        self._registers, self._buffer, self._open_until_ns = dict(self._saved), b"", 0
        self._felt: deque[float] = deque([math.inf], maxlen=max(round(self._registers[0x6E] * self._rate_hz / 1000), 1))
        return []

    def encode(self, reading: Reading) -> list[bytes]:
        """The frames of one sample that are switched on."""
        if not reading.finite or WITMOTION_HZ.get(self._registers[0x03]) != self._rate_hz:
            return []
        rates_dps = [math.degrees(rate) for rate in reading.gyr_radps]
        self._felt.append(max(rate * rate for rate in rates_dps))
        if sum(self._felt) / len(self._felt) < (self._registers[0x6F] / 1000) ** 2:
            rates_dps = [0.0, 0.0, 0.0]
        of_day_ms = reading.t_device_ns // 1_000_000 % DAY_MS
        seconds, ms = divmod(of_day_ms, 1000)
        frames = {
            0: (0x50, struct.pack("<6BH", 0, 0, 0, seconds // 3600, seconds // 60 % 60, seconds % 60, ms)),
            1: (0x51, _triad([force / G_MPS2 * 2048 for force in reading.acc_mps2])),
            2: (0x52, _triad([rate * 16.384 for rate in rates_dps])),
            3: (0x53, bytes(8)),
            4: (0x54, bytes(8)),
        }
        return [b"".join(_frame(*frames[bit]) for bit in frames if self._registers[0x02] >> bit & 1)]

    def answer(self, data: bytes, t_device_ns: int) -> list[bytes]:
        """Registers that are asked for; those that are set while it is open for that."""
        self._buffer += data
        out: list[bytes] = []
        while (start := self._buffer.find(b"\xff\xaa")) >= 0 and len(self._buffer) >= start + 5:
            register, value = struct.unpack_from("<BH", self._buffer, start + 2)
            self._buffer = self._buffer[start + 5 :]
            if register == 0x27:
                out.append(_frame(0x5F, struct.pack("<4H", *(self._registers.get(value + k, 0) for k in range(4)))))
            elif (register, value) == (0x69, 0xB588):
                self._open_until_ns = t_device_ns + OPEN_NS
            elif t_device_ns > self._open_until_ns:
                continue
            elif register == 0:
                self._saved = dict(self._registers)
            else:
                self._registers[register] = value
        return out


def _frame(kind: int, data: bytes) -> bytes:
    head = bytes((0x55, kind)) + data
    return head + bytes((sum(head) & 0xFF,))


def _triad(values: list[float]) -> bytes:
    return struct.pack("<4h", *(round(min(max(value, -32768), 32767)) for value in values), 2500)  # at 25 °C


DOT_HZ: Final = (60, 30)
INFO: Final = bytes.fromhex("5a8a00cd22d4 020601 e7070701020304 00000000 0d0c0b0a00000000 58532d543032")


class MovellaDotWire(Wire):
    """A sensor that can measure at this rate; it does so once that is set, too. ValueError: it has it not."""

    def __init__(self, rate_hz: float) -> None:
        if rate_hz not in DOT_HZ:
            raise ValueError(f"{rate_hz:g} Hz: a Movella DOT has {' and '.join(map(str, DOT_HZ))} by radio")
        self._rate_hz = rate_hz
        self.boot()

    def boot(self) -> list[bytes]:
        """At 60 Hz, and silent."""
        self._measures, self._payload, self._set_hz = False, 4, 60
        self._buffer = b""
        return []

    def encode(self, reading: Reading) -> list[bytes]:
        """Rate quantities; nothing while another payload or rate is set."""
        if not self._measures or self._payload != 21 or self._set_hz != self._rate_hz:
            return []
        rates_dps = [math.degrees(rate) for rate in reading.gyr_radps]
        stamp_us = reading.t_device_ns // 1000 % 2**32
        return [record(0x2003, struct.pack("<I6f12x", stamp_us, *reading.acc_mps2, *rates_dps))]

    def answer(self, data: bytes, t_device_ns: int) -> list[bytes]:
        """Values that are asked for; those that it is given it takes."""
        written, self._buffer = records(self._buffer + data)
        out: list[bytes] = []
        for number, value in written:
            if not value:
                out.append(record(number, self._read(number)))
            elif number == 0x2001 and value[0] == 1:
                self._measures, self._payload = value[1] == 1, value[2]
            elif number == 0x1002 and value[0] & 0x10 and not self._measures:
                self._set_hz = int.from_bytes(value[24:26], "little")
        return out

    def _read(self, number: int) -> bytes:
        control = struct.pack("<B23xHB5x", 0, self._set_hz, 0)
        return {0x1001: INFO, 0x1002: control, 0x2001: bytes((1, self._measures, self._payload))}.get(number, b"")


SERIAL_WIRES: Final = ("xbus", "ximu3", "capture2go", "capture2go_ble", "witmotion", "movella_dot")


def serial_wire(kind: str, rate_hz: float, serial: str = SERIAL, air: Air | None = None) -> Wire:
    """One sensor's; ``air`` for those that can hear each other by radio. ValueError: a rate that it has not."""
    if kind.startswith("capture2go"):
        return Capture2GoWire(rate_hz, air, serial)
    if kind in ("witmotion", "movella_dot"):
        return WitmotionWire(rate_hz) if kind == "witmotion" else MovellaDotWire(rate_hz)
    return XbusWire(rate_hz, serial) if kind == "xbus" else Ximu3Wire()


def on_its_line(kind: str, imu: SimulatedImu, t_ns: int) -> SimulatedImu | Radio:
    """The sensor, or the radio that it is behind."""
    if kind == "capture2go_ble":
        return Radio(imu, t_ns, characteristics=(0x0002, 0x0003))
    return Radio(imu, t_ns, whole=True) if kind == "movella_dot" else imu
