"""The safety gate: the last word before the wire."""

from fes.gate.gate import SafetyGate
from fes.gate.of_session import gate_of

__all__ = ["SafetyGate", "gate_of"]
