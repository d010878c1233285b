"""Evidence as JSON with a digest, and the page that is made of evidence and of nothing else.

The digest is SHA-256 over all else, written in one fixed manner: a figure that was changed, by hand, by a merge or on
the way, is found. Whoever changes one on purpose can make a new digest; then the page changes with it, under the name
of who commits that. A lab that wants to know its own evidence again gives a key of its own: HMAC-SHA256 with it is
beside the digest. A public key would prove more, and asks for a library and for somebody to vouch for keys.

Figures of a device against what its settings, its maker and this project ask for: what deviates, in words.

Judged anew whenever it is shown, so that old evidence is held against the limits of today.
"""

import hashlib
import hmac
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from fes import limits
from fes.qualify.sensor import AXES, STILL_SHARE, Figures

RATE_SHARE: Final = 0.02  # more is another setting, not a crystal's error
CLOCK_PPM: Final = 500.0  # a poor crystal has 100; the host's clock may be turned by 500 (NTP) while it is measured
LOST_SHARE: Final = 0.001  # of the samples, or bad in any other manner: by cable none are
FORCE_GAIN, FORCE_BIAS_MPS2 = 0.03, 0.5  # a side set up by hand leans by 5° at most, which is 0.4 % of gravity
RATE_GAIN: Final = 0.05  # a turn along an edge is a full one within 10°
RANGE_SHARE: Final = 0.98  # of the full scale in the settings
SERIALS_SAID: Final = ("xbus", "capture2go", "capture2go_ble", "movella_dot")  # kinds that say their number
READ_MA, READ_US, READ_SHARE = 0.2, 3.0, 0.02  # what a person reads from an oscilloscope, and 2 % of it
INTERVAL_SHARE: Final = 0.05
LATE_MS: Final = float(limits.MAX_DATA_AGE_MS)
OFF_MS: Final = float(limits.MAX_VALIDITY_MS)
ANSWER_MS: Final = 100.0  # ScienceMode2: within 100 ms; on CAN 45 ms latch the gate by themselves
SILENCE_MS: Final = {"p24_mid_level": 2000.0}  # the device's own watchdog (docs/stimulators.md); else the lease


class Finding(NamedTuple):
    """A deviation: what of the device, and in words by how much."""

    name: str
    text: str


def findings(evidence: dict[str, Any]) -> list[Finding]:
    """All deviations that the figures of this evidence show, each name once.

    KeyError, TypeError: it is no evidence of a sensor or a stimulator.
    """
    figures, settings = evidence["figures"], evidence["settings"]
    found = _sensor(figures, settings) if evidence["what"] == "sensor" else _stimulator(figures, settings)
    return list({each.name: each for each in found}.values())


def _sensor(found: Figures, settings: dict[str, Any]) -> Iterator[Finding]:
    n, rate_hz = found["samples"], settings["rate_hz"]
    if found["serial"] != found["serial_again"] or (not found["serial"] and settings["device"] in SERIALS_SAID):
        yield Finding("identity", f"says serial {found['serial'] or '–'}, opened again {found['serial_again'] or '–'}")
    if abs(found["rate_hz"] / rate_hz - 1.0) > RATE_SHARE:
        yield Finding("rate", f"{found['rate_hz']:.2f} Hz instead of {rate_hz:g}")
    if found["clock_ppm"] is None or abs(found["clock_ppm"]) > CLOCK_PPM:
        yield Finding("clock", f"runs {found['clock_ppm'] or math.nan:+.0f} ppm fast")
    for name, text in (("missing", "lost"), ("bad_stamps", "with a stamp twice or backward")):
        if found[name] > LOST_SHARE * n:
            yield Finding(name, f"{found[name]} of {n} samples {text}")
    for name in ("bad_frames", "bad_values"):
        if found[name] > LOST_SHARE * n:
            yield Finding(name, f"{found[name]} beside {n} samples")
    late_ms = max(found["late_p99_ms"], -math.inf if found["knock_ms"] is None else found["knock_ms"])
    if found["knock_ms"] is None:
        yield Finding("late", "no blow was seen, so its delay is not known")
    elif late_ms > LATE_MS:
        yield Finding("late", f"samples come {late_ms:.0f} ms late, at most {LATE_MS:g} are allowed")
    if found["repeats_share"] > STILL_SHARE:
        yield Finding("frozen", f"{100 * found['repeats_share']:.0f} % of the samples at rest repeat the one before")
    elif found["dead_band_dps"] is None:
        yield Finding("dead_band", "shows no rate at all")
    elif found["dead_band_dps"] > 0:
        yield Finding("dead_band", f"shows no rate below {found['dead_band_dps']:.2f} °/s")
    for triad, what, unit, most in (
        ("acc", "force", "g", settings["acc_range_g"]),
        ("gyr", "rate", "dps", settings["gyr_range_dps"]),
    ):
        end = found[f"{triad}_ends_at_{unit}"]
        if end is not None and end < RANGE_SHARE * most:
            yield Finding(f"{what}_range", f"ends at {end:.4g} {unit}, the settings say {most:g}")
        wrong = [f"{a} is {axis}" for a in AXES if (axis := found[f"{triad}_{a}_axis"]) not in (None, f"+{a}")]
        if wrong:
            yield Finding(f"{what}_axes", ", ".join(wrong))
        gains = {a: found[f"{triad}_{a}_gain"] for a in AXES}
        within = FORCE_GAIN if triad == "acc" else RATE_GAIN
        if off := [f"{a} × {g or math.nan:.3f}" for a, g in gains.items() if g is None or abs(g - 1) > within]:
            yield Finding(f"{what}_gain", ", ".join(off))
    biases = {a: found[f"acc_{a}_bias_mps2"] for a in AXES}
    if off := [f"{a} {b or math.nan:+.2f} m/s²" for a, b in biases.items() if b is None or abs(b) > FORCE_BIAS_MPS2]:
        yield Finding("force_bias", ", ".join(off))


def _stimulator(found: Figures, settings: dict[str, Any]) -> Iterator[Finding]:
    for name, unit, asked, read, least in (
        ("current", "mA", found["asked_ma"], found["read_ma"], READ_MA),
        ("width", "µs", found["asked_us"], found["read_us"], READ_US),
    ):
        pairs = zip(asked, read, strict=True)
        if wrong := [f"{r:g} for {a:g}" for a, r in pairs if abs(r - a) > least + READ_SHARE * a]:
            yield Finding(name, f"{', '.join(wrong)} {unit}")
    asked_ms, read_ms = found["interval_ms"], found["read_interval_ms"]
    if abs(read_ms / asked_ms - 1.0) > INTERVAL_SHARE:
        yield Finding("interval", f"{read_ms:g} ms between pulses instead of {asked_ms:g}")
    allowed = {"off": OFF_MS, "stop": OFF_MS, "silence": SILENCE_MS.get(settings["device"], 0.0) + OFF_MS}
    for ends, most_ms in allowed.items():
        if found[f"{ends}_after_ms"] > most_ms:
            yield Finding(ends, f"pulses for {found[f'{ends}_after_ms']:.0f} ms after it, at most {most_ms:g}")
        if found[f"{ends}_later_pulses"] > 0:
            yield Finding(f"{ends}_later", f"{found[f'{ends}_later_pulses']:g} pulses come later, by themselves")
    if not found["stop_refused_commands"]:
        yield Finding("gate", "no command was refused after the emergency stop")
    if "switch_noticed" in found:
        if found["switch_after_ms"] > OFF_MS:
            yield Finding("switch", f"pulses for {found['switch_after_ms']:.0f} ms after its own emergency switch")
        if not found["switch_noticed"]:
            yield Finding("switch_said", "does not say that its emergency switch was pressed")
        if found["switch_released_pulses"] > 0:
            yield Finding("switch_released", f"{found['switch_released_pulses']:g} pulses when the switch was released")
    first_ma = found["asked_ma"][0]
    if abs(found["again_ma"] - first_ma) > READ_MA + READ_SHARE * first_ma:
        yield Finding("again", f"{found['again_ma']:g} mA instead of {first_ma:g} after all this, armed again")
    if not found["answers"] or found["answer_p99_ms"] > ANSWER_MS:
        yield Finding("answers", f"99 % within {found['answer_p99_ms'] or math.nan:.0f} ms, at most {ANSWER_MS:g}")
    if found["latches"]:
        yield Finding("faults", "; ".join(dict.fromkeys(found["latches"])))


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
