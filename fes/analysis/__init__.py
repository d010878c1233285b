"""Off-line analysis of a recording: no stimulation, no clock, no devices."""
