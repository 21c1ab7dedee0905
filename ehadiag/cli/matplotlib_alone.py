"""Loads matplotlib without what others may have laid out for it."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator

__all__ = ["matplotlib_alone"]


@contextlib.contextmanager
def matplotlib_alone() -> Iterator[None]:
    """Load matplotlib without what others may have laid out for it.

    It reads `matplotlibrc` in the working folder, which may be anybody's, and keeps a list of fonts
    in a folder that need not be safe either.
    """
    import tempfile  # noqa: PLC0415

    from ehadiag.core.cache_folder import private_folder  # noqa: PLC0415

    if "matplotlib" in sys.modules:
        yield
        return
    with contextlib.ExitStack() as stack:
        own = private_folder("matplotlib")
        if own is None:
            place = stack.enter_context(tempfile.TemporaryDirectory(prefix="ehadiag-"))
        else:
            stack.enter_context(own)
            place = str(own.path)
        os.environ.setdefault("MPLCONFIGDIR", place)
        with contextlib.suppress(OSError):
            stack.enter_context(contextlib.chdir(place))
        yield
