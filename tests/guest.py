"""A Linux in user mode with a genuine ``vcan0``, for machines whose own kernel has no CAN. No root, no module needed.

Debian's ``user-mode-linux`` is a kernel that runs as a process, with ``vcan`` and ``can-raw`` beside it; it sees the
host's files read-only, so the tests' own virtual environment runs in it unchanged. Its exit status does not come out;
the tests' result does, through the one folder that it may write.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

PACKAGES = ("user-mode-linux", "busybox-static")
MODULES = ("net/can/can", "net/can/can-raw", "drivers/net/can/dev/can-dev", "drivers/net/can/vcan")
ROOT = Path(__file__).resolve().parents[1]
MEMORY = "1024M"
UP = "up"  # the file that tells that the guest runs

INIT = """#!{busybox} sh
b={busybox}
$b mount -t proc proc /proc
$b mount -t sysfs sys /sys
$b mkdir -p /dev/shm /dev/pts
$b mount -t tmpfs shm /dev/shm
$b mount -t devpts pts /dev/pts
$b mount -t tmpfs tmp /mnt
$b mkdir /mnt/out /mnt/tmp
$b mount -t hostfs -o {out} none /mnt/out
$b touch /mnt/out/{up}
for module in {modules}; do $b insmod {kernel}/$module.ko; done
$b ip link set lo up
$b ip link add vcan0 type vcan
$b ip link set vcan0 up
export HOME=/mnt TMPDIR=/mnt/tmp XDG_CACHE_HOME=/mnt/tmp PATH=/usr/sbin:/usr/bin:/sbin:/bin
export PYTHONDONTWRITEBYTECODE=1 FES_TEST_BUS=socketcan:vcan0 FES_BUSYBOX=$b
cd {project}
{command} > /mnt/out/output.txt 2>&1 < /dev/null
echo $? > /mnt/out/status.txt
$b sync
$b poweroff -f
"""


class NoGuest(RuntimeError):
    """The guest cannot be had on this machine; the message says why."""


class NoResult(RuntimeError):
    """The guest came up, and left nothing or did not end; the message holds what it said."""


@dataclass(frozen=True)
class Kernel:
    """Where the unpacked packages hold what is needed."""

    linux: Path
    modules: Path
    busybox: Path


def unpacked(folder: Path) -> Kernel:
    """The guest's kernel, fetched with the machine's own package manager the first time.

    Raises:
        NoGuest: no such package manager, or it cannot reach the packages.
    """
    marker = folder / "complete"
    if not marker.exists():
        for tool in ("apt-get", "dpkg-deb"):
            if shutil.which(tool) is None:
                raise NoGuest(f"{tool} is not there to fetch {' and '.join(PACKAGES)}")
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        fetch = subprocess.run(
            ["apt-get", "download", *PACKAGES], cwd=folder, capture_output=True, text=True, timeout=180, check=False
        )
        if fetch.returncode:
            raise NoGuest(f"{' and '.join(PACKAGES)} cannot be fetched: {fetch.stderr.strip()[-200:]}")
        for package in folder.glob("*.deb"):
            subprocess.run(["dpkg-deb", "-x", str(package), str(folder)], check=True)
            package.unlink()
        marker.touch()
    kernels = sorted(folder.glob("usr/lib/uml/modules/*/kernel"))
    kernel = Kernel(folder / "usr/bin/linux.uml", kernels[-1] if kernels else folder, folder / "bin/busybox")
    if not kernels or not kernel.linux.exists() or not kernel.busybox.exists():
        raise NoGuest(f"the packages unpacked in {folder} do not hold what they used to; delete that folder")
    return kernel


def cache_folder() -> Path:
    """Where the unpacked packages stay between runs."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fes" / "user-mode-linux"


def run_in_guest(arguments: list[str], folder: Path, timeout_s: float) -> tuple[int, str]:
    """Run this Python with ``arguments`` inside the guest, in the project's folder; its exit status and output.

    Raises:
        NoGuest: there is none, or it did not come up, as on processors that its kernel does not know.
        NoResult: it came up, and did not come to an end or left no result.
    """
    kernel = unpacked(cache_folder())
    out = folder / "out"
    out.mkdir()
    init = folder / "init.sh"
    init.write_text(
        INIT.format(
            busybox=kernel.busybox,
            out=out,
            up=UP,
            modules=" ".join(MODULES),
            kernel=kernel.modules,
            project=ROOT,
            command=" ".join([sys.executable, *arguments]),
        ),
        encoding="utf-8",
    )
    init.chmod(0o755)
    boot = [str(kernel.linux), f"mem={MEMORY}", "root=/dev/root", "rootfstype=hostfs", "rootflags=/", "ro"]
    boot += [f"init={init}", "con=null", "con0=fd:0,fd:1", "quiet"]
    with (folder / "console.txt").open("wb") as console:
        # a group of its own: the guest consists of several processes, and all must go
        guest = subprocess.Popen(boot, stdin=subprocess.DEVNULL, stdout=console, stderr=console, start_new_session=True)
        try:
            guest.wait(timeout_s)
        except subprocess.TimeoutExpired:
            if not (out / UP).exists():
                raise NoGuest(f"the guest did not come up within {timeout_s:g} s") from None
            raise NoResult(f"the guest did not end within {timeout_s:g} s: {_tail(folder)}") from None
        finally:
            if guest.poll() is None:
                os.killpg(guest.pid, 9)
                guest.wait(10)
    if not (out / UP).exists():
        raise NoGuest(f"the guest did not come up: {' '.join(_tail(folder).split())[-200:]}")
    try:
        return int((out / "status.txt").read_text()), (out / "output.txt").read_text(errors="replace")
    except (OSError, ValueError) as error:
        raise NoResult(f"the guest left no result: {_tail(folder)}") from error


def _tail(folder: Path) -> str:
    said = [folder / "console.txt", folder / "out" / "output.txt"]
    return " … ".join(path.read_text(errors="replace")[-500:] for path in said if path.exists())
