"""What a foot sensor's strides tell of the sensor itself: whether it lies, in what, by how much and from when on."""

from fes.witness.verdict import Lie, Testimony, corrected, examine

__all__ = ["Lie", "Testimony", "corrected", "examine"]
