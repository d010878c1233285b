"""The HTML report: self-contained, escaped, complete, and sane for every odd session."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import report_records as make
from click.testing import CliRunner

from fes.cli import main
from fes.report.figures.svg import Plot, nice_ticks, padded
from fes.report.figures.timeseries import MISSING, chart_data, even_grid, main_axis_rate_radps, pack
from fes.report.html import ReportError, embed
from fes.report.page import render_report, write_report
from fes.report.summary import summarise_session
from fes.report.text import local_time
from fes.session_log import Note, SampleArrays, SessionRecord
from fes.session_log.writer import SessionWriter
from fes.signals import Tick

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"


class Page(HTMLParser):
    """Collects elements, their text and whatever could make a browser load something."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.loads: list[str] = []
        self.scripts: list[str] = []
        self.text = ""
        self.ids: set[str] = set()
        self._in: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        values = dict(attrs)
        self.loads += [f"{tag} {k}={v}" for k, v in attrs if k in ("src", "srcset", "data", "action", "poster")]
        if tag == "link" or (tag == "a" and not (values.get("href") or "").startswith("#")):
            self.loads.append(f"{tag} {values}")
        self.loads += [f"{tag} {k}" for k, _ in attrs if k.startswith("on")]
        if values.get("id"):
            self.ids.add(values["id"])
        if tag in ("script", "style"):
            self._in.append(tag)
            if tag == "script":
                self.scripts.append("")

    def handle_endtag(self, tag):
        if self._in and self._in[-1] == tag:
            self._in.pop()

    def handle_data(self, data):
        if not self._in:
            self.text += data
        elif self._in[-1] == "script":
            self.scripts[-1] += data


def no_loads(html: str) -> Page:
    page = Page(html)
    assert page.loads == []
    assert "default-src 'none'" in html
    css = "".join(re.findall(r"<style>(.*?)</style>", html, re.S))
    assert "url(" not in css
    assert "@import" not in css
    own_script = page.scripts[-1]
    assert not re.search(r"fetch|XMLHttpRequest|WebSocket|import\(|https?:", own_script)
    return page


def test_report_holds_every_section_and_loads_nothing(tmp_path):
    path = tmp_path / "deep" / "report.html"
    write_report(make.walk(12), path)
    html = path.read_text(encoding="utf-8")
    page = no_loads(html)
    sections = {"summary", "paths", "signals", "strides", "phases", "stimulation", "latency", "table", "quality"}
    sections |= {"parameters"}
    assert sections | {"settings", "words"} <= page.ids
    assert "Research software, not a medical device" in page.text
    assert "24 of 24 swings passed all four phases" in page.text
    assert "2026-11-20 10:00 UTC" in page.text
    # first page, over the stride, butterfly, space, each stride, phases, stimulation, envelopes, swing, latency
    assert html.count('<svg class="plot') == 2 + 3 + 2 + 1 + 2 + 2 + 2 + 2 + 2 + 1
    assert "Permission is hereby granted" in page.scripts[-2]
    assert not list(path.parent.glob("*.part"))


def test_the_same_record_gives_the_same_bytes():
    assert render_report(make.walk(4)) == render_report(make.walk(4))


def test_hostile_words_are_shown_and_not_run():
    record = make.walk(4)
    names = [make.channel(0, "left_foot", HOSTILE[:60]), make.channel(1, "right_foot", "TA")]
    record.header = make.header(names, name=HOSTILE, subject=HOSTILE)
    record.header["recording"]["name"] = HOSTILE
    record.header["fes_version"] = record.header["created"] = record.header["kind"] = HOSTILE
    record.header["calibration"] = {HOSTILE: {HOSTILE: HOSTILE}}
    record.strides[0] = replace(record.strides[0], valid=False, reason=HOSTILE)
    record.commands[3] = replace(record.commands[3], on=False, refused=HOSTILE)
    record.notes.append(Note(make.at(1), "fault", HOSTILE, HOSTILE))
    record.summary = {HOSTILE: HOSTILE}
    record.complete, record.lost = False, HOSTILE
    html = render_report(record)
    page = no_loads(html)
    assert len(page.scripts) == 3
    assert "img" not in page.tags
    assert HOSTILE in page.text
    assert "onerror=alert(2)>" not in html.replace("&gt;", "")
    assert json.loads(page.scripts[0])["current"]["channels"][0]["name"] == HOSTILE[:60]


def test_hostile_foot_name_is_escaped_in_the_plots():
    record = SessionRecord(make.header([]), complete=True)
    record.strides = [replace(make.stride(i, i * 1.4), foot=HOSTILE) for i in range(3)]
    page = no_loads(render_report(record))
    assert len(page.scripts) == 3


def nothing() -> SessionRecord:
    return SessionRecord(make.header([]), complete=True)


def empty_header() -> SessionRecord:
    return SessionRecord({})


def no_channels() -> SessionRecord:
    record = make.walk(5)
    record.header = make.header([])
    record.commands, record.statuses = [], []
    return record


def one_foot() -> SessionRecord:
    return make.walk(5, ("left_foot",))


def one_stride() -> SessionRecord:
    return make.walk(1)


def no_latency() -> SessionRecord:
    record = make.walk(5)
    record.latency_ns = record.latency_t_ns = np.zeros(0, np.int64)
    return record


def not_a_number() -> SessionRecord:
    record = make.walk(5)
    nan = float("nan")
    record.strides = [
        replace(
            stride,
            stride_length_m=nan,
            clearance_m=nan,
            speed_mps=nan,
            turn_rad=nan,
            trajectory_m=np.full((101, 3), nan),
            pitch_rad=np.full(101, nan),
        )
        for stride in record.strides
    ]
    for samples in record.samples.values():
        samples.acc_mps2[:] = nan
        samples.gyr_radps[100:200] = nan
    return record


def no_paths() -> SessionRecord:
    record = make.walk(5)
    record.strides = [replace(s, trajectory_m=np.zeros((0, 3)), pitch_rad=np.zeros(0)) for s in record.strides]
    return record


def no_phases() -> SessionRecord:
    record = make.walk(5)
    record.phases = []
    gone = {"t_pre_swing_ns": None, "t_swing_ns": None, "t_loading_response_ns": None, "t_stance_ns": None}
    record.strides = [replace(stride, **gone) for stride in record.strides]
    return record


def none_valid() -> SessionRecord:
    record = make.walk(5)
    record.strides = [replace(stride, valid=False, reason="slow") for stride in record.strides]
    return record


def one_sample() -> SessionRecord:
    record = nothing()
    t = np.array([make.T0])
    record.samples["left_foot"] = SampleArrays(t, t, np.ones((1, 3)), np.ones((1, 3)))
    return record


CASES = (
    *(nothing, empty_header, no_channels, one_foot, one_stride, no_latency, not_a_number, no_paths, no_phases),
    *(none_valid, one_sample),
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_odd_sessions_give_a_sane_report(case):
    page = no_loads(render_report(case()))
    assert "Summary" in page.text
    assert not re.search(r"\bnan\b|\binf\b|None|Undefined", page.text)
    json.loads(page.scripts[0])


def test_odd_sessions_say_what_is_missing():
    assert "No stimulation channel was set up" in Page(render_report(no_channels())).text
    assert "The latency was not measured" in Page(render_report(no_latency())).text
    assert "No stride was found" in Page(render_report(nothing())).text
    assert "– m/s" in Page(render_report(not_a_number())).text


def test_a_torn_session_carries_a_banner():
    record = make.walk(3)
    assert "no proper end" not in Page(render_report(record)).text
    record.complete, record.lost = False, "41 bytes after byte 90112"
    text = Page(render_report(record)).text
    assert "This session has no proper end" in text
    assert "41 bytes after byte 90112" in text


def test_stimulation_outside_its_phases_is_red():
    record = make.walk(4)
    record.commands = sorted(record.commands + make.burst(0, 4.2, 0.3), key=lambda command: command.t_ns)
    html = render_report(record)
    assert '<li class="alert">' in html
    assert 'class="bad"' in html


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("x", encoding="utf-8")
    with pytest.raises(ReportError, match=r"file.*cannot be written") as raised:
        write_report(nothing(), blocked / "report.html")
    assert raised.value.strerror


def test_a_90_s_session_at_500_hz_stays_small():
    record = make.walk(63, rate_hz=500.0)
    assert len(render_report(record).encode()) < 3_000_000


def test_embedded_json_cannot_end_its_element():
    text = embed({"a": HOSTILE, "b": float("nan"), "c": "\u2028"})
    assert "<" not in text
    assert text.isascii()
    assert json.loads(text) == {"a": HOSTILE, "b": None, "c": "\u2028"}


def unpack(packed) -> np.ndarray:
    raw = np.frombuffer(base64.b64decode(packed["data"]), "<i2")
    return np.where(raw == MISSING, np.nan, raw * packed["step"])


def test_packed_values_come_back_within_half_a_step():
    values = np.array([0.0, 1.5, -2.0, np.nan, 1999.9])
    packed = pack(values)
    np.testing.assert_allclose(unpack(packed), values, atol=packed["step"] / 2)
    assert packed["step"] < 0.07
    assert np.isnan(unpack(pack(np.full(3, np.nan)))).all()


def test_fast_signals_keep_their_peaks_and_gaps():
    t_s = np.arange(5000) / 500.0
    values = np.sin(t_s)
    values[1234] = 50.0
    keep = (t_s < 4) | (t_s > 5)
    start, step, even = even_grid(t_s[keep], values[keep], 200)
    assert (start, step) == (0.0, pytest.approx(0.005))
    assert np.nanmax(even) == 50.0
    assert abs(np.nanargmax(even) * step - t_s[1234]) < 0.011
    assert np.isnan(even[int(4.1 / step) : int(4.9 / step)]).all()
    assert not np.isnan(even[: int(3.9 / step)]).any()


def test_slow_signals_keep_their_samples():
    t_s = np.arange(300) / 100.0
    values = np.cos(t_s)
    _, step, even = even_grid(t_s, values, 200)
    assert step == pytest.approx(0.01)
    np.testing.assert_allclose(even, values[: even.size], atol=1e-9)


def test_rotation_rate_is_toe_down_positive_however_the_sensor_sits():
    record = make.walk(6)
    view = summarise_session(record)
    samples = record.samples["left_foot"]
    rate, known = main_axis_rate_radps(samples, view.timelines["left_foot"])
    turned = SampleArrays(samples.t_ns, samples.t_sensor_ns, samples.acc_mps2, -samples.gyr_radps[:, [2, 0, 1]])
    other, _ = main_axis_rate_radps(turned, view.timelines["left_foot"])
    assert known
    np.testing.assert_allclose(rate, other, atol=1e-9)
    assert rate.max() > 5  # push-off


def test_values_that_no_sensor_has_and_a_stamp_of_another_age_are_left_out_of_the_charts():
    record = make.walk(4)
    samples = record.samples["left_foot"]
    before = chart_data(summarise_session(record))["feet"][0]
    stamps, gyr = samples.t_sensor_ns.copy(), samples.gyr_radps.copy()
    stamps[7], gyr[9:12] = -(2**62), 1e300
    record.samples["left_foot"] = SampleArrays(samples.t_ns, stamps, samples.acc_mps2, gyr)
    after = chart_data(summarise_session(record))["feet"][0]
    assert after["pieces"] == before["pieces"]
    assert after["gyr_degps"]["step"] == pytest.approx(before["gyr_degps"]["step"], rel=1e-3)


@pytest.mark.parametrize("t_ns", [-(2**63), 2**62, 2**63 - 1])
def test_times_that_no_session_has_are_refused_with_the_file(tmp_path: Path, t_ns: int):
    log = SessionWriter(tmp_path / "s.feslog", make.header())
    log.event(Tick(make.T0))
    log.event(Tick(t_ns))
    log.close({"ended": "complete"})
    result = CliRunner().invoke(main, ["report", str(tmp_path / "s.feslog")])
    assert (result.exit_code, "no session is so long" in result.output) == (2, True)
    assert str(tmp_path / "s.feslog") in result.output


def test_charts_carry_phases_and_currents_of_the_record():
    record = make.walk(4)
    data = chart_data(summarise_session(record))
    left = data["feet"][0]
    assert left["name"] == "left foot"
    assert left["phase"][:5] == [0, 1, 2, 3, 0]
    assert left["phase_start_s"][1] == pytest.approx((record.phases[0].t_ns - make.T0) / 1e9, abs=1e-4)
    current = unpack(data["current"]["channels"][0]["current_ma"])
    assert current.max() == pytest.approx(20.0, abs=0.01)
    assert data["current"]["pieces"] == [[0, current.size]]


def test_ticks_are_round_and_ranges_never_empty():
    assert nice_ticks(0.0, 1.0) == [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    low, high = padded([np.array([3.0, 3.0, np.nan])])
    assert low < 3.0 < high
    assert padded([np.array([np.nan])]) == (0.0, 1.0)


def test_a_line_breaks_where_a_value_is_missing():
    plot = Plot("l", "x", "y", (0.0, 3.0), (0.0, 1.0))
    plot.line(np.arange(4.0), np.array([0.0, np.nan, 1.0, 0.5]), "#000")
    (path,) = re.findall(r'<path d="([^"]*)" fill="none" stroke="#000"', plot.render())
    assert path.count("M") == 2
    assert path.count("L") == 1


def test_times_are_written_as_people_write_them():
    assert local_time("2026-11-20T10:00:00+02:00") == "2026-11-20 10:00 UTC+02:00"
    assert local_time("yesterday") == "yesterday"
