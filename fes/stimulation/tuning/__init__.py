"""Stimulation that follows the measured foot, stride by stride, within bounds that the session sets."""
