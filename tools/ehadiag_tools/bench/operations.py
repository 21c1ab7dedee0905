"""Counts the vector kernel's arithmetic by running it uncompiled on numbers that count.

As a script, with NUMBA_DISABLE_JIT=1: reads a list of jobs, pickled, from stdin and prints the
counts as JSON.
"""

from __future__ import annotations

import json
import operator
import os
import pickle
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.search.objective import SEARCH_CAP
from ehadiag.model.batch import Batch
from ehadiag.model.simd.residuals import Scratch, block_costs, scratch_for

__all__ = ["Job", "Operations", "Tally", "count_operations", "counting"]

ARITHMETIC = ("add", "subtract", "multiply", "divide")
COUNTED = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "truediv": operator.truediv,
}
NOT_COUNTED = ("lt", "le", "gt", "ge", "eq", "ne")


@dataclass(frozen=True, slots=True)
class Operations:
    """Of all candidates together; a sum, a product and a division count one each.

    Attributes
    ----------
    vector: in vectors, divisions among them.
    divisions: in vectors.
    choices: comparisons, choices, minima and magnitudes in vectors; not among the others.
    scalar: one by one, divisions among them.
    """

    vector: int
    divisions: int
    choices: int
    scalar: int

    @property
    def arithmetic(self) -> int:
        """All that are counted as operations."""
        return self.vector + self.scalar


Job = tuple[Batch, NDArray[np.int64], NDArray[np.float64]]
"""Recordings, the jack's steps in them (`SimdModel.levels`), and candidates."""


def count_operations(jobs: Sequence[Job]) -> list[Operations]:
    """Operations of `block_costs` for each job as its source says, but for those of its tables.

    The compiler may find a few of them twice. Runs in a process of its own.
    """
    done = subprocess.run(
        [sys.executable, "-m", __name__],
        env={
            **os.environ,
            "NUMBA_DISABLE_JIT": "1",
            "PYTHONPATH": os.pathsep.join(item for item in sys.path if item),
        },
        input=pickle.dumps(list(jobs)),
        capture_output=True,
        check=True,
    )
    return [Operations(**item) for item in json.loads(done.stdout)]


class Tally:
    """What arrays and numbers count into."""

    def __init__(self) -> None:
        self.vector = self.divisions = self.choices = self.scalar = 0

    def add_vector(self, name: str, size: int) -> None:
        """Count a function of vectors."""
        if name in ARITHMETIC:
            self.vector += size
            self.divisions += size * (name == "divide")
        else:
            self.choices += size

    def result(self) -> Operations:
        """Return the counts."""
        return Operations(self.vector, self.divisions, self.choices, self.scalar)


def counting(tally: Tally) -> type[np.ndarray]:
    """Kind of array that counts what is done with it, and with its single elements."""

    class Number(float):
        # numpy leaves an operation with one of its numbers to the methods here.
        __array_ufunc__ = None

    def method(function: Any, count: int, *, turned: bool = False) -> Any:
        def operation(self: float, other: Any) -> Any:
            other = float(other) if isinstance(other, Number) else other
            result = function(other, float(self)) if turned else function(float(self), other)
            if isinstance(result, np.ndarray):
                return result  # the array has counted it
            tally.scalar += count
            return Number(result) if count else result

        return operation

    for name, function in COUNTED.items():
        setattr(Number, f"__{name}__", method(function, 1))
        setattr(Number, f"__r{name}__", method(function, 1, turned=True))
    for name in NOT_COUNTED:
        setattr(Number, f"__{name}__", method(getattr(operator, name), 0))
    for name in ("neg", "abs"):
        function = getattr(operator, name)
        setattr(Number, f"__{name}__", lambda self, f=function: Number(f(float(self))))

    class Counted(np.ndarray):
        def __getitem__(self, key: Any) -> Any:
            found = super().__getitem__(key)
            return found if isinstance(found, np.ndarray) else Number(found)

        def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
            return wrapped(
                ufunc.__name__, getattr(ufunc, method)(*map(plain_of, inputs), **options)
            )

        def __array_function__(self, function: Any, _kinds: Any, inputs: Any, options: Any) -> Any:
            return wrapped(function.__name__, function(*map(plain_of, inputs), **options))

    def plain_of(item: Any) -> Any:
        if isinstance(item, list):
            return [plain_of(part) for part in item]
        return item.view(np.ndarray) if isinstance(item, Counted) else item

    def wrapped(name: str, result: Any) -> Any:
        if not isinstance(result, np.ndarray):
            return result
        tally.add_vector(name, result.size)
        return result.view(Counted)

    return Counted


def main() -> None:
    """Count what stdin asks for."""
    found = []
    for batch, levels, candidates in pickle.load(sys.stdin.buffer):
        tally = Tally()
        kind = counting(tally)
        work = scratch_for(levels)
        own = Scratch._make(a.view(kind) if a.dtype == np.float64 else a for a in work)
        block_costs(batch, candidates, SEARCH_CAP, own, np.empty(len(candidates)))
        found.append(asdict(tally.result()))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
