"""Tokenizers of text networks: CLIP's byte pairs and BERT's word pieces."""

import gzip
import html
import unicodedata
import zlib
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..base.errors import InputError

END_OF_WORD = "</w>"
"""Suffix of tokens that end a word."""
CLIP_MERGES = 49152 - 256 - 2
"""Merges that CLIP uses; its file has more."""


class BytePairTokenizer:
    """CLIP's lower-case byte pair encoding (Sennrich et al. 2016).

    Tokens in this order: the 256 bytes, the 256 bytes that end a word, one for each merge, start and end of a text.

    Args:
        path: CLIP's bpe_simple_vocab_16e6.txt.gz.

    Raises:
        InputError: If the file is absent or not this vocabulary.
    """

    def __init__(self, path: Path) -> None:
        lines = _text(path, gzip.open).splitlines()[1 : 1 + CLIP_MERGES]
        merges = [tuple(line.split()) for line in lines]
        if not merges or any(len(merge) != 2 for merge in merges):
            raise InputError(f"{path} is not CLIP's vocabulary bpe_simple_vocab_16e6.txt.gz: get it again.")
        self.letters = _byte_letters()
        tokens = list(self.letters.values())
        tokens += [letter + END_OF_WORD for letter in tokens]
        tokens += ["".join(merge) for merge in merges]
        self.ids = {token: number for number, token in enumerate(tokens)}
        self.ranks = {merge: rank for rank, merge in enumerate(merges)}
        self.start, self.end = len(tokens), len(tokens) + 1

    def encode(self, text: str) -> list[int]:
        """Return the token ids of a text, without start and end."""
        ids = []
        for word in _clip_words(html.unescape(html.unescape(text)).lower()):
            letters = "".join(self.letters[byte] for byte in word.encode("utf-8"))
            ids += [self.ids[piece] for piece in self._merged(letters)]
        return ids

    def padded(self, text: str, length: int) -> np.ndarray:
        """Return start, tokens, end and zeros, (length,) int64; a text that is too long is truncated."""
        ids = [self.start, *self.encode(text)[: length - 2], self.end]
        return np.array(ids + [0] * (length - len(ids)), np.int64)

    def _merged(self, letters: str) -> Sequence[str]:
        """Return the tokens of a word."""
        pieces = [*letters[:-1], letters[-1] + END_OF_WORD]
        while len(pieces) > 1:
            pairs = list(zip(pieces, pieces[1:], strict=False))
            best = min(pairs, key=lambda pair: self.ranks.get(pair, len(self.ranks)))
            if best not in self.ranks:
                break
            joined: list[str] = []
            at = 0
            while at < len(pieces):
                together = at < len(pairs) and pairs[at] == best
                joined.append("".join(best) if together else pieces[at])
                at += 2 if together else 1
            pieces = joined
        return pieces


class WordPieceTokenizer:
    """BERT's lower-case word pieces (Devlin et al. 2019).

    Args:
        path: BERT's vocab.txt, one token a line.

    Raises:
        InputError: If the file is absent or not this vocabulary.
    """

    def __init__(self, path: Path) -> None:
        self.tokens = _text(path, open).splitlines()
        self.ids = {token: number for number, token in enumerate(self.tokens)}
        if not {"[UNK]", "[CLS]", "[SEP]", "[PAD]", "."} <= self.ids.keys():
            raise InputError(f"{path} is not BERT's vocabulary vocab.txt: get it again.")

    def encode(self, text: str) -> list[int]:
        """Return the token ids of a text, without [CLS] and [SEP]."""
        return [number for word in _bert_words(text) for number in self._pieces(word)]

    def decode(self, ids: Sequence[int]) -> str:
        """Return the text of token ids, without special tokens and numbers beyond the vocabulary."""
        text = ""
        for number in ids:
            token = self.tokens[number] if number < len(self.tokens) else "[UNK]"
            if token.startswith("##"):
                text += token[2:]
            elif not (token.startswith("[") and token.endswith("]")):
                text += " " + token
        return text.strip()

    def _pieces(self, word: str) -> list[int]:
        """Return the tokens of a word: the longest piece of the vocabulary that it starts with, and so on."""
        pieces = []
        start = 0
        while start < len(word):
            for end in range(len(word), start, -1):
                piece = self.ids.get(("##" if start else "") + word[start:end])
                if piece is not None:
                    break
            else:
                return [self.ids["[UNK]"]]
            pieces.append(piece)
            start = end
        return pieces


@lru_cache(maxsize=1)
def _byte_letters() -> dict[int, str]:
    """Return a printable character for each byte, in the order of CLIP's vocabulary; printable Latin-1 is itself."""
    visible = [*range(ord("!"), ord("~") + 1), *range(ord("¡"), ord("¬") + 1), *range(ord("®"), ord("ÿ") + 1)]
    hidden = [byte for byte in range(256) if byte not in visible]
    letters = {byte: chr(byte) for byte in visible}
    return letters | {byte: chr(256 + place) for place, byte in enumerate(hidden)}


def _clip_words(text: str) -> Iterator[str]:
    """Split as CLIP does: English endings after an apostrophe, runs of letters, digits, runs of anything else."""
    at = 0
    while at < len(text):
        ending = next((e for e in ("'s", "'t", "'re", "'ve", "'m", "'ll", "'d") if text.startswith(e, at)), None)
        kind = _kind(text[at])
        end = at + 1
        if ending:
            end = at + len(ending)
        elif kind in ("letter", "other"):
            while end < len(text) and _kind(text[end]) == kind:
                end += 1
        if kind != "blank":
            yield text[at:end]
        at = end


def _kind(character: str) -> str:
    if character.isspace():
        return "blank"
    return {"L": "letter", "N": "number"}.get(unicodedata.category(character)[0], "other")


def _bert_words(text: str) -> list[str]:
    """Return lower case without accents, split at blanks and at each punctuation mark."""
    plain = unicodedata.normalize("NFD", text.lower())
    spaced = ""
    for character in plain:
        category = unicodedata.category(character)
        ascii_mark = character.isascii() and character.isprintable() and not character.isalnum() and character != " "
        if category == "Mn":
            continue
        spaced += f" {character} " if category[0] == "P" or ascii_mark else character
    return spaced.split()


def _text(path: Path, opened: object) -> str:
    if not path.is_file():
        raise InputError(f"There is no file {path}: save the vocabulary there.")
    try:
        with opened(path, "rt", encoding="utf-8") as file:  # type: ignore[operator]
            return str(file.read())
    except (OSError, EOFError, UnicodeDecodeError, zlib.error) as error:
        raise InputError(f"{path} cannot be read as a vocabulary ({error}): get it again.") from error
