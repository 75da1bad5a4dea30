"""Draw which packages import which, from the imports in the code, and write the table of packages.

Run: `python docs/scripts/import_diagram.py [--check]`
Results: docs/images/imports.svg, and the block `packages` of docs/architecture.md

The order of the packages and the line below which nothing imports torch are those of .importlinter. An arrow is left
out of the picture where other arrows lead from the one package to the other. With --check nothing is written: stale
files are named, and the exit code is 1.
"""

import ast
import configparser
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import grimp

sys.path.insert(0, str(Path(__file__).parent))

from generated import ROOT, filled, update

TOP = ["operators", "swag_blender"]
"""Packages above the engine, from the top."""
PICTURE = ROOT / "docs" / "images" / "imports.svg"
PAGE = ROOT / "docs" / "architecture.md"
ROW = 34
"""Height of a package in the picture, pixels."""
BOX = (150, 24)
"""Width and height of its box, pixels."""
LEFT, ABOVE = 670, 24
"""Place of the first box, pixels; what the package is for stands left of it."""
STEP = 15
"""Pixels by which an arrow bulges for each package that it passes."""

Imports = Mapping[str, set[str]]
"""Package -> packages that it imports."""


def contracts() -> configparser.ConfigParser:
    """Read .importlinter."""
    parser = configparser.ConfigParser()
    parser.read(ROOT / ".importlinter", encoding="utf-8")
    return parser


def packages(parser: configparser.ConfigParser) -> list[str]:
    """Return the packages from the top down."""
    layers = parser["importlinter:contract:layers"]["layers"].strip().splitlines()
    return [*TOP, *(name.strip() for layer in layers for name in layer.split("|"))]


def below_torch(parser: configparser.ConfigParser) -> set[str]:
    """Return the packages of the engine that must not import torch."""
    modules = parser["importlinter:contract:torch"]["source_modules"].split()
    return {module.rsplit(".", 1)[1] for module in modules}


def imports(names: Sequence[str]) -> Imports:
    """Read the imports between packages from the code, deferred and TYPE_CHECKING ones too."""
    with tempfile.TemporaryDirectory() as folder:
        # The extension has no name of its own: Blender gives it one.
        package = Path(folder, "swag_splatting")
        package.mkdir()
        for name in ("__init__.py", "swag_engine", *TOP):
            (package / name).symlink_to(ROOT / name)
        sys.path.insert(0, folder)
        try:
            graph = grimp.build_graph("swag_splatting", cache_dir=None)
        finally:
            sys.path.remove(folder)

    def package_of(module: str) -> str:
        parts = module.split(".")[1:]
        return parts[1] if parts[0] == "swag_engine" and len(parts) > 1 else parts[0]

    found: dict[str, set[str]] = {name: set() for name in names}
    for importer in graph.modules - {"swag_splatting"}:
        for imported in graph.find_modules_directly_imported_by(importer) - {"swag_splatting"}:
            pair = package_of(importer), package_of(imported)
            if pair[0] != pair[1] and set(pair) <= set(names):
                found[pair[0]].add(pair[1])
    return found


def reduced(found: Imports) -> Imports:
    """Leave out imports that follow from others."""

    def reached(name: str) -> set[str]:
        return found[name].union(*(reached(other) for other in found[name]))

    return {
        name: {other for other in direct if not any(other in reached(between) for between in direct)}
        for name, direct in found.items()
    }


def purpose(name: str) -> str:
    """Return the first line of a package's docstring."""
    folder = ROOT / name if name in TOP else ROOT / "swag_engine" / name
    docstring = ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8")))
    return (docstring or "").partition("\n")[0].partition(". ")[0].rstrip(".")


def escaped(text: str) -> str:
    """Return text for XML."""
    return text.replace("&", "&amp;").replace("<", "&lt;")


def picture(names: Sequence[str], arrows: Imports, torch_free: set[str]) -> str:
    """Draw the packages below one another and the imports between them.

    Args:
        names: Packages from the top down.
        arrows: The imports to draw.
        torch_free: Packages of the engine that do not import torch.

    Returns:
        The text of an SVG.
    """
    width, height = BOX
    right = LEFT + width
    line = next(number for number, name in enumerate(names) if name in torch_free)
    bottom = ABOVE + ROW * len(names) + 8
    farthest = max(names.index(to) - names.index(of) for of in arrows for to in arrows[of])
    size = right + STEP * farthest + 30, bottom

    def middle(name: str) -> float:
        return ABOVE + ROW * names.index(name) + height / 2

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size[0]} {size[1]}" width="{size[0]}" '
        f'height="{size[1]}" font-family="sans-serif" font-size="13">',
        "<title>Imports between the packages: every arrow goes down</title>",
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0 L8 4 L0 8 Z" fill="#3f51b5"/></marker></defs>',
        f'<rect width="{size[0]}" height="{size[1]}" fill="#ffffff"/>',
    ]
    boxes, titles, purposes, curves = [], [], [], []
    for name in names:
        y = middle(name)
        fill = "#fff3e0" if name in TOP else "#e8f5e9" if name in torch_free else "#e8eaf6"
        boxes.append(
            f'<rect x="{LEFT}" y="{y - height / 2:.0f}" width="{width}" height="{height}" rx="4" fill="{fill}"/>'
        )
        titles.append(f'<text x="{LEFT + width / 2:.0f}" y="{y + 4:.0f}">{name}</text>')
        purposes.append(f'<text x="{LEFT - 10}" y="{y + 4:.0f}">{escaped(purpose(name))}</text>')
        # Arrows leave a box below those that enter it, so that their ends stay apart.
        for to in sorted(arrows[name], key=names.index):
            start, end = y + 5, middle(to) - 5
            bulge = right + 12 + STEP * (names.index(to) - names.index(name))
            curves.append(
                f'<path d="M{right} {start:.0f} C{bulge} {start:.0f} {bulge} {end:.0f} {right} {end:.0f}" '
                'marker-end="url(#tip)"/>'
            )
    for style, drawn in (
        ('stroke="#90a4ae"', boxes),
        ('text-anchor="middle"', titles),
        ('text-anchor="end" font-size="11" fill="#455a64"', purposes),
        ('stroke="#3f51b5" fill="none"', curves),
    ):
        parts += [f"<g {style}>", *drawn, "</g>"]
    y = ABOVE + ROW * line - (ROW - height) / 2
    parts += [
        f'<path d="M10 {y:.0f} H{size[0] - 10}" stroke="#2e7d32" stroke-dasharray="5 4" fill="none"/>',
        f'<text x="{size[0] - 10}" y="{y - 4:.0f}" text-anchor="end" font-size="11" fill="#2e7d32">'
        "below: no torch</text>",
    ]
    return "\n".join([*parts, "</svg>", ""])


def table(names: Sequence[str], found: Imports) -> str:
    """Return a table of the packages, what they are for, and all that they import."""
    lines = ["| package | what it holds | imports |", "| --- | --- | --- |"]
    for name in names:
        path = name if name in TOP else f"swag_engine/{name}"
        imported = ", ".join(sorted(found[name], key=names.index)) or "nothing"
        lines.append(f"| `{path}` | {purpose(name)} | {imported} |")
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> int:
    """Write or check picture and table and return the exit code."""
    parser = contracts()
    names = packages(parser)
    found = imports(names)
    page = filled(PAGE.read_text("utf-8"), {"packages": table(names, found)})
    drawn = picture(names, reduced(found), below_torch(parser))
    return update({PICTURE: drawn, PAGE: page}, "--check" in arguments, "python docs/scripts/import_diagram.py")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
