import csv
import json
import os
import select
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import dask
import numpy as np
import pytest
from distributed import LocalCluster
from scenes.wood import view_from

from canopy_skel.recording import RecordingWriter

SKELETON = "tree.skeleton.json"
NAMES = ["row1/tree.mcap", "row2/tree.mcap", "row2/west/tree.mcap"]


def record(path, *views):
    path.unlink(missing_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    with RecordingWriter(path, {"scan_id": path.stem}, tool_from_camera=np.eye(4)) as writer:
        for view in views:
            writer.write_view(view)


@pytest.fixture(scope="module")
def grown(tmp_path_factory):
    """Three recordings of one name in different folders."""
    folder = tmp_path_factory.mktemp("grown")
    for number, name in enumerate(NAMES):
        record(folder / name, view_from(0, seed=number), view_from(1, y=0.1, seed=number))
    return folder


@pytest.fixture
def orchard(grown, tmp_path):
    return shutil.copytree(grown, tmp_path / "orchard")


@pytest.fixture(scope="module")
def cluster():
    allowed = {"distributed.scheduler.allowed-failures": 0}
    with (
        dask.config.set(allowed),
        LocalCluster(
            n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
        ) as cluster,
    ):
        yield cluster.scheduler_address


def table(out):
    with (out / "batch.csv").open() as stream:
        return {row["recording"]: row for row in csv.DictReader(stream)}


def statuses(out):
    return {name: row["status"] for name, row in table(out).items()}


def written(out):
    """What a batch has written, and when."""
    files = (path for path in out.rglob("tree.*") if path.is_file())
    return {path.relative_to(out): (path.read_bytes(), path.stat().st_mtime_ns) for path in files}


def made_again(before, out):
    after = written(out)
    return {path.parent.as_posix() for path in after if after[path] != before.get(path)}


def assert_as_replayed(canopy, orchard, out, tmp_path):
    for name in NAMES:
        alone = tmp_path / "alone" / name
        canopy("replay", orchard / name, "-o", alone)
        for file in (SKELETON, "tree.skeleton.glb", "tree.overlay.png"):
            assert (out / name).with_name(file).read_bytes() == (alone / file).read_bytes()


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_folder_becomes_what_replay_makes_of_each_recording(canopy, orchard, tmp_path, jobs):
    (orchard / "row1" / "._tree.mcap").write_bytes(b"what another system keeps beside a file")
    out = tmp_path / "out"
    code, stdout, stderr = canopy("batch", orchard, "-o", out, "--jobs", jobs, "--json")
    assert code == 0
    result = json.loads(stdout)
    assert [result[status] for status in ("ok", "partial", "failed")] == [3, 0, 0]
    assert [row["recording"] for row in result["recordings"]] == NAMES
    assert list(table(out)) == NAMES
    summary = json.loads((out / "row1/tree.summary.json").read_text())
    row = table(out)["row1/tree.mcap"]
    assert float(row["length_m"]) == summary["skeleton"]["length_m"]
    assert (int(row["branches"]), row["views_used"]) == (summary["skeleton"]["branches"], "2")
    assert float(row["seconds"]) > 0
    assert "3/3 " in stderr
    assert_as_replayed(canopy, orchard, out, tmp_path)


def test_what_is_done_is_left_alone_and_what_changed_is_done_again(canopy, orchard, tmp_path):
    out = tmp_path / "out"
    arguments = ("batch", orchard, "-o", out, "--method", "paper", "--jobs", 1)
    assert canopy(*arguments)[0] == 0
    before = written(out)
    code, stdout, stderr = canopy(*arguments, "--json")
    assert (code, json.loads(stdout)["ok"]) == (0, 3)
    assert "3 of 3 recordings are done already" in stderr
    assert made_again(before, out) == set()

    os.utime(orchard / NAMES[0], ns=(1, 1))
    record(orchard / NAMES[1], view_from(0, seed=9))
    (out / "row2/west" / SKELETON).unlink()
    canopy(*arguments)
    assert made_again(before, out) == {"row2", "row2/west"}
    assert table(out)[NAMES[1]]["views_used"] == "1"

    before = written(out)
    store = out / "batch.jsonl"
    store.write_bytes(store.read_bytes()[:-40])  # Killed while the last row was written.
    assert canopy(*arguments)[0] == 0
    assert len(made_again(before, out)) == 1

    before = written(out)
    canopy(*arguments, "--voxel", "0.006")
    assert made_again(before, out) == {"row1", "row2", "row2/west"}
    before = written(out)
    canopy(*arguments)  # The files are not those of these settings any more.
    assert made_again(before, out) == {"row1", "row2", "row2/west"}


def test_a_broken_recording_costs_no_other_and_is_tried_again(canopy, orchard, tmp_path):
    out, good = tmp_path / "out", (orchard / NAMES[1]).read_bytes()
    (orchard / NAMES[1]).write_bytes(b"no recording at all")
    record(orchard / NAMES[2], view_from(0), view_from(1, scores=(0.9,)))
    arguments = ("batch", orchard, "-o", out, "--method", "paper", "--jobs", 1)
    code, stdout, stderr = canopy(*arguments)
    assert code == 3
    assert stdout == f"1 ok, 1 partial, 1 failed\n{out / 'batch.csv'}\n"
    assert "row2/tree.mcap: is not an MCAP file" in stderr
    assert statuses(out) == dict(zip(NAMES, ("ok", "failed", "partial"), strict=True))
    rows = table(out)
    assert "is not an MCAP file" in rows[NAMES[1]]["error"]
    assert rows[NAMES[1]]["branches"] == ""
    assert "view 1 left out: " in rows[NAMES[2]]["warnings"]

    (orchard / NAMES[1]).write_bytes(good)
    before = written(out)
    assert canopy(*arguments)[0] == 3
    assert made_again(before, out) == {"row2"}
    assert statuses(out)[NAMES[1]] == "ok"


def test_a_batch_of_which_all_failed_has_failed(canopy, tmp_path):
    (tmp_path / "none.mcap").write_bytes(b"")
    code, _, _ = canopy("batch", tmp_path / "none.mcap", "-o", tmp_path / "out", "--jobs", 1)
    assert code == 1


class Blocked:
    """A recording that whoever reads it waits for: a pipe that nothing comes out of."""

    def __init__(self, path):
        path.unlink(missing_ok=True)
        os.mkfifo(path)
        self.path = path

    @contextmanager
    def read(self):
        """Wait until some process reads it; in the end, until none does."""
        end = os.open(self.path, os.O_WRONLY)
        try:
            yield
            gone = select.poll()
            gone.register(end, select.POLLERR)
            gone.poll()
        finally:
            os.close(end)


@contextmanager
def running(*arguments):
    """A batch in a process of its own, of two jobs."""
    command = (Path(sys.executable).with_name("canopy"), "batch", "--method", "paper", "--jobs", 2)
    with subprocess.Popen(
        [*map(str, command), *map(str, arguments)],
        stderr=subprocess.PIPE,
        text=True,
        # Tests that run in the background have it ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        yield process


def readers_of(path):
    """The processes that have a file open for reading."""
    for fd in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            flags = (fd.parents[1] / "fdinfo" / fd.name).read_text().split("flags:")[1].split()[0]
            if fd.readlink() == path and int(flags, 8) & os.O_ACCMODE == os.O_RDONLY:
                yield int(fd.parts[2])
        except OSError:
            continue


def test_a_process_that_is_killed_costs_its_recording_alone(canopy, orchard, tmp_path):
    out, blocked = tmp_path / "out", Blocked(orchard / NAMES[0])
    with running(orchard, "-o", out) as process:
        with blocked.read():
            (worker,) = readers_of(blocked.path)
            os.kill(worker, signal.SIGKILL)
        assert process.wait() == 3
    assert statuses(out) == dict(zip(NAMES, ("failed", "ok", "ok"), strict=True))
    error = table(out)[NAMES[0]]["error"]
    assert "row1/tree.mcap: the process that replayed it was killed (signal 9)" in error
    assert "run again with fewer --jobs" in error


@pytest.mark.parametrize(("how", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_a_batch_can_be_stopped_at_any_moment_and_gone_on_with(
    canopy, orchard, grown, tmp_path, how, code
):
    out, blocked = tmp_path / "out", Blocked(orchard / NAMES[2])
    (out / "row2/west").mkdir(parents=True)
    half = out / "row2/west" / f".{SKELETON}.part"
    half.write_bytes(b"half of a document")
    with running(orchard, "-o", out) as process:
        with blocked.read():
            for line in process.stderr:
                if line.startswith("2/3 "):
                    break
            process.send_signal(how)
        assert process.wait() == code
    assert half.exists() == (how == signal.SIGKILL)
    before = written(out)
    assert {path.parent.as_posix() for path in before} - {"row2/west"} == {"row1", "row2"}
    if how == signal.SIGINT:
        assert set(statuses(out)) == set(NAMES[:2])
    blocked.path.unlink()
    shutil.copy2(grown / NAMES[2], blocked.path)
    assert canopy("batch", orchard, "-o", out, "--method", "paper", "--jobs", 1)[0] == 0
    assert made_again(before, out) == {"row2/west"}
    assert not half.exists()
    assert set(statuses(out).values()) == {"ok"}


def test_two_batches_do_not_share_a_folder(canopy, orchard, tmp_path):
    out, blocked = tmp_path / "out", Blocked(orchard / NAMES[0])
    with running(orchard, "-o", out) as process, blocked.read():
        code, _, stderr = canopy("batch", orchard, "-o", out)
        assert code == 2
        assert "batch.jsonl: another canopy writes there" in stderr
        process.send_signal(signal.SIGINT)


def test_results_that_would_overwrite_each_other_are_refused_before_any_work(
    canopy, orchard, tmp_path
):
    out = tmp_path / "out"
    code, _, stderr = canopy("batch", orchard / "row1", orchard / "row2", "-o", out)
    assert code == 2
    assert "tree.mcap: their results would overwrite each other; give the folder above" in stderr
    assert not out.exists()


def test_a_recording_named_twice_is_replayed_once(canopy, orchard, tmp_path):
    west = orchard / "row2/west"
    paths = (west, west / "tree.mcap", west / "../west")
    arguments = ("-o", tmp_path, "--method", "paper", "--jobs", 1, "--json")
    _, stdout, _ = canopy("batch", *paths, *arguments)
    assert [row["recording"] for row in json.loads(stdout)["recordings"]] == ["tree.mcap"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["missing"], "missing: no such file or folder"),
        (["empty"], "empty: no *.mcap is in it"),
        (["row1", "--jobs", "0"], "jobs is 0; give 1 or more"),
        (["row1", "--jobs", "2", "--cluster", "tcp://127.0.0.1:1"], "leave it out with --cluster"),
        (["row1", "--method", "best"], "unknown method 'best'"),
        (["row1", "--method", "mst", "--rooted"], "leave them out with mst"),
        (["row1", "--segmenter", "maskrcnn"], "comes without weights"),
        (["row1", "--segmenter", "unet", "--weights", "row1/none.pt"], "none.json: cannot be read"),
        (["row1", "--cluster", "host"], "--cluster host: no Dask scheduler answers there"),
    ],
)
def test_wrong_arguments_are_usage_errors(
    canopy, orchard, tmp_path, monkeypatch, arguments, complaint
):
    monkeypatch.setattr("service.batch.cluster.CONNECTING", "1s")
    monkeypatch.chdir(orchard)
    (orchard / "empty").mkdir()
    code, _, stderr = canopy("batch", *arguments, "-o", tmp_path / "out")
    assert code == 2
    assert complaint in stderr
    assert not (tmp_path / "out").exists()


def test_a_file_of_something_else_is_no_row_store(canopy, orchard, tmp_path):
    (tmp_path / "batch.jsonl").write_text('{"other": 1}\n')
    code, _, stderr = canopy("batch", orchard, "-o", tmp_path)
    assert code == 2
    assert "batch.jsonl: line 1 is no row of a batch" in stderr


def test_a_cluster_needs_its_extra(canopy, orchard, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    code, _, stderr = canopy("batch", orchard, "-o", tmp_path, "--cluster", "tcp://127.0.0.1:1")
    assert code == 2
    assert "pip install 'canopy-skel[cluster]'" in stderr


def test_a_cluster_makes_the_same_and_goes_on_where_processes_stopped(
    canopy, orchard, tmp_path, cluster
):
    out, good = tmp_path / "out", (orchard / NAMES[0]).read_bytes()
    (orchard / NAMES[0]).write_bytes(b"no recording at all")
    assert canopy("batch", orchard / NAMES[0], "-o", out / "row1", "--jobs", 1)[0] == 1
    assert canopy("batch", orchard, "-o", out, "--cluster", cluster)[0] == 3
    assert statuses(out) == dict(zip(NAMES, ("failed", "ok", "ok"), strict=True))
    before = written(out)
    (orchard / NAMES[0]).write_bytes(good)
    assert canopy("batch", orchard, "-o", out, "--cluster", cluster)[0] == 0
    assert made_again(before, out) == {"row1"}
    assert_as_replayed(canopy, orchard, out, tmp_path)


def test_a_worker_of_a_cluster_that_is_killed_costs_its_recording_alone(orchard, tmp_path, cluster):
    out, blocked = tmp_path / "out", Blocked(orchard / NAMES[0])
    command = (Path(sys.executable).with_name("canopy"), "batch", orchard, "-o", out)
    with subprocess.Popen([*command, "--method", "paper", "--cluster", cluster]) as process:
        with blocked.read():
            (worker,) = readers_of(blocked.path)
            os.kill(worker, signal.SIGKILL)
        assert process.wait() == 3
    assert statuses(out) == dict(zip(NAMES, ("failed", "ok", "ok"), strict=True))
    assert "row1/tree.mcap: the cluster could not do it" in table(out)[NAMES[0]]["error"]
