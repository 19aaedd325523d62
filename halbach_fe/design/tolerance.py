"""Multipoles or homogeneity of magnets whose blocks are drawn: what the tolerances allow.

The coefficients C_n are linear in the magnetizations. Multipoles are C_n divided by the main
coefficient; linearized in the latter, their mean and covariance have a closed form. The magnitudes
|c_n|, their quantiles and the share of magnets within a limit are computed from samples of C_n.
Deviations of |B| in a region are those of drawn fields, without linearization.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as linalg

from halbach_fe.core.arrays import Floats
from halbach_fe.core.interface import ShownInNotebook
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.response.homogeneity import Homogeneity, HomogeneityModel
from halbach_fe.response.multipoles import MultipoleModel, Multipoles
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.model import Study

QUANTILES = (0.05, 0.5, 0.95, 0.99)
"""Probabilities of the quantiles that are reported."""


class DrawnMagnets(ShownInNotebook):
    """What the tolerances of blocks make of magnets that are drawn from a prior."""

    limit: float | None

    @property
    def largest(self) -> Floats:
        """What the limit is of, of each magnet (draws,)."""
        raise NotImplementedError

    @property
    def share(self) -> float | None:
        """Share of magnets within the limit; None without a limit."""
        return None if self.limit is None else float(np.mean(self.largest <= self.limit))

    @property
    def share_sd(self) -> float | None:
        """Standard error of `share`, which follows from the number of draws.

        It uses Laplace's rule of succession, so that it is not 0 if the share is 0 or 1.
        """
        if self.share is None:
            return None
        count = len(self.largest)
        guess = (self.share * count + 1) / (count + 2)
        return float(np.sqrt(guess * (1 - guess) / count))


@dataclass(frozen=True)
class Tolerance(DrawnMagnets):
    """Multipoles of magnets whose blocks are drawn from a prior.

    Attributes
    ----------
    study : Study
    model : MultipoleModel
        The linear model from magnetizations to multipoles.
    known : Multipoles
        Mean and covariance in closed form.
    sizes : ndarray, shape (draws, k)
        |c_n| of the samples, in units of 1e-4.
    main : ndarray, shape (draws,)
        |C_N| of the samples, in T, or T m if integrated along z.
    limit : float or None
        Limit of all |c_n|, in units of 1e-4.
    table_doubts : tuple of str or None
        Why the table of measured blocks may not be of this magnet; None without a table.
    quantiles : ndarray, shape (len(`QUANTILES`), k)
        Quantiles of |c_n|, in units of 1e-4.
    share, share_sd : float or None
        Share of the magnets, from 0 to 1, whose multipoles are all within the limit, and its
        standard error; None without a limit.
    """

    study: Study
    model: MultipoleModel
    known: Multipoles
    sizes: Floats
    main: Floats
    limit: float | None
    table_doubts: tuple[str, ...] | None = None

    @property
    def quantiles(self) -> Floats:
        """Quantiles of |c_n| in units, shape (len(`QUANTILES`), k)."""
        return np.quantile(self.sizes, QUANTILES, axis=0)

    @property
    def largest(self) -> Floats:
        """The largest |c_n| of each magnet in units, (draws,)."""
        return np.asarray(self.sizes.max(axis=1))

    @property
    def shares(self) -> Floats | None:
        """Share of magnets within the limit for each order, (k,); None without a limit."""
        return None if self.limit is None else np.mean(self.sizes <= self.limit, axis=0)


@dataclass(frozen=True)
class HomogeneityTolerance(DrawnMagnets):
    """Homogeneity of magnets whose blocks are drawn from a prior.

    Attributes
    ----------
    study : Study
    model : HomogeneityModel
        The linear model from magnetizations to the field in the region.
    ordered : Homogeneity
        That of the magnet whose blocks are as ordered, and the range of the drawn magnets.
    mean_T : ndarray, shape (draws,)
        Mean of |B| of the samples.
    rms_ppm, peak_to_peak_ppm : ndarray, shape (draws,)
        Deviations of |B| from its mean.
    limit : float or None
        Limit of the rms deviation in ppm.
    table_doubts : tuple of str or None
        Why the table of measured blocks may not be of this magnet; None without a table.
    share, share_sd : float or None
        Share of the magnets within the limit, from 0 to 1, and its standard error; None without a
        limit.
    """

    study: Study
    model: HomogeneityModel
    ordered: Homogeneity
    mean_T: Floats
    rms_ppm: Floats
    peak_to_peak_ppm: Floats
    limit: float | None
    table_doubts: tuple[str, ...] | None = None

    @property
    def largest(self) -> Floats:
        """The rms deviation of each magnet in ppm, (draws,)."""
        return self.rms_ppm


def predict_tolerance(
    model: MultipoleModel, magnet: Magnet, prior: Gaussian, draws: int,
    generator: np.random.Generator, limit: float | None = None,
) -> Tolerance:
    """Compute the distribution of the multipoles of magnets from a prior.

    Parameters
    ----------
    prior : Gaussian
        Distribution of the magnetizations in A/m, including the errors of mounting.
    draws : int
        Number of samples.
    limit : float, optional
        Limit of every |c_n|, in units of 1e-4.
    """
    mean, root = prior.products(model.matrix, model.of_neighbours)
    mean = model.offset + mean
    # a QR decomposition reduces the covariance factor to a square one of the same covariance
    parts = np.vstack([root.real, root.imag])
    (small,) = linalg.qr(parts.T, mode="r")
    drawn = generator.standard_normal((draws, len(small))) @ small
    count = len(mean)
    coefficients = mean + drawn[:, :count] + 1j * drawn[:, count:]
    sizes = np.hypot(*model.units(coefficients).reshape(draws, 2, -1).swapaxes(0, 1))
    return Tolerance(magnet.study, model, model.known(mean, root), sizes,
                     np.abs(coefficients[:, 0]), limit)


def predict_homogeneity(
    model: HomogeneityModel, magnet: Magnet, prior: Gaussian, draws: int,
    generator: np.random.Generator, limit: float | None = None,
) -> HomogeneityTolerance:
    """Compute the distribution of the homogeneity of magnets from a prior.

    Parameters
    ----------
    prior : Gaussian
        Distribution of the magnetizations in A/m, including the errors of mounting.
    draws : int
        Number of samples.
    limit : float, optional
        Limit of the rms deviation in ppm.
    """
    at_once = 200  # number of magnets whose fields are computed at a time, which limits the memory
    parts = [model.deviations(model.drawn(
        prior, min(at_once, draws - first), generator))
        for first in range(0, draws, at_once)]
    mean, rms, whole = (np.concatenate(each) for each in zip(*parts, strict=True))
    return HomogeneityTolerance(magnet.study, model, model.of(prior), mean, rms, whole, limit)
