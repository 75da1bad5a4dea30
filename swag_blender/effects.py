"""The plan of a scene as a list: the decision, evidence and cost of each effect, and the user's choice."""

from typing import Annotated, Any, Literal

import bpy
from bpy.props import BoolProperty, CollectionProperty, EnumProperty, FloatProperty, IntProperty, StringProperty
from bpy.types import PropertyGroup

from .blender_types import with_properties

STATE_ICONS: dict[str, Literal["CHECKMARK", "X", "QUESTION"]] = {"on": "CHECKMARK", "off": "X", "unknown": "QUESTION"}


@with_properties
class SwagEffect(PropertyGroup):
    """One line of the plan; `name` is the engine's name of the effect."""

    state: Annotated[str, StringProperty(name="Plan", description="Decision of the plan: on, off or undetermined")]
    reason: Annotated[
        str, StringProperty(name="Evidence", description="Figures of the decision, with their thresholds")
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


@with_properties
class SwagPlan(PropertyGroup):
    """`scene.swag.plan`: one line for each effect, in the engine's order."""

    lines: Annotated["bpy.types.bpy_prop_collection_idprop[SwagEffect]", CollectionProperty(type=SwagEffect)]
    active: Annotated[int, IntProperty(name="Effect", options=set())]
    stale: Annotated[bool, BoolProperty(description="Other photos were chosen after the plan was made")]

    def take(self, plan: dict[str, Any]) -> None:
        """Show a plan as plan.json has it; the user's choices stay."""
        choices = {line.name: line.choice for line in self.lines}
        self.lines.clear()
        for name, effect in plan["effects"].items():
            line = self.lines.add()
            line.name, line.state, line.reason = name, effect["state"], effect["reason"]
            line.cost_ms, line.choice = effect["cost_ms"], choices.get(name, "PLAN")
        self.active, self.stale = min(self.active, len(self.lines) - 1), False

    def switches(self) -> str:
        """The user's choices as the engine's setting `effects` takes them."""
        return ",".join(f"{line.name}={line.choice.lower()}" for line in self.lines if line.choice != "PLAN")


class SWAG_UL_effects(bpy.types.UIList):
    """List of the effects: name, decision, cost, choice."""

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
        row = layout.row(align=True)
        row.label(text=item.title, icon=STATE_ICONS.get(item.state, "QUESTION"))
        cost = row.row()
        cost.alignment = "RIGHT"
        cost.label(text=f"{item.cost_ms:.1f} ms" if item.cost_ms else "")
        row.prop(item, "choice", text="", icon_only=True)


_CLASSES = (SwagEffect, SwagPlan, SWAG_UL_effects)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
