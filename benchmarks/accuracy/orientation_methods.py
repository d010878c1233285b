"""The orientation filters that ``orientation.py`` compares: ours, and others where they are installed.

Nothing of this project depends on the others. Each runs with the default setting that its documentation gives and with
the recording's sampling rate; where a documentation's own example has further settings, these are a row of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.orientation.body import smooth_orientation, track_orientation
from fes.signals import G_MPS2, FloatArray

Run = Callable[[FloatArray, FloatArray, float], FloatArray]  # acc, gyr, rate -> (N, 4) w, x, y, z, sensor to world


class Method(NamedTuple):
    """A filter; ``package`` is what must be importable."""

    name: str
    causal: bool
    package: str
    run: Run

    @property
    def installed(self) -> bool:
        """Whether it can run here."""
        return find_spec(self.package) is not None


def _vqf(name: str) -> Run:
    def run(acc: FloatArray, gyr: FloatArray, rate_hz: float) -> FloatArray:
        import vqf

        if name == "offlineVQF":
            return np.asarray(vqf.offlineVQF(gyr, acc, None, 1.0 / rate_hz)["quat6D"])
        return np.asarray(getattr(vqf, name)(1.0 / rate_hz).updateBatch(gyr, acc)["quat6D"])

    return run


def _imufusion(**settings: float) -> Run:
    def run(acc: FloatArray, gyr: FloatArray, rate_hz: float) -> FloatArray:
        import imufusion

        ahrs = imufusion.Ahrs()
        chosen: Any = imufusion.AhrsSettings()
        chosen.sample_rate = rate_hz
        for key, value in settings.items():
            setattr(chosen, key, value)
        ahrs.set_settings(chosen)
        out = np.empty((len(acc), 4))
        for k, (rate, force) in enumerate(zip(np.degrees(gyr), acc / G_MPS2, strict=True)):
            ahrs.update_no_magnetometer(rate, force)
            out[k] = ahrs.get_quaternion()
        return out

    return run


def _ahrs(name: str) -> Run:
    def run(acc: FloatArray, gyr: FloatArray, rate_hz: float) -> FloatArray:
        from ahrs import filters

        return np.asarray(getattr(filters, name)(gyr=gyr, acc=acc, frequency=rate_hz).Q)

    return run


def _ours(smoothed: bool) -> Run:
    track = smooth_orientation if smoothed else track_orientation
    return lambda acc, gyr, rate_hz: track(acc, gyr, rate_hz).quaternion


METHODS = (
    Method("ours, causal", True, "fes", _ours(smoothed=False)),
    Method("ours, off-line", False, "fes", _ours(smoothed=True)),
    Method("VQF", True, "vqf", _vqf("VQF")),
    Method("BasicVQF", True, "vqf", _vqf("BasicVQF")),
    Method("VQF, off-line", False, "vqf", _vqf("offlineVQF")),
    Method("imufusion", True, "imufusion", _imufusion()),
    Method(
        "imufusion, its example's settings",
        True,
        "imufusion",
        _imufusion(gain=0.5, gyroscope_range=2000.0, acceleration_rejection=10.0, rejection_timeout=5.0),
    ),
    Method("Madgwick (ahrs)", True, "ahrs", _ahrs("Madgwick")),
    Method("Mahony (ahrs)", True, "ahrs", _ahrs("Mahony")),
    Method("EKF (ahrs)", True, "ahrs", _ahrs("EKF")),
)
