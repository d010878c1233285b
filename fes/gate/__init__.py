"""The safety gate: the last word before the wire."""

from fes.gate.gate import STOPPED, Flagged, SafetyGate, gate_of

__all__ = ["STOPPED", "Flagged", "SafetyGate", "gate_of"]
