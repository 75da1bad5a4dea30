"""Names of effects and of parts of the method, the same in the plan, on the command line and in Blender.

EFFECTS is the registry of effects: each name is a file of swag_engine/effects/.
"""

from dataclasses import dataclass

from ..base.errors import InputError


@dataclass(frozen=True)
class EffectWords:
    """What the interface says of an effect.

    Attributes:
        statement: What is so where the effect is on, in at most 30 characters.
        sentence: What the effect does, in one sentence.
    """

    statement: str
    sentence: str


EFFECTS = {
    "attenuation": EffectWords("Water absorbs colors", "The water takes light, of one color more than of another."),
    "backscatter": EffectWords("Water adds haze", "The water adds light of its own, more with distance."),
    "separate_backscatter": EffectWords(
        "Haze grows at its own rate", "The light that the water adds grows with range by a coefficient of its own."
    ),
    "lamp": EffectWords("A lamp is at the camera", "Light from a lamp at the camera falls off with its distance."),
    "beam": EffectWords("The lamp has a beam", "The lamp lights one part of each photo more than another."),
    "exposure": EffectWords("Exposure varies", "Each photo has an exposure and a color balance of its own."),
    "vignetting": EffectWords("Corners are darker", "The lens darkens photos towards their corners."),
    "caustics": EffectWords("Waves cast moving light", "Light that waves throw on the ground flickers."),
    "moving_objects": EffectWords("Fish or divers move", "Fish, divers and other moving objects are masked out."),
    "interpolation": EffectWords("Photos are far apart", "Frames are interpolated between photos that are far apart."),
    "semantics": EffectWords(
        "Open water needs a label", "The splats get labels during training, where you switch it on."
    ),
    "depth_prior": EffectWords("Sparse points are few", "Predicted depth helps where sparse points are few."),
}
"""Effects that the plan decides about, in the order of decisions."""
PARTS = {
    "stages": "Geometry and water are frozen at the end, and colors follow the squared error.",
    "dropout": "Gaussians are dropped at random where the run overfits.",
    "reallocation": "Gaussians are relocated from where they matter least to where the error is largest.",
    "grey_world": "The scene without water is grey on average.",
    "smoothness": "Range is smooth where the photo is.",
    "hinge": "The channels keep their order of attenuation.",
    "salient_densification": "Salient regions are densified first.",
    "salient_pixels": "Pixels of salient regions weigh more.",
    "open_water": "Open water has no Gaussians of its own.",
    "class_pruning": "Gaussians of water and haze are removed.",
}
"""Parts of a method that do not depend on the scene; the plan does not decide about them."""
TOGETHER = {"water": ("attenuation", "backscatter")}
"""Names for several effects at once."""
NEEDS = {"backscatter": "attenuation", "separate_backscatter": "backscatter", "beam": "lamp"}
"""Effects that make no sense without another."""


def parse_effects(text: str) -> dict[str, bool]:
    """Parse choices such as "attenuation=off,lamp=on".

    Switching an effect on switches on what it needs; switching one off switches off what needs it.

    Args:
        text: Choices between commas; the last one on a name counts.

    Returns:
        Whether each effect or part is on, by name, with what the choices imply.

    Raises:
        InputError: For an unknown name or state, or choices that contradict one another.
    """
    said: dict[str, bool] = {}
    for part in filter(None, (piece.strip() for piece in text.split(","))):
        word, _, state = (piece.strip() for piece in part.partition("="))
        name = word.replace("-", "_")
        if name not in (*EFFECTS, *PARTS, *TOGETHER):
            raise InputError(f"There is no effect {word!r}; there are {', '.join((*EFFECTS, *PARTS, *TOGETHER))}.")
        if state not in ("on", "off"):
            raise InputError(f"The effect {word} can be on or off, not {state!r}: write {word}=on or {word}=off.")
        said |= dict.fromkeys(TOGETHER.get(name, (name,)), state == "on")
    for effect, needed in NEEDS.items():
        if said.get(effect) and said.get(needed) is False:
            raise InputError(f"The effect {effect} needs {needed}: switch both on, or both off.")
    choices = dict(said)
    for effect, needed in NEEDS.items():  # from the effect that needs least
        if choices.get(needed) is False:
            choices[effect] = False
    for effect, needed in reversed(NEEDS.items()):
        if choices.get(effect):
            choices[needed] = True
    return choices
