"""The envelope of a view on the bus: what the worker must know, then the recorded messages.

Layout: MAGIC, the header's length (uint32, little endian), the header (JSON), the data of the
messages one after the other, bytes unchanged.
"""

import json
import struct
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, TypeVar

from canopy_skel.baselines.ftsem import FtsemConfig
from canopy_skel.canopy import canopy_config_from
from canopy_skel.cluster import ClusterConfig
from canopy_skel.errors import UsageError
from canopy_skel.initial import InitialConfig
from canopy_skel.likelihood import LikelihoodConfig
from canopy_skel.messages import Message, encode_json
from canopy_skel.pipeline import MethodConfig
from canopy_skel.spline import SplineConfig
from service.bus import BusError

_T = TypeVar("_T")
MAGIC = b"canopy-view/1\n"
_LENGTH = struct.Struct("<I")
_STAGES: Mapping[str, type[Any]] = {
    "cluster": ClusterConfig,
    "spline": SplineConfig,
    "likelihood": LikelihoodConfig,
    "initial": InitialConfig,
    "ftsem": FtsemConfig,
}


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewEnvelope:
    """One view of a scan, and how the scan is to be made into a skeleton."""

    scan_id: str
    view: int
    config: MethodConfig
    segmenter: str
    messages: tuple[Message, ...]


def encode_envelope(envelope: ViewEnvelope) -> bytes:
    """Return the bytes of an envelope; the same envelope gives the same bytes."""
    header = encode_json(
        {
            "scan_id": envelope.scan_id,
            "view": envelope.view,
            "segmenter": envelope.segmenter,
            "method": asdict(envelope.config),
            "config_sha256": envelope.config.sha256(),
            "messages": [
                [one.topic, one.stamp_ns, one.sequence, len(one.data)] for one in envelope.messages
            ],
        }
    )
    data = (one.data for one in envelope.messages)
    return b"".join((MAGIC, _LENGTH.pack(len(header)), header, *data))


def decode_envelope(data: bytes) -> ViewEnvelope:
    """Return the envelope that some bytes hold.

    Raises:
        BusError: they hold none, one of another version, or one whose parts do not fit together.
    """
    header, body = _split(data)
    try:
        envelope = ViewEnvelope(
            scan_id=_typed(header["scan_id"], str),
            view=_typed(header["view"], int),
            config=_config(header["method"]),
            segmenter=_typed(header["segmenter"], str),
            messages=_messages(header["messages"], body),
        )
        expected = _typed(header["config_sha256"], str)
    except KeyError as error:
        raise BusError(f"view envelope: its header has no {error}") from error
    except (TypeError, ValueError, UsageError) as error:
        raise BusError(f"view envelope: its header is wrong: {error}") from error
    if any(one.sequence != envelope.view for one in envelope.messages):
        raise BusError(f"view envelope: not all its messages are of view {envelope.view}")
    if envelope.config.sha256() != expected:
        raise BusError(
            "view envelope: the method's settings do not match their hash; run service and worker"
            " of one version"
        )
    return envelope


def _split(data: bytes) -> tuple[Mapping[str, Any], bytes]:
    """Return the header's fields, and the bytes after it."""
    name = MAGIC.split(b"/")[0]
    if not data.startswith(MAGIC):
        kind = "of another version" if data.startswith(name + b"/") else "not a view envelope"
        raise BusError(
            f"view envelope: {data[: len(MAGIC)]!r}… is {kind}; needed is {MAGIC!r}: run service"
            " and worker of one version"
        )
    start = len(MAGIC) + _LENGTH.size
    size = _LENGTH.unpack(data[len(MAGIC) : start])[0] if len(data) >= start else 0
    if len(data) < start + size or not size:
        raise BusError(f"view envelope: cut off after {len(data)} bytes, inside its header")
    try:
        header = json.loads(data[start : start + size])
    except ValueError as error:
        raise BusError(f"view envelope: its header is not JSON: {error}") from error
    if not isinstance(header, dict):
        raise BusError("view envelope: its header is not a JSON object")
    return header, data[start + size :]


def _messages(rows: list[list[Any]], body: bytes) -> tuple[Message, ...]:
    messages, start = [], 0
    for topic, stamp_ns, sequence, size in rows:
        end = start + _typed(size, int)
        if not start <= end <= len(body):
            raise BusError(
                f"view envelope: cut off, {topic} would end at byte {end} of {len(body)}"
            )
        messages.append(
            Message(
                topic=_typed(topic, str),
                stamp_ns=_typed(stamp_ns, int),
                sequence=_typed(sequence, int),
                data=body[start:end],
            )
        )
        start = end
    if start != len(body):
        raise BusError(f"view envelope: {len(body) - start} bytes too many behind its messages")
    return tuple(messages)


def _config(fields: Mapping[str, Any]) -> MethodConfig:
    stages = {name: stage(**fields[name]) for name, stage in _STAGES.items()}
    canopy = canopy_config_from(fields["canopy"])
    return MethodConfig(**{**fields, **stages, "canopy": canopy})


def _typed(value: object, kind: type[_T]) -> _T:
    if type(value) is not kind:
        raise TypeError(f"{value!r} is not {kind.__name__}")
    return value
