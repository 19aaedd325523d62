"""Other people's solvers, and the studies' numbers for them."""

import numpy as np

from halbach_fe.blocks import blocks_of
from halbach_fe.study import IronRing, Study
from tests.oracles import ngsolve_model, ngsolve_nonlinear


def dipole_of(study: Study) -> ngsolve_model.Dipole:
    """The numbers of a study of rings of sectors."""
    array, iron = study.array, study.iron_ring
    return ngsolve_model.Dipole(
        array.blocks_per_ring, array.inner_radius_m, array.outer_radius_m,
        array.rings * (array.ring_length_m or 0.0), blocks_of(study)[0].remanence,
        array.recoil_permeability,
        iron=iron and (iron.inner_radius_m, iron.outer_radius_m, iron.relative_permeability))


def section_of(study: Study) -> ngsolve_nonlinear.Section:
    """The numbers of a 2D study of sectors, its iron with a curve after Froehlich and Kennelly."""
    array, ring, blocks = study.array, study.iron_ring, blocks_of(study)
    return ngsolve_nonlinear.Section(
        array.inner_radius_m, array.outer_radius_m,
        np.array([block.magnetization[:2] for block in blocks]),
        np.array([np.arctan2(block.easy_axis[1], block.easy_axis[0]) for block in blocks]),
        array.recoil_permeability, array.recoil_permeability_across or array.recoil_permeability,
        np.radians(array.first_block_angle_deg), iron=ring and iron_of(ring))


def iron_of(ring: IronRing) -> ngsolve_nonlinear.Iron:
    """The numbers of a ring with a curve after Froehlich and Kennelly."""
    return ngsolve_nonlinear.Iron(
        ring.inner_radius_m, ring.outer_radius_m, ring.curve.initial_relative_permeability,
        ring.curve.saturation_polarization_T)
