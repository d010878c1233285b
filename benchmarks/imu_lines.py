"""Loss and latency of two simulated inertial sensors: ``python benchmarks/imu_lines.py --seconds 30 --rate 500``."""

from __future__ import annotations

import argparse
import select
import time

from drivers.imu.open import open_imus
from drivers.simulated.spawn import spawn_imu
from fes.config.session import ImuDevice


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=500.0)
    options = parser.parse_args()
    lines = [("xbus", {"baudrate": 921600}), ("ximu3", {}), ("ximu3", {"library": True})]
    for kind, extra in lines:
        with (
            spawn_imu(kind, sensor="left_foot", rate_hz=options.rate) as left,
            spawn_imu(kind, sensor="right_foot", rate_hz=options.rate) as right,
        ):
            worn = {"left_foot": left, "right_foot": right}
            common = {"device": kind, "rate_hz": options.rate, "acc_range_g": 16.0, "gyr_range_dps": 2000.0}
            ports = open_imus(
                [
                    ImuDevice.model_validate(common | {"sensor": name, "port": handle.port, "options": extra})
                    for name, handle in worn.items()
                ]
            )
            late_ms: list[float] = []
            begin_s = time.monotonic() + 1.0  # what waited in the line while it was opened is not its latency
            end_s = begin_s + options.seconds
            while time.monotonic() < end_s:
                select.select([port.fileno() for port in ports], [], [], 0.1)
                for port in ports:
                    for sample in port.read(time.monotonic_ns()):
                        if time.monotonic() < begin_s:
                            continue
                        taken_ns = worn[sample.sensor].t0_ns + sample.t_device_ns
                        late_ms.append((sample.t_host_ns - taken_ns) / 1e6)
            lost = sum(counts.missing + counts.bad_frames for port in ports for counts in port.counts.values())
            late_ms.sort()
            p50, p99, p999 = (late_ms[int(share * len(late_ms))] for share in (0.5, 0.99, 0.999))
            name = kind + (" (library)" if extra.get("library") else "")
            print(f"{name:16s} {len(late_ms)} samples, {lost} lost; ms late: {p50:.2f} p99 {p99:.2f} p99.9 {p999:.2f}")
            for port in ports:
                port.close()


if __name__ == "__main__":
    main()
