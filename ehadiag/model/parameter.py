"""What a parameter of the identification is: a value with bounds, and what it does to the model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum

from ehadiag.core.channels import CHANNELS, Channels
from ehadiag.model.plant import PlantConstants, Value

__all__ = ["Changes", "Kind", "Parameter", "sized"]

Changes = Mapping[str, Value]
"""Fields of `PlantConstants` with the values that they take."""


class Kind(Enum):
    """What a parameter is to the diagnosis. The order is that in which they are applied."""

    DATUM = "datum"
    """By how much the unit differs from its actuator file, or a probe from the truth."""
    NUISANCE = "nuisance"
    """Of the installation or of the day: estimated so that it does not pass for a fault."""
    FAULT = "fault"
    """A progressive fault: a severity from 0, as new, to 1, limit of damage."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One scalar that can be estimated.

    Attributes
    ----------
    name : str
        Identifier in tables, files and reports.
    symbol : str
        As the specification writes it.
    unit : str
        SI.
    lower, upper : float
        Bounds.
    kind : Kind
    scale : float
        What is large: points of a search are in units of it, derivatives over a share of it.
    short, meaning : str
        In two words, and in a line.
    changes : callable
        (constants, value) -> the fields of the constants that it changes; pure, and for arrays too.
    adds_to : int or None
        Row of the residuals to which the parameter is simply added (a constant error of a sensor):
        its derivative is known. None: it acts through the model.
    sized_by : str or None
        Channel with whose range bounds and scale grow: they are given for the default range.
    """

    name: str
    symbol: str
    unit: str
    lower: float
    upper: float
    kind: Kind
    scale: float
    short: str
    meaning: str
    changes: Callable[[PlantConstants, Value], Changes]
    adds_to: int | None = None
    sized_by: str | None = None


def sized(item: Parameter, channels: Channels) -> Parameter:
    """Return a parameter with bounds and scale for converters of these ranges.

    Parameters
    ----------
    item : Parameter
        As the registry has it, or already sized, which is then returned as it is.
    channels : Channels
        Converters of the unit.

    Returns
    -------
    Parameter
        The same one where the range is the default one.
    """
    if item.sized_by is None:
        return item
    names = [channel.name for channel in CHANNELS]
    index = names.index(item.sized_by)
    ratio = channels[index].full_scale / CHANNELS[index].full_scale
    if ratio == 1.0:
        return item
    return replace(
        item,
        lower=item.lower * ratio,
        upper=item.upper * ratio,
        scale=item.scale * ratio,
        sized_by=None,
    )
