"""Diagnose each log that is named: verdict, faults with their 95 % intervals, and a picture.

python examples/diagnose_log.py LOG...
"""

import sys
from pathlib import Path

import ehadiag

for name in sys.argv[1:]:
    try:
        result = ehadiag.diagnose(name)
    except ehadiag.EhadiagError as error:  # one line: what is wrong, where, how to mend it
        print(error)
        continue
    print(f"{Path(name).name}: {result.verdict}", *result.reasons, sep="\n  ")
    for fault in result.faults.values():
        low, high = fault.interval
        print(f"  {fault.name} {fault.value:.4f} ({low:.4f} … {high:.4f}), {fault.meaning}")
    if result.identified:
        picture = Path(name).with_suffix(".png").name
        result.plot().savefig(picture)
        print(f"  see {picture}")
