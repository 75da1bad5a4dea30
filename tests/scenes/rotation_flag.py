"""Photo files with the flag that they are to be shown turned, as a camera writes them that is held upright."""

import struct

_ORIENTATION = 274


def with_rotation_flag(file: bytes, orientation: int = 6) -> bytes:
    """A JPEG file, or a little-endian TIFF file, with an orientation; 6 is to be shown turned clockwise."""
    flag = struct.pack("<HHIHH", _ORIENTATION, 3, 1, orientation, 0)
    if file[:2] != b"II":
        segment = b"Exif\x00\x00" + b"II*\x00\x08\x00\x00\x00\x01\x00" + flag + bytes(4)
        return file[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + file[2:]
    (start,) = struct.unpack_from("<I", file, 4)
    (count,) = struct.unpack_from("<H", file, start)
    entries = [file[at : at + 12] for at in range(start + 2, start + 2 + 12 * count, 12)]
    others = [entry for entry in entries if entry[:2] != flag[:2]]
    entries = sorted([*others, flag], key=_tag)
    end = file + bytes(len(file) % 2)
    return (
        end[:4]
        + struct.pack("<I", len(end))
        + end[8:]
        + struct.pack("<H", len(others) + 1)
        + b"".join(entries)
        + bytes(4)
    )


def _tag(entry: bytes) -> int:
    return int.from_bytes(entry[:2], "little")
