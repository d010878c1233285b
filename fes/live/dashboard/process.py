"""The dashboard's process as the session sees it: its link, starting and ending it, pressing its stop."""

import http.client
import secrets
import socket
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from fes.config import Session
from fes.estimation.sensor_choice import phase_sensors
from fes.live.dashboard.access import LOOPBACK, link_address, write_link
from fes.live.dashboard.frames import END, hello
from fes.live.dashboard.stream import DashboardStream
from fes.live.operator import INTENSITY_STEP, question_of_side, unchecked_side
from fes.live.processes import HelperProcess

LINK_NAME: Final = "page.url"
ERRORS_NAME: Final = "page.log"
SLOW_MS: Final = 10_000
ANSWER_WAIT_S: Final = 2.0


def about_session(session: Session, mode: str, calibrated: Iterable[str] = ()) -> dict[str, Any]:
    """What the dashboard shows before anything happens: channels, bounds.

    ``mode``: live, exercise or replay. ``calibrated``: the sensors that may have to be asked for.
    """
    sensors = phase_sensors(calibrated)
    return {
        "mode": mode,
        "ask_side": question_of_side(sensors) if mode == "live" and unchecked_side(sensors) else "",
        "name": session.name,
        "most_intensity": session.stimulation.intensity,
        "intensity_step": INTENSITY_STEP,
        "feet": sorted({str(channel.foot) for channel in session.channels}),
        "channels": [
            {
                "number": channel.number,
                "name": channel.name,
                "foot": str(channel.foot),
                "current_ma": channel.current_ma,
                "most_ma": channel.limits.max_current_ma,
            }
            for channel in session.channels
        ],
    }


def press_stop(port: int) -> None:
    """Ask the dashboard on this port for an emergency stop; returns when its process has handed that on.

    OSError: nobody serves there, or it refuses.
    """
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=ANSWER_WAIT_S)
    try:
        connection.request("POST", "/stop", headers={"Origin": f"http://{LOOPBACK}:{port}"})
        answer = connection.getresponse()
        if answer.status != http.client.OK:
            raise OSError(f"the dashboard answered {answer.status} {answer.read(200).decode(errors='replace')}")
    except http.client.HTTPException as error:
        raise OSError(f"the dashboard does not answer: {error}") from error
    finally:
        connection.close()


class DashboardProcess(HelperProcess):
    """The dashboard while entered. ``url`` opens it once; the file ``page.url`` in the folder always has the next link.

    For ``about`` see :func:`about_session`; port 0 takes a free one.

    OSError: the port is taken, or the folder cannot be written.
    """

    farewell = END + b"The session has ended. Stimulation is off."

    def __init__(self, folder: Path, about: dict[str, Any], port: int = 0) -> None:
        token = secrets.token_urlsafe(24)
        self._errors = folder / ERRORS_NAME
        self._url_file = folder / LINK_NAME
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as listening:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if hasattr(socket, "TCP_USER_TIMEOUT"):  # a browser that stopped reading is let go
                listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, SLOW_MS)
            listening.bind((LOOPBACK, port))
            listening.listen(64)
            self.port = int(listening.getsockname()[1])
            self.url = link_address(self.port, token)
            write_link(self._url_file, self.url)
            with self._errors.open("wb") as errors:
                served = listening.fileno()
                super().__init__("fes.live.dashboard", served, also=(served,), stdout=errors, stderr=errors)
        # the token goes this way: a command line can be read by everybody on the machine
        self.link.send(hello({**about, "token": token, "url_file": str(self._url_file.absolute())}))
        self.stream = DashboardStream(self.link)

    def say_at_the_end(self, text: str) -> None:
        """What the dashboard shows once this is left, in the place of its usual words."""
        self.farewell = END + text.encode()

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        with suppress(OSError):
            self._url_file.unlink(missing_ok=True)
            if not self._errors.stat().st_size:
                self._errors.unlink()
