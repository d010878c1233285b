"""The session under test: ``fes run`` as a process of its own, with keys, control socket and children to aim at."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

LONGEST_S: Final = 3600
_START: Final = "from fes.cli import main; main(prog_name='fes')"


class ControllerProcess:
    """A running ``fes run``; always :meth:`end` it.

    Args:
        settings: its session file.
        calibration: so that walking counts at once.
        folder: for its results, its socket (``control``) and its stop file (``stop``).
        view: with the terminal view.
    """

    def __init__(self, settings: Path, calibration: Path, folder: Path, *, view: bool = False) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self.control = folder / "control"
        self.stop_file = folder / "stop"
        self.control.unlink(missing_ok=True)
        self.stop_file.unlink(missing_ok=True)
        reading, self._keys = os.pipe()
        command = [sys.executable, "-c", _START, "run", str(settings), "--out", str(folder)]
        command += ["--calibration", str(calibration), "--control", str(self.control)]
        command += ["--stop-file", str(self.stop_file), "--keys-from", str(reading), "--duration", str(LONGEST_S)]
        command.append("--view" if view else "--no-view")
        self._said = (folder / "said.txt").open("a+", encoding="utf-8")
        try:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=self._said,
                stderr=self._said,
                pass_fds=(reading,),
                start_new_session=True,
            )
        finally:
            os.close(reading)

    @property
    def pid(self) -> int:
        """Of the controller itself."""
        return self.process.pid

    @property
    def alive(self) -> bool:
        """Whether it still runs."""
        return self.process.poll() is None

    def key(self, key: bytes) -> None:
        """Press a key."""
        os.write(self._keys, key)

    def child(self, module: str) -> int:
        """The process id of its child that runs this module.

        Raises:
            ProcessLookupError: there is none.
        """
        for name in Path(f"/proc/{self.pid}/task/{self.pid}/children").read_text(encoding="ascii").split():
            with suppress(OSError):
                if module in Path(f"/proc/{name}/cmdline").read_text(encoding="utf-8", errors="replace"):
                    return int(name)
        raise ProcessLookupError(f"the session has no process {module}")

    def log(self) -> Path | None:
        """The newest session log in the folder."""
        return max(self.folder.glob("**/session.feslog"), key=lambda path: path.stat().st_mtime_ns, default=None)

    def said(self) -> str:
        """The end of what it printed."""
        self._said.seek(0)
        return self._said.read()[-2000:].strip()

    def wait(self, timeout_s: float) -> int | None:
        """Its exit status; None when it still runs."""
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def end(self) -> None:
        """Be sure that it is gone, and everything that it started."""
        children = self._children()
        if self.alive:
            with suppress(OSError):
                self.process.send_signal(signal.SIGCONT)
                self.process.send_signal(signal.SIGTERM)
            if self.wait(3.0) is None:
                self.process.kill()
                self.process.wait()
        end_s = time.monotonic() + 1.0
        while time.monotonic() < end_s and any(_runs(pid) for pid in children):
            time.sleep(0.02)
        for pid in children:
            with suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        with suppress(OSError):
            os.close(self._keys)
            self._said.close()

    def _children(self) -> list[int]:
        with suppress(OSError):
            return [
                int(name)
                for name in Path(f"/proc/{self.pid}/task/{self.pid}/children").read_text(encoding="ascii").split()
            ]
        return []


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
