"""The plan of a scene as a list: the decision, figures and cost of each effect, and the user's choice."""

from typing import Annotated, Any, Literal

import bpy
from bpy.props import BoolProperty, CollectionProperty, EnumProperty, FloatProperty, IntProperty, StringProperty
from bpy.types import PropertyGroup

from ..swag_engine.settings.effect_figures import figure_rows
from ..swag_engine.settings.effect_names import EFFECTS, EffectWords
from .blender_types import set_button, with_properties

STATES: dict[str, tuple[Literal["CHECKMARK", "X", "QUESTION"], str]] = {
    "on": ("CHECKMARK", "The plan models it."),
    "off": ("X", "The plan does not model it."),
    "unknown": ("QUESTION", "The photos cannot show whether it is so."),
}
"""Icon and sentence of each decision."""
NO_WATER = "No water is modelled: the colors are as photographed."
WATER_UNKNOWN = "Whether there is water cannot be seen: it stays in the colors."
WATER_EFFECT = "attenuation"
"""Effect without which no water is modelled."""


@with_properties
class SwagFigure(PropertyGroup):
    """One figure of a decision; `name` is what was measured."""

    measured: Annotated[str, StringProperty(description="Value that was measured in the photos")]
    needed: Annotated[str, StringProperty(description="Value that the effect needs")]
    met: Annotated[bool, BoolProperty(description="Whether the measured value is what the effect needs")]


@with_properties
class SwagEffect(PropertyGroup):
    """One line of the plan; `name` is the engine's name of the effect."""

    state: Annotated[str, StringProperty(name="Plan", description="Decision of the plan: on, off or undetermined")]
    reason: Annotated[
        str, StringProperty(name="Reason", description="The decision in a sentence, with figures and thresholds")
    ]
    figures: Annotated[
        "bpy.types.bpy_prop_collection_idprop[SwagFigure]",
        CollectionProperty(name="Figures", description="What was measured, and what is needed", type=SwagFigure),
    ]
    cost_ms: Annotated[
        float, FloatProperty(name="Cost", description="Milliseconds that the effect adds to an iteration here")
    ]
    choice: Annotated[
        str,
        EnumProperty(
            name="Choice",
            description="Whether training models this effect",
            items=[
                ("PLAN", "Plan", "As the plan decided; undetermined effects stay off", "DOT", 0),
                ("ON", "On", "Model it, whatever the plan decided", "CHECKBOX_HLT", 1),
                ("OFF", "Off", "Do not model it, whatever the plan decided", "CHECKBOX_DEHLT", 2),
            ],
            options=set(),
        ),
    ]

    @property
    def title(self) -> str:
        """Name of the effect in the interface."""
        return self.name.replace("_", " ").capitalize()

    @property
    def words(self) -> EffectWords:
        """What the interface says of the effect; of a later version's effect, its name."""
        return EFFECTS.get(self.name) or EffectWords(self.title, self.title)

    @property
    def explained(self) -> bool:
        """Whether the figures alone explain the decision; else the reason is needed."""
        met = all(figure.met for figure in self.figures)
        return bool(self.figures) and self.state in ("on", "off") and met == (self.state == "on")

    def take(self, effect: dict[str, Any]) -> None:
        """Store a line of plan.json."""
        self.state, self.reason, self.cost_ms = effect["state"], effect["reason"], effect["cost_ms"]
        for row in figure_rows(self.name, effect["evidence"]):
            figure = self.figures.add()
            figure.name, figure.measured, figure.needed, figure.met = row.label, row.measured, row.needed, row.met


@with_properties
class SwagPlan(PropertyGroup):
    """`scene.swag.plan`: one line for each effect, in the engine's order."""

    lines: Annotated["bpy.types.bpy_prop_collection_idprop[SwagEffect]", CollectionProperty(type=SwagEffect)]
    active: Annotated[int, IntProperty(name="Effect", options=set())]
    folder: Annotated[str, StringProperty(description="Folder of the photos that the plan was made for")]

    def take(self, plan: dict[str, Any], folder: str) -> None:
        """Show a plan of the photos in `folder` as plan.json has it; the user's choices stay."""
        choices = {line.name: line.choice for line in self.lines}
        self.lines.clear()
        for name, effect in plan["effects"].items():
            line = self.lines.add()
            line.name, line.choice = name, choices.get(name, "PLAN")
            line.take(effect)
        self.active, self.folder = min(self.active, len(self.lines) - 1), folder

    def switches(self) -> str:
        """The user's choices as the engine's setting `effects` takes them."""
        return ",".join(f"{line.name}={line.choice.lower()}" for line in self.lines if line.choice != "PLAN")

    def line(self, name: str) -> SwagEffect | None:
        """The line of an effect; None without one."""
        index = self.lines.find(name)
        return self.lines[index] if index >= 0 else None

    def wants(self, name: str) -> bool:
        """Whether training would model an effect by the plan and the user's choices; False without a plan."""
        line = self.line(name)
        return line is not None and (line.choice == "ON" or (line.choice == "PLAN" and line.state == "on"))

    @property
    def water_note(self) -> str:
        """A sentence where the plan models no water; "" where it does, and without a plan."""
        if not self.lines or self.wants(WATER_EFFECT):
            return ""
        line = self.line(WATER_EFFECT)
        if line is not None and line.state == "unknown" and line.choice == "PLAN":
            return WATER_UNKNOWN
        return NO_WATER


def state_icon(state: str) -> Literal["CHECKMARK", "X", "QUESTION"]:
    """Icon of a decision."""
    return STATES.get(state, STATES["unknown"])[0]


def state_sentence(state: str) -> str:
    """A decision as a sentence."""
    return STATES.get(state, STATES["unknown"])[1]


def tooltip(plan: SwagPlan, effect: str) -> str:
    """What an effect does, and the plan's decision about it in a sentence."""
    line = plan.line(effect)
    if line is None:
        return ""
    translate = bpy.app.translations.pgettext_tip
    return f"{translate(line.words.sentence)}\n{translate(state_sentence(line.state))}\n{line.reason}".rstrip(".")


class SWAG_UL_effects(bpy.types.UIList):
    """List of the effects: decision, what is so where it is on, choice."""

    def draw_item(
        self,
        context: bpy.types.Context | None,
        layout: bpy.types.UILayout,
        data: Any,
        item: Any,
        icon: int | None,
        active_data: Any,
        active_property: str | None,
        index: int | None,
        flt_flag: int | None,
    ) -> None:
        """Draw one effect; Blender calls this."""
        row = layout.split(factor=0.84, align=True)
        line = row.row(align=True)
        line.alignment = "LEFT"
        button = line.operator("swag.show_effect", text=item.words.statement, icon=state_icon(item.state), emboss=False)
        set_button(button, effect=item.name)
        row.prop(item, "choice", text="", icon_only=True)


_CLASSES = (SwagFigure, SwagEffect, SwagPlan, SWAG_UL_effects)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
