"""How a simulated WitMotion sensor answers, and says a sample; no I/O, no clock.

It shares no code and no constant with the driver's codec, so that the two check each other. As shipped it sends no
time. Registers are written for 10 s after the key, and kept over a loss of power once they were saved. Its clock was
never set: it begins with the power, on a day 0 of month 0. Its rates are exactly 0 once they stay below register 6F
(0.3 °/s, as shipped) for as long as register 6E says (0.5 s); here by the root mean square of the last so many samples.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from typing import Final

from drivers.simulated.imu.wire import Reading, Wire
from fes.signals import G_MPS2, NS_PER_S

SHIPPED: Final = {0x02: 0x1E, 0x03: 0x06, 0x04: 0x06, 0x1F: 0x04, 0x20: 0x03, 0x6E: 500, 0x6F: 300}
RATES: Final = {0x08: 50, 0x09: 100, 0x0B: 200}
OPEN_NS: Final = 10 * NS_PER_S
DAY_MS: Final = 86_400_000


class WitmotionWire(Wire):
    """A sensor that measures at this rate; it sends nothing while another one is set. ValueError: it has it not."""

    carries_nan = False

    def __init__(self, rate_hz: float) -> None:
        if rate_hz not in RATES.values():
            raise ValueError(f"{rate_hz:g} Hz: a WitMotion sensor has {', '.join(map(str, RATES.values()))}")
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
        if not reading.finite or RATES.get(self._registers[0x03]) != self._rate_hz:
            return []
        rates_dps = [math.degrees(rate) for rate in reading.gyr_radps]
        self._felt.append(max(rate * rate for rate in rates_dps))
        if sum(self._felt) / len(self._felt) < (self._registers[0x6F] / 1000) ** 2:
            rates_dps = [0.0, 0.0, 0.0]
        of_day_ms = reading.t_device_ns // 1_000_000 % DAY_MS
        seconds, ms = divmod(of_day_ms, 1000)
        frames = {
            0: (0x50, struct.pack("<6BH", 0, 0, 0, seconds // 3600, seconds // 60 % 60, seconds % 60, ms)),
            1: (0x51, _steps([force / G_MPS2 * 2048 for force in reading.acc_mps2])),
            2: (0x52, _steps([rate * 16.384 for rate in rates_dps])),
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


def _steps(values: list[float]) -> bytes:
    return struct.pack("<4h", *(round(min(max(value, -32768), 32767)) for value in values), 2500)  # at 25 °C
