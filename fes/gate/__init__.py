"""The safety gate: the last word before the wire."""

from fes.gate.gate import Flagged, SafetyGate, gate_of

__all__ = ["Flagged", "SafetyGate", "gate_of"]
