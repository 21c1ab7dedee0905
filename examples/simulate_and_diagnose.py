"""How well can wear be told in hot oil? Simulate a worn actuator, diagnose it, compare.

python examples/simulate_and_diagnose.py
"""

from typing import Any

import ehadiag

truth: dict[str, Any] = {"Kintas": 0.2, "FSS": 0.5, "FDJ": 0.4}

for temperature in (20.0, 40.0, 80.0):
    recording = ehadiag.simulate("closed", **truth, oil_temperature=temperature, seed=1)
    result = ehadiag.diagnose(recording)
    worst = max(abs(fault.value - truth[name]) for name, fault in result.faults.items())
    print(f"{temperature:.0f} degC: {result.verdict}, largest error {worst:.4f}")
