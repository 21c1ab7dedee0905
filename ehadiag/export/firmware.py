"""The C side of the default bus, as an export carries it: frames, samples, and the node itself."""

from __future__ import annotations

from importlib import resources
from typing import Final

__all__ = ["SOURCES", "firmware"]

MODULES: Final = ("check", "frames", "link", "samples", "stored_tests", "node", "diagnosis")
GENERATED: Final = "eha_fcc"
SOURCES: Final = tuple(f"{name}.c" for name in (*MODULES, GENERATED))


def firmware() -> dict[str, bytes]:
    """Read sources and headers, for one folder without others in it.

    Returns
    -------
    dict[str, bytes]
        Their texts by name.
    """
    place = resources.files("firmware_iface").joinpath("c")
    files = {}
    for suffix in (".c", ".h"):
        for name in MODULES:
            text = place.joinpath(name + suffix).read_text("utf-8")
            files[name + suffix] = text.replace('"generated/', '"').encode()
        files[GENERATED + suffix] = place.joinpath("generated", GENERATED + suffix).read_bytes()
    return files
