"""A recording without a sidecar: the proposal for one is put beside it, and what is open in it is shown."""

from __future__ import annotations

from fes.recording.tracks import SidecarMissingError


def error_text(error: Exception) -> str:
    """What to show of an error; of a missing sidecar, after writing the proposal where it is due.

    A file that is there and not empty is never touched. Where nothing can be written the proposal is shown instead.
    """
    if not isinstance(error, SidecarMissingError):
        return str(error)
    try:
        with error.sidecar.open("a", encoding="utf-8") as file:
            if file.tell():
                return str(error)
            file.write(error.proposal)
    except OSError:
        return str(error)
    lines = error.proposal.splitlines()
    opened = [number for number, line in enumerate(lines, start=1) if "?" in line and not line.startswith("#   ")]
    if opened:
        one = len(opened) == 1
        todo = (
            f"{'One answer is' if one else f'{len(opened)} answers are'} missing: the “?” in "
            f"{'line' if one else 'lines'} {', '.join(map(str, opened))} of {error.sidecar}. "
            f"Fill {'it' if one else 'them'} in with a text editor, check the rest, then give the same command again."
        )
    else:
        todo = f"No answer is missing. If {error.sidecar} is right, give the same command again."
    return f"{error.sidecar} was missing, so a proposal is written there. It says:\n\n{error.proposal}\n{todo}"
