"""The session log: append-only, a checksum per record, readable to the last whole record whatever happened."""

from fes.journal.reader import iter_events, iter_inputs, read_session
from fes.journal.record import Note, Received, SampleArrays, SessionLogError, SessionRecord
from fes.journal.writer import SessionWriter

__all__ = [
    "Note",
    "Received",
    "SampleArrays",
    "SessionLogError",
    "SessionRecord",
    "SessionWriter",
    "iter_events",
    "iter_inputs",
    "read_session",
]
