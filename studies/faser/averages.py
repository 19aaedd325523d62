"""Other things that a column B_x may hold: a value on a line, or an average over circles.

The mapper read the field on circles, from which the paper computed Fourier coefficients. Whether
a profile is a reading at one angle or such a coefficient is decided as in `register`: by the
evidence, with the magnetizations of all blocks integrated out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import least_squares

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.response.block_variation import study_prior
from halbach_fe.solver.exact_block_field import field_of, unit_fields
from halbach_fe.stats.gaussian import root_matrix
from halbach_fe.study.materials import MU_0

ANGLES = 24
"""Number of points of a circle."""

ROUNDS = 5
"""Number of fits, each with the field of the blocks at the place of the one before."""

DIFFERENCE = 1e-4
"""Step of finite differences, in units of a parameter's prior standard deviation."""


@dataclass(frozen=True)
class Reading:
    """What a column of a profile may hold.

    Attributes
    ----------
    name : str
    angles : callable
        From the parameter ``angle``, the angles (m,) in rad of the points of one reading.
    weights : callable
        From these angles, the weights (m, 2) of B_x and B_y.
    has_angle : bool
        Whether the angle is a parameter.
    """

    name: str
    angles: Callable[[float], Floats]
    weights: Callable[[Floats], Floats]
    has_angle: bool


def _circle(_: float) -> Floats:
    return 2 * np.pi * (np.arange(ANGLES) + 0.25) / ANGLES


def _radial(angles: Floats) -> Floats:
    return np.column_stack([np.cos(angles), np.sin(angles)])


READINGS = (
    Reading("B_x on a line", lambda angle: np.array([angle]),
            lambda angles: np.array([[1.0, 0.0]]), True),
    Reading("B_r on a line", lambda angle: np.array([angle]), _radial, True),
    Reading("first Fourier coefficient of B_r on circles", _circle,
            lambda angles: 2 * np.cos(angles)[:, None] * _radial(angles) / ANGLES, False),
    Reading("mean of B_x over circles", _circle,
            lambda angles: np.tile([1.0 / ANGLES, 0.0], (ANGLES, 1)), False),
)
"""What was compared; the first is what `register` assumes."""

MEANS = np.array([0.0, 0.0, 0.075, 0.3, 0.0])
"""Prior means: shift in m, scale of z, radius in m, angle in rad, gain."""


@dataclass(frozen=True)
class Fitted:
    """A reading that was fitted to a profile.

    Attributes
    ----------
    parameters, sd : ndarray, shape (5,)
        Shift in m, scale of z, radius in m, angle in rad, and gain.
    error : ndarray, shape (n,)
        Relative error of the updated magnet's prediction.
    """

    reading: Reading
    parameters: Floats
    sd: Floats
    log_evidence: float
    error: Floats


def fit(
    magnet: Magnet, reading: Reading, z: Floats, measured: Floats, training: NDArray[np.bool_],
    radius_sd: float, sigma_T: float, position_sd_m: float,
) -> Fitted:
    """Fit a profile (n,) at z (n,) in m by one kind of reading of a magnet.

    Parameters
    ----------
    training : ndarray of bool, shape (n,)
    radius_sd : float
        Prior standard deviation in m of the radius about that of the mapper's circles.
    sigma_T, position_sd_m : float
        Noise of a reading, and of its position.
    """
    root = root_matrix(study_prior(magnet, len(magnet.parameter_names)).root)
    root = root if isinstance(root, np.ndarray) else root.toarray()
    array = magnet.array
    assert array.ring_length_m is not None
    assert array.block_moment_A_m2 is not None
    whole = magnet.with_(array__rings=1, array__ring_length_m=array.rings * array.ring_length_m,
                         array__block_moment_A_m2=array.rings * array.block_moment_A_m2)
    sd = np.array([0.05, 0.05, radius_sd, 1.0 if reading.has_angle else 1e-6, 0.003])

    def points(scaled: Floats) -> tuple[Floats, Floats]:
        """Return the points (m n, 3) in m of all readings, and the weights (m, 2) of B there."""
        shift, stretch, radius, angle, gain = MEANS + sd * scaled
        angles = reading.angles(angle)
        return np.concatenate([np.column_stack([
            np.full(len(z), radius * np.cos(one)), np.full(len(z), radius * np.sin(one)),
            z * (1 + stretch) + shift]) for one in angles]), (1 + gain) * reading.weights(angles)

    def nominal(scaled: Floats) -> Floats:
        """Return what the nominal magnet reads (n,); its equal rings are as good as a long one."""
        places, weights = points(scaled)
        field = field_of(whole.blocks, places).reshape(len(weights), len(z), 3)
        return np.asarray(np.einsum("ac,anc->n", weights, field[:, :, :2]))

    def deviations(scaled: Floats) -> Floats:
        """Return what deviations of the blocks by one prior standard deviation read (n, k)."""
        places, weights = points(scaled)
        read = np.concatenate([np.einsum(
            "ac,anck->nk", weights, (unit @ (MU_0 * block.recoil_tensor)).reshape(
                len(weights), len(z), 3, 3)[:, :, :2]) for block, unit in zip(
            magnet.blocks, unit_fields(magnet.blocks, places), strict=True)], axis=1)
        return np.asarray(read @ root)

    start = np.zeros(5)
    for number in range(ROUNDS):
        field, blocks = nominal(start), deviations(start)
        slope = np.gradient(field, z)
        noise = np.hypot(sigma_T, slope * position_sd_m)
        # at first the blocks must not take up what place and scale explain, see `register`
        noise = np.hypot(noise, 0.04 * 10.0**-number if number + 1 < ROUNDS else 0.0)
        covariance = blocks @ blocks.T + np.diag(noise**2)
        lower = np.linalg.cholesky(covariance[np.ix_(training, training)])

        def residual(scaled: Floats, lower: Floats = lower) -> Floats:
            left = (measured - nominal(scaled))[training]
            return np.concatenate([solve_triangular(lower, left, lower=True), scaled])

        found = least_squares(residual, start, diff_step=DIFFERENCE, x_scale=1.0, max_nfev=8)
        start = found.x
    information = found.jac.T @ found.jac
    evidence = -found.cost - float(np.log(np.diag(lower)).sum()) - 0.5 * float(
        np.linalg.slogdet(information)[1])
    field = nominal(start)
    factor = cho_factor(covariance[np.ix_(training, training)])
    updated = field + (covariance - np.diag(noise**2))[:, training] @ cho_solve(
        factor, (measured - field)[training])
    return Fitted(reading, MEANS + sd * start, sd * np.sqrt(np.diag(np.linalg.inv(information))),
                  evidence, np.abs(updated / measured - 1))
