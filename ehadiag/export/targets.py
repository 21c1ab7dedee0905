"""The computers for which libraries can be exported, by name."""

from __future__ import annotations

from dataclasses import dataclass

from ehadiag.compile.object_code import Processor
from ehadiag.core.errors import ConfigurationError

__all__ = ["TARGETS", "Target", "target"]


@dataclass(frozen=True, slots=True)
class Target:
    """A computer, for the compiler that is in numba and for that of the user.

    Attributes
    ----------
    name : str
        As the command line has it.
    meaning : str
        For people.
    processor : Processor
        For numba's compiler.
    flags : tuple[str, ...]
        Of GCC, with which what calls the library is compiled.
    """

    name: str
    meaning: str
    processor: Processor
    flags: tuple[str, ...] = ()


TARGETS: tuple[Target, ...] = (
    Target("host", "this computer", Processor("", "host", shared=True)),
    Target(
        "host-single",
        "this computer, results rounded to single precision as on cortex-m4-single",
        Processor("", "host", shared=True, single=True),
    ),
    Target(
        "cortex-m7",
        "Arm Cortex-M7 with double precision, bare",
        Processor("thumbv7em-none-eabihf", "cortex-m7"),
        ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-d16"),
    ),
    Target(
        "cortex-m4",
        "Arm Cortex-M4F, bare; doubles in software",
        Processor("thumbv7em-none-eabihf", "cortex-m4", rounds=False, doubles=False),
        ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"),
    ),
    Target(
        "cortex-m4-single",
        "Arm Cortex-M4F, bare; arithmetic in single precision",
        Processor("thumbv7em-none-eabihf", "cortex-m4", rounds=False, single=True),
        ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"),
    ),
    Target(
        "cortex-r5",
        "Arm Cortex-R5F, bare",
        Processor("armv7r-none-eabihf", "cortex-r5", rounds=False),
        ("-mcpu=cortex-r5", "-mfloat-abi=hard", "-mfpu=vfpv3-d16"),
    ),
    Target(
        "cortex-a53",
        "Arm Cortex-A53, 64 bits, Linux",
        Processor("aarch64-unknown-linux-gnu", "cortex-a53"),
        ("-mcpu=cortex-a53",),
    ),
    Target(
        "riscv64",
        "RISC-V RV64GC, Linux",
        Processor("riscv64-unknown-linux-gnu", "generic-rv64", "+m,+a,+f,+d,+c", "lp64d"),
        ("-march=rv64gc", "-mabi=lp64d"),
    ),
    Target(
        "powerpc-e500mc",
        "Freescale e500mc, 32 bits, big-endian, Linux",
        Processor("powerpc-unknown-linux-gnu", "e500mc", rounds=False),
        ("-mcpu=e500mc",),
    ),
)


def target(name: str) -> Target:
    """Return the target of that name.

    Parameters
    ----------
    name : str
        Of a target.

    Returns
    -------
    Target
        The target.

    Raises
    ------
    ConfigurationError
        There is none.
    """
    for item in TARGETS:
        if item.name == name:
            return item
    raise ConfigurationError(
        f"target {name!r}: need one of {', '.join(item.name for item in TARGETS)}"
    )
