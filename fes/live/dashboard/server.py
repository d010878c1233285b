"""The dashboard's web server: files held in memory, one web socket a browser, and a stop that needs one request."""

import asyncio
import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, ClassVar, Final

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

from fes.live.dashboard.access import Access
from fes.live.dashboard.frames import StateBuffer
from fes.live.dashboard.message_handler import NAME, MessageHandler
from fes.live.dashboard.network_guard import NetworkGuard
from fes.live.status import Status

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
