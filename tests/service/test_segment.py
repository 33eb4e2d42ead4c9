"""`canopy segment` and `canopy train` as users call them."""

import json

import cv2
import numpy as np
import pytest
import torch
from mcap.reader import make_reader
from scenes.drawn import drawn, straight
from scenes.scorers import constant_scorer
from scenes.wood import view_from

from canopy_skel.recording import RecordingWriter, read_recording
from canopy_skel.segmenters.unet.grouping import Grouping
from canopy_skel.segmenters.unet.network import UNet
from canopy_skel.segmenters.unet.weights import Model, load, save

CHANNELS = (8, 8, 8, 8, 8)
BARS = [straight((50, 60), 80, 90, 8), straight((115, 60), 15, 70, 7)]


@pytest.fixture
def weights(tmp_path):
    """Weights of a small network that finds a branch wherever a picture is bright."""
    torch.manual_seed(0)
    network = UNet(CHANNELS)
    torch.nn.init.zeros_(network.head.weight)
    with torch.no_grad():
        network.head.bias.copy_(torch.tensor([3.0, 3.0, 1.0, 0.0, 2.0, 0.0, 0.0, 5.0]))
    model = Model(
        network=network.eval(),
        channels=CHANNELS,
        zoom=1.5,
        grouping=Grouping(),
        scorer=constant_scorer(CHANNELS, 1.0),
        least_score=0.5,
    )
    save(tmp_path / "small.pt", model, {})
    return tmp_path / "small.pt"


def picture(path, pixels):
    assert cv2.imwrite(str(path), pixels)
    return path


@pytest.mark.parametrize(
    "pixels",
    [
        np.full((32, 160, 3), 200, np.uint8),
        np.full((32, 160), 200, np.uint8),
        np.full((32, 160, 3), 3000, np.uint16),
        np.full((32, 160), 60000, np.uint16),
        np.full((32, 160, 4), 200, np.uint8),
    ],
    ids=["colour", "grey", "12 of 16 bits", "16 bits grey", "with alpha"],
)
def test_pictures_of_all_kinds_get_overlay_instances_and_scores(canopy, tmp_path, weights, pixels):
    path, out = picture(tmp_path / "tree.png", pixels), tmp_path / "out"
    code, stdout, _ = canopy("segment", path, "-o", out, "--weights", weights)
    assert code == 0
    assert "tree.png: 1 branch instances, 0 of them with a confidence of 0.9 or more" in stdout
    assert sorted(file.name for file in out.iterdir()) == [
        "tree.instances.png",
        "tree.overlay.jpg",
        "tree.scores.json",
    ]
    assert cv2.imread(str(out / "tree.overlay.jpg")).shape == (32, 160, 3)
    instances = cv2.imread(str(out / "tree.instances.png"), cv2.IMREAD_UNCHANGED)
    assert instances.dtype == np.uint16
    assert instances.max() == 1
    assert (instances == 1).mean() > 0.2
    (score,) = json.loads((out / "tree.scores.json").read_text())["scores"]
    assert score == pytest.approx(1 / (1 + np.exp(-1)))


def test_a_single_pixel_has_no_branch(canopy, tmp_path, weights):
    path = picture(tmp_path / "dot.png", np.full((1, 1, 3), 9, np.uint8))
    code, stdout, _ = canopy("segment", path, "-o", tmp_path, "--weights", weights, "--json")
    assert code == 0
    (result,) = json.loads(stdout)
    assert (result["instances"], result["views"]) == (0, 1)


def test_one_bad_picture_is_named_and_the_others_go_on(canopy, tmp_path, weights):
    good = picture(tmp_path / "good.png", np.full((32, 160, 3), 90, np.uint8))
    bad = tmp_path / "bad.jpg"
    bad.write_bytes(good.read_bytes()[:60])
    code, stdout, stderr = canopy(
        "segment", bad, good, tmp_path / "no.png", "-o", tmp_path / "out", "--weights", weights
    )
    assert code == 3
    assert "good.png: 1 branch" in stdout
    assert "bad.jpg: is no picture that can be read (60 bytes)" in stderr
    assert "no.png: cannot be read (No such file or directory)" in stderr


def content(path):
    with path.open("rb") as stream:
        return [
            (channel.topic, m.sequence, m.log_time, m.data)
            for _, channel, m in make_reader(stream).iter_messages(log_time_order=False)
            if "branches" not in channel.topic
        ]


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "sticks.mcap"
    with RecordingWriter(path, {"scan_id": "s"}, tool_from_camera=np.eye(4)) as writer:
        for view in (view_from(0), view_from(1, y=0.1)):
            writer.write_view(view)
    return path


def test_a_recording_gets_a_copy_with_instances(canopy, recording, tmp_path, weights):
    out = tmp_path / "out"
    code, stdout, _ = canopy("segment", recording, "-o", out, "--weights", weights)
    assert code == 0
    assert "sticks.mcap: 2 branch instances in 2 views" in stdout
    assert content(out / "sticks.mcap") == content(recording)
    for view in read_recording(out / "sticks.mcap").views():
        assert len(view.scores) == 1
        assert (view.instances == 1).any()
    code, _, stderr = canopy("segment", recording, "-o", out, "--weights", weights)
    assert code == 1
    assert "is there already" in stderr


def test_a_recording_judges_instances_and_the_skeleton_they_lead_to(
    canopy, recording, tmp_path, weights
):
    canopy("replay", recording, "-o", tmp_path, "--formats", "json", "--method", "paper")
    truth = (tmp_path / "sticks.skeleton.json").read_bytes()
    path = tmp_path / "with_truth.mcap"
    with RecordingWriter(path, {"scan_id": "s"}, tool_from_camera=np.eye(4)) as writer:
        for view in read_recording(recording).views():
            writer.write_view(view)
        writer.attach("ground_truth_skeleton.json", "application/json", truth)
    code, stdout, _ = canopy("segment", "--evaluate", path, "--weights", weights, "--json")
    assert code == 0
    (result,) = json.loads(stdout)
    scores = result["scores"]
    assert (scores["pictures"], scores["instances_true"], scores["instances_found"]) == (2, 6, 2)
    assert 0 < scores["pixel_recall"] < 0.5
    assert 0 < scores["pixel_iou"] < scores["pixel_precision"] < 0.5
    assert scores["precision"] <= 0.5
    assert result["pace"]["size_px"] == [320, 240]
    assert result["pace"]["cpu"]
    skeleton = result["skeleton"]
    assert skeleton["recorded"]["precision"] == skeleton["recorded"]["recall"] == 1.0
    assert skeleton["unet"]["recall"] < 1.0
    assert skeleton["ratio"]["recall"] == pytest.approx(skeleton["unet"]["recall"])


def test_recorded_instances_are_what_is_compared_with(canopy, recording):
    arguments = ("--evaluate", recording, "--segmenter", "recorded")
    code, _, stderr = canopy("segment", *arguments)
    assert code == 2
    assert "recorded instances are what is compared with; choose unet or maskrcnn" in stderr


@pytest.fixture
def labelme(tmp_path):
    """LabelMe files of two scans of two pictures each."""
    folder = tmp_path / "labels"
    for number in range(4):
        name = f"tree{number // 2}_{number}"
        image = drawn(BARS, (120, 160), seed=number)
        folder.mkdir(exist_ok=True)
        picture(folder / f"{name}.png", image.color_rgb[..., ::-1])
        shapes = [
            {
                "label": "branch",
                "shape_type": "linestrip",
                "points": bar[:, :2].tolist(),
                "description": f"width={2 * bar[0, 2]}",
            }
            for bar in BARS
        ]
        document = {"imagePath": f"{name}.png", "imageHeight": 120, "imageWidth": 160}
        (folder / f"{name}.json").write_text(json.dumps({**document, "shapes": shapes}))
    return folder


def test_labels_judge_and_train(canopy, labelme, tmp_path, weights):
    code, stdout, _ = canopy(
        "segment", "--evaluate", "--labelme", labelme, "--weights", weights, "--json"
    )
    assert code == 0
    (result,) = json.loads(stdout)
    assert (result["scores"]["pictures"], result["scores"]["instances_true"]) == (4, 8)
    out = tmp_path / "trained"
    arguments = ("--labelme", labelme, "--init", weights, "--steps", "2", "-o", out)
    code, stdout, _ = canopy("train", *arguments)
    assert code == 0
    assert "unet.pt: trained for 2 steps" in stdout
    assert "judged on: none: too few instances in scans" in stdout
    model = load(out / "unet.pt")
    assert model.channels == CHANNELS
    assert (model.least_score, model.zoom) == (0.5, 1.5)
    before = load(weights).network.state_dict()
    assert any(not torch.equal(before[k], v) for k, v in model.network.state_dict().items())
    assert len(list((out / "data" / "train").glob("*.labels.npz"))) == 2
    assert len(list((out / "data" / "validate").glob("*.labels.npz"))) == 2
    for path in labelme.glob("*.json"):
        path.write_text(path.read_text().replace("width=", "width=1"))
    code, _, stderr = canopy("train", *arguments)
    assert code == 2
    assert "checkpoint.pt: was trained on other labels, or began with other weights" in stderr


def test_training_from_nothing_gives_weights_that_segment_and_are_gone_on_from(
    canopy, labelme, tmp_path
):
    first, second = tmp_path / "first", tmp_path / "second"
    code, stdout, _ = canopy(
        "train", "--labelme", labelme, "--init", "none", "--steps", "2", "-o", first
    )
    assert code == 0
    assert "unet.pt: trained for 2 steps" in stdout
    weights = first / "unet.pt"
    code, _, _ = canopy(
        "segment", labelme / "tree0_0.png", "--weights", weights, "-o", tmp_path / "found"
    )
    assert code == 0
    code, _, _ = canopy(
        "train", "--labelme", labelme, "--init", weights, "--steps", "1", "-o", second
    )
    assert code == 0
    before, after = (load(folder / "unet.pt").network.state_dict() for folder in (first, second))
    learned = [name for name, value in before.items() if value.ndim > 1]
    apart = torch.stack([(after[name] - before[name]).abs().max() for name in learned])
    assert ((apart > 0) & (apart < 1e-3)).all()  # one gentle step from there


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["segment"], "give pictures or recordings, and a folder for the results"),
        (["segment", "a.png"], "give pictures or recordings, and a folder for the results"),
        (["segment", "--evaluate"], "--evaluate needs recordings, or labels"),
        (["segment", "a/b.png", "c/b.png", "-o", "o"], "several sources are named b"),
        (["segment", "a.png", "-o", "o", "--segmenter", "eyes"], "unknown segmenter 'eyes'"),
        (["segment", "a.png", "-o", "o", "--segmenter", "maskrcnn"], "comes without weights"),
        (["segment", "a.png", "-o", "o", "--coco", "c.json"], "labels are for --evaluate"),
        (["train", "-o", "o", "--coco", "c.json"], "--coco needs --images"),
        (["train", "-o", "o", "--coco", "c", "--labelme", "l"], "either --coco FILE"),
        (["train", "-o", "o", "--labelme", "l", "--recipe", "builtin"], "give either labels"),
        (["train", "-o", "o", "--segmenter", "maskrcnn"], "unknown recipe 'builtin' for maskrcnn"),
        (["train", "-o", "o", "--segmenter", "eyes"], "unknown segmenter 'eyes'"),
        (["train", "-o", "o", "--labelme", "nowhere"], "nowhere: is not a folder"),
        (["train", "-o", "o", "--labelme", "l", "--steps", "0"], "--steps 0: give more than 0"),
        (["train", "-o", "o", "--minutes", "-1"], "--minutes -1.0: give more than 0"),
        (["train", "-o", "o", "--minutes", "nan"], "--minutes nan: give more than 0"),
        (["train", "-o", "o", "--scenes", "0"], "--scenes 0: give more than 0"),
        (["train", "-o", "o", "--images", "i"], "go with labels: give --coco, --labelme"),
        (["train", "-o", "o", "--init", "none"], "go with labels: give --coco, --labelme"),
        (["segment", "--evaluate", "a.png"], "a.png: is a picture without labels; give them"),
        (["segment", ".", "-o", "o"], ".: is a folder; name the pictures or recordings in it"),
    ],
)
def test_wrong_arguments_are_usage_errors(canopy, tmp_path, monkeypatch, arguments, says):
    monkeypatch.chdir(tmp_path)
    code, stdout, stderr = canopy(*arguments)
    assert (code, stdout) == (2, "")
    assert says in stderr
    assert stderr.count("\n") == 1
