"""Writes an actuator's data as the file that `load_actuator` reads."""

from __future__ import annotations

from typing import Any

import msgspec
import tomli_w

from ehadiag.core.actuator import Actuator

__all__ = ["actuator_toml"]

HEAD = "# Written by `ehadiag calibrate`; SI units. Keys: docs/reference/actuator-file.md.\n"


def actuator_toml(actuator: Actuator) -> bytes:
    """Return an actuator as TOML, every number to its last digit.

    Parameters
    ----------
    actuator : Actuator
        The data.

    Returns
    -------
    bytes
        UTF-8.
    """
    tree: Any = msgspec.to_builtins(actuator)
    return (HEAD + tomli_w.dumps(_without_none(tree))).encode()


def _without_none(node: Any) -> Any:
    """Leave out what is not there: TOML has no word for it."""
    if isinstance(node, dict):
        return {key: _without_none(value) for key, value in node.items() if value is not None}
    if isinstance(node, list | tuple):
        return [_without_none(item) for item in node]
    return node
