"""Without a compiler the gate's judge works on namespaces instead of numpy's records."""

from __future__ import annotations

from judges import PLAIN, use_plain_cores

if PLAIN:
    use_plain_cores()
