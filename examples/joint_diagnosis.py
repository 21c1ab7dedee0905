"""What a second test adds: one estimate from an open-loop and a closed-loop test together.

python examples/joint_diagnosis.py OPEN CLOSED
"""

import sys

import ehadiag

paths = sys.argv[1:]
recordings = [recording for path in paths for recording in ehadiag.read(path)]
each = [ehadiag.diagnose(recording) for recording in recordings]
joint = ehadiag.diagnose(recordings)

print(f"{'':8}" + "".join(f"{result.test:>19}" for result in [*each, joint]))
for name in joint.faults:
    faults = [result.faults[name] for result in [*each, joint]]
    print(f"{name:8}" + "".join(f"{f.value:9.4f} ± {f.std:.5f}" for f in faults))
