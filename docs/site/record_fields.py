"""Descriptions of the fields of a record, from its docstring."""

import dataclasses
import inspect
import re
from typing import Any

# ``name:`` or ``name, other:`` in the docstring of a record
KEY = re.compile(r"(?<!\S)((?:\w+,\s+)*\w+):\s")


def describe_fields(record: type[Any]) -> dict[str, str]:
    """{field: its description in the docstring of a record}.

    A description is ``name: text`` or ``name, other: text``, up to an empty line.
    """
    names = {entry.name for entry in dataclasses.fields(record)}
    doc = inspect.getdoc(record) or ""
    if doc.startswith(
        f"{record.__name__}("
    ):  # the signature that stands for a docstring
        return {}
    matches = [
        candidate
        for candidate in KEY.finditer(doc)
        if set(re.split(r",\s+", candidate.group(1))) <= names
    ]
    descriptions: dict[str, str] = {}
    for match, following in zip(matches, [*matches, None][1:], strict=True):
        text = doc[match.end() : following.start() if following else len(doc)].split(
            "\n\n"
        )[0]
        for name in re.split(r",\s+", match.group(1)):
            descriptions.setdefault(name, " ".join(text.split()).rstrip(" ;."))
    return descriptions
