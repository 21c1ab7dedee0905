"""`modelDescription.xml` of a co-simulation unit, FMI 2.0 and FMI 3.0."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata

__all__ = ["Variable", "description"]

SAME = {"2.0": "2.0", "3.0": "3.0"}


@dataclass(frozen=True, slots=True)
class Variable:
    """A number that a unit shows to its master.

    Attributes
    ----------
    name : str
        Its name.
    causality : str
        "parameter", "input" or "output".
    start : float
        Before anything is set.
    meaning : str
        With the unit of measure, for people.
    """

    name: str
    causality: str
    start: float
    meaning: str


def description(
    version: str, model: str, token: str, tick: float, meaning: str, variables: Sequence[Variable]
) -> bytes:
    """Describe a unit whose variables have their places as value references.

    Parameters
    ----------
    version : str
        "2.0" or "3.0".
    model : str
        Identifier, the name of the shared library.
    token : str
        That a master must show to make an instance.
    tick : float
        s, the internal step.
    meaning : str
        One line for people.
    variables : Sequence[Variable]
        Parameters, then inputs, then outputs.

    Returns
    -------
    bytes
        XML.
    """
    three = version == "3.0"
    root = ET.Element(
        "fmiModelDescription",
        {
            "fmiVersion": version,
            "modelName": model,
            "instantiationToken" if three else "guid": token,
            "description": meaning,
            "generationTool": f"ehadiag {metadata.version('ehadiag')}",
            "variableNamingConvention": "flat",
        },
    )
    co = {"modelIdentifier": model, "canHandleVariableCommunicationStepSize": "true"}
    if three:
        co["fixedInternalStepSize"] = repr(tick)
    ET.SubElement(root, "CoSimulation", co)
    ET.SubElement(root, "DefaultExperiment", {"startTime": "0", "stepSize": repr(tick)})
    listed = ET.SubElement(root, "ModelVariables")
    if three:
        ET.SubElement(
            listed,
            "Float64",
            {
                "name": "time",
                "valueReference": str(len(variables)),
                "causality": "independent",
                "variability": "continuous",
            },
        )
    for place, item in enumerate(variables):
        said = {
            "name": item.name,
            "valueReference": str(place),
            "causality": item.causality,
            "variability": "fixed" if item.causality == "parameter" else "discrete",
            "description": item.meaning,
        }
        start = {"start": repr(float(item.start))}
        if item.causality == "output":
            said["initial"] = "exact"
        if three:
            ET.SubElement(listed, "Float64", {**said, **start})
        else:
            ET.SubElement(ET.SubElement(listed, "ScalarVariable", said), "Real", start)
    structure = ET.SubElement(root, "ModelStructure")
    outputs = [n for n, item in enumerate(variables) if item.causality == "output"]
    if three:
        for place in outputs:
            ET.SubElement(structure, "Output", {"valueReference": str(place)})
    else:
        group = ET.SubElement(structure, "Outputs")
        for place in outputs:
            ET.SubElement(group, "Unknown", {"index": str(place + 1)})
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True)
