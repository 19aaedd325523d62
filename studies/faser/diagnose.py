"""The first FASER dipole: what the model lacks, by the published on-axis profile.

One component on one line tells little: many effects look alike there, and the published noise of
the fringe field is larger than most. The result is what the readings support, with the assumptions
of `run.py` beside it::

    python studies/faser/diagnose.py -o results/faser-diagnosis
"""

from __future__ import annotations

import argparse
import sys

from run import HERE, assumptions, options, profile_to_map, with_step

from halbach_fe.cli import common
from halbach_fe.cli.diagnose import print_diagnosis
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.discriminating_measurements import separations
from halbach_fe.measurement.field_map import read_map
from halbach_fe.report.result_files import write_diagnosis
from halbach_fe.study.reader import read_study


def run(arguments: argparse.Namespace) -> int:
    """Diagnose the published profile, write everything, print what was found."""
    measured = arguments.output / "measured.csv"
    profile_to_map(HERE / "fig4_faser_on_axis.csv", measured, arguments.z_step_m)
    study = with_step(read_study(arguments.study), arguments.z_step_m)
    data = read_map(measured)
    with common.session(arguments) as session:
        found = diagnose(study, data, session, say=common.say)
        next_ones = separations(found, data, session)
    assumed = assumptions(found.before, arguments.z_step_m)
    text = arguments.study.read_text(encoding="utf-8")
    write_diagnosis(found, next_ones, study, text, arguments.output, assumed)
    common.say("Assumed:\n" + "\n".join(f"- {one}" for one in assumed))
    print_diagnosis(found, arguments.output)
    return 0


if __name__ == "__main__":
    sys.exit(common.run_study(__doc__ or "", HERE / "study.toml", "faser-diagnosis", run, options))
