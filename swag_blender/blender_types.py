"""What type checking needs to know about Blender beyond the types of fake-bpy-module."""

from typing import Annotated, Any, Literal, TypeVar, cast, get_origin

import bpy

T = TypeVar("T")
Class = TypeVar("Class", bound=type)

OperatorResult = set[Literal["RUNNING_MODAL", "CANCELLED", "FINISHED", "PASS_THROUGH", "INTERFACE"]]
"""Return value of an operator's execute, invoke and modal."""


def with_properties(cls: Class) -> Class:
    """Let Blender see the properties of a class (decorator).

    A property is written `name: Annotated[float, FloatProperty(...)]`: type checkers read the type, and Blender gets
    the definition, which it expects as the annotation.
    """
    cls.__annotations__ = {
        name: hint.__metadata__[0] if get_origin(hint) is Annotated else hint
        for name, hint in cls.__annotations__.items()
    }
    return cls


def present(value: T | None) -> T:
    """The value itself, where Blender's types allow None and Blender never gives it (a panel's layout)."""
    assert value is not None
    return value


def call_operator(name: str, *arguments: str, **properties: Any) -> None:
    """Call an operator of the extension, `swag.NAME`, as `bpy.ops` does."""
    getattr(cast(Any, bpy.ops).swag, name)(*arguments, **properties)


def set_button(button: bpy.types.OperatorProperties | None, **values: Any) -> None:
    """Set the properties with which a button, made by `layout.operator`, calls its operator."""
    for name, value in values.items():
        setattr(button, name, value)
