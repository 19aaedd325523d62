"""What every page says first, and the terminal too: the answer, how far to trust it, what next."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path


@dataclass(frozen=True)
class Answer:
    """The answer of a command in plain words.

    Attributes
    ----------
    question : str
        What was asked.
    said : str
        The answer, with its uncertainty.
    trust : str
        Whether it can be trusted, and why not.
    step : str
        What to do next.
    command : str
        The command for that, in which STUDY, MAP, BLOCKS and POSTERIOR stand for files of the user,
        ``DIR/`` for the folder of this command, and a single DIR for another one; empty if no
        command does it.
    sound : bool
        Whether the answer may be used as it stands. Otherwise its box is a warning.
    """

    question: str
    said: str
    trust: str
    step: str
    command: str = ""
    sound: bool = True

    @property
    def sentences(self) -> tuple[str, str, str]:
        """What the terminal says before the command."""
        return self.said, self.trust, f"Next: {self.step}"

    def with_paths(self, paths: Mapping[str, object]) -> Answer:
        """Return the answer with the paths that are known in place of the words of its command."""
        def known(word: str) -> str:
            name, slash, rest = word.partition("/")
            path = paths.get(name)
            if path is None or (name == "DIR") != bool(slash):
                return word
            return shlex.quote(str(Path(str(path), rest)))

        return replace(self, command=" ".join(map(known, self.command.split(" "))))


def agreement(disagreement: str | None) -> str:
    """Say that an answer may be trusted whose update agrees with its map, or is not known to."""
    return ("Yes, as far as the update agrees with its map, which its own page says."
            if disagreement is None else "Yes: the update agrees with its map.")


def of_a_conflict(question: str, said: str, disagreement: str) -> Answer:
    """Return an answer from an update that disagrees with its map, which is not to be trusted."""
    return Answer(
        question, said, f"No. It is that of an update that disagrees with its map. {disagreement}",
        "Look for what the study lacks, and update again, before you use these numbers.",
        "halbach-fe diagnose STUDY --measurements MAP -o DIR", sound=False)
