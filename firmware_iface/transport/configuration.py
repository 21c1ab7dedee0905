"""Reads which bus python-can's own configuration names: variables, files and their contexts."""

from __future__ import annotations

import configparser
import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ehadiag.core.errors import ConfigurationError
from firmware_iface.transport.adapters import OWN_OPTIONS, BusOptions, one_line

__all__ = ["configured", "configures_a_bus"]


def configures_a_bus() -> bool:
    """Tell whether python-can's variables or files name an interface.

    Returns
    -------
    bool
        Of the default context.

    Raises
    ------
    ConfigurationError
        They cannot be read.
    """
    return "interface" in _merged(None)


def configured(options: BusOptions, context: str | None) -> BusOptions:
    """Complete the options of a bus by python-can's configuration.

    What is given comes first, then `CAN_INTERFACE`, `CAN_CHANNEL`, `CAN_BITRATE` and `CAN_CONFIG`,
    each with `_CONTEXT` before the plain one, then the file's section of that name, then
    `[default]`: https://python-can.readthedocs.io/en/stable/configuration.html

    Parameters
    ----------
    options : BusOptions
        What was given; an empty interface: none.
    context : str | None
        Section of python-can's file, and end of its variables; None: the default one.

    Returns
    -------
    BusOptions
        With an interface.

    Raises
    ------
    ConfigurationError
        The configuration cannot be read, has nothing of that context, or names no interface.
    """
    import can.util  # noqa: PLC0415 - costs half a second

    if context is not None and not (_file(context) or _variables(context)):
        files = ", ".join(can.util.CONFIG_FILES)
        raise ConfigurationError(
            f"--context {context}: no section [{context}] in {files}, nor a variable"
            f" CAN_INTERFACE_{context}, CAN_CHANNEL_{context} or CAN_CONFIG_{context}"
        )
    # What only a plain variable said comes after the context's own ones.
    plain = {"interface": "CAN_INTERFACE", "channel": "CAN_CHANNEL"}
    given = {
        key: value
        for key in OWN_OPTIONS
        if (value := getattr(options, key)) and str(value) != os.environ.get(plain.get(key, ""))
    }
    given |= options.extra
    try:
        # Also makes one object of bit timings that are given by their parts.
        found = dict(can.util.load_config(config=given, context=context))
    except (ValueError, TypeError, configparser.Error, can.CanError) as error:
        raise ConfigurationError(f"python-can's configuration: {one_line(error)}") from None
    own = {key: found.pop(key) for key in OWN_OPTIONS & found.keys()}
    return replace(options, **_typed(own), extra=found)


def _typed(own: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a file, where all is text or number, as ours take them."""
    out = dict(own)
    if out.get("channel") is not None:
        out["channel"] = str(out["channel"])
    return out


def _merged(context: str | None) -> dict[str, Any]:
    return {**_file(None), **_file(context), **_variables(None), **_variables(context)}


def _file(context: str | None) -> dict[str, str]:
    import can.util  # noqa: PLC0415

    try:
        return can.util.load_file_config(section=context or "default")
    except (configparser.Error, UnicodeDecodeError) as error:
        raise ConfigurationError(f"python-can's configuration file: {one_line(error)}") from None


def _variables(context: str | None) -> dict[str, str]:
    import can.util  # noqa: PLC0415

    try:
        return dict(can.util.load_environment_config(context))
    except (ValueError, TypeError) as error:
        name = f"CAN_CONFIG_{context}" if context else "CAN_CONFIG"
        raise ConfigurationError(f"variable {name}: no JSON object: {one_line(error)}") from None
