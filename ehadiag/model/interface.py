"""What an identification needs of a model: the seam between solvers and kernels.

Solvers see costs of points, the refinement sees residuals. A back end in another language, or
another second stage, implements this protocol in one module.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ehadiag.model.batch import Batch
from ehadiag.model.parameters import Unknowns

__all__ = ["ResidualModel"]


class ResidualModel(Protocol):
    """A model that explains recorded tests, for points in the space of the unknowns.

    All numbers of one model come from one kernel: costs are compared with costs of the same model
    only.
    """

    @property
    def batch(self) -> Batch:
        """What is to be explained."""
        ...

    @property
    def unknowns(self) -> Unknowns:
        """What points are."""
        ...

    @property
    def evaluations(self) -> int:
        """Points that were evaluated so far."""
        ...

    def residuals(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Weighted residuals, measured less modelled, and how often the model was re-anchored.

        Parameters
        ----------
        points : shape (n, k)

        Returns
        -------
        residuals : shape (n, signals, N)
            Rows as the batch's weights have them; in units of noise, 0 where no sample counts.
        anchored : shape (n,)
        """
        ...

    def costs(self, points: NDArray[np.float64], cap: float) -> NDArray[np.float64]:
        """Sum of squared residuals of points, each square at most `cap`, shape (n,)."""
        ...
