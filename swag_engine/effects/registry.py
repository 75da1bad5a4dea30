"""All effects by name. A new effect is one file here and one line in settings/effect_names.py."""

from importlib import import_module

from ..settings.effect_names import EFFECTS
from .effect import Effect

REGISTRY: dict[str, Effect] = {name: import_module(f".{name}", __package__).EFFECT for name in EFFECTS}
"""Name -> effect, in the order of decisions."""
MODELS: dict[str, Effect] = {effect.model_name or name: effect for name, effect in REGISTRY.items() if effect.load}
"""Key of a model in checkpoints -> its effect."""
