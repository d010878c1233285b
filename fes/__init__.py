"""Functional electrical stimulation timed by how the patient walks.

For Python and notebooks, each with an example in ``docs/api.md``:

=====================  ==============================================================================
``read``               a recording's file, with its sidecar → recording
``recording``          arrays → recording
``calibrate``          a recording → how its sensors sit
``analyse``            a recording → strides, events, phases, path, gait parameters, report
``load_session``       ``session.toml`` → settings of a session
``replay``             a recording through the loop of a live session, into a simulated stimulator
``read_log``           a session log → its strides, phases, commands
``simulate``           a virtual patient walks, stimulated or not
``evaluate``           an analysis or a session log against a reference
``bundled_file``       a bundled recording's path, to try all of this on
=====================  ==============================================================================

All of them are loaded when they are first asked for; their types are in ``__init__.pyi``.
"""

from importlib import import_module

__version__ = "0.2.0"
__all__ = [
    "analyse",
    "bundled_file",
    "calibrate",
    "evaluate",
    "load_session",
    "read",
    "read_log",
    "recording",
    "replay",
    "simulate",
]


def __getattr__(name: str) -> object:
    if name == "recording":
        return import_module("fes.recording")  # the room's face, which can be called
    if name == "bundled_file":
        return import_module("fes.simulation").bundled_file
    if name in __all__:
        return getattr(import_module("fes.notebook"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({"__version__", *__all__})
