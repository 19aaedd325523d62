"""Method of moments for the reaction of the recoil permeability of separate blocks."""
