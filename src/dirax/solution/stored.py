"""What a file of dirax holds, before its arrays are read: attributes, sizes, and a way to each array."""

import os
import stat
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

TYPES = ("float64", "float32", "int64", "int32", "int8", "uint8", "bool")
"""Types of the arrays that dirax writes."""


class Unreadable(ValueError):
    """What is wrong with a file, without its path."""


@dataclass(frozen=True)
class Stored:
    """`attributes`: plain values by name; `kinds`: shape and type of every array; `read(name)`: the array itself."""

    attributes: dict[str, Any]
    kinds: dict[str, tuple[tuple[int, ...], np.dtype]]
    read: Callable[[str], Any]
    later: frozenset[str] = frozenset()
    """Arrays that are read, and checked, where they are used."""


def checksum(values: np.ndarray) -> int:
    """The CRC-32 of the bytes of an array."""
    return zlib.crc32(np.ascontiguousarray(values).data)


def plain_bytes(file: Path, where: Any, most: int) -> bytes:
    """The bytes of a file that a store calls `where`. Raises `Unreadable` for one with more than `most`, and for a link, a
    pipe or a device, which may have no end, before any is read; `FileNotFoundError` for none."""
    status = os.lstat(file)
    if stat.S_ISLNK(status.st_mode):
        raise Unreadable(f"its entry {where} is a link, which dirax does not write")
    if not stat.S_ISREG(status.st_mode):
        raise Unreadable(f"its entry {where} is a pipe, a device or a folder in the place of a file")
    if status.st_size > most:
        raise Unreadable(f"its entry {where} has {status.st_size} bytes, and dirax writes at most {most} there")
    with open(file, "rb") as opened:
        return opened.read(status.st_size)


def reading(problem: str, read: Callable, *arguments: Any) -> Any:
    """`read(*arguments)`, where anything unexpected means that the file has this problem."""
    try:
        return read(*arguments)
    except Unreadable:
        raise
    except Exception as error:
        reason = (str(error).splitlines() or ["no reason given"])[0].rstrip(".")
        reason = reason if len(reason) <= 100 else f"{reason[:99]}…"
        raise Unreadable(f"{problem} ({type(error).__name__}: {reason})") from error
