"""Other languages: every word of a table is one that the interface shows."""

import ast


def shown(root):
    """The string literals of the sources of the interface, their f-strings left out."""
    words = set()
    for folder in ("swag_blender", "operators"):
        for path in (root / folder).rglob("*.py"):
            if path.name != "translations.py":
                tree = ast.parse(path.read_text(encoding="utf-8"))
                words |= {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)}
    return words


def test_tables_have_no_words_that_nothing_shows(root):
    tree = ast.parse((root / "swag_blender" / "translations.py").read_text(encoding="utf-8"))
    german = next(node.value for node in tree.body if isinstance(node, ast.Assign) and node.targets[0].id == "GERMAN")
    words = ast.literal_eval(german)
    assert not set(words) - shown(root)
    assert all(words.values())
