"""One browser's words: what each means, what is answered, what goes on to the session. Pure: no clock, no I/O.

Press the page's stop from a program: one request, no token. For fault campaigns and tests.

The loop's end of the way from the page: what may come, and how much of it in a turn. No clock; waits for nobody.
"""

from __future__ import annotations

import http.client
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from fes.live.commands import NEEDS_CONFIRMATION, Ask, CommandRefused, Order, State, order_of_message
from fes.live.dashboard.network_guard import ADDRESS_LOOPBACK as LOOPBACK
from fes.live.dashboard.network_guard import Access, Confirmations, Role, Situation
from fes.live.dashboard.stream import DashboardStream
from fes.live.inputs import Carry
from fes.live.status import Status
from fes.signals import Event

WITHIN_S: Final = 2.0


def press_stop(port: int) -> None:
    """Ask the page on this port for an emergency stop; returns when its process has handed that on.

    Raises:
        OSError: nobody serves there, or it refuses.
    """
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=WITHIN_S)
    try:
        connection.request("POST", "/stop", headers={"Origin": f"http://{LOOPBACK}:{port}"})
        answer = connection.getresponse()
        if answer.status != http.client.OK:
            raise OSError(f"the page answered {answer.status} {answer.read(200).decode(errors='replace')}")
    except http.client.HTTPException as error:
        raise OSError(f"the page does not answer: {error}") from error
    finally:
        connection.close()


ORDERS_RESUME: Final = b'{"ask":"resume","confirm":true}'
ALLOWED: Final = frozenset((Ask.STOP, Ask.ARM, Ask.DISARM, Ask.PAUSE, Ask.UP, Ask.DOWN))
AT_ONCE: Final = 8
ORDERS_LONGEST: Final = 256
ORIGIN: Final = "page"


class DashboardCommands:
    """An input of the live session (see ``fes.live.ports.Input``).

    The page's process is not trusted: of all orders only those in ALLOWED exist here, what leads to more current needs
    its confirmation again, *pause* never goes on, and however much comes, a turn carries out one stop, before anything
    else, or a few others.

    Args:
        feed: its other direction.
        carry: carries an order out.
        state: where the session stands.
        confused: told of a message that is no order.
    """

    def __init__(
        self,
        feed: DashboardStream,
        carry: Carry,
        state: Callable[[], State],
        confused: Callable[[int, str], None] = lambda t_ns, text: None,
    ) -> None:
        self._feed = feed
        self._carry = carry
        self._state = state
        self._confused = confused

    def fileno(self) -> int | None:
        """While the page's process is there."""
        return None if self._feed.lost else self._feed.link.fileno()

    def take(self, t_ns: int) -> list[Event]:
        """Carry out what has come; a stop among it comes first and puts the rest aside."""
        orders: list[Order] = []
        for message in self.messages():
            try:
                if (order := self._order(message)) is not None:
                    orders.append(order)
            except CommandRefused as error:
                self._confused(t_ns, f"the page sent what is no order: {error}")
        stop = next((order for order in orders if order.ask is Ask.STOP), None)
        return [event for order in ([stop] if stop else orders) for event in self._carry(order, t_ns)]

    def messages(self) -> list[bytes]:
        """What has come, at most a few."""
        found: list[bytes] = []
        while len(found) < AT_ONCE and not self._feed.lost:
            try:
                message = self._feed.link.recv(ORDERS_LONGEST)
            except BlockingIOError:
                break
            except OSError as error:
                message = b""
                self._feed.lose(error.strerror or str(error))
            if not message:
                self._feed.lose("its process has ended")
                break
            found.append(message)
        return found

    def _order(self, message: bytes) -> Order | None:
        """The order; None where it means nothing as the session stands.

        Raises:
            CommandRefused: it is none that a page may give.
        """
        if message == ORDERS_RESUME:
            return Order(Ask.PAUSE, origin=ORIGIN) if self._state() is State.PAUSED else None
        order = order_of_message(message)
        if order.ask not in ALLOWED:
            raise CommandRefused(f"{order.ask} is not the page's business")
        if order.ask is Ask.PAUSE and self._state() is State.PAUSED:
            return None  # pressed on two pages at once: the second must not go on
        return Order(order.ask, origin=ORIGIN)


RESUME: Final = "resume"
CALMING: Final = frozenset((Ask.PAUSE, Ask.DOWN, Ask.DISARM))
RAISING: Final = frozenset((Ask.ARM, Ask.UP, RESUME))
LONGEST: Final = 512
NAME: Final = 40  # characters of a press's name
ORDERS_A_SECOND: Final = 10
FRESH_NS: Final = 500_000_000
CURRENT: Final = ("armed", "running")


@dataclass(frozen=True, slots=True)
class Outcome:
    """What to send back (None: nothing) and what to order (b"": nothing); ``stop`` goes before anything else.

    ``press`` names a press of the button, which also comes as a request of its own; "" where it does not.
    """

    reply: dict[str, Any] | None = None
    order: bytes = b""
    stop: bool = False
    press: str = ""
    entered: bool = False


class MessageHandler:
    """Handles the messages of one connection.

    Args:
        access: shared by all connections.
        about: what a browser that may see is told first: the session, its bounds.
        newest: the session's newest status and its age (ns).
        fresh: makes identifiers.
    """

    def __init__(
        self,
        access: Access,
        about: dict[str, Any],
        newest: Callable[[int], tuple[Status | None, int]],
        fresh: Callable[[], str],
    ) -> None:
        self._access = access
        self._about = about
        self._newest = newest
        self._confirmations = Confirmations(fresh)
        self._secret = ""
        self._recent_ns: list[int] = []

    @property
    def role(self) -> Role:
        """What this browser may do now; it changes when another one comes in."""
        return self._access.role(self._secret)

    def take(self, text: str, t_ns: int) -> Outcome:
        """One message; whatever it is, there is an outcome."""
        try:
            said = json.loads(text) if len(text) <= LONGEST else None
        except (ValueError, RecursionError):
            said = None
        if not isinstance(said, dict):
            return _refuse("not understood")
        if said.get("ask") == Ask.STOP:  # before any look at who asks, or how often
            self._confirmations.forget()
            return Outcome(stop=True, press=_text(said.get("press"))[:NAME])
        if {"token", "secret"} & said.keys():
            return self._enter(_text(said.get("token")), _text(said.get("secret")))
        if self.role is Role.NOBODY:
            return _refuse("this page has no valid link: only the stop works here")
        if not self._in_time(t_ns):
            return _refuse("too fast; not done")
        if "confirm" in said:
            return self._confirm(_text(said["confirm"]), t_ns)
        return self._ask(_text(said.get("ask")), t_ns)

    def _enter(self, token: str, secret: str) -> Outcome:
        bought = self._access.enter(token) if token else ""
        self._secret = bought or secret
        if self.role is Role.NOBODY:
            self._secret = ""
            return Outcome({"refused": "This link was used already, or is of another session."})
        return Outcome({"hello": self._about, "secret": self._secret}, entered=bool(bought))

    def _ask(self, ask: str, t_ns: int) -> Outcome:
        if self._about.get("mode") == "replay":
            return _refuse("a replay can only be stopped")
        if ask in CALMING:
            return Outcome(order=json.dumps({"ask": ask}).encode())
        if ask not in RAISING:
            return _refuse("not understood")
        status, why = self._raisable(t_ns)
        if status is None:
            return _refuse(why)
        most = float(self._about["most_intensity"])
        if ask == Ask.UP and status.intensity >= most - 1e-6:
            return _refuse(f"{most:.0%} is the most that this session allows")
        identifier = self._confirmations.ask(ask, _situation(status), t_ns)
        question = _question(ask, status, float(self._about["intensity_step"]), most)
        return Outcome({"question": {"id": identifier, "ask": ask, "text": question}})

    def _confirm(self, identifier: str, t_ns: int) -> Outcome:
        status, why = self._raisable(t_ns)
        if status is None:
            return _refuse(why)
        what, why = self._confirmations.answer(identifier, _situation(status), t_ns)
        if not what:
            return _refuse(why)
        assert what == RESUME or what in NEEDS_CONFIRMATION
        return Outcome(order=json.dumps({"ask": what, "confirm": True}, separators=(",", ":")).encode())

    def _raisable(self, t_ns: int) -> tuple[Status | None, str]:
        """The status that a raise may rest on, or why there is none."""
        if self.role is not Role.CONTROL:
            return None, "another browser has the newest link: here you can watch, pause, lower and stop"
        status, age_ns = self._newest(t_ns)
        if status is None or age_ns > FRESH_NS:
            return None, "nothing is heard of the session"
        return status, ""

    def _in_time(self, t_ns: int) -> bool:
        self._recent_ns = [each for each in self._recent_ns if t_ns - each < 1_000_000_000]
        if len(self._recent_ns) >= ORDERS_A_SECOND:
            return False
        self._recent_ns.append(t_ns)
        return True


def _situation(status: Status) -> Situation:
    # a patient who stops or starts to walk while somebody reads the question has not changed what it asks
    return Situation("current" if status.state in CURRENT else status.state, status.intensity, status.stops)


def _question(what: str, status: Status, step: float, most: float) -> str:
    if what == Ask.UP:
        return f"Raise the intensity from {status.intensity:.0%} to {min(status.intensity + step, most):.0%}?"
    if what == RESUME:
        return f"Go on at {status.intensity:.0%} intensity? Current may flow at the next step."
    return "Arm the stimulator? The intensity starts at 0 %."


def _text(value: object) -> str:
    return value if isinstance(value, str) else ""


def _refuse(why: str) -> Outcome:
    return Outcome({"said": why})
