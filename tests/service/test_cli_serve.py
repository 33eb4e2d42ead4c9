"""What `canopy serve` refuses before anything is started."""

import errno
import os
import socket

import pytest
from live_rig import options_for

from canopy_skel.errors import UsageError
from service.catalogue import Catalogue
from service.compose import composed
from service.server import listening


@pytest.fixture
def nothing_is_started(monkeypatch):
    def started(*arguments):
        raise AssertionError("the rig was started")

    monkeypatch.setattr("service.compose.composed", started)
    monkeypatch.setattr("service.cli.serve.compile_kernels", started)


@pytest.mark.usefixtures("nothing_is_started")
def test_a_port_that_is_taken_is_refused_before_anything_is_started(canopy, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        code, stdout, stderr = canopy("serve", "--sim", "--data", tmp_path, "--port", port)
    assert (code, stdout) == (2, "")
    assert stderr == (
        f"error: cannot listen at 127.0.0.1, port {port}: it is taken; end what listens there,"
        " or choose another --host or --port\n"
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("nothing_is_started")
@pytest.mark.parametrize(
    ("host", "why"),
    [("192.0.2.1", os.strerror(errno.EADDRNOTAVAIL)), ("no such host", "")],
)
def test_an_address_of_another_machine_is_refused(canopy, tmp_path, host, why):
    (tmp_path / "key").write_text("0123456789abcdef")
    where = ("--port", 0, "--host", host, "--key-file", tmp_path / "key")
    code, _, stderr = canopy("serve", "--sim", "--data", tmp_path, *where)
    assert code == 2
    assert stderr.startswith(f"error: cannot listen at {host}, port 0: {why}")
    assert len(stderr.splitlines()) == 1


def test_a_folder_that_is_in_use_is_refused_before_arm_and_camera_are_touched(tmp_path):
    def touched(options):
        raise AssertionError("the hardware was touched")

    busy = pytest.raises(UsageError, match="another canopy service uses this folder")
    with Catalogue(tmp_path), busy, composed(options_for(tmp_path), touched):
        pass


def test_a_port_that_was_just_used_may_be_used_again():
    with listening("127.0.0.1", 0) as bound:
        address = bound.getsockname()
        with socket.create_connection(address) as caller:
            accepted, _ = bound.accept()
            accepted.close()  # first, so that it is left in TIME_WAIT
            assert caller.recv(1) == b""
    listening(*address).close()


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ((), "give either --sim or --robot FILE"),
        (("--sim", "--robot", "rig.toml"), "give either --sim or --robot FILE"),
        (("--robot", "no-such-rig.toml"), "no rig file no-such-rig.toml"),
        (("--sim", "--host", "0.0.0.0"), "lets others reach the arm: give --key-file FILE"),
        (("--sim", "--host", "::"), "lets others reach the arm: give --key-file FILE"),
        (("--sim", "--key-file", "no-such-key"), "no key file no-such-key"),
        (("--sim", "--name", "rig-3:8000"), "--name rig-3:8000: give the host's name alone"),
        (("--sim", "--port", "99999"), "less than or equal to 65535"),
        (("--sim", "--time-scale", "0"), "greater than or equal to 0.01"),
    ],
)
def test_what_cannot_be_served_is_refused_before_anything_starts(arguments, why, canopy, tmp_path):
    code, _, stderr = canopy("serve", "--data", tmp_path / "data", *arguments)
    assert code == 2
    assert why in " ".join(stderr.replace("│", " ").split())
    assert not (tmp_path / "data").exists()
