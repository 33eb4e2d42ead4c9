import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from service.skeletons import SOFTWARE

QUICK = ("--species", "walnut", "--topologies", "3-3", "--foliage", "1", "--picture-scale", "0.25")
CANOPY = (sys.executable, "-c", "from service.cli import main; main()")


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """A folder whose run was killed while it recorded, and the processes it had."""
    path = tmp_path_factory.mktemp("simulated")
    run = start("simulate", "-o", path, *QUICK)
    until(lambda: list(path.glob(".unfinished-*/*.part")))
    workers = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
    run.send_signal(signal.SIGKILL)
    run.wait()
    return path, workers


@pytest.fixture(scope="module")
def folder(killed):
    path, _ = killed
    run = start("simulate", "-o", path, *QUICK, "--json", stdout=subprocess.PIPE)
    result = json.loads(run.communicate()[0])
    assert run.returncode == 0
    assert [one["file"] for one in result["recordings"]] == ["walnut_003_fd1.mcap"]
    assert result["densities"][0]["worst_miss"] < 0.03
    assert result["manifest"] == str(path / "manifest.json")
    return path


def start(*arguments, **options):
    return subprocess.Popen([*CANOPY, *map(str, arguments)], text=True, **options)


def test_a_killed_run_leaves_no_process_and_nothing_half(killed):
    path, workers = killed
    assert workers
    until(lambda: not any(is_running(worker) for worker in workers))
    assert json.loads((path / "manifest.json").read_text())["recordings"] == []
    assert not list(path.glob("*.mcap"))


def test_run_again_it_goes_on_and_clears_up(folder):
    assert sorted(os.listdir(folder)) == ["manifest.json", "walnut_003_fd1.mcap"]


def test_simulated_recordings_are_inspected_and_scored(canopy, folder, tmp_path):
    recording = folder / "walnut_003_fd1.mcap"
    code, out, _ = canopy("inspect", recording, "--json")
    assert code == 0
    facts = json.loads(out)
    assert facts["metadata"]["software"] == SOFTWARE
    assert len(facts["views"]) == 10
    canopy("replay", recording, "-o", tmp_path, "--formats", "json")
    code, out, _ = canopy("score", tmp_path / "walnut_003_fd1.skeleton.json", recording, "--json")
    assert code == 0
    assert json.loads(out)["precision"] > 0.5


def test_run_again_it_keeps_what_is_there_and_prints_the_densities(canopy, folder):
    code, out, err = canopy("simulate", "-o", folder, *QUICK)
    assert code == 0
    assert "walnut_003_fd1.mcap there already" in err
    assert "| walnut | 1 | 1 |" in out


def test_a_check_makes_nothing_and_names_what_is_damaged(canopy, folder, tmp_path):
    code, out, err = canopy("simulate", "-o", folder, "--check")
    assert (code, err) == (0, "")
    assert "| walnut | 1 | 1 |" in out
    (tmp_path / "manifest.json").write_bytes((folder / "manifest.json").read_bytes())
    code, _, err = canopy("simulate", "-o", tmp_path, "--check")
    assert code == 1
    assert "walnut_003_fd1.mcap: cannot be read (No such file or directory)" in err
    assert [path.name for path in tmp_path.iterdir()] == ["manifest.json"]


def test_a_full_disk_is_one_line(tmp_path):
    # Like a full disk for these processes: no file can grow beyond this.
    run = start(
        *("simulate", "-o", tmp_path, *QUICK),
        stderr=subprocess.PIPE,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000)),
    )
    _, err = run.communicate()
    assert run.returncode == 1
    (line,) = err.splitlines()
    assert "walnut_003_fd1.mcap: cannot be written (File too large); check the disk" in line
    assert [path.name for path in tmp_path.iterdir()] == ["manifest.json"]


def until(condition, within_s=120):
    end_s = time.perf_counter() + within_s
    while not condition():
        assert time.perf_counter() < end_s
        time.sleep(0.02)


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--species", "pear"], "unknown species 'pear'; choose one of apple, oak, walnut"),
        (["--species", "apple,"], "unknown species ''"),
        (["--views", "0"], "no camera path with 0 views; choose 10 or 70"),
        (["--foliage", "5"], "no foliage density 5; choose 1, 2, 3 or 4"),
        (["--foliage", "4-1"], "--foliage 4-1: 4-1 is no range; give the smaller number first"),
        (["--topologies", "0"], "--topologies 0: give 1 or more trees"),
        (["--topologies", "two"], "--topologies two: give numbers and ranges"),
        (["--topologies", "-3"], "--topologies -3: give numbers and ranges"),
        (["--noise", "loud"], "unknown noise 'loud'; choose one of none, nominal, bad"),
        (["--weather", "hail"], "unknown weather 'hail'; choose fair or any"),
        (["--wind", "-1"], "wind_m is -1.0; give 0 or more"),
        (["--wind", "nan"], "wind_m is nan; give 0 or more"),
        (["--seed", "-1"], "seed is -1; give 0 or more"),
        (["--jobs", "0"], "jobs is 0; give 1 or more"),
        (["--picture-scale", "0"], "no pictures scaled by 0.0; give more than 0"),
        (["--picture-scale", "nan"], "no pictures scaled by nan"),
    ],
)
def test_bad_options_of_simulate_are_one_line(canopy, tmp_path, arguments, message):
    code, out, err = canopy("simulate", "-o", tmp_path, *arguments)
    assert (code, out) == (2, "")
    (line,) = err.splitlines()
    assert message in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("verb", ["simulate", "coco"])
def test_a_folder_that_cannot_be_written_is_one_line(canopy, verb):
    code, _, err = canopy(verb, "-o", "/dev/null/here")
    assert code == 2
    (line,) = err.splitlines()
    assert "/dev/null/here: cannot write there (Not a directory)" in line


def test_a_folder_without_manifest_cannot_be_checked(canopy, tmp_path):
    code, _, err = canopy("simulate", "-o", tmp_path, "--check")
    assert code == 2
    (line,) = err.splitlines()
    assert "manifest.json: cannot be read (No such file or directory); give the folder" in line


def test_coco_writes_a_data_set_and_says_where(canopy, tmp_path):
    options = ("--images", "1", "--picture-scale", "0.125", "--species", "walnut")
    code, out, _ = canopy("coco", "-o", tmp_path, *options, "--json")
    assert code == 0
    result = json.loads(out)
    document = json.loads(Path(result["annotations"]).read_text())
    assert document["info"]["species"] == ["walnut"]
    assert os.listdir(tmp_path / "images") == ["000000.jpg"]


def test_coco_refuses_no_images_in_one_line(canopy, tmp_path):
    code, _, err = canopy("coco", "-o", tmp_path, "--images", "0")
    assert code == 2
    (line,) = err.splitlines()
    assert "0 images; give 1 or more" in line
