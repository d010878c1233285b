"""What a session tells whoever watches it, ten times a second: one JSON datagram, never waited for."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any

VERSION = 1


@dataclass(frozen=True, slots=True)
class FootStatus:
    """One foot: its phase, last stride (m; None before the first), walking speed (m/s), and whether it walks."""

    phase: str
    walking: bool
    strides: int = 0
    stride_length_m: float | None = None
    speed_mps: float | None = None
    rate_hz: float = 0.0
    age_ms: float = 0.0


@dataclass(frozen=True, slots=True)
class Status:
    """A session at one moment; latency is from a sample's reading to the last byte written, since it began."""

    t_ns: int
    state: str
    message: str = ""
    fault: str = ""
    intensity: float = 0.0
    channel: int = 0
    on: bool = False
    feet: dict[str, FootStatus] = field(default_factory=dict)
    belt_speed_mps: float | None = None
    latency_p50_ms: float | None = None
    latency_p99_ms: float | None = None
    lateness_p99_ms: float | None = None
    samples: int = 0
    stimulator: str = ""
    dropped_frames: int = 0
    version: int = VERSION

    def encode(self) -> bytes:
        """The datagram."""
        return json.dumps(asdict(self), separators=(",", ":")).encode()

    @staticmethod
    def decode(datagram: bytes) -> Status:
        """Back from the datagram.

        Raises:
            ValueError: it is none of this version.
        """
        try:
            data: dict[str, Any] = json.loads(datagram)
            if data["version"] != VERSION:
                raise ValueError(f"status of version {data['version']}, this program reads {VERSION}")
            feet = {name: FootStatus(**foot) for name, foot in data.pop("feet").items()}
            return Status(**data, feet=feet)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"no status: {error}") from error
