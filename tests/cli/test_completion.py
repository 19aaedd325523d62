"""The completion script, asked by bash."""

from __future__ import annotations

import subprocess

import pytest

from halbach_fe.cli import main
from halbach_fe.cli.verbs import VERBS

ASK = """source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
$(complete -p halbach-fe | sed 's/.*-F \\([^ ]*\\).*/\\1/'); printf '%s\\n' "${COMPREPLY[@]}" """


def completed(script, *words):
    """What bash proposes for the last word."""
    done = subprocess.run(["bash", "-c", ASK, "bash", script, *words], check=True,
                          capture_output=True, text=True)
    return done.stdout.split()


def test_verbs_and_options_are_completed(tmp_path, capsys):
    assert main(["completion", "bash"]) == 0
    script = tmp_path / "halbach-fe.bash"
    script.write_text(capsys.readouterr().out)
    assert set(completed(script, "halbach-fe", "")) >= set(VERBS)
    assert completed(script, "halbach-fe", "dia") == ["diagnose"]
    assert "--measurements" in completed(script, "halbach-fe", "infer", "--mea")
    assert completed(script, "halbach-fe", "nothing-like-it") == []


def test_other_shells_are_refused(capsys):
    with pytest.raises(SystemExit) as refused:
        main(["completion", "fish"])
    assert refused.value.code == 2
    assert "bash" in capsys.readouterr().err
