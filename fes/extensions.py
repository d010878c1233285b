"""Parts that other packages bring, by entry points: sensors, stimulators, detectors, stride methods, importers, tuners.

A package names them in its own ``pyproject.toml`` (docs/extensions.md). One is loaded when a setting, an argument or a
command names it, never before, and never in place of a part of this program.
"""

from importlib.metadata import EntryPoint, entry_points
from typing import Any, Final

GROUPS: Final = {
    "sensor": "fes.sensors",
    "stimulator": "fes.stimulators",
    "detector": "fes.detectors",
    "stride method": "fes.stride_methods",
    "importer": "fes.importers",
    "tuner": "fes.tuners",
}


class ExtensionError(ValueError):
    """A part cannot be had, or what it gave cannot be used; the message names it and the package that brings it."""


def extension_names(kind: str) -> tuple[str, ...]:
    """Names that installed packages give to parts of this kind (a key of :data:`GROUPS`), in alphabetical order."""
    return tuple(sorted({each.name for each in entry_points(group=GROUPS[kind])}))


def load_extension(kind: str, name: str) -> Any:
    """The object behind an entry point.

    Raises:
        ExtensionError: no package brings it, two do, or it cannot be imported.
    """
    found: list[EntryPoint] = list(entry_points(group=GROUPS[kind], name=name))
    if not found:
        known = ", ".join(extension_names(kind)) or "none"
        raise ExtensionError(f"no installed package brings a {kind} {name!r}; there are: {known}")
    if len({each.value for each in found}) > 1:
        packages = ", ".join(sorted(package_of(each) for each in found))
        raise ExtensionError(f"several packages bring a {kind} {name!r}: {packages}; uninstall all but one")
    try:
        return found[0].load()
    except Exception as error:  # whatever another's module raises when it is imported
        said = f"{type(error).__name__}: {error}"
        raise ExtensionError(f"{kind} {name!r} of {package_of(found[0])} cannot be imported: {said}") from error


def package_of(part: EntryPoint) -> str:
    """The name of the package that brings it."""
    return part.dist.name if part.dist is not None else part.value
