"""Process that draws snapshots on the terminal: reads them as JSON lines, ends when they end.

It is a process of its own so that drawing takes nothing from the one that reads the bus.
"""

from __future__ import annotations

import io
import signal
import sys


def run_screen() -> int:
    """Draw each snapshot of standard input on standard error; the last one stays. Exit code 0."""
    # Ctrl-C is for the session: it ends, and with it what is read here.
    for name in ("SIGINT", "SIGHUP", "SIGTERM", "SIGBREAK"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    from rich.console import Console  # noqa: PLC0415
    from rich.live import Live  # noqa: PLC0415

    from ehadiag.live import Snapshot  # noqa: PLC0415
    from ehadiag.terminal.live_view import draw_snapshot  # noqa: PLC0415

    if isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr.reconfigure(errors="replace")
    console = Console(file=sys.stderr, highlight=False, markup=False, emoji=False)
    unicode = (console.encoding or "").lower().startswith("utf")
    try:
        with Live(console=console, auto_refresh=False, redirect_stderr=False) as live:
            for line in sys.stdin.buffer:
                snapshot = Snapshot.from_json(line)
                # The terminal shows `^C` at the end of the last line, which must not wrap.
                width = console.width - 2
                live.update(draw_snapshot(snapshot, width, unicode=unicode), refresh=True)
    except OSError:
        return 0  # the terminal has gone
    return 0


if __name__ == "__main__":
    raise SystemExit(run_screen())
