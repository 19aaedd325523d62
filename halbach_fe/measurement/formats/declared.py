"""What a user says of a file that does not say it itself."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Declared:
    """Each is empty if the user says nothing; what file and user both say must agree.

    Attributes
    ----------
    length_unit, field_unit, angle_unit : str
        Of all columns of the kind.
    columns : tuple of str
        What each column is, ``-`` for one to leave out.
    component : str
        x, y or z: of a column that is just B.
    at : mapping of str to float, in m
        Coordinates that the file leaves out, since they are the same everywhere.
    origin_m : tuple of float or None
        Where the origin of the file is, along the magnet's axes.
    decimal_comma : bool
        Whether 0,5 is one half.
    encoding : str
        Of text.
    """

    length_unit: str = ""
    field_unit: str = ""
    angle_unit: str = ""
    columns: tuple[str, ...] = ()
    component: str = ""
    at: dict[str, float] = field(default_factory=dict)
    origin_m: tuple[float, float, float] | None = None
    decimal_comma: bool = False
    encoding: str = "utf-8-sig"
