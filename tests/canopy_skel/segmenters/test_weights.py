import hashlib
import json
import pickle

import pytest
import torch

from canopy_skel.errors import UsageError
from canopy_skel.segmenters.unet.grouping import Grouping
from canopy_skel.segmenters.unet.network import UNet, normalised
from canopy_skel.segmenters.unet.weights import (
    BUILTIN,
    Model,
    fused,
    load,
    save,
    untaught_scorer,
)

SMALL = (4, 6, 8)


@pytest.fixture
def model():
    torch.manual_seed(0)
    return Model(
        network=UNet(SMALL).eval(),
        channels=SMALL,
        zoom=1.5,
        grouping=Grouping(branch=0.6, centres=(0.1, 0.3)),
        scorer=untaught_scorer(SMALL).eval(),
        least_score=0.3,
    )


@pytest.fixture
def saved(model, tmp_path):
    path = tmp_path / "mine.pt"
    save(path, model, {"note": "of a test"})
    return path


def described(path, **changes):
    beside = path.with_suffix(".json")
    beside.write_text(json.dumps(json.loads(beside.read_text()) | changes))


def rehash(path):
    described(path, sha256=hashlib.sha256(path.read_bytes()).hexdigest())


def test_what_was_saved_is_loaded(model, saved):
    again = load(saved)
    assert again.grouping == model.grouping
    assert (again.channels, again.zoom, again.least_score) == (SMALL, 1.5, 0.3)
    for mine, other in ((model.network, again.network), (model.scorer, again.scorer)):
        wanted = mine.state_dict()
        for name, value in other.state_dict().items():
            assert value.dtype == wanted[name].dtype
            assert torch.allclose(value, wanted[name], rtol=1e-3, atol=1e-6)
    assert json.loads(saved.with_suffix(".json").read_text())["note"] == "of a test"


def test_a_truncated_file_is_refused_before_it_is_unpickled(saved):
    saved.write_bytes(saved.read_bytes()[:-100])
    with pytest.raises(UsageError, match=r"mine\.pt: is not the file its JSON describes"):
        load(saved)


class Harmful:
    def __reduce__(self):
        return (pytest.fail, ("code in a weights file was run",))


def test_pickled_code_is_never_run(saved, tmp_path):
    saved.write_bytes(pickle.dumps(Harmful(), protocol=2))
    with pytest.raises(UsageError, match="is not the file"):
        load(saved)
    rehash(saved)
    with pytest.raises(UsageError, match="something other than plain weights"):
        load(saved)
    torch.save({"stem.0.weight": Harmful()}, saved)
    rehash(saved)
    with pytest.raises(UsageError, match="something other than plain weights"):
        load(saved)


def test_weights_of_another_architecture_are_refused(saved):
    described(saved, channels=[4, 6, 10])
    with pytest.raises(UsageError, match=r"another architecture: .*expected"):
        load(saved)
    torch.save([1, 2], saved)
    rehash(saved)
    with pytest.raises(UsageError, match="another architecture"):
        load(saved)


def test_a_description_that_is_missing_old_or_short_is_named(saved):
    beside = saved.with_suffix(".json")
    text = beside.read_text()
    for wrong, why in (
        ("{", "is not JSON"),
        ('{"format": "canopy-unet/1"}', "of format 'canopy-unet/1'"),
        ("[]", "of format None"),
    ):
        beside.write_text(wrong)
        with pytest.raises(UsageError, match=why):
            load(saved)
    beside.write_text(json.dumps({k: v for k, v in json.loads(text).items() if k != "grouping"}))
    with pytest.raises(UsageError, match="lacks grouping"):
        load(saved)
    beside.unlink()
    with pytest.raises(UsageError, match=r"mine\.json: cannot be read"):
        load(saved)


@pytest.mark.parametrize(
    "changes",
    [
        {"channels": []},
        {"zoom": 0},
        {"zoom": "large"},
        {"channels": "many"},
        {"channels": [4, -6, 8]},
        {"grouping": None},
        {"grouping": {"sharpness": 1}},
        {"grouping": {"centres": [0.1], "sharpness": 1}},
        {"grouping": {"centres": [0.1], "branch": "0.4"}},
        {"grouping": {"centres": [0.1], "branch": float("nan")}},
        {"grouping": {"centres": 0.1}},
        {"grouping": {"centres": []}},
        {"grouping": {"centres": [0.1, float("nan")]}},
        {"grouping": {"centres": [0.1, 1.0]}},
        {"grouping": {"centres": [0.1], "taken": 1.0}},
        {"least_score": None},
        {"least_score": -5},
    ],
)
def test_a_description_of_something_else_is_refused_in_one_line(saved, changes):
    described(saved, **changes)
    with pytest.raises(UsageError, match=r"mine\.json: does not say how the network is") as refused:
        load(saved)
    assert "\n" not in str(refused.value)


def test_folding_normalisation_into_convolutions_changes_nothing(model):
    network = model.network.train()
    pictures = torch.rand(2, 3, 64, 64)
    for _ in range(3):
        network(pictures)
    network.eval()
    with torch.inference_mode():
        wanted = network(pictures)
        assert torch.allclose(fused(network)(pictures), wanted, atol=1e-4)


def test_the_network_answers_at_half_size():
    with torch.inference_mode():
        out = UNet().eval()(normalised(torch.zeros(1, 64, 96, 3, dtype=torch.uint8).numpy()))
    assert out.shape == (1, 8, 32, 48)


def test_what_the_network_knows_are_its_maps_and_what_they_are_made_of(model):
    with torch.inference_mode():
        picture = normalised(torch.randint(0, 256, (1, 64, 96, 3), dtype=torch.uint8).numpy())
        maps, features = model.network.known(picture)
        whole, again = model.network(picture)[0], model.network.head(features[None])[0]
    assert maps.is_contiguous()
    assert features.shape == (SMALL[0], 32, 48)
    assert torch.allclose(maps, whole, atol=1e-5)
    assert torch.allclose(again, maps, atol=1e-5)


def test_the_built_in_weights_are_small_and_say_where_they_come_from():
    assert BUILTIN.stat().st_size <= 8 << 20
    model = load()
    both = [*model.network.parameters(), *model.scorer.parameters()]
    assert sum(value.numel() for value in both) <= 3_000_000
    facts = json.loads(BUILTIN.with_suffix(".json").read_text(), parse_constant=pytest.fail)
    assert {"training", "validation", "sha256"} <= facts.keys()
