"""Captions of photographs, and the things they name."""

import re
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from ..weights.onnx import Graph
from .cache import file_key
from .embed import CLIP_MEAN, CLIP_STD
from .tokenizer import WordPieceTokenizer

_CONNECTING = (
    "a an the this that these those some many several lots lot of in on at by with and or near next to from over under "
    "above below behind beside between through around into onto out is are was be being it its there which while photo "
    "picture image view close up shot underwater swimming sitting standing lying floating laying"
)
CONNECTING = frozenset(_CONNECTING.split())
"""Words of captions that part one thing from the next."""


class Captioner(Protocol):
    """Says what a photograph shows. `name` and `key` as in RegionProvider."""

    name: str
    key: str

    def captions(self, pixels: np.ndarray) -> list[str]:
        """Sentences about an image (H, W, 3) uint8 sRGB, the best first."""
        ...


def phrases(caption: str) -> list[str]:
    """The things that a caption names, each once: "a red starfish on some coral" gives "red starfish", "coral"."""
    found: list[str] = []
    words: list[str] = []
    for word in [*re.findall(r"[\w'-]+|[^\w\s]", caption.lower()), "."]:
        if word[0].isalnum() and word not in CONNECTING:
            words.append(word)
        elif words:
            found.append(" ".join(words))
            words = []
    return list(dict.fromkeys(found))


class Blip:
    """BLIP's captioner (Li et al. 2022, arXiv 2201.12086) in two ONNX files, with BERT's vocabulary.

    Image: (1, 3, 384, 384) to (1, T, D). Text: token ids (1, L) and the image's states, named encoder_hidden_states, to
    logits (1, L, V); masks where the file asks for them. The most likely token is taken each time.
    """

    name = "blip"
    START, END, MOST_TOKENS = 30522, 102, 20  # [DEC] and [SEP]

    def __init__(self, image: Path, text: Path, vocabulary: Path) -> None:
        """Raises InputError when a file is absent or of another kind."""
        pixels = {"pixel_values": (None, 3, None, None)}
        states = {"input_ids": (None, None), "encoder_hidden_states": (None, None, None)}
        masks = ["attention_mask", "encoder_attention_mask"]
        self.image_network = Graph(image, "BLIP's image network", pixels, ["last_hidden_state"])
        self.text_network = Graph(text, "BLIP's text network", states, ["logits"], masks)
        self.tokenizer = WordPieceTokenizer(vocabulary)
        self.key = f"blip:{file_key(image)}:{file_key(text)}"

    def captions(self, pixels: np.ndarray) -> list[str]:
        """As in Captioner: one sentence. Raises InputError when a network fails."""
        side = self.image_network.shapes["pixel_values"][-1] or 384
        resized = cv2.resize(pixels.astype(np.float32) / 255, (side, side), interpolation=cv2.INTER_CUBIC)
        shown = ((resized - CLIP_MEAN) / CLIP_STD).transpose(2, 0, 1)[None]
        states = self.image_network(pixel_values=shown)["last_hidden_state"]
        tokens = [self.START]
        for _ in range(self.MOST_TOKENS):
            ids = np.array([tokens])
            logits = self.text_network(
                input_ids=ids,
                attention_mask=np.ones_like(ids),
                encoder_hidden_states=states,
                encoder_attention_mask=np.ones(states.shape[:2], np.int64),
            )["logits"]
            following = int(logits[0, -1].argmax())
            if following == self.END:
                break
            tokens.append(following)
        return [self.tokenizer.decode(tokens[1:])]
