"""What ``import fes`` offers, for type checkers and editors."""

from fes.notebook import analyse as analyse
from fes.notebook import calibrate as calibrate
from fes.notebook import evaluate as evaluate
from fes.notebook import load_session as load_session
from fes.notebook import read as read
from fes.notebook import read_log as read_log
from fes.notebook import replay as replay
from fes.notebook import simulate as simulate
from fes.recording.arrays import recording_from_arrays as recording
from fes.simulation import bundled_file as bundled_file

__all__ = [
    "analyse",
    "bundled_file",
    "calibrate",
    "evaluate",
    "load_session",
    "read",
    "read_log",
    "recording",
    "replay",
    "simulate",
]
__version__: str
