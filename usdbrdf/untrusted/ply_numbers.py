"""The numbers behind a PLY's header, text or binary, element by element; rows of any lengths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from struct import Struct
from typing import Any, Protocol

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from usdbrdf.model.arrays import Array, Long

# PLY's names of numbers, as NumPy spells them.
KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float16": "f2", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
# And as struct does.
_PACKED = {
    "i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q",
    "f2": "e", "f4": "f", "f8": "d",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Column:
    """A property of all rows of an element: ``counts`` of each row, numbers ``flat``."""

    counts: Long
    flat: Array
    is_list: bool


class Numbers(Protocol):
    """The numbers behind a header, one after the other."""

    @property
    def of_counts(self) -> str:
        """The kind in which counts of lists are taken, "" for that of the header."""

    @property
    def left(self) -> int:
        """How many bytes or numbers nobody has taken."""

    def table(self, kinds: Sequence[tuple[str, int]], rows: int) -> list[Array] | None:
        """Rows of the same length: of each of its parts, a kind and how many, (rows, how many).
        None, and nothing is taken, where there are less."""

    def lengths(self, rows: int, lists: Sequence[tuple[int, str, int]], tail: int) -> Long:
        """(rows, L) how many numbers each list of each row has; all rows are taken. ValueError
        where there are less.

        lists  of each the size of what lies before it, the kind of its count, the size of its kind
        tail   the size of what follows the last one
        """

    def rows_at(self, starts: Long, kinds: Sequence[tuple[str, int]]) -> list[Array]:
        """As ``table``, of rows of the same length that begin anywhere; nothing is taken."""

    def size(self, kind: str) -> int:
        """By how much a number leads on."""

    def back(self, place: int) -> None:
        """Go back to a place."""

    place: int


class Text:
    of_counts = "f8"  # as they stand: of what is none nothing is made

    def __init__(self, content: bytes) -> None:
        try:
            self.numbers: Array = np.fromstring(content, np.float64, sep=" ")
        except ValueError as error:
            raise ValueError(f"it holds {_no_number(content)}, which is no number") from error
        self.place = 0

    @property
    def left(self) -> int:
        return len(self.numbers) - self.place

    def table(self, kinds: Sequence[tuple[str, int]], rows: int) -> list[Array] | None:
        width = sum(count for _, count in kinds)
        if rows * width > self.left:
            return None
        part = self.numbers[self.place : self.place + rows * width].reshape(rows, width)
        self.place += part.size
        return _parts_of(part, kinds)

    def lengths(self, rows: int, lists: Sequence[tuple[int, str, int]], tail: int) -> Long:
        walks = [(before, self.numbers.item, 1, size) for before, _, size in lists]
        self.place, found = _walked(self.place, len(self.numbers), rows, walks, tail)
        return found

    def rows_at(self, starts: Long, kinds: Sequence[tuple[str, int]]) -> list[Array]:
        width = sum(count for _, count in kinds)
        return _parts_of(sliding_window_view(self.numbers, width)[starts], kinds)

    def size(self, kind: str) -> int:
        return 1

    def back(self, place: int) -> None:
        self.place = place


def _parts_of(rows: Array, kinds: Sequence[tuple[str, int]]) -> list[Array]:
    ends = np.cumsum([count for _, count in kinds]).tolist()
    parts = zip(kinds, ends, strict=True)
    return [_of_kind(rows[:, end - count : end], kind) for (kind, count), end in parts]


def _no_number(content: bytes) -> str:
    for word in content.split():
        try:
            float(word)
        except ValueError:
            return repr(word[:40].decode("latin-1"))
    return "something"


def _of_kind(numbers: Array, kind: str) -> Array:
    """Numbers that were written as text. Whole ones that are none, or too large, become -1, or what
    is largest where nothing is below 0."""
    if kind[0] == "f":
        with np.errstate(over="ignore"):
            return numbers.astype(kind)
    limits = np.iinfo(f"{kind[0]}{min(int(kind[1]), 4)}")  # beyond that, doubles are not exact
    fits = (numbers >= limits.min) & (numbers <= limits.max) & (np.floor(numbers) == numbers)
    return np.where(fits, numbers, -1 if kind[0] == "i" else limits.max).astype(kind)


class _Bytes:
    of_counts = ""

    def __init__(self, content: bytes, place: int, order: str) -> None:
        self.content, self.place, self.order = content, place, order

    @property
    def left(self) -> int:
        return 0  # what follows belongs to nobody, and is passed over

    def table(self, kinds: Sequence[tuple[str, int]], rows: int) -> list[Array] | None:
        row = self._row(kinds)
        if rows * row.itemsize > len(self.content) - self.place:
            return None
        found = np.frombuffer(self.content, row, rows, self.place) if rows else np.zeros(0, row)
        self.place += found.nbytes
        return [found[str(i)] for i in range(len(kinds))]

    def _row(self, kinds: Sequence[tuple[str, int]]) -> np.dtype[Any]:
        parts = enumerate(kinds)
        return np.dtype([(str(i), self.order + kind, (count,)) for i, (kind, count) in parts])

    def lengths(self, rows: int, lists: Sequence[tuple[int, str, int]], tail: int) -> Long:
        walks = [(before, self._one(kind), int(kind[1]), size) for before, kind, size in lists]
        self.place, found = _walked(self.place, len(self.content), rows, walks, tail)
        return found

    def _one(self, kind: str) -> Callable[[int], float]:
        """What reads one number at a place."""
        if kind == "u1":
            return self.content.__getitem__
        packed, content = Struct(self.order + _PACKED[kind]).unpack_from, self.content
        return lambda place: float(packed(content, place)[0])

    def rows_at(self, starts: Long, kinds: Sequence[tuple[str, int]]) -> list[Array]:
        row = self._row(kinds)
        windows = sliding_window_view(np.frombuffer(self.content, np.uint8), row.itemsize)
        found = windows[starts].view(row)[:, 0]
        return [found[str(i)] for i in range(len(kinds))]

    def size(self, kind: str) -> int:
        return int(kind[1])

    def back(self, place: int) -> None:
        self.place = place


def numbers_behind(header: Sequence[str], content: bytes, start: int) -> Numbers:
    said = next((line.split()[1:2] for line in header if line.split()[:1] == ["format"]), [])
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get("".join(said))
    if order is not None:
        return _Bytes(content, start, order)
    if said != ["ascii"]:
        raise ValueError(f"its format is {''.join(said)[:40]!r}")
    return Text(content[start:])


def _walked(
    place: int,
    end: int,
    rows: int,
    lists: Sequence[tuple[int, Callable[[int], float], int, int]],
    tail: int,
) -> tuple[int, Long]:
    """Where rows end that begin at a place, and how long each one's lists are, (rows, L).

    lists  as those of ``Numbers.lengths``; in place of the kind what reads a count, and its size
    """
    lengths = list[int]()
    for _ in range(rows):
        for before, read, size, each in lists:
            place += before
            if place + size > end:
                raise ValueError("it ends within a face")
            said = read(place)
            if not said >= 0 or said % 1:
                raise ValueError(f"a list has {said:g} elements")
            lengths.append(int(said))
            place += size + each * lengths[-1]
        place += tail
        if place > end:
            raise ValueError("it ends within a face")
    return place, np.array(lengths, np.int64).reshape(rows, len(lists))


def element(
    numbers: Numbers, name: str, count: int, properties: Sequence[Sequence[str]]
) -> dict[str, Column]:
    """All rows of an element; where all lists are as long as the first row's, as one table."""
    if not properties:
        return {}
    start, lists, before = numbers.place, list[tuple[int, str, int]](), 0
    for words in properties:
        size = numbers.size(KINDS[words[-2]])
        if words[0] == "list":
            lists.append((before, numbers.of_counts or KINDS[words[1]], size))
        before = 0 if words[0] == "list" else before + size
    first = numbers.lengths(min(count, 1), lists, before)
    numbers.back(start)
    usual = first[0] if count else np.zeros(len(lists), np.int64)
    table = numbers.table(_kinds(numbers, properties, usual), count)
    if table is not None:
        said, values = _divided(properties, table)
        if all((own == n).all() for own, n in zip(said, usual, strict=True)):
            return {
                words[-1]: Column(
                    counts=np.full(count, own.shape[1], np.int64),
                    flat=own.reshape(-1),
                    is_list=words[0] == "list",
                )
                for words, own in zip(properties, values, strict=True)
            }
    elif not lists:
        raise ValueError(f"it ends before its {count} elements {name!r}")
    numbers.back(start)
    lengths = numbers.lengths(count, lists, before)
    each = np.array([size for *_, size in lists], np.int64)
    sizes = lengths @ each + before + sum(a + numbers.size(kind) for a, kind, _ in lists)
    starts = start + np.cumsum(sizes) - sizes
    return _rows_of_any_length(numbers, properties, starts, lengths)


def _kinds(
    numbers: Numbers, properties: Sequence[Sequence[str]], lengths: Long
) -> list[tuple[str, int]]:
    """The parts of a row whose lists have these lengths (L,): kind and how many."""
    left, kinds = iter(lengths.tolist()), list[tuple[str, int]]()
    for words in properties:
        if words[0] == "list":
            kinds.append((numbers.of_counts or KINDS[words[1]], 1))
        kinds.append((KINDS[words[-2]], next(left) if words[0] == "list" else 1))
    return kinds


def _divided(
    properties: Sequence[Sequence[str]], parts: Sequence[Array]
) -> tuple[list[Array], list[Array]]:
    """The counts of lists, and of each property what it holds."""
    left = iter(parts)
    said, values = list[Array](), list[Array]()
    for words in properties:
        if words[0] == "list":
            said.append(next(left))
        values.append(next(left))
    return said, values


def _rows_of_any_length(
    numbers: Numbers, properties: Sequence[Sequence[str]], starts: Long, lengths: Long
) -> dict[str, Column]:
    """Rows that begin at ``starts`` (R,), of whose lists ``lengths`` (R, L) tells; those that are
    alike are read at once."""
    left, columns = iter(lengths.T), list[Column]()
    for words in properties:
        counts = next(left) if words[0] == "list" else np.ones(len(starts), np.int64)
        flat = np.zeros(int(counts.sum()), KINDS[words[-2]])
        columns.append(Column(counts=counts, flat=flat, is_list=words[0] == "list"))
    firsts = [np.cumsum(column.counts) - column.counts for column in columns]
    alike = np.zeros(len(starts), np.int64)
    for counts in lengths.T:
        alike = np.unique(alike * (counts.max() + 1) + counts, return_inverse=True)[1]
    order = np.argsort(alike, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(alike[order])) + 1):
        kinds = _kinds(numbers, properties, lengths[rows[0]])
        _, values = _divided(properties, numbers.rows_at(starts[rows], kinds))
        for column, first, own in zip(columns, firsts, values, strict=True):
            column.flat[first[rows, None] + np.arange(own.shape[1])] = own
    return {words[-1]: column for words, column in zip(properties, columns, strict=True)}
