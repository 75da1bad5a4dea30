"""SPZ of Niantic, small files for the web and for phones. numpy and zstandard only, Blender imports it.

Written is version 4, read are versions 1 to 4. All numbers are little-endian. Version 4 has a header of 32 bytes,
extensions, a table with the packed and unpacked bytes of each attribute, and the attributes, each packed with zstd.
Versions 1 to 3 are one gzip stream of a header of 16 bytes, the attributes, and extensions. Attributes, in this order:

- positions: three fixed-point numbers of 24 bits; the header says how many bits are behind the point; in version 1
  half floats
- opacities: 0..1 in 8 bits
- colors: (0.15 f_dc + 0.5) in 8 bits
- scales: (natural logarithm + 10) * 16 in 8 bits
- rotations: from version 3 on the index of the largest component of xyzw in the highest 2 bits of a word, then of each
  of the others a sign and 9 bits of its size up to 1/sqrt(2); before that x, y and z from -1 to 1 in 8 bits, w positive
- further spherical harmonics: 128 (1 + value) in 8 bits, R, G and B of one coefficient after the other

The axes are x right, y up and z back, unless the extension of Adobe says others. There is no place for extras.
The format is described at https://github.com/nianticlabs/spz; details were checked against files of gaussforge.
"""

import logging
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from ..base.errors import InputError, remedy
from ..base.files import atomic_path, read_bytes, read_text
from ..base.strict_json import from_json, to_json
from ..scene.georeference import Placement
from ..splats.splats import Splats, clean_splats
from ..splats.transform import rotation_to_y_up, transformed
from .export_format import Direction, ExportFormat
from .gltf import COLMAP_UP, Z_UP, up_of
from .place import place_from_json, place_to_json

log = logging.getLogger(__name__)

MAGIC, GZIP = b"NGSP", b"\x1f\x8b"
"""First bytes of version 4, and of the others."""
HEADER = struct.Struct("<4sIIBBBB")
"""Magic, version, number of splats, SH degree, bits behind the point, flags, and in version 4 number of attributes."""
TABLE_START = struct.Struct("<I12x")
"""What follows in the header of version 4: offset of the table."""
ENTRY = struct.Struct("<QQ")
"""Row of the table: packed and unpacked bytes of a stream."""
RECORD = struct.Struct("<II")
"""Start of an extension: type, and bytes of its content."""
HAS_EXTENSIONS = 2
"""Flag of the header."""
AXES_EXTENSION = 0xADBE0003
"""Type of the extension with the axes, SPZ_ADOBE_coordinate_system."""
AXES = ("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF",
        "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU")  # fmt: skip
"""Its values from 1 on: where x, y and z point; left or right, up or down, front or back."""
DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "U": (0, 1, 0), "D": (0, -1, 0), "B": (0, 0, 1), "F": (0, 0, -1)}
"""Where the letters of AXES point in the axes of files without that extension."""
SH_BYTES = (0, 9, 24, 45, 72)
"""Bytes of a splat's further spherical harmonics, by degree; degree 4 is read without its highest band."""
COLOR_SCALE = 0.15
"""Color byte / 255 per unit of f_dc."""
FRACTION_BITS = 12
"""Bits behind the point that other programs write: steps of 1/4096 unit."""
STEPS_PER_SPLAT = 32
"""Steps of a position that fit at least in a splat of median size, where 24 bits allow it."""
LARGEST = 2**23 - 1
"""Largest number with a sign and 24 bits."""
SH_STEPS = np.array([8] * 3 + [16] * 12, np.float32)[:, None]
"""Of the 256 values, every eighth is used for coefficients of degree 1 and every sixteenth for others, as other
programs do: that halves the file."""
LEVEL = 3
"""Compression level of zstd. On a trained scene of 40 000 splats 9 takes ten times as long and saves 2 %."""
BLOCK = 65536
"""Splats packed at a time, so that intermediate numbers take little memory."""
MAX_RATIO, ALWAYS_ALLOWED = 100, 1 << 20
"""Unpacked bytes are at most so many per byte of the file, or this many: real files have 2 to 5, and a small file must
not fill the memory."""


@dataclass(frozen=True)
class Header:
    """Header of a file.

    Attributes:
        version: 1 to 4.
        count: Number of splats.
        degree: Degree of the spherical harmonics, 0 to 4.
        fraction_bits: Bits of a position behind the point.
        flags: Flags.
        streams: Number of attributes in version 4.
    """

    version: int
    count: int
    degree: int
    fraction_bits: int
    flags: int
    streams: int

    @property
    def sizes(self) -> list[int]:
        """Unpacked bytes of each attribute."""
        position, rotation = 6 if self.version == 1 else 9, 4 if self.version > 2 else 3
        return [self.count * width for width in (position, 1, 3, 3, rotation, SH_BYTES[self.degree])]


def write_spz(path: Path, splats: Splats, up: Direction = COLMAP_UP) -> None:
    """Write splats as an SPZ of version 4 of their own degree. The file is whole or absent.

    SPZ has no place for placement and origin of splats: they are written to NAME.scale.json beside the file, the
    offset of the placement in metres with z up, the origin in the axes of the file.

    Numbers are rounded to the precision of the format, and those outside its range are set to its ends: f_dc within
    3.3, further coefficients within 1, standard deviations from 0.00005 to 380 units. Extras are left out.

    Args:
        path: File to write.
        splats: Splats to write.
        up: Direction (3,) in the splats' world that is up: the splats are rotated so that it is y.

    Raises:
        InputError: If there are no splats, a position is not finite or too far away, zstandard is missing, or the file
            cannot be written.
    """
    parts = _assemble(path, splats, up)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.writelines(parts)
    beside = _placement_path(path)
    if place := place_to_json(splats):
        turn = rotation_to_y_up(up_of(splats, up))
        if splats.placement:
            place |= splats.placement.file_json(turn)
        if "origin" in place:
            place["origin"] = (turn @ place["origin"]).tolist()
        with atomic_path(beside) as temporary:
            temporary.write_text(to_json(place, indent=2) + "\n", encoding="utf-8")
    elif _place(path) != place_from_json(None):
        beside.unlink()  # of an earlier file of this name


def spz_size(path: Path, splats: Splats, up: Direction = COLMAP_UP) -> int:
    """Return the size in bytes of the file that `write_spz` makes of the same arguments; this packs all of it.

    Raises:
        InputError: As `write_spz` before it writes.
    """
    return sum(map(len, _assemble(path, splats, up)))


def _assemble(path: Path, splats: Splats, up: Direction) -> list[bytes]:
    """Return the parts of the file."""
    if not len(splats):
        raise InputError(f"There are no splats to write to {path}; choose at least one.")
    if not np.isfinite(splats.positions).all():
        raise InputError(f"Cannot write {path}: a splat's position is not finite; remove that splat.")
    zstandard = _zstandard()
    turn = np.eye(4)
    turn[:3, :3] = rotation_to_y_up(up_of(splats, up))
    if not np.array_equal(turn, np.eye(4)):
        splats = transformed(splats, turn)
    bits = _fraction_bits(path, splats)
    unpacked = _pack(splats, bits)[: 6 if splats.degree else 5]
    packer = zstandard.ZstdCompressor(level=LEVEL)
    packed = [packer.compress(attribute) for attribute in unpacked]
    # The axes are declared, because some programs write others undeclared.
    extension = RECORD.pack(AXES_EXTENSION, 4) + struct.pack("<I", 1 + AXES.index("RUB"))
    head = HEADER.pack(MAGIC, 4, len(splats), splats.degree, bits, HAS_EXTENSIONS, len(packed))
    start = TABLE_START.pack(len(head) + TABLE_START.size + len(extension))
    table = [ENTRY.pack(len(after), before.nbytes) for after, before in zip(packed, unpacked, strict=True)]
    return [head, start, extension, *table, *packed]


def _fraction_bits(path: Path, splats: Splats) -> int:
    """Return how many bits of a position are behind the point: enough for small splats, if the largest one fits."""
    farthest = max(float(np.abs(splats.positions).max()), 1e-30)
    fitting = int(np.floor(np.log2(LARGEST / farthest)))
    if fitting < 0:
        raise InputError(
            f"Cannot write {path}: a splat is {farthest:.3g} units from the origin, and an SPZ reaches to {LARGEST}; "
            "remove that splat, or scale the scene down."
        )
    size = max(float(np.median(splats.scales.mean(axis=1))), 1e-30)
    wanted = int(np.ceil(np.log2(STEPS_PER_SPLAT / size)))
    return min(max(wanted, FRACTION_BITS), fitting, 24)


def _pack(splats: Splats, bits: int) -> list[np.ndarray]:
    """Return the attributes as bytes, in the order of the file."""
    count = len(splats)
    widths = (9, 1, 3, 3, 4, SH_BYTES[splats.degree])
    positions, opacities, colors, scales, rotations, sh = (np.empty((count, width), np.uint8) for width in widths)
    for start in range(0, count, BLOCK):
        part = slice(start, min(start + BLOCK, count))
        steps = np.rint(splats.positions[part].astype(np.float64) * 2.0**bits).astype("<i4")
        positions[part] = steps.view(np.uint8).reshape(-1, 3, 4)[:, :, :3].reshape(-1, 9)
        opacities[part, 0] = _bytes(splats.opacities[part] * 255)
        colors[part] = _bytes((splats.sh[part, 0] * COLOR_SCALE + 0.5) * 255)
        scales[part] = _bytes((np.log(np.maximum(splats.scales[part], np.finfo(np.float32).tiny)) + 10) * 16)
        rotations[part] = _packed_rotations(splats.rotations[part])
        if splats.degree:
            used = SH_STEPS[: splats.sh.shape[1] - 1]
            exact = np.rint(splats.sh[part, 1:] * 128) + 128
            sh[part] = _bytes(np.floor((exact + used / 2) / used) * used).reshape(-1, sh.shape[1])
    return [positions, opacities, colors, scales, rotations, sh]


def _bytes(values: np.ndarray) -> np.ndarray:
    """Round to 0..255; NaN becomes 0."""
    return np.nan_to_num(np.rint(values)).clip(0, 255).astype(np.uint8)


def _packed_rotations(rotations: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) wxyz as bytes (N, 4)."""
    quaternions = np.nan_to_num(np.roll(rotations, -1, axis=1))
    largest = np.abs(quaternions).argmax(axis=1)[:, None]
    others = np.take_along_axis(quaternions, _others(largest), axis=1)
    others = np.where(np.take_along_axis(quaternions, largest, axis=1) < 0, -others, others)
    sizes = np.minimum(np.abs(others) * np.sqrt(2) * 511 + 0.5, 511).astype(np.uint32)
    x, y, z = (sizes | (others < 0).astype(np.uint32) << np.uint32(9)).T
    words = largest[:, 0].astype(np.uint32) << np.uint32(30) | x << np.uint32(20) | y << np.uint32(10) | z
    return words.astype("<u4").view(np.uint8).reshape(-1, 4)


def _others(largest: np.ndarray) -> np.ndarray:
    """Return the indices (N, 3) of the components beside the largest one (N, 1)."""
    return np.arange(3) + (np.arange(3) >= largest)


@np.errstate(invalid="ignore")  # half floats of version 1 may be no numbers; their splats are dropped
def read_spz(path: Path, up: Direction = COLMAP_UP) -> Splats:
    """Read an SPZ of version 1 to 4.

    Spherical harmonics of degree 4 are dropped with a warning; extensions but the one with the axes are ignored.

    Args:
        path: The file.
        up: Direction (3,) that shall be up in the splats' world; with the one given to `write_spz` the splats are those
            that were written, to the precision of the format. Splats with a placement have z up whatever is given.

    Returns:
        The splats.

    Raises:
        InputError: If the file is missing, not an SPZ, of a later version, damaged or cut off, or zstandard is missing.
    """
    try:
        data = read_bytes(path)
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error
    if not data:
        raise InputError(f"{path} is empty.")
    if not data.startswith((MAGIC, GZIP)):
        raise InputError(f"{path} is not an SPZ file.")
    try:
        header, attributes, extensions = (_unpacked_streams if data[:4] == MAGIC else _unzipped)(path, data)
        axes = _axes(extensions)
    except (ValueError, struct.error, zlib.error) as error:
        raise InputError(f"{path} is a damaged SPZ: its parts do not fit together; copy or write it again.") from error
    if header.degree > 3:
        log.warning("%s: spherical harmonics above degree 3 were dropped", path)
    splats = clean_splats(_splats(header, attributes), path)
    placement, splats.origin = _place(path)
    turn = np.eye(4)
    turn[:3, :3] = rotation_to_y_up(Z_UP if placement else up).T @ axes
    splats = splats if np.array_equal(turn, np.eye(4)) else transformed(splats, turn)
    splats.placement = placement
    return splats


def _placement_path(path: Path) -> Path:
    """Return the file that says where the splats of an SPZ lie."""
    return path.with_suffix(".scale.json")


def _place(path: Path) -> tuple[Placement | None, tuple[float, float, float]]:
    """Return placement and origin of the splats of an SPZ: none and zeros where no file beside it tells them."""
    try:
        return place_from_json(from_json(read_text(_placement_path(path))))
    except (OSError, ValueError):
        return place_from_json(None)


def _header(path: Path, data: bytes) -> Header:
    """Read and check the header, and refuse what the file cannot hold."""
    magic, *values = HEADER.unpack_from(data)
    header = Header(*values)
    if magic != MAGIC:
        raise ValueError("no SPZ inside")
    if header.version > 4:
        raise InputError(f"{path} is SPZ version {header.version}; versions 1 to 4 can be read: save it as version 4.")
    if not header.version or header.degree >= len(SH_BYTES) or header.fraction_bits > 31:
        raise ValueError("a header that no program writes")
    if not header.count:
        raise InputError(f"{path} holds no splats.")
    return header


def _check_size(path: Path, header: Header, available: int) -> None:
    """Refuse a file that announces more splats than so many packed bytes can hold."""
    if sum(header.sizes) > max(MAX_RATIO * available, ALWAYS_ALLOWED):
        raise InputError(
            f"{path} announces {header.count} splats, which its {available} bytes cannot hold; copy or write it again."
        )


def _unpacked_streams(path: Path, data: bytes) -> tuple[Header, list[bytes], bytes]:
    """Return the header, the unpacked attributes and the extensions of version 4."""
    cut_off = InputError(f"{path} is cut off; copy or write it again.")
    if len(data) < HEADER.size + TABLE_START.size:
        raise cut_off
    header = _header(path, data)
    (start,) = TABLE_START.unpack_from(data, HEADER.size)
    sizes = [size for size in header.sizes if size]
    here = start + ENTRY.size * len(sizes)
    if header.version != 4 or header.streams != len(sizes) or start < HEADER.size + TABLE_START.size:
        raise ValueError("another table than that of version 4")
    if here > len(data):
        raise cut_off
    table = list(ENTRY.iter_unpack(data[start:here]))
    if [unpacked for _, unpacked in table] != sizes:
        raise ValueError("attributes of another number of splats")
    if here + sum(packed for packed, _ in table) > len(data):
        raise cut_off
    _check_size(path, header, len(data))
    zstandard = _zstandard()
    attributes = []
    for packed, unpacked in table:
        attributes.append(_unpacked(zstandard, data[here : here + packed], unpacked))
        here += packed
    extensions = data[HEADER.size + TABLE_START.size : start] if header.flags & HAS_EXTENSIONS else b""
    return header, attributes, extensions


def _unpacked(zstandard: ModuleType, packed: bytes, size: int) -> bytes:
    """Unpack a zstd frame of `size` bytes; raises ValueError where it holds another number, before memory is taken."""
    try:
        if zstandard.frame_content_size(packed) not in (size, -1):  # -1: the frame does not say it
            raise ValueError("another size than the table has")
        unpacked: bytes = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from error
    if len(unpacked) != size:
        raise ValueError("fewer bytes than the table has")
    return unpacked


def _unzipped(path: Path, data: bytes) -> tuple[Header, list[bytes], bytes]:
    """Return the header, the attributes and the extensions of versions 1 to 3."""
    unzip = zlib.decompressobj(16 + zlib.MAX_WBITS)
    header = _header(path, unzip.decompress(data, HEADER.size))
    if header.version > 3:
        raise ValueError("a version that is not packed with gzip")
    _check_size(path, header, len(data))
    size = sum(header.sizes)
    # Extensions are a few bytes; one more byte than the attributes shows that there is more.
    more = ALWAYS_ALLOWED if header.flags & HAS_EXTENSIONS else 1
    content = unzip.decompress(unzip.unconsumed_tail, size + more)
    if len(content) < size:
        raise InputError(f"{path} is cut off; copy or write it again.")
    if not unzip.eof:
        raise ValueError("more or fewer bytes than the header announces")
    ends = np.cumsum(header.sizes).tolist()
    attributes = [content[end - size : end] for end, size in zip(ends, header.sizes, strict=True)]
    return header, attributes, content[ends[-1] :]


def _axes(extensions: bytes) -> np.ndarray:
    """Return the matrix (3, 3) from the file's axes to x right, y up, z back."""
    for kind, content in _records(extensions):
        if kind == AXES_EXTENSION:
            (number,) = struct.unpack("<I", content)
            if number > len(AXES):
                raise ValueError("unknown axes")
            if number:
                return np.array([DIRECTIONS[letter] for letter in AXES[number - 1]], np.float64).T
    return np.eye(3)


def _records(extensions: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield type and content of each extension."""
    here = 0
    while here < len(extensions):
        kind, length = RECORD.unpack_from(extensions, here)
        here += RECORD.size + length
        if here > len(extensions):
            raise ValueError("an extension beyond the end")
        yield kind, extensions[here - length : here]


def _splats(header: Header, attributes: list[bytes]) -> Splats:
    """Return the splats in the file's axes."""
    count = header.count
    # Without further coefficients there is no stream of them.
    rows = [np.frombuffer(attribute, np.uint8).reshape(count, -1) for attribute in attributes]
    positions, opacities, colors, scales, rotations = rows[:5]
    kept = (min(header.degree, 3) + 1) ** 2
    sh = np.empty((count, kept, 3), np.float32)
    sh[:, 0] = (colors / np.float32(255) - np.float32(0.5)) / np.float32(COLOR_SCALE)
    if kept > 1:
        sh[:, 1:] = rows[5].reshape(count, -1, 3)[:, : kept - 1]
        sh[:, 1:] -= 128
        sh[:, 1:] /= 128
    return Splats(
        positions=_positions(header, positions),
        rotations=_unpacked_rotations(rotations),
        scales=np.exp(scales / np.float32(16) - np.float32(10)),
        opacities=opacities[:, 0] / np.float32(255),
        sh=sh,
    )


def _positions(header: Header, rows: np.ndarray) -> np.ndarray:
    """Return positions (N, 3) float32."""
    if header.version == 1:
        return np.ascontiguousarray(rows).view("<f2").astype(np.float32)
    low, middle, high = (rows[:, byte::3].astype(np.int32) for byte in range(3))
    steps = low | middle << 8 | (high ^ 0x80) - 0x80 << 16
    return (steps * 2.0**-header.fraction_bits).astype(np.float32)


def _unpacked_rotations(rows: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) wxyz float32 from bytes (N, 4), or before version 3 (N, 3)."""
    if rows.shape[1] == 3:
        others = rows / 127.5 - 1
        largest = np.full((len(rows), 1), 3)
    else:
        words = np.ascontiguousarray(rows).view("<u4")
        largest = (words >> np.uint32(30)).astype(np.intp)
        parts = np.concatenate([words >> np.uint32(shift) & np.uint32(1023) for shift in (20, 10, 0)], axis=1)
        others = (parts & np.uint32(511)) / (511 * np.sqrt(2))
        others = np.where(parts > 511, -others, others)
    quaternions = np.empty((len(rows), 4))
    np.put_along_axis(quaternions, _others(largest), others, axis=1)
    remaining = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1, keepdims=True)))
    np.put_along_axis(quaternions, largest, remaining, axis=1)
    return np.roll(quaternions, 1, axis=1).astype(np.float32)


def _zstandard() -> ModuleType:
    """Return the package zstandard, which Blender and the engine's environment have.

    Raises:
        InputError: If this Python lacks it.
    """
    try:
        import zstandard
    except ModuleNotFoundError as error:
        raise InputError(
            "SPZ files need the Python package zstandard, which this Python lacks: "
            f"{remedy('install it with `python -m pip install zstandard`, or use PLY', 'use PLY or GLB')}."
        ) from error
    return zstandard


FORMAT = ExportFormat(
    name="spz",
    suffix=".spz",
    title="SPZ",
    description="A tenth of the size of a PLY, for the web and phones; numbers are rounded, and labels left out.",
    options=frozenset(),
    write=lambda path, splats, up, cameras: write_spz(path, splats, up),
    size=lambda path, splats, up, cameras: spz_size(path, splats, up),
    read=read_spz,
)
