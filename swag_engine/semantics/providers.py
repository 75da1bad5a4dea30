"""Choice of what finds regions and embeds them: by name, by the user's words and masks, and by available networks."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from ..base.errors import InputError, remedy
from ..scene.colmap import Scene
from ..weights.registry import find_or_fetch, is_available
from .captions import Blip, Captioner
from .embed import Clip, Descriptor, Embedder
from .grounded_sam import GroundedSam, GroundingDino, Sam
from .masks import MaskFolder
from .regions import RegionProvider
from .saliency import Saliency

Provider = Literal["masks", "grounded-sam", "saliency"]
"""Name of a provider of regions."""
Progress = Callable[[str, float], None]
"""Called with the name of a stage and the fraction of it that is done."""


def choose_provider(
    scene: Scene, words: Sequence[str], masks: Path | None, provider: Provider | None = None
) -> tuple[Provider, Path | None]:
    """Choose the provider of regions.

    Args:
        scene: The scene, whose folder `labels` holds masks where it exists.
        words: Words to look for.
        masks: Folder of masks that the user named.
        provider: Provider that the user named; without it masks where a folder is given, grounded-sam where there are
            words, else masks where the scene has the folder `labels`, else saliency.

    Returns:
        The provider, and the folder of masks.
    """
    own = scene.folder / "labels"
    if masks is None and own.is_dir() and (provider == "masks" or not (provider or words)):
        masks = own
    return provider or ("masks" if masks else "grounded-sam" if words else "saliency"), masks


def make_provider(
    provider: Provider,
    scene: Scene,
    masks: Path | None,
    has_words: bool,
    weights_dir: Path | None,
    download: bool,
    progress: Progress = lambda stage, fraction: None,
) -> tuple[RegionProvider, Captioner | None]:
    """Make a provider of regions.

    Args:
        provider: Its name.
        scene: The scene.
        masks: Folder of masks.
        has_words: Whether the user named words to look for.
        weights_dir: Folder where networks are looked for first.
        download: Whether networks may be downloaded.
        progress: Called during downloads.

    Returns:
        The provider, and the captioner that finds words where the provider needs some and the user named none.

    Raises:
        InputError: If the folder of masks or a network is missing or damaged.
    """
    if provider == "masks":
        if masks is None:
            raise InputError(f"Masks need a folder: {remedy('name it with --masks', 'choose it in Masks')}.")
        return MaskFolder(masks, scene), None
    if provider == "saliency":
        return Saliency(), None

    def network(name: str) -> Path:
        return _network(name, weights_dir, download, progress)

    vocabulary = network("bert-vocabulary")
    captioner = None if has_words else Blip(network("blip-image"), network("blip-text"), vocabulary)
    detector = GroundingDino(network("grounding-dino"), vocabulary)
    return GroundedSam(detector, Sam(network("mobile-sam-image"), network("mobile-sam-mask"))), captioner


def make_embedder(
    weights_dir: Path | None, download: bool, progress: Progress = lambda stage, fraction: None
) -> Embedder:
    """Make an embedder of regions.

    Args:
        weights_dir: Folder where networks are looked for first.
        download: Whether networks may be downloaded.
        progress: Called during downloads.

    Returns:
        CLIP where its files exist or may be downloaded, else a Descriptor.

    Raises:
        InputError: If a file of CLIP is damaged or cannot be downloaded.
    """
    files = "clip-image", "clip-text", "clip-vocabulary"
    if not download and not all(is_available(name, weights_dir) for name in files):
        return Descriptor()
    image, text, vocabulary = (_network(name, weights_dir, download, progress) for name in files)
    return Clip(image, text, vocabulary)


def _network(name: str, weights_dir: Path | None, download: bool, progress: Progress) -> Path:
    return find_or_fetch(name, weights_dir, download, lambda fraction: progress(f"Download {name}", fraction))
