"""Weights on disk: tensors in a .pt file beside a .json that says what they are.

The JSON holds the file's SHA-256, which is compared before anything is unpickled; what is
unpickled may hold tensors only.
"""

import hashlib
import io
import json
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from canopy_skel.errors import UsageError


def write_weights(path: Path, state: Mapping[str, Tensor], description: Mapping[str, Any]) -> None:
    """Write tensors as float16, and the description with their SHA-256 beside them."""
    buffer = io.BytesIO()
    torch.save({name: _narrowed(value) for name, value in state.items()}, buffer)
    path.write_bytes(buffer.getvalue())
    digest = hashlib.sha256(buffer.getvalue()).hexdigest()
    text = json.dumps({**description, "sha256": digest}, indent=2)
    path.with_suffix(".json").write_text(text + "\n")


def _narrowed(value: Tensor) -> Tensor:
    return value.detach().half() if value.is_floating_point() else value


def read_description(path: Path, form: str, needed: frozenset[str]) -> dict[str, Any]:
    """Return what the JSON beside a weights file says.

    Raises:
        UsageError: it is not there, of another format, or lacks something that is `needed`.
    """
    beside = path.with_suffix(".json")
    try:
        description = json.loads(beside.read_text())
    except OSError as error:
        raise UsageError(
            f"{beside}: cannot be read ({error.strerror}); weights come as two files, .pt and .json"
        ) from error
    except ValueError as error:
        raise UsageError(f"{beside}: is not JSON ({error}); copy both files anew") from error
    known = description.get("format") if isinstance(description, dict) else None
    if known != form:
        raise UsageError(
            f"{path}: is of format {known!r}, expected {form!r}; give other weights, or train anew"
        )
    missing = (needed | {"sha256"}) - description.keys()
    if missing:
        raise UsageError(f"{beside}: lacks {', '.join(sorted(missing))}; copy both files anew")
    found: dict[str, Any] = description
    return found


def read_state(path: Path, sha256: str | None, most_bytes: int) -> dict[str, Tensor]:
    """Return the tensors in a file by name, as float32, after comparing its SHA-256.

    sha256: its beginning is enough; None = not known.

    Raises:
        UsageError: it cannot be read, is too large, has another SHA-256, or holds anything but
            tensors of finite numbers by name.
    """
    data = _bytes(path, most_bytes)
    found = hashlib.sha256(data).hexdigest()
    if sha256 is not None and not found.startswith(sha256):
        raise UsageError(
            f"{path}: is not the file its JSON describes (SHA-256 {found[:12]}…, expected"
            f" {sha256[:12]}…), truncated or changed; copy both files anew"
        )
    try:
        state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError) as error:
        raise UsageError(
            f"{path}: holds something other than plain weights and was not loaded; give a file"
            " that `canopy train` wrote"
        ) from error
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise UsageError(
            f"{path}: is of another architecture: it holds no tensors by name; give weights of this"
            " segmenter"
        )
    widened = {str(name): _widened(value) for name, value in state.items()}
    for name, value in widened.items():
        if not value.isfinite().all():
            raise UsageError(
                f"{path}: {name} holds numbers that are none (infinite, or not numbers); train anew"
            )
    return widened


def _widened(value: Tensor) -> Tensor:
    return value.float() if value.is_floating_point() else value


def _bytes(path: Path, most_bytes: int) -> bytes:
    try:
        if path.stat().st_size > most_bytes:
            raise UsageError(f"{path}: is larger than {most_bytes >> 20} MiB; no such weights")
        return path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror}); check the path") from error


def require_fit(path: Path, wanted: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> None:
    """Refuse weights of another architecture, naming the first difference.

    Raises:
        UsageError: names or shapes differ.
    """
    for name in sorted(wanted.keys() | given.keys()):
        shapes = [tuple(one[name].shape) if name in one else None for one in (wanted, given)]
        if shapes[0] != shapes[1]:
            raise UsageError(
                f"{path}: is of another architecture: {name} is {shapes[1] or 'missing'}, expected"
                f" {shapes[0] or 'nothing'}; give weights of this segmenter"
            )
