"""The live page: a browser's view of a session, served on loopback by a process of its own (see docs/page.md)."""
