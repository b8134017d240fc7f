"""Closed forms of symmetric matrices, for one or several matches, against ``numpy.linalg``."""

from __future__ import annotations

import numpy as np
import pytest

from gpusense.matching.columns import (
    axes_of_one,
    balanced,
    column_of,
    columns_of,
    inverse_of,
    is_definite,
    matrices_of,
    moved,
    squared_length,
    triangle_of,
)
from gpusense.matching.verdicts import noise_of


def drawn(count: int) -> np.ndarray:
    """Return positive definite matrices with eigenvalue ratios of up to 10^6."""
    rng = np.random.default_rng(3)
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    return (axes * 10 ** rng.uniform(-3, 3, (count, 1, 3))) @ axes.transpose(0, 2, 1)


@pytest.mark.parametrize("count", [1, 40])
def test_closed_forms_are_those_of_matrices(count):
    matrices = drawn(count)
    triangle = triangle_of(matrices)
    np.testing.assert_array_equal(matrices_of(triangle), np.triu(matrices) + np.triu(matrices, 1).transpose(0, 2, 1))
    np.testing.assert_allclose(
        matrices_of(inverse_of(triangle)) @ matrices, np.eye(3)[None].repeat(count, 0), atol=1e-6
    )
    x, y, turn = columns = columns_of(np.random.default_rng(4).normal(size=(count, 3)))
    derivative = np.tile(np.eye(3), (count, 1, 1))
    derivative[:, 0, 2], derivative[:, 1, 2] = x, y
    expected = derivative.transpose(0, 2, 1) @ matrices @ derivative
    np.testing.assert_allclose(matrices_of(moved(triangle, x, y)), expected, rtol=1e-9, atol=1e-9)
    vector = np.array(columns).reshape(3, count).T
    length = np.einsum("si,sij,sj->s", vector, matrices, vector)
    np.testing.assert_allclose(squared_length(triangle, x, y, turn), column_of(length), rtol=1e-9)
    lever = column_of(np.linspace(2.0, 5.0, count))
    scale = np.ones((count, 3))
    scale[:, 2] = 1 / np.array(lever)
    np.testing.assert_allclose(
        matrices_of(balanced(triangle, lever)), matrices * scale[:, :, None] * scale[:, None], rtol=1e-12
    )


def test_a_matrix_is_definite_if_all_its_eigenvalues_are_positive():
    matrices = drawn(300)
    shifted = matrices - np.random.default_rng(5).uniform(0, 2, (300, 1, 1)) * np.linalg.eigvalsh(matrices)[
        :, :1, None
    ] * np.eye(3)
    definite = np.linalg.eigvalsh(shifted)[:, 0] > 0
    assert 100 < definite.sum() < 200
    np.testing.assert_array_equal(is_definite(triangle_of(shifted)), definite)
    assert [is_definite(triangle_of(one[None])) for one in shifted] == definite.tolist()
    assert not is_definite((float("nan"), 0.0, 0.0, 1.0, 0.0, 1.0))


def test_axes_of_one_matrix_are_its_eigenvectors():
    for matrix in [*drawn(50), np.zeros((3, 3)), np.diag([2.0, 1.0, 1.0]), -drawn(1)[0]]:
        values, vectors = map(np.array, zip(*axes_of_one(triangle_of(matrix[None])), strict=True))
        size = np.abs(matrix).max()
        np.testing.assert_allclose(values, np.linalg.eigvalsh(matrix), rtol=0, atol=1e-14 * size)
        np.testing.assert_allclose(vectors @ vectors.T, np.eye(3), atol=1e-14)
        np.testing.assert_allclose(vectors.T * values @ vectors, matrix, atol=1e-14 * size)


def test_one_ratio_has_the_noise_that_it_has_among_others():
    ratios = np.concatenate([[0.0, np.inf, np.nan, 1e-300], np.random.default_rng(6).uniform(0, 1.1, 2000)])
    alone = np.array([noise_of(ratio) for ratio in ratios.tolist()])
    np.testing.assert_array_equal(alone.T, noise_of(ratios))


@pytest.mark.parametrize("count", [1, 40])
def test_the_inverse_of_a_matrix_that_is_not_definite_is_nan(count):
    """Zero, singular, indefinite and negative ones, alone and among others."""
    others = np.array([np.zeros((3, 3)), np.ones((3, 3)), np.diag([1.0, 1.0, 0.0]), np.diag([1.0, 0.0, 1.0]),
                       np.diag([0.0, 1.0, 1.0]), np.diag([1.0, -1.0, 1.0]), np.diag([1.0, 1.0, -2.0]), -np.eye(3),
                       np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])])  # fmt: skip
    for other in others:
        matrices = drawn(count)
        matrices[count // 2] = other
        with np.errstate(all="raise"):
            inverse = matrices_of(inverse_of(triangle_of(matrices)))
        assert np.isnan(inverse[count // 2]).all()
        assert np.isfinite(np.delete(inverse, count // 2, axis=0)).all()
