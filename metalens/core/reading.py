"""Text of inputs: encodings, the columns of tables, and what a file is in words."""

import codecs
import contextlib
import re
from pathlib import Path

_WITH_COMMA = re.compile(r"[+-]?(\d+([.,]\d*)?|\.\d+)([eE][+-]?\d+)?")


def decode_text(content: bytes) -> str:
    """Text decoded from UTF-8, or from UTF-16 with a byte-order mark (as spreadsheets
    save it).

    Args:
        content: bytes of the file.

    Raises:
        UnicodeDecodeError: neither of them.
    """
    if not content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-8-sig")
    text = content.decode("utf-16")
    if len(text) and not re.search(r"[0-9A-Za-z]", text):
        raise UnicodeDecodeError("utf-16", content, 0, len(content), "no plain letter")
    return text


def read_text(path: str | Path) -> str:
    """Text of a file, by :func:`decode_text`.

    Args:
        path: of the file.
    """
    return decode_text(Path(path).read_bytes())


def column_separator(line: str) -> tuple[str | None, bool]:
    """Separator of the columns of a table's line (None for blanks and tabs), and
    whether its commas are decimal.

    They are where something else separates the columns: "840,5;0,3", "840,5 0,3".

    Args:
        line: of the table.
    """
    if ";" in line:
        return ";", True
    words = line.split()
    separated = len(words) > 1 and not any(
        word[0] == "," or word[-1] == "," for word in words
    )
    if separated and all(_WITH_COMMA.fullmatch(word) for word in words[:2]):
        return None, True
    return ("," if "," in line else None), False


def split_columns(line: str) -> list[str]:
    """Fields of a table's line as text, with decimal points."""
    separator, decimal = column_separator(line)
    line = line.replace(",", ".") if decimal else line
    return (line if separator is None else line.replace(separator, " ")).split()


def to_valid_utf8(text: str) -> str:
    """Text that UTF-8 can encode, from text that may hold file names of an unknown
    encoding.

    Python keeps their bytes as lone surrogates. Valid UTF-8 among them becomes its
    characters; other bytes become escapes.

    >>> to_valid_utf8("gr\\udcc3\\udcb6sse \\udcff")
    'grösse \\\\xff'
    """
    try:
        return text.encode("utf-8", "surrogateescape").decode(
            "utf-8", "backslashreplace"
        )
    except UnicodeEncodeError:  # surrogates that stand for no byte
        return text.encode("utf-8", "backslashreplace").decode()


def missing_reason(path: Path) -> str:
    """What is wrong with a path that is no plain file, in words."""
    if path.is_dir():
        return "a folder"
    if path.exists():
        return "no plain file (a pipe or a device), in which a reader could go back and forth"
    return "no such file"


_FOREIGN = {  # first bytes of files that are often mistaken for an artefact
    b"\x93NUMPY": "an array of NumPy",
    b"PK\x03\x04": "an archive (.npz or .zip)",
    b"II*\0": "a TIFF picture",
    b"MM\0*": "a TIFF picture",
    b"\x89PNG": "a PNG picture",
    b"MATLAB 5": "a MATLAB file",
    b"\x1f\x8b": "a compressed file (gzip: unpack it)",
}


def foreign_format(path: str | Path) -> str:
    """Format of a file with the first bytes of another program, in words; empty for any
    other.

    Args:
        path: of the file.
    """
    start = b""
    with contextlib.suppress(OSError), open(path, "rb") as file:
        start = file.read(8)
    return next(
        (words for first, words in _FOREIGN.items() if start.startswith(first)), ""
    )
