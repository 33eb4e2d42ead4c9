"""A power cut, a killed process or a bad disk costs only what was not yet there."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from canopy_skel.document import RejectedView
from canopy_skel.errors import CanopyError, RecordingError
from canopy_skel.frame import View
from canopy_skel.recording import TopicOptions, read_recording, recover

many = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture(scope="module")
def whole(kit, tmp_path_factory):
    """A recording's bytes, and where the chunk of each view ends."""
    path = kit.write(tmp_path_factory.mktemp("whole") / "a.mcap")
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    return path.read_bytes(), [c.chunk_start_offset + c.chunk_length for c in chunks]


@pytest.fixture(scope="module")
def foreign(kit, tmp_path_factory):
    """The same views written by a recorder that does not care where chunks end."""
    messages = [m for view in kit.views for m in kit.messages_of(view).values()]
    path = kit.write_raw(tmp_path_factory.mktemp("foreign") / "a.mcap", messages, chunk_size=3000)
    return path.read_bytes()


@many
@given(data=st.data())
def test_a_cut_file_gives_every_view_that_was_whole(kit, whole, tmp_path, data):
    content, ends = whole
    length = data.draw(st.integers(0, len(content) - 1))
    saved = sum(end <= length for end in ends)
    path = tmp_path / "cut.mcap"
    path.write_bytes(content[:length])

    if saved == 0:
        text = f"ends before its first whole view .* of {length}\\); no view can be recovered"
        with pytest.raises(RecordingError, match=rf"cut\.mcap: {text if length else 'is empty'}"):
            read_recording(path)
        return
    recording = read_recording(path)
    found = list(recording.views())
    assert [view.index for view in found] == list(range(saved))
    for view in found:
        kit.assert_same_view(view, kit.views[view.index])
    (warning,) = recording.warnings
    assert f"of {length}: {saved} whole views were saved; `canopy recover`" in warning


@many
@given(data=st.data())
def test_a_view_cut_in_two_is_rejected_never_degraded(kit, foreign, tmp_path, data):
    length = data.draw(st.integers(0, len(foreign) - 1))
    path = tmp_path / "cut.mcap"
    path.write_bytes(foreign[:length])
    try:
        found = list(read_recording(path).views())
    except RecordingError:
        return
    usable = [one for one in found if isinstance(one, View)]
    assert [one.index for one in found] == list(range(len(found)))
    assert len(found) - len(usable) <= 1
    for view in usable if len(found) > 1 else ():  # alone, nothing says what it should have
        kit.assert_same_view(view, kit.views[view.index])


@many
@example(place=112, flipped=128)  # sizes in the head of a chunk
@example(place=117, flipped=2)
@example(place=132, flipped=128)
@given(place=st.integers(0, 1 << 40), flipped=st.integers(1, 255))
def test_a_flipped_byte_never_changes_a_view_unnoticed(kit, whole, tmp_path, place, flipped):
    content = bytearray(whole[0])
    content[place % len(content)] ^= flipped
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    try:
        recording = read_recording(path)
        found = list(recording.views())
    except CanopyError:
        return
    usable = [one for one in found if isinstance(one, View)]
    for view in usable:
        kit.assert_same_view(view, kit.views[view.index])
    assert len(usable) == len(kit.views) or recording.warnings


def test_a_cut_file_whose_cameras_have_other_names_lists_them(whole, tmp_path):
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[0][: whole[1][1]])
    zed = TopicOptions(color_image="/zed/rgb", left_image="/zed/left")
    with pytest.raises(RecordingError, match=r"topic \(it is cut off .* it has .*/camera/color/im"):
        read_recording(path, zed)


def test_a_damaged_chunk_costs_its_view_only(kit, whole, tmp_path):
    content, ends = bytearray(whole[0]), whole[1]
    content[(ends[1] + ends[2]) // 2] ^= 0x10
    (tmp_path / "bad.mcap").write_bytes(content)
    recording = read_recording(tmp_path / "bad.mcap")

    assert [view.index for view in recording.views()] == [0, 1, 3]
    assert "bad.mcap: the chunk at byte" in recording.warnings[0]
    report = recover(tmp_path / "bad.mcap", tmp_path / "good.mcap")
    assert (report.views_saved, len(report.damage), report.bytes_lost) == (3, 1, 0)
    assert read_recording(tmp_path / "good.mcap").warnings == ()


def test_a_damaged_attachment_is_not_handed_out(whole, tmp_path):
    content = bytearray(whole[0])
    place = content.index(b"application/json") + len(b"application/json") + 8
    assert content[place : place + 2] == b"{}"
    content[place] ^= 1
    (tmp_path / "bad.mcap").write_bytes(content)
    recording = read_recording(tmp_path / "bad.mcap")
    assert recording.ground_truth is None
    assert "the attachment at byte" in recording.warnings[0]


def test_recover_makes_a_whole_file_of_a_cut_one(kit, whole, tmp_path):
    content, ends = whole
    part = tmp_path / "scan.mcap.part"
    part.write_bytes(content[: ends[2] + 40])
    report = recover(part, tmp_path / "scan.mcap")

    assert (report.views_saved, report.views_incomplete, report.damage) == (3, (), ())
    assert part.read_bytes() == content[: ends[2] + 40]
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["scan.mcap", "scan.mcap.part"]
    recovered = read_recording(tmp_path / "scan.mcap")
    assert (recovered.warnings, recovered.scan_id) == ((), "scan-7")
    for view, written in zip(recovered.views(), kit.views, strict=False):
        kit.assert_same_view(view, written)
    with (tmp_path / "scan.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages()) == report.messages


def test_recover_tells_readers_which_view_is_not_whole(foreign, tmp_path):
    cut = tmp_path / "cut.mcap"
    for length in range(len(foreign) // 2, len(foreign), 997):
        cut.write_bytes(foreign[:length])
        before = list(read_recording(cut).views())
        if isinstance(before[-1], RejectedView):
            break
    report = recover(cut, tmp_path / "good.mcap")
    after = read_recording(tmp_path / "good.mcap")

    assert report.views_incomplete == (before[-1].index,)
    assert after.warnings == ()
    rejected = list(after.views())[-1]
    assert isinstance(rejected, RejectedView)
    assert "lost in part, without" in rejected.reason


def test_a_file_without_chunks_is_read_cut_and_recovered(kit, tmp_path):
    messages = [m for view in kit.views for m in kit.messages_of(view).values()]
    path = kit.write_raw(tmp_path / "a.mcap", messages, use_chunking=False)
    for view, written in zip(read_recording(path).views(), kit.views, strict=True):
        kit.assert_same_view(view, written)

    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    report = recover(tmp_path / "cut.mcap", tmp_path / "good.mcap")
    saved = [v for v in read_recording(tmp_path / "good.mcap").views() if isinstance(v, View)]
    assert report.views_saved == len(saved) == 2
    for view, written in zip(saved, kit.views, strict=False):
        kit.assert_same_view(view, written)


def test_recover_never_writes_over_a_file(whole, tmp_path):
    source = tmp_path / "a.mcap"
    source.write_bytes(whole[0][: whole[1][1]])
    with pytest.raises(RecordingError, match=r"a\.mcap: is there already"):
        recover(source, source)
    assert source.read_bytes() == whole[0][: whole[1][1]]


def test_recover_of_nothing_says_so(whole, tmp_path):
    (tmp_path / "a.mcap").write_bytes(whole[0][:60])
    with pytest.raises(RecordingError, match="not one whole message is left"):
        recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert not list(tmp_path.glob("b.*"))


KILLED = """
import os, signal, sys
from canopy_skel.recording import RecordingWriter, read_recording
views = read_recording(sys.argv[1]).views()
with RecordingWriter(sys.argv[2], {"scan_id": "killed"}) as writer:
    writer.write_view(next(views))
    writer.write_view(next(views))
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_recorder_keeps_what_it_wrote(whole, tmp_path):
    (tmp_path / "a.mcap").write_bytes(whole[0])
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, tmp_path / "a.mcap", tmp_path / "b.mcap"],
        cwd=Path(__file__).parents[3],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
        check=False,
    )
    assert killed.returncode == -signal.SIGKILL
    recording = read_recording(tmp_path / "b.mcap.part")
    assert [view.index for view in recording.views()] == [0, 1]
    assert recording.scan_id == "killed"
