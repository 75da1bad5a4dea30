"""Regions of words: Grounding DINO finds boxes, SAM or MobileSAM their outlines (as in Grounded SAM, arXiv 2401.14159).

Both through ONNX Runtime, with the inputs and outputs that their published exports have.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..base.errors import InputError
from ..scene.images import TrainingImage
from ..weights.onnx import Graph
from .cache import file_key
from .regions import Region
from .tokenizer import WordPieceTokenizer

IMAGENET_MEAN, IMAGENET_STD = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)
MOST_TOKENS = 256
"""Of one text that Grounding DINO takes."""
MIN_SCORE = 0.3
"""Of a box, as in Grounding DINO's own demonstration."""
MOST_OVERLAP = 0.7
"""Intersection over union of two boxes of one word; of more, only the surer stays."""


@dataclass(frozen=True)
class Box:
    """Left, top, right, bottom in pixels of the photograph; what it holds, and how sure that is, 0..1."""

    name: str
    score: float
    corners: tuple[float, float, float, float]


class GroundingDino:
    """Grounding DINO (Liu et al. 2023, arXiv 2303.05499) as exported from transformers, with BERT's vocabulary.

    pixel_values (1, 3, H, W), pixel_mask (1, H, W), input_ids, token_type_ids, attention_mask (1, L) to logits
    (1, Q, 256) of each box by token, and pred_boxes (1, Q, 4): centre and size in 0..1 of the picture.
    """

    SHORT_SIDE, LONG_SIDE = 800, 1333

    def __init__(self, path: Path, vocabulary: Path) -> None:
        """Raises InputError when a file is absent or of another kind."""
        inputs = {"pixel_values": (None, 3, None, None), "input_ids": (None, None)}
        others = ["pixel_mask", "token_type_ids", "attention_mask"]
        self.network = Graph(path, "Grounding DINO", inputs, ["logits", "pred_boxes"], others)
        self.tokenizer = WordPieceTokenizer(vocabulary)

    def boxes(self, pixels: np.ndarray, words: Sequence[str]) -> list[Box]:
        """What is found of `words` in an image (H, W, 3) uint8 sRGB, the surest first."""
        shown = self._shown(pixels)
        found = [box for text in self._texts(words) for box in self._found(shown, pixels.shape, text)]
        kept: list[Box] = []
        for box in sorted(found, key=lambda box: -box.score):
            if all(box.name != other.name or overlap(box, other) <= MOST_OVERLAP for other in kept):
                kept.append(box)
        return kept

    def _shown(self, pixels: np.ndarray) -> np.ndarray:
        height, width = pixels.shape[:2]
        scale = min(self.SHORT_SIDE / min(height, width), self.LONG_SIDE / max(height, width))
        rows, columns = (
            fixed or max(1, round(size * scale))
            for fixed, size in zip(self.network.shapes["pixel_values"][2:], (height, width), strict=True)
        )
        resized = cv2.resize(pixels.astype(np.float32) / 255, (columns, rows), interpolation=cv2.INTER_LINEAR)
        return ((resized - IMAGENET_MEAN) / IMAGENET_STD).transpose(2, 0, 1)[None]

    def _texts(self, words: Sequence[str]) -> list[list[tuple[str, list[int]]]]:
        """Words with their tokens, in groups that fit into one text each."""
        length = self.network.shapes["input_ids"][1] or MOST_TOKENS
        texts: list[list[tuple[str, list[int]]]] = [[]]
        room = length - 2
        for word in words:
            tokens = self.tokenizer.encode(word)[: length - 3] or [self.tokenizer.ids["[UNK]"]]
            if len(tokens) + 1 > room:
                texts.append([])
                room = length - 2
            texts[-1].append((word, tokens))
            room -= len(tokens) + 1
        return texts

    def _found(self, shown: np.ndarray, shape: tuple[int, ...], text: list[tuple[str, list[int]]]) -> list[Box]:
        ids = [self.tokenizer.ids["[CLS]"]]
        spans = []
        for _, tokens in text:
            spans.append(slice(len(ids), len(ids) + len(tokens)))
            ids += [*tokens, self.tokenizer.ids["."]]
        ids.append(self.tokenizer.ids["[SEP]"])
        length = self.network.shapes["input_ids"][1] or len(ids)
        padded = np.array([ids + [self.tokenizer.ids["[PAD]"]] * (length - len(ids))])
        made = self.network(
            pixel_values=shown,
            pixel_mask=np.ones((1, *shown.shape[2:]), np.int64),
            input_ids=padded,
            token_type_ids=np.zeros_like(padded),
            attention_mask=np.arange(length)[None] < len(ids),
        )
        logits, boxes = made["logits"][0].astype(np.float64), made["pred_boxes"][0]
        if logits.ndim != 2 or boxes.shape != (len(logits), 4) or logits.shape[1] < len(ids):
            raise InputError(f"{self.network.path} is not Grounding DINO: it made {logits.shape} and {boxes.shape}.")
        scores = 1 / (1 + np.exp(-logits.clip(-50, 50)))
        by_word = np.stack([scores[:, span].max(1) for span in spans], 1)
        found = []
        for row in np.flatnonzero(by_word.max(1) >= MIN_SCORE):
            best = int(by_word[row].argmax())
            (x, y, w, h), (height, width) = boxes[row].tolist(), shape[:2]
            corners = (x - w / 2) * width, (y - h / 2) * height, (x + w / 2) * width, (y + h / 2) * height
            found.append(Box(text[best][0], float(by_word[row, best]), corners))
        return found


class Sam:
    """SAM (Kirillov et al. 2023, arXiv 2304.02643), or MobileSAM (arXiv 2306.14289), in two ONNX files.

    Encoder: one image to image_embeddings (1, 256, 64, 64), either (H, W, 3) in 0..255 with its longer side 1024, which
    it normalises itself, or (1, 3, 1024, 1024) normalised and padded. Decoder: as segment-anything's own export makes
    it; a box is two points with the labels 2 and 3.
    """

    SIDE = 1024
    MEAN, STD = np.array([123.675, 116.28, 103.53], np.float32), np.array([58.395, 57.12, 57.375], np.float32)

    def __init__(self, encoder: Path, decoder: Path) -> None:
        """Raises InputError when a file is absent or of another kind."""
        self.encoder = Graph(encoder, "SAM's image encoder", {"input_image": None}, ["image_embeddings"])
        inputs = {
            "image_embeddings": (1, None, None, None), "point_coords": (None, None, 2), "point_labels": (None, None),
            "mask_input": (None, 1, None, None), "has_mask_input": (None,), "orig_im_size": (None,),
        }  # fmt: skip
        outputs = ["masks", "iou_predictions", "low_res_masks"]
        self.decoder = Graph(decoder, "SAM's mask decoder", inputs, outputs)

    def masks(self, pixels: np.ndarray, boxes: Sequence[Box]) -> list[np.ndarray]:
        """(H, W) bool for each box in an image (H, W, 3) uint8 sRGB."""
        height, width = pixels.shape[:2]
        scale = self.SIDE / max(height, width)
        size = round(width * scale), round(height * scale)
        shown = cv2.resize(pixels, size, interpolation=cv2.INTER_LINEAR).astype(np.float32)
        if len(self.encoder.shapes["input_image"]) == 4:
            padded = np.zeros((1, 3, self.SIDE, self.SIDE), np.float32)
            padded[0, :, : size[1], : size[0]] = ((shown - self.MEAN) / self.STD).transpose(2, 0, 1)
            shown = padded
        embeddings = self.encoder(input_image=shown)["image_embeddings"]
        masks = []
        for box in boxes:
            made = self.decoder(
                image_embeddings=embeddings,
                point_coords=np.array(box.corners, np.float32).reshape(1, 2, 2) * scale,
                point_labels=np.array([[2, 3]]),
                mask_input=np.zeros((1, 1, 256, 256), np.float32),
                has_mask_input=np.zeros(1, np.float32),
                orig_im_size=np.array([height, width], np.float32),
            )
            best = int(made["iou_predictions"][0].argmax())
            if made["masks"].shape[2:] != (height, width):
                raise InputError(f"{self.decoder.path} is not SAM's mask decoder: it made {made['masks'].shape}.")
            masks.append(made["masks"][0, best] > 0)
        return masks


class GroundedSam:
    """Regions of words; each word's regions in one photograph are one."""

    name = "grounded-sam"

    def __init__(self, detector: GroundingDino, segmenter: Sam) -> None:
        self.detector, self.segmenter = detector, segmenter
        paths = detector.network.path, segmenter.encoder.path, segmenter.decoder.path
        self.key = f"grounded-sam:{MIN_SCORE}:{[file_key(path) for path in paths]}"

    def regions(self, image: TrainingImage, words: Sequence[str]) -> list[Region]:
        """As in RegionProvider. Raises InputError without words."""
        if not words:
            raise InputError("grounded-sam looks for words, and there are none: name what to look for, such as coral.")
        boxes = self.detector.boxes(image.pixels, words)
        if not boxes:
            return []
        return [
            Region(mask, box.name) for box, mask in zip(boxes, self.segmenter.masks(image.pixels, boxes), strict=True)
        ]


def overlap(a: Box, b: Box) -> float:
    """Intersection over union of two boxes."""
    left, top = max(a.corners[0], b.corners[0]), max(a.corners[1], b.corners[1])
    right, bottom = min(a.corners[2], b.corners[2]), min(a.corners[3], b.corners[3])
    common = max(0.0, right - left) * max(0.0, bottom - top)
    areas = [(box.corners[2] - box.corners[0]) * (box.corners[3] - box.corners[1]) for box in (a, b)]
    return common / max(sum(areas) - common, 1e-9)
