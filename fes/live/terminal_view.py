"""The terminal view, a process of its own: ``python -m fes.live.terminal_view SOCKET_FD PARENT_PID``.

It shows; it decides nothing.
"""

import sys
from typing import Final

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from fes.live.processes import LOOK_EVERY_S, end_with, joined, orphaned
from fes.live.status import Status, TuningStatus, ground_text

COLOURS: Final = {
    "off": "dim",
    "shadow": "cyan",
    "armed": "yellow",
    "running": "green",
    "paused": "blue",
    "stopped": "bold white on red",
    "fault": "bold white on red",
}
KEYS: Final = (
    "SPACE stop · a arm · d disarm · p pause · + − intensity · 0–7 channel · b test · t trigger · < > belt"
    " · m mark · q quit · tuning: f freeze · g go on · y accept · r roll back"
)
LARGEST: Final = 1 << 16


def picture(status: Status) -> Group:
    """One frame."""
    head = Text.assemble(
        (f" {status.state.upper()} ", COLOURS.get(status.state, "")),
        f"  intensity {status.intensity:.0%}  channel {status.channel}  ",
        ("● CURRENT ON" if status.on else "○ off", "bold red" if status.on else "dim"),
        f"  ground: {ground_text(status.incline_percent)}",
    )
    table = Table("foot", "phase", "walking", "strides", "length (m)", "speed (m/s)", "belt (m/s)", "rate", "age (ms)")
    belt_mps = status.belt_speed_mps
    for name, foot in status.feet.items():
        speed_mps = foot.speed_mps  # red where it differs from the belt's by more than a tenth
        far = speed_mps is not None and belt_mps is not None and abs(speed_mps - belt_mps) > 0.1 * max(belt_mps, 0.1)
        table.add_row(
            name.replace("_", " "),
            foot.phase.replace("_", " "),
            "yes" if foot.walking else "no",
            str(foot.strides),
            _number(foot.stride_length_m, 2),
            Text(_number(speed_mps, 2), "red" if far else ""),
            _number(belt_mps, 2),
            f"{foot.rate_hz:.0f} Hz",
            f"{foot.age_ms:.0f}",
        )
    timing = (
        f"latency p50 {_number(status.latency_p50_ms, 2)} ms, p99 {_number(status.latency_p99_ms, 2)} ms · "
        f"lateness p99 {_number(status.lateness_p99_ms, 2)} ms · samples {status.samples} · "
        f"stimulator {status.stimulator}"
    )
    lines: list[Text | Table | Panel] = [head, table, Text(timing, "dim"), Text(status.message)]
    lines += [Text(f"! {notice}", "yellow") for notice in status.notices]
    lines += [text for number, one in status.tuning.items() if (text := _tuning(number, one))]
    if status.fault:
        texts = filter(None, (status.fault, status.remedy, "Off until armed again by hand (a)."))
        lines.append(Panel(Text("\n".join(texts), "bold red"), title=status.state.upper()))
    return Group(*lines, Text(KEYS, "dim"))


def _tuning(number: str, one: TuningStatus) -> Text | None:
    """The next burst, the suggestion, the last change with its reason, the charge; None where there is nothing yet."""
    if one.mode == "off" and not one.session_uc:
        return None
    text = Text.assemble((f"channel {number}: ", "bold"))
    if one.mode != "off":
        text.append(f"tuning {one.mode}, set to {one.now} at full intensity")
        text.append(f", FROZEN ({one.frozen})" if one.frozen else "", "bold yellow")
        text.append(" · ")
    text.append(f"{one.step_uc:.0f} µC a step, {one.minute_uc / 1e3:.2f} mC this minute, {one.session_uc / 1e3:.2f} mC")
    if one.suggestion:
        text.append(f"\n  {one.why} (y accepts)", "yellow")
    if one.last_change:
        text.append(f"\n  last change: {one.last_change}", "dim")
    if one.hint:
        text.append(f"\n  {one.hint}", "red")
    return text


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def main() -> int:
    """Show what comes until the session says that it is over, or is gone."""
    link, parent, _ = joined()
    end_with(parent)
    with link, Live(console=Console(), auto_refresh=False, transient=False) as live:
        link.settimeout(LOOK_EVERY_S)
        while not orphaned(parent):
            try:
                datagram = link.recv(LARGEST)
            except TimeoutError:
                continue
            if not datagram:
                break
            try:
                status = Status.decode(datagram)
            except ValueError:
                continue
            live.update(picture(status), refresh=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
