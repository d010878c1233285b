"""``python -m drivers.virtual.sciencemode2``: a simulated HASOMED RehaStim2 in its own process."""

import sys

from drivers.virtual.device_process import run_device
from drivers.virtual.sciencemode2_device import ScienceMode2Device

if __name__ == "__main__":
    sys.exit(run_device("sciencemode2", ScienceMode2Device))
