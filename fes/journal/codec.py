"""Single records' payloads ↔ values; what comes often is packed, what is rare is JSON."""

from __future__ import annotations

import dataclasses
import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from fes.journal.framing import RecordType
from fes.journal.record import Note, Received
from fes.signals import (
    SENSORS,
    FootSwitchEvent,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimOpened,
    StimStatus,
    StrideResult,
    SystemFault,
    Tick,
    WireFrame,
)
from statemachine.phases import Phase, PhaseChange, Transition

_TICK = struct.Struct("<q")
_ACT = struct.Struct("<qd")
_ALIVE = struct.Struct("<qqq")
_OPENED = struct.Struct("<qI")
_SWITCH = struct.Struct("<qBB")
_SILENT = 2  # beside not pressed and pressed
# from the narrowest form to the one that takes everything; the flags' upper bits say which
_STATUS = tuple(map(struct.Struct, ("<BqBBHffff", "<BqBBHdddd", "<Bqqqqdddd")))
_COMMAND = tuple(map(struct.Struct, ("<BqBHfff", "<BqBHddd", "<Bqqqddd")))
_FRAME = struct.Struct("<qI")
_PHASE = struct.Struct("<qBBBB")
_STRIDE = struct.Struct("<III")
_STRIDE_ARRAYS = ("trajectory_m", "pitch_rad")

RareEvent = Tick | OperatorAct | StimStatus | StimAlive | StimOpened | FootSwitchEvent | SystemFault
Rare = RareEvent | StimCommand | WireFrame | PhaseChange | StrideResult | Note | Received


def encode(value: Rare) -> tuple[RecordType, bytes]:
    """Return the record type and payload of a value.

    Raises:
        struct.error, TypeError, ValueError: a field holds what the log cannot.
    """
    match value:
        case Tick():
            return RecordType.TICK, _TICK.pack(value.t_ns)
        case StimCommand():
            numbers = (value.current_ma, value.pulse_width_us, value.frequency_hz)
            packed = _pack(_COMMAND, value.on, value.t_ns, value.channel, value.validity_ms, *numbers)
            return RecordType.COMMAND, packed + value.refused.encode()
        case WireFrame():
            return RecordType.FRAME, _FRAME.pack(value.t_ns, value.identifier) + value.data
        case StimStatus():
            numbers = (value.current_ma, value.pulse_width_us, value.frequency_hz)
            counts = (value.channel, value.counter, value.pulses)
            packed = _pack(_STATUS, value.on, value.t_ns, *counts, *numbers, value.charge_uc)
            return RecordType.STATUS, packed + value.fault.encode()
        case StimAlive():
            return RecordType.ALIVE, _ALIVE.pack(value.t_ns, value.boot_id, value.rejected) + value.fault.encode()
        case PhaseChange():
            foot = SENSORS.index(value.foot)
            return RecordType.PHASE, _PHASE.pack(value.t_ns, foot, value.transition, value.source, value.destination)
        case OperatorAct():
            said = f"{value.action}\n{value.why}" if value.why else str(value.action)
            return RecordType.ACT, _ACT.pack(value.t_ns, value.value) + said.encode()
        case Note():
            return RecordType.NOTE, encode_json(dataclasses.asdict(value))
        case StrideResult():
            return RecordType.STRIDE, _encode_stride(value)
        case StimOpened():
            return RecordType.STIM_OPENED, _OPENED.pack(value.t_ns, value.session_id)
        case FootSwitchEvent():
            pressed = _SILENT if value.pressed is None else value.pressed
            return RecordType.FOOT_SWITCH, _SWITCH.pack(value.t_ns, SENSORS.index(value.foot), pressed)
        case Received():
            return RecordType.RECEIVED, _TICK.pack(value.t_ns) + value.data
        case SystemFault():
            return RecordType.SYSTEM_FAULT, _TICK.pack(value.t_ns) + value.text.encode()


def decode(kind: int, payload: memoryview) -> Rare:
    """Return the value of a single record; the inverse of :func:`encode`.

    Raises:
        struct.error, ValueError, KeyError, IndexError, TypeError: the payload is not of this type.
    """
    match kind:
        case RecordType.TICK:
            return Tick(*_TICK.unpack(payload))
        case RecordType.COMMAND:
            (on, t_ns, channel, validity_ms, current_ma, pulse_width_us, frequency_hz), text = _unpack(
                _COMMAND, payload
            )
            return StimCommand(t_ns, channel, on, current_ma, pulse_width_us, frequency_hz, validity_ms, text)
        case RecordType.FRAME:
            t_ns, identifier = _FRAME.unpack_from(payload)
            return WireFrame(t_ns, identifier, bytes(payload[_FRAME.size :]))
        case RecordType.STATUS:
            (on, t_ns, channel, counter, pulses, current_ma, pulse_width_us, frequency_hz, charge_uc), text = _unpack(
                _STATUS, payload
            )
            return StimStatus(
                t_ns, channel, counter, on, current_ma, pulse_width_us, frequency_hz, pulses, charge_uc, text
            )
        case RecordType.ALIVE:
            t_ns, boot_id, rejected = _ALIVE.unpack_from(payload)
            return StimAlive(t_ns, boot_id, rejected, str(payload[_ALIVE.size :], "utf-8"))
        case RecordType.PHASE:
            t_ns, foot, transition, source, destination = _PHASE.unpack(payload)
            return PhaseChange(t_ns, SENSORS[foot], Transition(transition), Phase(source), Phase(destination))
        case RecordType.ACT:
            t_ns, value = _ACT.unpack_from(payload)
            action, _, why = str(payload[_ACT.size :], "utf-8").partition("\n")
            return OperatorAct(t_ns, OperatorAction(action), value, why)
        case RecordType.NOTE:
            return Note(**decode_json(payload))
        case RecordType.STRIDE:
            return _decode_stride(payload)
        case RecordType.STIM_OPENED:
            return StimOpened(*_OPENED.unpack(payload))
        case RecordType.FOOT_SWITCH:
            t_ns, foot, pressed = _SWITCH.unpack(payload)
            return FootSwitchEvent(t_ns, SENSORS[foot], None if pressed == _SILENT else bool(pressed))
        case RecordType.SYSTEM_FAULT:
            (t_ns,) = _TICK.unpack_from(payload)
            return SystemFault(t_ns, str(payload[_TICK.size :], "utf-8"))
        case RecordType.RECEIVED:
            (t_ns,) = _TICK.unpack_from(payload)
            return Received(t_ns, bytes(payload[_TICK.size :]))
        case _:
            raise ValueError(f"record type {kind} is no single value")


def decode_many(kind: int, payloads: Sequence[memoryview]) -> list[Any]:
    """Return the values of many single records of one type, as :func:`decode` each; what comes often in a third of
    the time.

    Raises:
        struct.error, ValueError, KeyError, IndexError, TypeError: as :func:`decode`.
    """
    if kind == RecordType.COMMAND:
        return [_usual_command(each) or decode(kind, each) for each in payloads]
    if kind == RecordType.STATUS:
        return [_usual_status(each) or decode(kind, each) for each in payloads]
    return [decode(kind, each) for each in payloads]


def _usual_command(payload: memoryview) -> StimCommand | None:
    """A command in the narrowest form that was not refused; None for any other."""
    if len(payload) != _COMMAND[0].size or payload[0] > 1:
        return None
    on, t_ns, channel, validity_ms, current_ma, pulse_width_us, frequency_hz = _COMMAND[0].unpack(payload)
    return StimCommand(t_ns, channel, on == 1, current_ma, pulse_width_us, frequency_hz, validity_ms)


def _usual_status(payload: memoryview) -> StimStatus | None:
    """An answer in the narrowest form without a fault; None for any other."""
    if len(payload) != _STATUS[0].size or payload[0] > 1:
        return None
    on, t_ns, channel, counter, pulses, current_ma, width_us, frequency_hz, charge_uc = _STATUS[0].unpack(payload)
    return StimStatus(t_ns, channel, counter, on == 1, current_ma, width_us, frequency_hz, pulses, charge_uc)


def _pack(forms: tuple[struct.Struct, ...], on: bool, *fields: float) -> bytes:
    """Pack in the first form that every field survives, else in the last."""
    for number, form in enumerate(forms[:-1]):
        try:
            packed = form.pack(on | number << 1, *fields)
        except (struct.error, OverflowError):
            continue
        if form.unpack(packed)[1:] == fields:
            return packed
    return forms[-1].pack(on | len(forms) - 1 << 1, *fields)


def _unpack(forms: tuple[struct.Struct, ...], payload: memoryview) -> tuple[tuple[Any, ...], str]:
    """Return (on and the fields, the text behind them)."""
    form = forms[payload[0] >> 1]
    flags, *fields = form.unpack_from(payload)
    return (bool(flags & 1), *fields), str(payload[form.size :], "utf-8")


def encode_json(values: dict[str, Any]) -> bytes:
    """Return UTF-8 JSON; NaN and infinities are kept, numpy's numbers become plain ones.

    Raises:
        TypeError, ValueError: a value is not plain data.
    """
    return json.dumps(values, ensure_ascii=False, separators=(",", ":"), default=_plain).encode()


def decode_json(payload: memoryview) -> dict[str, Any]:
    """Return the mapping in a JSON payload.

    Raises:
        ValueError: it is not JSON or not a mapping.
    """
    try:
        values = json.loads(bytes(payload))
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    if not isinstance(values, dict):
        raise ValueError("not a mapping")
    return values


def _plain(value: object) -> Any:
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not plain data")


def _encode_stride(stride: StrideResult) -> bytes:
    names = [field.name for field in dataclasses.fields(stride) if field.name not in _STRIDE_ARRAYS]
    text = encode_json({name: getattr(stride, name) for name in names})
    trajectory = np.ascontiguousarray(stride.trajectory_m, "<f4").reshape(-1, 3)
    pitch = np.ascontiguousarray(stride.pitch_rad, "<f4").reshape(-1)
    return _STRIDE.pack(len(text), len(trajectory), len(pitch)) + text + trajectory.tobytes() + pitch.tobytes()


def _decode_stride(payload: memoryview) -> StrideResult:
    text_bytes, rows, angles = _STRIDE.unpack_from(payload)
    start = _STRIDE.size + text_bytes
    numbers = np.frombuffer(payload, "<f4", 3 * rows + angles, start).astype(np.float64)
    fields = decode_json(payload[_STRIDE.size : start])
    return StrideResult(**fields, trajectory_m=numbers[: 3 * rows].reshape(-1, 3), pitch_rad=numbers[3 * rows :])
