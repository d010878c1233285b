"""The session log: append-only, a checksum per record, readable to the last whole record whatever happened."""

from fes.journal.reader import iter_events, read_session
from fes.journal.record import Note, SampleArrays, SessionLogError, SessionRecord
from fes.journal.writer import SessionWriter

__all__ = ["Note", "SampleArrays", "SessionLogError", "SessionRecord", "SessionWriter", "iter_events", "read_session"]
