"""CLIP, Grounding DINO, SAM and BLIP: what goes into the networks and what is made of what comes out, on small graphs
with the inputs and outputs of the real ones; and their tokenizers, on the real vocabulary where it can be had."""

import gzip
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import onnx
import onnx.parser
import platformdirs
import pytest
from onnx import TensorProto, helper, numpy_helper

from swag_engine.base.errors import InputError
from swag_engine.scene.images import TrainingImage
from swag_engine.semantics.captions import Blip, phrases
from swag_engine.semantics.embed import CLIP_MEAN, CLIP_STD, Clip, Descriptor, Projection, color_name, crop_to_mask
from swag_engine.semantics.grounded_sam import Box, GroundedSam, GroundingDino, Sam, intersection_over_union
from swag_engine.semantics.tokenizer import BytePairTokenizer, WordPieceTokenizer

TOKENS = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", ".", "coral", "wreck", "anch", "##or", "the", "-", "a"]
MERGES = ["r e", "re d</w>", "b l", "u e</w>", "bl ue</w>", "p h"]


def write_graph(path: Path, graph: str) -> Path:
    onnx.save(onnx.parser.parse_model(f'<ir_version: 8, opset_import: ["": 17]> net {graph}'), path)
    return path


def write_nodes(path: Path, nodes: list, inputs: list, outputs: list, tables: dict[str, np.ndarray]) -> Path:
    """A graph with tables; inputs and outputs are (name, element type, shape)."""
    before, after = ([helper.make_tensor_value_info(*tensor) for tensor in side] for side in (inputs, outputs))
    stored = [numpy_helper.from_array(table, name) for name, table in tables.items()]
    graph = helper.make_graph(nodes, "net", before, after, stored)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return path


@pytest.fixture
def bert(tmp_path: Path) -> Path:
    path = tmp_path / "vocab.txt"
    path.write_text("\n".join(TOKENS) + "\n")
    return path


@pytest.fixture
def merges(tmp_path: Path) -> Path:
    path = tmp_path / "merges.txt.gz"
    with gzip.open(path, "wt", encoding="utf-8") as file:
        file.write("\n".join(["#version: 0.2", *MERGES]) + "\n")
    return path


# Tokenizers -----------------------------------------------------------------------------------------------------------


def test_byte_pairs_are_merged_in_the_order_of_the_file(merges: Path) -> None:
    tokenizer = BytePairTokenizer(merges)
    merged = {merge.replace(" ", ""): 512 + place for place, merge in enumerate(MERGES)}
    letter = {character: tokenizer.ids[character] for character in "bluero"}
    assert tokenizer.encode("Red  BLUE") == [merged["red</w>"], merged["blue</w>"]]
    assert tokenizer.encode("rere") == [merged["re"], letter["r"], tokenizer.ids["e</w>"]]
    assert tokenizer.padded("red", 5).tolist() == [518, merged["red</w>"], 519, 0, 0]
    assert tokenizer.padded("red " * 9, 5).tolist() == [518, *[merged["red</w>"]] * 3, 519]
    assert len(tokenizer.encode("é")) == 2  # its two bytes


@pytest.fixture(scope="session")
def clip_vocabulary() -> Path:
    """OpenAI's file (MIT), which the package open_clip_torch carries; kept in the user's cache."""
    cache = Path(platformdirs.user_cache_dir("swag_splatting", appauthor=False)) / "test-weights"
    path = cache / "bpe_simple_vocab_16e6.txt.gz"
    if not path.exists():
        cache.mkdir(parents=True, exist_ok=True)
        fetch = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "-d", str(cache), "open_clip_torch==3.3.0"]
        if subprocess.run(fetch, capture_output=True, timeout=120).returncode:
            pytest.skip("CLIP's vocabulary (pip package open_clip_torch 3.3.0) cannot be had here")
        wheel = next(cache.glob("open_clip_torch-3.3.0-*.whl"))
        with zipfile.ZipFile(wheel) as files:
            path.write_bytes(files.read("open_clip/bpe_simple_vocab_16e6.txt.gz"))
        wheel.unlink()
    return path


def test_clips_own_vocabulary_gives_its_published_tokens(clip_vocabulary: Path) -> None:
    tokenizer = BytePairTokenizer(clip_vocabulary)
    assert (tokenizer.start, tokenizer.end) == (49406, 49407)
    padded = tokenizer.padded("a photo of a cat", 77)  # the example of the CLIP page of transformers
    assert padded.tolist() == [49406, 320, 1125, 539, 320, 2368, 49407] + 70 * [0]
    assert tokenizer.encode("a diagram") == [320, 22697]
    assert tokenizer.encode("Hello World!") == [3306, 1002, 256]
    assert tokenizer.encode("it's  2&amp;3") == tokenizer.encode("it 's 2 & 3")


def test_word_pieces_are_the_longest_that_fit(bert: Path) -> None:
    tokenizer = WordPieceTokenizer(bert)
    assert tokenizer.encode("The Anchor-córal.") == [9, 7, 8, 10, 5, 4]
    assert tokenizer.encode("fish coral") == [1, 5]
    assert tokenizer.decode([9, 7, 8, 3, 6]) == "the anchor wreck"


def test_a_file_that_is_no_vocabulary_is_refused(tmp_path: Path, bert: Path) -> None:
    broken = tmp_path / "broken.gz"
    broken.write_bytes(b"\x1f\x8b\x08 no gzip")
    for load, path in ((BytePairTokenizer, broken), (BytePairTokenizer, bert), (WordPieceTokenizer, broken)):
        with pytest.raises(InputError, match=f"{path}.*get it again"):
            load(path)
    with pytest.raises(InputError, match="There is no file"):
        WordPieceTokenizer(tmp_path / "absent")


# CLIP -----------------------------------------------------------------------------------------------------------------


def clip(folder: Path, merges: Path, words: str = "int32[M,77] input") -> Clip:
    """Images are embedded as their mean color, texts as the sum of their tokens' places in a table of colors."""
    image = write_graph(
        folder / "image.onnx",
        "(float[1,3,224,224] input) => (float[1,3] output) { output = ReduceMean<axes=[2,3], keepdims=0>(input) }",
    )
    table = np.full((520, 3), 0.001, np.float32)
    table[513], table[516] = (1, 0, 0), (0, 0, 1)
    kind = TensorProto.INT32 if "int32" in words else TensorProto.INT64
    nodes = [
        helper.make_node("Gather", ["table", "ids"], ["rows"]),
        helper.make_node("ReduceSum", ["rows", "axis"], ["sums"], keepdims=0),
    ]
    text = write_nodes(
        folder / "text.onnx", nodes, [("ids", kind, ["M", 77])], [("sums", TensorProto.FLOAT, ["M", 3])],
        {"table": table, "axis": np.array([1])},
    )  # fmt: skip
    return Clip(image, text, merges)


@pytest.mark.parametrize("words", ["int32[M,77]", "int64[M,77]"])
def test_clip_sees_the_region_alone_and_reads_words(tmp_path: Path, merges: Path, words: str) -> None:
    network = clip(tmp_path, merges, words)
    pixels = np.zeros((30, 50, 3), np.uint8)
    mask = np.zeros((30, 50), bool)
    mask[5:25, 5:25] = True
    pixels[mask] = (255, 0, 0)
    pixels[~mask] = (0, 255, 0)
    # Beside the region is CLIP's mean, 0 once normalised; so the embedding has the direction of normalised red.
    red = (np.array([1, 0, 0]) - CLIP_MEAN) / CLIP_STD
    assert np.allclose(network.image(*crop_to_mask(pixels, mask)), red / np.linalg.norm(red), atol=0.02)
    made = network.words(["Red", "blue"])
    assert made.shape == (2, 3) and np.allclose(np.linalg.norm(made, axis=1), 1)
    assert made[0, 0] > 0.99 and made[1, 2] > 0.99


def test_an_embedding_that_is_not_a_number_is_refused(tmp_path: Path, merges: Path) -> None:
    network = clip(tmp_path, merges)
    for made in ("Log(input)", "Sub(input, input)"):  # of a negative number; nothing at all
        graph = f"(float[1,3,224,224] input) => (float[1,3] output) {{ x = {made} "
        graph += "output = ReduceMean<axes=[2,3], keepdims=0>(x) }"
        bad = write_graph(tmp_path / "bad.onnx", graph)
        network = Clip(bad, tmp_path / "text.onnx", merges)
        with pytest.raises(InputError, match="bad.onnx makes"):
            network.image(np.zeros((20, 20, 3), np.uint8), np.ones((20, 20), bool))


def test_another_network_is_not_clip(tmp_path: Path, merges: Path) -> None:
    network = clip(tmp_path, merges)
    image, text = network.image_network.path, network.text_network.path
    with pytest.raises(InputError, match="text.onnx is not CLIP's image network: it makes sums .* pixel_values"):
        Clip(text, text, merges)
    with pytest.raises(InputError, match="image.onnx is not CLIP's text network"):
        Clip(image, image, merges)


# Grounding DINO and SAM -----------------------------------------------------------------------------------------------

# Three boxes: one of each of the tokens 5 (coral) and 8 (##or), and another of coral over the first.
DINO = """(float[1,3,{h},{w}] pixel_values, int64[1,{h},{w}] pixel_mask, int64[1,{l}] input_ids,
 int64[1,{l}] token_type_ids, int64[1,{l}] attention_mask) => (float[1,3,{l}] logits, float[1,3,4] pred_boxes)
<int64[1,3,1] wanted = {{5,8,5}}, float[1,3,4] boxes = {{0.25,0.5,0.5,1.0, 0.75,0.25,0.5,0.5, 0.25,0.5,0.5,0.9}},
 float[1,3,1] strength = {{9,8,7}}, float low = {{-6}}, int64[1] one = {{1}}, float infinite = {{-inf}},
 float nothing = {{0}}>
{{ ids = Unsqueeze(input_ids, one) same = Equal(ids, wanted) share = Cast<to=1>(same) strong = Mul(share, strength)
  scores = Add(strong, low) kept = Cast<to=9>(attention_mask) visible = Unsqueeze(kept, one)
  logits = Where(visible, scores, infinite) mean = ReduceMean<axes=[1,2,3], keepdims=0>(pixel_values)
  none = Mul(mean, nothing) pred_boxes = Add(boxes, none) }}"""
ENCODER = """(float[{size}] input_image) => (float[1,256,64,64] image_embeddings)
<float[1,256,1,1] zero = {zeros}, int64[4] shape = {{1,256,64,64}}>
{{ mean = ReduceMean<keepdims=0>(input_image) sum = Add(zero, mean) image_embeddings = Expand(sum, shape) }}"""
# Draws the box itself, whose corners come in the frame with its longer side 1024.
DECODER = """(float[1,256,64,64] image_embeddings, float[1,N,2] point_coords, float[1,N] point_labels,
 float[1,1,256,256] mask_input, float[1] has_mask_input, float[2] orig_im_size)
 => (float[1,1,h,w] masks, float[1,1] iou_predictions, float[1,1,256,256] low_res_masks)
<int64 i0 = {0}, int64 i1 = {1}, float f0 = {0}, float f1 = {1}, float half = {0.5}, float side = {1024},
 int64[2] column = {-1,1}, int64[2] row = {1,-1}, float[2] corners = {2,3}, int64[2] two = {1,1}, int64[2] pair = {0,1}>
{ longest = ReduceMax<keepdims=0>(orig_im_size) scale = Div(longest, side) scaled = Mul(point_coords, scale)
  least = ReduceMin<axes=[1], keepdims=0>(scaled) most = ReduceMax<axes=[1], keepdims=0>(scaled)
  x0 = Gather<axis=1>(least, i0) y0 = Gather<axis=1>(least, i1)
  x1 = Gather<axis=1>(most, i0) y1 = Gather<axis=1>(most, i1)
  h = Gather(orig_im_size, i0) w = Gather(orig_im_size, i1) ys0 = Range(f0, h, f1) xs0 = Range(f0, w, f1)
  ys1 = Add(ys0, half) xs1 = Add(xs0, half) ys = Reshape(ys1, column) xs = Reshape(xs1, row)
  a = Less(x0, xs) b = Less(xs, x1) c = Less(y0, ys) d = Less(ys, y1) ab = And(a, b) cd = And(c, d) in = And(ab, cd)
  drawn = Cast<to=1>(in) signed = Sub(drawn, half) wrong = Sub(point_labels, corners) off = ReduceMax<keepdims=0>(wrong)
  sized = Sub(signed, off) masks = Unsqueeze(sized, pair)
  iou_predictions = Reshape(half, two) low_res_masks = Identity(mask_input) }"""


def dino(folder: Path, bert: Path, fixed: bool = False) -> GroundingDino:
    sizes = {"h": 96, "w": 64, "l": 256} if fixed else {"h": "H", "w": "W", "l": "L"}
    return GroundingDino(write_graph(folder / "dino.onnx", DINO.format(**sizes)), bert)


def sam(folder: Path, size: str) -> Sam:
    encoder = ENCODER.format(size=size, zeros="{" + ",".join(["0"] * 256) + "}")
    return Sam(write_graph(folder / "encoder.onnx", encoder), write_graph(folder / "decoder.onnx", DECODER))


@pytest.mark.parametrize("fixed", [False, True])
def test_boxes_are_of_the_words_whose_tokens_they_answer(tmp_path: Path, bert: Path, fixed: bool) -> None:
    detector = dino(tmp_path, bert, fixed)
    pixels = np.full((60, 100, 3), 100, np.uint8)
    found = detector.boxes(pixels, ["wreck", "coral", "anchor"])
    assert [box.label for box in found] == ["coral", "anchor"]  # the third box lies over the first
    assert np.allclose(found[0].corners, (0, 0, 50, 60)) and np.allclose(found[1].corners, (50, 0, 100, 30))
    assert found[0].score == pytest.approx(1 / (1 + np.exp(-3)), abs=1e-4)
    assert detector.boxes(pixels, ["wreck"]) == []


def test_words_that_fill_several_texts_are_all_looked_for(tmp_path: Path, bert: Path) -> None:
    detector = dino(tmp_path, bert, fixed=True)
    words = [f"wreck {number}" for number in range(300)] + ["coral"]
    assert [box.label for box in detector.boxes(np.zeros((50, 50, 3), np.uint8), words)] == ["coral"]


@pytest.mark.parametrize("size", ["H,W,3", "1,3,1024,1024"])
def test_masks_are_drawn_where_the_boxes_are(tmp_path: Path, size: str) -> None:
    boxes = [Box("coral", 0.9, (10.0, 5.0, 40.0, 20.0)), Box("wreck", 0.8, (50.0, 0.0, 100.0, 60.0))]
    first, second = sam(tmp_path, size).masks(np.full((60, 100, 3), 90, np.uint8), boxes)
    assert first.shape == (60, 100) and first[5:20, 10:40].all() and first.sum() == 15 * 30
    assert second[:, 50:].all() and second.sum() == 60 * 50


def test_words_become_regions(tmp_path: Path, bert: Path) -> None:
    provider = GroundedSam(dino(tmp_path, bert), sam(tmp_path, "H,W,3"))
    pixels = np.zeros((60, 100, 3), np.uint8)
    image = TrainingImage(None, pixels, np.ones((60, 100), bool))
    regions = provider.regions(image, ["coral", "anchor"])
    assert [region.label for region in regions] == ["coral", "anchor"]
    assert regions[1].mask[:30, 50:].all() and regions[1].mask.sum() == 30 * 50
    assert provider.regions(image, ["wreck"]) == []
    with pytest.raises(InputError, match="looks for words, and there are none"):
        provider.regions(image, [])


def test_overlap_is_intersection_over_union() -> None:
    a, b = Box("", 1, (0, 0, 2, 2)), Box("", 1, (1, 0, 3, 2))
    assert intersection_over_union(a, b) == pytest.approx(1 / 3) and intersection_over_union(a, a) == pytest.approx(1)
    assert intersection_over_union(a, Box("", 1, (5, 5, 6, 6))) == 0


# BLIP -----------------------------------------------------------------------------------------------------------------


def test_a_caption_is_read_word_by_word(tmp_path: Path, bert: Path) -> None:
    vision = """(float[1,3,384,384] pixel_values) => (float[1,577,768] last_hidden_state)
    <float[1,1,1] zero = {0}, int64[3] shape = {1,577,768}>
    { mean = ReduceMean<keepdims=0>(pixel_values) sum = Add(zero, mean) last_hidden_state = Expand(sum, shape) }"""
    following = np.full(30523, 102, np.int64)
    following[[30522, 11, 7, 8, 9]] = (11, 7, 8, 102, 102)  # [DEC] a anch ##or [SEP]
    following[102] = 9  # what comes after the end is not read
    nodes = [
        helper.make_node("Gather", ["following", "input_ids"], ["next"]),
        helper.make_node("OneHot", ["next", "depth", "values"], ["hot"]),
        helper.make_node("ReduceMean", ["encoder_hidden_states"], ["mean"], keepdims=0),
        helper.make_node("Add", ["hot", "mean"], ["logits"]),
    ]
    tables = {"following": following, "depth": np.array(30524), "values": np.array([0, 1], np.float32)}
    states = ("encoder_hidden_states", TensorProto.FLOAT, [1, "T", 768])
    ids, mask = ("input_ids", TensorProto.INT64, [1, "L"]), ("encoder_attention_mask", TensorProto.INT64, [1, "T"])
    logits = ("logits", TensorProto.FLOAT, [1, "L", 30524])
    text = write_nodes(tmp_path / "text.onnx", nodes, [ids, mask, states], [logits], tables)
    captioner = Blip(write_graph(tmp_path / "vision.onnx", vision), text, bert)
    assert captioner.captions(np.full((40, 60, 3), 120, np.uint8)) == ["a anchor"]


def test_captions_name_things() -> None:
    assert phrases("a red starfish sitting on top of some coral, with a diver's light") == [
        "red starfish", "top", "coral", "diver's light",
    ]  # fmt: skip
    assert phrases("coral and coral") == ["coral"] and phrases("a close up of the") == []


# Embeddings without a network, and their projection -------------------------------------------------------------------


def test_descriptors_tell_colors_and_textures_apart() -> None:
    descriptor = Descriptor()
    random = np.random.default_rng(0)
    smooth, rough = np.full((40, 40, 3), 120, np.uint8), np.full((40, 40, 3), 120, np.uint8)
    rough += random.integers(-60, 60, (40, 40, 1)).astype(np.uint8)
    orange = np.full((40, 40, 3), (230, 130, 30), np.uint8)
    mask = np.ones((40, 40), bool)
    made = [descriptor.image(pixels, mask) for pixels in (smooth, rough, orange)]
    assert all(np.linalg.norm(embedding) == pytest.approx(1, abs=1e-5) for embedding in made)
    same = made[1] @ descriptor.image(np.rot90(rough)[:30].copy(), mask[:30])
    assert same > 0.95 > made[0] @ made[1] > made[0] @ made[2]
    assert [color_name(embedding) for embedding in made] == ["grey", "grey", "orange"]
    with pytest.raises(InputError, match="Without CLIP only labels can be searched by name, and none is called eel"):
        descriptor.words(["eel"])


@pytest.mark.parametrize(("count", "width"), [(200, 100), (20, 100), (2, 512), (1, 512), (50, 12)])
def test_projected_embeddings_have_length_one_and_keep_their_neighbours(count: int, width: int) -> None:
    random = np.random.default_rng(1)
    centres = 3 + random.normal(size=(3, width))  # much in common, as all that CLIP sees has
    groups = random.integers(0, 3, count)
    embeddings = centres[groups] + 0.1 * random.normal(size=(count, width))
    embeddings = (embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True)).astype(np.float32)
    projection = Projection.fit(embeddings)
    made = projection(embeddings)
    assert made.shape == (count, 32) and made.dtype == np.float32
    assert np.allclose(np.linalg.norm(made, axis=1), 1, atol=1e-5)
    again = Projection.fit(embeddings)
    assert np.array_equal(again.matrix, projection.matrix)
    cosines = made @ made.T
    same = groups[:, None] == groups
    assert cosines[same].min() > 0.5 and (same.all() or cosines[~same].max() < 0.5)
    if width >= 32:
        assert np.allclose(projection.matrix @ projection.matrix.T, np.eye(32), atol=1e-4)


def test_many_embeddings_are_projected_on_their_principal_components() -> None:
    random = np.random.default_rng(2)
    flat = random.normal(size=(300, 32)) @ random.normal(size=(32, 64))
    projection = Projection.fit(flat.astype(np.float32))
    centred = flat - flat.mean(0)
    assert np.allclose(centred @ projection.matrix.T @ projection.matrix, centred, atol=1e-3 * np.abs(centred).max())
