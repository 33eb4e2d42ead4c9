"""The wire itself: a second RTDE client, faults, start and end of the process."""

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time

import numpy as np
import pytest

from mock_hw.fake_ur.process import FakeUr, free_host

FORMATS = {"DOUBLE": "d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I", "UINT64": "Q"}


class RtdeReader:
    """An RTDE client of protocol versions 1 and 2 that shares no code with the vendor's."""

    def __init__(self, host, version=2):
        self.version = version
        self._link = socket.create_connection((host, 30004), timeout=5.0)
        self._buffer = b""

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self._link.close()

    def ask(self, kind, payload=b""):
        self._link.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)
        answered, reply = self.package()
        while answered != kind:
            answered, reply = self.package()
        return reply

    def package(self):
        while (
            len(self._buffer) < 3 or len(self._buffer) < struct.unpack_from(">H", self._buffer)[0]
        ):
            chunk = self._link.recv(4096)
            if not chunk:
                raise ConnectionError("closed by the controller")
            self._buffer += chunk
        (size,) = struct.unpack_from(">H", self._buffer)
        package, self._buffer = self._buffer[:size], self._buffer[size:]
        return chr(package[2]), package[3:]

    def subscribe(self, names, frequency_hz=500.0):
        if self.version == 2:
            assert self.ask("V", struct.pack(">H", 2)) == b"\x01"
        head = struct.pack(">d", frequency_hz) if self.version == 2 else b""
        reply = self.ask("O", head + ",".join(names).encode())
        types = (reply[1:] if self.version == 2 else reply).decode().split(",")
        self._layout = ">" + "".join(FORMATS[kind] for kind in types)
        assert self.ask("S") == b"\x01"
        return types

    def values(self):
        kind, payload = self.package()
        while kind != "U":
            kind, payload = self.package()
        return struct.unpack(self._layout, payload[1:] if self.version == 2 else payload)


def readings(reader, count):
    return np.array([reader.values() for _ in range(count)])


@pytest.mark.parametrize("protocol", [1, 2])
def test_both_protocol_versions_stream_the_same_values(fake, protocol):
    with RtdeReader(fake.host, protocol) as reader:
        types = reader.subscribe(["timestamp", "actual_q", "robot_mode", "safety_status_bits"])
        assert types == ["DOUBLE", "VECTOR6D", "INT32", "UINT32"]
        values = readings(reader, 5)
    assert values[0, 1:7] == pytest.approx(fake.do("state")["joints_rad"])
    assert (values[:, 7:] == [7, 1]).all()


def test_stamps_keep_the_rate_of_the_generation(fake, version):
    period_s = 0.008 if version == "3.15" else 0.002
    with RtdeReader(fake.host) as reader:
        reader.subscribe(["timestamp"], 500.0)
        readings(reader, 5)
        start_s = time.perf_counter()
        stamps = readings(reader, 100)[:, 0]
        took_s = time.perf_counter() - start_s
    steps = np.diff(stamps) / period_s
    assert steps == pytest.approx(np.round(steps), abs=1e-6)
    assert np.median(steps) == pytest.approx(1.0)
    assert took_s == pytest.approx(stamps[-1] - stamps[0], abs=0.15)


def test_a_slower_stream_is_thinned(fake):
    with RtdeReader(fake.host) as reader:
        reader.subscribe(["timestamp"], 25.0)
        stamps = readings(reader, 8)[:, 0]
    assert np.median(np.diff(stamps)) == pytest.approx(0.04, abs=0.008)


def test_an_input_belongs_to_one_connection_until_that_is_closed(fake):
    with RtdeReader(fake.host) as other:
        with RtdeReader(fake.host) as reader:
            assert reader.ask("I", b"input_int_register_24") == b"\x01INT32"
            both = b"input_int_register_24,input_double_register_24,"
            assert reader.ask("I", both) == b"\x02INT32,DOUBLE"
            wanted = b"input_int_register_24,input_int_register_25"
            assert other.ask("I", wanted) == b"\x00IN_USE,INT32"
            assert other.ask("I", b"input_int_register_25") == b"\x01INT32"
        until = time.perf_counter() + 2.0
        while (answer := other.ask("I", wanted)) == b"\x00IN_USE,INT32":
            assert time.perf_counter() < until
        assert answer == b"\x02INT32,INT32"


def test_a_missing_variable_is_named_not_found(fake):
    with RtdeReader(fake.host, version=1) as reader:
        reply = reader.ask("O", b"timestamp,nonsense")
        assert reply == b"DOUBLE,NOT_FOUND"
        assert reader.ask("S") == b"\x00"


def test_a_frozen_controller_keeps_connections_and_says_nothing(fake):
    with RtdeReader(fake.host) as reader:
        reader.subscribe(["timestamp"])
        readings(reader, 3)
        fake.do("freeze")
        reader._link.settimeout(0.2)
        with pytest.raises(TimeoutError):
            readings(reader, 1000)
        with (
            socket.create_connection((fake.host, 29999), timeout=0.2) as dashboard,
            pytest.raises(TimeoutError),
        ):
            dashboard.recv(1)
        fake.do("thaw")
        readings(reader, 3)


def test_a_cut_link_resets_everybody_until_mended(fake):
    with RtdeReader(fake.host) as reader:
        reader.subscribe(["timestamp"])
        fake.do("cut_link")
        with pytest.raises(ConnectionError):
            readings(reader, 1000)
    with pytest.raises(ConnectionError), RtdeReader(fake.host) as reader:
        reader.subscribe(["timestamp"])
    fake.do("reset")
    with RtdeReader(fake.host) as reader:
        reader.subscribe(["timestamp"])
        readings(reader, 3)


def test_slow_packages_come_with_gaps(fake):
    with RtdeReader(fake.host) as reader:
        reader.subscribe(["timestamp"])
        fake.do("slow_packets", period_s=0.1)
        while np.diff(readings(reader, 2)[:, 0]) < 0.05:
            pass  # sent before
        assert np.diff(readings(reader, 4)[:, 0]) == pytest.approx([0.1] * 3, abs=0.02)


def test_the_fault_port_says_what_it_can_do(fake):
    with pytest.raises(RuntimeError, match="protective_stop"):
        fake.do("make_coffee")
    with socket.create_connection((fake.host, fake._fault_port), timeout=2) as link:
        link.sendall(b"not json\n")
        assert json.loads(link.makefile().readline())["ok"] is False


def test_the_dashboard_answers_unknown_lines(fake, version):
    with socket.create_connection((fake.host, 29999), timeout=2) as link, link.makefile() as lines:
        assert lines.readline().startswith("Connected")
        for line, answer in (
            ("robotmode", "Robotmode: RUNNING"),
            ("is in remote control", "true" if version == "5.15" else None),
            ("dance", "could not understand: 'dance'"),
            ("quit", "Disconnected"),
        ):
            link.sendall(line.encode() + b"\n")
            assert lines.readline().strip() == (answer or f"could not understand: '{line}'")
        assert lines.readline() == ""


def test_it_ends_cleanly_and_leaves_its_ports():
    host = free_host()
    for _ in range(2):
        with FakeUr(host) as fake, RtdeReader(host) as reader:
            reader.subscribe(["timestamp"])
            os.kill(fake._child.pid, signal.SIGTERM)
            assert fake._child.exit_code(2) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--version", "4.2"], "'4.2' is not a version"),
        (["--time-scale", "0"], "--time-scale must be above 0"),
        (["--host", "192.0.2.1"], "choose another --host"),
    ],
)
def test_a_bad_start_says_why(arguments, message):
    ended = subprocess.run(
        [sys.executable, "-m", "mock_hw.fake_ur", *arguments], capture_output=True, text=True
    )
    assert ended.returncode != 0
    assert message in ended.stderr
