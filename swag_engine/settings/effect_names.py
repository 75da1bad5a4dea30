"""The words that effects are switched by, the same in the plan, on the command line and in Blender."""

from ..base.errors import InputError

EFFECTS = {
    "attenuation": "The water takes light, of one colour more than of another.",
    "backscatter": "The water adds light of its own.",
    "separate_backscatter": "That light grows with range by a coefficient of its own.",
    "lamp": "A lamp at the camera: light falls off with the square of the range.",
    "exposure": "Each photograph has a brightness of its own.",
    "caustics": "Light that waves throw on the ground flickers.",
    "moving_objects": "Fish, divers and other things that move are left out.",
    "interpolation": "Frames are made between photographs that are far apart.",
    "semantics": "Things get names.",
    "depth_prior": "A network's depth helps where sparse points are few.",
}
"""What the plan decides for a scene, and what each is."""
PARTS = {
    "stages": "Geometry and water are frozen at the end, and colours follow the square error.",
    "dropout": "Gaussians are left out at random where photographs are learned by heart.",
    "reallocation": "Gaussians move from where they show least to where the error is largest.",
    "grey_world": "The place without water is grey on average.",
    "smoothness": "Range is smooth where the photograph is.",
    "hinge": "The channels keep their order of attenuation.",
    "salient_growth": "Gaussians of what stands out grow first.",
    "salient_pixels": "Pixels of what stands out weigh more.",
    "open_water": "Open water has no Gaussians of its own.",
    "class_pruning": "Gaussians of water and haze are taken out.",
}
"""What a method has or has not, whatever the scene; the plan is silent about them."""
TOGETHER = {"water": ("attenuation", "backscatter")}
"""Words for several effects at once."""
NEEDS = {"backscatter": "attenuation", "separate_backscatter": "backscatter"}
"""An effect that makes no sense without another."""


def parse_effects(text: str) -> dict[str, bool]:
    """What `--effects attenuation=off,lamp=on` says, by name, with what it implies; the last word on a name counts.

    Switching an effect on switches on what it needs, switching one off what needs it. Raises InputError naming the word
    that is wrong, or two that contradict one another.
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
