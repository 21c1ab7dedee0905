"""What many results come to: counts, the worst units, what failed and why."""

from __future__ import annotations

import json
import time
from collections import Counter
from typing import Any

from ehadiag.cli.batch.sinks import whole_file
from ehadiag.cli.exit_codes import FAILED, worst_code
from ehadiag.core.printable import printable
from ehadiag.report.origin import package

__all__ = ["FAILED", "Summary", "summary_lines", "worst_code", "write_summary"]

SCHEMA = "ehadiag.summary/1"
MOST_NAMED = 100
"""Failures that are kept with their reasons."""
MOST_WORST = 10


class Summary:
    """Takes each result, and keeps what is told at the end; of a size that does not grow.

    Parameters
    ----------
    inputs : int
        Recordings that were named.
    """

    def __init__(self, inputs: int) -> None:
        self._inputs = inputs
        self._begin = time.perf_counter()
        self._verdicts: Counter[str] = Counter()
        self._failures: list[dict[str, str]] = []
        self._failed = 0
        self._not_tested: list[dict[str, Any]] = []
        self._worst: dict[object, dict[str, Any]] = {}
        self.reused = 0
        """Results that an earlier call had found."""
        self.left = 0
        """Recordings that were not come to."""
        self.codes: set[int] = set()
        """Exit codes that came."""

    def take(self, tree: dict[str, Any]) -> None:
        """Count a result, `ehadiag.diagnosis/2`."""
        if tree["error"] is not None:
            self._failed += 1
            if len(self._failures) < MOST_NAMED:
                error = {"source": tree["source"], "error": tree["error"]["text"]}
                self._failures.append(error)
            return
        self._verdicts[tree["verdict"]] += 1
        if tree["verdict"] == "NOT_TESTED":
            if len(self._not_tested) < MOST_NAMED:
                reasons = {"source": tree["source"], "reasons": tree["reasons"]}
                self._not_tested.append(reasons)
            return
        self._rank(tree)

    def _rank(self, tree: dict[str, Any]) -> None:
        """Keep it if it is among the worst units; of one unit the worst result."""
        estimates = {key: item["estimate"] for key, item in tree["faults"].items()}
        known = {key: value for key, value in estimates.items() if value is not None}
        if not known:
            return
        fault = max(known, key=lambda key: known[key])
        unit = ("serial", tree["serial"]) if tree["serial"] is not None else tree["source"]
        before = self._worst.get(unit)
        if before is None or before["estimate"] < known[fault]:
            self._worst[unit] = {
                "serial": tree["serial"],
                "source": tree["source"],
                "verdict": tree["verdict"],
                "fault": fault,
                "estimate": known[fault],
                "interval95": tree["faults"][fault]["interval95"],
            }
        if len(self._worst) > MOST_WORST:
            del self._worst[min(self._worst, key=lambda key: self._worst[key]["estimate"])]

    def tree(self, exit_code: int, workers: int) -> dict[str, Any]:
        """Return the object `ehadiag.summary/1`."""
        elapsed = time.perf_counter() - self._begin
        done = sum(self._verdicts.values()) + self._failed - self.reused
        names = ("HEALTHY", "DEGRADED", "FAULT", "NOT_TESTED")
        worst = sorted(self._worst.values(), key=lambda item: -item["estimate"])
        return {
            "schema": SCHEMA,
            "inputs": self._inputs,
            "verdicts": {name: self._verdicts[name] for name in names},
            "failed": self._failed,
            "reused": self.reused,
            "not_diagnosed": self.left,
            "worst": worst,
            "failures": self._failures,
            "not_tested": self._not_tested,
            "workers": workers,
            "elapsed_s": round(elapsed, 3),
            "rate_per_s": round(done / elapsed, 3) if elapsed > 0 else None,
            "exit_code": exit_code,
            "package": package(),
        }


def write_summary(tree: dict[str, Any], name: str) -> None:
    """Write the object to a file; InputOutputError where that fails."""
    with whole_file(name, "summary") as file:
        file.write(json.dumps(tree, indent=2, allow_nan=False).encode() + b"\n")


def summary_lines(tree: dict[str, Any]) -> list[str]:
    """Return the summary for people."""
    verdicts = ", ".join(
        f"{count} {name.replace('_', ' ')}" for name, count in tree["verdicts"].items() if count
    )
    failed = f", {tree['failed']} not readable" if tree["failed"] else ""
    reused = f", {tree['reused']} of them from an earlier call" if tree["reused"] else ""
    lines = [
        f"{tree['inputs']} recordings in {tree['elapsed_s']:.1f} s ({tree['rate_per_s']:.1f}/s): "
        f"{verdicts or 'none diagnosed'}{failed}{reused}"
    ]
    if tree["not_diagnosed"]:
        lines.append(f"not diagnosed: {tree['not_diagnosed']}")
    for item in tree["worst"]:
        if item["verdict"] in ("FAULT", "DEGRADED"):
            unit = "" if item["serial"] is None else f"serial {item['serial']}: "
            lines.append(
                f"{item['verdict']} {unit}{item['fault']} {item['estimate']:.3f}  {item['source']}"
            )
    lines += [f"NOT TESTED {item['source']}: {'; '.join(item['reasons'])}"
              for item in tree["not_tested"][:MOST_WORST]]  # fmt: skip
    lines += [f"not readable: {item['error']}" for item in tree["failures"][:MOST_WORST]]
    return [printable(line) for line in lines]
