"""The few CANopen frames that a stimulator needs, and where the settings say that its values are; no I/O.

Source: CiA 301: expedited SDO download, SYNC, NMT start, heartbeat.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import can

NMT_ID: Final = 0x000
SYNC_ID: Final = 0x080
BOOT_UP: Final = 0  # the heartbeat's state in a node's first message after its start
OPERATIONAL: Final = 5
_DOWNLOAD: Final = {1: 0x2F, 2: 0x2B, 4: 0x23}  # expedited, size given
_DOWNLOADED: Final = 0x60
_ABORTED: Final = 0x80
_START: Final = 0x01


@dataclass(frozen=True, slots=True)
class Sdo:
    """A value for one entry of the node's object dictionary."""

    index: int
    subindex: int
    value: int
    size: int


@dataclass(frozen=True, slots=True)
class CanOpenSettings:
    """Where things are in this device's object dictionary, and in which steps.

    Channel ``n`` is subindex ``n + 1``. ``value_bytes`` is 1, 2 or 4. ``max_current_ma`` and ``max_width_us`` are the
    device's own limits.
    """

    node_id: int
    current_index: int
    width_index: int
    current_step_ma: float
    width_step_us: float
    max_current_ma: float
    max_width_us: float
    value_bytes: int = 1
    heartbeat_ms: int = 500

    def __post_init__(self) -> None:
        entries = (0x2000, 0x9FFF)
        whole = {"node_id": (1, 127), "current_index": entries, "width_index": entries, "heartbeat_ms": (10, 10_000)}
        for name, (least, most) in whole.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
                raise ValueError(f"{name} = {value!r} must be a whole number from {least} to {most}")
        if isinstance(self.value_bytes, (bool, float)) or self.value_bytes not in _DOWNLOAD:
            raise ValueError(f"value_bytes = {self.value_bytes!r} must be 1, 2 or 4")
        for name in ("current_step_ma", "width_step_us", "max_current_ma", "max_width_us"):
            value = getattr(self, name)
            if isinstance(value, (bool, str)) or not math.isfinite(value) or not value > 0:
                raise ValueError(f"{name} = {value!r} must be a number above 0")
        if self.current_index == self.width_index:
            raise ValueError(f"current_index and width_index are both 0x{self.width_index:04x}")

    @classmethod
    def from_options(cls, options: Mapping[str, Any]) -> CanOpenSettings:
        """From a session's options. ValueError: one is missing, unknown or out of range; the message names it."""
        try:
            return cls(**options)
        except TypeError as error:
            raise ValueError(str(error).replace("CanOpenSettings.__init__() ", "")) from None

    @property
    def heartbeat_id(self) -> int:
        """Identifier of the node's heartbeat."""
        return 0x700 + self.node_id

    @property
    def answer_id(self) -> int:
        """Identifier of the node's SDO answers."""
        return 0x580 + self.node_id

    def steps(self, current_ma: float, pulse_width_us: float) -> list[int]:
        """Current and width in the device's steps, rounded down.

        Raises:
            ValueError: not finite, negative, or over the device's limits or what its entries hold.
        """
        out: list[int] = []
        current = ("current_ma", current_ma, self.current_step_ma, self.max_current_ma)
        width = ("pulse_width_us", pulse_width_us, self.width_step_us, self.max_width_us)
        for name, value, step, most in (current, width):
            if not math.isfinite(value) or not 0 <= value <= most:
                raise ValueError(f"{name} = {value!r}; this stimulator takes 0 to {most:g}")
            steps = math.floor(value / step)
            if steps >= 1 << 8 * self.value_bytes:
                raise ValueError(f"{name} = {value!r} does not fit an entry of {self.value_bytes} bytes")
            out.append(steps)
        return out

    def sdo(self, what: int, channel: int, value: int) -> Sdo:
        """The entry for a channel's current (0) or width (1)."""
        return Sdo((self.current_index, self.width_index)[what], channel + 1, value, self.value_bytes)

    def answers(self, sdo: Sdo, message: can.Message) -> bool:
        """Whether this is the node's answer to that download, good or bad."""
        if message.arbitration_id != self.answer_id or len(message.data) != 8:
            return False
        command, index, subindex = struct.unpack_from("<BHB", message.data)
        return command in (_DOWNLOADED, _ABORTED) and (index, subindex) == (sdo.index, sdo.subindex)

    @staticmethod
    def refusal(message: can.Message) -> str:
        """Why the node refused; "" when it did not."""
        if message.data[0] != _ABORTED:
            return ""
        _, index, subindex, code = struct.unpack("<BHBI", bytes(message.data))
        return f"refused object 0x{index:04x}:{subindex} (SDO abort 0x{code:08x})"


def encode_download(node_id: int, sdo: Sdo) -> tuple[int, bytes]:
    """Identifier and data of an expedited download."""
    value = sdo.value.to_bytes(sdo.size, "little").ljust(4, b"\0")
    return 0x600 + node_id, struct.pack("<BHB", _DOWNLOAD[sdo.size], sdo.index, sdo.subindex) + value


def encode_start(node_id: int) -> tuple[int, bytes]:
    """Identifier and data of NMT start for this node."""
    return NMT_ID, bytes((_START, node_id))
