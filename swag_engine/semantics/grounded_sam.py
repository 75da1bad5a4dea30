"""Regions by words: Grounding DINO finds boxes, SAM or MobileSAM their masks, as in Grounded SAM (arXiv 2401.14159).

Both run in ONNX Runtime, with the inputs and outputs that their published exports have.
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

IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
"""Mean of ImageNet's images, sRGB in 0..1."""
IMAGENET_STD = np.array([0.229, 0.224, 0.225], np.float32)
"""Their standard deviation."""
MAX_TOKENS = 256
"""Of one text that Grounding DINO takes."""
MIN_SCORE = 0.3
"""Of a box, as in Grounding DINO's own demonstration."""
MAX_OVERLAP = 0.7
"""Intersection over union above which, of two boxes with one label, only the one of the higher score is kept."""


@dataclass(frozen=True)
class Box:
    """A detection.

    Attributes:
        label: The word that was found.
        score: Confidence, 0..1.
        corners: Left, top, right, bottom, pixels of the image.
    """

    label: str
    score: float
    corners: tuple[float, float, float, float]


class GroundingDino:
    """Grounding DINO (Liu et al. 2023, arXiv 2303.05499) as exported from transformers, with BERT's vocabulary.

    Inputs: pixel_values (1, 3, H, W), pixel_mask (1, H, W), input_ids, token_type_ids, attention_mask (1, L). Outputs:
    logits (1, Q, 256) of each box by token, and pred_boxes (1, Q, 4), centre and size as fractions of the image.

    Args:
        path: File of the network.
        vocabulary: BERT's vocab.txt.

    Raises:
        InputError: If a file is absent or of another kind.
    """

    SHORT_SIDE = 800
    """Pixels that the shorter side is resized to, as in Grounding DINO's own preprocessing."""
    LONG_SIDE = 1333
    """Pixels that the longer side may have at most."""

    def __init__(self, path: Path, vocabulary: Path) -> None:
        inputs = {"pixel_values": (None, 3, None, None), "input_ids": (None, None)}
        others = ["pixel_mask", "token_type_ids", "attention_mask"]
        self.network = Graph(path, "Grounding DINO", inputs, ["logits", "pred_boxes"], others)
        self.tokenizer = WordPieceTokenizer(vocabulary)

    def boxes(self, pixels: np.ndarray, words: Sequence[str]) -> list[Box]:
        """Detect words in an image.

        Args:
            pixels: (H, W, 3) uint8 sRGB.
            words: Words or phrases to look for.

        Returns:
            Boxes, the highest score first.

        Raises:
            InputError: If the network fails.
        """
        pixel_values = self._pixel_values(pixels)
        found = [box for text in self._texts(words) for box in self._detect(pixel_values, pixels.shape, text)]
        kept: list[Box] = []
        for box in sorted(found, key=lambda box: -box.score):
            if all(box.label != other.label or intersection_over_union(box, other) <= MAX_OVERLAP for other in kept):
                kept.append(box)
        return kept

    def _pixel_values(self, pixels: np.ndarray) -> np.ndarray:
        """Return the image resized and normalised, (1, 3, H', W') float32."""
        height, width = pixels.shape[:2]
        scale = min(self.SHORT_SIDE / min(height, width), self.LONG_SIDE / max(height, width))
        rows, columns = (
            fixed or max(1, round(size * scale))
            for fixed, size in zip(self.network.shapes["pixel_values"][2:], (height, width), strict=True)
        )
        resized = cv2.resize(pixels.astype(np.float32) / 255, (columns, rows), interpolation=cv2.INTER_LINEAR)
        return ((resized - IMAGENET_MEAN) / IMAGENET_STD).transpose(2, 0, 1)[None]

    def _texts(self, words: Sequence[str]) -> list[list[tuple[str, list[int]]]]:
        """Return words with their tokens, in groups that fit into one text each."""
        length = self.network.shapes["input_ids"][1] or MAX_TOKENS
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

    def _detect(self, pixel_values: np.ndarray, shape: tuple[int, ...], text: list[tuple[str, list[int]]]) -> list[Box]:
        """Return the boxes that one pass over an image of this shape finds."""
        ids = [self.tokenizer.ids["[CLS]"]]
        spans = []
        for _, tokens in text:
            spans.append(slice(len(ids), len(ids) + len(tokens)))
            ids += [*tokens, self.tokenizer.ids["."]]
        ids.append(self.tokenizer.ids["[SEP]"])
        length = self.network.shapes["input_ids"][1] or len(ids)
        padded = np.array([ids + [self.tokenizer.ids["[PAD]"]] * (length - len(ids))])
        made = self.network(
            pixel_values=pixel_values,
            pixel_mask=np.ones((1, *pixel_values.shape[2:]), np.int64),
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

    Encoder: an image to image_embeddings (1, 256, 64, 64); the image is (H, W, 3) in 0..255 with a longer side of 1024,
    which the file normalises itself, or (1, 3, 1024, 1024) normalised and padded. Decoder: as the export of
    segment-anything makes it; a box is two points with the labels 2 and 3.

    Args:
        encoder: File of the image encoder.
        decoder: File of the mask decoder.

    Raises:
        InputError: If a file is absent or of another kind.
    """

    SIDE = 1024
    """Pixels of the longer side."""
    MEAN = np.array([123.675, 116.28, 103.53], np.float32)
    """Mean of the training images, 0..255."""
    STD = np.array([58.395, 57.12, 57.375], np.float32)
    """Their standard deviation."""

    def __init__(self, encoder: Path, decoder: Path) -> None:
        self.encoder = Graph(encoder, "SAM's image encoder", {"input_image": None}, ["image_embeddings"])
        inputs = {
            "image_embeddings": (1, None, None, None), "point_coords": (None, None, 2), "point_labels": (None, None),
            "mask_input": (None, 1, None, None), "has_mask_input": (None,), "orig_im_size": (None,),
        }  # fmt: skip
        outputs = ["masks", "iou_predictions", "low_res_masks"]
        self.decoder = Graph(decoder, "SAM's mask decoder", inputs, outputs)

    def masks(self, pixels: np.ndarray, boxes: Sequence[Box]) -> list[np.ndarray]:
        """Segment what boxes hold.

        Args:
            pixels: (H, W, 3) uint8 sRGB.
            boxes: Boxes in the image.

        Returns:
            A mask (H, W) bool for each box.

        Raises:
            InputError: If a network fails.
        """
        height, width = pixels.shape[:2]
        scale = self.SIDE / max(height, width)
        size = round(width * scale), round(height * scale)
        resized = cv2.resize(pixels, size, interpolation=cv2.INTER_LINEAR).astype(np.float32)
        if len(self.encoder.shapes["input_image"]) == 4:
            padded = np.zeros((1, 3, self.SIDE, self.SIDE), np.float32)
            padded[0, :, : size[1], : size[0]] = ((resized - self.MEAN) / self.STD).transpose(2, 0, 1)
            resized = padded
        embeddings = self.encoder(input_image=resized)["image_embeddings"]
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
    """Provider of regions by words.

    Args:
        detector: Finds boxes.
        segmenter: Finds the masks of boxes.
    """

    name = "grounded-sam"

    def __init__(self, detector: GroundingDino, segmenter: Sam) -> None:
        self.detector, self.segmenter = detector, segmenter
        paths = detector.network.path, segmenter.encoder.path, segmenter.decoder.path
        self.key = f"grounded-sam:{MIN_SCORE}:{[file_key(path) for path in paths]}"

    def regions(self, image: TrainingImage, words: Sequence[str]) -> list[Region]:
        """Find regions as in RegionProvider; raises InputError without words."""
        if not words:
            raise InputError("grounded-sam looks for words, and there are none: name what to look for, such as coral.")
        boxes = self.detector.boxes(image.pixels, words)
        if not boxes:
            return []
        return [
            Region(mask, box.label) for box, mask in zip(boxes, self.segmenter.masks(image.pixels, boxes), strict=True)
        ]


def intersection_over_union(a: Box, b: Box) -> float:
    """Return the area that two boxes share over the area that they cover, 0..1."""
    left, top = max(a.corners[0], b.corners[0]), max(a.corners[1], b.corners[1])
    right, bottom = min(a.corners[2], b.corners[2]), min(a.corners[3], b.corners[3])
    common = max(0.0, right - left) * max(0.0, bottom - top)
    areas = [(box.corners[2] - box.corners[0]) * (box.corners[3] - box.corners[1]) for box in (a, b)]
    return common / max(sum(areas) - common, 1e-9)
