"""References that a recording is held against: motion capture, ultrasound, treadmill, step mats, foot switches.

Every reader gives the same :class:`fes.evaluation.reference.types.Reference`;
:func:`fes.evaluation.reference.compare.compare` pairs it with what was estimated.
"""

from fes.evaluation.reference.types import MarkerPath, Reference, ReferenceError, ReferenceEvent, ReferenceStride

__all__ = ["MarkerPath", "Reference", "ReferenceError", "ReferenceEvent", "ReferenceStride"]
