"""The catalogue of effects: what each changes, and the prior widths of its amplitudes.

An effect is a deviation of the real magnet or mapper from the study: a displaced block, a gain
error of a sensor, an iron ring that the study does not mention. Its amplitudes and their prior
standard deviations are the parameters of its entry in a list ``EFFECTS`` of a module here. Another
package adds effects by entry points of the group ``halbach_fe.effects``; each entry names a
sequence of `Effect` objects.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterable, Iterator
from importlib import metadata

from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.diagnosis.effects.base import Effect

GROUP = "halbach_fe.effects"


def catalogue() -> tuple[Effect, ...]:
    """Return all effects, those of other packages included, sorted by name.

    Raises
    ------
    StudyError
        If what lists effects has anything else, or repeats the name of another effect.
    """
    found: dict[str, Effect] = {}
    for source, effects, hint in _lists():
        for effect in effects:
            if not isinstance(effect, Effect) or effect.name in found:
                raise StudyError(must_be(source, GROUP, "a sequence of effects with names of their "
                                         "own", f"{effect!r}", hint))
            found[effect.name] = effect
    return tuple(found[name] for name in sorted(found))


def _lists() -> Iterator[tuple[str, Iterable[object], str]]:
    """Yield what lists effects (modules here, entry points of other packages), its list, and what
    to do if that is wrong.
    """
    for module in pkgutil.iter_modules(__path__):
        loaded = importlib.import_module(f"{__name__}.{module.name}")
        yield (f"module {module.name}", getattr(loaded, "EFFECTS", ()),
               "Give the effect a name of its own.")
    for entry in metadata.entry_points(group=GROUP):
        yield f"entry point {entry.name}", entry.load(), "Correct or remove that package."
