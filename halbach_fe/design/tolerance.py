"""Multipoles of magnets whose blocks are drawn from the prior: what to expect of the next one.

They are linear in the magnetizations but for the main one that they are divided by, so that their
covariance has a closed form; sizes |c_n|, their quantiles and the share of magnets within a limit
come from samples of C itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as linalg

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.response.multipoles import MultipoleModel, Multipoles, met
from halbach_fe.stats.gaussian import Gaussian, beside, by_block, nominal_prior, rotated
from halbach_fe.study.model import Study

QUANTILES = (0.05, 0.5, 0.95, 0.99)


@dataclass(frozen=True)
class Tolerance:
    """Multipoles of magnets from one prior.

    Attributes
    ----------
    known : Multipoles
        Mean and covariance, in closed form.
    sizes : ndarray, shape (draws, k)
        |c_n| in units.
    main : ndarray, shape (draws,)
        |C_N| in T or T m.
    limit : float or None
        In units.
    """

    study: Study
    model: MultipoleModel
    known: Multipoles
    sizes: Floats
    main: Floats
    limit: float | None

    @property
    def quantiles(self) -> Floats:
        """|c_n| that so many magnets stay below, (`QUANTILES`, k)."""
        return np.quantile(self.sizes, QUANTILES, axis=0)

    @property
    def share(self) -> float | None:
        """Of magnets all of whose multipoles are within the limit."""
        return None if self.limit is None else met(self.sizes, self.limit)

    @property
    def share_sd(self) -> float | None:
        """Of that share, by the number of draws; by the rule of succession, not 0 for none."""
        if self.share is None:
            return None
        count = len(self.sizes)
        guess = (self.share * count + 1) / (count + 2)
        return float(np.sqrt(guess * (1 - guess) / count))

    @property
    def shares(self) -> Floats | None:
        """By order (k,): of magnets within the limit."""
        return None if self.limit is None else np.mean(self.sizes <= self.limit, axis=0)


def assembled_prior(magnet: Magnet, nominal: Floats) -> Gaussian:
    """The study's prior of magnets as they are assembled: blocks, calibration, and mounting.

    Parameters
    ----------
    nominal : ndarray, shape (parameters,), in A/m
    """
    settings, size = magnet.study.prior, magnet.dimension
    blocks = nominal_prior(nominal, size, settings.magnitude_sd, settings.direction_sd_deg,
                         settings.common_mode_sd)
    turns = rotated(nominal.reshape(-1, size), np.radians(settings.mounting_sd_deg))
    return Gaussian(blocks.mean, beside(blocks.root, by_block(turns)))


def predict_tolerance(
    model: MultipoleModel, magnet: Magnet, prior: Gaussian, draws: int,
    generator: np.random.Generator, limit: float | None = None,
) -> Tolerance:
    """Draw magnets from a prior.

    Parameters
    ----------
    prior : Gaussian
        Of the parameters in A/m, mounting included.
    draws : int
    limit : float, optional
        For every |c_n|, in units of 1e-4.
    """
    mean = model.offset + model.matrix @ prior.mean
    root = model.matrix @ prior.root
    # as many columns as there are numbers do for the same covariance
    parts = np.vstack([root.real, root.imag])
    (small,) = linalg.qr(parts.T, mode="r")
    drawn = generator.standard_normal((draws, len(small))) @ small
    count = len(mean)
    coefficients = mean + drawn[:, :count] + 1j * drawn[:, count:]
    sizes = np.hypot(*model.units(coefficients).reshape(draws, 2, -1).swapaxes(0, 1))
    return Tolerance(magnet.study, model, model.known(mean, root), sizes,
                     np.abs(coefficients[:, 0]),
                     limit)
