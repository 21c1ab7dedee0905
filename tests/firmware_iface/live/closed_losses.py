"""Measures what lost frames cost the closed-loop test; prints rows for the page on bus faults.

python tests/firmware_iface/live/closed_losses.py 20

The limit on guessed positions (`ehadiag.core.criteria.LOSSES`) is lifted here, so
that the table shows what it keeps out.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np
from fault_cases import Case, run
from msgspec.structs import replace

from ehadiag import Recording, Verdict, bundled_tests, default_actuator
from ehadiag.assess import diagnosis, lost_samples
from ehadiag.core.criteria import LOSSES as LOSSES_BORNE
from ehadiag_sim.conditions import Faults
from firmware_iface.alignment.align import assemble
from firmware_iface.bus_map import default_map
from firmware_iface.transport.frames import Frame, FrameTable

PAPER = ((0.3, 0.3, 0.3), (0.3, 0.6, 0.3), (0.6, 0.6, 0.3), (0.6, 0.6, 0.6))
STATUS, COMMAND = 0x201, 0x111
LOSSES = (0.01, 0.02, 0.05, 0.10, 0.12, 0.15, 0.20)
HOLES = ((1, 100), (1, 200), (20, 5), (40, 5), (10, 20))
"""How many, and how long, ms."""


@dataclass(frozen=True)
class Outcome:
    """One damaged run: share of guessed ticks, deviations in the standard deviation told."""

    guessed: float
    tested: bool
    same: bool
    off_sound: float
    off_truth: float


def lossy(frames: list[Frame], share: float, rng: np.random.Generator) -> list[Frame]:
    """Frames of which a share is lost, the computer's status apart."""
    return [item for item in frames if item.can_id == STATUS or rng.random() >= share]


def holed(frames: list[Frame], count: int, length: int, rng: np.random.Generator) -> list[Frame]:
    """Frames with dropouts of some ms anywhere in the test."""
    begun = next(item.time_ns for item in frames if item.can_id == COMMAND and item.data[5])
    first = rng.integers(300, 5400 - length, count)
    gone = {tick for item in first.tolist() for tick in range(item, item + length)}
    return [
        item
        for item in frames
        if item.can_id == STATUS or (item.time_ns - begun) // 1_000_000 not in gone
    ]


def diagnosed(recording: Recording) -> diagnosis.Diagnosis:
    return diagnosis.diagnose([recording], default_actuator(), bundled_tests().values())


def compared(frames: list[Frame], sound: diagnosis.Diagnosis, truth: tuple[float, ...]) -> Outcome:
    came = diagnosed(assemble(FrameTable.from_frames(frames), default_map(), "lossy")[-1])
    if sound.identification is None:
        raise AssertionError("; ".join(sound.reasons))
    if came.identification is None:
        return Outcome(float("nan"), False, False, 0.0, 0.0)
    ours, whole = came.identification.estimates, sound.identification.estimates
    return Outcome(
        guessed=came.experiments[0].trace.guessed,
        tested=came.verdict is not Verdict.NOT_TESTED,
        same=came.verdict is sound.verdict,
        off_sound=max(abs(a.value - b.value) / a.std for a, b in zip(ours, whole, strict=True)),
        off_truth=max(abs(a.value - b) / a.std for a, b in zip(ours, truth, strict=True)),
    )


def row(name: str, outcomes: list[Outcome]) -> str:
    tested = [item for item in outcomes if item.tested]
    guessed = np.array([item.guessed for item in outcomes])
    refused = int((guessed > LIMIT).sum())
    low, high = (f"{100 * pick(guessed):.1f}" for pick in (np.nanmin, np.nanmax))
    told = [max(getattr(o, key) for o in tested) for key in ("off_sound", "off_truth")]
    wrong = sum(not item.same for item in tested)
    return (
        f"| {name} | {low} … {high} % | {len(tested)} of {len(outcomes)}, {wrong} wrong "
        f"| {told[0]:.1f} | {told[1]:.1f} | {refused} of {len(outcomes)} |"
    )


LIMIT = LOSSES_BORNE.max_guessed_share


def main(seeds: int) -> None:
    lost_samples.LOSSES = replace(LOSSES_BORNE, max_guessed_share=1.0)
    found: dict[str, list[Outcome]] = {}
    for seed in range(seeds):
        truth = PAPER[seed % len(PAPER)]
        case = Case("sound", core={"faults": Faults(*truth), "seed": seed})
        clean = run(case, test=bundled_tests()["closed"])
        sound = diagnosed(clean.recording)
        for share in LOSSES:
            rng = np.random.default_rng((seed, int(1000 * share)))
            frames = lossy(clean.frames, share, rng)
            name = f"loss of {100 * share:g} %"
            found.setdefault(name, []).append(compared(frames, sound, truth))
        for count, length in HOLES:
            rng = np.random.default_rng((seed, count, length))
            frames = holed(clean.frames, count, length, rng)
            name = f"{count} dropout{'s' * (count > 1)} of {length} ms"
            found.setdefault(name, []).append(compared(frames, sound, truth))
    for name, outcomes in found.items():
        print(row(name, outcomes))


if __name__ == "__main__":
    main(int(sys.argv[1]))
