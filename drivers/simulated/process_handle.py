"""A simulated device's process, seen from whoever started it: started, told its faults, asked for its record, ended.

The other end of the conversation is :mod:`drivers.simulated.process_end`. The handles of the single kinds of device add
what their ready line says beyond this, and what the device says unasked.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from drivers.simulated.stimulator.firmware import RecordEntry, read_record

STOP_WAIT_S: Final = 3.0
ANSWER_WAIT_S: Final = 10.0
_SAID_AT_MOST: Final = 65536  # bytes at once


class ProcessHandle:
    """A running device: ``port`` is what the host opens, ``record`` the file that it writes (None: none).

    Use as a context manager, or call :meth:`stop`. Should this process die first, the device sees its stdin close and
    ends by itself.

    Args:
        what: the device, as messages name it.
        module: run by ``python -m``.
        arguments: the module's.
        lost: what is raised when the device is not there.

    Raises:
        lost: it ended, or was not ready within ``timeout_s``; the message holds the command and what it said.
    """

    def __init__(
        self,
        what: str,
        module: str,
        arguments: Sequence[str],
        *,
        lost: type[RuntimeError],
        timeout_s: float,
        record: Path | None = None,
    ) -> None:
        self._what = what
        self._lost = lost
        self.record = record
        self.port = ""
        self.real_time = False
        command = [sys.executable, "-m", module, *arguments, *([] if record is None else ["--record", str(record)])]
        self._heard = b""
        self._overdue = 0
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the handle
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, start_new_session=True
        )
        said = self._line(timeout_s)
        try:
            self._take(json.loads(said or ""))
        except (ValueError, KeyError, TypeError) as error:
            if said is None:
                self.process.kill()
            why = self._last_words(f"nothing within {timeout_s:g} s" if said is None else said.strip())
            self.stop()
            raise lost(f"{what} did not start ({' '.join(command)}); it said: {why}") from error

    def _take(self, ready: Mapping[str, Any]) -> None:
        """What the ready line says; each kind of device adds its own."""
        self.port, self.real_time = str(ready.get("port", "")), bool(ready["real_time"])

    def _hear(self, said: Mapping[str, Any]) -> bool:
        """Take in a line that the device may say unasked; whether it was one. A device that does so overrides this."""
        return False

    def tell(self, fault: str, value: float = 1.0) -> int:
        """Bring a fault about now; returns when it had taken effect, by the device's clock (CLOCK_MONOTONIC), ns.

        Raises:
            lost: the device does not know it, or is gone; the message says which, and what it said last.
        """
        return int(self.ask({"fault": fault, "value": value})["t_ns"])

    def ask(self, order: Mapping[str, Any]) -> dict[str, Any]:
        """Give any order that this device takes; its answer.

        Raises:
            lost: as :meth:`tell` does.
        """
        try:
            if self.process.stdin is not None:
                self.process.stdin.write(json.dumps(dict(order)).encode() + b"\n")
                self.process.stdin.flush()
            answer = self._answer()
        except (OSError, ValueError) as error:
            raise self._lost(f"{self._what} is gone; it said: {self._last_words()}") from error
        if "error" in answer:
            raise self._lost(f"{self._what} refused: {answer['error']}")
        return answer

    def entries(self, event: str = "") -> list[RecordEntry]:
        """The record so far; only entries of this kind, when one is named."""
        if self.record is None or not self.record.is_file():
            return []
        return [entry for entry in read_record(self.record) if event in ("", entry.event)]

    def stop(self) -> int:
        """End the device and wait for it; returns its exit status. May be called twice."""
        if self.process.stdin is not None:
            with contextlib.suppress(OSError):  # it may be gone with something unread
                self.process.stdin.close()
        end_s = time.monotonic() + STOP_WAIT_S
        self.listen(STOP_WAIT_S)  # its last words; and a pipe that is full would keep it from ending
        for last_resort in (self.process.terminate, self.process.kill):
            try:
                self.process.wait(max(0.0, end_s - time.monotonic()))
                break
            except subprocess.TimeoutExpired:
                last_resort()
                end_s = time.monotonic() + STOP_WAIT_S
        status = self.process.wait(STOP_WAIT_S)
        if self.process.stdout is not None:
            self.process.stdout.close()
        self._errors.close()
        return status

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def listen(self, timeout_s: float = 0.0) -> None:
        """Take in what it says unasked, until it says no more or the time is over."""
        end_s = time.monotonic() + timeout_s
        while said := self._line(max(0.0, end_s - time.monotonic())):
            with contextlib.suppress(ValueError, TypeError):  # nobody waits for a line that says nothing
                self._is_answer(said)

    def _answer(self) -> dict[str, Any]:
        end_s = time.monotonic() + ANSWER_WAIT_S
        while (said := self._line(max(0.0, end_s - time.monotonic()))) is not None:
            if answer := self._is_answer(said):
                return answer
        self._overdue += 1  # its answer, should it still come, is none to the next order
        raise self._lost(f"{self._what} has not answered within {ANSWER_WAIT_S:g} s")

    def _is_answer(self, line: str) -> dict[str, Any]:
        """The answer to the newest order; empty for what was said unasked and for an answer that is overdue."""
        said: dict[str, Any] = json.loads(line)
        if self._hear(said):
            return {}
        if self._overdue:
            self._overdue -= 1
            return {}
        return said

    def _line(self, timeout_s: float) -> str | None:
        """The next line it says; without its end when it says no more, None when there is none in time."""
        if self.process.stdout is None or self.process.stdout.closed:
            return ""
        descriptor = self.process.stdout.fileno()
        end_s = time.monotonic() + timeout_s
        while b"\n" not in self._heard:
            if not select.select([descriptor], [], [], max(0.0, end_s - time.monotonic()))[0]:
                return None
            data = os.read(descriptor, _SAID_AT_MOST)
            if not data:
                break
            self._heard += data
        line, _, self._heard = self._heard.partition(b"\n")
        return line.decode(errors="replace")

    def _last_words(self, else_said: str = "") -> str:
        """Its errors once it has ended, else ``else_said``, else how it ended."""
        if self._errors.closed:
            return "nothing; it has been stopped"
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(STOP_WAIT_S)
        # not by seek: the device writes at the same place in the file
        said = os.pread(self._errors.fileno(), _SAID_AT_MOST, 0).decode(errors="replace").strip()
        return said or else_said or f"nothing; it ended with status {self.process.returncode}"
