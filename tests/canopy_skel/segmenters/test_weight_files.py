"""Weights are compared before they are opened, and nothing in them is ever run."""

import json
import pickle

import pytest
import torch

from canopy_skel.errors import UsageError
from canopy_skel.segmenters.weight_files import (
    read_description,
    read_state,
    require_fit,
    write_weights,
)

MOST = 1 << 20


@pytest.fixture
def path(tmp_path):
    state = {"a": torch.linspace(-2, 2, 9), "n": torch.tensor(3)}
    write_weights(tmp_path / "w.pt", state, {"format": "f/1", "size": 5})
    return tmp_path / "w.pt"


def read(path, needed=()):
    description = read_description(path, "f/1", frozenset(needed))
    return read_state(path, description["sha256"], MOST)


def test_what_is_written_comes_back_in_full_precision_types(path):
    state = read(path, ["size"])
    assert state["a"].dtype == torch.float32
    assert torch.allclose(state["a"], torch.linspace(-2, 2, 9), atol=2e-3)
    assert state["n"] == 3


def test_a_truncated_or_changed_file_is_not_opened(path):
    data = path.read_bytes()
    for broken in (data[:-1], data[:10], b"", data[:50] + b"x" + data[51:]):
        path.write_bytes(broken)
        with pytest.raises(UsageError, match=r"w\.pt: is not the file its JSON describes"):
            read(path)


class Evil:
    def __reduce__(self):
        return (print, ("this must not run",))


@pytest.mark.parametrize("content", [{"a": Evil()}, Evil(), [1, 2], {"a": 5}])
def test_code_and_other_objects_are_refused_even_with_a_right_digest(path, content, capsys):
    torch.save(content, path)
    with pytest.raises(UsageError, match=r"w\.pt: (holds something other|is of another arch)"):
        read_state(path, None, MOST)
    path.write_bytes(pickle.dumps(content, protocol=2))
    with pytest.raises(UsageError, match=r"w\.pt: (holds something other|is of another arch)"):
        read_state(path, None, MOST)
    assert "must not run" not in capsys.readouterr().out


def test_weights_of_a_training_that_diverged_are_refused(tmp_path):
    for bad in (float("nan"), 1e9):  # Too large for float16, as which they are stored.
        write_weights(tmp_path / "w.pt", {"a": torch.tensor([1.0, bad])}, {"format": "f/1"})
        with pytest.raises(UsageError, match=r"w\.pt: a holds numbers that are none"):
            read(tmp_path / "w.pt")


def test_what_is_far_too_large_is_not_even_read(path):
    with pytest.raises(UsageError, match="is larger than 0 MiB"):
        read_state(path, None, 100)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "is not JSON"),
        ("[]", "is of format None, expected 'f/1'"),
        (json.dumps({"format": "g/1"}), "is of format 'g/1', expected 'f/1'"),
        (json.dumps({"format": "f/1"}), "lacks sha256, size"),
    ],
)
def test_a_description_that_is_none_is_refused(path, text, says):
    path.with_suffix(".json").write_text(text)
    with pytest.raises(UsageError, match=says):
        read(path, ["size"])
    path.with_suffix(".json").unlink()
    with pytest.raises(UsageError, match=r"w\.json: cannot be read .*two files"):
        read(path)


def test_another_architecture_is_named_by_its_first_difference(path):
    state = read(path)
    require_fit(path, state, dict(state))
    for wanted, says in (
        ({**state, "b": torch.zeros(2)}, r"b is missing, expected \(2,\)"),
        ({"n": state["n"]}, r"a is \(9,\), expected nothing"),
        ({**state, "a": torch.zeros(3)}, r"a is \(9,\), expected \(3,\)"),
    ):
        with pytest.raises(UsageError, match=says):
            require_fit(path, wanted, state)
