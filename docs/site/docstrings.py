"""How docstrings become pages: fields of records as lists, roles as links (a griffe
extension, see mkdocs.yml).
"""

import importlib
import re
import sys
from pathlib import Path
from typing import Any

import griffe

sys.path.insert(0, str(Path(__file__).parent))
record_fields: Any = importlib.import_module("record_fields")
_NAMED = re.compile(r"^::: ([\w.]+)$", re.M)
_ROLE = re.compile(r":(?:func|class|mod|meth|attr):`~?([\w.]+)`")
_REFERENCE = Path(__file__).parents[1] / "reference" / "api.md"


class Docstrings(griffe.Extension):
    """Rewrites docstrings in the words that mkdocstrings sets."""

    def __init__(self) -> None:
        self.named = set(_NAMED.findall(_REFERENCE.read_text(encoding="utf-8")))

    def _linked(self, found: "re.Match[str]") -> str:
        name = found[1]
        return f"[`{name}`][{name}]" if name in self.named else f"`{name}`"

    def on_object(self, *, obj: Any, **_: Any) -> None:
        """A role is a link where the reference holds what it names, else plain code."""
        if obj.docstring:
            obj.docstring.value = _ROLE.sub(self._linked, obj.docstring.value)

    def on_class_members(self, *, cls: griffe.Class, **_: Any) -> None:
        """Fields that a record tells run together ("a: of this. b: of that.") stand one
        by one.
        """
        if not cls.docstring or not any(
            "dataclass" in str(one.value) for one in cls.decorators
        ):
            return
        told = record_fields.describe_fields(
            getattr(importlib.import_module(cls.module.path), cls.name)
        )
        texts = cls.docstring.value.split("\n\n")
        other = [
            text
            for text in texts
            if text.partition(":")[0].partition(",")[0] not in told
        ]
        if told:
            rows = [f"    {name}: {text}" for name, text in told.items()]
            cls.docstring.value = "\n\n".join(
                [*other, "\n".join(["Attributes:", *rows])]
            )
