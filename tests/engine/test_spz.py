"""SPZ: what goes out comes back as exactly as the format can, gaussforge reads and writes the same, damage is refused.

gaussforge is a wrapper of Niantic's own library: it shows the numbers of a file without turning them.
"""

import gzip
import logging
import struct
import sys
import tracemalloc

import numpy as np
import pytest
import zstandard

from swag_engine.base.errors import InputError
from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.formats.spz import ALWAYS_ALLOWED, AXES, Header, read_spz, spz_size, write_spz
from swag_engine.splats.splats import Splats
from swag_engine.splats.transform import covariances, rotation_matrices, sh_basis, transformed

Y_UP = (0.0, 1.0, 0.0)
"""Up direction of the file's own axes."""


def some_splats(count=300, degree=3, seed=0):
    """Splats within the range of the format."""
    random = np.random.default_rng(seed)
    rotations = random.normal(size=(count, 4))
    sh = random.normal(size=(count, (degree + 1) ** 2, 3)) * 0.25
    sh[:, 0] *= 4
    columns = (
        random.normal(size=(count, 3)) * 5,
        rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
        np.exp(random.uniform(-6, 1, (count, 3))),
        random.uniform(0, 1, count),
        sh.clip(-0.99, 0.99) if degree else sh,
    )
    positions, rotations, scales, opacities, sh = (column.astype(np.float32) for column in columns)
    return Splats(positions, rotations, scales, opacities, sh)


def same_rotations(a, b, tolerance):
    cosines = np.abs(np.sum(a.astype(np.float64) * b, axis=1))
    assert cosines.min() > np.cos(tolerance), cosines.min()


def assert_rounded(read, expected):
    """Equal to the precision of the format."""
    np.testing.assert_allclose(read.positions, expected.positions, atol=0.5 / 4096 + 1e-6)
    np.testing.assert_allclose(np.log(read.scales), np.log(expected.scales), atol=0.5 / 16 + 1e-5)
    np.testing.assert_allclose(read.opacities, expected.opacities, atol=0.5 / 255 + 1e-6)
    same_rotations(read.rotations, expected.rotations, 0.003)
    error = np.abs(read.sh - expected.sh)
    assert read.sh.shape == expected.sh.shape and error[:, 0].max() <= 0.5 / 255 / 0.15 + 1e-6
    assert error[:, 1:4].max(initial=0) <= 4.5 / 128 + 1e-6 and error[:, 4:].max(initial=0) <= 8.5 / 128 + 1e-6


@pytest.fixture(scope="module")
def gaussforge(missing):
    try:
        import gaussforge as module
    except ModuleNotFoundError:
        missing("gaussforge is not installed: run `make .venv/ready`.")
    return module.GaussForge()


def by_gaussforge(gaussforge, data, tmp_path):
    """What gaussforge reads from the bytes of an SPZ, as splats."""
    converted = gaussforge.convert(data, "spz", "ply")
    assert "error" not in converted, converted
    (tmp_path / "read by gaussforge.ply").write_bytes(bytes(converted["data"]))
    return read_ply(tmp_path / "read by gaussforge.ply")


def made_by_gaussforge(gaussforge, splats, version, tmp_path):
    write_ply(tmp_path / "given.ply", splats)
    converted = gaussforge.convert((tmp_path / "given.ply").read_bytes(), "ply", "spz", spz_version=version)
    assert "error" not in converted, converted
    return bytes(converted["data"])


def streams_of(data):
    """The unpacked attributes of a file of version 4, by the description of the format."""
    start = struct.unpack_from("<I", data, 16)[0]
    here, found = start + 16 * data[15], []
    for packed, unpacked in struct.iter_unpack("<QQ", data[start:here]):
        found.append(zstandard.ZstdDecompressor().decompress(data[here : here + packed]))
        assert len(found[-1]) == unpacked
        here += packed
    assert here == len(data)
    return found


def version_four(streams, count, degree, extensions=b"", flags=0):
    """A file of version 4 from unpacked attributes."""
    packed = [zstandard.ZstdCompressor().compress(stream) for stream in streams]
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, 12, flags, len(streams), 32 + len(extensions))
    table = b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True))
    return b"".join([head, extensions, table, *packed])


# ------------------------------------------------------------------------------------------------ what is written


@pytest.mark.parametrize("up", [Y_UP, (0.0, -1.0, 0.0), (0.2, -0.7, 0.4)])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_goes_out_comes_back(tmp_path, degree, up):
    splats, path = some_splats(degree=degree), tmp_path / "Riff ä.spz"
    write_spz(path, splats, up)
    assert spz_size(path, splats, up) == path.stat().st_size < 300 * (20 + 45)
    read = read_spz(path, up)
    if up == Y_UP:
        assert_rounded(read, splats)
    np.testing.assert_allclose(read.positions, splats.positions, atol=1e-3)
    np.testing.assert_allclose(covariances(read), covariances(splats), atol=0.1 * covariances(splats).max())
    direction = np.array([[0.36, 0.48, 0.8]])
    basis = sh_basis(direction, degree)[0]
    seen = np.einsum("k,nkc->nc", basis, read.sh - splats.sh)
    assert np.sqrt(np.mean(seen**2)) < 0.1


def test_the_same_splats_make_the_same_bytes_and_a_second_round_changes_nothing(tmp_path):
    splats = some_splats()
    for name in ("a", "b"):
        write_spz(tmp_path / name, splats, Y_UP)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    read = read_spz(tmp_path / "a", Y_UP)
    write_spz(tmp_path / "c", read, Y_UP)
    again = read_spz(tmp_path / "c", Y_UP)
    for name in ("positions", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(again, name), getattr(read, name))
    same_rotations(again.rotations, read.rotations, 1e-3)


def test_up_is_y_in_the_file(tmp_path):
    """One splat two units above the ground of COLMAP's world, and one of Blender's."""
    one = some_splats(1, 0)
    for up, place in (((0, -1, 0), (0, -2, 0)), ((0, 0, 1), (0, 0, 2))):
        one.positions[:] = place
        write_spz(tmp_path / "one.spz", one, up)
        np.testing.assert_allclose(read_spz(tmp_path / "one.spz", Y_UP).positions, [(0, 2, 0)], atol=1e-6)


@pytest.mark.parametrize(
    ("farthest", "size", "step"), [(5.0, 0.1, 2**-12), (5.0, 1e-4, 2**-19), (3000.0, 1e-4, 2**-11)]
)
def test_small_splats_get_finer_positions_where_all_fit(tmp_path, farthest, size, step):
    splats = some_splats(50, 0)
    splats.positions *= np.float32(farthest / np.abs(splats.positions).max())
    splats.scales[:] = size
    write_spz(tmp_path / "a.spz", splats, Y_UP)
    error = np.abs(read_spz(tmp_path / "a.spz", Y_UP).positions - splats.positions).max()
    assert step / 8 < error <= step / 2 * 1.01 + 1e-6 * farthest


def test_numbers_outside_the_range_become_its_ends(tmp_path):
    splats = some_splats(3)
    splats.sh[0, 0], splats.sh[0, 1], splats.sh[0, 2] = 9, 9, -9
    splats.scales[0] = 0, 1e-30, 1e9
    splats.opacities[:] = 0, 1, np.nan
    write_spz(tmp_path / "a.spz", splats, Y_UP)
    read = read_spz(tmp_path / "a.spz", Y_UP)
    np.testing.assert_allclose(read.sh[0, :3, 0], [10 / 3, 127 / 128, -1], rtol=1e-6)
    np.testing.assert_allclose(np.log(read.scales[0]), [-10, -10, 255 / 16 - 10], rtol=1e-6)
    np.testing.assert_array_equal(read.opacities, [0, 1, 0])


def test_what_cannot_be_written_is_refused_and_leaves_no_file(tmp_path, monkeypatch):
    path = tmp_path / "a.spz"
    splats = some_splats(4, 0)
    far, lost = some_splats(4, 0), some_splats(4, 0)
    far.positions[1, 2], lost.positions[1, 2] = 1e7, np.nan
    none = splats.subset(np.zeros(4, bool))
    for given, words in ((none, "no splats"), (far, "scale the scene"), (lost, "not finite")):
        for function in (write_spz, spz_size):
            with pytest.raises(InputError, match=words):
                function(path, given)
    with pytest.raises(InputError, match="occupied"):
        (tmp_path / "occupied").touch()
        write_spz(tmp_path / "occupied" / "a.spz", splats)
    write_spz(tmp_path / "good.spz", splats)
    monkeypatch.setitem(sys.modules, "zstandard", None)
    for function in (lambda: write_spz(path, splats), lambda: read_spz(tmp_path / "good.spz")):
        with pytest.raises(InputError, match="pip install zstandard"):
            function()
    assert {entry.name for entry in tmp_path.iterdir()} == {"occupied", "good.spz"}


# ------------------------------------------------------------------------------------------------ gaussforge


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gaussforge_writes_the_same_bytes_and_reads_the_same_numbers(gaussforge, tmp_path, degree):
    splats = some_splats(degree=degree)
    write_spz(tmp_path / "ours.spz", splats, Y_UP)
    ours, theirs = (tmp_path / "ours.spz").read_bytes(), made_by_gaussforge(gaussforge, splats, 4, tmp_path)
    # Ours has an extension with the axes before the table.
    assert ours[:14] + bytes([0]) + ours[15:16] == theirs[:16] and ours[16:32] == struct.pack("<I12x", 44)
    assert ours[32:44] == struct.pack("<III", 0xADBE0003, 4, 4)
    different = [
        np.mean(np.frombuffer(a, np.uint8) != np.frombuffer(b, np.uint8))
        for a, b in zip(streams_of(ours), streams_of(theirs), strict=True)
    ]
    assert max(different) < 0.002, different  # a PLY's logit and logarithm move some across a half
    read = by_gaussforge(gaussforge, ours, tmp_path)
    assert_rounded(read, splats)
    own = read_spz(tmp_path / "ours.spz", Y_UP)
    np.testing.assert_array_equal(read.positions, own.positions)
    np.testing.assert_array_equal(read.sh, own.sh)
    np.testing.assert_allclose(read.scales, own.scales, rtol=1e-5)
    same_rotations(read.rotations, own.rotations, 1e-3)


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("degree", [0, 3])
def test_files_of_gaussforge_are_read(gaussforge, tmp_path, version, degree):
    splats = some_splats(degree=degree)
    (tmp_path / "theirs.spz").write_bytes(made_by_gaussforge(gaussforge, splats, version, tmp_path))
    read = read_spz(tmp_path / "theirs.spz", Y_UP)
    theirs = by_gaussforge(gaussforge, (tmp_path / "theirs.spz").read_bytes(), tmp_path)
    np.testing.assert_array_equal(read.positions, theirs.positions)
    np.testing.assert_array_equal(read.sh, theirs.sh)
    np.testing.assert_allclose(read.scales, theirs.scales, rtol=1e-5)
    np.testing.assert_allclose(read.opacities, theirs.opacities, atol=1e-6)
    same_rotations(read.rotations, theirs.rotations, 1e-3)
    same_rotations(read.rotations, splats.rotations, 0.003 if version > 2 else 0.2)  # bytes: poor near half a turn


# ------------------------------------------------------------------------------------------------ other files


def test_version_one_has_half_floats(tmp_path):
    splats = some_splats(9, 1)
    write_spz(tmp_path / "a.spz", splats, Y_UP)
    _, opacities, colors, scales, _, sh = streams_of((tmp_path / "a.spz").read_bytes())
    places, still = splats.positions.astype("<f2"), bytes([127, 128, 255] * 9)
    head = struct.pack("<4sIIBBBB", b"NGSP", 1, 9, 1, 12, 0, 0)
    packed = gzip.compress(b"".join([head, places.tobytes(), opacities, colors, scales, still, sh]))
    (tmp_path / "old.spz").write_bytes(packed)
    read = read_spz(tmp_path / "old.spz", Y_UP)
    np.testing.assert_array_equal(read.positions, places.astype(np.float32))
    np.testing.assert_allclose(np.abs(read.rotations), [[0, 0, 0, 1]] * 9, atol=0.01)
    np.testing.assert_array_equal(read.sh, read_spz(tmp_path / "a.spz", Y_UP).sh)


def test_degree_four_keeps_degree_three(tmp_path, caplog):
    splats = some_splats(20, 3)
    write_spz(tmp_path / "a.spz", splats, Y_UP)
    *others, sh = streams_of((tmp_path / "a.spz").read_bytes())
    more = np.concatenate([np.frombuffer(sh, np.uint8).reshape(20, 45), np.full((20, 27), 200, np.uint8)], axis=1)
    (tmp_path / "b.spz").write_bytes(version_four([*others, more.tobytes()], 20, 4))
    with caplog.at_level(logging.WARNING):
        read = read_spz(tmp_path / "b.spz", Y_UP)
    np.testing.assert_array_equal(read.sh, read_spz(tmp_path / "a.spz", Y_UP).sh)
    assert "above degree 3" in caplog.text


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("axes", ["RUB", "RDF", "LUF", "RFU"])
def test_axes_that_a_file_declares_are_followed(tmp_path, axes, legacy):
    """RDF is half a turn around x; RFU has z up, LUF is half a turn around y. Other extensions are ignored."""
    splats = some_splats(40, 3)
    write_spz(tmp_path / "a.spz", splats, Y_UP)
    streams = streams_of((tmp_path / "a.spz").read_bytes())
    extensions = struct.pack("<II3s", 0x12340001, 3, b"xyz") + struct.pack("<III", 0xADBE0003, 4, AXES.index(axes) + 1)
    if legacy:
        head = struct.pack("<4sIIBBBB", b"NGSP", 3, 40, 3, 12, 2, 0)
        data = gzip.compress(b"".join([head, *streams, extensions]))
    else:
        data = version_four(streams, 40, 3, extensions, flags=2)
    (tmp_path / "b.spz").write_bytes(data)
    turns = {"RUB": (1, 0, 0, 0), "RDF": (0, 1, 0, 0), "LUF": (0, 0, 1, 0), "RFU": (np.sqrt(0.5), -np.sqrt(0.5), 0, 0)}
    turn = np.eye(4)
    turn[:3, :3] = rotation_matrices(np.array(turns[axes]))
    expected, read = transformed(read_spz(tmp_path / "a.spz", Y_UP), turn), read_spz(tmp_path / "b.spz", Y_UP)
    np.testing.assert_allclose(read.positions, expected.positions, atol=1e-5)
    np.testing.assert_allclose(covariances(read), covariances(expected), atol=1e-4)
    np.testing.assert_allclose(read.sh, expected.sh, atol=1e-5)


@pytest.mark.parametrize("version", [3, 4])
def test_damaged_files_are_refused_in_one_sentence(tmp_path, version):
    path, splats = tmp_path / "a.spz", some_splats(30, 1)
    write_spz(path, splats, Y_UP)
    good, streams = path.read_bytes(), streams_of(path.read_bytes())

    def file(count=30, degree=1, bits=12, flags=0, number=version, more=b"", content=streams):
        """A file with another header."""
        if version == 4:
            data = bytearray(version_four(content, count, degree, more, flags))
            data[4], data[13] = number, bits
            return bytes(data)
        head = struct.pack("<4sIIBBBB", b"NGSP", number, count, degree, bits, flags, 0)
        return gzip.compress(b"".join([head, *content, more]))

    assert_rounded(read_spz(path, Y_UP), splats)
    path.write_bytes(file())
    assert_rounded(read_spz(path, Y_UP), splats)
    cases = [
        (b"", "is empty"),
        (b"ply\nformat ascii", "is not an SPZ"),
        (file(count=0), "holds no splats"),
        (file(count=31), "damaged|cut off"),
        (file(count=29), "damaged"),
        (file(count=2**32 - 1), "damaged|cannot hold"),
        (file(degree=2), "damaged|cut off"),
        (file(degree=5), "damaged"),
        (file(bits=99), "damaged"),
        (file(number=5), "version 5"),
        (file(number=0), "damaged"),
        (file(flags=2, more=struct.pack("<II", 7, 99)), "damaged"),
        (file(flags=2, more=struct.pack("<III", 0xADBE0003, 4, 17)), "damaged"),
        (file(flags=2, more=struct.pack("<IIH", 0xADBE0003, 2, 1)), "damaged"),
        *[(file()[:length], "cut off|damaged|empty") for length in (0, 1, 3, 15, 31, 33, 100, len(file()) - 1)],
    ]
    if version == 4:
        packed_size, unpacked_size = struct.unpack_from("<QQ", good, 44)
        cases += [
            (good[:52] + struct.pack("<Q", unpacked_size + 1) + good[60:], "damaged"),
            (good[:44] + struct.pack("<Q", 2**63) + good[52:], "cut off"),
            (good[:44] + struct.pack("<Q", packed_size - 1) + good[52:], "damaged"),
            (good[:15] + b"\x05" + good[16:], "damaged"),
            (good[:16] + struct.pack("<I", 8) + good[20:], "damaged"),
            (good[:16] + struct.pack("<I", 2**31) + good[20:], "cut off"),
        ]
    for data, words in cases:
        path.write_bytes(data)
        with pytest.raises(InputError, match=words) as refused:
            read_spz(path)
        assert str(path) in str(refused.value) and "\n" not in str(refused.value)
    with pytest.raises(InputError, match="nowhere"):
        read_spz(tmp_path / "nowhere.spz")


@pytest.mark.parametrize("version", [3, 4])
def test_a_small_file_cannot_fill_the_memory(tmp_path, version):
    """Zeros pack a thousand times smaller: a megabyte of file would become gigabytes of splats."""
    count, path = 4_000_000, tmp_path / "bomb.spz"
    sizes = Header(version, count, 0, 12, 0, 5).sizes[:5]
    if version == 4:
        path.write_bytes(version_four([bytes(size) for size in sizes], count, 0))
    else:
        head = struct.pack("<4sIIBBBB", b"NGSP", 3, count, 0, 12, 0, 0)
        path.write_bytes(gzip.compress(head + bytes(sum(sizes)), 9))
    assert sum(sizes) > max(100 * path.stat().st_size, ALWAYS_ALLOWED)
    with pytest.raises(InputError, match="announces 4000000 splats"):
        read_spz(path)


@pytest.mark.parametrize("says", [False, True])
def test_a_frame_with_more_than_the_table_says_is_refused_without_unpacking_it(tmp_path, says):
    """The header of a zstd frame may say another size, or none."""
    path = tmp_path / "a.spz"
    write_spz(path, some_splats(30, 0), Y_UP)
    streams = streams_of(path.read_bytes())
    packer = zstandard.ZstdCompressor(write_content_size=says)
    for extra in (0, 100_000_000):
        packed = [packer.compress(streams[0] + bytes(extra)), *map(packer.compress, streams[1:])]
        head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 30, 0, 12, 0, 5, 32)
        table = b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True))
        path.write_bytes(b"".join([head, table, *packed]))
        if not extra:
            assert len(read_spz(path)) == 30
    tracemalloc.start()
    with pytest.raises(InputError, match="damaged"):
        read_spz(path)
    used = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert used < 1_000_000
