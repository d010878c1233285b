"""``python -m drivers.virtual.sciencemode4``: a simulated HASOMED P24 / RehaMove3 in its own process."""

import sys

from drivers.virtual.device_process import run_device
from drivers.virtual.sciencemode4_device import ScienceMode4Device

if __name__ == "__main__":
    sys.exit(run_device("sciencemode4", ScienceMode4Device))
