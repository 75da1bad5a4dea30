"""Captions of images, and the phrases in them that can be looked for."""

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
"""Words of captions that separate phrases."""


class Captioner(Protocol):
    """Describes images in words.

    Attributes:
        name: Name for the user.
        key: Distinguishes the captioner and its weights from others in the cache.
    """

    name: str
    key: str

    def captions(self, pixels: np.ndarray) -> list[str]:
        """Describe an image.

        Args:
            pixels: (H, W, 3) uint8 sRGB.

        Returns:
            Sentences, the best first.

        Raises:
            InputError: If a network fails.
        """
        ...


def phrases(caption: str) -> list[str]:
    """Extract the phrases of a caption, each once: "a red starfish on some coral" gives "red starfish", "coral"."""
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

    Image network: (1, 3, 384, 384) to (1, T, D). Text network: token ids (1, L) and the image's states, named
    encoder_hidden_states, to logits (1, L, V); masks where the file has these inputs. Decoding is greedy.

    Args:
        image: File of the image network.
        text: File of the text network.
        vocabulary: BERT's vocab.txt.

    Raises:
        InputError: If a file is absent or of another kind.
    """

    name = "blip"
    START = 30522
    """Token [DEC], which BERT's vocabulary does not have."""
    END = 102
    """Token [SEP]."""
    MAX_TOKENS = 20
    """Of one caption."""

    def __init__(self, image: Path, text: Path, vocabulary: Path) -> None:
        pixels = {"pixel_values": (None, 3, None, None)}
        states = {"input_ids": (None, None), "encoder_hidden_states": (None, None, None)}
        masks = ["attention_mask", "encoder_attention_mask"]
        self.image_network = Graph(image, "BLIP's image network", pixels, ["last_hidden_state"])
        self.text_network = Graph(text, "BLIP's text network", states, ["logits"], masks)
        self.tokenizer = WordPieceTokenizer(vocabulary)
        self.key = f"blip:{file_key(image)}:{file_key(text)}"

    def captions(self, pixels: np.ndarray) -> list[str]:
        """Describe an image in one sentence, as in Captioner."""
        side = self.image_network.shapes["pixel_values"][-1] or 384
        resized = cv2.resize(pixels.astype(np.float32) / 255, (side, side), interpolation=cv2.INTER_CUBIC)
        normalised = ((resized - CLIP_MEAN) / CLIP_STD).transpose(2, 0, 1)[None]
        states = self.image_network(pixel_values=normalised)["last_hidden_state"]
        tokens = [self.START]
        for _ in range(self.MAX_TOKENS):
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
