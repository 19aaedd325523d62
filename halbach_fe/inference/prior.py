"""The prior N(mu_0, C_0) of the block magnetizations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as linalg

from halbach_fe.blocks import Floats


@dataclass(frozen=True)
class Gaussian:
    """A normal distribution, by its mean and a square root of its covariance.

    Attributes
    ----------
    mean : ndarray, shape (m,)
    root : ndarray, shape (m, k)
        Covariance = root @ root.T; any k.
    """

    mean: Floats
    root: Floats

    @property
    def covariance(self) -> Floats:
        """Shape (m, m)."""
        return self.root @ self.root.T

    @property
    def sd(self) -> Floats:
        """Marginal standard deviations, shape (m,)."""
        return np.sqrt(np.einsum("ij,ij->i", self.root, self.root))

    def sample(self, count: int, generator: np.random.Generator) -> Floats:
        """Draw ``count`` samples, shape (count, m)."""
        return self.mean + generator.standard_normal((count, self.root.shape[1])) @ self.root.T


def block_prior(
    nominal: Floats, dimension: int, magnitude_sd: float, direction_sd_deg: float,
    common_mode_sd: float = 0.0,
) -> Gaussian:
    """Independent deviations of every block along and across its easy axis, and a common mode.

    Parameters
    ----------
    nominal : ndarray, shape (blocks * dimension,), in A/m
        Nominal magnetizations, block by block.
    magnitude_sd, common_mode_sd : float
        Fractions of the nominal magnetization, independent by block and shared by all.
    direction_sd_deg : float
        Of each direction across the easy axis; a small angle, so the deviation is M times it.
    """
    vectors = nominal.reshape(-1, dimension)
    root = np.zeros((nominal.size, nominal.size + (common_mode_sd > 0)))
    for number, vector in enumerate(vectors):
        magnitude = float(np.linalg.norm(vector))
        if magnitude == 0:
            continue  # a block that is missing is known not to be there
        axis = (vector / magnitude)[:, None]
        across = linalg.null_space(axis.T)
        block = slice(number * dimension, (number + 1) * dimension)
        root[block, block] = magnitude * np.hstack(
            [magnitude_sd * axis, np.radians(direction_sd_deg) * across])
    if common_mode_sd > 0:
        root[:, -1] = common_mode_sd * nominal
    return Gaussian(nominal, root)


def turned(vectors: Floats, sd: float) -> Floats:
    """What turns of blocks do to their magnetizations: roots (n, d, axes) of the covariance.

    Parameters
    ----------
    vectors : ndarray, shape (n, d), in A/m
        In a cross-section (d = 2) blocks turn about z only.
    sd : float
        Of the turn about each axis, in rad.
    """
    whole = np.zeros((len(vectors), 3))
    whole[:, :vectors.shape[1]] = vectors
    axes = np.eye(3)[2:] if vectors.shape[1] == 2 else np.eye(3)
    changes = np.cross(axes, whole[:, None])  # (n, axes, 3)
    return np.asarray(sd * changes[:, :, :vectors.shape[1]].swapaxes(1, 2))
