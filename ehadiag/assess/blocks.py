"""What a model leaves unexplained, by the block of the actuator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.core.actuator import Actuator
from ehadiag.core.criteria import ESTIMATION
from ehadiag.identify.experiment import Experiment
from ehadiag.identify.least_squares import Refinement
from ehadiag.identify.prior import FAULT_OF_DATUM, severity_of_datum
from ehadiag.model.batch import PRESSURE_ROW, SPOOL_ROW
from ehadiag.model.residual_models import ModelResponse

BLOCKS = ("torque", "spool", "pressure", "jack")
"""Torque motor and first stage; spool with its friction; second stage; jack."""


class BlockRules(msgspec.Struct, frozen=True):
    """Which sample is of which block."""

    slew_share: float = 0.1
    """Least speed of a slewing spool, as a share of its stroke a tick, 1: it is the first stage
    that limits it, not friction."""
    jack_ticks: int = 20
    """Ticks over which the jack's travel is looked at, 1."""
    jack_lsb: float = 4.0
    """Least travel of a moving jack meanwhile, LSB."""


RULES = BlockRules()


def block_masks(experiments: Sequence[Experiment]) -> dict[str, NDArray[np.bool_]]:
    """Samples of each block, shape (2, N): rows of spool and pressure.

    Parameters
    ----------
    experiments : Sequence[Experiment]
        One behind the other.

    Returns
    -------
    dict[str, NDArray[np.bool_]]
        By the name of the block; each sample is of one.
    """
    slews, moves = [], []
    for item in experiments:
        speed = np.abs(np.gradient(np.nan_to_num(item.spool)))
        slews.append(speed > RULES.slew_share * item.constants.XSM)
        place = np.nan_to_num(item.position)
        ahead = np.roll(place, -RULES.jack_ticks // 2) - np.roll(place, RULES.jack_ticks // 2)
        moves.append(np.abs(ahead) > RULES.jack_lsb * item.channels.position.lsb)
    slew, move = np.concatenate(slews), np.concatenate(moves)
    out = {}
    for name, row, ticks in (
        ("torque", SPOOL_ROW, slew),
        ("spool", SPOOL_ROW, ~slew),
        ("pressure", PRESSURE_ROW, ~move),
        ("jack", PRESSURE_ROW, move),
    ):
        out[name] = np.zeros((2, len(ticks)), dtype=bool)
        out[name][row] = ticks
    return out


def unexplained_block(experiments: Sequence[Experiment], modelled: Sequence[ModelResponse]) -> str:
    """Name the block of which most is unexplained, by Cauchy's cost.

    Parameters
    ----------
    experiments : Sequence[Experiment]
        What was identified from.
    modelled : Sequence[ModelResponse]
        Their responses as identified.

    Returns
    -------
    str
        One of `BLOCKS`.
    """
    residuals = [
        [
            (item.spool - np.nanmedian(item.spool - model.spool) - model.spool) / item.spool_noise,
            (item.pressure - np.nanmedian(item.pressure - model.pressure) - model.pressure)
            / item.pressure_noise,
        ]
        for item, model in zip(experiments, modelled, strict=True)
    ]
    return block_with_most(experiments, np.concatenate(residuals, axis=1))


def block_with_most(experiments: Sequence[Experiment], residuals: Array) -> str:
    """Name the block with most of the residuals, by Cauchy's cost.

    residuals: of spool and pressure of all experiments, one behind the other, in deviations of the
    noise, shape (2, N). Returns one of `BLOCKS`.
    """
    costs = np.log1p((np.nan_to_num(residuals) / ESTIMATION.cauchy_scale) ** 2)
    masks = block_masks(experiments)
    return max(BLOCKS, key=lambda name: float(costs[masks[name]].sum()))


def pulls_of_blocks(
    experiments: Sequence[Experiment], refined: Refinement, actuator: Actuator
) -> dict[str, dict[str, float]]:
    """What the residuals of each block alone would move the severities by.

    At the optimum the pulls of all blocks cancel; a block with a pull is one that the others, or
    what was known, hold against: by so much a severity may be wrong if the block is.

    Parameters
    ----------
    experiments : Sequence[Experiment]
        What was learned from.
    refined : Refinement
        The optimum, with data that pass for severities free.
    actuator : Actuator
        Of the unit's type, for the scales of the severities.

    Returns
    -------
    dict[str, dict[str, float]]
        By block, then by severity.
    """
    shares = severity_of_datum(actuator)
    names = [item.name for item in refined.parameters]
    inverse = np.linalg.pinv(
        refined.normal + (refined.information if refined.information is not None else 0.0),
        hermitian=True,
    )
    out: dict[str, dict[str, float]] = {}
    for block, mask in block_masks(experiments).items():
        used = refined.used & mask[: len(refined.used)]
        step = -inverse @ (refined.jacobian[:, used] @ refined.residuals[used]) * refined.scale
        out[block] = {
            FAULT_OF_DATUM[symbol]: float(
                # Friction of the spool that grows does what a smaller flow gain of it does.
                step[names.index(f"datum_{symbol}")] * share * (-1.0 if symbol == "GQF" else 1.0)
            )
            for symbol, share in shares.items()
            if f"datum_{symbol}" in names
        }
    return out


def words_of_pulls(pulls: Mapping[str, Mapping[str, float]]) -> str:
    """Say in a line what the blocks would move the severities by."""
    parts = (
        f"{block} " + ", ".join(f"{name} {value:+.4f}" for name, value in of_block.items())
        for block, of_block in pulls.items()
    )
    return "not explained, in severities: " + "; ".join(parts)
