"""An inertial sensor from a Lab Streaming Layer stream; needs the optional package ``pylsl``.

``port`` is the stream's name. Options: ``acc_x`` … ``gyr_z`` name channels by label (default: those very words),
``acc_unit`` (m/s2, g), ``gyr_unit`` (rad/s, deg/s), ``timeout_s`` (5). Stamps are the sender's, as they came: LSL's own
time correction is measured at every exchange and would make the intervals jitter; it is read once, for information.
"""

import importlib
import math
from typing import Any, Final

from drivers.imu.can_port import ACC_UNITS, GYR_UNITS
from drivers.imu.port import AXES, ImuLost, OneSensorPort, seconds_option, text_option
from fes.config import ImuDevice
from fes.signals import NS_PER_S, RawSample

PULL_AT_MOST: Final = 4096


class LslImu(OneSensorPort):
    """:class:`~drivers.imu.port.ImuPort` for one stream; the library has no descriptor to wait on.

    Raises:
        ImuLost: no library, no such stream, or the stream ended.
        ValueError: the stream has not the channels asked for, or a unit is unknown.
    """

    def __init__(self, device: ImuDevice) -> None:
        try:
            self._lsl: Any = importlib.import_module("pylsl")
            self._errors: Any = importlib.import_module("pylsl.util")
        except (ImportError, RuntimeError) as error:  # RuntimeError: no liblsl
            raise ImuLost(f"{device.sensor}: needs the package pylsl: pip install 'fes-gait[lsl]' ({error})") from error
        self.time_correction_s = math.nan
        super().__init__(device)

    def _open(self) -> None:
        device = self._device
        timeout_s = seconds_option(device, "timeout_s", 5.0)
        found = self._lsl.resolve_byprop("name", device.port, timeout=timeout_s)
        if not found:
            where = f"{device.sensor}: no LSL stream named {device.port!r}"
            raise ImuLost(f"{where} within {timeout_s:g} s. Is it running?")
        inlet = self._lsl.StreamInlet(found[0], max_buflen=10, recover=False)
        try:
            info = inlet.info(timeout=timeout_s)
            self._columns, self._factors = _columns(device, info)
            inlet.open_stream(timeout=timeout_s)
            self.time_correction_s = float(inlet.time_correction(timeout=timeout_s))
        except (self._errors.LostError, self._errors.TimeoutError) as error:
            raise ImuLost(f"{device.sensor}: LSL stream {device.port!r} went away: {error}") from error
        self._expect_samples()
        self._inlet: Any = inlet

    def fileno(self) -> None:
        """None: read at every tick."""
        return None

    def read(self, t_ns: int) -> list[RawSample]:
        """All that the library has received."""
        try:
            rows, stamps = self._inlet.pull_chunk(timeout=0.0, max_samples=PULL_AT_MOST)
        except self._errors.LostError as error:
            raise ImuLost(f"{self._device.sensor}: LSL stream {self._device.port!r} ended") from error
        samples: list[RawSample] = []
        for row, stamp in zip(rows or [], stamps or [], strict=True):
            if not math.isfinite(stamp):
                self._counts.bad_frames += 1
                continue
            v = [float(row[column]) * factor for column, factor in zip(self._columns, self._factors, strict=True)]
            samples.append(self._sample(t_ns, round(stamp * NS_PER_S), (v[0], v[1], v[2]), (v[3], v[4], v[5])))
        return samples

    def close(self) -> None:
        """Leave the stream."""
        self._inlet.close_stream()


def _columns(device: ImuDevice, info: Any) -> tuple[list[int], list[float]]:
    """Column and factor to SI of the six axes, by label and unit of the stream's description."""
    labels: list[str] = []
    units: list[str] = []
    channel = info.desc().child("channels").child("channel")
    for _ in range(info.channel_count()):
        labels.append(channel.child_value("label"))
        units.append(channel.child_value("unit"))
        channel = channel.next_sibling("channel")
    columns: list[int] = []
    factors: list[float] = []
    for axis in AXES:
        wanted = text_option(device, axis, axis).lower()
        found = [k for k, label in enumerate(labels) if label.lower() == wanted]
        if not found:
            raise ValueError(f"{device.sensor}: the LSL stream has no channel {wanted!r}; it has: {', '.join(labels)}")
        kind, table = ("acc_unit", ACC_UNITS) if axis.startswith("acc") else ("gyr_unit", GYR_UNITS)
        unit = text_option(device, kind, units[found[0]])
        if unit not in table:
            where = f"{device.sensor}: {wanted} is in {unit!r}"
            raise ValueError(f"{where}; set options.{kind} to one of {', '.join(table)}")
        columns.append(found[0])
        factors.append(table[unit])
    return columns, factors
