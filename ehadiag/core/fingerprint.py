"""Hash of what a configuration file says, whatever its comments and its order."""

from __future__ import annotations

import hashlib
from typing import Any

import msgspec

__all__ = ["fingerprint"]


def fingerprint(content: Any) -> str:
    """Return the SHA-256 of a structure's content, 64 hexadecimal digits.

    Parameters
    ----------
    content : Any
        An actuator, a stored test, the meaning of a bus: structures and data classes of plain
        values. Two files that say the same have the same hash.

    Returns
    -------
    str
        Hash of the content as JSON with sorted keys.
    """
    plain = msgspec.to_builtins(content, str_keys=True)
    return hashlib.sha256(msgspec.json.encode(plain, order="deterministic")).hexdigest()
