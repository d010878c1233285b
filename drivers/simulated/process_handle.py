"""A simulated device's process, seen from whoever started it: started, given faults, asked for its record, ended.

The other end of the conversation is :mod:`drivers.simulated.process_end`.
"""

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
from typing import Any, Final, Self

from drivers.simulated.record import RecordEntry, read_record

STOP_WAIT_S: Final = 3.0
ANSWER_WAIT_S: Final = 10.0
_READ_AT_MOST: Final = 65536  # bytes at once


class ProcessHandle:
    """A running device: ``port`` is what the host opens, ``record`` the file that it writes (None: none).

    Use as a context manager, or call :meth:`stop`. Should this process die first, the device sees its stdin close and
    ends by itself. ``what`` is the device, as messages name it; ``python -m module`` runs it. ``ready`` holds the facts
    of its ready line, to which each kind of device adds its own.

    Raises:
        lost: it ended, or was not ready within ``timeout_s``; the message holds the command and what it printed.
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
        command = [sys.executable, "-m", module, *arguments, *([] if record is None else ["--record", str(record)])]
        self._unread = b""
        self._overdue = 0
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the handle
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, start_new_session=True
        )
        line = self._read_line(timeout_s)
        try:
            self.ready: dict[str, Any] = json.loads(line or "")
            self.port, self.real_time = str(self.ready.get("port", "")), bool(self.ready["real_time"])
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            if line is None:
                self.process.kill()
            why = self._error_output(f"nothing within {timeout_s:g} s" if line is None else line.strip())
            self.stop()
            raise lost(f"{what} did not start ({' '.join(command)}); it said: {why}") from error

    def _on_message(self, message: Mapping[str, Any]) -> bool:
        """Take in a line that the device may send unasked; whether it was one. A device that does so overrides this."""
        return False

    def inject(self, fault: str, value: float = 1.0) -> int:
        """Bring a fault about now; returns when it had taken effect, by the device's clock (CLOCK_MONOTONIC), ns.

        Raises:
            lost: the device does not know it, or is gone; the message says which, and what it printed last.
        """
        return int(self.request({"fault": fault, "value": value})["t_ns"])

    def request(self, command: Mapping[str, Any]) -> dict[str, Any]:
        """Send any command that this device takes; its answer. lost: as :meth:`inject` does."""
        try:
            if self.process.stdin is not None:
                self.process.stdin.write(json.dumps(dict(command)).encode() + b"\n")
                self.process.stdin.flush()
            end_s = time.monotonic() + ANSWER_WAIT_S
            answer: dict[str, Any] = {}
            while not answer:
                if (line := self._read_line(max(0.0, end_s - time.monotonic()))) is None:
                    self._overdue += 1  # its answer, should it still come, is none to the next command
                    raise self._lost(f"{self._what} has not answered within {ANSWER_WAIT_S:g} s")
                answer = self._answer_in(line)
        except (OSError, ValueError) as error:
            raise self._lost(f"{self._what} is gone; it said: {self._error_output()}") from error
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
        self.receive_messages(STOP_WAIT_S)  # its last ones; and a pipe that is full would keep it from ending
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

    def __exit__(self, *_: object) -> None:
        self.stop()

    def receive_messages(self, timeout_s: float = 0.0) -> None:
        """Take in what it sends unasked, until it sends no more or the time is over."""
        end_s = time.monotonic() + timeout_s
        while line := self._read_line(max(0.0, end_s - time.monotonic())):
            with contextlib.suppress(ValueError, TypeError):  # nobody waits for a line that says nothing
                self._answer_in(line)

    def _answer_in(self, line: str) -> dict[str, Any]:
        """The answer to the newest command; empty for what was sent unasked and for an answer that is overdue."""
        message: dict[str, Any] = json.loads(line)
        unasked = self._on_message(message)
        overdue = not unasked and self._overdue > 0
        self._overdue -= overdue
        return {} if unasked or overdue else message

    def _read_line(self, timeout_s: float) -> str | None:
        """The next line it prints; without its end when it prints no more, None when there is none in time."""
        if self.process.stdout is None or self.process.stdout.closed:
            return ""
        descriptor = self.process.stdout.fileno()
        end_s = time.monotonic() + timeout_s
        while b"\n" not in self._unread:
            if not select.select([descriptor], [], [], max(0.0, end_s - time.monotonic()))[0]:
                return None
            data = os.read(descriptor, _READ_AT_MOST)
            if not data:
                break
            self._unread += data
        line, _, self._unread = self._unread.partition(b"\n")
        return line.decode(errors="replace")

    def _error_output(self, default: str = "") -> str:
        """Its errors once it has ended, else ``default``, else how it ended."""
        if self._errors.closed:
            return "nothing; it has been stopped"
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(STOP_WAIT_S)
        # not by seek: the device writes at the same place in the file
        printed = os.pread(self._errors.fileno(), _READ_AT_MOST, 0).decode(errors="replace").strip()
        return printed or default or f"nothing; it ended with status {self.process.returncode}"
