"""Who finds regions and embeds them: chosen by name, by the user's words and masks, and by what is on this machine."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from ..base.errors import InputError
from ..scene.colmap import Scene
from ..weights.registry import find_or_fetch, is_here
from .captions import Blip, Captioner
from .embed import Clip, Descriptor, Embedder
from .grounded_sam import GroundedSam, GroundingDino, Sam
from .masks import MaskFolder
from .regions import RegionProvider
from .saliency import Saliency

Provider = Literal["masks", "grounded-sam", "saliency"]
Progress = Callable[[str, float], None]


def choose(
    scene: Scene, words: Sequence[str], masks: Path | None, provider: Provider | None = None
) -> tuple[Provider, Path | None]:
    """Whose regions, and the folder of masks.

    Without a provider's name: masks where a folder is given, grounded-sam where there are words, else the scene's own
    folder `labels` where it has one, else saliency.
    """
    own = scene.folder / "labels"
    if masks is None and own.is_dir() and (provider == "masks" or not (provider or words)):
        masks = own
    return provider or ("masks" if masks else "grounded-sam" if words else "saliency"), masks


def region_provider(
    provider: Provider,
    scene: Scene,
    masks: Path | None,
    has_words: bool,
    weights_dir: Path | None,
    download: bool,
    progress: Progress = lambda stage, fraction: None,
) -> tuple[RegionProvider, Captioner | None]:
    """The provider of that name, and the captioner that says what to look for where it needs words and has none."""
    if provider == "masks":
        if masks is None:
            raise InputError("Masks need a folder: name it with --masks.")
        return MaskFolder(masks, scene), None
    if provider == "saliency":
        return Saliency(), None

    def network(name: str) -> Path:
        return _network(name, weights_dir, download, progress)

    vocabulary = network("bert-vocabulary")
    captioner = None if has_words else Blip(network("blip-image"), network("blip-text"), vocabulary)
    detector = GroundingDino(network("grounding-dino"), vocabulary)
    return GroundedSam(detector, Sam(network("mobile-sam-image"), network("mobile-sam-mask"))), captioner


def region_embedder(
    weights_dir: Path | None, download: bool, progress: Progress = lambda stage, fraction: None
) -> Embedder:
    """CLIP where its files are there or may be fetched, else colour and texture. A damaged file of CLIP is refused."""
    files = "clip-image", "clip-text", "clip-vocabulary"
    if not download and not all(is_here(name, weights_dir) for name in files):
        return Descriptor()
    image, text, vocabulary = (_network(name, weights_dir, download, progress) for name in files)
    return Clip(image, text, vocabulary)


def _network(name: str, weights_dir: Path | None, download: bool, progress: Progress) -> Path:
    return find_or_fetch(name, weights_dir, download, lambda fraction: progress(f"Download {name}", fraction))
