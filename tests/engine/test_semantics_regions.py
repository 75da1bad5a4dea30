"""Regions of a scene's photographs: the user's masks, saliency, the cache, and their labels."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from swag_engine.base.errors import InputError
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import Scene, load_scene
from swag_engine.scene.images import TrainingImage, load_images
from swag_engine.semantics.describe_labels import Description, describe_labels, unique_names
from swag_engine.semantics.embed import Descriptor, Projection
from swag_engine.semantics.masks import MaskFolder
from swag_engine.semantics.regions import Region, SceneRegions, find_regions, flatten_regions
from swag_engine.semantics.saliency import OPEN_WATER, Saliency, border_contrast
from swag_engine.splats.splats import Splats
from swag_engine.splats.transform import C0

ROOT = Path(__file__).resolve().parents[2]
REEF = ROOT / "tests" / "scenes" / "reef_wreck"
shared = ROOT.parent / "shared"
needs_data = pytest.mark.skipif(not (shared / "data").is_dir(), reason="the shared example photographs are not here")


def photograph(name: str = "a.jpg", height: int = 40, width: int = 60, seed: int = 0) -> TrainingImage:
    pixels = np.random.default_rng(seed).integers(0, 255, (height, width, 3)).astype(np.uint8)
    camera = Camera(name, width, height, 50.0, 50.0, width / 2, height / 2, np.eye(4))
    return TrainingImage(camera, pixels, np.ones((height, width), bool))


def box(image: TrainingImage, left: int, top: int, right: int, bottom: int) -> np.ndarray:
    mask = np.zeros(image.valid.shape, bool)
    mask[top:bottom, left:right] = True
    return mask


class Boxes:
    """Gives the same regions for every photograph, and counts how often it is asked."""

    name = "Boxes"

    def __init__(self, *regions: tuple[str, tuple[int, int, int, int]]) -> None:
        self.given, self.key, self.asked = regions, f"boxes:{regions}", 0
        self.words: list[tuple[str, ...]] = [()]

    def regions(self, image: TrainingImage, words: Sequence[str]) -> list[Region]:
        self.asked += 1
        self.words.append(tuple(words))
        return [Region(box(image, *corners), name) for name, corners in self.given]


# Regions under labels -------------------------------------------------------------------------------------------------


def test_where_masks_overlap_the_first_counts() -> None:
    image = photograph()
    image.valid[:, :5] = False
    regions = [("coral", (0, 0, 30, 40)), ("wreck", (20, 0, 60, 20)), ("coral", (50, 0, 60, 40)), ("dot", (0, 0, 3, 3))]
    index, names = flatten_regions([Region(box(image, *corners), name) for name, corners in regions], image)
    assert names == ("coral", "wreck")  # the dot is hidden, and too small
    assert (index[:, :5] == 0).all() and (index[:, 5:30] == 1).all() and (index[:20, 30:] == 2).all()
    assert (index[20:, 50:] == 1).all() and (index[20:, 30:50] == 0).all()
    with pytest.raises(InputError, match="The mask of coral is 60 x 30 and not 60 x 40"):
        flatten_regions([Region(np.ones((30, 60), bool), "coral")], image)


def test_labels_come_in_the_order_of_the_words_then_by_size() -> None:
    images = [photograph(f"{k}.jpg", seed=k) for k in range(2)]
    provider = Boxes(("wreck", (0, 0, 60, 20)), ("coral", (0, 20, 60, 30)), ("fish", (0, 30, 30, 40)))
    found = find_regions(images, provider, Descriptor())
    assert found.labels == ("wreck", "coral", "fish")
    assert np.allclose(found.pixel_fractions(), [0.125, 0.5, 0.25, 0.125])
    asked = find_regions(images, provider, Descriptor(), ["fish", "eel"])
    assert asked.labels == ("fish", "wreck", "coral") and provider.words[-1] == ("fish", "eel")
    assert asked.notes == ("Nothing was found for eel.",)
    for name in ("0.jpg", "1.jpg"):
        assert asked.maps[name][0, 0] == 2 and asked.maps[name][39, 0] == 1 and asked.maps[name][39, 59] == 0
        assert sorted(asked.features[name]) == [1, 2, 3]
    assert np.allclose(np.linalg.norm(asked.prototypes, axis=1), 1, atol=1e-5)


def test_regions_without_names_are_put_together_by_looks_and_called_by_color() -> None:
    images = []
    for k in range(4):
        image = photograph(f"{k}.jpg")
        noise = np.random.default_rng(k).integers(-9, 9, (40, 60, 3))
        image.pixels[:] = np.clip(np.array([40, 60, 160]) + noise, 0, 255)
        image.pixels[:20] = np.clip(np.array([235, 130, 30]) + noise[:20], 0, 255)
        images.append(image)
    found = find_regions(images, Boxes(("", (0, 0, 60, 20)), ("", (0, 20, 60, 40))), Descriptor())
    assert {name.rstrip(" 0123456789") for name in found.labels} == {"orange", "blue"}
    tops = {int(found.maps[image.camera.name][0, 0]) for image in images}
    bottoms = {int(found.maps[image.camera.name][39, 0]) for image in images}
    assert not tops & bottoms


def test_captions_say_what_to_look_for_where_no_word_does() -> None:
    class Caption:
        name = key = "caption"

        def captions(self, pixels: np.ndarray) -> list[str]:
            return ["a fish over a reef with sand and kelp"]

    provider = Boxes(("fish", (0, 0, 30, 30)))
    find_regions([photograph()], provider, Descriptor(), captioner=Caption())
    assert provider.words[-1] == ("fish", "reef", "sand")
    find_regions([photograph()], provider, Descriptor(), ["eel"], Caption())
    assert provider.words[-1] == ("eel",)


def test_found_regions_are_kept_until_photograph_provider_or_words_change(tmp_path: Path) -> None:
    images = [photograph(f"{k}.jpg", seed=k) for k in range(3)]
    provider = Boxes(("coral", (0, 0, 30, 30)))
    first = find_regions(images, provider, Descriptor(), cache=tmp_path)
    again = find_regions(images, provider, Descriptor(), cache=tmp_path)
    assert provider.asked == 3
    assert np.array_equal(first.maps["1.jpg"], again.maps["1.jpg"]) and again.labels == ("coral",)
    assert np.array_equal(first.features["1.jpg"][1], again.features["1.jpg"][1])
    images[0].pixels[0, 0] ^= 1
    find_regions(images, provider, Descriptor(), cache=tmp_path)
    assert provider.asked == 4
    find_regions(images, provider, Descriptor(), ["coral"], cache=tmp_path)
    assert provider.asked == 7
    provider.key = "other weights"
    find_regions(images, provider, Descriptor(), cache=tmp_path)
    assert provider.asked == 10
    for path in tmp_path.iterdir():
        path.write_bytes(path.read_bytes()[:100])
    find_regions(images, provider, Descriptor(), cache=tmp_path)
    assert provider.asked == 13


def test_what_cannot_be_used_is_said_in_one_sentence() -> None:
    images = [photograph("a.jpg"), photograph("b.jpg")]

    class Nan(Descriptor):
        name = "broken"

        def image(self, pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
            return np.full(40, np.nan, np.float32)

    with pytest.raises(InputError, match="Boxes found no region of coral, eel in any of the 2 images"):
        find_regions(images, Boxes(), Descriptor(), ["coral", "eel"])
    for words in ([""], ["coral", "  "], ["..."]):
        with pytest.raises(InputError, match="One of the words to look for is empty"):
            find_regions(images, Boxes(), Descriptor(), words)
    with pytest.raises(InputError, match=r"embedding broken made numbers that are not finite.*\(image a.jpg\)"):
        find_regions(images, Boxes(("coral", (0, 0, 30, 30))), Nan())


def test_one_region_over_everything_is_used_and_remarked_on() -> None:
    images = [photograph(f"{k}.jpg", seed=k) for k in range(2)]
    found = find_regions(images, Boxes(("reef", (0, 0, 60, 40))), Descriptor())
    assert found.labels == ("reef",) and all((labels == 1).all() for labels in found.maps.values())
    assert found.notes == ("In every image one region covers all pixels, so the labels distinguish nothing.",)


def test_three_hundred_labels_are_kept_apart() -> None:
    image = photograph("a.jpg", 200, 300)
    cells = [(f"thing {r * 20 + c}", (c * 15, r * 13, c * 15 + 15, r * 13 + 13)) for r in range(15) for c in range(20)]
    found = find_regions([image], Boxes(*cells), Descriptor())
    assert len(found.labels) == 300 and found.maps["a.jpg"].max() == 300
    assert found.labels[found.maps["a.jpg"][13 * 14, 15 * 19] - 1] == "thing 299"


# The user's masks -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reef() -> Scene:
    return load_scene(REEF)


@pytest.fixture(scope="module")
def reef_image(reef: Scene) -> TrainingImage:
    return load_images(reef, [reef.views[1]], 320)[0]


def write_mask(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), values)


@pytest.mark.parametrize("white", [1, 255, 65535])
def test_masks_in_a_folder_a_class(tmp_path: Path, reef: Scene, reef_image: TrainingImage, white: int) -> None:
    kind = np.uint16 if white > 255 else np.uint8
    for name, rows in (("coral", slice(0, 90)), ("wreck", slice(180, 360))):
        drawn = np.zeros((360, 640), kind)
        drawn[rows, 320:] = white
        suffix = ".png" if name == "coral" else ".jpg.png"
        write_mask(tmp_path / name / f"reef_001{suffix}", drawn)
    regions = MaskFolder(tmp_path, reef).regions(reef_image, [])
    assert [region.label for region in regions] == ["coral", "wreck"]
    assert regions[0].mask[:45, 160:].all() and regions[0].mask.sum() == 45 * 160
    assert regions[1].mask[90:, 160:].all() and regions[1].mask.sum() == 90 * 160
    assert [region.label for region in MaskFolder(tmp_path, reef).regions(reef_image, ["wreck"])] == ["wreck"]


def test_masks_as_numbers_of_names(tmp_path: Path, reef: Scene, reef_image: TrainingImage) -> None:
    drawn = np.zeros((180, 320), np.uint16)
    drawn[:50], drawn[100:] = 2, 300
    (tmp_path / "labels.txt").write_text("\n".join(f"thing {k}" for k in range(1, 301)))
    write_mask(tmp_path / "reef_001.png", drawn)
    regions = MaskFolder(tmp_path, reef).regions(reef_image, [])
    assert [region.label for region in regions] == ["thing 2", "thing 300"]
    assert regions[0].mask[:50].all() and regions[0].mask.sum() == 50 * 320
    (tmp_path / "labels.txt").write_text("one\ntwo\n")
    with pytest.raises(InputError, match="reef_001.png has the value 300, and labels.txt has only 2 labels"):
        MaskFolder(tmp_path, reef).regions(reef_image, [])
    (tmp_path / "labels.txt").write_text("one\none\n")
    with pytest.raises(InputError, match="labels.txt must have one label a line, each once"):
        MaskFolder(tmp_path, reef)


@needs_data
def test_masks_are_freed_of_the_lens_as_the_photograph_is() -> None:
    scene = load_scene(shared / "data" / "aqualoc_amphorae")
    assert not scene.views[0].lens.is_pinhole
    image = load_images(scene, scene.views[:1], 484)[0]
    pixels = cv2.imread(str(scene.views[0].path), cv2.IMREAD_GRAYSCALE)
    smooth = cv2.GaussianBlur(pixels, (0, 0), 6)
    seen = MaskFolder._undistorted(scene.views[0], smooth, image)
    shown = cv2.GaussianBlur(cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY), (0, 0), 3)
    assert seen.shape == shown.shape
    assert np.abs(seen.astype(float) - shown)[image.valid].mean() < 1.5
    undistorted_wrongly = cv2.resize(smooth, shown.shape[::-1])
    assert np.abs(undistorted_wrongly.astype(float) - shown)[image.valid].mean() > 3


def test_masks_that_do_not_fit_are_named(tmp_path: Path, reef: Scene, reef_image: TrainingImage) -> None:
    with pytest.raises(InputError, match="There is no folder .*absent"):
        MaskFolder(tmp_path / "absent", reef)
    with pytest.raises(InputError, match="holds no masks: put them in one folder a label"):
        MaskFolder(tmp_path, reef)
    write_mask(tmp_path / "coral" / "another.png", np.zeros((10, 10), np.uint8))
    with pytest.raises(InputError, match="No mask in .* belongs to an image of the scene.*reef_000.png"):
        MaskFolder(tmp_path, reef)
    mask = tmp_path / "coral" / "reef_001.png"
    for values, message in (
        (np.zeros((100, 100), np.uint8), "reef_001.png is 100 x 100 pixels, .* 640 x 360: make it from the image"),
        (np.full((360, 640, 3), (0, 0, 255), np.uint8), "reef_001.png is a mask in color"),
    ):
        write_mask(mask, values)
        with pytest.raises(InputError, match=message):
            MaskFolder(tmp_path, reef).regions(reef_image, [])
    mask.write_bytes(b"no picture")
    with pytest.raises(InputError, match="reef_001.png cannot be read as an image"):
        MaskFolder(tmp_path, reef).regions(reef_image, [])


# Saliency -------------------------------------------------------------------------------------------------------------


def test_open_water_is_found_without_a_network(reef: Scene) -> None:
    masks = MaskFolder(REEF / "labels", reef)
    for image in load_images(reef, reef.views[::6], 320):
        truth = next(region.mask for region in masks.regions(image, []) if region.label == "open water")
        found = {region.label: region.mask for region in Saliency().regions(image, [])}[OPEN_WATER]
        assert (found & truth).sum() / (found | truth).sum() > 0.8


@needs_data
def test_open_water_is_found_in_real_photographs() -> None:
    scores = []
    for path in sorted((shared / "data" / "suim" / "images").iterdir()):
        pixels = cv2.imread(str(path))[..., ::-1].copy()
        truth = cv2.imread(str(path.parents[1] / "masks" / f"{path.stem}.png")).max(-1) == 0
        image = TrainingImage(photograph().camera, pixels, np.ones(pixels.shape[:2], bool))
        found = Saliency().regions(image, [])[0].mask
        truth = cv2.resize(truth.astype(np.uint8), pixels.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
        scores.append((found & truth).sum() / max(1, (found | truth).sum()))
    print([round(score, 2) for score in scores])
    assert np.median(scores) > 0.7


def test_saliency_knows_no_words_and_takes_any_picture() -> None:
    with pytest.raises(InputError, match="saliency cannot look for words"):
        Saliency().regions(photograph(), ["coral"])
    for height, width in ((1, 1), (3, 200), (50, 7), (40, 60)):
        for value in (0, 128, 255):
            image = photograph(height=height, width=width)
            image.pixels[:] = value
            regions = Saliency().regions(image, [])
            assert np.sum([region.mask for region in regions], axis=0).max() == 1


def test_contrast_is_the_mean_difference_from_the_most_similar_quarter_of_the_border() -> None:
    lightness = np.array([50, 10, 40, 90, 30, 20, 80, 70, 60, 0, 11, 13])  # of the border: its quarter is 3 superpixels
    border = np.stack([lightness, 0 * lightness, 0 * lightness], 1).astype(float)
    colors = np.array([[10.0, 0, 0], [100, 0, 0], [20, 4, 3]])
    expected = [(0 + 1 + 3) / 3, (10 + 20 + 30) / 3, (5 + np.hypot(7, 5) + np.hypot(9, 5)) / 3]
    np.testing.assert_allclose(border_contrast(colors, border), expected)
    np.testing.assert_allclose(border_contrast(colors[:1], border[:1]), [40])  # at least one


def test_labels_without_a_name_get_the_color_without_water_and_a_place():
    """Three regions that the photos show black: one splat each, brown, brown and white without the water."""
    index = np.zeros((20, 20), np.uint16)
    index[:6, :6], index[14:, 14:], index[8:12, 8:12], index[:4, 16:] = 1, 2, 3, 4
    labels = ("black", "black 2", "black 3", "coral")
    regions = SceneRegions(
        labels, {"a.jpg": index}, {}, np.zeros((4, 1)), Projection.fit(np.eye(4)), (), frozenset(labels[:3])
    )
    colors = np.array([(110, 70, 40), (110, 70, 40), (240, 240, 240), (20, 20, 20)]) / 255
    splats = Splats(
        np.zeros((4, 3), "f4"), np.tile(np.array([1, 0, 0, 0], "f4"), (4, 1)), np.ones((4, 3), "f4"),
        np.ones(4, "f4"), ((colors - 0.5) / C0)[:, None].astype("f4"),
    )  # fmt: skip
    named = describe_labels(regions, splats, np.arange(1, 5))
    assert named.labels == ("brown, top left", "brown, bottom right", "white", "coral")
    reds = [Description("red", light, place) for light, place in ((50, "top"), (52, "top"), (48, "left"), (30, "left"))]
    assert unique_names([*reds, Description("red", 70, "top")], {"red, left"}) == [
        "red, top", "red, top (2)", "red, left (2)", "dark red", "light red",
    ]  # fmt: skip
