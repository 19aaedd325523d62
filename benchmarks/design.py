"""Design of the published bore of 27 cm beside a plain genetic algorithm.

The problem is that of T. O'Reilly et al., J. Magn. Reson. 307 (2019) 106578, with the radii and
numbers of magnets of their published code: 23 places of two rings of 12 mm cubes, 19 pairs of
radii, and the field in a sphere of 20 cm. The genetic algorithm has their population, number of
generations and rates, and judges designs by the same table of fields as the search, a whole
generation at once::

    python -m benchmarks.run design
"""

from __future__ import annotations

from time import process_time

import numpy as np

from benchmarks.note import Note
from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.design.ring_catalogue import Catalogue
from halbach_fe.design.ring_design import Task, search, task_of
from halbach_fe.response.region import Region
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study

INNER_M = (0.148, 0.151, 0.154, 0.156, *np.arange(0.159, 0.2015, 0.003).round(3).tolist())
NUMBERS = tuple(range(50, 50 + len(INNER_M)))
APART_M, MORE = 0.021, 7
"""Distance of the two layers, and how many more magnets the outer one has."""

POPULATION, GENERATIONS, CROSSED, MUTATED, GENE, TOURNAMENT = 10_000, 100, 0.55, 0.4, 0.05, 3
"""Of the published code."""

SEEDS = 5
CHANGES, MOST_CHANGES = 600, 5000
"""Random changes of the search, and the most until it is as good as the other."""


def study() -> Study:
    """Return the study of the published problem."""
    return parse_study({
        "name": "bore-27cm", "array": {
            "blocks_per_ring": 50, "inner_radius_m": 0.142, "outer_radius_m": 0.154,
            "ring_length_m": 0.012, "remanence_T": 1.37,
            "block": {"shape": "cuboid", "width_m": 0.012, "orientation": "magnetization"}},
        "design": {"rings": 23, "spacing_m": 0.022, "layers_together": True, "layer": [
            {"radii_m": INNER_M, "blocks_per_ring": NUMBERS},
            {"radii_m": [round(radius + APART_M, 3) for radius in INNER_M],
             "blocks_per_ring": [number + MORE for number in NUMBERS]}]},
        "mesh": {"block_size_m": 0.006},
        "observation": {"quantity": "flux_density", "positions": {
            "kind": "points", "points_m": [[0, 0, 0]]}}})


def values(task: Task, population: Ints) -> Floats:
    """Return the deviations (m,) in ppm of designs (m, p)."""
    total = task.offset + np.zeros((len(population), 1))
    for place, table in enumerate(task.table):
        total += table[population[:, place]]
    return task.value(total)


def genetic(task: Task, generator: np.random.Generator) -> float:
    """Return the least deviation in ppm that a genetic algorithm finds."""
    places, options = task.table.shape[:2]
    population = generator.integers(options, size=(POPULATION, places))
    value = values(task, population)
    best = float(value.min())
    for _ in range(GENERATIONS):
        rivals = generator.integers(POPULATION, size=(POPULATION, TOURNAMENT))
        population = population[rivals[np.arange(POPULATION), value[rivals].argmin(axis=1)]]
        ends = np.sort(generator.integers(places + 1, size=(POPULATION // 2, 2)), axis=1)
        inside = (np.arange(places) >= ends[:, :1]) & (np.arange(places) < ends[:, 1:])
        inside &= generator.random((POPULATION // 2, 1)) < CROSSED
        first, second = population[::2].copy(), population[1::2].copy()
        population[::2] = np.where(inside, second, first)
        population[1::2] = np.where(inside, first, second)
        mutated = (generator.random((POPULATION, 1)) < MUTATED) & (
            generator.random(population.shape) < GENE)
        population[mutated] = generator.integers(options, size=int(mutated.sum()))
        value = values(task, population)
        best = min(best, float(value.min()))
    return best


def time_to(task: Task, wanted: float, generator: np.random.Generator) -> float:
    """Return the processor time in s of the search until a deviation in ppm."""
    began = process_time()
    search(task, np.full(len(task.table), len(INNER_M) // 2), MOST_CHANGES, generator, wanted)
    return process_time() - began


def run(note: Note) -> None:
    """Note homogeneity and time beside the genetic algorithm, medians over seeds."""
    catalogue = Catalogue.of(study(), Region.sphere(0.1), 7500.0)
    task = task_of(catalogue, np.zeros(len(catalogue.sample.points)))
    ratio, faster, found = [], [], []
    for seed in range(SEEDS):
        generator = np.random.default_rng(seed)
        began = process_time()
        other = genetic(task, generator)
        spent = process_time() - began
        seconds = time_to(task, other, generator)
        own = search(task, np.full(len(task.table), len(INNER_M) // 2), CHANGES, generator).ppm
        ratio.append(own / other)
        faster.append(seconds / spent)
        found.append(own)
    note("design.homogeneity_over_genetic", float(np.median(ratio)), "ratio",
         f"peak to peak after {CHANGES} changes over that of a genetic algorithm of {POPULATION} x "
         f"{GENERATIONS}; median of {SEEDS} seeds, {min(found):.0f} to {max(found):.0f} ppm")
    note("design.time_over_genetic", float(np.median(faster)), "ratio",
         "processor time until the search is as good as the genetic algorithm at its end; median")
