"""A sensor that writes a line of text a sample: microseconds, accelerations in g, rates in degrees per second."""

import math
import os

from drivers.imu.port import ImuLost, OneSensorPort
from fes.config import ImuDevice
from fes.signals import G_MPS2, RawSample

SCHEME = "lines://"  # a port that is no serial port has a scheme; `fes doctor` then opens it without looking for it


class LineSensor(OneSensorPort):
    """Reads the pipe or file that ``port = "lines:///path"`` names."""

    def __init__(self, device: ImuDevice) -> None:
        if not device.port.startswith(SCHEME):
            raise ValueError(f"{device.sensor}: port = {device.port!r} must begin with {SCHEME}")
        super().__init__(device)

    def _open(self) -> None:
        self._expect_samples()
        self._rest = b""
        try:
            self._file = os.open(self._device.port.removeprefix(SCHEME), os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise ImuLost(f"{self._device.port}: {error.strerror}; is the sensor switched on?") from error

    def fileno(self) -> int | None:
        return None  # read at every tick

    def read(self, t_ns: int) -> list[RawSample]:
        try:
            data = self._rest + os.read(self._file, 65536)
        except BlockingIOError:
            return []
        except OSError as error:
            raise ImuLost(f"{self._device.port}: {error.strerror}") from error
        *lines, self._rest = data.split(b"\n")
        samples = []
        for line in lines:
            try:
                t_us, ax, ay, az, gx, gy, gz = (float(cell) for cell in line.split(b","))
            except ValueError:
                self._counts.bad_frames += 1
                continue
            acc = ax * G_MPS2, ay * G_MPS2, az * G_MPS2
            gyr = math.radians(gx), math.radians(gy), math.radians(gz)
            samples.append(self._sample(t_ns, round(1000 * t_us), acc, gyr))
        return samples

    def close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
        self._file = -1
