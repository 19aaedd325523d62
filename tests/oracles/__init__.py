"""Other people's solvers, and the studies' numbers for them."""

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.model import Study
from tests.oracles import ngsolve_model


def dipole_of(study: Study) -> ngsolve_model.Dipole:
    """The numbers of a study of rings of sectors."""
    array, iron = study.array, study.iron_ring
    return ngsolve_model.Dipole(
        array.blocks_per_ring, array.inner_radius_m, array.outer_radius_m,
        array.rings * (array.ring_length_m or 0.0), build_magnet(study).blocks[0].remanence,
        array.recoil_permeability,
        iron=iron and (iron.inner_radius_m, iron.outer_radius_m, iron.relative_permeability))
