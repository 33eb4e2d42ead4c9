import json
import os
import struct
import threading
import time

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from scenes.bus import free_port, listening_addresses, wait_for

from canopy_skel.errors import UsageError
from canopy_skel.likelihood import LikelihoodConfig
from canopy_skel.messages import TOPICS, Message
from canopy_skel.pipeline import METHODS, MethodConfig
from service.bus import BusError, Keys, open_session, scan_id_of
from service.envelope import MAGIC, ViewEnvelope, decode_envelope, encode_envelope
from service.heartbeat import Heartbeat, Version, decode_heartbeat, decode_version

KEYS = Keys(site="orchard", rig="arm-1")


@st.composite
def envelopes(draw):
    view = draw(st.integers(0, 2**32 - 1))
    message = st.builds(
        Message,
        topic=st.sampled_from(sorted(TOPICS)),
        stamp_ns=st.integers(0, 2**63 - 1),
        sequence=st.just(view),
        data=st.binary(max_size=200),
    )
    config = MethodConfig(
        name=draw(st.sampled_from(METHODS)),
        likelihood=LikelihoodConfig(voxel_size_m=draw(st.floats(1e-3, 0.1))),
        straighten_steps=draw(st.integers(0, 50)),
    )
    return ViewEnvelope(
        scan_id=draw(st.text(min_size=1, max_size=20)),
        view=view,
        config=config,
        segmenter=draw(st.sampled_from(["recorded", "unet"])),
        messages=tuple(draw(st.lists(message, max_size=6))),
    )


EXAMPLE = ViewEnvelope(
    scan_id="scan-1",
    view=3,
    config=MethodConfig(),
    segmenter="recorded",
    messages=tuple(
        Message(topic=topic, stamp_ns=7, sequence=3, data=topic.encode()) for topic in TOPICS
    ),
)


def with_header(**changes):
    """The example's bytes with other fields in the header; None takes a field out."""
    data = encode_envelope(EXAMPLE)
    start = len(MAGIC) + 4
    (size,) = struct.unpack("<I", data[len(MAGIC) : start])
    header = json.loads(data[start : start + size]) | changes
    text = json.dumps({name: value for name, value in header.items() if value is not None}).encode()
    return MAGIC + struct.pack("<I", len(text)) + text + data[start + size :]


@given(envelopes())
def test_an_envelope_comes_back_as_it_was(envelope):
    data = encode_envelope(envelope)
    assert decode_envelope(data) == envelope
    assert encode_envelope(decode_envelope(data)) == data


@given(envelopes(), st.data())
def test_a_cut_envelope_is_refused_wherever_it_was_cut(envelope, data):
    encoded = encode_envelope(envelope)
    with pytest.raises(BusError, match="view envelope: "):
        decode_envelope(encoded[: data.draw(st.integers(0, len(encoded) - 1))])


@given(st.binary(max_size=300))
def test_no_bytes_do_worse_than_a_bus_error(data):
    for candidate in (data, MAGIC + data, MAGIC + struct.pack("<I", len(data)) + data):
        with pytest.raises(BusError):
            decode_envelope(candidate)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"canopy-view/2\nxxxx", "of another version"),
        (b"hello", "not a view envelope"),
        (encode_envelope(EXAMPLE) + b"x", "1 bytes too many"),
        (with_header(scan_id=None), "no 'scan_id'"),
        (with_header(scan_id=5), "5 is not str"),
        (with_header(view="3"), "'3' is not int"),
        (with_header(view=4), "not all its messages are of view 4"),
        (with_header(method={"name": "paper"}), "no 'cluster'"),
        (with_header(config_sha256="0" * 64), "do not match their hash"),
        (with_header(messages=[["/tf", 7, 3, -1]]), "cut off, /tf"),
        (with_header(messages=5), "its header is wrong"),
    ],
)
def test_a_wrong_envelope_says_what_is_wrong(data, says):
    with pytest.raises(BusError, match=r"^view envelope: ") as refused:
        decode_envelope(data)
    assert says in str(refused.value)


@given(
    st.builds(
        Heartbeat,
        id=st.text(),
        pid=st.integers(0),
        views=st.lists(st.integers(0)).map(tuple),
        rejected=st.lists(st.integers(0)).map(tuple),
        busy=st.booleans(),
    )
)
def test_a_heartbeat_comes_back_as_it_was(heartbeat):
    assert decode_heartbeat(heartbeat.encode()) == heartbeat


def test_what_is_no_heartbeat_or_version_is_a_bus_error():
    assert decode_version(Version(revision=3, rejected=1).encode()) == Version(
        revision=3, rejected=1
    )
    for data in (b"", b"[]", b"{}", b'{"views": 3}', b"\xff"):
        with pytest.raises(BusError):
            decode_heartbeat(data)
        with pytest.raises(BusError):
            decode_version(data)


def test_the_keys_are_those_of_the_contract():
    root = "canopy/v1/orchard/arm-1"
    assert [KEYS.view("s"), KEYS.pose("s"), KEYS.event("s"), KEYS.skeleton("s")] == [
        f"{root}/scan/s/{name}" for name in ("view", "pose", "event", "skeleton")
    ]
    assert KEYS.worker("w") == f"{root}/worker/w"
    assert zenoh.KeyExpr(KEYS.views).includes(KEYS.view("s"))
    assert zenoh.KeyExpr(KEYS.skeletons).includes(KEYS.skeleton("s"))
    assert zenoh.KeyExpr(KEYS.workers).includes(KEYS.worker("w"))
    assert scan_id_of(KEYS.view("s")) == "s"


@pytest.mark.parametrize("name", ["", "a/b", "*", "$x", "a b", "a#", "why?", "line\n"])
def test_a_name_that_cannot_be_in_a_key_is_refused(name):
    for make in (KEYS.view, KEYS.worker, lambda name: Keys(site=name, rig="r")):
        with pytest.raises(UsageError, match="cannot be part of a bus key"):
            make(name)


@pytest.mark.parametrize(
    "endpoint", ["tcp/0.0.0.0:7447", "tcp/10.0.0.1:7447", "udp/127.0.0.1:7447", "tcp/[::]:0", ""]
)
def test_only_the_loopback_is_listened_on(endpoint):
    for side in ("listen", "connect"):
        with (
            pytest.raises(UsageError, match="is not on the loopback"),
            open_session(**{side: endpoint}),
        ):
            pass


def test_a_taken_port_is_named():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with (
        open_session(listen=endpoint),
        pytest.raises(BusError, match=f"{endpoint}: the bus cannot be opened"),
        open_session(listen=endpoint),
    ):
        pass


def test_a_sample_passes_whoever_is_there_first():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    data = encode_envelope(EXAMPLE)
    came = []
    with open_session(connect=endpoint) as late, open_session(listen=endpoint) as early:
        subscriber = late.declare_subscriber(KEYS.views, came.append)
        publisher = early.declare_publisher(KEYS.view("scan-1"))
        wait_for(lambda: publisher.matching_status.matching, 5)
        publisher.put(data)
        (sample,) = wait_for(lambda: came, 5)
        assert sample.payload.to_bytes() == data
        assert {address for address, _ in listening_addresses(os.getpid())} <= {"127.0.0.1"}
        subscriber.undeclare()


def test_closing_never_waits_for_a_session_that_does_not_close(monkeypatch):
    release = threading.Event()
    monkeypatch.setattr("service.bus._close", lambda session: release.wait(20))
    start = time.monotonic()
    with open_session(listen=f"tcp/127.0.0.1:{free_port()}") as session:
        pass
    assert time.monotonic() - start < 2
    release.set()
    session.close()
