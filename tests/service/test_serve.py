"""What `canopy serve` refuses before anything is started."""

import pytest


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ((), "give either --sim or --robot FILE"),
        (("--sim", "--robot", "rig.toml"), "give either --sim or --robot FILE"),
        (("--robot", "no-such-rig.toml"), "no rig file no-such-rig.toml"),
        (("--sim", "--host", "0.0.0.0"), "lets others reach the arm: give --key-file FILE"),
        (("--sim", "--host", "::"), "lets others reach the arm: give --key-file FILE"),
        (("--sim", "--key-file", "no-such-key"), "no key file no-such-key"),
        (("--sim", "--port", "99999"), "less than or equal to 65535"),
        (("--sim", "--time-scale", "0"), "greater than or equal to 0.01"),
    ],
)
def test_what_cannot_be_served_is_refused_before_anything_starts(arguments, why, canopy, tmp_path):
    code, _, stderr = canopy("serve", "--data", tmp_path / "data", *arguments)
    assert code == 2
    assert why in " ".join(stderr.replace("│", " ").split())
    assert not (tmp_path / "data").exists()
