"""The session under test: ``fes run`` as a process of its own, and the scripted operator at its control socket.

Ctrl-C waits until a process that is being started, or ended, is in somebody's hands.
"""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Final
from urllib.parse import urlsplit

from fes.live.status import Status

ASK_EVERY_S: Final = 1.0
SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, *((signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()))


@contextmanager
def uninterrupted() -> Iterator[None]:
    """While entered, SIGINT, SIGTERM and SIGHUP wait; they act on leaving.

    A KeyboardInterrupt inside ``subprocess.Popen``, or between its return and the name that it is kept under, leaves a
    process that nobody ends. Signals that are ignored, or end this process without a word, are left as they are: so
    the started process inherits what it would have. Outside the main thread, where none acts, this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    waits = False

    def remember(number: int, frame: FrameType | None) -> None:
        if waits:
            came.append(number)
        else:  # between two changes of handlers: what this one does may end them half-way
            before[number](number, frame)

    before = {int(number): handler for number in SIGNALS if callable(handler := signal.getsignal(number))}
    for number in before:
        signal.signal(number, remember)
    try:
        waits = True
        yield
    finally:
        waits = False
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in dict.fromkeys(came):
            signal.raise_signal(number)


class ScriptedOperator:
    """One end of a control socket; ``status`` is the newest that came, ``answers`` what was refused."""

    def __init__(self, session_socket: Path, own: Path) -> None:
        self.status: Status | None = None
        self.refusals: list[str] = []
        self._to = str(session_socket)
        self._own = own
        self._asked_s = -math.inf
        own.unlink(missing_ok=True)
        self._link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._link.bind(str(own))
        self._link.setblocking(False)

    def send_command(self, ask: str, value: float = 0.0) -> None:
        """Send a command, confirmed; a session that is not there hears nothing."""
        with suppress(OSError):
            self._link.sendto(json.dumps({"ask": ask, "value": value, "confirm": True}).encode(), self._to)

    def receive_status(self) -> Status | None:
        """Take in what has come, and every second ask for more; the newest status."""
        if time.monotonic() - self._asked_s > ASK_EVERY_S:
            self._asked_s = time.monotonic()
            with suppress(OSError):
                self._link.sendto(b"watch", self._to)
        while True:
            try:
                datagram = self._link.recv(1 << 16)
            except OSError:
                return self.status
            try:
                self.status = Status.decode(datagram)
            except ValueError:
                with suppress(ValueError):
                    answer = json.loads(datagram)
                    if not answer.get("ok"):
                        self.refusals.append(str(answer.get("why")))

    def close(self) -> None:
        """Release the socket."""
        self._link.close()
        self._own.unlink(missing_ok=True)


LONGEST_S: Final = 3600
_WITH_PARENT: Final = "from fes.live.processes import interrupted_with; interrupted_with({}); "
_START: Final = "from fes.cli import main; main(prog_name='fes')"
_FAULTED: Final = (
    "from fes.hil.sensor_faults import InjectedFaults; from fes.cli import main; "
    "main(prog_name='fes', obj=InjectedFaults({}))"
)


@dataclass(frozen=True, slots=True)
class Child:
    """A process that a session started; ``began`` tells it from a later one of the same number."""

    pid: int
    began: str
    module: str

    @staticmethod
    def running(pid: int) -> Child | None:
        """The process of this number; None when there is none any more."""
        if not (began := _began(pid)):
            return None
        with suppress(OSError):
            command = Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8", errors="replace").split("\0")
            return Child(pid, began, next((word for word in command if word.startswith("fes.")), command[0]))
        return None

    @property
    def runs(self) -> bool:
        """Whether it still does."""
        return _began(self.pid) == self.began

    def kill(self) -> None:
        """If it still runs."""
        with suppress(OSError):
            if self.runs:
                os.kill(self.pid, signal.SIGKILL)


def _began(pid: int) -> str:
    """When the process began, in the kernel's ticks; "" when it is gone or only waits to be reaped."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    except OSError:
        return ""
    return "" if fields[0] == "Z" else fields[19]


class ControllerProcess:
    """A running ``fes run`` and its ``operator``; always :meth:`end` it. Make it, and keep it, ``uninterrupted()``.

    Should this process be killed, the session is interrupted as by SIGTERM, where the system tells it (Linux). The
    folder holds its results, its socket (``control``) and its stop file (``stop``). ``view``: with the terminal view;
    ``page``: with the live page. ``faults``: the session's end of a link by which its sensors' faults are ordered;
    it is closed here. ``python``: of the environment that it runs in.
    """

    def __init__(
        self,
        settings: Path,
        calibration: Path,
        folder: Path,
        *,
        view: bool = False,
        page: bool = False,
        faults: socket.socket | None = None,
        python: str = sys.executable,
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self.control = folder / "control"
        self.stop_file = folder / "stop"
        self.control.unlink(missing_ok=True)
        self.stop_file.unlink(missing_ok=True)
        reading, self._keys = os.pipe()
        handed = [reading] if faults is None else [reading, faults.fileno()]
        program = _WITH_PARENT.format(os.getpid()) + (_START if faults is None else _FAULTED.format(faults.fileno()))
        command = [python, "-c", program, "run", str(settings), "--out", str(folder)]
        command += ["--calibration", str(calibration), "--control", str(self.control)]
        command += ["--stop-file", str(self.stop_file), "--keys-from", str(reading), "--duration", str(LONGEST_S)]
        command += ["--view" if view else "--no-view", *(["--dashboard"] if page else [])]
        self.operator = ScriptedOperator(self.control, folder / "operator")
        self._output = (folder / "said.txt").open("a+", encoding="utf-8")
        try:
            said: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": self._output, "stderr": self._output}
            self.process = subprocess.Popen(command, pass_fds=handed, start_new_session=True, **said)
        finally:
            os.close(reading)
            if faults is not None:
                faults.close()

    @property
    def alive(self) -> bool:
        """Whether it still runs."""
        return self.process.poll() is None

    def key(self, key: bytes) -> None:
        """Press a key."""
        os.write(self._keys, key)

    def page_port(self) -> int:
        """Where its page is served. ProcessLookupError: it has none."""
        for path in self.folder.glob("**/page.url"):
            if port := urlsplit(path.read_text(encoding="utf-8").strip()).port:
                return port
        raise ProcessLookupError("the session has no page")

    def child(self, module: str) -> int:
        """The process id of its child that runs this module. ProcessLookupError: there is none."""
        if pid := next((child.pid for child in self.children() if module in child.module), 0):
            return pid
        raise ProcessLookupError(f"the session has no process {module}")

    def log(self) -> Path | None:
        """The newest session log in the folder, or what was saved of one that was removed."""
        return max(self.folder.glob("**/session*.feslog"), key=lambda path: path.stat().st_mtime_ns, default=None)

    def printed(self) -> str:
        """The end of what it printed."""
        self._output.seek(0)
        return self._output.read()[-2000:].strip()

    def wait(self, timeout_s: float) -> int | None:
        """Its exit status; None when it still runs."""
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    @uninterrupted()
    def end(self) -> None:
        """Be sure that it is gone, and everything that it started. Ctrl-C waits for that, up to 4 s."""
        children = self.children()
        if self.alive:
            with suppress(OSError):
                self.process.send_signal(signal.SIGCONT)
                self.process.send_signal(signal.SIGTERM)
            if self.wait(3.0) is None:
                self.process.kill()
                self.process.wait()
        end_s = time.monotonic() + 1.0
        while time.monotonic() < end_s and any(child.runs for child in children):
            time.sleep(0.02)
        for child in children:
            child.kill()
        self.operator.close()
        with suppress(OSError):
            os.close(self._keys)
            self._output.close()

    def children(self) -> list[Child]:
        """Its processes now; none where there is no /proc."""
        try:
            names = (
                Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text(encoding="ascii").split()
            )
        except OSError:
            return []
        return [child for name in names if (child := Child.running(int(name))) is not None]
