"""Saturating iron and anisotropic magnets in NGSolve, in the formulations that synthetic campaigns
do not use: the vector potential, and an octant.
"""

from __future__ import annotations

import ngsolve as ngs
import numpy as np

from halbach_fe.study.materials import MU_0
from halbach_fe.synthetic.ngsolve_reaction import half_field, newton, permeability
from halbach_fe.synthetic.true_magnet import FroehlichLaw
from halbach_fe.synthetic.true_magnet_of_study import TrueMagnet
from tests.oracles.ngsolve_model import Dipole, even_field


def reluctivity(law: FroehlichLaw, square):
    """mu_0 H / B at B^2 in T^2: the positive root of mu_0 H^2 + (mu_0 h + J_s - B) H = B h."""
    root = ngs.sqrt if isinstance(square, ngs.CoefficientFunction) else np.sqrt
    size, half = root(square + 1e-24), half_field(law)  # the root has no slope at 0
    p = half + law.saturation - size
    return 2 * half / (p + root(p * p + 4 * half * size))


def section_field(magnet: TrueMagnet, mesh: ngs.Mesh, order: int, points: np.ndarray) -> np.ndarray:
    """B (n, 3) in T of a cross-section at points, by the vector potential."""
    space = ngs.H1(mesh, order=order, dirichlet="far")
    u, v = space.TnT()

    def curl(a):
        return ngs.CF((ngs.grad(a)[1], -ngs.grad(a)[0]))

    nu, source = {}, {}
    for number, body in enumerate(magnet.bodies):
        turn = body.orientation.as_matrix()
        nu[f"block{number}"] = (turn @ np.linalg.inv(body.permeability) @ turn.T)[:2, :2]
        source[f"block{number}"] = MU_0 * body.magnetization[:2]
    nu = ngs.CF(mesh.MaterialCF({name: tuple(one.ravel()) for name, one in nu.items()},
                                default=(1.0, 0.0, 0.0, 1.0)), dims=(2, 2))
    source = mesh.MaterialCF({name: tuple(one) for name, one in source.items()},
                             default=(0.0, 0.0))
    form = ngs.BilinearForm(space)
    form += (nu * curl(u)) * curl(v) * ngs.dx("block.*|air")
    form += -source * curl(v) * ngs.dx("block.*")
    if magnet.iron is not None:
        form += (reluctivity(magnet.iron.law, curl(u) * curl(u)) * curl(u) * curl(v)
                 * ngs.dx("iron", bonus_intorder=4))
    solution = ngs.GridFunction(space)
    newton(form, solution)
    field = np.zeros((len(points), 3))
    field[:, :2] = np.array(curl(solution)(mesh(*points[:, :2].T)))
    return field


def potential_reaction(
    dipole: Dipole, law: FroehlichLaw, mesh: ngs.Mesh, order: int, points: np.ndarray,
    remanence: tuple[float, float, float] | None = None,
) -> np.ndarray:
    """What permeability and iron add to B (n, 3) in T at points, by the scalar potential in an
    octant: real materials minus vacuum. With ``remanence`` all blocks have the same, along x.

    The potential vanishes on x = 0, which B crosses at right angles.
    """
    space = ngs.H1(mesh, order=order, dirichlet="far|x0")
    u, v = space.TnT()
    source = mesh.MaterialCF({f"block{b}": remanence or dipole.remanence_of(b)
                              for b in range(dipole.blocks)}, default=(0.0, 0.0, 0.0))
    fields = []
    for real in (True, False):
        mu = mesh.MaterialCF({"block.*": dipole.permeability if real else 1.0}, default=1.0)
        if real:
            mu = mesh.MaterialCF({"iron": permeability(law, ngs.grad(u) * ngs.grad(u))},
                                 default=mu)
        form = ngs.BilinearForm(space)
        form += mu * ngs.grad(u) * ngs.grad(v) * ngs.dx
        form += -source * ngs.grad(v) * ngs.dx("block.*")
        solution = ngs.GridFunction(space)
        newton(form, solution)
        fields.append(even_field(-ngs.grad(solution), mesh, points))
    return fields[0] - fields[1]
