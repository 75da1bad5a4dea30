"""The interface in other languages. What is missing from a table stays English; sentences of the engine always do.

Blender looks up labels, tooltips and names of properties by themselves: a language is a table of English and own words.
"""

import bpy

from . import EXTENSION

GERMAN = {
    "Scene": "Szene",
    "Photographs": "Fotos",
    "Photographs with COLMAP model": "Fotos mit COLMAP-Modell",
    "Check": "Prüfen",
    "Check Photographs": "Fotos prüfen",
    "Import": "Importieren",
    "Import COLMAP Scene": "COLMAP-Szene importieren",
    "Effects": "Effekte",
    "Plan": "Planen",
    "Plan Again": "Neu planen",
    "Plan Effects": "Effekte planen",
    "Follow Plan": "Plan folgen",
    "On": "Ein",
    "Off": "Aus",
    "Train": "Trainieren",
    "Continue": "Fortsetzen",
    "Pause": "Anhalten",
    "Go On": "Weiter",
    "Pause or Go On": "Anhalten oder weiter",
    "Cancel": "Abbrechen",
    "Show Log": "Protokoll zeigen",
    "More": "Mehr",
    "Method": "Verfahren",
    "Quality": "Güte",
    "Time Budget": "Zeitrahmen",
    "Stop When Flat": "Enden, wenn nichts mehr kommt",
    "Iterations": "Schritte",
    "Width": "Breite",
    "Max Gaussians": "Höchstzahl der Gaußglocken",
    "Water": "Wasser",
    "Metres per Unit": "Meter je Einheit",
    "SH Degree": "SH-Grad",
    "Result": "Ergebnis",
    "Set Up Render": "Rendern vorbereiten",
    "Open Splat File": "Splat-Datei öffnen",
    "Labels": "Etiketten",
    "Export": "Exportieren",
    "Install Engine": "Rechenkern einrichten",
    "Install Engine Again": "Rechenkern neu einrichten",
    "Remove Engine": "Rechenkern entfernen",
    "Check Engine": "Rechenkern prüfen",
    "Look Up Size": "Größe nachsehen",
    "Package Index": "Paketverzeichnis",
    "Folder of Wheels": "Ordner mit Wheels",
    "Open Preferences": "Einstellungen öffnen",
    "Choose the folder first.": "Zuerst den Ordner wählen.",
}


def table(words: dict[str, str]) -> dict[tuple[str, str], str]:
    """As Blender takes it: buttons of operators have a context of their own."""
    return {(context, english): own for english, own in words.items() for context in ("*", "Operator")}


def register() -> None:
    bpy.app.translations.register(EXTENSION, {"de_DE": table(GERMAN)})


def unregister() -> None:
    bpy.app.translations.unregister(EXTENSION)
