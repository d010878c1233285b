"""One browser's messages: what each means, what is answered, what goes on to the session. No clock, no I/O."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from fes.config import STEEPEST_PERCENT
from fes.live.commands import NEEDS_CONFIRMATION, CommandKind, CommandRefused, mark_text
from fes.live.dashboard.access import Access, Confirmations, Role, Situation
from fes.live.status import Status

RESUME: Final = "resume"
CALMING: Final = frozenset((CommandKind.PAUSE, CommandKind.DOWN, CommandKind.DISARM))
GROUND: Final = frozenset((CommandKind.GROUND, CommandKind.GROUND_FREE))
RAISING: Final = frozenset((CommandKind.ARM, CommandKind.UP, RESUME))
LONGEST: Final = 512
NAME: Final = 40  # characters of a press's name
COMMANDS_A_SECOND: Final = 10
FRESH_NS: Final = 500_000_000
CURRENT: Final = ("armed", "running")


@dataclass(frozen=True, slots=True)
class Outcome:
    """What to send back (None: nothing) and what goes to the session (b"": nothing); ``stop`` goes before all else.

    ``press`` names a press of the button, which also comes as a request of its own; "" where it does not.
    """

    reply: dict[str, Any] | None = None
    command: bytes = b""
    stop: bool = False
    press: str = ""
    entered: bool = False


@dataclass(eq=False)
class MessageHandler:
    """Handles the messages of one connection; ``access`` is shared by all.

    ``about``: what a browser that may see is told first: the session, its bounds. ``newest``: the session's newest
    status and its age (ns).
    """

    access: Access
    about: dict[str, Any]
    newest: Callable[[int], tuple[Status | None, int]]
    new_token: Callable[[], str]

    def __post_init__(self) -> None:
        self._confirmations = Confirmations(self.new_token)
        self._secret = ""
        self._recent_ns: list[int] = []

    @property
    def role(self) -> Role:
        """What this browser may do now; it changes when another one comes in."""
        return self.access.role(self._secret)

    def handle(self, text: str, t_ns: int) -> Outcome:
        """Handle one message (JSON); whatever it is, there is an outcome."""
        try:
            message = json.loads(text) if len(text) <= LONGEST else None
        except (ValueError, RecursionError):
            message = None
        if not isinstance(message, dict):
            return _refuse("not understood")
        if message.get("ask") == CommandKind.STOP:  # before any look at who asks, or how often
            self._confirmations.forget()
            return Outcome(stop=True, press=_text(message.get("press"))[:NAME])
        if {"token", "secret"} & message.keys():
            return self._enter(_text(message.get("token")), _text(message.get("secret")))
        if self.role is Role.NOBODY:
            return _refuse("this page has no valid link: only the stop works here")
        self._recent_ns = [each for each in self._recent_ns if t_ns - each < 1_000_000_000]
        if len(self._recent_ns) >= COMMANDS_A_SECOND:
            return _refuse("too fast; not done")
        self._recent_ns.append(t_ns)
        if "confirm" in message:
            return self._confirm(_text(message["confirm"]), t_ns)
        if message.get("ask") == CommandKind.MARK:
            return self._mark(message.get("text", ""))
        return self._ask(_text(message.get("ask")), message.get("value"), t_ns)

    def _enter(self, token: str, secret: str) -> Outcome:
        bought = self.access.enter(token) if token else ""
        self._secret = bought or secret
        if self.role is Role.NOBODY:
            self._secret = ""
            return Outcome({"refused": "This link was used already, or is of another session."})
        return Outcome({"hello": self.about, "secret": self._secret}, entered=bool(bought))

    def _ask(self, ask: str, value: object, t_ns: int) -> Outcome:
        if self.about.get("mode") == "replay":
            return _refuse("a replay can only be stopped")
        if ask in CALMING:
            return Outcome(command=json.dumps({"ask": ask}).encode())
        if ask in GROUND:
            return self._set_ground(ask, value, t_ns)
        if ask not in RAISING:
            return _refuse("not understood")
        status, why = self._controllable(t_ns)
        if status is None:
            return _refuse(why)
        most = float(self.about["most_intensity"])
        if ask == CommandKind.UP and status.intensity >= most - 1e-6:
            return _refuse(f"{most:.0%} is the most that this session allows")
        raised = min(status.intensity + float(self.about["intensity_step"]), most)
        side = f"{self.about['ask_side']} " if self.about.get("ask_side") else ""
        questions: dict[str, str] = {
            CommandKind.UP: f"Raise the intensity from {status.intensity:.0%} to {raised:.0%}?",
            RESUME: f"Go on at {status.intensity:.0%} intensity? Current may flow at the next step.",
            CommandKind.ARM: f"{side}Arm the stimulator? The intensity starts at 0 %.",
        }
        identifier = self._confirmations.ask(ask, _situation(status), t_ns)
        return Outcome({"question": {"id": identifier, "ask": ask, "text": questions[ask]}})

    def _mark(self, said: object) -> Outcome:
        """A mark changes nothing, so whoever watches may set one."""
        if self.about.get("mode") == "replay":
            return _refuse("a replay can only be stopped")
        try:
            marked = {"ask": CommandKind.MARK, "text": mark_text(said)}
        except CommandRefused as error:
            return _refuse(str(error))
        return Outcome(command=json.dumps(marked, ensure_ascii=False).encode())

    def _set_ground(self, ask: str, value: object, t_ns: int) -> Outcome:
        """What is walked on: no current comes of it, so nothing is asked back, but one browser says it."""
        status, why = self._controllable(t_ns)
        if status is None:
            return _refuse(why)
        if ask == CommandKind.GROUND_FREE:
            return Outcome(command=json.dumps({"ask": ask}).encode())
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= STEEPEST_PERCENT:
            return _refuse(f"the incline is a number from -{STEEPEST_PERCENT:.0f} to {STEEPEST_PERCENT:.0f} percent")
        return Outcome(command=json.dumps({"ask": ask, "value": value}).encode())

    def _confirm(self, identifier: str, t_ns: int) -> Outcome:
        status, why = self._controllable(t_ns)
        if status is None:
            return _refuse(why)
        what, why = self._confirmations.answer(identifier, _situation(status), t_ns)
        if not what:
            return _refuse(why)
        assert what == RESUME or what in NEEDS_CONFIRMATION
        return Outcome(command=json.dumps({"ask": what, "confirm": True}, separators=(",", ":")).encode())

    def _controllable(self, t_ns: int) -> tuple[Status | None, str]:
        """The status that an order of the one who controls may rest on, or why there is none."""
        if self.role is not Role.CONTROL:
            return None, "another browser has the newest link: here you can watch, pause, lower and stop"
        status, age_ns = self.newest(t_ns)
        if status is None or age_ns > FRESH_NS:
            return None, "nothing is heard of the session"
        return status, ""


def _situation(status: Status) -> Situation:
    # a patient who stops or starts to walk while somebody reads the question has not changed what it asks
    return Situation("current" if status.state in CURRENT else status.state, status.intensity, status.stops)


def _text(value: object) -> str:
    return value if isinstance(value, str) else ""


def _refuse(why: str) -> Outcome:
    return Outcome({"said": why})
