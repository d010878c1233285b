"""A DBC that the project does not ship, and the options that name its signals."""

from __future__ import annotations

from pathlib import Path

# a layout unlike the Xsens': three messages, both byte orders, a signal nobody names, a clock of 16 bits
DBC = """VERSION ""
BU_: A
BO_ 300 Gyr: 6 A
 SG_ X : 0|16@1- (0.0625,0) [0|0] "dps" A
 SG_ Y : 16|16@1- (0.0625,0) [0|0] "dps" A
 SG_ Z : 32|16@1- (0.0625,0) [0|0] "dps" A
BO_ 256 Acc: 8 A
 SG_ X : 7|16@0- (0.00048828125,0) [0|0] "g" A
 SG_ Y : 23|16@0- (0.00048828125,0) [0|0] "g" A
 SG_ Z : 39|16@0- (0.00048828125,0) [0|0] "g" A
 SG_ Temperature : 55|16@0- (0.1,20) [0|0] "C" A
BO_ 400 Clock: 3 A
 SG_ Stamp : 0|16@1+ (0.5,-100) [0|0] "ms" A
 SG_ Count : 16|8@1+ (1,0) [0|0] "" A
"""
OPTIONS = {
    **{f"acc_{axis}": f"Acc.{axis.upper()}" for axis in "xyz"},
    **{f"gyr_{axis}": f"Gyr.{axis.upper()}" for axis in "xyz"},
    "time": "Clock.Stamp",
    "counter": "Clock.Count",
    "time_unit": "ms",
    "acc_unit": "g",
    "gyr_unit": "deg/s",
    "id_offset": 2,
}


def dbc_options(folder: Path, text: str = DBC, **change: str | float) -> dict[str, str | int | float | bool]:
    path = folder / "imu.dbc"
    path.write_text(text, encoding="ascii")
    return {**OPTIONS, "dbc": str(path), **change}
