"""What a magnet is improved for: small multipoles, or a homogeneous field in a region.

A study with a table ``[homogeneity]`` asks for a homogeneous field in its region. The search for
better magnets is the same for both: the blocks' magnetizations are mapped linearly to values, whose
sum of squares is made small. The values are b_n and a_n in units of 1e-4 of the main multipole, or
deviations of |B| in ppm of its mean. An `Objective` is the map, `Known` its values for a magnet.

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
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.numbers import LIMIT_PPM, LIMIT_UNITS, check_number
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.response.homogeneity import PPM, HomogeneityModel, homogeneity_model
from halbach_fe.response.multipoles import (
    MultipoleModel,
    MultipoleReference,
    Multipoles,
    multipole_model,
    unwanted_orders,
)
from halbach_fe.response.region import default_region, region_points
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian, correlated_values


@dataclass(frozen=True)
class Deviations:
    """Deviations of |B| in a region, with their uncertainty."""

    main: float
    main_sd: float
    """Mean of |B| in T and its standard deviation, including the solver's error."""
    mean: Floats
    """Means of the values whose squares sum to the mean square deviation, in ppm. Shape (k,)."""
    root: Floats
    """Root of their covariance in ppm. Shape (k, q)."""
    error: Floats
    """Error of the solver in ppm, which ``root`` does not include. Shape (k,)."""

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
    """The linear model ``(m, v) = offset + matrix p`` of mean and deviations of |B| in a region."""

    homogeneity: HomogeneityModel
    """The field at all points of the region."""
    matrix: Floats
    """Rows for the mean of |B|, and for values whose squares sum to the mean square of its
    deviations. Shape (1 + k, parameters), in T m/A."""
    offset: Floats
    """The same of external fields. Shape (1 + k,), in T."""
    error: Floats
    """Error bar of the solver for these. Shape (1 + k,), in T."""
    nominal: Floats
    """Nominal magnetization. Shape (parameters,), in A/m."""
    of_neighbours: Floats
    """Rows for what the magnetizations of neighbours' blocks deviate, which a distribution knows
    beside its parameters. Shape (1 + k, neighbours' parameters), in T m/A."""

    @cached_property
    def nominal_main(self) -> float:
        """Mean of |B| of the nominal magnet in T."""
        return float((self.offset + self.matrix @ self.nominal)[0])

    def scaled(self, main: float) -> Floats:
        """Return the matrix (k, parameters) to deviations in ppm of a mean field in T."""
        return PPM / main * self.matrix[1:]

    def of(self, parameters: Gaussian) -> Deviations:
        """Return the deviations for normally distributed magnetizations in A/m."""
        mean, root = parameters.products(self.matrix, self.of_neighbours)
        return self.known(self.offset + mean, root)

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

    ``about`` (parameters,) in A/m: magnetizations of that magnet, which those of neighbours' blocks
    may follow; by default the nominal ones.
    """
    response, others = model.response, model.response.of_neighbours
    inner = np.flatnonzero(model.weights > 0)
    weights = model.weights[inner]
    rows = (3 * inner[:, None] + np.arange(3)).ravel()
    matrix, offset, others = response.matrix[rows], response.offset[rows], others[rows]
    field = model.field((response.nominal if about is None else about)[:, None])[inner, :, 0]
    along = field / np.linalg.norm(field, axis=1, keepdims=True)

    def of_size(values: Floats) -> Floats:
        """Return the part along the field (n, ...) of values (3 n, ...)."""
        return np.einsum("nc,nc...->n...", along, values.reshape(len(along), 3, -1))

    # the last column is that of the offset
    size = np.hstack([of_size(others), of_size(matrix), of_size(offset)])
    mean = weights @ size
    apart = np.sqrt(weights)[:, None] * (size - mean)
    # a magnetization may be as large as the largest one, an amplitude is of some sd
    largest = float(np.abs(response.nominal).max())
    scale = np.array([largest] * others.shape[1] + [
        largest if name[-3:-1] == ".M" else 1.0 for name in response.parameters] + [1.0])
    known = scale * apart
    # a wide matrix has the left singular vectors of the triangle of its transpose; products with
    # itself, of the size of the points, would take minutes where these are thousands
    tall = known if len(known) >= known.shape[1] else np.asarray(
        np.linalg.qr(known.T, mode="r")).T
    vectors, sizes, _ = np.linalg.svd(tall, full_matrices=False)
    # smallest singular value that is kept, relative to the largest one. What is left out changes
    # rms deviations by less than 1e-6 of themselves.
    kept_share = 3e-7
    kept = vectors[:, sizes > kept_share * sizes[0]]
    values = np.vstack([mean, kept.T @ apart])
    error = np.sqrt(weights) * np.linalg.norm(response.error[rows].reshape(-1, 3), axis=1)
    beside = others.shape[1]
    return DeviationModel(
        model, values[:, beside:-1], values[:, -1],
        np.append(np.linalg.norm(error), np.sqrt((kept**2).T @ error**2)), response.nominal,
        values[:, :beside])


Known = Multipoles | Deviations
"""The values of a magnet with their uncertainty."""

Objective = MultipoleModel | DeviationModel
"""A linear map from magnetizations to values.

The values are ratios: row 0 of ``matrix`` (1 + k, parameters) is that of the main multipole or of
the mean field, to which the others are relative.
"""


def check_objective(
    magnet: Magnet, reference: MultipoleReference | None, limit_units: float | None,
    limit_ppm: float | None,
) -> None:
    """Refuse, before any solve, what does not fit what the study asks for.

    Raises
    ------
    StudyError
        If multipoles are described for a study that asks for a homogeneous field, or a limit in
        ppm is given for one that does not; if the multipoles do not fit the study, or the region
        reaches into material.
    """
    for name, value, limits in (("limit_units", limit_units, LIMIT_UNITS),
                                ("limit_ppm", limit_ppm, LIMIT_PPM)):
        if value is not None:
            check_number(name, f"study {magnet.name}", value, *limits)
    if magnet.study.homogeneity is None:
        if limit_ppm is not None:
            raise StudyError(must_be(
                "limit_ppm", f"study {magnet.name}", "left out, as the study asks for multipoles",
                f"{limit_ppm:g}", "Add the table [homogeneity] with the region to the study, or "
                "give limit_units."))
        unwanted_orders(magnet, reference or MultipoleReference())
        return
    for name, there in (("limit_units", limit_units), ("the reference of multipoles", reference)):
        if there is not None:
            raise StudyError(must_be(
                name, f"study {magnet.name}", "left out, as its table [homogeneity] asks for a "
                "homogeneous field", "one", "Leave out the options of multipoles, or the table."))
    region_points(magnet, default_region(magnet))


def objective_of(
    magnet: Magnet, reference: MultipoleReference | None, session: Session,
    about: Floats | None = None,
) -> Objective:
    """Return what the study asks for as a function of the magnetizations.

    Parameters
    ----------
    reference : MultipoleReference or None
        Radius, orders and z of multipoles, if the study asks for multipoles.
    about : ndarray, shape (parameters,), in A/m, optional
        Magnetizations about which |B| is linearized; by default the nominal ones.

    Raises
    ------
    StudyError
        If the nominal magnet has no main multipole or mean field, to which the others are relative.
    """
    # least main multipole, relative to what all blocks could make together, of which units make
    # sense: usual arrays have 0.5 and more. Of less, tolerances of the blocks of some per cent are
    # most of it.
    least_main = 0.01
    if magnet.study.homogeneity is None:
        model = multipole_model(magnet, reference or MultipoleReference(), session)
        blocks = float(np.abs(model.matrix[0] * model.nominal).sum())  # if none cancelled another
        if model.nominal_main < least_main * blocks:
            raise StudyError(must_be(
                f"the multipole of order {model.main}", f"study {magnet.name}",
                f"above {least_main:g} of what the blocks could make together, as others are in "
                "units of 1e-4 of it", f"{model.nominal_main / blocks:.2g}",
                magnet.axis_beside or "Check multipole_order; of an undulator, ask on a circle at "
                "a pole: --at-z-m Z."))
        return model
    region = homogeneity_model(magnet, default_region(magnet), session)
    field = region.field(region.response.nominal[:, None])[..., 0]
    mean, size = region.nominal_mean, float(region.weights @ np.linalg.norm(field, axis=1))
    # least mean of B over a region, relative to that of |B|, of which ppm make sense: below, B
    # turns round within the region, where its size is no linear function of the blocks
    least_mean = 0.1
    if np.linalg.norm(mean) < least_mean * size:
        raise StudyError(must_be(
            "`homogeneity`", f"study {magnet.name}", "a region in which the mean of B is above "
            f"{least_mean:g} of that of |B|, as deviations are in ppm of it",
            f"{region.region.text}, with {np.linalg.norm(mean) / size:.2g}",
            "B cancels there, as in a quadrupole or between poles: leave the table out to ask for "
            "multipoles, or choose another region."))
    return deviation_model(region, about)
