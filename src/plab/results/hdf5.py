"""Attributes and columns of an HDF5 file by low-level calls: a fourth of the time that h5py's objects take.

When thousands of runs are loaded for the first time, most of the time goes to the thirty attributes of each.

What is read is the file's own and no more than it can hold: no link or data set that leads to another file,
no filter but those that plab writes with, no array that its bytes on the disk cannot stand for.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Container
from typing import Any, TypeVar

import h5py
import numpy as np
from h5py import h5a, h5d, h5g, h5l, h5o, h5s, h5t, h5z

from plab.reading import LARGEST

__all__ = ["array", "attributes", "check_heaps", "columns", "groups", "length", "numbers", "take", "tree"]

_TEXT = h5t.py_create(h5py.string_dtype())

_FILTERS = (h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32)

_RATIO, _SMALL = 1_100, 1 << 16
"""Most bytes that a byte on the disk can stand for (deflate's limit is 1,032), beside some that need none."""

_ENTRIES, _DEPTH = 10_000, 16
"""Most entries of an attribute, and most levels of groups."""

_HEAP = b"GCOL\x01"
"""What a heap begins with: where HDF5 keeps texts."""

_LEAST_HEAP = 4096

_HEAP_HEADER = struct.Struct("<8sQ")
"""Of a heap: what it begins with, and its size."""

_OBJECT = struct.Struct("<H6xQ")
"""Of an object in a heap: its number (0: what is free), and its size, of what is free with this header."""

Kind = TypeVar("Kind")


def check_heaps(content: bytes | mmap.mmap) -> None:
    """See that the heaps of a file come to an end: HDF5 reads one whose objects take no room for ever.

    Raises:
        ValueError: If a heap is damaged.
    """
    start = content.find(_HEAP)
    while start >= 0:
        place = start + _HEAP_HEADER.size
        size = _HEAP_HEADER.unpack_from(content, start)[1] if place <= len(content) else 0
        # What is no heap, but begins as one, HDF5 refuses itself.
        end = start + size if _LEAST_HEAP <= size <= len(content) - start else 0
        while end - place >= _OBJECT.size:
            number, room = _OBJECT.unpack_from(content, place)
            taken = _OBJECT.size + -(-room // 8) * 8 if number else room
            if not _OBJECT.size <= taken <= end - place:
                raise ValueError("a heap of texts is damaged")
            place += taken
        start = content.find(_HEAP, start + 1)


def attributes(file: h5py.File, group: str = "/", names: Container[str] | None = None) -> dict[str, Any]:
    """Return the attributes of a group, or those of them that are named, scalars as plain Python ones.

    Raises:
        KeyError: If there is no such group.
        ValueError: If it is no group of this file.
    """
    place = _group(file.id, group)
    found: list[bytes] = []
    h5a.iterate(place, found.append)
    decoded = ((name.decode(), name) for name in found)
    return {name: _value(place, encoded) for name, encoded in decoded if names is None or name in names}


def take(values: dict[str, Any], name: str, kind: type[Kind]) -> Kind:
    """Return an attribute of a type: ``str``, ``int`` or ``float``, which integers are, too.

    Raises:
        ValueError: If it is missing or of another type.
    """
    if name not in values:
        raise ValueError(f"it has no {name}")
    value, kinds = values[name], (int, float) if kind is float else kind
    if not isinstance(value, kinds) or isinstance(value, bool):
        raise ValueError(f"{name} is a {type(value).__name__}, no {kind.__name__}")
    return kind(value)  # type: ignore[call-arg]


def numbers(values: dict[str, Any]) -> dict[str, float]:
    """Return attributes all of which have to be numbers.

    Raises:
        ValueError: If one is not.
    """
    for name in values:
        take(values, name, float)
    return values


def columns(file: h5py.File, group: str) -> dict[str, np.ndarray]:
    """Return the data sets of a group that its attribute ``columns`` names, in this order.

    Raises:
        KeyError: If there is no such group, or one of them is missing.
        ValueError: If they are no columns of numbers, all as long as each other.
    """
    place = _group(file.id, group)
    found = {name: _numbers(_dataset(place, name), name) for name in _names(place)}
    if len({values.shape for values in found.values()}) > 1 or any(v.ndim != 1 for v in found.values()):
        raise ValueError(f"the columns of {group} differ in length")
    return found


def length(file: h5py.File, group: str) -> int:
    """Return how long the columns of a group are, by the first of them.

    Raises:
        KeyError: If there is no such group, or no such data set.
        ValueError: If it is none.
    """
    place = _group(file.id, group)
    names = _names(place)
    shape = _dataset(place, names[0]).shape if names else (0,)
    if len(shape) != 1:
        raise ValueError(f"{names[0]} is no column")
    return shape[0]


def array(file: h5py.File, group: str, name: str) -> np.ndarray | None:
    """Return a data set of numbers in a group, None if it is not there.

    Raises:
        KeyError: If there is no such group.
        ValueError: If it is no data set of numbers.
    """
    place = _group(file.id, group)
    return _numbers(_dataset(place, name), name) if name.encode() in place else None


def groups(file: h5py.File, group: str) -> list[str]:
    """Return the names of what is in a group."""
    return [name.decode() for name in _group(file.id, group)]


def tree(file: h5py.File, group: str) -> dict[str, Any]:
    """Return all that is in a group: nested dictionaries of arrays of numbers and of texts.

    Raises:
        KeyError: If there is no such group.
        ValueError: If it holds anything else.
    """
    return _tree(_group(file.id, group), 0)


def _tree(place: h5g.GroupID, depth: int) -> dict[str, Any]:
    if depth > _DEPTH:
        raise ValueError(f"it has groups in groups, {depth} deep")
    found: dict[str, Any] = {}
    for encoded in place:
        name = encoded.decode()
        member = _open(place, name)
        if isinstance(member, h5g.GroupID):
            found[name] = _tree(member, depth + 1)
        else:
            dataset = _dataset(place, name)
            if h5py.check_string_dtype(dataset.dtype) is None:
                found[name] = _numbers(dataset, name)
            elif dataset.shape == ():
                found[name] = h5py.Dataset(dataset).asstr()[()]
            else:
                raise ValueError(f"{name} is a list of texts")
    return found


def _names(place: h5g.GroupID) -> list[str]:
    """Return what the attribute ``columns`` says."""
    names = _value(place, b"columns")
    listed = isinstance(names, np.ndarray) and names.ndim == 1
    # Of no columns HDF5 keeps no type of names.
    if not listed or not all(isinstance(name, str) for name in names):
        raise ValueError("columns is no list of names")
    return list(names)


def _group(root: h5g.GroupID, path: str) -> h5g.GroupID:
    place = root if isinstance(root, h5g.GroupID) else h5o.open(root, b"/")
    for part in filter(None, path.split("/")):
        place = _open(place, part)
        if not isinstance(place, h5g.GroupID):
            raise ValueError(f"{part} is no group")
    return place


def _open(place: h5g.GroupID, name: str) -> Any:
    """Open what a group holds itself."""
    encoded = name.encode()
    try:
        kind = place.links.get_info(encoded).type
    except RuntimeError:
        raise KeyError(f"there is no {name}") from None
    if kind != h5l.TYPE_HARD:
        raise ValueError(f"{name} is a link to somewhere else")
    return h5o.open(place, encoded)


def _dataset(place: h5g.GroupID, name: str) -> h5d.DatasetID:
    """Open a data set whose numbers are in the file, and can be as many as it says."""
    found = _open(place, name)
    if not isinstance(found, h5d.DatasetID):
        raise ValueError(f"{name} is no data set")
    made = found.get_create_plist()
    if made.get_layout() == h5d.VIRTUAL or made.get_external_count():
        raise ValueError(f"{name} has its numbers in another file")
    filters = [made.get_filter(k)[0] for k in range(made.get_nfilters())]
    if strange := [code for code in filters if code not in _FILTERS]:
        raise ValueError(f"{name} is packed by filter {strange[0]}, which plab does not use")
    space = found.get_space()
    if space.get_simple_extent_type() not in (h5s.SCALAR, h5s.SIMPLE):
        raise ValueError(f"{name} is empty")
    size = space.get_simple_extent_npoints() * found.get_type().get_size()
    if size > min(LARGEST, _SMALL + _RATIO * found.get_storage_size()):
        raise ValueError(f"{name} claims {size} bytes, which the file does not hold")
    return found


def _numbers(dataset: h5d.DatasetID, name: str) -> np.ndarray:
    kind = dataset.dtype
    if kind.kind not in "biufc":
        raise ValueError(f"{name} holds no numbers")
    values = np.empty(dataset.shape, kind)
    dataset.read(h5s.ALL, h5s.ALL, values)
    return values


def _value(place: h5g.GroupID, name: bytes) -> Any:
    found = h5a.open(place, name)
    space = found.get_space()
    if space.get_simple_extent_type() != h5s.SCALAR:
        if space.get_simple_extent_npoints() > _ENTRIES:
            raise ValueError(f"{name.decode()} has more than {_ENTRIES} entries")
        return h5py.Group(place).attrs[name]
    kind = found.get_type()
    if isinstance(kind, h5t.TypeStringID) and kind.is_variable_str():
        value = np.empty((), object)
        found.read(value, mtype=_TEXT)
        return value.item().decode("utf-8", "surrogateescape")
    if isinstance(kind, h5t.TypeFloatID):
        value = np.empty(())
        found.read(value, mtype=h5t.NATIVE_DOUBLE)
    else:
        value = np.empty((), kind.dtype)
        found.read(value)
    return value.item()
