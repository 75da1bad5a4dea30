"""Other languages: each table has every word that the interface shows, and no other."""

import ast
import re

import pytest

# Proper names and figures, the same in every language.
SAME = {"SWAG Splatting", "PLY (3DGS)", "glTF (GLB)", "PSNR", "SSIM", " ms", "Cycles", "EEVEE"}

COLLECT = """
import json, re, bpy
found = set()
kinds = (bpy.types.Operator, bpy.types.Panel, bpy.types.Menu, bpy.types.PropertyGroup, bpy.types.AddonPreferences,
         bpy.types.FileHandler)
def below(kind):
    for cls in kind.__subclasses__():
        yield cls
        yield from below(cls)
for cls in {cls for kind in kinds for cls in below(kind) if "swag_splatting" in cls.__module__}:
    if "bl_rna" not in vars(cls):  # a base class, which is not registered
        continue
    if cls.__name__ == "SwagStatus":  # for scripts: panels show its values alone
        continue
    rna = cls.bl_rna
    if issubclass(cls, bpy.types.Operator):
        rna = getattr(bpy.ops.swag, cls.bl_idname.partition(".")[2]).get_rna_type()
        found.add(rna.description)
    found.add(getattr(cls, "bl_label", ""))
    own = {name for one in cls.__mro__ if "swag_splatting" in one.__module__
           for name in vars(one).get("__annotations__", ())}
    for shown in (rna.properties[name] for name in own & set(rna.properties.keys())):
        if not shown.is_hidden:
            for item in (shown, *getattr(shown, "enum_items", ())):
                found |= {item.description} | ({item.name} - {item.identifier})
print("SHOWN", json.dumps(sorted(word for word in found if re.search("[A-Za-z]{2}", word))))
"""


def drawn(root):
    """The constants among the texts of labels and buttons, and why a button is off."""
    words = set()
    for folder in ("swag_blender", "operators"):
        for path in (root / folder).rglob("*.py"):
            for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if not isinstance(call, ast.Call):
                    continue
                texts = [keyword.value for keyword in call.keywords if keyword.arg == "text"]
                function = getattr(call.func, "id", getattr(call.func, "attr", ""))
                texts += call.args[1:2] if function == "draw_wrapped" else []
                texts += call.args[:1] if function == "poll_message_set" else []
                for text in texts:
                    either = (text.body, text.orelse) if isinstance(text, ast.IfExp) else (text,)
                    words |= {n.value for n in either if isinstance(n, ast.Constant) and isinstance(n.value, str)}
    return {word for word in words if re.search("[A-Za-z]{2}", word)}


@pytest.fixture(scope="module")
def german(root):
    tree = ast.parse((root / "swag_blender" / "translations.py").read_text(encoding="utf-8"))
    return ast.literal_eval(next(node.value for node in tree.body if isinstance(node, ast.Assign)))


def test_a_table_has_what_is_shown_and_nothing_else(blender, root, german):
    shown = set(blender.json_after("SHOWN", blender.run(COLLECT))) | drawn(root)
    missing, unknown = shown - set(german) - SAME, set(german) - shown
    assert not missing and not unknown, (sorted(missing), sorted(unknown))
    assert all(german.values())
