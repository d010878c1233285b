"""Evidence as JSON with a digest, and the page that is made of evidence and of nothing else.

The digest is SHA-256 over all else, written in one fixed manner: a figure that was changed, by hand, by a merge or on
the way, is found. Whoever changes one on purpose can make a new digest; then the page changes with it, under the name
of who commits that. A lab that wants to know its own evidence again gives a key of its own: HMAC-SHA256 with it is
beside the digest. A public key would prove more, and asks for a library and for somebody to vouch for keys.
"""

import hashlib
import hmac
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from fes.qualify.judging import findings

FORMAT: Final = 1
LEAST_KEY_BYTES: Final = 16
TITLES: Final = {"sensor": "Sensor", "stimulator": "Stimulator"}
PAGE: Final = """# Hardware that was tried

Written by `fes qualify --page docs/evidence`, from the evidence in `docs/evidence/` and from nothing else; how evidence
comes about is in [qualification](qualify.md). Do not edit.

## Real devices

{real}

## Simulated devices

These ran against this project's own simulated devices, with a simulated person, on a simulated clock. They show that
the qualification works. Of any real device they say nothing.

{simulated}
{details}"""
NONE_REAL: Final = "**None. No device has been tried for real.**"


class EvidenceRefused(ValueError):
    """A file is no evidence, or not as it was written; the message names the file."""


def sealed(evidence: Mapping[str, Any], key: bytes = b"") -> dict[str, Any]:
    """With its digest, and with ``key`` its signature. ValueError: a figure is not finite, or the key is too short."""
    body = {"format": FORMAT, **evidence}
    text = _canonical(body)
    body["digest"] = hashlib.sha256(text).hexdigest()
    if key:
        body["signature"] = {"key": _key_name(key), "hmac_sha256": hmac.new(_checked(key), text, "sha256").hexdigest()}
    return body


def load_evidence(path: Path, key: bytes = b"") -> dict[str, Any]:
    """Evidence as it was written; with ``key`` its signature by that key is checked too.

    Raises:
        EvidenceRefused: it cannot be read, is none, or is not as it was written.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        body = {name: value for name, value in data.items() if name not in ("digest", "signature")}
        text, digest, signature = _canonical(body), data["digest"], data.get("signature")
        if body["format"] != FORMAT:
            raise EvidenceRefused(f"{path}: is of format {body['format']}; this program reads {FORMAT}")
        findings(body)
    except EvidenceRefused:
        raise
    except OSError as error:
        raise EvidenceRefused(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise EvidenceRefused(f"{path}: is no evidence of `fes qualify`: {type(error).__name__} {error}") from error
    if not hmac.compare_digest(hashlib.sha256(text).hexdigest(), str(digest)):
        raise EvidenceRefused(f"{path}: its digest is another's: something in it was changed after it was written")
    if key and signature and signature.get("key") == _key_name(key):
        found = hmac.new(key, text, "sha256").hexdigest()
        if not hmac.compare_digest(found, str(signature.get("hmac_sha256"))):
            raise EvidenceRefused(f"{path}: its signature does not hold: somebody without the key wrote it")
    return dict(data)


def hardware_page(folder: Path, key: bytes = b"") -> str:
    """The page, of all evidence in a folder. EvidenceRefused: a file is not as it was written."""
    if not folder.is_dir():
        raise EvidenceRefused(f"{folder}: there is no such folder")
    files = sorted(folder.glob("*.json"))
    records = [(path, load_evidence(path, key)) for path in files]
    order = sorted(records, key=lambda pair: (pair[1]["what"], pair[1]["settings"]["device"], pair[1]["when"]))
    real, simulated = ([pair for pair in order if pair[1]["simulated"] is apart] for apart in (False, True))
    details = "".join(f"\n{_detail(path, each)}" for path, each in (*real, *simulated))
    none = "None."
    page = PAGE.format(real=_table(real) or NONE_REAL, simulated=_table(simulated) or none, details=details)
    return page.rstrip() + "\n"


def _table(records: Iterable[tuple[Path, dict[str, Any]]]) -> str:
    rows = []
    for path, each in records:
        deviates = [finding.name.replace("_", " ") for finding in findings(each)]
        serial, firmware = each["serial"] or "not said", each["firmware"] or "not said"
        cells = (
            each["settings"]["device"],
            each["what"],
            serial,
            firmware,
            each["when"][:10],
            each["by"],
            each["with"],
        )
        rows.append([*cells, ", ".join(deviates) or "nothing", f"[{each['digest'][:12]}](evidence/{path.name})"])
    if not rows:
        return ""
    heads = ["device", "what", "serial", "firmware", "when", "by", "with", "deviates in", "evidence"]
    return "\n".join(f"| {' | '.join(map(_cell, row))} |" for row in (heads, ["---"] * len(heads), *rows))


def _detail(path: Path, each: dict[str, Any]) -> str:
    """What was tested, with every figure."""
    simulated = ", simulated" if each["simulated"] else ""
    lines = [f"### {TITLES[each['what']]} {each['settings']['device']}{simulated}: {path.stem}", ""]
    lines += [f"- **{finding.name.replace('_', ' ')}**: {finding.text}" for finding in findings(each)]
    lines += ["", "| tested | figure |", "|---|---|"][not findings(each) :]
    lines += [f"| {name.replace('_', ' ')} | {_cell(shown(value))} |" for name, value in each["figures"].items()]
    return "\n".join(lines) + "\n"


def shown(value: Any) -> str:
    """A figure for people."""
    if isinstance(value, (list, tuple)):
        return ", ".join(map(shown, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or value == "":
        return "–"
    return f"{value + 0.0:.4g}" if isinstance(value, float) else str(value)  # no negative zero


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")


def _canonical(body: Mapping[str, Any]) -> bytes:
    return json.dumps(body, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()


def _checked(key: bytes) -> bytes:
    if len(key) < LEAST_KEY_BYTES:
        raise ValueError(f"the key has {len(key)} bytes; {LEAST_KEY_BYTES} are the least")
    return key


def _key_name(key: bytes) -> str:
    """Tells keys apart, and says nothing of what is in them."""
    return hashlib.sha256(b"fes evidence key\0" + _checked(key)).hexdigest()[:16]


def finite(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Figures as JSON can hold them: a number that is none becomes null."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in figures.items()
    }
