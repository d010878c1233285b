"""How well two ways of measuring agree: limits of agreement, ICC, regression, and the lag of their clocks.

Arrays in, numbers out. Nothing here knows of files, feet or sensors.
"""

from fes.evaluation.agreement.lag import Lag, event_trains, find_lag
from fes.evaluation.agreement.paired import Differences, Interval, RegressionLine, differences, icc_2_1, regression_line

__all__ = [
    "Differences",
    "Interval",
    "Lag",
    "RegressionLine",
    "differences",
    "event_trains",
    "find_lag",
    "icc_2_1",
    "regression_line",
]
