"""Deviations of |B| in a region from its mean, as linear functions of block magnetizations.

With unit vectors b_i along the field of a magnet at the points of the region, ``|B_i| = b_i B_i``
but for the square of what turns the field: of the 1e-3 by which the errors of blocks do, 0.5 ppm.
With the weights w_i of means over the volume, the mean of |B| is ``m = sum w_i |B_i|``, and the
mean square of the deviations ``(|B_i| - m) / m`` is the sum of the squares of ``sqrt(w_i) (|B_i| -
m) / m``. These values are turned into as many as matter: a field without sources in the region has
few degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.response.homogeneity import PPM, HomogeneityModel
from halbach_fe.stats.gaussian import Gaussian, correlated_values


@dataclass(frozen=True)
class Deviations:
    """Deviations of |B| in a region, with their uncertainty.

    Attributes
    ----------
    main, main_sd : float
        Mean of |B| in T and its standard deviation, including the solver's error.
    mean : ndarray, shape (k,)
        Means of the values whose squares sum to the mean square deviation, in ppm.
    root : ndarray, shape (k, q)
        Root of their covariance in ppm.
    error : ndarray, shape (k,)
        Error of the solver in ppm, which ``root`` does not include.
    """

    main: float
    main_sd: float
    mean: Floats
    root: Floats
    error: Floats

    @property
    def expected_square(self) -> float:
        """Expectation of the mean square deviation in ppm^2, without the solver's error."""
        return float(self.mean @ self.mean + np.sum(self.root**2))

    @property
    def rms(self) -> float:
        """Root of `expected_square`, in ppm."""
        return float(np.sqrt(self.expected_square))

    @property
    def rms_of_mean(self) -> float:
        """Rms deviation of the mean field, in ppm."""
        return float(np.linalg.norm(self.mean))

    def share_within(self, limit: float, normals: Floats) -> float:
        """Return the probability that the rms deviation is within a limit in ppm.

        It is estimated from standard normal numbers (count, k).
        """
        covariance = self.root @ self.root.T + np.diag(self.error**2)
        drawn = correlated_values(self.mean, covariance, normals)
        return float(np.mean(np.einsum("ij,ij->i", drawn, drawn) <= limit**2))


@dataclass(frozen=True)
class DeviationModel:
    """The linear model ``(m, v) = offset + matrix p`` of mean and deviations of |B| in a region.

    Attributes
    ----------
    homogeneity : HomogeneityModel
        The field at all points of the region.
    matrix : ndarray, shape (1 + k, parameters), in T m/A
        Rows for the mean of |B|, and for values whose squares sum to the mean square of its
        deviations.
    offset : ndarray, shape (1 + k,), in T
        The same of external fields.
    error : ndarray, shape (1 + k,), in T
        Error bar of the solver for these.
    nominal : ndarray, shape (parameters,), in A/m
        Nominal magnetization.
    """

    homogeneity: HomogeneityModel
    matrix: Floats
    offset: Floats
    error: Floats
    nominal: Floats

    @cached_property
    def nominal_main(self) -> float:
        """Mean of |B| of the nominal magnet in T."""
        return float((self.offset + self.matrix @ self.nominal)[0])

    def scaled(self, main: float) -> Floats:
        """Return the matrix (k, parameters) to deviations in ppm of a mean field in T."""
        return PPM / main * self.matrix[1:]

    def of(self, parameters: Gaussian) -> Deviations:
        """Return the deviations for normally distributed magnetizations in A/m."""
        return self.known(self.offset + self.matrix @ parameters.mean,
                          self.matrix @ parameters.root)

    def known(self, mean: Floats, root: Floats) -> Deviations:
        """Return the deviations for a mean (1 + k,) and a root (1 + k, q) of the values in T.

        The ratios to the mean field are linearized about their mean.
        """
        relative = mean[1:] / mean[0]
        return Deviations(
            float(mean[0]), float(np.hypot(np.linalg.norm(root[0]), self.error[0])),
            PPM * relative,
            PPM / mean[0] * (root[1:] - np.outer(relative, root[0])),
            PPM / mean[0] * self.error[1:])

    def units(self, values: Floats) -> Floats:
        """Return deviations in ppm (..., k) of values (..., 1 + k) in T, without linearization."""
        return np.asarray(PPM * values[..., 1:] / values[..., :1])


def deviation_model(model: HomogeneityModel, about: Floats | None = None) -> DeviationModel:
    """Return the linear model of the deviations of |B| about the field of a magnet.

    Parameters
    ----------
    model : HomogeneityModel
    about : ndarray, shape (parameters,), in A/m, optional
        Magnetizations of that magnet; by default the nominal ones.
    """
    response = model.response
    inner = np.flatnonzero(model.weights > 0)
    weights = model.weights[inner]
    rows = (3 * inner[:, None] + np.arange(3)).ravel()
    matrix, offset = response.matrix[rows], response.offset[rows]
    field = (offset + matrix @ (response.nominal if about is None else about)).reshape(-1, 3)
    along = field / np.linalg.norm(field, axis=1, keepdims=True)

    def of_size(values: Floats) -> Floats:
        """Return the part along the field (n, ...) of values (3 n, ...)."""
        return np.einsum("nc,nc...->n...", along, values.reshape(len(along), 3, -1))

    size = np.hstack([of_size(matrix), of_size(offset)])  # the last column is that of the offset
    mean = weights @ size
    apart = np.sqrt(weights)[:, None] * (size - mean)
    scale = float(np.abs(response.nominal).max())
    known = np.hstack([scale * apart[:, :-1], apart[:, -1:]])
    values, vectors = np.linalg.eigh(known @ known.T)
    # smallest eigenvalue of the matrix of products that is kept, relative to the largest one;
    # smaller ones are rounding errors. What is left out changes rms deviations by less than 1e-6 of
    # themselves.
    kept_share = 1e-13
    kept = vectors[:, values > kept_share * values[-1]]
    values = np.vstack([mean, kept.T @ apart])
    error = np.sqrt(weights) * np.linalg.norm(response.error[rows].reshape(-1, 3), axis=1)
    return DeviationModel(
        model, values[:, :-1], values[:, -1],
        np.append(np.linalg.norm(error), np.sqrt((kept**2).T @ error**2)), response.nominal)
