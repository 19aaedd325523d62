"""What blocks have lost of their remanence in the field that they are in, for good.

A block that is driven past the knee of its demagnetization curve keeps a part of its remanence
only, and the loss changes the field that the others are in. In every cell the polarization along
the easy axis u is ``J = B_r p(h) + chi h`` with ``h = mu_0 H . u``, and
``p(h) = tanh((h + h_c) / (2 w))``: nearly 1 above the knee, 0.9 at it, and 0 at ``-h_c``, for
``h_c = mu_0 H_cJ`` and a width w that follows from the squareness ``H_k / H_cJ``. This is the major
branch of the hysteresis loop on which magnets are that have been saturated and then assembled;
nothing has driven them back since.

The equations are those of `halbach_fe.solver.moments.solve` with that J in place of a constant
remanence. Newton's method solves them, each step by GMRES. The operator ``J - p(H(J))`` is
monotone, since p grows with H and the field of polarized cells opposes them.

Losses lie along the edges of blocks, in layers that are thinner than a cell, and p is steep there.
That of the mean of h over a cell is too small a loss, and the mean of p at nodes of the cell is too
large a one if the cell is polarized uniformly: what is lost at one node raises h there. Therefore J
about a node may differ by d from the mean of its cell, and h is less by `TUBE` times d. The means
of J make the field that the nodes are in.

In one ring of 12 cuboids with coercivities of 0.63 to 0.73 T and squarenesses of 0.8 and 0.9,
relative to the field of the losses extrapolated from 6 and 8 cells a side: 3 cells a side leave a
difference of 0.03 to 0.10 of it, rms, and 4 cells as much. The law of the mean leaves 0.17 to 1.01
with 3 cells, 0.10 to 0.72 with 4 and 0.03 to 0.22 with 8. What is left is mostly too large a loss,
which finer cells do not cure: by up to 0.12 of the field near one or two cubes, and by a third of
the mean loss where that is less than a hundredth of the remanence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse.linalg import LinearOperator, gmres

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachError
from halbach_fe.solver.moments.solve import Applied, Moments, System
from halbach_fe.study.magnet import Demagnetization
from halbach_fe.study.materials import MU_0

TUBE = 1 / 2
"""Field within a long tube that is polarized across, relative to its polarization: such tubes are
what is lost along the edges."""


@dataclass(frozen=True)
class KneeLaw:
    """A demagnetization curve with a knee, or those of cells (n,) of several materials."""

    coercivity_T: float | Floats
    """mu_0 H_cJ. Shape () or (n,)."""
    squareness: float
    """Ratio of H_k, where a tenth of the remanence is lost, to H_cJ; below 1."""

    @classmethod
    def of(cls, material: Demagnetization) -> KneeLaw:
        """Return the law of a study's material that has been at its temperature.

        There the blocks are weaker, and so is the field that they are in. The part that is left at
        ``B_r`` with the coercivity ``h_c / (1 + a)`` is that at ``(1 + a) B_r`` with ``h_c``: all
        fields are as much weaker as the remanence, but for those of other sources.
        """
        hotter = material.temperature_C - material.reference_temperature_C
        coercivity, remanence = (1 + hotter * each for each in (
            material.coercivity_coefficient_per_K, material.remanence_coefficient_per_K))
        return cls(MU_0 * material.intrinsic_coercivity_A_per_m * coercivity / remanence,
                   material.squareness)

    def _at(self, field: Floats) -> tuple[Floats, Floats]:
        """Return the coercivity and the width w in T for fields (n, ...) of the cells."""
        # part of the remanence that is left at the knee, by the definition of H_k in IEC 60404-8-1
        at_knee = 0.9
        own = np.asarray(self.coercivity_T)
        own = own.reshape(own.shape + (1,) * (np.ndim(field) - own.ndim))
        return own, own * (1 - self.squareness) / (2 * float(np.arctanh(at_knee)))

    def kept(self, field: Floats) -> Floats:
        """Return the part p of the remanence that is left at mu_0 H . u = ``field``, in T."""
        coercivity, width = self._at(field)
        return np.asarray(np.tanh((field + coercivity) / (2 * width)))

    def slope(self, field: Floats) -> Floats:
        """Return the derivative of `kept` in 1/T."""
        return np.asarray((1 - self.kept(field)**2) / (2 * self._at(field)[1]))

    def kept_in_tubes(self, field: Floats, strength: Floats, mean: Floats) -> tuple[Floats, Floats]:
        """Return the part p that is left where a loss raises the field, and dp / dfield in 1/T.

        They fulfil ``p = kept(field - TUBE (strength p - mean))`` for a remanence ``strength`` and
        a mean polarization ``mean`` of the surroundings along the easy axis, both in T. Arrays of
        all arguments are broadcast.
        """
        least, most = -np.ones(field.shape), np.ones(field.shape)
        bisections = 40  # steps of the bisection for the part of the remanence at a node, to 1e-12
        for _ in range(bisections):
            part = (least + most) / 2
            is_above = part > self.kept(field - TUBE * (strength * part - mean))
            least, most = np.where(is_above, least, part), np.where(is_above, part, most)
        slope = self.slope(field - TUBE * (strength * part - mean))
        return part, slope / (1 + TUBE * strength * slope)


def solve_irreversible(
    system: System, law: KneeLaw, applied: Applied | None = None, *, by_mean: bool = False
) -> tuple[Moments, Floats]:
    """Return the polarization of blocks that have lost remanence, and the loss.

    Parameters
    ----------
    system : System
        The cells with the remanence that they had when they were saturated.
    applied : callable, optional
        mu_0 H of other sources, such as iron.
    by_mean : bool
        Whether the loss of a cell is that of the mean field in it, which is too small.

    Returns
    -------
    moments : Moments
        The polarization less the original remanence.
    lost : ndarray, shape (cells,), in T
        Mean loss in every cell.

    Raises
    ------
    HalbachError
        If Newton's method does not come to rest.
    """
    interaction, chi, cells = system.interaction, system.susceptibility, system.interaction.cells
    strength = np.linalg.norm(system.remanence, axis=1)
    easy = system.remanence / np.where(strength > 0, strength, 1.0)[:, None]
    outer = np.zeros_like(cells.nodes)
    if applied is not None:
        outer = applied(cells.nodes.reshape(-1, 3)).reshape(cells.nodes.shape)

    outer_along, outer_mean = np.einsum("nqi,ni->nq", outer, easy), cells.mean(outer)

    def kept(along: Floats, polarization: Floats) -> tuple[Floats, Floats]:
        """Return p and dp/dh in 1/T at the nodes (cells, q) in the field along the easy axis."""
        return law.kept_in_tubes(
            along, strength[:, None], np.einsum("ni,ni->n", polarization, easy)[:, None])

    field_of = None if by_mean else interaction.field_along(easy)

    def state(polarization: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the mean field (cells, 3) in T, and the means of p and of dp/dh (cells,)."""
        if field_of is None:
            field = interaction.mean_field(polarization) + outer_mean
            along = np.einsum("ni,ni->n", field, easy)
            return field, law.kept(along), law.slope(along)
        along, field = field_of(polarization)
        part, slope = kept(along + outer_along, polarization)
        return (field + outer_mean, np.einsum("nq,nq->n", cells.weights, part),
                np.einsum("nq,nq->n", cells.weights, slope))

    polarization, part, steps = _uniform(system, strength, easy, state, 0.0 if by_mean else TUBE)
    # the polarization about the nodes differs as the field there does; its means stay
    field = interaction.node_field(polarization) + outer
    along = np.einsum("nqi,ni->nq", field, easy)
    at_nodes = law.kept(along) if by_mean else kept(along, polarization)[0]
    by_node = np.einsum("nij,nqj->nqi", chi, field) + (
        strength[:, None] * at_nodes)[..., None] * easy[:, None]
    by_node += (polarization - cells.mean(by_node))[:, None]
    return (Moments(interaction, by_node - system.remanence[:, None], system.blocks, steps,
                    system.largest_susceptibility),
            np.asarray(strength * (1 - part)))


def _uniform(
    system: System, strength: Floats, easy: Floats,
    state: Callable[[Floats], tuple[Floats, Floats, Floats]], tube: float
) -> tuple[Floats, Floats, int]:
    """Return the mean polarizations (cells, 3) in T, the mean part (cells,) of the remanence that
    is left, and the number of Newton's steps.

    ``strength`` (cells,) in T and ``easy`` (cells, 3) are amount and direction of the remanence.
    ``state`` takes the polarization (cells, 3) in T and returns the mean of mu_0 H (cells, 3) in T,
    that part, and its derivative by the field in 1/T; by the polarization along the easy axis it is
    ``tube`` times as large.
    """
    interaction, chi = system.interaction, system.susceptibility
    scale = float(strength.max(initial=0.0))

    def residual(polarization: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the residual (cells, 3) in T, the part that is left, and its derivative."""
        field, part, slope = state(polarization)
        return (polarization - (strength * part)[:, None] * easy
                - np.einsum("nij,nj->ni", chi, field)), part, slope

    polarization = system.remanence
    left, part, slope = residual(polarization)
    # largest residual of a polarization, relative to the remanence, that ends Newton's method.
    # Losses are some 10 % where they matter, and the coercivity is hardly known to 1 %.
    tolerance = 1e-4
    # largest number of Newton's steps, and of halvings of one of them
    most_steps, most_halvings = 40, 6
    # residual that ends GMRES, relative to its right-hand side, and its largest number of steps
    gmres_tolerance, gmres_steps = 0.05, 30
    # degree of the expansions within GMRES, whose result only has to point the right way
    degree = 3
    # field of a cell in itself relative to its polarization, for the preconditioner: that of a cube
    own_field = 1 / 3
    for count in range(most_steps):
        size = float(np.linalg.norm(left))
        if np.abs(left).max(initial=0.0) <= tolerance * scale:
            return polarization, part, count
        by_field = (strength * slope)[:, None, None] * (easy[:, :, None] * easy[:, None])
        tangent, own = chi + by_field, np.eye(3) - tube * by_field

        def times(vector: Floats, tangent: Floats = tangent, own: Floats = own) -> Floats:
            step = vector.reshape(-1, 3)
            field = interaction.mean_field(step, degree)
            return np.asarray(np.einsum("nij,nj->ni", own, step)
                              - np.einsum("nij,nj->ni", tangent, field)).ravel()

        inverse = np.asarray(np.linalg.inv(own + own_field * tangent), float)

        def precondition(vector: Floats, inverse: Floats = inverse) -> Floats:
            return np.einsum("nij,nj->ni", inverse, vector.reshape(-1, 3)).ravel()

        unknowns = (left.size, left.size)
        step, _ = gmres(LinearOperator(unknowns, times, dtype=float), -left.ravel(),
                        rtol=gmres_tolerance, restart=gmres_steps, maxiter=1,
                        M=LinearOperator(unknowns, precondition, dtype=float))
        step = step.reshape(-1, 3)
        for halving in range(most_halvings):
            tried = polarization + step / 2**halving
            left, part, slope = residual(tried)
            if np.linalg.norm(left) < size:
                break
        polarization = tried
    raise HalbachError(
        f"The irreversible losses of the blocks do not settle in {most_steps} steps: the last left "
        f"{np.abs(left).max() / scale:.1e} of the remanence. Please report this with the study.")
