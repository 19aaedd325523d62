# make demo     the main job on the published profile of the FASER dipole: what is wrong, and what is left
# make test     all tests
# make test-quick  those that take two minutes
# make fuzz     every reader of files, on files that are damaged or made up; half an hour
# make verify-calibration  are the posteriors as sure as they may be?
# make verify-diagnosis    are hidden effects found, and only those?
# make study-faser           the published profile, and the synthetic twin of the whole campaign
# make study-faser-diagnosis what the published profile is a profile of, and what is left
# make study-linear-3d       the paper's linear validation: 576 magnetizations from a map of the bore
# make study-nonlinear-2d  the paper's non-linear validation: 32 magnetizations in a steel ring
# make study-quadrupole    an example: solve, infer and diagnose a quadrupole in its yoke
# make study-cubes         the same of an MRI array of 96 cubes
# make study-mri           an MRI magnet of 3 009 cubes, from its design to its shim tray
# make study-emphatic      a stepped dipole of three bores and two layers, from its drawing
# make study-mri4all       an MRI magnet of 990 cubes, from the table of its design
# make study-mri-large     an MRI magnet of 4 032 cubes in three layers
# make study-mandhala      two rings of square bars
# make study-hybrid-quadrupole  steel poles and free blocks, in cross-section
# make study-mri-plates     eight cubes between two steel plates
# make study-hybrid-undulator  saturating poles between magnets, in 3D
# make study-sensitivity   where the field is sensitive to the blocks, and where to measure it
# make benchmark-scaling   time and memory by blocks, readings, unknowns of the mesh and workers
# Both set up everything they need first (tools/setup.sh).

# Without compiled files beside the sources every process of the tests would compile all again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: docs demo verify-diagnosis study-faser study-faser-diagnosis study-linear-3d verify-calibration study-nonlinear-2d study-sensitivity study-quadrupole study-cubes study-mri study-emphatic study-mri4all study-mri-large study-mandhala study-hybrid-quadrupole study-mri-plates study-hybrid-undulator test test-quick fuzz benchmark benchmark-scaling lint wheel-check setup setup-test clean

demo: setup
	.venv/bin/python studies/faser/diagnose.py -o results/demo --quick

verify-calibration: setup
	.venv/bin/python studies/calibration/run.py -o results/calibration

# Effects are hidden in simulated campaigns; hours, and an interrupted run goes on.
verify-diagnosis: setup-test
	.venv/bin/python studies/diagnosis/run.py -o results/diagnosis

study-faser: setup
	.venv/bin/python studies/faser/run.py -o results/faser
	.venv/bin/python studies/faser/twin.py -o results/faser-twin

study-faser-diagnosis: setup
	.venv/bin/python studies/faser/diagnose.py -o results/faser-diagnosis

study-linear-3d: setup
	.venv/bin/python studies/linear-3d/run.py -o results/linear-3d

study-nonlinear-2d: setup
	.venv/bin/python studies/nonlinear-2d/run.py -o results/nonlinear-2d

# Their campaigns were simulated by `halbach-fe simulate-measurement`; each has something hidden.
study-quadrupole study-cubes: study-%: setup
	.venv/bin/halbach-fe solve studies/$*/study.toml -o results/$*/field
	.venv/bin/halbach-fe demagnetization studies/$*/study.toml -o results/$*/demagnetization
	.venv/bin/halbach-fe infer studies/$*/study.toml --measurements studies/$*/campaign/map.csv \
	    --blocks studies/$*/campaign/blocks.csv --held-out studies/$*/campaign/held-out.csv \
	    -o results/$*/inferred
	.venv/bin/halbach-fe diagnose studies/$*/study.toml --measurements studies/$*/campaign/map.csv \
	    --blocks studies/$*/campaign/blocks.csv --held-out studies/$*/campaign/held-out.csv \
	    -o results/$*/diagnosis

# What the language of magnets can describe; the campaigns are simulated on the spot, with nothing
# hidden, so that the diagnosis should find nothing.
study-emphatic study-mri4all study-mri-large study-mandhala study-hybrid-quadrupole study-mri-plates study-hybrid-undulator: study-%: setup-test
	.venv/bin/halbach-fe solve studies/$*/study.toml -o results/$*/field
	.venv/bin/halbach-fe verify studies/$*/study.toml -o results/$*/verified
	test -e results/$*/campaign/map.csv || .venv/bin/halbach-fe simulate-measurement \
	    studies/$*/study.toml --seed 1 -o results/$*/campaign
	.venv/bin/halbach-fe infer studies/$*/study.toml -o results/$*/inferred \
	    --measurements results/$*/campaign/map.csv --held-out results/$*/campaign/held-out.csv
	.venv/bin/halbach-fe diagnose studies/$*/study.toml -o results/$*/diagnosis \
	    --measurements results/$*/campaign/map.csv --held-out results/$*/campaign/held-out.csv

# The measured magnets, each on one page: raw map, Maxwell's check, where the map lies, the updated
# blocks, what is missing.
study-emphatic: results/emphatic/measured.html
study-mri4all: results/mri4all/measured.html

EMPHATIC_PROBE := studies/emphatic/measured/probe_calibration.csv
results/emphatic/body.csv: studies/emphatic/measured/body_scan.csv $(EMPHATIC_PROBE) | setup
	.venv/bin/halbach-fe import-map $< -o $@ --calibration $(EMPHATIC_PROBE) \
	    --columns "x[inch],y[inch],z[inch],-,Bx[T],By[T],Bz[T],t[s],-"
results/emphatic/fringe.csv: studies/emphatic/measured/small_aperture_fringe.csv $(EMPHATIC_PROBE) | setup
	.venv/bin/halbach-fe import-map $< -o $@ --calibration $(EMPHATIC_PROBE) \
	    --columns "x[inch],y[inch],z[inch],-,Bx[T],By[T],Bz[T],-"
results/emphatic/%/check.html: results/emphatic/%.csv
	.venv/bin/halbach-fe check $< -o $(@D)
results/mri4all/map.csv: studies/mri4all/measured/cube_10cm_11_steps.csv | setup
	.venv/bin/halbach-fe import-map $< -o $@ "--columns=-,dx[mm],dy[mm],dz[mm],Bx[G],By[G],Bz[G],-,-"
results/%/check/check.html: results/%/map.csv
	.venv/bin/halbach-fe check $< -o $(@D)
results/emphatic/registered/study.registered.toml: results/emphatic/body/check.html \
    results/emphatic/fringe/check.html results/emphatic/joined/joined.html
	.venv/bin/halbach-fe register studies/emphatic/measured/study.toml -o $(@D) \
	    --joined results/emphatic/joined/joined.json
results/mri4all/registered/registration.html: results/mri4all/check/check.html
	.venv/bin/halbach-fe register studies/mri4all/measured/study.toml -o $(@D) \
	    --measurements results/mri4all/check/corrected_map.csv
results/emphatic/measured/report.html: results/emphatic/registered/study.registered.toml
	.venv/bin/halbach-fe infer $< -o $(@D)
results/mri4all/measured/report.html: results/mri4all/registered/registration.html
	.venv/bin/halbach-fe infer results/mri4all/registered/study.registered.toml -o $(@D) \
	    --measurements results/mri4all/check/corrected_map.csv
results/mri4all/diagnosed/diagnosis.html: results/mri4all/measured/report.html
	.venv/bin/halbach-fe diagnose results/mri4all/registered/study.registered.toml -o $(@D) \
	    --measurements results/mri4all/check/corrected_map.csv --check results/mri4all/check/check.json
# One stage was shifted between both maps: where they overlap, they test it without a magnet.
results/emphatic/joined/joined.html: results/emphatic/body.csv results/emphatic/fringe.csv
	.venv/bin/halbach-fe check $^ --turn-rad 0.001 -o $(@D)
results/emphatic/measured.html: results/emphatic/measured/report.html results/emphatic/joined/joined.html
	.venv/bin/halbach-fe report $(addprefix results/emphatic/,joined registered measured) -o $@
results/mri4all/measured.html: results/mri4all/diagnosed/diagnosis.html
	.venv/bin/halbach-fe report $(addprefix results/mri4all/,check registered measured diagnosed) -o $@

# In the sphere of the map: the nominal magnet, the updated one, and the readings themselves.
study-mri4all: results/mri4all/homogeneity/homogeneity.html
results/mri4all/homogeneity/homogeneity.html: results/mri4all/measured/report.html
	.venv/bin/halbach-fe homogeneity results/mri4all/registered/study.registered.toml -o $(@D) \
	    --posterior results/mri4all/measured/posterior.h5 --sphere-m 0.045 \
	    --measurements results/mri4all/check/corrected_map.csv

# Everything between the wish and the shimmed magnet, on one page.
study-mri: setup-test
	.venv/bin/python studies/mri/run.py -o results/mri

study-sensitivity: setup
	.venv/bin/python studies/sensitivity/run.py -o results/sensitivity

# Each core has a worker already: more threads of the linear algebra would wait for each other.
test test-quick: setup-test
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 .venv/bin/python -m pytest -n auto --dist loadfile --no-loadscope-reorder $(if $(filter test-quick,$@),-m quick)

# What breaks a promise of tests/fuzz/contract.py is kept in build/fuzz; SEED=2 tries other files.
SECONDS = 60
SEED = 1
fuzz: setup-test
	.venv/bin/python -m tests.fuzz --seconds $(SECONDS) --seed $(SEED)

# The figures of README and docs, ratios measured in one run.
benchmark: setup-test
	.venv/bin/python -m benchmarks.run

# How time and memory grow, up to 10 240 blocks and a million readings: a quarter of an hour.
benchmark-scaling: setup-test
	.venv/bin/python -m benchmarks.run scaling

# Pages of docs/, into build/docs.
docs: setup-test
	.venv/bin/python -m sphinx -q -W --keep-going -b html docs build/docs

lint: setup-test
	.venv/bin/ruff check .
	.venv/bin/python tools/check_types.py

# The wheel, alone in a clean environment outside the checkout, solves a study.
wheel-check: setup
	tools/check_wheel.sh

setup:
	tools/setup.sh

setup-test:
	tools/setup.sh test

clean:
	rm -rf .venv build dist results *.egg-info
