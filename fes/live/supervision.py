"""What controller and supervisor say to each other: one datagram holds one request, or its answer, and records.

A datagram is ``u32 number | u8 what | i64 time`` and records, each ``u8 kind | u16 bytes | payload``. The
controller's: the events that its gate has observed since its last one, and for :attr:`What.COMMAND` the command behind
them. The supervisor's, under the request's number: what it did by itself (commands, each with its frame) and its
faults, then what was asked for. Payloads are the session log's, but for samples, which are of a fixed size here.
"""

import struct
from enum import IntEnum
from typing import Final, NamedTuple

from fes.session_log.codec import Rare, decode, encode
from fes.session_log.framing import RecordType
from fes.signals import SENSORS, ImuSample

MOST_BYTES: Final = 1 << 16  # of a datagram
UNSENT: Final = 0  # the identifier of a frame that did not go out
OWN: Final = "by the supervisor: "  # begins the reason of a command that the controller did not ask for
MALFORMED: Final = (struct.error, ValueError, KeyError, IndexError, TypeError, OverflowError)
_HEAD = struct.Struct("<IBq")
_RECORD = struct.Struct("<BH")
_SAMPLE = struct.Struct("<qBq6d")
_WHOLE_SAMPLE = struct.Struct("<BHqBq6d")
_LINE = struct.Struct("<Id")
_LINE_KIND: Final = 200  # beyond the log's own
_NUMBER_OF: Final = {sensor: number for number, sensor in enumerate(SENSORS)}


class What(IntEnum):
    """What a datagram asks, or how what it asked for went."""

    NOTHING = 0  # events only; is not answered
    COMMAND = 1
    POLL = 2
    OPEN = 3
    CLOSE = 4  # is not answered
    DONE = 10
    LOST = 11  # the line; the last value is a SystemFault that says why
    IMPOSSIBLE = 12  # ValueError; likewise


class LineOpened(NamedTuple):
    """The stimulator's session was opened under this identifier; its step between two currents."""

    session_id: int
    current_step_ma: float


Value = Rare | ImuSample | LineOpened


class Datagram(NamedTuple):
    """One of either side; an answer's time is when what was asked had been done."""

    number: int
    what: What
    t_ns: int
    values: list[Value]


def packed(value: Value) -> bytes:
    """A value as a record."""
    if isinstance(value, ImuSample):
        t_ns, sensor, t_sensor_ns, acc, gyr = value
        number = _NUMBER_OF[sensor]
        return _WHOLE_SAMPLE.pack(RecordType.SAMPLES, _SAMPLE.size, t_ns, number, t_sensor_ns, *acc, *gyr)
    kind, payload = (_LINE_KIND, _LINE.pack(*value)) if isinstance(value, LineOpened) else encode(value)
    return _RECORD.pack(kind, len(payload)) + payload


def datagram(number: int, what: What, t_ns: int, records: bytes | bytearray) -> bytes:
    """A request or an answer with its records, as :func:`packed` makes them."""
    return _HEAD.pack(number & 0xFFFF_FFFF, what, t_ns) + records


def unpacked(data: bytes) -> Datagram:
    """The inverse.

    Raises:
        one of MALFORMED: it is none.
    """
    if len(data) > MOST_BYTES:
        raise ValueError("longer than any")
    number, what, t_ns = _HEAD.unpack_from(data)
    values: list[Value] = []
    view, at = memoryview(data), _HEAD.size
    while at < len(view):
        kind, length = _RECORD.unpack_from(view, at)
        at += _RECORD.size + length
        if at > len(view):
            raise ValueError("a record is cut off")
        payload = view[at - length : at]
        if kind == RecordType.SAMPLES:
            t_sample_ns, sensor, t_sensor_ns, ax, ay, az, p, q, r = _SAMPLE.unpack(payload)
            values.append(ImuSample(t_sample_ns, SENSORS[sensor], t_sensor_ns, (ax, ay, az), (p, q, r)))
        elif kind == _LINE_KIND:
            values.append(LineOpened(*_LINE.unpack(payload)))
        else:
            values.append(decode(kind, payload))
    return Datagram(number, What(what), t_ns, values)
