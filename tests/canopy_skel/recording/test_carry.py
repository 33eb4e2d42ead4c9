"""A new recording goes on from an unfinished one: nothing in it changes, nothing half is taken."""

import struct

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader

from canopy_skel.errors import RecordingError
from canopy_skel.recording import RecordingWriter, carry_over, read_recording, recover


def content(path, *, journal):
    """Return topic, sequence, time and bytes of every message, in the order of the file."""
    with path.open("rb") as stream:
        return [
            (channel.topic, message.sequence, message.log_time, message.data)
            for _, channel, message in make_reader(stream).iter_messages(log_time_order=False)
            if (channel.topic == "/scan/event") == journal
        ]


@pytest.fixture
def scanned(kit, tmp_path):
    """A recording of views 0, 1, 2 with a journal."""
    path = tmp_path / "whole.mcap"
    with RecordingWriter(path, {}, tool_from_camera=kit.tool_from_camera) as writer:
        writer.write_event(5, {"kind": "start"})
        for view in kit.views[:3]:
            writer.write_view(view, kit.as_png(view))
            writer.write_event(view.stamp_ns + 1, {"kind": "captured", "index": view.index})
    return path


def carried(source, target):
    with RecordingWriter(target, {"scan_id": "again"}) as writer:
        indices = carry_over(source, writer)
    return indices


def test_whole_views_and_journal_keep_every_byte(kit, scanned, tmp_path):
    before = scanned.read_bytes()
    assert carried(scanned, tmp_path / "new.mcap") == (0, 1, 2)
    assert scanned.read_bytes() == before
    for journal in (True, False):
        assert content(tmp_path / "new.mcap", journal=journal) == content(scanned, journal=journal)
    for view, written in zip(
        read_recording(tmp_path / "new.mcap").views(), kit.views, strict=False
    ):
        kit.assert_same_view(view, written)


def test_a_view_lost_in_its_chunk_is_not_carried_but_its_journal_is(scanned, tmp_path):
    with scanned.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    last_view = max(chunks[-4:], key=lambda chunk: chunk.chunk_length)
    part = tmp_path / "cut.mcap.part"
    part.write_bytes(scanned.read_bytes()[: last_view.chunk_start_offset + 200])

    assert carried(part, tmp_path / "new.mcap") == (0, 1)
    views = content(scanned, journal=False)
    assert content(tmp_path / "new.mcap", journal=False) == [row for row in views if row[1] < 2]
    events = content(scanned, journal=True)
    assert content(tmp_path / "new.mcap", journal=True) == events[:3]


def chunks_of(content):
    """Return start and end of every chunk, also of a file without an end."""
    found, offset = [], 8
    while offset + 9 <= len(content):
        opcode, length = struct.unpack_from("<BQ", content, offset)
        if opcode == Opcode.CHUNK:
            found.append((offset, offset + 9 + length))
        offset += 9 + length
    return found


def damage(path, whole, place):
    """Write a recording with one byte changed."""
    damaged = bytearray(whole)
    damaged[place] ^= 0xFF
    path.write_bytes(damaged)
    return path


@pytest.fixture
def unfinished(kit, tmp_path):
    """What is on disk in the middle of a scan: views 0, 1, 2 and the journal around them."""
    path = tmp_path / "unfinished.mcap"
    with RecordingWriter(path, {}, tool_from_camera=kit.tool_from_camera) as writer:
        writer.write_event(5, {"kind": "running"})
        for view in kit.views[:3]:
            writer.write_view(view, kit.as_png(view))
            writer.write_event(view.stamp_ns + 1, {"kind": "view", "index": view.index})
        return path.with_name(path.name + ".part").read_bytes()


@pytest.mark.parametrize("damaged", range(7))  # entry, view 0, entry, view 1, ...
def test_a_damaged_chunk_costs_what_is_in_it_and_nothing_else(kit, unfinished, tmp_path, damaged):
    chunks = chunks_of(unfinished)
    assert len(chunks) == 7
    part = damage(tmp_path / "bad.mcap.part", unfinished, sum(chunks[damaged]) // 2)
    left = [index for index in range(3) if damaged != 2 * index + 1]
    found = list(read_recording(part).views())
    assert [view.index for view in found] == left
    for view in found:
        kit.assert_same_view(view, kit.views[view.index])
    assert recover(part, tmp_path / "good.mcap").views_saved == len(left)
    assert carried(part, tmp_path / "new.mcap") == tuple(left)
    assert len(content(tmp_path / "new.mcap", journal=True)) == 4 - (damaged % 2 == 0)


def test_messages_of_which_nobody_knows_what_they_are_are_not_left_behind(kit, tmp_path):
    """Before the journal repeated the channels, damage in the first view could take them all."""
    messages = [m for view in kit.views[:3] for m in kit.messages_of(view).values()]
    path = kit.write_raw(tmp_path / "old.mcap", messages, chunk_size=3000, repeat_channels=False)
    whole = path.read_bytes()
    damage(path, whole, sum(chunks_of(whole)[0]) // 2)
    with pytest.raises(RecordingError, match=r"old\.mcap: is damaged where it says what \d+ of"):
        carried(path, tmp_path / "new.mcap")


def test_a_half_written_view_is_not_carried(kit, tmp_path):
    """Other recorders end their chunks anywhere: a part of the last view is there."""
    messages = [m for view in kit.views[:3] for m in kit.messages_of(view).values()]
    half = [*messages[:-5]]
    assert {m.sequence for m in half} == {0, 1, 2}
    path = kit.write_raw(tmp_path / "cut.mcap", half, use_chunking=False)
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(half[-1].data) + len(half[-1].data)])

    assert carried(path, tmp_path / "new.mcap") == (0, 1)
    rows = content(tmp_path / "new.mcap", journal=False)
    whole = [(m.topic, m.sequence, m.stamp_ns, m.data) for m in messages if m.sequence < 2]
    assert rows == whole


def test_an_index_that_was_carried_cannot_be_written_again(kit, scanned, tmp_path):
    with RecordingWriter(tmp_path / "new.mcap", {}) as writer:
        carry_over(scanned, writer)
        writer.write_view(kit.views[3], kit.as_png(kit.views[3]))
    assert [v.index for v in read_recording(tmp_path / "new.mcap").views()] == [0, 1, 2, 3]


def test_only_a_journal_is_carried_from_a_scan_without_a_view(tmp_path):
    with RecordingWriter(tmp_path / "old.mcap", {}) as writer:
        writer.write_event(5, {"kind": "start"})
    assert carried(tmp_path / "old.mcap", tmp_path / "new.mcap") == ()
    (event,) = content(tmp_path / "new.mcap", journal=True)
    assert event == ("/scan/event", 0, 5, b'{"kind":"start"}')


def test_what_is_no_recording_is_refused(tmp_path):
    (tmp_path / "old.mcap").write_text("no recording")
    with pytest.raises(RecordingError, match=r"old\.mcap: is not an MCAP file"):
        carried(tmp_path / "old.mcap", tmp_path / "new.mcap")
