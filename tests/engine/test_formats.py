"""What goes out comes back, other programs' files come in, and damaged files end in one sentence."""

import base64
import json
import logging
import resource
import struct
from typing import Any

import numpy as np
import plyfile
import pytest

from swag_engine.base.errors import InputError
from swag_engine.camera_files.registry import read_camera_file
from swag_engine.formats.gltf import read_glb, write_glb
from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.formats.registry import find_format
from swag_engine.scene.colmap import load_scene
from swag_engine.splats.splats import Splats
from swag_engine.splats.transform import covariances, transformed

READERS = {"ply": read_ply, "glb": read_glb}
WRITERS = {"ply": write_ply, "glb": write_glb}
EXTENSION = "KHR_gaussian_splatting"


def some_splats(count=20, degree=3, extras=False):
    rng = np.random.default_rng(degree)
    rotations = rng.normal(size=(count, 4))
    own = {
        "label": rng.integers(-1, 40, count).astype(np.int32),
        "similarity": rng.random(count).astype(np.float32),
        "instance": rng.integers(0, 60000, count).astype(np.int32),
    }
    return Splats(
        rng.normal(size=(count, 3)).astype(np.float32),
        (rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32),
        np.exp(rng.normal(size=(count, 3)) * 2 - 5).astype(np.float32),
        rng.random(count).astype(np.float32),
        rng.normal(size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
        own if extras else {},
    )


def assert_equal(read, expected):
    """Equal bit by bit, but for the logit and the logarithm: those to float precision."""
    np.testing.assert_array_equal(read.positions, expected.positions)
    np.testing.assert_array_equal(read.rotations, expected.rotations)
    np.testing.assert_allclose(read.scales, expected.scales, rtol=1e-6)
    np.testing.assert_allclose(read.opacities, expected.opacities, atol=1e-7)
    np.testing.assert_array_equal(read.sh, expected.sh)
    assert read.extras.keys() == expected.extras.keys()
    for name, values in expected.extras.items():
        assert read.extras[name].dtype == values.dtype
        np.testing.assert_array_equal(read.extras[name], values)


def ply_columns(splats):
    """The file's properties by name, computed here independently of the writer."""
    opacities = splats.opacities.astype(np.float64)
    columns = dict(zip("xyz", splats.positions.T, strict=True))
    columns |= {f"f_dc_{c}": splats.sh[:, 0, c] for c in range(3)}
    rest = splats.sh.shape[1] - 1
    columns |= {f"f_rest_{c * rest + i}": splats.sh[:, 1 + i, c] for c in range(3) for i in range(rest)}
    columns |= {"opacity": np.log(opacities) - np.log1p(-opacities)}
    columns |= {f"scale_{i}": np.log(splats.scales[:, i].astype(np.float64)) for i in range(3)}
    columns |= {f"rot_{i}": splats.rotations[:, i] for i in range(4)}
    return columns


def write_with_plyfile(path, columns, kind="f4", text=False, byte_order="<"):
    write_rows(path, columns, {}, text, kind, byte_order)


def write_rows(path, columns, kinds, text=False, kind="f4", byte_order="<"):
    rows = np.zeros(len(next(iter(columns.values()))), [(name, kinds.get(name, kind)) for name in columns])
    for name, values in columns.items():
        rows[name] = values
    vertex = plyfile.PlyElement.describe(rows, "vertex")
    plyfile.PlyData([vertex], text=text, byte_order=byte_order, comments=["written elsewhere"]).write(path)


@pytest.fixture(params=["ply", "glb"])
def kind(request):
    return request.param


# ------------------------------------------------------------------------------------------------ both formats


@pytest.mark.parametrize("extras", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_goes_out_comes_back(tmp_path, kind, degree, extras):
    splats = some_splats(degree=degree, extras=extras)
    path = tmp_path / f"mit Umläuten {degree}.{kind}"
    WRITERS[kind](path, splats)
    assert_equal(READERS[kind](path), splats)


def test_more_splats_than_a_block(tmp_path, kind):
    splats = some_splats(20_000, 1, extras=True)
    WRITERS[kind](tmp_path / "big", splats)
    assert_equal(READERS[kind](tmp_path / "big"), splats)


def test_extreme_opacities_and_scales_stay_finite(tmp_path, kind):
    splats = some_splats(4)
    splats.opacities[:] = [0, 1, 1e-6, 1 - 2**-24]
    splats.scales[0] = [0, 1e-30, 1e30]
    WRITERS[kind](tmp_path / "extreme", splats)
    read = READERS[kind](tmp_path / "extreme")
    np.testing.assert_allclose(read.opacities, splats.opacities, atol=2e-8)
    np.testing.assert_allclose(read.scales, splats.scales, rtol=1e-5, atol=2e-38)


def test_no_splats_are_not_written(tmp_path, kind):
    nothing = some_splats().subset(np.zeros(20, bool))
    with pytest.raises(InputError, match="no splats to write"):
        WRITERS[kind](tmp_path / "none", nothing)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_file(tmp_path, kind, monkeypatch):
    path = tmp_path / f"old.{kind}"
    path.write_bytes(b"old")

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(InputError, match="No space left"):
        WRITERS[kind](path, some_splats())
    assert path.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


def test_a_disk_that_fills_up_leaves_the_old_file(tmp_path, kind):
    """Half of the new file fits: nothing of it stays, the old one does."""
    path = tmp_path / f"old.{kind}"
    WRITERS[kind](path, some_splats(10))
    old = path.read_bytes()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, before[1]))
    try:
        with pytest.raises(InputError, match="File too large"):
            WRITERS[kind](path, some_splats(10_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes() == old and len(list(tmp_path.iterdir())) == 1


def test_splats_with_nan_are_left_out_and_counted(tmp_path, kind, caplog):
    splats = some_splats(6, 1, extras=True)
    splats.sh[1, 2, 0] = np.nan
    splats.rotations[4, 1] = np.inf
    WRITERS[kind](tmp_path / "nan", splats)
    with caplog.at_level(logging.WARNING):
        read = READERS[kind](tmp_path / "nan")
    assert_equal(read, splats.subset(np.array([0, 2, 3, 5])))
    assert "2 of 6" in caplog.text


def test_only_nan_is_an_error(tmp_path, kind):
    splats = some_splats(2, 0)
    splats.sh[:] = np.nan
    WRITERS[kind](tmp_path / "nan", splats)
    with pytest.raises(InputError, match="finite"):
        READERS[kind](tmp_path / "nan")


def test_quaternions_are_brought_to_unit_length(tmp_path, kind):
    splats = some_splats(3, 0)
    lengthened = some_splats(3, 0)
    lengthened.rotations[0] *= 7
    lengthened.rotations[1] = 0
    splats.rotations[1] = (1, 0, 0, 0)
    WRITERS[kind](tmp_path / "long", lengthened)
    np.testing.assert_allclose(READERS[kind](tmp_path / "long").rotations, splats.rotations, atol=1e-7)


def test_missing_empty_and_foreign_files(tmp_path, kind):
    read = READERS[kind]
    with pytest.raises(InputError, match="No such file"):
        read(tmp_path / "absent")
    with pytest.raises(InputError, match="Is a directory"):
        read(tmp_path)
    (tmp_path / "empty").touch()
    with pytest.raises(InputError, match="is empty"):
        read(tmp_path / "empty")
    (tmp_path / "text").write_text("plywood and glTF")
    with pytest.raises(InputError, match="is not a"):
        read(tmp_path / "text")


def test_every_cut_ends_in_one_sentence(tmp_path, kind):
    path = tmp_path / f"cut.{kind}"
    WRITERS[kind](path, some_splats(3, 1))
    data = path.read_bytes()
    for length in range(0, len(data), 7):
        path.write_bytes(data[:length])
        with pytest.raises(InputError) as error:
            READERS[kind](path)
        assert str(path) in str(error.value) and str(error.value).count("\n") == 0


# ------------------------------------------------------------------------------------------------ PLY


@pytest.mark.parametrize("degree", [0, 3])
def test_plyfile_reads_the_same_numbers(tmp_path, degree):
    splats = some_splats(degree=degree, extras=True)
    write_ply(tmp_path / "a.ply", splats)
    data = plyfile.PlyData.read(tmp_path / "a.ply")
    assert data.byte_order == "<" and not data.text and [element.name for element in data.elements] == ["vertex"]
    rows = data["vertex"].data
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity"]
    expected += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert rows.dtype.names == (*expected, "label", "similarity", "instance")
    assert all(rows.dtype[name] == np.float32 for name in expected)
    assert rows.dtype["label"] == np.int32 and rows.dtype["similarity"] == np.float32
    for name, values in ply_columns(splats).items():
        np.testing.assert_allclose(rows[name], values, rtol=1e-6, err_msg=name)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize("how", ["ascii", "little", "big"])
def test_shuffled_properties_of_another_writer(tmp_path, degree, kind, how):
    splats = some_splats(degree=degree)
    columns = list(ply_columns(splats).items())
    np.random.default_rng(1).shuffle(columns)
    write_with_plyfile(
        tmp_path / "b.ply", dict(columns), kind, text=how == "ascii", byte_order=">" if how == "big" else "<"
    )
    read = read_ply(tmp_path / "b.ply")
    for name in ("positions", "rotations", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(read, name), getattr(splats, name), rtol=2e-6, atol=1e-7, err_msg=name)
    assert not read.extras


@pytest.mark.parametrize("text", [False, True])
def test_extra_properties_and_other_elements(tmp_path, text):
    splats = some_splats(degree=0)
    columns = ply_columns(splats)
    rows = np.zeros(len(splats), [("class", "u1"), *((name, "f4") for name in columns), ("Score", "f8"), ("id", "i4")])
    for name, values in columns.items():
        rows[name] = values
    rows["class"], rows["Score"], rows["id"] = np.arange(20) + 200, np.arange(20) / 3, -np.arange(20)
    chunks = plyfile.PlyElement.describe(np.ones(3, [("low", "f4"), ("high", "i2")]), "chunk")
    faces = np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))])
    elements = [chunks, plyfile.PlyElement.describe(rows, "vertex"), plyfile.PlyElement.describe(faces, "face")]
    plyfile.PlyData(elements, text=text).write(tmp_path / "c.ply")
    read = read_ply(tmp_path / "c.ply")
    np.testing.assert_array_equal(read.positions, splats.positions)
    assert {name: values.dtype.name for name, values in read.extras.items()} == {
        "class": "uint8",
        "Score": "float64",
        "id": "int32",
    }
    for name, values in read.extras.items():
        np.testing.assert_array_equal(values, rows[name])
    write_ply(tmp_path / "d.ply", read)
    assert_equal(read_ply(tmp_path / "d.ply"), read)


def sorted_by_name(columns):
    return {name: columns[name] for name in sorted(columns)}


def shapes_first(columns):
    order = ["x", "y", "z", "scale_", "opacity", "rot_", "f_dc_", "f_rest_"]
    return {name: columns[name] for start in order for name in columns if name.startswith(start)}


def with_normals(columns):
    zeros = {name: np.zeros(len(columns["x"])) for name in ("nx", "ny", "nz")}
    return {name: columns[name] for name in "xyz"} | zeros | columns


LAYOUTS = {
    "3DGS": (with_normals, []),
    "gsplat": (dict, []),
    "Brush, sorted names": (sorted_by_name, ["Exported from Brush", "Vertical axis: y", "SH degree: {degree}"]),
    "Brush": (shapes_first, ["Exported from Brush", "Vertical axis: 0 1 0", "SplatRenderMode: mip"]),
    "SuperSplat": (dict, ["Generated by SuperSplat 2.4.1"]),
}


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("arranged, comments", LAYOUTS.values(), ids=LAYOUTS.keys())
def test_layouts_of_other_trainers(tmp_path, degree, arranged, comments):
    splats = some_splats(degree=degree)
    columns = arranged(ply_columns(splats))
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {c.format(degree=degree)}" for c in comments)]
    header += ["element vertex 20", *(f"property float {name}" for name in columns), "end_header", ""]
    rows = np.stack(list(columns.values()), axis=1).astype("<f4")
    (tmp_path / "theirs.ply").write_bytes("\n".join(header).encode() + rows.tobytes())
    assert_equal(read_ply(tmp_path / "theirs.ply"), splats)


def packed_ply(path, chunk_names, words, chunks, more=""):
    header = ["ply", "format binary_little_endian 1.0", "comment generated by super-splat"]
    header += [f"element chunk {len(chunks)}", *(f"property float {name}" for name in chunk_names)]
    header += [f"element vertex {len(words)}"]
    header += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    path.write_bytes(("\n".join(header) + f"\n{more}end_header\n").encode() + chunks.tobytes() + words.tobytes())


@pytest.mark.parametrize("more", ["", "element sh 2\n"], ids=["old SuperSplat", "gsplat of degree 0"])
def test_compressed_by_hand(tmp_path, more):
    """Two splats packed bit by bit, colors without bounds: one inside the box and one at its corner."""
    names = ["min_x", "min_y", "min_z", "max_x", "max_y", "max_z"]
    names += [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
    chunk = np.array([[-1, -2, -3, 1, 2, 5, -4, -4, -4, 0, -2, -1]], "<f4")
    words = np.array(
        [
            [1536 << 21 | 256 << 11 | 64, 1023 << 20 | 512 << 10 | 512, 0, 255 << 24 | 255],  # w largest: x 1 / sqrt(2)
            [2047 << 21 | 1023 << 11 | 2047, 3 << 30 | 512 << 20 | 512 << 10 | 512, 2047 << 21, 51 << 16 | 102],
        ],
        "<u4",
    )
    packed_ply(tmp_path / "old.ply", names, words, chunk, more)
    read = read_ply(tmp_path / "old.ply")
    inside = [-1 + 2 * 1536 / 2047, -2 + 4 * 256 / 1023, -3 + 8 * 64 / 2047]
    np.testing.assert_allclose(read.positions, [inside, [1.0, 2.0, 5.0]], rtol=1e-6)
    np.testing.assert_allclose(read.scales, np.exp([[-4, -4, -4], [0, -4, -4]]), rtol=1e-6)
    np.testing.assert_allclose(read.rotations, [[0.5**0.5, 0.5**0.5, 0, 0], [0, 0, 0, 1]], atol=2e-3)
    np.testing.assert_allclose(0.5 + 0.28209479 * read.sh[:, 0], [[1.0, 0.0, 0.0], [0.0, 0.2, 0.0]], atol=1e-6)
    np.testing.assert_allclose(read.opacities, [1, 0.4], atol=1e-6)


def test_text_of_other_writers(tmp_path):
    splats = some_splats(3, 0)
    write_rows(tmp_path / "e.ply", ply_columns(splats), {}, True, "f8")
    before = "comment Größe\nobj_info a b\nelement face 2\nproperty list uchar int vertex_indices\nelement vertex"
    head, body = (tmp_path / "e.ply").read_text().replace("element vertex", before).split("end_header")
    text = f"{head}element edge 1\nproperty int a\nend_header\n3 0 1 2\n4 0 1 2 0\n\n{body}\n7\n"
    (tmp_path / "e.ply").write_bytes(text.replace("\n", "\r\n").encode())
    np.testing.assert_array_equal(read_ply(tmp_path / "e.ply").positions, splats.positions)


def columns_without(splats, *starts):
    return {name: values for name, values in ply_columns(splats).items() if not name.startswith(starts)}


@pytest.mark.parametrize("kind, white", [("u1", 255), ("f4", 255), ("f4", 1), ("u2", 65535)])
@pytest.mark.parametrize("names", ["rgb", ("red", "green", "blue")])
def test_plain_colors_stand_in_for_harmonics(tmp_path, names, kind, white):
    given = np.array([[1, 0.2, 0], [0.4, 0, 0.6], [0.8, 1, 0.2]]) * white
    colors = dict(zip(names, given.T, strict=True))
    write_rows(tmp_path / "c.ply", columns_without(some_splats(3, 0), "f_dc") | colors, dict.fromkeys(names, kind))
    read = read_ply(tmp_path / "c.ply")
    np.testing.assert_allclose(0.5 + 0.2820948 * read.sh[:, 0], given / white, atol=1e-6)
    assert not read.extras


@pytest.mark.parametrize("axes, missing", [(3, "?"), (2, "scale_2"), (1, ("scale_1", "scale_2", "rot"))])
def test_fewer_sizes_and_the_filter_of_mip_splatting(tmp_path, axes, missing):
    splats, widths = some_splats(5, 0), np.linspace(0, 0.1, 5)
    write_with_plyfile(tmp_path / "m.ply", columns_without(splats, *np.ravel(missing)) | {"filter_3D": widths})
    read = read_ply(tmp_path / "m.ply")
    before = splats.scales[:, [0, 0, 0] if axes == 1 else range(axes)].astype(float)
    after = np.hypot(before, widths[:, None])
    np.testing.assert_allclose(read.opacities, splats.opacities * (before / after).prod(axis=1), rtol=1e-4)
    after = np.c_[after, 1e-3 * after.min(axis=1)] if axes == 2 else after
    np.testing.assert_allclose(read.scales, after, rtol=1e-5)
    assert (read.rotations == ((1, 0, 0, 0) if axes == 1 else splats.rotations)).all() and not read.extras


@pytest.mark.parametrize("order", "<>")
def test_doubles_are_read(tmp_path, order):
    far = {"x": np.array([500000.03125, 0.1, 3e-9]), "time": np.array([1.7e9 + 0.25, 1e300, 0])}
    write_with_plyfile(tmp_path / "d.ply", ply_columns(some_splats(3, 1)) | far, "f8", byte_order=order)
    read = read_ply(tmp_path / "d.ply")
    np.testing.assert_array_equal(read.positions[:, 0], far["x"].astype(np.float32))
    np.testing.assert_array_equal(read.extras["time"], far["time"])


def test_extras_that_are_not_finite_make_valid_files(tmp_path, kind, caplog):
    splats = some_splats(3, 0)
    splats.extras = {"haze": np.array([np.nan, 0.5, -np.inf], np.float32), "big": np.array([1e300, 2, 3])}
    WRITERS[kind](tmp_path / "a", splats)
    read = READERS[kind](tmp_path / "a").extras
    assert np.isfinite(read["haze"]).all() and read["haze"][:2].tolist() == [0, 0.5] and read["big"][2] == 3
    assert ("2 values of haze" in caplog.text) == (kind == "ply")  # a GLB holds finite numbers


def test_infinite_logits_are_opacities(tmp_path):
    columns = ply_columns(some_splats(3, 0)) | {"opacity": np.array([np.inf, -np.inf, 0])}
    write_with_plyfile(tmp_path / "f.ply", columns)
    np.testing.assert_array_equal(read_ply(tmp_path / "f.ply").opacities, np.array([1, 0, 0.5], np.float32))


def test_degree_four_keeps_degree_three(tmp_path, caplog):
    splats = some_splats(5, 3)
    columns = ply_columns(splats)
    rest = {c * 24 + i: columns.pop(f"f_rest_{c * 15 + i}") for c in range(3) for i in range(15)}
    columns |= {f"f_rest_{i}": rest.get(i, np.full(5, 9.0)) for i in range(72)}
    write_with_plyfile(tmp_path / "g.ply", columns)
    np.testing.assert_array_equal(read_ply(tmp_path / "g.ply").sh, splats.sh)
    assert "above degree 3" in caplog.text


def test_plys_that_are_no_splats_say_so(tmp_path):
    path, columns = tmp_path / "h.ply", ply_columns(some_splats(4, 1))
    cases = [
        ({name: columns[name] for name in "xyz"} | {"red": np.zeros(4)}, "plain point cloud"),
        ({"packed_position": columns["x"], "x": columns["x"]}, "plain point cloud"),
        (
            {name: v for name, v in columns.items() if name not in ("scale_1", "opacity")},
            "lacks opacity, scale_1, which",
        ),
        ({name: v for name, v in columns.items() if name[:4] != "f_dc"}, "lacks f_dc_0, f_dc_1, f_dc_2, which"),
        ({name: values for name, values in columns.items() if name != "f_rest_8"}, "not those of a degree"),
        ({("f_rest_70" if name == "f_rest_3" else name): v for name, v in columns.items()}, "not those of a degree"),
        ({name: values[:0] for name, values in columns.items()}, "holds no splats"),
    ]
    for given, sentence in cases:
        write_with_plyfile(path, given)
        with pytest.raises(InputError, match=sentence):
            read_ply(path)
    path.write_bytes(b"\x1f\x8b\x08\x00 an spz of version 3 is gzip")
    with pytest.raises(InputError, match="compressed splat file"):
        read_ply(path)


@pytest.mark.parametrize("read", [read_ply, find_format, load_scene, read_camera_file])
@pytest.mark.parametrize("name", ["a.splat", "a.KSPLAT", "a.sog", "a.psx", "a.PSZ"])
def test_files_to_convert_first_are_named_with_the_way(tmp_path, name, read):
    (tmp_path / name).write_bytes(b"PK")
    way = "Export Cameras there, as Agisoft XML" if "PS" in name.upper()[2:4] else f"`splat-transform {name} a.ply`"
    with pytest.raises(InputError, match=rf"{name} is a .*{way}"):
        read(tmp_path / name)
    if "XML" in way and read in (load_scene, read_camera_file):
        with pytest.raises(InputError, match=rf"{name} is a project"):
            read(tmp_path)


def test_hostile_ply_headers(tmp_path):
    path = tmp_path / "i.ply"
    write_ply(path, some_splats(3, 0))
    binary = path.read_bytes()
    write_with_plyfile(path, ply_columns(some_splats(3, 0)), text=True)
    for data in (binary, path.read_bytes()):
        cases = [
            (b"vertex 3", b"vertex 99999999999999999", "cut off"),
            (b"vertex 3", b"vertex 4", "cut off"),
            (b"vertex 3", b"vertex -3", "header"),
            (b"vertex 3", b"vertex many", "header"),
            (b"property float x", b"property quad x", "header"),
            (b"property float x", b"property list uchar int x", "a list"),
            (b"end_header", b"property float x\nend_header", "twice"),
            (b"element vertex", b"element face 2\nproperty list uchar int i\nelement vertex", "list|numbers|cut off"),
            (b"1.0\n", b"1.0\nproperty float lost\n", "header"),
            (b"end_header\n", b"", "cut off|header"),
        ]
        for old, new, sentence in cases:
            path.write_bytes(data.replace(old, new, 1))
            with pytest.raises(InputError, match=sentence):
                read_ply(path)


def test_damaged_text_is_refused(tmp_path):
    path = tmp_path / "j.ply"
    write_with_plyfile(path, ply_columns(some_splats(3, 0)), text=True)
    lines = path.read_text().splitlines()
    for last in ("what is this", lines[-1] + " 7", lines[-1].rsplit(" ", 1)[0]):
        path.write_text("\n".join([*lines[:-1], last]))
        with pytest.raises(InputError, match="not the numbers"):
            read_ply(path)


def test_extras_that_a_ply_cannot_hold(tmp_path):
    for name in ("x", "two words", "f_rest_0", ""):
        splats = some_splats(3, 1)
        splats.extras[name] = np.zeros(3, np.float32)
        with pytest.raises(InputError, match="rename"):
            write_ply(tmp_path / "k.ply", splats)
    splats.extras = {"big": np.array([1, 2, 2**40])}
    with pytest.raises(InputError, match="large integers"):
        write_ply(tmp_path / "k.ply", splats)
    splats.extras = {"chosen": np.array([True, False, True]), "small": np.array([1, 2, -3])}
    write_ply(tmp_path / "k.ply", splats)
    read = read_ply(tmp_path / "k.ply").extras
    assert read["chosen"].dtype == np.uint8 and read["chosen"].tolist() == [1, 0, 1]
    assert read["small"].dtype == np.int32 and read["small"].tolist() == [1, 2, -3]


# ------------------------------------------------------------------------------------------------ GLB


def glb_parts(path):
    data = path.read_bytes()
    magic, version, total, length, kind = struct.unpack("<4s4I", data[:20].replace(b"JSON", struct.pack("<I", 0)))
    assert (magic, version, total, kind) == (b"glTF", 2, len(data), 0) and length % 4 == 0
    size, kind = struct.unpack("<I4s", data[20 + length : 28 + length])
    assert kind == b"BIN\0" and size % 4 == 0 and 28 + length + size == len(data)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def save_glb(path, document, binary):
    text = json.dumps(document).encode() if isinstance(document, dict) else document
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(binary), len(text), b"JSON")
    path.write_bytes(head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary)


class GlbBuilder:
    """Another writer: interleaves, quantises and nests as it likes."""

    def __init__(self):
        self.binary = b""
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "accessors": [],
            "bufferViews": [],
            "nodes": [],
            "meshes": [],
        }

    def accessor(self, array, component, normalized=False, stride=None):
        width = array.dtype.itemsize * array.shape[1]
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(array) * (stride or width)}
        rows = np.zeros((len(array), stride or width), np.uint8)
        rows[:, :width] = np.ascontiguousarray(array).view(np.uint8)
        self.binary += rows.tobytes() + b"\0" * (-rows.size % 4)
        accessor = {"bufferView": len(self.document["bufferViews"]), "componentType": component, "count": len(array)}
        accessor |= {"type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[array.shape[1]], "normalized": normalized}
        self.document["bufferViews"].append(view | ({"byteStride": stride} if stride else {}))
        self.document["accessors"].append(accessor)
        return len(self.document["accessors"]) - 1

    def primitive(self, splats, rotations=None, scales=None, **settings):
        attributes = {
            "POSITION": self.accessor(splats.positions, 5126, stride=20),
            f"{EXTENSION}:ROTATION": rotations or self.accessor(np.roll(splats.rotations, -1, axis=1), 5126),
            f"{EXTENSION}:SCALE": scales or self.accessor(splats.scales, 5126),
            f"{EXTENSION}:OPACITY": self.accessor(splats.opacities[:, None], 5126),
        }
        names = [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{i}" for d in range(splats.degree + 1) for i in range(2 * d + 1)]
        attributes |= {name: self.accessor(splats.sh[:, i], 5126) for i, name in enumerate(names)}
        return {"mode": 0, "attributes": attributes, "extensions": {EXTENSION: {"kernel": "ellipse"} | settings}}

    def save(self, path):
        self.document["buffers"] = [{"byteLength": len(self.binary)}]
        save_glb(path, self.document, self.binary)


def test_glb_is_laid_out_as_the_extension_says(tmp_path):
    splats = some_splats(5, 1, extras=True)
    splats.sh[0, 0] = (-5, 0, 5)
    write_glb(tmp_path / "reef.glb", splats)
    document, binary = glb_parts(tmp_path / "reef.glb")
    assert document["extensionsUsed"] == [EXTENSION] and "extensionsRequired" not in document
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"] == {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}

    def attribute(name):
        accessor = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0 and view.get("byteStride", 4) % 4 == 0
        code = {5122: "<i2", 5123: "<u2", 5126: "<f4"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        step = view.get("byteStride", width * np.dtype(code).itemsize)
        rows = np.frombuffer(binary, np.uint8, step * 5, view["byteOffset"]).reshape(5, step)
        return np.ascontiguousarray(rows[:, : width * np.dtype(code).itemsize]).view(code), accessor

    np.testing.assert_array_equal(attribute("POSITION")[0], splats.positions)
    assert attribute("POSITION")[1]["min"] == splats.positions.min(axis=0).tolist()
    assert attribute("POSITION")[1]["max"] == splats.positions.max(axis=0).tolist()
    np.testing.assert_array_equal(attribute(f"{EXTENSION}:ROTATION")[0], splats.rotations[:, [1, 2, 3, 0]])
    np.testing.assert_array_equal(attribute(f"{EXTENSION}:SCALE")[0], splats.scales)
    np.testing.assert_array_equal(attribute(f"{EXTENSION}:OPACITY")[0][:, 0], splats.opacities)
    np.testing.assert_array_equal(attribute(f"{EXTENSION}:SH_DEGREE_0_COEF_0")[0], splats.sh[:, 0])
    np.testing.assert_array_equal(attribute(f"{EXTENSION}:SH_DEGREE_1_COEF_2")[0], splats.sh[:, 3])
    color, accessor = attribute("COLOR_0")
    assert accessor["normalized"] is True
    np.testing.assert_allclose(color[0] / 65535, [0, 0.21404, 1, splats.opacities[0]], atol=2e-5)  # .5 in sRGB
    labels, accessor = attribute("_LABEL")
    assert accessor["componentType"] == 5122 and "normalized" not in accessor
    np.testing.assert_array_equal(labels[:, 0], splats.extras["label"])
    assert attribute("_INSTANCE")[1]["componentType"] == 5123
    assert attribute("_SIMILARITY")[1]["componentType"] == 5126


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, 1), (0, 1, 0), (0.1, -0.9, 0.3), (-2, 0.5, 1), (1, 0, 0)])
def test_the_node_turns_up_to_y(tmp_path, up):
    splats = some_splats(10)
    direction = np.array(up) / np.linalg.norm(up)
    splats.positions[1] = splats.positions[0] + direction
    write_glb(tmp_path / "a.glb", splats, up)
    seen = read_glb(tmp_path / "a.glb", up=(0, 1, 0))  # as glTF says it
    np.testing.assert_allclose(seen.positions[1] - seen.positions[0], [0, 1, 0], atol=1e-6)
    assert_equal(read_glb(tmp_path / "a.glb", up), splats)


def test_colmap_and_blender_turn_as_viewers_expect(tmp_path):
    splats = some_splats(2)
    x, y, z = splats.positions.T
    write_glb(tmp_path / "a.glb", splats)  # a COLMAP camera looks along z, a glTF camera against it
    np.testing.assert_array_equal(read_glb(tmp_path / "a.glb", (0, 1, 0)).positions.T, [x, -y, -z])
    write_glb(tmp_path / "a.glb", splats, (0, 0, 1))
    np.testing.assert_array_equal(read_glb(tmp_path / "a.glb", (0, 1, 0)).positions.T, [x, z, -y])


def test_nested_nodes_and_several_sets(tmp_path):
    first, second = some_splats(4, 1), some_splats(3, 0)
    builder = GlbBuilder()
    mesh = {"mode": 0, "attributes": {"POSITION": 0}}  # an ordinary point cloud beside
    builder.document["meshes"] = [
        {"primitives": [builder.primitive(first), mesh]},
        {"primitives": [builder.primitive(second)]},
    ]
    moved = np.diag([2.0, 2.0, 2.0, 1.0])
    moved[:3, 3] = (1, 2, 3)
    builder.document["nodes"] = [
        {"children": [1, 2], "rotation": [0, 0, 0.5**0.5, 0.5**0.5], "translation": [0, 0, 1]},
        {"mesh": 0, "matrix": moved.T.ravel().tolist()},
        {"mesh": 1, "scale": [1, 3, 1]},
    ]
    builder.save(tmp_path / "a.glb")
    read = read_glb(tmp_path / "a.glb", (0, 1, 0))
    turned = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]])
    expected = transformed(first, turned @ moved)
    np.testing.assert_allclose(read.positions[:4], expected.positions, atol=1e-6)
    np.testing.assert_allclose(covariances(read)[:4], covariances(expected), rtol=1e-4, atol=1e-10)
    np.testing.assert_allclose(read.sh[:4], expected.sh, atol=1e-6)
    expected = transformed(second, turned @ np.diag([1, 3, 1, 1]))
    np.testing.assert_allclose(read.positions[4:], expected.positions, atol=1e-6)
    np.testing.assert_allclose(covariances(read)[4:], covariances(expected), rtol=1e-4, atol=1e-10)
    assert not read.sh[4:, 1:].any()


def test_quantised_attributes_and_draft_log_scales(tmp_path):
    splats = some_splats(30, 0)
    builder = GlbBuilder()
    builder.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    quantised = np.round(splats.rotations[:, [1, 2, 3, 0]] * 32767).astype("<i2")
    builder.accessor(splats.positions, 5126)
    primitive = builder.primitive(
        splats,
        rotations=builder.accessor(quantised, 5122, normalized=True),
        scales=builder.accessor(np.log(splats.scales), 5126),
    )
    builder.document["meshes"], builder.document["nodes"] = [{"primitives": [primitive]}], [{"mesh": 0}]
    builder.save(tmp_path / "a.glb")
    read = read_glb(tmp_path / "a.glb", (0, 1, 0))
    np.testing.assert_allclose(read.rotations, splats.rotations, atol=1e-4)
    np.testing.assert_allclose(read.scales, splats.scales, rtol=1e-5)


def test_hostile_glb(tmp_path):
    path = tmp_path / "a.glb"
    write_glb(path, some_splats(3, 1, extras=True))
    document, binary = glb_parts(path)

    def changed(where, value):
        copy = json.loads(json.dumps(document))
        place = copy
        for key in where[:-1]:
            place = place[key]
        place[where[-1]] = value
        return copy

    uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    extension = ("meshes", 0, "primitives", 0, "extensions")
    cases = [
        (changed(("accessors", 0, "count"), 10**15), "damaged"),
        (changed(("accessors", 0, "count"), -1), "damaged"),
        (changed(("accessors", 0, "count"), 4), "damaged"),
        (changed(("accessors", 0, "componentType"), 7), "damaged"),
        (changed(("accessors", 0, "bufferView"), 99), "damaged"),
        (changed(("accessors", 0, "sparse"), {}), "damaged"),
        (changed(("bufferViews", 2, "byteOffset"), -4), "damaged"),
        (changed(("bufferViews", 2, "byteStride"), 1), "damaged"),
        (changed(("nodes", 0, "children"), [0]), "damaged"),
        (changed(("nodes", 0, "rotation"), "round"), "damaged"),
        (changed(("nodes", 0, "scale"), [float("nan"), 1, 1]), "damaged"),
        (changed(("scene",), 5), "damaged"),
        (changed(("nodes",), [{"mesh": 0}] * 1000) | {"scenes": [{"nodes": list(range(1000))}]}, "damaged"),
        (changed(("buffers", 0, "uri"), "../../etc/passwd"), "other files"),
        (changed(("buffers", 0, "uri"), uri), "other files"),
        (changed(("extensionsRequired",), ["EXT_meshopt_compression"]), "EXT_meshopt_compression"),
        (changed((*extension, EXTENSION, "extensions"), {"KHR_gaussian_splatting_compression_spz_2": {}}), "_spz_2"),
        (changed(extension, {}), "no Gaussian splats"),
        (changed(("nodes", 0), {}), "no Gaussian splats"),
        (b"[" * 200_000 + b"]" * 200_000, "damaged"),
        (b"[]", "damaged"),
        (b"\xff\xfe", "damaged"),
    ]
    for document_or_bytes, sentence in cases:
        save_glb(path, document_or_bytes, binary)
        with pytest.raises(InputError, match=sentence):
            read_glb(path)
    save_glb(path, document, binary)
    path.write_bytes(path.read_bytes().replace(b"glTF\x02", b"glTF\x01", 1))
    with pytest.raises(InputError, match="version 1"):
        read_glb(path)


def test_extras_that_a_glb_cannot_hold(tmp_path):
    splats = some_splats(3, 0)
    splats.extras = {"a": np.zeros(3), "A": np.zeros(3)}
    with pytest.raises(InputError, match="differ only in case"):
        write_glb(tmp_path / "a.glb", splats)
    splats.extras = {"id": np.array([0, 1, 2**30])}
    with pytest.raises(InputError, match="large integers"):
        write_glb(tmp_path / "a.glb", splats)
    splats.extras = {"id": np.array([0, -1, 70_000]), "chosen": np.array([True, False, True])}
    write_glb(tmp_path / "a.glb", splats)
    assert read_glb(tmp_path / "a.glb").extras["id"].tolist() == [0, -1, 70_000]
    assert read_glb(tmp_path / "a.glb").extras["chosen"].tolist() == [1, 0, 1]
    splats.positions[0, 0] = np.nan
    with pytest.raises(InputError, match="not finite"):
        write_glb(tmp_path / "a.glb", splats)
    with pytest.raises(ValueError, match="direction"):
        read_glb(tmp_path / "a.glb", up=(0, 0, 0))
