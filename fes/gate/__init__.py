"""The safety gate: the last word before the wire. It imports signals, limits and settings, nothing else of ours."""

from fes.gate.gate import SafetyGate

__all__ = ["SafetyGate"]
