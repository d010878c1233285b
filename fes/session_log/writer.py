"""Writing the session log while the session runs.

Records gather in memory, encoded, until they are delivered: to a file, or to a process that writes one. Nothing waits
for a disk's cache, and nothing that was delivered is lost.
"""

import errno
import os
import struct
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Final

from fes.session_log.codec import LatencyRun, Rare, SampleRun, encode, encode_json
from fes.session_log.framing import MAGIC, Received, RecordType, SessionLogError, framed, not_made
from fes.signals import NS_PER_S, Event, ImuSample, StimCommand, StrideResult, WireFrame
from fes.walk_record import Note
from statemachine.phases import PhaseChange

FLUSH_INTERVAL_NS: Final = NS_PER_S // 20
FLUSH_BYTES: Final = 1 << 16

_UNLOGGABLE = (struct.error, TypeError, ValueError, KeyError, OverflowError, AttributeError)


class RecordBuffer(ABC):
    """Takes what a session reports and delivers it, encoded, every 50 ms or 64 KiB.

    Events keep their order; outputs (commands, phases …) keep theirs among each other of a kind.

    Every method raises SessionLogError if a delivery failed, in that call or an earlier one; what had been delivered
    stays readable.
    """

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        """Begin with magic and header. SessionLogError: the header is not plain data."""
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

    @abstractmethod
    def _deliver(self, encoded: bytearray) -> None:
        """Take the bytes, whole or raise OSError."""

    def _raise_fault(self) -> None:
        if self._fault:
            raise SessionLogError(self._fault)

    def event(self, event: Event) -> None:
        """Log what happened to the controller."""
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

    def received(self, received: Received) -> None:
        """Log what a serial stimulator's line brought, in its place among the events."""
        self._close_samples()
        self._append(received)

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
        self._raise_fault()
        try:
            if not self._latencies.add(t_ns, latency_ns):
                self._close_latencies()
                self._latencies.add(t_ns, latency_ns)
        except _UNLOGGABLE as error:
            told = f"latency {latency_ns!r} at {t_ns!r}"
            raise SessionLogError(f"{self.path}: {told} cannot be logged: {error}") from error

    def flush_due(self, t_monotonic_ns: int) -> bool:
        """Hand what has gathered to the operating system if 50 ms have passed since that was last done here.

        Returns True if it was done. ``t_monotonic_ns`` is the host's clock, whatever the events' times are.
        """
        self._raise_fault()
        last = self._flushed_at_ns
        if last is not None and 0 <= t_monotonic_ns - last < FLUSH_INTERVAL_NS:
            return False
        self._flushed_at_ns = t_monotonic_ns
        self.flush()
        return True

    def flush(self) -> None:
        """Hand everything that has gathered to the operating system now."""
        self._raise_fault()
        self._close_samples()
        self._close_latencies()
        try:
            self._deliver(self._buffer)
        except OSError as error:
            self._fault = self._why(error)
            raise SessionLogError(self._fault) from error
        self._buffer.clear()

    def _why(self, error: OSError) -> str:
        what = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else error.strerror or str(error)
        return (
            f"{self.path}: cannot be written any more: {what}. What was written is kept and readable; "
            f"make room and start a new session"
        )

    def _finish(self, summary: dict[str, Any]) -> None:
        """Deliver what is left and the summary as the last record."""
        self._close_samples()
        self._close_latencies()
        self._buffer += framed(RecordType.SUMMARY, encode_json(summary))
        self.flush()

    def _sample(self, sample: ImuSample) -> None:
        self._raise_fault()
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
        self._raise_fault()
        try:
            kind, payload = encode(value)
        except _UNLOGGABLE as error:
            raise SessionLogError(f"{self.path}: {value!r} cannot be logged: {error}") from error
        self._buffer += framed(kind, payload)
        if len(self._buffer) > FLUSH_BYTES:
            self.flush()

    def _close_samples(self) -> None:
        if self._samples:
            self._buffer += framed(RecordType.SAMPLES, self._samples.close())

    def _close_latencies(self) -> None:
        if self._latencies:
            self._buffer += framed(RecordType.LATENCY, self._latencies.close())


def create(path: Path) -> int:
    """Make a new session log's file; its descriptor, for adding to it, and for reading it should its name be gone.

    SessionLogError: the file is there already or cannot be made.
    """
    try:
        return os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o644)
    except OSError as error:
        raise not_made(path, error, "choose another name or move it") from error


class SessionWriter(RecordBuffer):
    """An open session log, written by this process.

    Records go to the operating system when 64 KiB are full or when :meth:`flush_due` finds 50 ms passed; from then on
    they outlive the process (and, after :meth:`close`, the machine).
    """

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        """Create the file and store the header at once.

        SessionLogError: the file is there already, cannot be made, or the header is not plain data.
        """
        super().__init__(path, header)
        self._fd = create(self.path)
        try:
            self.flush()
        except SessionLogError:
            os.close(self._fd)
            self._fd = -1
            raise

    def _deliver(self, encoded: bytearray) -> None:
        with memoryview(encoded) as pending:
            written = 0
            while written < len(pending):
                written += os.write(self._fd, pending[written:])

    def close(self, summary: dict[str, Any]) -> None:
        """Write the summary as the last record, wait for the disk, close. Closing again does nothing.

        SessionLogError: the disk refused a write (now or before) or the summary is not plain data; the file is closed
        all the same, without its end.
        """
        if self._fd < 0:
            return
        try:
            self._finish(summary)
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
