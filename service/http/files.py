"""Open files as responses.

The framework's own takes the length first and then sends all it finds under the name: too much of
a file that has grown since, which breaks the answer off, and nothing of one that was renamed.
"""

import os
from collections.abc import Iterator
from typing import BinaryIO

from fastapi import Response
from fastapi.responses import StreamingResponse

from service.http.negotiation import byte_range
from service.http.problems import Problem

_PIECE = 1 << 18


def file_response(
    stream: BinaryIO, name: str, media_type: str, *, asked: str = "", if_range: str = ""
) -> Response:
    """Return what is in a file now, under the name to save it by; closes the file.

    asked, if_range: the headers `Range` and `If-Range`.

    Raises:
        Problem: none of the bytes asked for are there.
    """
    found = os.fstat(stream.fileno())
    etag = f'"{found.st_ino:x}-{found.st_size:x}-{found.st_mtime_ns:x}"'
    wanted = byte_range(asked, found.st_size) if if_range in ("", etag) else None
    headers = {
        "Accept-Ranges": "bytes",
        "Cache-Control": "no-cache",
        "Content-Disposition": f'attachment; filename="{name}"',
        "ETag": etag,
    }
    if wanted is None:
        return _pieces(stream, range(found.st_size), media_type, headers, 200)
    if not wanted:
        stream.close()
        raise _not_there(found.st_size)
    headers["Content-Range"] = f"bytes {wanted.start}-{wanted.stop - 1}/{found.st_size}"
    return _pieces(stream, wanted, media_type, headers, 206)


def _pieces(
    stream: BinaryIO, wanted: range, media_type: str, headers: dict[str, str], status: int
) -> Response:
    headers["Content-Length"] = str(len(wanted))
    return StreamingResponse(_read(stream, wanted), status, headers, media_type)


def _read(stream: BinaryIO, wanted: range) -> Iterator[bytes]:
    with stream:
        stream.seek(wanted.start)
        left = len(wanted)
        while left and (piece := stream.read(min(left, _PIECE))):
            left -= len(piece)
            yield piece


def _not_there(size: int) -> Problem:
    title = "No such range"
    detail = f"the file has {size} bytes; ask for some of them"
    headers = {"Content-Range": f"bytes */{size}"}
    return Problem(416, "range_not_satisfiable", title, detail, headers=headers)
