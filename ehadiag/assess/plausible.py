"""Whether an actuator file can be of an actuator at all: ratios that no built one is far from.

Each value of a file may be in its range, and the whole be none: the model then is so stiff, or so
slow, that an identification takes minutes to explain nothing.
"""

from __future__ import annotations

from ehadiag.core.actuator import Actuator

__all__ = ["objections_to_actuator"]

REACH = 30.0
"""Factor by which a ratio may be off what is usual."""


def objections_to_actuator(actuator: Actuator) -> list[str]:
    """Why an actuator file cannot be right, with the data to look at; empty if it can."""
    controller, valve, jack = actuator.controller, actuator.servovalve, actuator.jack
    slew = valve.GQF * valve.XFM / valve.AS
    speed = valve.GQ * valve.XSM / jack.AJ
    force = valve.GPF * valve.XFM * valve.AS
    ratios = (
        ("spool travel at rated current over spool stop", "GM, IM, KSF, XSM",
         valve.GM * controller.IM / valve.KSF / valve.XSM, 1.0),
        ("flapper travel at rated current over flapper stop", "GM, IM, KF, XFM",
         valve.GM * controller.IM / valve.KF / valve.XFM, 2.0),
        ("spool travel in 1 s over spool stop", "GQF, XFM, AS, XSM", slew / valve.XSM, 500.0),
        ("first stage's force over spool friction at the limit", "GPF, XFM, AS, FSS1",
         force / valve.FSS1, 5.0),
        ("spool acceleration by the first stage over that in 0.1 ms", "GPF, XFM, AS, MS, GQF",
         force / valve.MS / (slew / 1e-4), 20.0),
        ("pressure at the spool's stop over supply", "GP, XSM, PSR",
         valve.GP * valve.XSM / valve.PSR, 40.0),
        ("jack travel in 1 s over jack stop", "GQ, XSM, AJ, XJM", speed / jack.XJM, 3.0),
        ("jack force over jack friction at the limit", "PSR, AJ, FDJ1",
         valve.PSR * jack.AJ / jack.FDJ1, 10.0),
        ("jack acceleration by the supply over that in 10 ms", "PSR, AJ, MJ, GQ, XSM",
         valve.PSR * jack.AJ / jack.MJ / (speed / 1e-2), 15.0),
    )  # fmt: skip
    return [
        f"actuator file: {what} is {ratio:.2g}, usual is {usual:g}: check {data}"
        for what, data, ratio, usual in ratios
        if not usual / REACH <= ratio <= usual * REACH
    ]
