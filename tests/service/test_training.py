import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes.drawn import drawn, straight

from canopy_skel.errors import UsageError
from canopy_skel.metrics.segmentation import Judgement
from canopy_skel.segmenters.unet.weights import load
from service.training import builtin, loop
from service.training.builtin import Amounts
from service.training.crops import draw_batch
from service.training.judging import Sighting, calibrated, figures, rescored, threshold
from service.training.loop import Plan, resume, start, train
from service.training.recipe import builtin_weights
from service.training.store import StoredImages, store

TINY = Plan(steps=15, batch=3, crop_px=64, look_every=5, warm_up=3, channels=(4, 8, 8))


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    rng = np.random.default_rng(0)
    pictures = []
    for k in range(6):
        lines = [
            straight(rng.uniform(60, 180, 2), rng.uniform(0, 180), 150, rng.uniform(4, 12))
            for _ in range(3)
        ]
        pictures.append((f"{k:03d}", drawn(lines, (240, 240), seed=k)))
    assert store(folder, pictures) == 6
    return StoredImages(folder)


def test_pictures_come_back_as_they_were_stored(images, tmp_path):
    image = drawn([straight((100, 90), 30, 120, 6)], (200, 220))
    empty = drawn([], (64, 64))
    store(tmp_path, [("b", image), ("a", empty)])
    again = StoredImages(tmp_path)
    assert len(again) == 2
    assert len(again[0].lines) == 0
    assert np.array_equal(again[1].color_rgb, image.color_rgb)
    assert np.array_equal(again[1].instances, image.instances)
    assert np.array_equal(again[1].lines[0], image.lines[0])


def test_crops_carry_maps_that_fit_them(images):
    batch = draw_batch(images, np.random.default_rng(1), count=24, size_px=96)
    assert batch.color_rgb.shape == (24, 96, 96, 3)
    assert batch.maps.shape == (24, 48, 48, 4)
    wood = batch.maps[..., 0] == 1
    assert wood.any(axis=(1, 2)).mean() > 0.6
    green = batch.color_rgb[:, ::2, ::2, 1].astype(int) - batch.color_rgb[:, ::2, ::2, 0]
    assert np.median(green[wood]) < np.median(green[~wood]) - 20


def test_angles_follow_mirrored_and_transposed_crops(images):
    for seed in range(12):
        batch = draw_batch(images, np.random.default_rng(seed), count=1, size_px=96)
        maps = batch.maps[0]
        v, u = np.nonzero(maps[..., 1] == 1)
        angle = maps[v, u, 2] * (np.pi / 255)
        along, wood = [], maps[..., 0] == 1
        for turn in (0.0, np.pi / 2):
            x = np.rint(u + 4 * np.cos(angle + turn)).astype(int)
            y = np.rint(v + 4 * np.sin(angle + turn)).astype(int)
            inside = (x >= 0) & (y >= 0) & (x < 48) & (y < 48)
            along.append(wood[y[inside], x[inside]].mean() if inside.any() else 1.0)
        assert along[0] > 0.75


def test_the_loss_falls_and_a_broken_off_run_ends_as_an_unbroken_one(images, tmp_path):
    def look(network):
        return {"val_iou": 0.0}

    whole = start(TINY)
    train(whole, lambda: images, tmp_path / "whole", look)
    log = [json.loads(line) for line in (tmp_path / "whole/log.jsonl").read_text().splitlines()]
    assert [entry["step"] for entry in log] == [5, 10, 15]
    assert log[-1]["branch"] < log[0]["branch"]

    first = start(TINY)
    part = tmp_path / "part"

    class StopError(Exception):
        pass

    def stop(network):
        if first.step == 10:
            raise StopError
        return {}

    with pytest.raises(StopError):
        train(first, lambda: images, part, stop)
    again = resume(TINY, part)
    assert again.step == 5
    train(again, lambda: images, part, look)
    assert again.step == 15
    for a, b in zip(
        again.averaged.state_dict().values(), whole.averaged.state_dict().values(), strict=True
    ):
        assert torch.equal(a, b)


def test_a_run_of_another_plan_is_not_gone_on_with(images, tmp_path):
    run = start(TINY)
    loop.save(run, tmp_path)
    other = Plan(**{**loop.asdict(TINY), "seed": 9})
    with pytest.raises(UsageError, match="was trained with seed 1, not 9"):
        resume(other, tmp_path)
    longer = Plan(**{**loop.asdict(TINY), "steps": 99})
    assert resume(longer, tmp_path).plan.steps == 99
    assert resume(TINY, tmp_path / "nowhere") is None
    with pytest.raises(UsageError, match="was trained on other labels, or began with other weigh"):
        resume(replace(TINY, data="others"), tmp_path)


@pytest.mark.parametrize("keep", [0, 100, 5000])
def test_a_damaged_checkpoint_is_refused_in_one_line(tmp_path, keep):
    loop.save(start(TINY), tmp_path)
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(UsageError, match=r"checkpoint\.pt: is damaged; remove it") as refused:
        resume(TINY, tmp_path)
    assert "\n" not in str(refused.value)
    torch.save({"other": 1}, path)
    with pytest.raises(UsageError, match=r"checkpoint\.pt: is no checkpoint"):
        resume(TINY, tmp_path)


def test_without_pictures_there_is_no_training(tmp_path):
    with pytest.raises(UsageError, match="no pictures to train on"):
        train(start(TINY), lambda: StoredImages(tmp_path), tmp_path, lambda network: {})


def test_the_recipe_goes_from_nothing_to_weights_and_on_where_it_was(tmp_path, monkeypatch):
    for name in ("TRAIN", "VALIDATE"):
        variety = replace(getattr(builtin, name), width_px=256, height_px=192)
        monkeypatch.setattr(builtin, name, variety)
    plan = replace(TINY, steps=10, channels=(4, 6, 8, 8, 8))
    amounts = Amounts(train_scenes=1, validate_scenes=2)
    seen = []

    def progress(name, done, total):
        seen.append((name, done, total))

    path = tmp_path / "unet.pt"
    plans = (plan, replace(plan, seed=2))
    facts = builtin_weights(tmp_path, path, plans, amounts, progress)
    assert seen[:3] == [("validate", 1, 2), ("validate", 2, 2), ("train", 1, 1)]
    assert facts["training"]["steps"] == 20
    assert facts["training"]["pictures"] == 4
    assert facts["validation"]["reported"].keys() >= {"line_ap", "precision", "pixel_iou"}
    assert load(path).channels == plan.channels
    log = (tmp_path / "run2" / "log.jsonl").read_text().splitlines()
    longer = (plan, replace(plans[1], steps=15))
    again = builtin_weights(tmp_path, path, longer, amounts, progress)
    assert again["training"]["steps"] == 25
    assert again["training"]["data"] == facts["training"]["data"]
    assert (tmp_path / "run2" / "log.jsonl").read_text().splitlines()[: len(log)] == log


def test_calibrated_scores_are_the_share_that_is_matched():
    rng = np.random.default_rng(0)
    features = rng.normal(size=(4000, 3)) * [1, 10, 0.1] + [5, 0, 0]
    real = rng.random(4000) < 1 / (1 + np.exp(-(2 * (features[:, 0] - 5) + 0.1 * features[:, 1])))
    sighting = Sighting(judgement=judgement(real), features=features)
    calibration = calibrated([sighting])
    assert figures(rescored([sighting], calibration)).ece < 0.03
    assert calibration.weights[:2] == pytest.approx((2, 0.1), rel=0.15)


def judgement(real):
    none = np.zeros(len(real), dtype=bool)
    return Judgement(
        threshold=0.5,
        place=np.arange(len(real)),
        confidence=np.zeros(len(real)),
        at30=none,
        at50=none,
        at_line=real,
        on_wood=real,
        true_count=1,
        pixels=np.zeros(3, np.int64),
        line_px=np.zeros(6),
    )


def test_the_threshold_is_the_lowest_that_is_precise_enough():
    scores = np.linspace(0, 1, 101) + 0.005
    sighting = Sighting(
        judgement=replace(judgement(scores > 0.6), confidence=scores), features=scores[:, None]
    )
    # Of the 51 from 0.5 on, 41 are wood.
    assert threshold([sighting], 41 / 51) == 0.5
    assert threshold([sighting], 1.0) == 0.6
    hopeless = replace(sighting, judgement=replace(judgement(scores > 2), confidence=scores))
    assert threshold([hopeless], 0.5) == 0.95
