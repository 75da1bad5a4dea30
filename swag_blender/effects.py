"""The plan of a scene as a list: which effects it calls for, why, what each costs, and what the user says instead."""

from typing import Any

import bpy
from bpy.props import BoolProperty, CollectionProperty, EnumProperty, FloatProperty, IntProperty, StringProperty
from bpy.types import PropertyGroup

STATES = {"on": "CHECKMARK", "off": "X", "unknown": "QUESTION"}


class SwagEffect(PropertyGroup):
    """One line of the plan; `name` is the engine's name of the effect."""

    state: StringProperty(name="Plan", description="What the photographs say: on, off or unknown")
    reason: StringProperty(name="Evidence", description="The figures behind it, each beside its threshold")
    cost_ms: FloatProperty(name="Cost", description="Milliseconds that the effect adds to an iteration here")
    choice: EnumProperty(
        name="Choice",
        description="Whether training simulates this effect",
        items=[
            ("PLAN", "Plan", "What the photographs say; what they cannot tell stays off", "DOT", 0),
            ("ON", "On", "Simulate it whatever the photographs say", "CHECKBOX_HLT", 1),
            ("OFF", "Off", "Leave it out whatever the photographs say", "CHECKBOX_DEHLT", 2),
        ],
        options=set(),
    )

    @property
    def title(self) -> str:
        return self.name.replace("_", " ").capitalize()


class SwagPlan(PropertyGroup):
    """`scene.swag.plan`: the lines, in the engine's order."""

    lines: CollectionProperty(type=SwagEffect)
    active: IntProperty(name="Effect", options=set())
    stale: BoolProperty(description="Other photographs have been chosen since")

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
    """The lines of the plan."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property) -> None:
        row = layout.row(align=True)
        row.label(text=item.title, icon=STATES.get(item.state, "QUESTION"))
        cost = row.row()
        cost.alignment = "RIGHT"
        cost.label(text=f"{item.cost_ms:.1f} ms" if item.cost_ms else "")
        row.prop(item, "choice", text="", icon_only=True)


_CLASSES = (SwagEffect, SwagPlan, SWAG_UL_effects)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
