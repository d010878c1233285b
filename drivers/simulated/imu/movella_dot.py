"""How a simulated Movella DOT answers, and says a sample; no I/O, no clock.

It shares no code and no constant with the driver's codec, so that the two check each other. Messages are records:
characteristic and length (two bytes each, the least significant first), value; one without a value asks for it. After a
loss of power it does not measure, and its clock begins anew.
"""

import math
import struct
from typing import Final

from drivers.simulated.imu.wire import Reading, Wire

RATES_HZ: Final = (60, 30)
INFO: Final = bytes.fromhex("5a8a00cd22d4 020601 e7070701020304 00000000 0d0c0b0a00000000 58532d543032")


class MovellaDotWire(Wire):
    """A sensor that can measure at this rate; it does so once that is set, too. ValueError: it has it not."""

    def __init__(self, rate_hz: float) -> None:
        if rate_hz not in RATES_HZ:
            raise ValueError(f"{rate_hz:g} Hz: a Movella DOT has {' and '.join(map(str, RATES_HZ))} by radio")
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
        return [_record(0x2003, struct.pack("<I6f12x", stamp_us, *reading.acc_mps2, *rates_dps))]

    def answer(self, data: bytes, t_device_ns: int) -> list[bytes]:
        """Values that are asked for; those that it is given it takes."""
        self._buffer += data
        out: list[bytes] = []
        while len(self._buffer) >= 4:
            number, size = struct.unpack_from("<HH", self._buffer)
            if len(self._buffer) < 4 + size:
                break
            value, self._buffer = self._buffer[4 : 4 + size], self._buffer[4 + size :]
            if not value:
                out.append(_record(number, self._read(number)))
            elif number == 0x2001 and value[0] == 1:
                self._measures, self._payload = value[1] == 1, value[2]
            elif number == 0x1002 and value[0] & 0x10 and not self._measures:
                self._set_hz = int.from_bytes(value[24:26], "little")
        return out

    def _read(self, number: int) -> bytes:
        control = struct.pack("<B23xHB5x", 0, self._set_hz, 0)
        return {0x1001: INFO, 0x1002: control, 0x2001: bytes((1, self._measures, self._payload))}.get(number, b"")


def _record(number: int, value: bytes) -> bytes:
    return struct.pack("<HH", number, len(value)) + value
