"""Who may ask, and who may command: host names against rebinding, origins, and a key.

None of it keeps anybody from stopping the arm.
"""

from dataclasses import dataclass, field
from ipaddress import ip_address
from secrets import compare_digest
from typing import Annotated
from urllib.parse import urlsplit

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from service.http.problems import Problem


@dataclass(frozen=True, kw_only=True, slots=True)
class Access:
    """Who is let in.

    names: what the service is called besides `localhost` and IP addresses, in lower case. key:
    what every command must bring along; None = nothing.
    """

    names: frozenset[str] = frozenset()
    key: str | None = field(default=None, repr=False)


async def _access(request: Request) -> Access:
    access: Access = request.app.state.access
    return access


Granted = Annotated[Access, Depends(_access)]
_bearer = HTTPBearer(auto_error=False, description="the rig's key, if it was given one")


async def refuse_unknown_names(request: Request, access: Granted) -> None:
    """Refuse requests to a name that is not ours: some page had its own name lead here.

    A browser lets such a page read and command what it reaches; it cannot make an IP address its
    name.
    """
    host = request.headers.get("host", "")
    name = (_name_in(host) or "").lower()
    if not (name == "localhost" or name in access.names or _is_address(name)):
        raise Problem(
            421,
            "unknown_host",
            "Not a name of this service",
            f"{host!r} is not a name of this service: ask by its IP address, or start it with"
            " --name and the name it is to be known by",
        )


async def refuse_foreign_pages(request: Request) -> None:
    """Refuse what a web page of another site makes a browser send: it must not move the arm."""
    origin = request.headers.get("origin")
    if origin is not None and urlsplit(origin).netloc != request.headers.get("host"):
        raise Problem(
            403, "foreign_origin", "Not from this page", f"{origin} may not command this rig"
        )


async def require_key(
    access: Granted, given: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]
) -> None:
    """Refuse who does not bring the rig's key, if it has one."""
    if access.key is None:
        return
    if given is None or not compare_digest(given.credentials.encode(), access.key.encode()):
        raise Problem(
            401,
            "key_required",
            "The rig's key is required",
            "send the header Authorization: Bearer KEY with the key that the service was started"
            " with" + ("" if given is None else "; this is another one"),
            headers={"WWW-Authenticate": "Bearer"},
        )


COMMAND = [Depends(refuse_foreign_pages), Depends(require_key)]


def _name_in(host: str) -> str | None:
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
