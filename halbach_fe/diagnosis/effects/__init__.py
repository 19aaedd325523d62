"""The catalogue of effects that a model may lack, each in a file of its own.

A package adds its own by the entry point group ``halbach_fe.effects``, whose entries name
a sequence of `Effect` objects.
"""

from __future__ import annotations

import importlib
import pkgutil
from importlib import metadata

from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.diagnosis.effects.base import Effect

GROUP = "halbach_fe.effects"


def catalogue() -> tuple[Effect, ...]:
    """All effects, by name."""
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
