"""What only SocketCAN does: the kernel's filters, an interface that goes down and comes back, a full transmit queue."""

from __future__ import annotations

import errno
import os
import subprocess
import time
from pathlib import Path

import can
import pytest
from full_queue import full_queue

from drivers.simulated.spawn import free_bus, spawn_node
from drivers.stimulator.bus import BusError, open_bus
from drivers.stimulator.can_codec import ALIVE_ID, NODE_IDS
from drivers.stimulator.can_port import CanStimulator
from drivers.stimulator.port import StimulatorLost
from fes.config import Bus
from fes.signals import StimCommand, StimStatus

INTERFACE, _, CHANNEL = os.environ.get("FES_TEST_BUS", "").partition(":")
pytestmark = pytest.mark.skipif(
    INTERFACE != "socketcan",
    reason="no SocketCAN: test_socketcan_guest runs this in a guest; on a real bus set FES_TEST_BUS=socketcan:can0",
)


def link(*arguments: str) -> None:
    """Configure the interface, with busybox in the guest and iproute2 elsewhere."""
    subprocess.run([*os.environ.get("FES_BUSYBOX", "").split(), "ip", "link", *arguments], check=True)


def command(t_ns: int, channel: int = 0, on: bool = True) -> StimCommand:
    return StimCommand(t_ns, channel, on, 20.0 if on else 0.0, 300.0 if on else 0.0, 40.0 if on else 0.0, 60)


def answers(port: CanStimulator, wait_s: float = 10.0) -> list[StimStatus]:
    end_s, heard = time.monotonic() + wait_s, []
    while port.outstanding and time.monotonic() < end_s:
        heard += [event for event in port.poll(time.monotonic_ns()) if isinstance(event, StimStatus)]
        time.sleep(0.002)
    return heard


def keep_sending(port: CanStimulator) -> None:
    for _ in range(100):
        port.send(command(0))
        port.poll(0)
        time.sleep(0.005)


def test_the_bus_under_test_is_genuine() -> None:
    with open_bus(free_bus()) as bus:
        assert type(bus).__name__ == "SocketcanBus"
        assert bus.channel_info.endswith(f"'{CHANNEL}'")


def test_the_kernel_filters_what_is_not_for_us() -> None:
    with open_bus(free_bus(), NODE_IDS) as ours, open_bus(free_bus()) as other:
        for identifier in (0x7FF, 0x000, ALIVE_ID, 0x055):
            other.send(can.Message(arbitration_id=identifier, data=bytes(8), is_extended_id=False), timeout=0)
        other.send(can.Message(arbitration_id=ALIVE_ID, data=bytes(8), is_extended_id=True), timeout=0)
        heard = []
        while (message := ours.recv(timeout=0.1)) is not None:
            heard.append((message.arbitration_id, message.is_extended_id))
    assert heard == [(ALIVE_ID, False)]


def test_a_flood_of_foreign_frames_delays_no_answer() -> None:
    with spawn_node(boot_id=3) as node, open_bus(node.bus) as stranger:
        port = CanStimulator(open_bus(node.bus), 11, in_real_time=False)
        port.open(0, timeout_s=10.0)
        for number in range(2000):
            stranger.send(can.Message(arbitration_id=0x300 + number % 64, data=bytes(8), is_extended_id=False))
        port.send(command(time.monotonic_ns()))
        status = answers(port)[0]  # held up for 60 ms, this process finds the end of the lease behind it
        assert (status.on, status.fault) == (True, "")
        port.close()


def test_an_interface_that_goes_down_is_lost_and_comes_back() -> None:
    with spawn_node(boot_id=4) as node:
        port = CanStimulator(open_bus(node.bus), 12)
        port.open(0, timeout_s=10.0)
        port.send(command(0))
        assert answers(port)
        link("set", CHANNEL, "down")
        try:
            with pytest.raises(StimulatorLost, match=r"did not take a command|cannot be read"):
                keep_sending(port)
        finally:
            link("set", CHANNEL, "up")
        port.close()
    with spawn_node(boot_id=5) as node:
        again = CanStimulator(open_bus(node.bus), 13)
        assert again.open(0, timeout_s=10.0).boot_id == 5
        again.close()


def test_a_full_transmit_queue_is_told_at_once_and_the_stimulator_goes_off_by_its_lease(
    tmp_path: Path,
) -> None:
    with spawn_node(boot_id=6, record=tmp_path / "node.jsonl") as node:
        port = CanStimulator(open_bus(node.bus), 14)
        port.open(0, timeout_s=10.0)
        port.send(command(0))
        assert answers(port)
        with full_queue(CHANNEL):
            took_ns = []
            for _ in range(5):
                begin_ns = time.monotonic_ns()
                with pytest.raises(StimulatorLost, match=os.strerror(errno.ENOBUFS)):
                    port.send(command(0))
                took_ns.append(time.monotonic_ns() - begin_ns)
            assert min(took_ns) < 50_000_000, "never waits for room; the machine may stop us now and then"
            end_s = time.monotonic() + 10.0
            while node.entries()[-1].event != "lease_expired":
                assert time.monotonic() < end_s, "it is still on"
                time.sleep(0.01)
        port.close()


def test_an_interface_that_is_not_there_is_named_with_the_remedy() -> None:
    with pytest.raises(BusError, match=r"vcan77.*ip link set"):
        open_bus(Bus(interface="socketcan", channel="vcan77"))
