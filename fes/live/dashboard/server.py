"""The dashboard's web server: files held in memory, one web socket a browser, and a stop that needs one request.

In front of all that the dashboard's server does: who may speak to it, and what browsers are told to forbid.

A name that an attacker points at 127.0.0.1 comes with that name as Host; another site's script comes with that site as
Origin, and so does one on another port of this machine. Neither gets further than here. Nothing rests on cookies.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, ClassVar, Final

from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketClose, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

from fes.config import STEEPEST_PERCENT
from fes.live.commands import NEEDS_CONFIRMATION, CommandKind, CommandRefused, mark_text
from fes.live.dashboard.access import LOOPBACK, Access, Confirmations, Role, Situation
from fes.live.dashboard.frames import StateBuffer
from fes.live.status import Status

NAMES: Final = (LOOPBACK, "localhost")
READING: Final = frozenset(("GET", "HEAD"))


def hosts(port: int) -> frozenset[str]:
    """What may stand in Host."""
    return frozenset(f"{name}:{port}" for name in NAMES)


def policy(port: int) -> dict[str, str]:
    """Headers of every answer: only this server's own files, no inline script or style, no frame, nothing kept."""
    live = " ".join(f"ws://{host}" for host in sorted(hosts(port)))
    return {
        "content-security-policy": (
            f"default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self' {live}; base-uri 'none'; "
            f"form-action 'none'; frame-ancestors 'none'"
        ),
        "x-content-type-options": "nosniff",
        "x-frame-options": "DENY",
        "referrer-policy": "no-referrer",
        "cross-origin-opener-policy": "same-origin",
        "cross-origin-resource-policy": "same-origin",
        "cache-control": "no-store",
    }


def refusal(scope: Scope, port: int) -> str:
    """Why this request goes no further; "" when it may."""
    headers = Headers(scope=scope)
    client = scope.get("client")
    allowed = hosts(port)
    if client is None or client[0] != LOOPBACK:
        return "only this computer is served"
    if headers.getlist("host") not in [[host] for host in allowed]:
        return "wrong Host"
    reads = scope["type"] == "http" and scope["method"] in READING
    if not reads and headers.getlist("origin") not in [[f"http://{host}"] for host in allowed]:
        return "wrong Origin"
    fetched = headers.get("sec-fetch-site", "none")
    if fetched not in ("none", "same-origin") and headers.get("sec-fetch-mode") != "navigate":
        return "another site asked"
    return ""


class NetworkGuard:
    """ASGI middleware: refuses, or lets through and adds the policy's headers."""

    def __init__(self, app: ASGIApp, port: int) -> None:
        self._app = app
        self._port = port
        self._policy = policy(port)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        why = refusal(scope, self._port)
        if scope["type"] == "websocket":
            await (WebSocketClose(1008, why) if why else self._app)(scope, receive, send)
            return

        async def with_policy(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(self._policy)
            await send(message)

        await (PlainTextResponse(f"Refused: {why}.\n", 403) if why else self._app)(scope, receive, with_policy)


# --- One browser's messages: what each means, what is answered, what goes on to the session. No clock, no I/O ---


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


OWN: Final = ("page.css", "page.js", "link.js", "charts.js", "side.js", "words.js")
SHARED: Final = ("uPlot.iife.min.js", "uPlot.min.css")  # the report's
TYPES: Final = {"html": "text/html; charset=utf-8", "js": "text/javascript; charset=utf-8", "css": "text/css"}
BROWSERS: Final = 8
KEEP_ALIVE_S: Final = 0.4
STRANGERS: Final = 16  # web sockets without a valid link: only their stop works, and the oldest gives way
CONNECTIONS: Final = 512  # likewise
REQUEST_S: Final = 3.0  # for a whole request's header, and for a connection that asks for nothing
SLOW_S: Final = 5.0  # a browser that takes no frame for so long is let go; it comes back by itself


class Connection(H11Protocol):
    """One connection: closed where no whole request comes in time. None is refused: the oldest gives way to the newest.

    So a stop is heard however many others hold a connection, or open one after the other.
    """

    _all: ClassVar[dict[H11Protocol, None]] = {}  # oldest first; without those that became web sockets
    _timeout: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a request."""
        super().connection_made(transport)
        self._all[self] = None
        self._wait()
        if len(self._all) > CONNECTIONS:
            oldest = next(iter(self._all))
            del self._all[oldest]
            oldest.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """It is gone."""
        self._settle()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """A whole request ends the waiting."""
        super().data_received(data)
        if self.cycle is not None and not self.cycle.response_complete and self._timeout is not None:
            self._timeout.cancel()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._wait()

    def handle_websocket_upgrade(self, event: Any) -> None:
        """It is another's from now on."""
        self._settle()
        super().handle_websocket_upgrade(event)

    def _wait(self) -> None:
        if self._timeout is not None:
            self._timeout.cancel()
        self._timeout = self.loop.call_later(REQUEST_S, self.transport.abort)

    def _settle(self) -> None:
        self._all.pop(self, None)
        if self._timeout is not None:
            self._timeout.cancel()


def assets() -> dict[str, Response]:
    """Path → answer for all that there is."""
    places = {"/": ("fes.live.dashboard", "index.html")}
    places |= {f"/static/{name}": ("fes.live.dashboard", name) for name in OWN}
    places |= {f"/static/{name}": ("fes.report", name) for name in SHARED}
    return {
        path: Response(files(package).joinpath("static", name).read_bytes(), media_type=TYPES[name.rsplit(".", 1)[1]])
        for path, (package, name) in places.items()
    }


@dataclass(eq=False)
class Server:
    """The application, and the browsers that are connected.

    ``stop`` hands an emergency stop on, at once; it is given the press's name, which may be "". ``send`` hands another
    command on; False where that was not possible. ``on_link_used`` is called when a link has been used.
    """

    buffer: StateBuffer
    access: Access
    about: dict[str, Any]
    port: int
    new_token: Callable[[], str]
    stop: Callable[[str], None]
    send: Callable[[bytes], bool]
    on_link_used: Callable[[], None]

    def __post_init__(self) -> None:
        self._waiting: dict[WebSocket, asyncio.Event] = {}
        self._strangers: list[WebSocket] = []  # oldest first
        pages = [Route(path, answer, methods=["GET"]) for path, answer in assets().items()]
        self.app = Starlette(
            routes=[*pages, Route("/stop", self._on_stop, methods=["POST"]), WebSocketRoute("/live", self._on_browser)],
            middleware=[Middleware(NetworkGuard, port=self.port)],
        )

    @property
    def browsers(self) -> int:
        """How many are connected."""
        return len(self._waiting)

    def changed(self) -> None:
        """The buffer has something new."""
        for event in self._waiting.values():
            event.set()

    async def _on_stop(self, request: Request) -> Response:
        """An emergency stop: no token, no body, no look at who asks."""
        self.stop(request.query_params.get("press", "")[:NAME])
        return PlainTextResponse("stop\n")

    async def _on_browser(self, socket: WebSocket) -> None:
        await socket.accept()
        self._strangers.append(socket)
        if len(self._strangers) > STRANGERS:
            with suppress(RuntimeError, WebSocketDisconnect):  # it may be gone by now: no affair of this one
                await self._strangers.pop(0).close(1013, "too many without a link")
        handler = MessageHandler(self.access, self.about, self._newest, self.new_token)
        pushing: asyncio.Task[None] | None = None
        try:
            while True:
                outcome = handler.handle(await socket.receive_text(), time.monotonic_ns())
                if outcome.stop:
                    self.stop(outcome.press)
                if outcome.entered:
                    self.on_link_used()
                reply = outcome.reply
                if reply and "hello" in reply and socket in self._strangers:
                    if len(self._waiting) >= BROWSERS:
                        await socket.close(1013, "too many browsers")
                        break
                    self._strangers.remove(socket)
                    self._waiting[socket] = asyncio.Event()
                if outcome.command and not self.send(outcome.command):
                    reply = {"said": "the session does not take it now; not done"}
                if reply is not None:
                    await asyncio.wait_for(socket.send_text(json.dumps(reply)), SLOW_S)
                if outcome.reply and "hello" in outcome.reply and pushing is None:
                    pushing = asyncio.create_task(self._push(socket, handler))
        except (WebSocketDisconnect, RuntimeError, TimeoutError, KeyError):  # gone, or sent bytes: either way done
            pass
        finally:
            self._waiting.pop(socket, None)
            if socket in self._strangers:
                self._strangers.remove(socket)
            if pushing is not None:
                pushing.cancel()

    async def _push(self, socket: WebSocket, handler: MessageHandler) -> None:
        """Frames to one browser, each when the one before has been taken; what it missed is in the next."""
        changed, seen = self._waiting[socket], 0
        with suppress(WebSocketDisconnect, RuntimeError, TimeoutError, OSError):
            while True:
                with suppress(TimeoutError):
                    await asyncio.wait_for(changed.wait(), KEEP_ALIVE_S)
                changed.clear()
                number = self.buffer.number
                frame = self.buffer.since(seen, time.monotonic_ns())
                frame |= {"role": handler.role, "browsers": len(self._waiting)}
                await asyncio.wait_for(socket.send_text(json.dumps(frame)), SLOW_S)
                seen = number

    def _newest(self, t_ns: int) -> tuple[Status | None, int]:
        heard_ns = self.buffer.heard_ns
        return self.buffer.newest, 0 if heard_ns is None else t_ns - heard_ns
