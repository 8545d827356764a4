"""Damage to the place where an HDF5 file keeps its texts, on which the HDF5 library itself would loop for ever."""

import mmap
import os
import struct

SIGNATURE = b"GCOL"
HEADER_BYTES = 16
# Index, number of references, nothing, and the size, as the library reads them ("Disk Format: Level 1E", HDF5 format
# specification), with the 8-byte lengths that every file of the layout has.
OBJECT = struct.Struct("<HHIQ")


def endless(path: str | os.PathLike[str]) -> bool:
    """Return whether a global heap of the file never ends: free space without a size, at which the library stands still.

    A heap lies between other data and has no checksum. What only looks like one costs nothing: the library reads a heap
    where a text refers to it, so a false alarm needs data that spell a whole heap, and a broken one.
    """
    if os.path.getsize(path) == 0:
        return False
    with open(path, "rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        place = content.find(SIGNATURE)
        while place >= 0:
            if _endless_at(content, place):
                return True
            place = content.find(SIGNATURE, place + 1)
    return False


def _endless_at(content: mmap.mmap, place: int) -> bool:
    if place + HEADER_BYTES > len(content) or content[place + 4] != 1:
        return False
    end = place + int.from_bytes(content[place + 8 : place + HEADER_BYTES], "little")
    if end > len(content):
        return False  # which the library finds itself
    place += HEADER_BYTES
    while place + OBJECT.size <= end:
        index, _, _, size = OBJECT.unpack(content[place : place + OBJECT.size])
        if index == 0 and size == 0:
            return True
        place += size if index == 0 else OBJECT.size + -(-size // 8) * 8
    return False
