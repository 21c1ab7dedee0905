"""What the flight-control computer has found itself, beside what was found here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ehadiag.assess.verdict import Verdict

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.core.recording import OnboardResult

__all__ = ["alone", "in_words", "onboard_tree"]


def onboard_tree(found: OnboardResult | None) -> dict[str, Any] | None:
    """Part `onboard` of a recording in the JSON object; None where the computer did not say."""
    if found is None:
        return None
    return {
        "verdict": _verdict(found),
        "test_id": found.test_id,
        "evaluations": found.runs,
        "faults": {
            name: {"estimate": value, "std": found.std[name]}
            for name, value in found.severities.items()
        },
    }


def alone(diagnosis: Diagnosis) -> OnboardResult | None:
    """Return what the computer found in the one recording of a diagnosis; None of several."""
    return diagnosis.recordings[0].onboard if len(diagnosis.recordings) == 1 else None


def in_words(found: OnboardResult, own: dict[str, float]) -> str:
    """Return a line on what the computer found.

    Parameters
    ----------
    found : OnboardResult
        What it says.
    own : dict[str, float]
        Severities that were estimated here; empty where none were.

    Returns
    -------
    str
        The line.
    """
    parts = [f"on board: {(_verdict(found) or 'no verdict').replace('_', ' ')}"]
    parts += [
        f"{key} {value:.7f} ± {found.std[key]:.7f}" for key, value in found.severities.items()
    ]
    if found.runs is not None:
        parts.append(f"{found.runs} model runs")
    apart = [
        abs(value - own[key]) / found.std[key]
        for key, value in found.severities.items()
        if key in own and found.std[key] > 0.0
    ]
    if apart:
        parts.append(f"at most {max(apart):.2f} of its deviations from what was found here")
    return ", ".join(parts)


def _verdict(found: OnboardResult) -> str | None:
    """Name of the verdict; a number that is none is shown as it is."""
    if found.verdict is None:
        return None
    known = {int(item): item.name for item in Verdict}
    return known.get(found.verdict, str(found.verdict))
