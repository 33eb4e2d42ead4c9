import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes.drawn import drawn, straight

from canopy_skel.errors import UsageError
from canopy_skel.metrics.segmentation import Judgement, segmentation_scores
from canopy_skel.segmenters.unet.network import Known
from canopy_skel.segmenters.unet.scorer import Scorer
from canopy_skel.segmenters.unet.segmenter import UNetSegmenter
from canopy_skel.segmenters.unet.targets import places_of
from canopy_skel.segmenters.unet.weights import load
from service.training import builtin, loop
from service.training.builtin import Amounts
from service.training.crops import draw_batch
from service.training.judging import Correction, corrected, corrected_scorer, honest, threshold
from service.training.look import Look
from service.training.loop import Plan, resume, start, train
from service.training.recipe import BUILTIN_PLANS, best_of, builtin_weights, shortened
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
    assert batch.maps.shape == (24, 48, 48, 5)
    assert batch.places.shape == (24, 48, 48, 3)
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


def test_places_follow_mirrored_and_transposed_crops(images):
    judged = 0
    for seed in range(12):
        batch = draw_batch(images, np.random.default_rng(seed), count=4, size_px=128)
        for maps, places in zip(batch.maps, batch.places, strict=True):
            for number in np.unique(maps[..., 4][maps[..., 4] > 0]):
                cells = np.argwhere(maps[..., 4] == number)[:, ::-1].astype(float)
                spread, axes = np.linalg.eigh(np.cov(cells.T) + np.eye(2))
                if spread[1] < 25 * spread[0]:
                    continue
                judged += 1
                way = places[maps[..., 4] == number]
                along = cells @ axes[:, 1]
                half = 0.5 * (np.ptp(along) + 1)
                wanted = (0.5 * (along.min() + along.max()) - along) / half
                assert way[:, :2] @ axes[:, 1] == pytest.approx(wanted, abs=0.15)
                assert np.abs(way[:, :2] @ axes[:, 0]).max() < 0.15
                assert np.exp(way[:, 2]) == pytest.approx(4 * half, rel=0.1)
    assert judged > 50


def test_pictures_another_version_stored_are_refused(images, tmp_path, monkeypatch):
    store(tmp_path / "train", [("00000-0", images[0])])
    path = tmp_path / "train" / "00000-0.maps.npy"
    np.save(path, np.load(path)[..., :4])
    old = StoredImages(tmp_path / "train")
    assert len(old[0].lines) == 3
    refusal = "train: holds pictures that another version has stored; give another folder, or del"
    with pytest.raises(UsageError, match=refusal):
        train(start(TINY), lambda: old, tmp_path / "run", lambda network: {})
    monkeypatch.setattr(builtin, "scene_frames", lambda variety, scene: pytest.fail("drawn"))
    amounts = Amounts(train_scenes=2, validate_scenes=0)
    with pytest.raises(UsageError, match=refusal):
        builtin.draw(tmp_path, amounts, lambda name, done, total: None)


def test_a_look_measures_how_far_off_the_maps_are(images, monkeypatch):
    def says(maps):
        known = Known(maps=maps, features=maps[:0])
        monkeypatch.setattr(UNetSegmenter, "known", lambda self, color: known)
        return Look(images, [0], 1.0)(start(TINY).network)

    truth = images.maps(0)
    angle = truth[..., 2] * (2 * np.pi / 255)
    wood, middle = np.where(truth[..., 0] == 1, 4, -4), np.where(truth[..., 1] == 1, 4, -4)
    ways = np.moveaxis(places_of(truth), -1, 0)
    maps = np.stack([wood, middle, np.cos(angle), np.sin(angle), wood, *ways]).astype(np.float32)
    right = {"val_iou": 1, "val_centre_iou": 1, "val_angle_median": 0, "val_angle_p90": 0}
    assert says(maps) == pytest.approx({**right, "val_middle": 0}, abs=1e-4)
    maps[5:7] += np.array([0.3, 0.4], np.float32)[:, None, None]
    assert says(maps) == pytest.approx({**right, "val_middle": 0.5}, abs=1e-4)
    assert says(np.full_like(maps, -4)) == {
        "val_iou": 0,
        "val_centre_iou": 0,
        "val_angle_median": 90,
        "val_angle_p90": 90,
        "val_middle": 1,
    }


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_places_are_learned_only_where_they_have_weight(images, tmp_path, weight):
    run = start(replace(TINY, piece_weight=weight, weight_decay=0.0, steps=2))
    before = run.network.head.weight.detach().clone()
    train(run, lambda: images, tmp_path, lambda network: {})
    changed = (run.network.head.weight != before).flatten(1).any(dim=1)
    assert changed.tolist() == [True] * 5 + [weight > 0] * 3


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
    plans = (replace(plan, piece_weight=0.0), replace(plan, seed=2, batch=2, crop_px=96))
    facts = builtin_weights(tmp_path, path, plans, amounts, progress)
    assert seen[:3] == [("validate", 1, 2), ("validate", 2, 2), ("train", 1, 1)]
    assert facts["training"]["steps"] == 20
    assert facts["training"]["pictures"] == 4
    assert facts["validation"]["reported"].keys() >= {"line_ap", "precision", "pixel_iou"}
    assert load(path).channels == plan.channels
    log = (tmp_path / "run2" / "log.jsonl").read_text().splitlines()
    longer = (plans[0], replace(plans[1], steps=15))
    again = builtin_weights(tmp_path, path, longer, amounts, progress)
    assert again["training"]["steps"] == 25
    assert again["training"]["data"] == facts["training"]["data"]
    assert (tmp_path / "run2" / "log.jsonl").read_text().splitlines()[: len(log)] == log


def test_a_length_that_is_given_is_shared_out_and_takes_the_place_of_the_plans_own():
    assert shortened(BUILTIN_PLANS, None, None) == BUILTIN_PLANS
    steps = sum(plan.steps for plan in BUILTIN_PLANS)
    for wanted in (100, 2 * steps):
        plans = shortened(BUILTIN_PLANS, wanted, None)
        assert sum(plan.steps for plan in plans) == wanted
        assert all(plan.minutes == math.inf for plan in plans)
    plans = shortened(BUILTIN_PLANS, None, 300)
    assert sum(plan.minutes for plan in plans) == pytest.approx(300)
    assert [plan.steps for plan in plans] == [plan.steps for plan in BUILTIN_PLANS]
    plans = shortened(BUILTIN_PLANS, 10, 30)
    assert sum(plan.steps for plan in plans) == 10
    assert sum(plan.minutes for plan in plans) == pytest.approx(30)


def test_honest_scores_are_the_share_that_is_matched():
    rng = np.random.default_rng(0)
    logits = rng.normal(size=4000)
    real = rng.random(4000) < 1 / (1 + np.exp(-(2 * logits - 1)))
    told = judgement(real, 1 / (1 + np.exp(-logits)))
    correction = honest([told])
    assert correction == pytest.approx((2, -1), abs=0.15)
    before, after = ([one] for one in (told, *corrected([told], correction)))
    assert segmentation_scores(before).ece > 0.1
    assert segmentation_scores(after).ece < 0.03
    assert segmentation_scores(after).line_ap == segmentation_scores(before).line_ap


def test_a_corrected_scorer_says_what_the_correction_does():
    torch.manual_seed(0)
    scorer = Scorer(9).eval()
    scorer.seen.fill_(1.0)
    strips = torch.randn(20, 11, 32, 9)
    once = Correction(slope=1.5, shift=-0.5)
    with torch.inference_mode():
        before = torch.sigmoid(scorer(strips)).numpy()
        for correction in (once, Correction(slope=0.7, shift=0.2)):
            scorer = corrected_scorer(scorer, correction)
            before = correction.of(before)
            assert torch.sigmoid(scorer(strips)).numpy() == pytest.approx(before, abs=1e-5)


def test_a_correction_never_turns_scores_round():
    scores = np.linspace(0.1, 0.9, 40)
    correction = honest([judgement(scores < 0.5, scores)])
    assert correction.slope > 0
    assert (np.diff(correction.of(scores)) > 0).all()


def test_the_checkpoint_is_the_one_that_knows_places_best_of_those_that_see_as_much(tmp_path):
    looks = [(100, 0.30, 0.1), (200, 0.60, 0.4), (300, 0.595, 0.3), (400, 0.598, 0.35)]
    lines = [
        json.dumps({"step": step, "val_iou": iou, "val_middle": middle})
        for step, iou, middle in looks
    ]
    (tmp_path / "log.jsonl").write_text("\n".join(lines))
    assert best_of(tmp_path).name == "average-000300.pt"
    with pytest.raises(UsageError, match="holds no training log; train first"):
        best_of(tmp_path / "nowhere")


def test_without_any_instance_scores_stay():
    assert honest([judgement(np.zeros(0, bool), np.zeros(0))]) == (1.0, 0.0)


def judgement(real, confidence):
    none = np.zeros(len(real), dtype=bool)
    return Judgement(
        threshold=0.5,
        place=np.arange(len(real)),
        confidence=confidence,
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
    told = [judgement(scores > 0.6, scores)]
    # Of the 51 from 0.5 on, 41 are wood.
    assert threshold(told, 41 / 51) == 0.5
    assert threshold(told, 1.0) == 0.6
    assert threshold([judgement(scores > 2, scores)], 0.5) == 0.95
