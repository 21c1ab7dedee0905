"""Pseudo-inverse of a regression's points, also where the library's decomposition fails."""

from __future__ import annotations

import numpy as np
import pytest

from ehadiag.identify.refine.linearisation import pseudo_inverse


def triangle(count=26):
    """Of random rotations: many equal singular values."""
    rng = np.random.default_rng(3)
    turns = [np.linalg.qr(rng.standard_normal((count, count)))[0] for _ in range(2)]
    return np.linalg.qr(np.vstack([*turns, turns[0][:5]]))[1]


def test_it_is_the_inverse():
    assert pseudo_inverse(triangle()) @ triangle() == pytest.approx(np.eye(26), abs=1e-12)


def test_it_is_the_same_where_the_decomposition_does_not_converge(monkeypatch):
    expected, library = pseudo_inverse(triangle()), np.linalg.pinv

    def failing(matrix, *rest, hermitian=False, **more):
        if not hermitian:
            raise np.linalg.LinAlgError("SVD did not converge")
        return library(matrix, *rest, hermitian=True, **more)

    monkeypatch.setattr(np.linalg, "pinv", failing)
    assert pseudo_inverse(triangle()) == pytest.approx(expected, abs=1e-12)


def test_a_direction_without_points_is_not_seen():
    flat = triangle() @ np.diag([1.0] * 25 + [0.0])
    assert np.abs(pseudo_inverse(flat)[25]).max() < 1e-9
