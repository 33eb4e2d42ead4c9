"""The key of a rig: a secret in a file, known to the service and to those who may command it."""

from ipaddress import ip_address
from pathlib import Path

from canopy_skel.errors import UsageError

FEWEST_CHARACTERS = 16


def read_key(path: Path) -> str:
    """Return the key in a file, without the space around it.

    Raises:
        UsageError: there is no such file, or what it holds cannot be a key.
    """
    try:
        key = path.read_text(encoding="ascii").strip()
    except OSError as error:
        raise UsageError(
            f"no key file {path} ({error.strerror}); make one: {_make(path)}"
        ) from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{path} holds no key; make one: {_make(path)}") from error
    if len(key) < FEWEST_CHARACTERS or not key.isprintable() or " " in key:
        raise UsageError(
            f"{path} holds no key: one word of at least {FEWEST_CHARACTERS} characters;"
            f" make one: {_make(path)}"
        )
    return key


def reaches_others(host: str) -> bool:
    """Say whether a service that listens there can be reached from other machines."""
    try:
        return not ip_address(host).is_loopback
    except ValueError:
        return host != "localhost"


def _make(path: Path) -> str:
    return f"(umask 077; openssl rand -hex 32 > {path})"
