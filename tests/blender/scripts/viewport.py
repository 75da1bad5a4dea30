"""What the viewport's drawing computes without a window: texels, order, and which textures a change reaches."""

import types

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import display, labels, splats
from bl_ext.user_default.swag_splatting.swag_blender.viewport import depth_order, packing, splat_store
from bl_ext.user_default.swag_splatting.swag_blender.water_values import WaterValues
from mathutils import Matrix, Quaternion
from pictures import random_splats

scene = bpy.context.scene


def texels():
    """Texels against float64 by other formulas."""
    made = random_splats(200, 16)
    found = packing.geometry_texels(made)
    assert found.shape == (200, 3, 4) and np.array_equal(found[:, 0, :3], made.positions)
    assert np.array_equal(found[:, 0, 3], made.opacities) and not found[:, 2, 3].any()
    made.extras["haze"] = np.linspace(0, 0.9, 200, dtype="f4")
    assert np.array_equal(packing.geometry_texels(made)[:, 2, 3], made.extras["haze"])
    for texel, quaternion, sigmas in zip(found[:20], made.rotations[:20], made.scales[:20], strict=True):
        w, x, y, z = quaternion.astype(np.float64)
        turned = np.array(Quaternion((w, x, y, z)).to_matrix(), np.float64) * sigmas.astype(np.float64)
        wanted = turned @ turned.T
        got = [*texel[1], *texel[2, :2]]
        assert np.allclose(got, wanted[np.triu_indices(3)], rtol=1e-5, atol=1e-9), (got, wanted)
        assert np.isclose(texel[2, 2], np.linalg.eigvalsh(wanted)[0], rtol=1e-4, atol=1e-9)
    for degree, per_splat in enumerate(packing.HARMONICS_TEXELS):
        packed = packing.harmonics_texels(made.sh, degree).reshape(200, -1)
        coefficients = (degree + 1) ** 2
        assert packed.shape[1] == per_splat * 4
        assert np.array_equal(packed[:, : coefficients * 3], made.sh[:, :coefficients].reshape(200, -1))
        assert not packed[:, coefficients * 3 :].any()
    hidden = np.zeros(200, bool)
    hidden[3] = True
    tint = np.ones((200, 4), "f4")
    states = packing.state_texels(hidden, tint, 200)
    assert states[3, 3] == packing.HIDDEN_ALPHA and (np.delete(states[:, 3], 3) < packing.HIDDEN_ALPHA).all()
    # Textures that are too small: fewer harmonics first.
    assert packing.fitting_degree(1000, 3, 100, 120) == 3 and packing.fitting_degree(1000, 3, 100, 100) == 2
    assert packing.fitting_degree(1000, 3, 100, 30) == 1 and packing.fitting_degree(1000, 3, 100, 20) == 0


def object_texels():
    """The eye and the water of an object, in its own space."""
    to_view = np.array(Matrix.Translation((1, 2, 3)) @ Matrix.Rotation(0.7, 4, "X") @ Matrix.Diagonal((2, 2, 2, 1)))
    water = WaterValues((0.1, 0.2, 0.3), (0.4, 0.5, 0.6), tuple((i, 0.0, 0.0) for i in range(9)), True)
    rows = packing.ObjectTexels(to_view, water=water, water_amount=0.5).texels()
    assert rows.shape == (packing.OBJECT_TEXELS, 4)
    assert np.allclose(rows[:3] @ np.append(rows[3, :3], 1), 0, atol=1e-6), "the eye is the view's origin"
    assert np.allclose(rows[6], (0.1, 0.2, 0.3, 0.5)) and np.allclose(rows[7], (0.4, 0.5, 0.6, 1))
    assert np.array_equal(rows[8:17, 0], range(9))
    none = packing.ObjectTexels(to_view, water=water, water_amount=0.0, haze_amount=0.75, pixel_size=0.25).texels()
    assert none[4, 3] == 0.25 and none[5, 3] == 0.75
    assert not none[6:17].any()


def order():
    """Back to front over several objects, exact or to 16 bits, with a limit, and in views with parallel rays."""
    random = np.random.default_rng(0)
    parts, first = [], 0
    for count in (500, 300):
        parts.append(
            depth_order.Part(
                random.normal(size=(count, 3)).astype("f4") * 5, random.uniform(size=count).astype("f4"), first
            )
        )
        first += count
    rows = [np.array([0.2, -0.4, 0.9, 1.0]), np.array([0.7, 0.1, 0.7, 2.0])]
    depths = np.concatenate([p.positions.astype("f8") @ r[:3] + r[3] for p, r in zip(parts, rows, strict=True)])
    found = depth_order.back_to_front(parts, rows, near=0.01)
    assert np.array_equal(found[:, 1] == 1, found[:, 0] >= 500), "each splat names its part"
    found = found[:, 0].astype(int)
    assert len(found) == (depths > 0.01).sum() and (np.diff(depths[found]) <= 1e-5).all()
    coarse = depth_order.back_to_front(parts, rows, near=0.01, exact=False)[:, 0].astype(int)
    assert set(coarse) == set(found) and (np.diff(depths[coarse]) <= depths[coarse][1:] * 1e-3).all()
    everything = depth_order.back_to_front(parts, rows, near=None)[:, 0].astype(int)
    assert len(everything) == 800 and (np.diff(depths[everything]) <= 1e-5).all()
    few = depth_order.back_to_front(parts, rows, near=1.0, limit=50)[:, 0].astype(int)
    weights = np.concatenate([p.contributions for p in parts]) / depths**2
    before = np.flatnonzero(depths > 1)
    assert set(few) == set(before[np.argsort(-weights[before])[:50]])
    assert len(depth_order.back_to_front([], [], near=0.01)) == 0
    behind = [np.array([0, 0, 0, -1.0])] * 2
    assert len(depth_order.back_to_front(parts, behind, near=0.01)) == 0


def sorter():
    """A sort beside the interface: nothing until it is done, and the same key is not sorted twice."""
    count = depth_order.SYNCHRONOUS + 1
    part = depth_order.Part(np.random.default_rng(0).normal(size=(count, 3)).astype("f4"), np.ones(count, "f4"), 0)
    row, made = np.array([0, 0, 1, 10.0]), depth_order.Sorter()
    made.request("a", [part], [row], 0.01, None)
    assert made.is_sorting
    made.request("b", [part], [row], 0.01, None)  # waits for the end of the first
    while not made.is_done:
        pass
    assert len(made.take()) == count and made.taken == "a" and made.take() is None
    made.request("a", [part], [row], 0.01, None)
    assert not made.is_sorting
    made.request("b", [part], [row], 0.01, 10)
    while not made.is_done:
        pass
    assert len(made.take()) == 10 and made.taken == "b"


def uploads():
    """Only what changed goes to the graphics card, which is not there: uploads are noted."""
    sent = []
    splat_store.new_texture = lambda values, size, kind: sent.append(kind)
    card = types.SimpleNamespace(max_texture_size_get=lambda: 128)
    splat_store.gpu = types.SimpleNamespace(capabilities=card)  # type: ignore[assignment]
    store = splat_store.SplatStore()
    one = splats.new_splat_object("one", random_splats(300, 16), scene.collection)
    two = splats.new_splat_object("two", random_splats(200, 4), scene.collection)

    def update(*objects):
        sent.clear()
        bpy.context.view_layer.update()
        store.update(objects, bpy.context.evaluated_depsgraph_get())
        return list(sent)

    everything = ["RGBA32F", "RGBA16F", "RGBA8"]
    assert update(one, two) == everything and store.degree == 3 and store.notice == ""
    assert store.part(one).first == 0 and store.part(two).first == 300
    numbers = store.splats_version
    assert update(one, two) == []
    # A selection changes tints alone.
    labels.select(one, np.arange(300) < 10)
    assert update(one, two) == ["RGBA8"] and store.splats_version == numbers
    store.mark_stale(None)  # undo of something else
    assert update(one, two) == []
    # An object that moves changes no texture: its matrix is not in them.
    one.location = (1, 2, 3)
    store.mark_stale(one.session_uid)
    assert update(one, two) == []
    # As many splats as before, as at the end of a training, and without a word from Blender.
    splats.replace_splats(one, random_splats(300, 16, seed=6))
    assert update(one, two) == everything and update(one, two) == []
    splats.replace_splats(one, random_splats(250, 16, seed=5))
    assert update(one, two) == everything and store.part(two).first == 250 and store.splats_version == numbers + 2
    assert update(two) == everything and store.part(one) is None
    # 128 x 128 texels hold 1365 splats of degree 3 and 5461 splats at all.
    many = splats.new_splat_object("many", random_splats(3000, 16), scene.collection)
    update(many)
    assert store.degree == 1 and "SH degree 1 of 3" in store.notice
    splats.replace_splats(many, random_splats(6000, 4))
    update(many)
    assert len(store.part(many).positions) == 5461 and "5461 of 6000 splats" in store.notice


def settings():
    """The properties drive the nodes that renders and points use."""
    from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_colors, splat_preview

    obj = splats.new_splat_object("reef", random_splats(100, 16), scene.collection)
    own = display.display_of(obj)
    assert (own.style, own.density, own.sh_degree) == ("SPLATS", 100, 3)
    own.sh_degree = 1
    own.density = 50

    def read(name):
        owner, path, _ = splat_preview._input(obj, name)
        return owner.value if path == "value" else owner[path]

    assert read(splat_colors.SH_DEGREE) == 1 and read(splat_colors.DENSITY) == 50
