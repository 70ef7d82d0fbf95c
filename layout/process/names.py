"""Names that every mask reader takes."""

import re

from metalens.core.errors import ProcessError

LONGEST = 32
_ILLEGAL = re.compile(r"[^A-Za-z0-9_$]")


def check_cell_name(name: str) -> str:
    """``name``, if GDSII and OASIS allow it: 1 to 32 letters, digits, ``_`` or ``$``.

    Raises:
        ProcessError: any other name; a legal one is proposed.
    """
    if 0 < len(name) <= LONGEST and not _ILLEGAL.search(name):
        return name
    raise ProcessError(
        f"cell name {name!r}: need 1 to {LONGEST} of A-Z a-z 0-9 _ $; for example {legal_cell_name(name)!r}"
    )


def legal_cell_name(text: str) -> str:
    """The nearest legal name to any text."""
    return (
        _ILLEGAL.sub("_", text.encode("ascii", "replace").decode())[:LONGEST] or "LENS"
    )


def check_distinct_names(names: list[str]) -> None:
    """Refuse a name that is used twice.

    Args:
        names: of all cells.

    Raises:
        ProcessError: two cells of one name.
    """
    used: set[str] = set()
    for name in names:
        if check_cell_name(name) in used:
            raise ProcessError(f"two cells are named {name!r}; give each its own name")
        used.add(name)
