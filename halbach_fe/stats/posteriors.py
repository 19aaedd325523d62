"""The posterior of a model with Gaussian prior and noise: closed for linear models, else sampled.

**Linear models.** The parameters are p = mu_0 + L z with z ~ N(0, I), where L is a square root of
the prior's covariance. The whitened readings are ``y = W z + e`` with e ~ N(0, I). The posterior
follows from the singular value decomposition W = U s V': along each direction of V (a column of V)
the posterior standard deviation is ``1/sqrt(1 + s^2)`` of the prior's, and in all orthogonal
directions it equals the prior's (C. M. Bishop, Pattern Recognition and Machine Learning, eq. 2.117,
in whitened coordinates). No covariance is inverted, the prior covariance C_0 may be singular, and
at most as many directions are stored as there are readings.

W need not fit into memory: its rows are computed in blocks. With more readings than parameters,
the Gram matrix W'W is accumulated, and V are its eigenvectors. Rows are kept instead of W'W in two
cases: with fewer readings than parameters, and with readings so exact that the rounding errors of
W'W would change the posterior. QR decompositions then compress the rows to a square root of the
information matrix with no more rows than parameters (G. J. Bierman, Factorization Methods for
Discrete Sequential Estimation, 1977). If even this root is too large, as with tens of thousands of
parameters, those combinations of readings are discarded that carry almost no information about
the parameters; see `NEGLIGIBLE`.

**Non-linear models.** Markov chains sample the posterior. Proposals are made in coordinates xi in
which a Gaussian reference measure is standard normal, p = m + R xi. With the prior as the reference
this is the preconditioned Crank-Nicolson algorithm (S. L. Cotter et al., Statist. Sci. 28 (2013)
424), centred on the prior's mean. With Laplace's approximation at the mode it is the generalized
algorithm of D. Rudolf, B. Sprungk (Found. Comput. Math. 18 (2018) 309); a step of 1 makes it an
independence sampler. The proposal ``xi' = sqrt(1 - s^2) xi + s eta`` leaves the reference
invariant, so that the acceptance probability depends only on the ratio of the posterior and
reference densities.

Convergence of chains is judged by R-hat, rank-normalized and split, effective sample size and Monte
Carlo error. The definitions are those of A. Vehtari, A. Gelman, D. Simpson, B. Carpenter, P.-C.
Buerkner, Bayesian Anal. 16 (2021) 667; ArviZ computes them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import scipy.linalg as linalg
import scipy.sparse as sparse
import xarray as xr

from halbach_fe.core.arrays import Floats, Ints, slices
from halbach_fe.core.errors import SamplingError
from halbach_fe.stats.gaussian import (
    CovarianceFactor,
    Gaussian,
    NoiseCovariance,
    root_matrix,
    stacked_root,
)

READINGS_AT_ONCE = 2048
"""Largest number of rows that are whitened at a time, so that memory does not grow with the number
of readings. Larger parts would be allocated anew by the system each time, which takes as long as
their products."""

NUMBERS_AT_ONCE = 2**24
"""Largest number of entries of one block of rows (128 MB). With many parameters a block therefore
has fewer than `READINGS_AT_ONCE` rows."""

WORST_CONDITION = 1e10
"""Largest condition number of the precision of z, I + W'W, for which the Gram matrix W'W is used.
At this limit the rounding of W'W moves the posterior by about 1e-6 of its standard deviation."""

NUMBERS_HELD = 2**26
"""Largest number of entries (512 MB) of W'W, or of the rows that are collected before they are
compressed. At most as many rows as parameters are needed, so that with fewer than 8000 parameters
no information is discarded."""

NEGLIGIBLE = 1e-4
"""Singular values of W up to which a combination of readings may be discarded. The prior alone
predicts such a combination to 1e-4 of its noise, and discarding one changes the posterior variance
by 1e-8 of itself. The changes add up over all blocks; `LinearPosterior.discarded_information`
reports their sum."""


class Rows(Protocol):
    """A matrix (n, m) whose rows can be read by index: an array, or a matrix stored in a file."""

    def __len__(self) -> int: ...
    def __getitem__(self, rows: Ints, /) -> Floats: ...


@dataclass(frozen=True)
class LinearPosterior:
    """The posterior of the parameters of a linear model."""

    distribution: Gaussian
    """Posterior distribution. Its root has as many columns as the prior's."""
    log_evidence: float
    """Log evidence: logarithm of the probability density of the readings under prior and noise."""
    parameters_learnt: float
    """Effective number of parameters that the readings determine: the trace of I - S^-1, where S is
    the posterior precision of z (D. J. C. MacKay, Neural Comput. 4 (1992) 415)."""
    prior_conflict: float
    """Chi-squared per reading, ``r' (Sigma + H C_0 H')^-1 r / n``, of the residuals r of the
    prior's prediction. If prior, model and noise are right, its expectation is 1 and its standard
    deviation sqrt(2/n)."""
    discarded_information: float
    """Upper bound of the relative change of the posterior variance of any combination of parameters
    because negligible combinations of readings were discarded; 0 if none were."""


@dataclass(frozen=True)
class Information:
    """The information of readings y = W z + e, e ~ N(0, I), about z, where W = U diag(s) V'."""

    directions: Floats
    """V. Shape (k, r)."""
    values: Floats
    """Singular values s. Shape (r,)."""
    projected: Floats
    """V' W' y. Shape (r,)."""
    chi2: float
    """y' (I + W W')^-1 y."""
    discarded: float = 0.0
    """Sum of the squares of the singular values that were discarded as negligible."""


def update(
    matrix: Rows, readings: Floats, noise: NoiseCovariance, prior: Gaussian,
    rows: Ints | None = None
) -> LinearPosterior:
    """Update a prior with readings q = H p + noise.

    Parameters
    ----------
    matrix : ndarray or Rows, shape (n, m)
        H. With ``rows``, a matrix that also has rows of other readings.
    readings : ndarray, shape (n,)
        q.
    noise : NoiseCovariance
        Noise of the n readings.
    prior : Gaussian
        Prior of the m parameters p.
    rows : ndarray of int, shape (n,), optional
        Rows of ``matrix`` that belong to the n readings. Default: all rows, in their order.
    """
    def response_and_residual(indices: Ints) -> Floats:
        response = _selected(matrix, indices if rows is None else rows[indices])
        return np.column_stack([response, readings[indices] - response @ prior.mean])

    columns = len(prior.mean) + 1
    found = information_of(lambda: whitened_row_blocks(response_and_residual, noise, columns),
                           (len(readings), columns), prior.root)
    values = found.values
    remaining = 1 / np.sqrt(1 + values**2)
    shift = found.directions @ (found.projected / (1 + values**2))
    log_normalization = float(-np.log(remaining).sum() + noise.log_sqrt_determinant
                              + len(readings) / 2 * np.log(2 * np.pi))
    return LinearPosterior(
        Gaussian(prior.mean + prior.root @ shift, CovarianceFactor(
            root_matrix(prior.root), found.directions, remaining)),
        -found.chi2 / 2 - log_normalization, float(np.sum(values**2 / (1 + values**2))),
        found.chi2 / len(readings), found.discarded)


def posterior(matrix: Floats, readings: Floats, noise: NoiseCovariance,
              prior: Gaussian) -> Gaussian:
    """Return only the posterior distribution of `update`."""
    return update(matrix, readings, noise, prior).distribution


def contraction(prior_sd: Floats, posterior_sd: Floats) -> Floats:
    """Return the posterior contraction 1 - trace(C_1) / trace(C_0) of each block, (blocks,).

    C_0 and C_1 are the prior and posterior covariances of the components of a block's
    magnetization, whose standard deviations are given, (blocks, components) each. The contraction
    is 0 if the readings carry no information about the block, and 1 if they determine it
    completely. It is NaN for a block without prior uncertainty: a missing block.
    """
    before, now = ((sd**2).sum(axis=1) for sd in (prior_sd, posterior_sd))
    return np.asarray(1 - now / np.where(before > 0, before, np.nan))


def whitened_row_blocks(
    rows: Callable[[Ints], Floats], noise: NoiseCovariance, columns: int
) -> Iterator[Floats]:
    """Yield the whitened rows of a matrix in blocks (c, k).

    A whitened reading is a combination of all readings whose noise is correlated with it. Each
    block asks for all rows that its whitened readings combine, wherever these rows are; correlated
    readings may therefore belong to different blocks.

    Parameters
    ----------
    rows : callable
        Returns the rows (c, k) of the matrix with given indices (c,).
    noise : NoiseCovariance
        Noise of all readings.
    columns : int
        Number of columns k of the matrix.
    """
    for block in row_slices(len(noise), columns):
        weights = noise.whitening[block]
        needed, place = np.unique(weights.indices, return_inverse=True)
        shape = weights.shape[0], len(needed)
        if shape[0] == shape[1] == weights.nnz and (np.diff(place) == 1).all():
            yield rows(needed) * weights.data[:, None]  # independent noise
        else:
            yield np.asarray(sparse.csr_array((weights.data, place, weights.indptr), shape=shape)
                             @ rows(needed))


def _selected(matrix: Rows, indices: Ints) -> Floats:
    """Return the rows of a matrix with given indices, without a copy of consecutive ones."""
    if isinstance(matrix, np.ndarray) and (np.diff(indices) == 1).all():
        return matrix[indices[0]:indices[-1] + 1]
    return matrix[indices]


def row_slices(count: int, columns: int, most: int | None = None) -> list[slice]:
    """Return slices that divide the rows of a matrix (count, columns) into blocks.

    A block has at most ``most`` rows (default: `READINGS_AT_ONCE`) and, unless it is a single row,
    at most `NUMBERS_AT_ONCE` entries.
    """
    step = min(most or READINGS_AT_ONCE, max(1, NUMBERS_AT_ONCE // max(1, columns)))
    return slices(count, step)


def information_of(
    blocks: Callable[[], Iterable[Floats]], shape: tuple[int, int],
    root: Floats | CovarianceFactor
) -> Information:
    """Return the information of whitened readings y = A L z + e about z.

    Parameters
    ----------
    blocks : callable
        Returns the rows of [A y] in consecutive blocks (c, m + 1). It is called a second time if
        the Gram matrix turns out to be too badly conditioned.
    shape : tuple of int
        Number of rows in all blocks together, and of columns: (n, m + 1).
    root : ndarray or CovarianceFactor, shape (m, k)
        L; the response to the whitened parameters is W = A L.
    """
    rows, columns = shape
    if rows > columns and columns**2 <= NUMBERS_HELD:
        found = _information_by_product(blocks(), columns, root)
        if found.values.max(initial=0) ** 2 < WORST_CONDITION:
            return found
    return _information_by_rows(
        np.column_stack([block[:, :-1] @ root, block[:, -1]]) for block in blocks())


def _information_by_product(
    blocks: Iterable[Floats], columns: int, root: Floats | CovarianceFactor
) -> Information:
    """Return the information from the eigenvectors of the Gram matrix W'W."""
    product = np.zeros((columns, columns))
    for block in blocks:
        product += block.T @ block
    # by numpy as the products are: scipy's threads would compete with those that just multiplied
    squares, directions = np.linalg.eigh((product[:-1, :-1] @ root).T @ root)
    squares, projected = np.maximum(squares, 0), directions.T @ (product[-1, :-1] @ root)
    return Information(directions, np.sqrt(squares), projected,
                       float(product[-1, -1] - np.sum(projected**2 / (1 + squares))))


def _information_by_rows(blocks: Iterable[Floats]) -> Information:
    """Return the information from the rows [W y], compressed whenever they need too much memory."""
    waiting: list[Floats] = []
    rows, chi2_outside, discarded = 0, 0.0, 0.0
    limit = 0
    for block in blocks:
        waiting.append(block)
        rows += len(block)
        columns = block.shape[1]
        enough = max(columns, READINGS_AT_ONCE)
        limit = max(limit, min(enough, max(1, NUMBERS_HELD // columns)))
        if rows <= limit:
            continue
        held = np.vstack(waiting)
        if enough * columns <= NUMBERS_HELD:
            held = np.asarray(np.linalg.qr(held, mode="r"))
        else:
            held, removed = _without_negligible(held)
            chi2_outside, discarded = chi2_outside + removed[0], discarded + removed[1]
            limit = max(limit, 2 * len(held))
        waiting, rows = [held], len(held)
    held = np.vstack(waiting)
    u, values, directions = linalg.svd(held[:, :-1], full_matrices=False, check_finite=False)
    within = u.T @ held[:, -1]  # y along the columns of U; the remainder has W = 0
    chi2_outside += float(np.sum((held[:, -1] - u @ within) ** 2))
    return Information(directions.T, values, values * within,
                       chi2_outside + float(np.sum(within**2 / (1 + values**2))), discarded)


def _without_negligible(held: Floats) -> tuple[Floats, tuple[float, float]]:
    """Remove the combinations of rows [W y] with negligible singular values of W.

    Returns
    -------
    kept : ndarray, shape (c, k + 1)
        The remaining combinations.
    removed : tuple of float
        Of the removed combinations: the sum of squares of y, and an upper bound of the sum of the
        squared singular values of W.
    """
    squares, vectors = linalg.eigh(held[:, :-1] @ held[:, :-1].T)
    kept = squares > NEGLIGIBLE**2
    gone = vectors[:, ~kept].T @ held[:, -1]
    rounding = np.finfo(float).eps * squares.max(initial=0)  # error of the small eigenvalues
    return vectors[:, kept].T @ held, (float(gone @ gone), float(
        np.maximum(squares[~kept], rounding).sum()))


def predict(matrix: Rows, parameters: Gaussian) -> tuple[Floats, Floats]:
    """Return mean and standard deviation (n,) of the noise-free readings H p."""
    mean, sd = np.empty(len(matrix)), np.empty(len(matrix))
    for block in row_slices(len(matrix), len(parameters.mean)):
        rows = matrix[np.arange(block.start, block.stop)]
        mean[block], sd[block] = rows @ parameters.mean, parameters.sd_of(rows)
    return mean, sd


def whitened(
    residual: Floats, noise: NoiseCovariance, root: Callable[[Ints], Floats], columns: int
) -> Floats:
    """Return residuals (n,), whitened by the covariance of noise and prediction together.

    If the model is right, the whitened residuals are independent and standard normal.

    A covariance ``Sigma + R R'`` can be whitened by any root of its inverse. Here the residuals are
    first whitened by the noise (W), and then by the symmetric root ``(I + A A')^-1/2`` with
    A = W R. The symmetric root changes each noise-whitened residual least, so that a whitened
    residual can still be attributed to its reading. It is applied by the singular values of A,
    which costs as much as one update, whatever the number of readings.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        Measured minus predicted readings. The readings must not have been used in the fit, since
        residuals of training readings are smaller than this covariance says.
    noise : NoiseCovariance
        Noise of the n readings.
    root : callable
        Returns the rows (c, columns) with given indices (c,) of R, a root of the covariance of the
        prediction.
    columns : int
        Number of columns of R.
    """
    by_noise = noise.whiten(residual)
    if not columns:
        return by_noise
    found = information_of(lambda: (
        np.column_stack([block, by_noise[place]]) for place, block in zip(
            row_slices(len(by_noise), columns), whitened_row_blocks(root, noise, columns),
            strict=True)),
        (len(by_noise), columns + 1), stacked_root(sparse.eye_array(columns, format="csr")))
    size = np.sqrt(1 + found.values**2)
    # projected * (1 - 1/size) / values^2, in a form that is finite for singular values of 0
    toward = found.directions @ (found.projected / (size * (1 + size)))
    return by_noise - np.concatenate([
        block @ toward for block in whitened_row_blocks(root, noise, columns)])


Model = Callable[[Floats], Floats]
"""Maps parameters (m,) to readings (n,)."""


@dataclass
class Posterior:
    """The unnormalized posterior of a model, which the chain samples."""

    model: Model
    """Maps parameters (m,) to readings (n,) in T."""
    readings: Floats
    """Shape (n,), in T."""
    noise: NoiseCovariance
    """Noise of the n readings."""
    prior: Gaussian
    """Prior of the m parameters."""
    solves: int = field(default=0, init=False)
    """Number of evaluations of the log likelihood so far; each solves the model once."""

    def log_likelihood(self, parameters: Floats) -> float:
        """Return the log likelihood of parameters (m,), up to a constant."""
        self.solves += 1
        residual = self.noise.whiten(self.model(parameters) - self.readings)
        return -float(residual @ residual) / 2


@dataclass(frozen=True)
class ReferenceMeasure:
    """A Gaussian reference measure in the prior's whitened coordinates z, p = mu_0 + L z.

    ``z = centre + root xi`` is distributed like the reference if xi is standard normal.
    """

    centre: Floats
    """Shape (k,)."""
    root: Floats
    inverse: Floats
    """Square root of the covariance of z, and the inverse of this root. Shape (k, k)."""

    def to_z(self, xi: Floats) -> Floats:
        """Return z (k,) of the reference coordinates xi (k,)."""
        return self.centre + self.root @ xi

    def to_xi(self, z: Floats) -> Floats:
        """Return the reference coordinates xi (k,) of z (k,)."""
        return self.inverse @ (z - self.centre)


def prior_reference(prior: Gaussian) -> ReferenceMeasure:
    """Return the prior as the reference measure."""
    size = prior.root.shape[1]
    return ReferenceMeasure(np.zeros(size), np.eye(size), np.eye(size))


def laplace(
    posterior: Posterior, jacobian: Callable[[Floats], Floats]
) -> tuple[ReferenceMeasure, Floats]:
    """Return Laplace's approximation of the posterior as a reference measure.

    The mode is found by Gauss-Newton steps, which are halved until the posterior density increases;
    the covariance is the inverse of the Gauss-Newton Hessian at the mode.

    ``jacobian``: maps parameters (m,) to the derivatives dq/dp (n, m) of the readings.

    Returns
    -------
    reference : ReferenceMeasure
    mode : ndarray, shape (m,)
        Parameters at the mode.

    Raises
    ------
    SamplingError
        If the mode is not found in 30 steps.
    """
    prior = posterior.prior
    z = np.zeros(prior.root.shape[1])

    def objective(at: Floats) -> float:
        return float(at @ at) / 2 - posterior.log_likelihood(prior.mean + prior.root @ at)

    value = objective(z)
    max_steps = 30  # largest number of Gauss-Newton steps to the mode
    # length of a Gauss-Newton step, in posterior standard deviations, below which the mode counts
    # as found
    mode_tolerance = 1e-3
    for _ in range(max_steps):
        parameters = prior.mean + prior.root @ z
        whitened = posterior.noise.whiten(jacobian(parameters) @ prior.root)
        residual = posterior.noise.whiten(posterior.readings - posterior.model(parameters))
        factor = linalg.cholesky(np.eye(len(z)) + whitened.T @ whitened)  # upper
        step = linalg.cho_solve((factor, False), whitened.T @ residual - z)
        if np.linalg.norm(factor @ step) < mode_tolerance:
            root = linalg.solve_triangular(factor, np.eye(len(z)))
            return ReferenceMeasure(z, root, factor), parameters
        length = 1.0
        while (trial := objective(z + length * step)) > value and length > 1e-6:
            length /= 2
        z, value = z + length * step, min(trial, value)
    raise SamplingError(
        f"The posterior's mode was not found in {max_steps} Gauss-Newton steps: the readings"
        " and the prior disagree, or the noise is understated. Check the study's noise and prior.")


@dataclass(frozen=True)
class Proposal:
    """A proposal that keeps its reference measure, ``xi' = sqrt(1 - s^2) xi + s eta``."""

    reference: ReferenceMeasure
    """Measure in whose coordinates xi the step is taken."""
    step: float
    """Step size s in (0, 1]."""


@dataclass(frozen=True)
class Chain:
    """A Markov chain of samples."""

    samples: Floats
    """Parameters after each step. Shape (steps, m)."""
    accepted: float
    """Fraction of the proposals that were accepted."""
    last: Floats
    """Whitened coordinates z of the last sample, from which the chain can be continued.
    Shape (k,)."""


def sample(
    posterior: Posterior, proposals: Sequence[Proposal], count: int, generator: np.random.Generator,
    start: Floats, first: int = 0,
) -> Chain:
    """Run a Markov chain that uses the proposals in turn; each leaves the posterior invariant.

    Proposals from Laplace's approximation mix fast where the posterior is nearly normal, but the
    approximation may have lighter tails than the posterior. Proposals from the prior should be
    among them: their acceptance weights are bounded, so that the chain reaches the tails too.

    Parameters
    ----------
    posterior : Posterior
        Distribution to sample.
    count : int
        Number of steps; each gives a sample.
    start : ndarray, shape (k,)
        Whitened coordinates z at which the chain starts.
    first : int
        Number of the first step; step i uses the proposal ``i % len(proposals)``.
    """
    prior = posterior.prior

    def parameters_at(z: Floats) -> Floats:
        return np.asarray(prior.mean + prior.root @ z)

    z = start
    value = posterior.log_likelihood(parameters_at(z))
    samples = np.empty((count, len(prior.mean)))
    accepted = 0
    for number in range(count):
        proposal = proposals[(first + number) % len(proposals)]
        xi = proposal.reference.to_xi(z)
        xi_new = (np.sqrt(1 - proposal.step**2) * xi
                  + proposal.step * generator.standard_normal(len(xi)))
        z_new = proposal.reference.to_z(xi_new)
        # log of the ratio of prior and reference densities: proposed minus current value
        weight = float(z @ z - z_new @ z_new - xi @ xi + xi_new @ xi_new) / 2
        value_new = posterior.log_likelihood(parameters_at(z_new))
        if np.log(generator.uniform()) < weight + value_new - value:
            z, value = z_new, value_new
            accepted += 1
        samples[number] = parameters_at(z)
    return Chain(samples, accepted / max(count, 1), z)


MAX_R_HAT = 1.01
MIN_EFFECTIVE = 400.0
"""Limits that the paper cited above recommends: the largest R-hat, and the smallest effective
sample size with which R-hat and the quantiles can be trusted."""


@dataclass(frozen=True)
class ConvergenceDiagnostics:
    """Convergence diagnostics of each of m parameters."""

    r_hat: Floats
    """Rank-normalized split R-hat. Shape (m,)."""
    bulk: Floats
    tail: Floats
    """Effective sample sizes for the mean, and for the 5 and 95 % quantiles. Shape (m,)."""
    mcse: Floats
    """Monte Carlo standard error of the mean, in the parameter's unit. Shape (m,)."""
    chains: int
    samples: int
    """Number of chains, and of the samples of all chains together."""


def assess_convergence(samples: Floats) -> ConvergenceDiagnostics:
    """Return the diagnostics of samples (chains, draws, m)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ArviZ warns on import of its next version
        import arviz  # here, as that takes seconds, which processes of single chains can do without

    data = xr.Dataset({"x": (("chain", "draw", "parameter"), samples)})

    def figure(found: xr.Dataset) -> Floats:
        return np.asarray(found["x"].values, float)

    return ConvergenceDiagnostics(
        figure(arviz.rhat(data)), figure(arviz.ess(data)), figure(arviz.ess(data, method="tail")),
        figure(arviz.mcse(data)), samples.shape[0], samples.shape[0] * samples.shape[1])


def require_convergence(
    found: ConvergenceDiagnostics, names: Sequence[str], effective: float = MIN_EFFECTIVE
) -> None:
    """Check that the chains are long enough and agree with each other.

    Parameters
    ----------
    names : sequence of str
        Names of the parameters, for the error message.
    effective : float
        Smallest effective sample size that is accepted.

    Raises
    ------
    SamplingError
        If the chains are too short or disagree. The message names the worst
        parameter and, for chains that are too short, its autocorrelation time and the number of
        draws that would suffice.
    """
    if not all(np.isfinite(values).all() for values in (found.r_hat, found.bulk, found.tail)):
        raise SamplingError(
            f"The convergence of the chains cannot be judged: {found.samples // found.chains} "
            "draws per chain are too few, or a chain never accepted a proposal. Take several "
            "hundred draws per chain.")
    smallest = np.minimum(found.bulk, found.tail)
    worst = int(np.argmin(smallest))
    if smallest[worst] < effective:
        time = found.samples / smallest[worst]
        raise SamplingError(
            f"The chains are too short: {names[worst]} has {smallest[worst]:.0f} effective samples "
            f"of {found.samples} (autocorrelation time {time:.0f}), where {effective:.0f} are "
            f"needed. Take about {2 * time * effective / found.chains:.0f} draws per chain, and a "
            "tenth more as burn-in.")  # twice: short chains hardly know their autocorrelation time
    apart = int(np.argmax(found.r_hat))
    if found.r_hat[apart] > MAX_R_HAT:
        raise SamplingError(
            f"The chains do not agree on {names[apart]}: its R-hat is {found.r_hat[apart]:.3f}, "
            f"where at most {MAX_R_HAT} is allowed. Take "
            f"{2 * found.samples // found.chains} draws per chain; if that does not help, the "
            "posterior probably has several modes.")
