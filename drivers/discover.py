"""What is plugged in: serial ports, CAN interfaces, Lab Streaming Layer streams. Looks only; opens no device."""

import contextlib
import importlib
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import can
from serial.tools import list_ports

_ARPHRD_CAN: Final = "280"  # linux/if_arp.h
_ADAPTERS: Final = ("pcan", "kvaser")  # python-can finds these without opening them; others take seconds
_MAKERS: Final = {0x2639: "Xsens", 0x0403: "FTDI"}
_WORDS: Final = {
    "capture2go": "SensorStim",
    "sensorstim": "SensorStim",
    "xsens": "Xsens",
    "movella": "Xsens",
    "x-io": "x-io",
    "x-imu3": "x-io",
    "hasomed": "HASOMED",
    "reha": "HASOMED",
    "ftdi": "FTDI",
    "future technology": "FTDI",
}


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port: ``usb`` is VID:PID in hex ("" for none), ``maker`` what it looks like ("" for nothing known)."""

    port: str
    description: str
    usb: str = ""
    maker: str = ""


@dataclass(frozen=True, slots=True)
class CanChannel:
    """A CAN interface that ``bus.interface`` and ``bus.channel`` name; ``state`` is up, down, or "" where unknown."""

    interface: str
    channel: str
    state: str = ""


@dataclass(frozen=True, slots=True)
class LslStream:
    """A stream of Lab Streaming Layer."""

    name: str
    kind: str
    channels: int
    rate_hz: float


def serial_ports() -> list[SerialPort]:
    """All of them, by name."""
    found = []
    for each in list_ports.comports():
        text = " ".join(str(part) for part in (each.manufacturer, each.product, each.description) if part)
        usb = "" if each.vid is None else f"{each.vid:04X}:{each.pid or 0:04X}"
        description = each.description if each.description not in (None, "n/a") else ""
        found.append(SerialPort(each.device, description, usb, device_maker(text, each.vid)))
    return sorted(found, key=lambda port: port.port)


def device_maker(text: str, vid: int | None) -> str:
    """Whose device says so of itself; an FTDI chip is in many of them, so words come first."""
    for word, maker in _WORDS.items():
        if word in text.lower():
            return maker
    return _MAKERS.get(vid, "") if vid is not None else ""


def can_channels(net: Path = Path("/sys/class/net")) -> list[CanChannel]:
    """SocketCAN's interfaces, and adapters whose libraries are installed."""
    found = []
    for kind in sorted(net.glob("*/type")):
        with contextlib.suppress(OSError):
            if kind.read_text(encoding="ascii").strip() == _ARPHRD_CAN:
                flags = int((kind.parent / "flags").read_text(encoding="ascii"), 16)
                found.append(CanChannel("socketcan", kind.parent.name, "up" if flags & 1 else "down"))
    quiet = logging.getLogger("can")
    before = quiet.level
    quiet.setLevel(logging.CRITICAL)  # a library that is not installed is no news
    try:
        adapters = can.detect_available_configs(list(_ADAPTERS))
        found += [CanChannel(str(adapter["interface"]), str(adapter["channel"])) for adapter in adapters]
    finally:
        quiet.setLevel(before)
    return found


def lsl_streams(wait_s: float = 1.0) -> list[LslStream] | None:
    """Streams that answer within ``wait_s``; None where the package ``pylsl`` is not installed."""
    try:
        lsl: Any = importlib.import_module("pylsl")
    except (ImportError, RuntimeError):  # RuntimeError: no liblsl
        return None
    infos = sorted(lsl.resolve_streams(wait_s), key=lambda info: str(info.name()))
    return [LslStream(info.name(), info.type(), info.channel_count(), info.nominal_srate()) for info in infos]
