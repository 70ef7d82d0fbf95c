"""How records show themselves in notebooks: a line, a table, axes."""

import dataclasses
import html
import textwrap
from typing import Any


class RecordView:
    """Short ``repr`` and HTML table of a dataclass: arrays by type and shape, records by
    name, numbers and words as they are.
    """

    __slots__ = ()

    def _shown(self, line: str) -> list[str]:
        """``line`` of the name and the text of each field that holds something."""
        names = [entry.name for entry in dataclasses.fields(self)]  # type: ignore[arg-type]
        values = {name: getattr(self, name) for name in names}
        return [line % (n, _short(v)) for n, v in values.items() if v is not None]

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self._shown('%s=%s'))})"

    def _repr_html_(self) -> str:
        rows = "".join(self._shown("<tr><th>%s</th><td>%s</td></tr>"))
        return f"<b>{type(self).__name__}</b><table>{rows}</table>"


def _short(value: Any) -> str:
    """One line for a value."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype} {tuple(value.shape)}"
    if dataclasses.is_dataclass(value):
        return type(value).__name__
    return textwrap.shorten(html.escape(repr(value), quote=False), 80)


def own_axes(axes: Any) -> Any:
    """Axes to draw on: those given, or those of a new figure of the notebook."""
    from matplotlib import pyplot

    return pyplot.subplots()[1] if axes is None else axes
