"""Make the pictures of the live page and of the report: ``python docs/screenshots.py [page] [report]``; needs Chromium.

Nothing is staged: simulated sensors on both feet, a simulated stimulator, `fes run --dashboard`, armed and raised over
the control socket, and a real browser; `fes demo` and `fes analyse --hemiparetic`. The printed page needs pdftoppm.
"""

from __future__ import annotations

import sys
import tempfile
import time
from base64 import b64decode
from contextlib import ExitStack
from pathlib import Path
from subprocess import DEVNULL, run

ROOT = Path(__file__).resolve().parents[1]
sys.path += [str(ROOT / "tests"), str(ROOT / "tests" / "transports")]

from live_runs import Bench, LiveRun, bus_text, live_run, sensor_text, standing_first  # noqa: E402
from page_browser import Page, chromium  # noqa: E402
from PIL import Image  # noqa: E402
from replays import cut, trial  # noqa: E402

from benchmarks.lib.channels import channel, toml  # noqa: E402
from drivers.simulated.spawn import spawn_imu, spawn_node  # noqa: E402
from fes.calibration.recording import calibrate_phase_sensors, save  # noqa: E402
from fes.recording import Recording, write_recording  # noqa: E402
from fes.signals import FOOT_SENSORS, NS_PER_S  # noqa: E402
from fes.simulation.forward import VirtualPatient, settings_for  # noqa: E402
from fes.simulation.forward.closed_loop import recording_of  # noqa: E402

TRIAL = "both_feet_200hz"
RATE_HZ = 200.0
STANDING_S = 12
SEEN_S = 7.0
WALKED_S = 45
FES = Path(sys.executable).with_name("fes")
LARGEST_BYTES = 250_000
CHANNEL = toml(
    "[[channels]]",
    channel(
        "left_foot", {
            "max_charge_per_phase_uc": 12.0, "max_charge_per_minute_mc": 20.0, "max_current_density_ma_per_cm2": 0.5,
            "max_rise_ma_per_s": 400.0,
        }, name="Peroneus, left", number=1, muscle="peroneus longus", current_ma=22.0, pulse_width_us=250.0,
        start_phase="pre_swing", stop_phase="loading_response", rise_s=0.15, extension_s=0.06, fall_s=0.10,
    ),
)  # fmt: skip


def both_feet(folder: Path, recording: Path, stack: ExitStack) -> Bench:
    """A sensor on each foot, each on a line of its own, the stimulator on CAN."""
    node = stack.enter_context(spawn_node(record=folder / "node.jsonl"))
    sensors = ("right_foot", "left_foot")
    imus = [
        stack.enter_context(spawn_imu("xbus", sensor=sensor, recording=recording, rate_hz=RATE_HZ))
        for sensor in sensors
    ]
    lines = [
        sensor_text("xbus", imu.port, sensor=sensor, rate_hz=RATE_HZ) for imu, sensor in zip(imus, sensors, strict=True)
    ]
    return Bench(sensors[0], imus[0], node, CHANNEL + bus_text(node.bus) + "".join(lines))


def link_of(run: LiveRun) -> str:
    """The page's link, once it is there."""
    while not (found := list(run.folder.glob("*/*/page.url"))):
        time.sleep(0.05)
    return found[0].read_text().strip()


def walking(run: LiveRun, page: Page) -> None:
    """Until there are strides to see, in the middle of a step; armed again where a busy machine held it up."""
    while page.run("document.querySelectorAll('#strides tr').length") < 10:
        run.in_mid_burst(240.0)
    run.in_mid_burst(240.0)
    time.sleep(SEEN_S)  # so that the chart of the last ten seconds has some bursts
    run.in_mid_burst(240.0)
    page.until("document.getElementById('current').className === 'on'")


def taken(page: Page, name: str) -> None:
    """Keep the picture in docs."""
    page.picture(ROOT / "docs" / name)
    smaller(name)


def smaller(name: str) -> None:
    """A picture of docs in 256 colours, a quarter of the bytes, and how large it is then."""
    path = ROOT / "docs" / name
    with Image.open(path) as picture:
        picture.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    size = path.stat().st_size
    print(f"{path.relative_to(ROOT)}  {size / 1000:.0f} kB")
    if size > LARGEST_BYTES:
        print(f"{name}: over {LARGEST_BYTES / 1000:.0f} kB")


def live_page() -> None:
    """The three pictures of the live page."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        whole = trial(TRIAL)
        recording, calibration = folder / "loop.parquet", folder / "loop.calibration.json"
        write_recording(standing_first(cut(whole, 0.0, 30.0), STANDING_S), recording)
        save(calibrate_phase_sensors(whole), calibration)
        run = stack.enter_context(
            live_run(folder, recording, "--calibration", calibration, "--dashboard", bench=both_feet)
        )
        page = stack.enter_context(chromium(folder / "browser"))
        page.size(1280, 800)
        page.go(link_of(run))
        run.armed_at()
        walking(run, page)
        taken(page, "page_desktop.png")
        page.size(768, 1024, dark=True, touch=True)
        walking(run, page)
        page.press("#up")
        page.until("!document.getElementById('question').hidden")
        taken(page, "page_tablet.png")
        page.press("#no")
        page.size(390, 844, touch=True)
        run.order("mark", text="brace on")
        walking(run, page)
        taken(page, "page_phone.png")
        run.quit()


def hemiparetic_walk() -> Recording:
    """A virtual patient's, from standing to standing."""
    patient = VirtualPatient(
        settings_for("moderate", pattern="hemiparetic_3", seed=3, rate_hz=100.0, side="right", sensors=FOOT_SENSORS)
    )
    samples = patient.advance(WALKED_S * NS_PER_S)
    patient.stop()
    samples += patient.advance((WALKED_S + 10) * NS_PER_S)
    return recording_of(patient, samples, "hemiparetic", "")


def report() -> None:
    """The demo's report on a screen, a hemiparetic walk's on a tablet, and the demo's first printed page."""
    with tempfile.TemporaryDirectory() as name, chromium(Path(name) / "browser") as page:
        folder = Path(name)
        run([FES, "demo", "--out", folder / "demo"], check=True, stdout=DEVNULL)
        (demo,) = (folder / "demo").glob("*/report.html")
        page.size(1280, 900)
        page.go(demo.as_uri())
        taken(page, "report_desktop.png")
        printed = b64decode(page.call("Page.printToPDF", preferCSSPageSize=True)["data"])
        pdf, png = folder / "report.pdf", ROOT / "docs" / "report_print"
        pdf.write_bytes(printed)
        run(["pdftoppm", "-r", "110", "-l", "1", "-singlefile", "-png", pdf, png], check=True)
        smaller("report_print.png")
        walked = folder / "hemiparetic.parquet"
        write_recording(hemiparetic_walk(), walked)
        run([FES, "analyse", walked, "--hemiparetic", "--out", folder], check=True, stdout=DEVNULL)
        (walk,) = folder.glob("hemiparetic-*/report.html")
        page.size(820, 1180, touch=True)
        page.go(walk.as_uri())
        page.run("location.hash = '#hemiparetic'")  # which opens the fold that it stands in
        page.until("document.getElementById('hemiparetic').getBoundingClientRect().top < 200")
        taken(page, "report_tablet.png")


if __name__ == "__main__":
    for each in sys.argv[1:] or ("page", "report"):
        {"page": live_page, "report": report}[each]()
