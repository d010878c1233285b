"""In front of all that the dashboard's server does: who may speak to it, and what browsers are told to forbid.

A name that an attacker points at 127.0.0.1 comes with that name as Host; another site's script comes with that site as
Origin, and so does one on another port of this machine. Neither gets further than here. Nothing rests on cookies.
"""

from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

from fes.live.dashboard.access import LOOPBACK

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
