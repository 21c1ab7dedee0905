"""What a model leaves unexplained, by the block of the actuator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.core.actuator import Actuator
from ehadiag.core.criteria import ESTIMATION, RESPONSE
from ehadiag.identify.experiment import Experiment
from ehadiag.identify.least_squares import Refinement
from ehadiag.identify.prior import FAULT_OF_DATUM, severity_of_datum
from ehadiag.model.batch import PRESSURE_ROW, SPOOL_ROW
from ehadiag.model.residual_models import ModelResponse
from ehadiag.model.severities import FAULT_LAWS

BLOCKS = ("torque", "spool", "pressure", "jack")
"""Torque motor and first stage; spool with its friction; second stage; jack."""


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
        new, filter_law = item.constants, FAULT_LAWS["Kintas"]
        # With a filter at its limit the first stage still moves the spool so fast.
        slewing = (1.0 + filter_law.change) * new.GQF * new.XFM / new.AS
        speed = np.abs(np.gradient(np.nan_to_num(item.spool), item.tick))
        slews.append(speed > slewing)
        place, half = np.nan_to_num(item.position), round(0.5 * RESPONSE.travel_span_s / item.tick)
        ahead = np.roll(place, -half) - np.roll(place, half)
        moves.append(np.abs(ahead) > RESPONSE.max_still_lsb * item.channels.position.lsb)
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
