"""Who may do what on the dashboard: one-time links, the one browser that controls, confirmations."""

import hmac
import os
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

LOOPBACK: Final = "127.0.0.1"
CONFIRM_WITHIN_NS: Final = 10_000_000_000
EARLIER_KEPT: Final = 16


def link_address(port: int, token: str) -> str:
    """The address to open; what stands behind # never leaves the browser by itself."""
    return f"http://{LOOPBACK}:{port}/#{token}"


def write_link(path: Path, address: str) -> None:
    """Put the address into its file, for the owner only; who reads meanwhile gets the old one or the new one.

    Raises:
        OSError: it cannot be written.
    """
    new = path.with_suffix(".new")
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        file.write(address + "\n")
    new.replace(path)


class Role(StrEnum):
    """What a browser may do beside stopping, which everybody may."""

    NOBODY = "nobody"
    WATCH = "watch"  # see, lower, pause
    CONTROL = "control"  # also say what is walked on; arm, raise and go on, each after a confirmation


class Access:
    """Links and the secrets that browsers got for them.

    A link works once: its token buys a secret, and a new link is made. The newest secret controls; those before it go
    on watching. ``token`` is the first link's; ``new_token`` makes tokens and secrets.
    """

    def __init__(self, token: str, new_token: Callable[[], str]) -> None:
        self.token = token
        self._new_token = new_token
        self._controls = ""
        self._earlier: deque[str] = deque(maxlen=EARLIER_KEPT)

    def enter(self, token: str) -> str:
        """The secret for a link's token; "" where it is wrong or used up."""
        if not _same(token, self.token):
            return ""
        self.token = self._new_token()
        if self._controls:
            self._earlier.append(self._controls)
        self._controls = self._new_token()
        return self._controls

    def role(self, secret: str) -> Role:
        """What the browser that holds this secret may do now."""
        if _same(secret, self._controls):
            return Role.CONTROL
        watches = [_same(secret, earlier) for earlier in self._earlier]
        return Role.WATCH if any(watches) else Role.NOBODY


def _same(one: str, other: str) -> bool:
    return bool(other) and hmac.compare_digest(one.encode(errors="replace"), other.encode())


@dataclass(frozen=True, slots=True)
class Situation:
    """What a person saw when asked: the session's state, the intensity (0–1), how many stops there had been."""

    state: str
    intensity: float
    stops: int = 0


class Confirmations:
    """One browser's open question: answered once, within ten seconds, and only while things are as they were."""

    def __init__(self, new_token: Callable[[], str]) -> None:
        self._new_token = new_token
        self._open: tuple[str, str, Situation, int] | None = None

    def ask(self, what: str, situation: Situation, t_ns: int) -> str:
        """A question's identifier; an earlier question is forgotten."""
        self._open = (self._new_token(), what, situation, t_ns)
        return self._open[0]

    def forget(self) -> None:
        """The question is not open any more."""
        self._open = None

    def answer(self, identifier: str, situation: Situation, t_ns: int) -> tuple[str, str]:
        """What was confirmed, or "" and why it was not."""
        asked, self._open = self._open, None
        if asked is None or not _same(identifier, asked[0]):
            return "", "nothing was asked"
        _, what, before, asked_ns = asked
        if t_ns - asked_ns > CONFIRM_WITHIN_NS:
            return "", "not confirmed within 10 s; nothing was done"
        same = (before.state, before.stops) == (situation.state, situation.stops)
        same = same and abs(before.intensity - situation.intensity) < 1e-6
        return (what, "") if same else ("", "the session has changed meanwhile; nothing was done")
