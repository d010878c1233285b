"""The session log: append-only, a checksum per record, readable to the last whole record whatever happened."""

from fes.session_log.framing import Received, SessionLogError, SessionRecord
from fes.session_log.reader import iter_events, iter_inputs, read_session
from fes.session_log.writer import SessionWriter
from fes.walk_record import Note, SampleArrays

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
