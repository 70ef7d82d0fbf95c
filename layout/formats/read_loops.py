"""The loops of the readers over millions of placements. They never read beyond the
bytes they are given.
"""

import numpy as np

from layout.mask.plan import BLOCK_SITES, FARTHEST, MOST_CLASSES
from layout.process.jit import compile_loop
from metalens.core.arrays import Array


def sref_run(data: Array, at: int) -> tuple[list[bytes], Array, Array, Array, int]:
    """Plain GDSII references in a row, all with names of one length.

    Args:
        data: bytes of the file.
        at: first byte.

    Returns:
        (names, index into names, x, y, byte after the last); nothing where the next
        record is something else.
    """
    nothing = np.empty(0, np.int32)
    size = int(data[at + 5]) + 20 if len(data) - at > 28 else 0
    fixed = bytes([0, 4, 10, 0, 0, size - 20, 18, 6]) if 24 < size < 276 else b"-"
    record = bytes(data[at : at + size])
    if (
        record[:8] != fixed
        or record[-16:-12] != b"\0\x0c\x10\3"
        or record[-4:] != b"\0\4\x11\0"
    ):
        return [], nothing, nothing, nothing, at
    most = min(BLOCK_SITES, (len(data) - at) // size)
    child = np.empty(most, np.int32)
    first = np.empty(min(MOST_CLASSES, most), np.int64)
    slots = np.full(4 << len(first).bit_length(), -1, np.int32)
    count, names = _number_names(data, at, size, child, slots, first)
    records = data[at : at + count * size].reshape(count, size)
    x, y = records[:, -12:-4].copy().view(">i4").astype(np.int32).T
    name_bytes = [data[first[k] : first[k] + size - 24].tobytes() for k in range(names)]
    return name_bytes, child[:count], x, y, at + count * size


@compile_loop
def _number_names(
    data: Array, at: int, size: int, child: Array, slots: Array, first: Array
) -> tuple[int, int]:
    """Number the names of a run of plain SREF records of equal size.

    Args:
        data: bytes of the file.
        at: first byte of the run, a plain record.
        size: bytes of each record, from SREF to ENDEL.
        child: (n,) output, number of the name of each.
        slots: hash table of the names: index, or -1.
        first: output, byte at which each name stands first.

    Returns:
        Number of references and of names; the run ends at any other record.
    """
    names = 0
    mask = slots.shape[0] - 1
    for n in range(len(child)):
        start = at + n * size
        coordinates = start + size - 16
        for i in range(size):
            is_fixed = i < 8 or size - 16 <= i < size - 12 or i >= size - 4
            if is_fixed and data[start + i] != data[at + i]:
                return n, names
        key = 0
        for i in range(start + 8, coordinates):
            key = (key * 131 + int(data[i])) & 0x7FFFFFFF
        slot = (key ^ key >> 15) & mask
        while slots[slot] >= 0:
            stored = first[slots[slot]]
            is_equal = True
            for i in range(coordinates - start - 8):
                if data[stored + i] != data[start + 8 + i]:
                    is_equal = False
                    break
            if is_equal:
                break
            slot = (slot + 1) & mask
        if slots[slot] < 0:
            if names == first.shape[0]:
                return n, names
            slots[slot], first[names] = names, start + 8
            names += 1
        child[n] = slots[slot]
    return len(child), names


@compile_loop
def unsigned_at(data: Array, at: int, end: int) -> tuple[int, int]:
    """A variable-length integer of at most 6 bytes, and the position after it.

    The position is -1 where the integer is cut or longer.

    Args:
        data: bytes.
        at: first byte.
        end: of the bytes.
    """
    value, shift = 0, 0
    while at < end and shift < 42:
        byte = int(data[at]) + 0  # 64 bits wide, compiled or not
        value |= (byte & 127) << shift
        at += 1
        if byte < 128:
            return value, at
        shift += 7
    return 0, -1


@compile_loop
def scan_placements(
    data: Array, at: int, end: int, state: Array, out: Array
) -> tuple[int, int]:
    """Read OASIS placements by reference number without repetition.

    Switches between absolute and relative coordinates are read too.

    Args:
        data: bytes.
        at: first byte.
        end: of the bytes.
        state: (4,) x, y, whether relative, and cell of the last placement (-1: none);
            updated.
        out: (4, n) output: child, x, y, turn of each.

    Returns:
        (position of the first record that is something else or broken, placements read)
    """
    count = 0
    child = out[0]
    x = out[1]
    y = out[2]
    turn = out[3]
    while at < end and count < out.shape[1]:
        kind = data[at]
        if kind == 15 or kind == 16:
            state[2] = kind - 15
            at += 1
            continue
        if (
            kind != 17
            or at + 1 >= end
            or data[at + 1] & 8
            or data[at + 1] & 0xC0 == 0x80
        ):
            break
        info = data[at + 1]
        position = at + 2
        number = state[3]
        if info & 0x80:
            number, position = unsigned_at(data, position, end)
        dx, dy = 0, 0
        if position > 0 and info & 0x20:
            dx, position = unsigned_at(data, position, end)
        if position > 0 and info & 0x10:
            dy, position = unsigned_at(data, position, end)
        if position < 0 or number < 0:
            break
        new_x = -(dx >> 1) if dx & 1 else dx >> 1
        new_y = -(dy >> 1) if dy & 1 else dy >> 1
        new_x = new_x + state[0] if state[2] or not info & 0x20 else new_x
        new_y = new_y + state[1] if state[2] or not info & 0x10 else new_y
        if abs(new_x) > FARTHEST or abs(new_y) > FARTHEST or number > FARTHEST:
            break
        state[0], state[1], state[3] = new_x, new_y, number
        child[count], x[count], y[count] = number, new_x, new_y
        turn[count] = (info >> 1 & 3) | (info & 1) << 2
        count = count + 1
        at = position
    return at, count


@compile_loop
def sum_deltas(data: Array, at: int, end: int, grid: int, x: Array, y: Array) -> int:
    """Running sums of the g-deltas of a repetition.

    Args:
        data: bytes.
        at: first byte.
        end: of the bytes.
        grid: factor of all steps.
        x: (n,) output; x[0] is set.
        y: (n,) output; y[0] is set.

    Returns:
        Position after the last, or -1 where the list is cut or leaves 32 bits.
    """
    for n in range(1, x.shape[0]):
        word, at = unsigned_at(data, at, end)
        if at < 0:
            return -1
        if word & 1:
            dx = -(word >> 2) if word & 2 else word >> 2
            word, at = unsigned_at(data, at, end)
            if at < 0:
                return -1
            dy = -(word >> 1) if word & 1 else word >> 1
        else:
            direction = word >> 1 & 7
            size = word >> 4
            dx = -size if direction in (2, 5, 6) else size
            if direction == 1 or direction == 3:
                dx = 0
            dy = -size if direction in (3, 6, 7) else size
            if direction == 0 or direction == 2:
                dy = 0
        if abs(dx) > FARTHEST or abs(dy) > FARTHEST:
            return -1
        next_x, next_y = x[n - 1] + dx * grid, y[n - 1] + dy * grid
        if abs(next_x) > FARTHEST or abs(next_y) > FARTHEST:
            return -1
        x[n], y[n] = next_x, next_y
    return at
