"""How well two ways of measuring agree: matching, time lag, differences, limits of agreement, ICC, regression.

Pure: arrays in, numbers out. Nothing here knows of files, feet or sensors.
"""

from fes.evaluation.agreement.lag import Lag, lag_of, trains
from fes.evaluation.agreement.paired import Differences, Icc, Interval, Line, differences, icc_2_1, line_through

__all__ = [
    "Differences",
    "Icc",
    "Interval",
    "Lag",
    "Line",
    "differences",
    "icc_2_1",
    "lag_of",
    "line_through",
    "trains",
]
