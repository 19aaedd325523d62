"""The catalogue of effects that the diagnosis searches for, grouped by what they act on.

An effect is a deviation of the real magnet or mapper from the study: a displaced block, a gain
error of a sensor, an iron ring that the study does not mention. Another package adds effects by
entry points of the group ``halbach_fe.effects``; each entry names a sequence of `Effect` objects.
"""

from __future__ import annotations

import importlib
import pkgutil
from importlib import metadata

from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.diagnosis.effects.base import Effect

GROUP = "halbach_fe.effects"


def catalogue() -> tuple[Effect, ...]:
    """Return all effects, those of other packages included, sorted by name.

    Raises
    ------
    StudyError
        If an entry point does not name effects, or repeats the name of another effect.
    """
    found: dict[str, Effect] = {}
    for module in pkgutil.iter_modules(__path__):
        loaded = importlib.import_module(f"{__name__}.{module.name}")
        found.update({effect.name: effect for effect in getattr(loaded, "EFFECTS", ())})
    for entry in metadata.entry_points(group=GROUP):
        for effect in entry.load():
            if not isinstance(effect, Effect) or effect.name in found:
                raise StudyError(must_be(f"entry point {entry.name}", GROUP,
                                         "a sequence of effects with names of their own",
                                         f"{effect!r}", "Correct or remove that package."))
            found[effect.name] = effect
    return tuple(found[name] for name in sorted(found))
