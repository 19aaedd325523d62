"""Progress of the command line where stderr is no terminal."""

from __future__ import annotations

import pytest

from halbach_fe.cli.common import progress_bar
from halbach_fe.core import progress


@pytest.mark.parametrize("told", [True, False])
def test_lines_in_place_of_a_bar(capsys, monkeypatch, told):
    """Control: a verb that tells its steps itself is not told twice."""
    monkeypatch.setattr(progress, "QUIET_S", 0.0)
    with progress_bar("solving", told) as show:
        for done in (0, 8, 50, 100):
            show(done, 100)
    said = capsys.readouterr()
    assert ("solving: 50 of 100, about 0 s left" in said.out + said.err) is told
