"""Files that only this user can have written: what is read from them may be run."""

from __future__ import annotations

import hmac
import os
import secrets
import stat
import tempfile
from functools import lru_cache
from pathlib import Path

from afm_rl.storage.files import write_whole


def write_signed(path: Path, data: bytes) -> None:
    """Write a file behind its signature, a keyed checksum of its name and content."""
    write_whole(path, _signature(path, data) + data)


def read_signed(path: Path) -> bytes | None:
    """Return what :func:`write_signed` wrote; None if that is not what is there.

    The bytes that were checked are those that are returned, so that nobody can change them in
    between.
    """
    if not path.is_file():
        return None
    content = path.read_bytes()
    signature, data = content[:32], content[32:]
    return data if hmac.compare_digest(signature, _signature(path, data)) else None


def _signature(path: Path, data: bytes) -> bytes:
    return hmac.digest(_key(), path.name.encode() + b"\0" + data, "sha256")


@lru_cache
def _key() -> bytes:
    """Return the key of this user, made when it is first needed; one of this process if it cannot.

    It is where the user keeps things, wherever settings let them be kept.
    """
    path = Path(os.environ.get("AFM_RL_CACHE", "~/.cache/afm_rl")).expanduser() / "key"
    try:
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            number, part = tempfile.mkstemp(dir=path.parent)  # for this user's eyes only
            with open(number, "wb") as file:
                file.write(secrets.token_bytes(32))
            os.replace(part, path)
        with open(path, "rb") as file:
            found = os.fstat(file.fileno())
            others = stat.S_IMODE(found.st_mode) & 0o077
            if os.name == "posix" and (found.st_uid != os.getuid() or others):
                raise PermissionError  # others may know it
            return file.read()
    except OSError:
        return secrets.token_bytes(32)
