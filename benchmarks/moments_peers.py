"""Run another program on cuboids with recoil permeability: ``PEER CELLS INPUT OUTPUT``.

PEER is ``material_response`` (magpylib-material-response) or ``magtense`` (MagTense). It runs in an
interpreter that has it, which need not be that of halbach-fe, and so imports nothing of
halbach-fe. Every cuboid is divided into CELLS^3 cells. INPUT holds centres, axes (as columns),
sides, polarizations and points; OUTPUT receives the reaction at the points and the seconds it took.
"""

from __future__ import annotations

import sys
import time
from importlib import import_module
from typing import Any

import numpy as np

MU_0 = 4e-7 * np.pi


def cells(data: Any, number: int) -> tuple[Any, Any, Any, Any]:
    """Centres (n, 3), axes (n, 3, 3), sides (n, 3) and polarizations (n, 3) of all cells."""
    t = (np.arange(number) + 0.5) / number - 0.5
    local = np.stack(np.meshgrid(t, t, t, indexing="ij"), -1).reshape(-1, 3)
    centres = data["centres"][:, None] + np.einsum(
        "bij,sj->bsi", data["axes"], local * data["sides"][0])
    each = number**3
    return (centres.reshape(-1, 3), np.repeat(data["axes"], each, axis=0),
            np.repeat(data["sides"] / number, each, axis=0),
            np.repeat(data["polarizations"], each, axis=0))


def material_response(data: Any, number: int) -> Any:
    """The reaction by magpylib-material-response, at its default settings."""
    from scipy.spatial.transform import Rotation

    magpylib = import_module("magpylib")
    apply_demag = import_module("magpylib_material_response.demag").apply_demag

    def field(bodies: Any) -> Any:
        return magpylib.getB(list(bodies), data["points"], sumup=True)

    bodies = magpylib.Collection(*(
        magpylib.magnet.Cuboid(position=centre, dimension=sides, polarization=axes.T @ polarization,
                               orientation=Rotation.from_matrix(axes))
        for centre, axes, sides, polarization in zip(*cells(data, number), strict=True)))
    return field(apply_demag(bodies, susceptibility=float(data["chi"]))) - field(bodies)


def magtense(data: Any, number: int) -> Any:
    """The reaction by MagTense; cuboids are turned about z only."""
    sys.setdlopenflags(1)  # symbols of CUDA, which is not used, are never looked up
    magstatics = import_module("magtense.magstatics")

    centres, axes, sides, polarizations = cells(data, number)
    tiles = magstatics.Tiles(
        n=len(centres), center_pos=centres, size=sides, tile_type=2, offset=centres,
        M_rem=list(np.linalg.norm(polarizations, axis=1) / MU_0),
        easy_axis=list(polarizations), mu_r_ea=float(1 + data["chi"]),
        mu_r_oa=float(1 + data["chi"]),
        rot=np.column_stack([0 * centres[:, 0], 0 * centres[:, 0],
                             np.arctan2(axes[:, 1, 0], axes[:, 0, 0])]))
    before = magstatics.get_H_field(tiles, data["points"])
    magstatics.iterate_magnetization(tiles, max_error=1e-8)
    return MU_0 * (magstatics.get_H_field(tiles, data["points"]) - before)


def main() -> None:
    """Solve twice, the second time with everything loaded, and write the result."""
    peer, number, source, target = sys.argv[1:]
    with np.load(source) as data:
        solve = {"material_response": material_response, "magtense": magtense}[peer]
        solve({**data, **{key: data[key][:2] for key in (
            "centres", "axes", "sides", "polarizations", "points")}}, 1)
        started = time.monotonic()
        reaction = solve(data, int(number))
        np.savez(target, reaction=reaction, seconds=time.monotonic() - started)


if __name__ == "__main__":
    main()
