"""Writing the session log while the session runs: never waits for a disk's cache, never loses what it wrote."""

from __future__ import annotations

import errno
import os
import struct
from pathlib import Path
from typing import Any, Final

from fes.journal.codec import Rare, encode, encode_json
from fes.journal.framing import MAGIC, RecordType, framed
from fes.journal.record import Note, SessionLogError
from fes.journal.runs import LatencyRun, SampleRun
from fes.signals import NS_PER_S, Event, ImuSample, StimCommand, StrideResult, WireFrame
from statemachine.phases import PhaseChange

FLUSH_INTERVAL_NS: Final = NS_PER_S // 20
FLUSH_BYTES: Final = 1 << 16

_UNLOGGABLE = (struct.error, TypeError, ValueError, KeyError, OverflowError, AttributeError)


class SessionWriter:
    """An open session log.

    Records gather in memory and go to the operating system when 64 KiB are full or when :meth:`flush_due` finds
    50 ms passed; from then on they outlive the process (and, after :meth:`close`, the machine). Events keep their
    order; outputs (commands, phases …) keep theirs among each other of a kind.

    Every method but ``close`` raises SessionLogError if the disk refused a write, in that call or an earlier one;
    what had been written stays readable.
    """

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        """Create the file and store the header at once.

        Raises:
            SessionLogError: the file is there already, cannot be made, or the header is not plain data.
        """
        self.path = Path(path)
        self._fault = ""
        self._buffer = bytearray(MAGIC)
        self._samples = SampleRun()
        self._latencies = LatencyRun()
        self._flushed_at_ns: int | None = None
        try:
            self._buffer += framed(RecordType.HEADER, encode_json(header))
        except (TypeError, ValueError) as error:
            raise SessionLogError(f"{self.path}: the header cannot be stored: {error}") from error
        try:
            self._fd = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o644)
        except FileExistsError as error:
            raise SessionLogError(
                f"{self.path}: is there already and session logs are never overwritten; choose another name or move it"
            ) from error
        except OSError as error:
            raise SessionLogError(f"{self.path}: cannot be made: {error.strerror or error}") from error
        try:
            self.flush()
        except SessionLogError:
            os.close(self._fd)
            self._fd = -1
            raise

    def event(self, event: Event) -> None:
        """Log what happened to the controller."""
        if self._fault:
            raise SessionLogError(self._fault)
        if isinstance(event, ImuSample):
            self._sample(event)
        else:
            self._close_samples()
            self._append(event)

    def command(self, command: StimCommand, frame: WireFrame) -> None:
        """Log what the gate let out and the bytes it became."""
        self._append(command)
        self._append(frame)

    def frame(self, frame: WireFrame) -> None:
        """Log bytes that went onto the wire without a command (heartbeats)."""
        self._append(frame)

    def phase(self, change: PhaseChange) -> None:
        """Log a phase change."""
        self._append(change)

    def stride(self, result: StrideResult) -> None:
        """Log a stride; its trajectory and pitch are kept as float32."""
        self._append(result)

    def note(self, note: Note) -> None:
        """Log a remark."""
        self._append(note)

    def latency(self, t_ns: int, latency_ns: int) -> None:
        """Log how long the step at ``t_ns`` took, from the event's arrival to the answer."""
        if self._fault:
            raise SessionLogError(self._fault)
        try:
            if not self._latencies.add(t_ns, latency_ns):
                self._close_latencies()
                self._latencies.add(t_ns, latency_ns)
        except _UNLOGGABLE as error:
            raise SessionLogError(
                f"{self.path}: latency {latency_ns!r} at {t_ns!r} cannot be logged: {error}"
            ) from error

    def flush_due(self, t_monotonic_ns: int) -> bool:
        """Hand what has gathered to the operating system if 50 ms have passed since that was last done here.

        Returns True if it was done. ``t_monotonic_ns`` is the host's clock, whatever the events' times are.
        """
        if self._fault:
            raise SessionLogError(self._fault)
        last = self._flushed_at_ns
        if last is not None and 0 <= t_monotonic_ns - last < FLUSH_INTERVAL_NS:
            return False
        self._flushed_at_ns = t_monotonic_ns
        self.flush()
        return True

    def flush(self) -> None:
        """Hand everything that has gathered to the operating system now."""
        if self._fault:
            raise SessionLogError(self._fault)
        self._close_samples()
        self._close_latencies()
        pending = memoryview(self._buffer)
        try:
            while pending:
                pending = pending[os.write(self._fd, pending) :]
        except OSError as error:
            what = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else error.strerror or str(error)
            self._fault = (
                f"{self.path}: cannot be written any more: {what}. What was written is kept and readable; "
                f"make room and start a new session"
            )
            raise SessionLogError(self._fault) from error
        finally:
            pending.release()
        self._buffer.clear()

    def close(self, summary: dict[str, Any]) -> None:
        """Write the summary as the last record, wait for the disk, close. Closing again does nothing.

        Raises:
            SessionLogError: the disk refused a write (now or before) or the summary is not plain data; the file is
                closed all the same, without its end.
        """
        if self._fd < 0:
            return
        try:
            self._close_samples()
            self._close_latencies()
            self._buffer += framed(RecordType.SUMMARY, encode_json(summary))
            self.flush()
            os.fsync(self._fd)
        except (TypeError, ValueError) as error:
            if isinstance(error, SessionLogError):
                raise
            raise SessionLogError(f"{self.path}: the summary cannot be stored: {error}") from error
        except OSError as error:
            raise SessionLogError(f"{self.path}: may be incomplete on disk: {error.strerror or error}") from error
        finally:
            os.close(self._fd)
            self._fd = -1
            self._fault = self._fault or f"{self.path}: is closed already; nothing more can be logged"

    def _sample(self, sample: ImuSample) -> None:
        samples = self._samples
        try:
            if not samples.add(sample):
                self._close_samples()
                samples.add(sample)
        except _UNLOGGABLE as error:
            raise SessionLogError(f"{self.path}: {sample!r} cannot be logged: {error}") from error
        if len(samples) > FLUSH_BYTES:
            self.flush()

    def _append(self, value: Rare) -> None:
        if self._fault:
            raise SessionLogError(self._fault)
        try:
            kind, payload = encode(value)
        except _UNLOGGABLE as error:
            raise SessionLogError(f"{self.path}: {value!r} cannot be logged: {error}") from error
        self._buffer += framed(kind, payload)
        if len(self._buffer) > FLUSH_BYTES:
            self.flush()

    def _close_samples(self) -> None:
        if self._samples:
            self._buffer += framed(RecordType.SAMPLES, self._samples.take())

    def _close_latencies(self) -> None:
        if self._latencies:
            self._buffer += framed(RecordType.LATENCY, self._latencies.take())
