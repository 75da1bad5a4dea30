"""Translations: each table has every text that the interface shows, and no other."""

import ast
import json
import re

import pytest

# Proper names and figures, the same in every language.
SAME = {"SWAG Splatting", "PLY (3DGS)", "glTF (GLB)", "PSNR", "SSIM", " ms", "Cycles", "EEVEE", "Lasso", "Radius"}


def drawn_words(root):
    """Constant texts of labels, buttons, the status bar, and of the reasons why a button is disabled."""
    words = set()
    for folder in ("swag_blender", "operators"):
        for path in (root / folder).rglob("*.py"):
            for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(call, ast.Assign) and [getattr(t, "id", "") for t in call.targets] == ["hint"]:
                    words.add(ast.literal_eval(call.value))
                if not isinstance(call, ast.Call):
                    continue
                texts = [keyword.value for keyword in call.keywords if keyword.arg == "text"]
                function = getattr(call.func, "id", getattr(call.func, "attr", ""))
                texts += call.args[1:2] if function == "draw_wrapped" else []
                texts += call.args[:1] if function in ("poll_message_set", "pgettext_iface", "translate") else []
                for text in texts:
                    either = (text.body, text.orelse) if isinstance(text, ast.IfExp) else (text,)
                    words |= {n.value for n in either if isinstance(n, ast.Constant) and isinstance(n.value, str)}
    return {word for word in words if re.search("[A-Za-z]{2}", word)}


@pytest.fixture(scope="module")
def german(root):
    tree = ast.parse((root / "swag_blender" / "translations.py").read_text(encoding="utf-8"))
    return ast.literal_eval(next(node.value for node in tree.body if isinstance(node, ast.Assign)))


def test_a_table_has_every_shown_text_and_no_other(blender, root, german):
    shown = set(blender.run("translations.shown_words")) | drawn_words(root)
    missing, unknown = shown - set(german) - SAME, set(german) - shown
    assert not missing, json.dumps(sorted(missing))
    # Some texts are shown in the newest version alone.
    assert blender.version != "5.3" or not unknown, json.dumps(sorted(unknown))
    assert all(german.values())
